"""Steers a vessel along a course with its identified model: CasADi against PID.

    residnet run configs/quickstart.yaml
    residnet export runs/quickstart --model plsr --format casadi
    python examples/casadi_mpc/steer.py runs/quickstart/exports/plsr.casadi wam_v_cal

The plant is the vessel that the model was learned from. Both controllers know the exported model
and nothing else; the gains of the PID are those that are best on the model along the same course.
Prints cross-track errors, and how long the solutions took.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from controllers import FeedForwardPID, Gains, Predictive
from model import Identified
from track import Track

from residnet.simulators.vehicle import Vehicle, load_vehicle

WAYPOINTS = [[0, 0], [40, 0], [60, 30], [100, 30], [100, 70], [60, 80], [30, 60]]
_START = 5.0
"""Part of the course in m behind which errors count: both controllers start from rest."""


class Plant:
    """The vessel in calm water, its measured actuators among its states.

    Args:
        source: name or file of the vessel.
        model: whose inputs drive it.
    """

    def __init__(self, source: str, model: Identified) -> None:
        self.vehicle: Vehicle = load_vehicle(source, dt=model.dt)
        commands = self.vehicle.inputs[: self.vehicle.n_commands]
        short = {name.removeprefix("cmd_"): k for k, name in enumerate(commands)}
        names = [name.removeprefix("cmd_") for name in model.inputs]
        places = [short.get(name, short.get(name.removeprefix("n_"), -1)) for name in names]
        if sorted(places) != list(range(len(commands))):
            raise ValueError(
                f"the model's inputs {', '.join(model.inputs)} are not the commands of {source}:"
                f" {', '.join(commands)}"
            )
        self.order = np.argsort(places)
        states = self.vehicle.states
        self.seen = [states.index(name) if name in states else -1 for name in names]
        self.reset()

    def reset(self) -> None:
        """Put the vessel at rest at the origin."""
        self.x = self.vehicle.initial_state.double().clone()
        self.x[:6] = 0.0
        self.x[6:] = 0.0
        self.given = np.zeros(2)

    def step(self, given: np.ndarray) -> None:
        """Move one step of the model under inputs [2] in the model's order."""
        self.given = given
        commands = torch.from_numpy(given[self.order]).unsqueeze(0)
        w = self.vehicle.inputs_at(commands.to(self.vehicle.lower_commands.dtype))
        memory = self.vehicle.dynamics.initial_state(1).to(self.x.dtype)
        self.x = self.vehicle.dynamics.step(self.x.unsqueeze(0), w.to(self.x.dtype), memory)[0][0]

    @property
    def measured(self) -> np.ndarray:
        """The state [6]."""
        return np.asarray(self.x[:6].numpy())

    @property
    def used(self) -> np.ndarray:
        """The inputs [2] as they stand now: actuators where they are measured, else commands."""
        return np.array(
            [float(self.x[k]) if k >= 0 else self.given[i] for i, k in enumerate(self.seen)]
        )

    def rates(self, model: Identified) -> np.ndarray:
        """Return how fast each input changes per second when all is asked of it."""
        self.reset()
        self.step(model.high[3:])
        fast = np.abs(self.used) / model.dt
        self.reset()
        return np.maximum(fast, 1e-3 * (model.high - model.low)[3:])


class OnModel:
    """The model in the place of the vessel, to tune on."""

    def __init__(self, model: Identified) -> None:
        self.model = model
        self.measured = np.zeros(6)
        self.memory = np.zeros(model.memory)

    def step(self, given: np.ndarray) -> None:
        after, memory, _ = self.model.step(self.measured, given, self.memory)
        self.measured = np.asarray(after).ravel()
        self.memory = np.asarray(memory).ravel()


def sailed(pilot: FeedForwardPID, craft: Plant | OnModel, track: Track, limit: float) -> np.ndarray:
    """Return place and cross-track error [T, 2] of a course under the PID."""
    place = 0.0
    rows = []
    for _ in range(round(limit / pilot.model.dt)):
        x, y = craft.measured[:2]
        place = track.place(x, y, place)
        rows.append((place, track.aside(x, y, place)))
        if place >= track.length or abs(rows[-1][1]) > 50.0:
            break
        craft.step(pilot(craft.measured, place))
    return np.array(rows)


def predicted(
    pilot: Predictive, craft: Plant, track: Track, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return place and cross-track error [T, 2] under the MPC, and seconds of each solution."""
    place = 0.0
    rows = []
    taken = []
    given = craft.used
    for k in range(round(limit / pilot.model.dt)):
        x, y = craft.measured[:2]
        place = track.place(x, y, place)
        rows.append((place, track.aside(x, y, place)))
        if place >= track.length or abs(rows[-1][1]) > 50.0:
            break
        pilot.observe(craft.measured, craft.used)
        if k % pilot.every == 0:
            begun = time.process_time()
            given = pilot(craft.measured, place, craft.used)
            taken.append(time.process_time() - begun)
        craft.step(given)
    return np.array(rows), np.array(taken)


def rms(rows: np.ndarray, track: Track) -> float:
    """Return the RMS cross-track error in m; without end where the course was not finished."""
    if rows[-1, 0] < track.length:
        return math.inf
    return float(np.sqrt(np.mean(rows[rows[:, 0] > _START, 1] ** 2)))


def tuned(model: Identified, track: Track, speed: float, limit: float, slowest: float) -> Gains:
    """Return the gains with the least RMS cross-track error on the model along the course."""
    grid = itertools.product(
        [share / slowest for share in (0.7, 1.4, 2.8)],
        [reach * speed * slowest for reach in (1.0, 2.0, 4.0)],
        [share * slowest for share in (0.0, 0.35, 0.7)],
    )
    scores = {}
    for choice in grid:
        gains = Gains(*choice)
        pilot = FeedForwardPID(model, track, speed, gains)
        scores[gains] = rms(sailed(pilot, OnModel(model), track, limit), track)
    best = min(scores, key=lambda gains: scores[gains])
    if math.isinf(scores[best]):
        raise ValueError("no gains of the PID bring the model to the end of the course")
    return best


def compared(model: Identified, craft: Plant, track: Track, speed: float) -> dict[str, Any]:
    """Return errors and times of both controllers along one course."""
    nu, w = model.steady(speed, 0.0)
    motion, _ = model.slopes(nu, w)
    # of sway and yaw together
    slowest = 1.0 / max(0.05, float(-np.linalg.eigvals(motion[1:, 1:]).real.max()))
    slowest = min(slowest, 20.0)
    limit = 3.0 * track.length / speed + 10.0 * slowest
    gains = tuned(model, track, speed, limit, slowest)
    craft.reset()
    by_pid = sailed(FeedForwardPID(model, track, speed, gains), craft, track, limit)
    rates = craft.rates(model)
    pilot = Predictive(model, track, speed, 0.2 * slowest, rates)
    by_mpc, taken = predicted(pilot, craft, track, limit)
    return {
        "course": round(track.length, 1),
        "speed": speed,
        "gains": gains._asdict(),
        "interval": pilot.interval,
        "pid": {"rms": rms(by_pid, track), "largest": float(np.abs(by_pid[:, 1]).max())},
        "mpc": {"rms": rms(by_mpc, track), "largest": float(np.abs(by_mpc[:, 1]).max())},
        "solutions": len(taken),
        "milliseconds": {
            "median": 1e3 * float(np.median(taken)),
            "99 %": 1e3 * float(np.quantile(taken, 0.99)),
            "largest": 1e3 * float(taken.max()),
        },
        "in_time": float(np.mean(taken <= pilot.interval)),
    }


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, help="the .casadi file")
    parser.add_argument("vessel", help="that the model was learned from: a name or a file")
    parser.add_argument("--waypoints", default=json.dumps(WAYPOINTS), help="[[north, east], ...]")
    parser.add_argument("--radius", type=float, help="of the corners in m")
    parser.add_argument("--speed", type=float, help="in m/s")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    model = Identified(given.model)
    speed = given.speed or 0.6 * float(model.high[0])
    # no turn takes more than half of the yaw rate that the model was trained at
    radius = given.radius or 2.0 * speed / float(min(model.high[2], -model.low[2]))
    track = Track(json.loads(given.waypoints), radius, easing=0.5 * radius)
    found = compared(model, Plant(given.vessel, model), track, speed)
    times = found["milliseconds"]
    print(f"course of {found['course']} m at {speed:.2f} m/s, corners of {radius:.1f} m")
    for name, words in (("pid", "PID with feed-forward"), ("mpc", "predictive control")):
        error = found[name]
        print(f"{words:24}RMS {error['rms']:.3f} m   largest {error['largest']:.3f} m")
    print(
        f"{found['solutions']} solutions, one each {found['interval']:.2f} s: median"
        f" {times['median']:.0f} ms, 99 % within {times['99 %']:.0f} ms, largest"
        f" {times['largest']:.0f} ms; {100 * found['in_time']:.1f} % within"
        f" {found['interval']:.2f} s"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
