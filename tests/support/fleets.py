"""Fleets: many logs of one vessel, and contradictions planted among them.

Vessels are drawn at random (`random_vessels`) from 1 to 300 m, or shipped ones are sailed by
residnet's own simulator, for logs of another kind than those by which limits were found.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from planted import KINDS as MANOEUVRES
from planted import SHIPS, clean, driving
from random_vessels import (
    KINDS,
    FlightDraws,
    draw,
    draw_flight,
    log_of,
    simulate_flights,
    skip_log,
)

from residnet.core.log import Log

Random = np.random.Generator


@dataclass(frozen=True)
class Fleet:
    """Logs of one vessel, as many of a sister with other parameters, and what drives both."""

    name: str
    logs: list[Log]
    sisters: list[Log]
    inputs: tuple[str, ...]
    steering: str


@functools.cache
def drawn(kind: str, seed: int, count: int, fewest: int = 8, most: int = 20) -> list[Fleet]:
    """Return fleets of 8 to 20 logs of vessels drawn at random; `kind` is boat or twin.

    A simulation takes seconds: an equal call returns the same fleets, not to be changed.
    """
    random = np.random.default_rng([seed, KINDS.index(kind), 7])
    vessels = draw(random, count, shortest=1.0, longest=300.0)
    other = draw(random, count, shortest=1.0, longest=300.0)
    # the sister is nearly as long, and as fast for her length as she was drawn
    length = vessels.length * random.uniform(0.7, 1.4, count)
    speed = other.speed * np.sqrt(length / other.length)
    turns = other.revolutions * speed / length * other.length / other.speed
    other = dataclasses.replace(other, revolutions=turns, length=length, speed=speed)
    unit = vessels.length / vessels.speed
    step = np.array([0.05, 0.1, 0.2, 0.5, 1.0])
    step = step[np.argmin(np.abs(step[:, None] - unit / 15.0), axis=0)]
    sizes = random.integers(fewest, most + 1, count)
    both: list[list[list[Log]]] = [[[] for _ in range(count)] for _ in range(2)]
    # all random numbers are drawn first, so that all flights are simulated together
    flights: list[tuple[int, FlightDraws]] = []
    logs: list[tuple[int, int, int, Mapping[str, Any]]] = []
    for k in range(int(sizes.max())):
        for which in range(2):
            draws = draw_flight(count, int(random.integers(4)), random, 900)
            for i in np.flatnonzero(sizes > k).tolist():
                rows = int(random.integers(350, 900))
                logs.append((len(flights), i, rows, random.bit_generator.state))
                skip_log(rows, random)
            flights.append((which, draws))
    vessels_of_flights = [(vessels, other)[which] for which, _ in flights]
    motions = simulate_flights(vessels_of_flights, kind, step, [draws for _, draws in flights])
    for number, i, rows, state in logs:
        random.bit_generator.state = state
        part = {name: values[:rows] for name, values in motions[number].items()}
        log = log_of(vessels_of_flights[number], kind, part, step, i, number // 2, random)
        both[flights[number][0]][i].append(log)
    inputs = ("n_port", "n_stbd") if kind == "twin" else ("n", "delta")
    return [
        Fleet(f"{kind} {i}", logs, sisters, inputs, inputs[1])
        for i, (logs, sisters) in enumerate(zip(*both, strict=True))
    ]


def shipped(seed: int) -> list[Fleet]:
    """Return a fleet of 12 logs of each shipped vessel; none has a sister."""
    out = []
    for ship in SHIPS:
        logs = [
            log.replace(name=f"{log.name}_{k}")
            for k in range(3)
            for log in clean(ship, 100 * seed + k, MANOEUVRES)
        ]
        inputs = [name for name in driving(logs[0]) if not name.startswith(("cmd_", "acting_"))]
        steering = ship.actual if ship.actual in inputs else ship.steer[0]
        out.append(Fleet(f"{ship.name} {seed}", logs, [], tuple(inputs), steering))
    return out


def _with(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def _dead(fleet: Fleet, log: Log) -> Log:
    values = log[fleet.steering]
    return _with(log, **{fleet.steering: np.full(len(log), float(np.median(values)))})


def _in_current(log: Log, random: Random) -> Log:
    """Return the log over ground in a current of .3 of the usual speed."""
    speed = float(np.median(np.hypot(log["u"], log["v"])))
    current = 0.3 * speed * np.exp(1j * random.uniform(-np.pi, np.pi))
    ground = log["u"] + 1j * log["v"] + current * np.exp(-1j * log["psi"])
    place = log["x"] + 1j * log["y"] + current * (log.t - log.t[0])
    return _with(log, u=ground.real, v=ground.imag, x=place.real, y=place.imag)


def _turned(log: Log) -> Log:
    """Return the log with a compass and velocities that are off by 15 deg."""
    way = (log["u"] + 1j * log["v"]) * np.exp(-1j * np.radians(15.0))
    return _with(log, u=way.real, v=way.imag, psi=log["psi"] + np.radians(15.0))


def _exchanged(fleet: Fleet, log: Log) -> Log:
    port, stbd = fleet.inputs
    return _with(log, **{port: log[stbd], stbd: log[port]})


Planted = tuple[list[Log], tuple[int, ...], str]
"""Logs, the numbers of those concerned (none for all), and the right cause."""


def _in(
    change: Callable[[Fleet, Log, Random], Log], cause: str, share: float = 0.0
) -> Callable[..., Planted]:
    """Return what changes one log of a fleet, or a share of them."""

    def plant(fleet: Fleet, random: Random) -> Planted:
        logs = list(fleet.logs)
        count = max(1, round(share * len(fleet.logs)))
        concerned = random.choice(len(logs), count, replace=False).tolist()
        for i in concerned:
            logs[i] = change(fleet, logs[i], random)
        return logs, tuple(concerned), cause

    return plant


def _other_boats(fleet: Fleet, random: Random) -> Planted:
    return [*fleet.sisters[:-1], fleet.logs[-1]], (len(fleet.logs) - 1,), "vessel"


CONTRADICTIONS: dict[str, Callable[[Fleet, Random], Planted]] = {
    "dead steering in one": _in(lambda fleet, log, random: _dead(fleet, log), "dead"),
    "another boat in one": _in(lambda fleet, log, random: fleet.sisters[0], "vessel"),
    "another boat but the last": _other_boats,
    "current in one": _in(lambda fleet, log, random: _in_current(log, random), "current"),
    "dead steering in all": lambda fleet, random: (
        [_dead(fleet, log) for log in fleet.logs],
        (),
        "dead",
    ),
}
"""What is wrong -> how it is planted."""
_THIRD = 1.0 / 3.0
SHARED: dict[str, Callable[[Fleet, Random], Planted]] = {
    "reversed steering": _in(
        lambda fleet, log, random: _with(log, **{fleet.steering: -log[fleet.steering]}),
        "sign",
        _THIRD,
    ),
    "steering 1.8 times": _in(
        lambda fleet, log, random: _with(log, **{fleet.steering: 1.8 * log[fleet.steering]}),
        "scale",
        _THIRD,
    ),
    "heading off by 15 deg": _in(lambda fleet, log, random: _turned(log), "heading", _THIRD),
    "exchanged sides": _in(lambda fleet, log, random: _exchanged(fleet, log), "exchanged", _THIRD),
}
"""What is wrong in a third of the logs -> how it is planted."""
