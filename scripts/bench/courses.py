"""Plans of randomly drawn courses past buoys: which are right or refused, and flights along them.

    python scripts/bench/courses.py [--courses 100] [--seed 0] [--protocol sides|enter]
        [--vessel NAME] [--clearance 1] [--current 0] [--fly]

Each plan is judged by a check of its points alone (`faults`), which uses nothing of the planner;
clearances are radii of circles in turning radii. Plans keep a margin for a `--current` in m/s. With
`--fly` the nominal vessel flies a plan in calm water and in 0.3 m/s from a random direction.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import bench
import numpy as np
import torch
from numpy.typing import NDArray

from residnet.autopilot.courses.config import (
    BuoyConfig,
    BuoyCourseConfig,
    PlannedCourse,
    plan_course,
    smallest_turn,
)
from residnet.autopilot.guidance import CourseGuidance, DriftEstimate, TrackKeeping
from residnet.autopilot.heading.classical import HeadingPD
from residnet.autopilot.heading.controllers import ControlTask
from residnet.autopilot.heading.steering_variation import Vessels
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.tasks.course.execute import simulate_course
from residnet.core.errors import ResidnetError
from residnet.physics.vessel import load_vessel

Array = NDArray[np.float64]
RUDDER = math.radians(5.0)
BUOYS = (6, 10)
SPACING = (3.0, 12.0)
"""Fewest and most buoys, and their distances in turning radii."""


@dataclass(frozen=True)
class Drawn:
    """A course from the origin: buoys [N, 2] and radius in m, sides [N] (+1 to starboard)."""

    buoys: Array
    radius: float
    sides: Array


def draw(rng: np.random.Generator, unit: float, radius: float) -> Drawn:
    """Draw a course; the next buoy lies in any direction."""
    at = np.zeros(2)
    places = []
    for _ in range(int(rng.integers(BUOYS[0], BUOYS[1] + 1))):
        towards = rng.uniform(-math.pi, math.pi)
        far = rng.uniform(*(unit * one for one in SPACING))
        at = at + far * np.array([math.cos(towards), math.sin(towards)])
        places.append(at)
    return Drawn(np.array(places), radius, rng.choice([-1.0, 1.0], len(places)))


def passes(track: Array, buoys: Array) -> list[int]:
    """Return the sample at which each buoy is passed: nearest in sum, and in their order."""
    distance = np.hypot(*np.moveaxis(track[:, None] - buoys, -1, 0))
    least = distance[:, 0]
    chosen = []
    for i in range(1, len(buoys)):
        best = np.minimum.accumulate(least)
        first = np.maximum.accumulate(np.where(least <= best, np.arange(len(least)), 0))
        chosen.append(first)
        least = distance[:, i] + best
    at = [int(least.argmin())]
    for first in reversed(chosen):
        at.append(int(first[at[-1]]))
    return at[::-1]


def faults(track: Array, course: Drawn, protocol: str) -> list[str]:
    """Return what is wrong with a track [N, 2]: order, side of closest approach, clearance.

    The closest approach on the whole track counts, and the one in the buoy's turn. A circle in
    which the track begins counts from where the track, outside of it, comes nearer again.
    """
    found = []
    radius = course.radius
    turn = passes(track, course.buoys)
    for i, (place, side) in enumerate(zip(course.buoys, course.sides, strict=True)):
        distance = np.hypot(*(track - place).T)
        if protocol == "enter":
            if distance[turn[i]] > radius:
                found.append(f"buoy {i + 1} missed by {distance[turn[i]] - radius:.3g} m")
            continue
        left = 0
        if distance[0] < radius:
            away = np.flatnonzero(distance >= radius)
            left = int(away[0]) if len(away) else len(track) - 1
            while left < len(track) - 1 and distance[left + 1] >= distance[left]:
                left += 1
        if distance[left:].min() < radius:
            found.append(f"buoy {i + 1} cleared by {distance[left:].min() - radius:.3g} m")
        whole = left + int(distance[left:].argmin())
        for name, near in (("in its turn", turn[i]), ("on the whole course", whole)):
            step = track[min(near + 1, len(track) - 1)] - track[max(near - 1, 0)]
            away = place - track[near]
            if (step[0] * away[1] - step[1] * away[0]) * side <= 0:
                found.append(f"buoy {i + 1} on the wrong side {name}")
    return found


class Ship:
    """The vessel that courses are planned for, and how it is steered along them."""

    def __init__(self, vessel: str) -> None:
        self.vessel = SteeredPlant(load_vessel(vessel).build())
        self.turning = self.vessel.estimate_nomoto(RUDDER, 300.0, 0.1)
        scale = self.turning.speed / (self.turning.gain * RUDDER)
        self.dt = 0.05 * max(self.turning.time / 3.94, 1.0)
        self.lookahead = 1.1 * scale if scale < 50 else 0.5 * scale
        any_course = Drawn(np.array([[9.0, 0.0], [18.0, 0.0]]), 1.0, np.ones(2))
        config = self.config(any_course, 0.0)
        self.steady = smallest_turn(config, self.vessel, self.turning, RUDDER)

    def config(self, course: Drawn, current: float) -> BuoyCourseConfig:
        """Return the course as the package's config."""
        buoys = tuple(
            BuoyConfig(north=x, east=y, leave_to=side, radius=course.radius)
            for (x, y), side in zip(
                course.buoys.tolist(), np.where(course.sides > 0, "starboard", "port"), strict=True
            )
        )
        return BuoyCourseConfig(
            buoys=buoys,
            acceptance=course.radius,
            lookahead=self.lookahead,
            turning_time=25.0 * self.turning.time,
            current=current,
        )

    def tracks(self, planned: PlannedCourse, currents: np.ndarray) -> list[Any]:
        """Return the flights of the nominal vessel in steady currents [B, 2] in m/s."""
        turning = self.turning
        vessel = self.vessel
        law = HeadingPD.from_pole_placement(
            vessel.state,
            gain=turning.gain,
            time=turning.time,
            frequency=8.0 / turning.time,
            damping=1.0,
            limit=RUDDER,
        )
        steered = TrackKeeping(law, vessel.state, limit=RUDDER, dt=self.dt, rate=vessel.rate)
        guidance = CourseGuidance(
            planned.course,
            self.lookahead,
            vessel.state,
            DriftEstimate(self.lookahead, 0.25 * turning.speed, self.dt),
        )
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(currents), -1)
        return simulate_course(
            ControlTask(vessel, turning, RUDDER, self.dt),
            steered,
            guidance,
            planned,
            self.lookahead,
            3.0 * planned.course.length / turning.speed,
            Vessels(nominal, torch.from_numpy(currents)),
        )


def judge(args: argparse.Namespace, ship: Ship, number: int) -> dict[str, Any]:
    """Draw, plan, check and, where asked for, fly the course of one number."""
    rng = np.random.default_rng((args.seed, number))
    # a circle that is as tight as the vessel turns is not widened for a rounding error
    radius = 1.000001 * args.clearance * ship.steady.radius
    course = draw(rng, ship.steady.radius, radius)
    out: dict[str, Any] = {"number": number, "buoys": len(course.buoys)}
    config = ship.config(course, args.current)
    begun = time.process_time()
    try:
        planned = plan_course(config, args.protocol, ship.vessel, ship.turning, RUDDER, ship.steady)
    except ResidnetError as error:
        return {**out, "refused": str(error), "seconds": time.process_time() - begun}
    out["seconds"] = time.process_time() - begun
    track = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
    out["faults"] = faults(track, course, args.protocol)
    if args.fly:
        towards = rng.uniform(-math.pi, math.pi)
        stream = 0.3 * np.array([[0.0, 0.0], [math.cos(towards), math.sin(towards)]])
        for name, flight in zip(("calm", "current"), ship.tracks(planned, stream), strict=True):
            missed = faults(flight.track, course, args.protocol)
            out[name] = missed if flight.finished else [*missed, "not finished"]
    return out


def main() -> None:
    """Print a line for each course that is not right, and the totals."""
    args = bench.options(
        __doc__, courses=100, seed=0, protocol="sides", vessel="nomoto_oceanos",
        clearance=1.0, current=0.0, fly=False,
    )  # fmt: skip
    ship = Ship(args.vessel)
    rows = []
    print(f"{args.vessel}: R {ship.steady.radius:.4g} m, K {ship.turning.gain:.4g}/s", end="")
    print(f", T {ship.turning.time:.4g} s, {ship.turning.speed:.3g} m/s", flush=True)
    for number in range(args.courses):
        rows.append(judge(args, ship, number))
        row = rows[-1]
        if any(row.get(name) for name in ("refused", "faults", "calm", "current")):
            shown = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
            print("  ".join(f"{k} {v}" for k, v in shown.items()), flush=True)
    planned = [row for row in rows if "refused" not in row]
    right = sum(not row["faults"] for row in planned)
    print(f"{len(planned)} of {len(rows)} planned, {right} right")
    seconds = [row["seconds"] for row in rows]
    print(f"time: median {np.median(seconds):.2f} s, worst {max(seconds):.2f} s of one core")
    for name in ("calm", "current") if args.fly else ():
        right = sum(not row[name] for row in planned)
        print(f"{name}: {right} of {len(planned)} flown without a miss")


if __name__ == "__main__":
    main()
