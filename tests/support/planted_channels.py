"""Planted faults of actuators, receivers and clocks, and what the doctor may call them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from planted import Fault, Plant, Ship, _late, _one, _stretch, _with

from residnet.core.log import Log
from residnet.data.doctor.actuators import neutral_angle
from residnet.data.doctor.effects import OneStep
from residnet.data.doctor.statistics import Record

HARMLESS = (
    *("time gap", "NaN stretch", "standing still"),
    *("outliers", "lever arm", "lag of x, y", "lag of psi", "lag of u, v"),
)
"""Faults that residnet handles by itself, or that a fit of velocities hardly sees.

Their level is measured; a note is enough.
"""


class Undecidable(Exception):
    """The host's channels cannot show the fault."""


_POSE = ("x", "y", "psi")
_MOTION = (*_POSE, "u", "v", "r")
_PROPELLERS = ("n", "n_port", "n_stbd")
_RUDDERS = ("delta",)


def anywhere(fault: Fault) -> Fault:
    """A fault of the shipped vessels, to be planted in other logs too where these can show it."""
    if fault.name == "lag of r":
        fault = dataclasses.replace(fault, plant=_one(_rate_late))
    needs = {"rudder in deg": ("boat", "tanker"), "stuck actuator": (), "no excitation": ()}
    hosts = needs.get(fault.name, ("boat", "twin", "tanker"))
    return dataclasses.replace(fault, hosts=hosts)


def propellers(log: Log) -> list[str]:
    """The channels of a log that hold revolutions."""
    return [name for name in _PROPELLERS if name in log.channels]


def rudders(log: Log) -> list[str]:
    """The channels of a log that hold a rudder's angle."""
    return [name for name in _RUDDERS if name in log.channels]


def _rate_late(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    """A late yaw rate; one that hardly changes hides its lag."""
    late = _late(log, random.uniform(*ship.lag), "r")
    if float(np.std(late["r"] - log["r"])) < 0.1 * float(np.std(log["r"])):
        raise Undecidable
    return late


def _scaled(log: Log, names: list[str], factor: float) -> Log:
    return _with(log, **{name: factor * log[name] for name in names})


def _rudder_bias(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    neutral = neutral_angle(Record(log))
    if neutral is None or neutral.error > np.radians(0.5):
        raise Undecidable
    bias = np.radians(random.uniform(3.0, 5.0)) * random.choice([-1.0, 1.0])
    return _with(log, delta=log["delta"] + bias)


def _rudder_clipped(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    limit = 0.6 * float(np.nanmax(np.abs(log["delta"])))
    # cut at its only angle a record shows a smaller rudder, and no fault
    hold = max(round(2.0 * ship.lag[0] / float(np.median(np.diff(log.t)))), 5)
    rests = np.abs(log["delta"][hold:] - log["delta"][:-hold]) < 0.02 * limit
    between = np.abs(log["delta"][hold:])
    if float((rests & (between > 0.15 * limit) & (between < 0.95 * limit)).mean()) < 0.1:
        raise Undecidable
    return _with(log, delta=np.clip(log["delta"], -limit, limit))


def _interpolated(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    step = float(np.median(np.diff(log.t)))
    count = max(round(15.0 / step), 30)
    start = int(random.integers(len(log) // 5, len(log) - count - 10))
    at = np.arange(len(log))
    inside = (at > start) & (at < start + count)
    return _with(
        log,
        **{
            name: np.where(inside, np.interp(at, at[~inside], log[name][~inside]), log[name])
            for name in _MOTION
        },
    )


def _frozen_fix(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    run = _stretch(log, random, 0.04, 0.12)
    names = _POSE[:2] if random.random() < 0.5 else ("x", "y", "u", "v")
    inside = np.zeros(len(log), dtype=bool)
    inside[run] = True
    return _with(log, **{name: np.where(inside, log[name][run.start], log[name]) for name in names})


def course(log: Log) -> np.ndarray:
    """Course over ground [T] from smoothed velocities and heading, continuous."""
    beta = np.arctan2(log["v"], np.maximum(log["u"], 1e-3))
    return np.asarray(log["psi"] + beta)


def _course_as_heading(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    return _with(log, psi=course(log))


def _swapped(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    return _with(log, psi=course(log), course=log["psi"])


_ORIGIN = np.radians([34.8, 135.5])
_RADIUS = 6_371_000.0


def with_fixes(log: Log) -> Log:
    """The log with the latitude and longitude of its positions."""
    latitude = _ORIGIN[0] + log["x"] / _RADIUS
    longitude = _ORIGIN[1] + log["y"] / (_RADIUS * np.cos(_ORIGIN[0]))
    out = _with(log, latitude=latitude, longitude=longitude)
    return out.replace(units={**out.units, "latitude": "rad", "longitude": "rad"})


def _positions_scaled(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    factor = random.uniform(1.05, 1.3) ** random.choice([-1.0, 1.0])
    # velocities scaled alike: only the fixes can tell
    return _scaled(with_fixes(log), ["x", "y", "u", "v"], factor)


def _repeated_fix(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    held = random.random(len(log)) < random.uniform(0.15, 0.4)
    held[0] = False
    last = np.maximum.accumulate(np.where(held, 0, np.arange(len(log))))
    names = _POSE[:2] if random.random() < 0.5 else _MOTION
    return _with(log, **{name: log[name][last] for name in names})


def _one_cell(size: str):
    def damage(ship: Ship, log: Log, random: np.random.Generator) -> Log:
        # a wind may come from anywhere at any moment
        names = [
            name for name in log.channels if float(np.ptp(log[name])) > 1e-6 and name != "wind_dir"
        ]
        name = str(random.choice(names))
        values = log[name].copy()
        at = int(random.integers(20, len(log) - 20))
        span = float(np.nanquantile(values, 0.99) - np.nanquantile(values, 0.01))
        values[at] = {
            "spike": values[at] + span * random.uniform(2.0, 6.0) * random.choice([-1.0, 1.0]),
            "fill": float(random.choice([-999.0, -9999.0, 9.96921e36, 1e20, -32768.0])),
            "absurd": 10.0 ** random.uniform(6, 30) * random.choice([-1.0, 1.0]),
        }[size]
        return _with(log, **{name: values})

    return _one(damage)


def _clock(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    return log.replace(t=log.t[0] + (log.t - log.t[0]) * 1.095)


def _inputs_late(names: Callable[[Log], list[str]]) -> Plant:
    """Late inputs, where a fit to the log would be the worse for it by a tenth at least."""

    def damage(ship: Ship, log: Log, random: np.random.Generator) -> Log:
        late = _late(log, ship.lag[0], *names(log))
        inputs = [name for name in log.channels if name not in _MOTION]
        before, after = (_left(OneStep(Record(one, inputs))) for one in (log, late))
        if float((after / before).max()) < 1.1:
            raise Undecidable
        return late

    return _one(damage)


def _left(rows: OneStep) -> np.ndarray:
    return rows.left(rows.fit())


_TIMING = ("acausal", "input_late", "input_early", "lag_n", "timing")
_ONE_VALUE = ("spikes", "outliers", "fill_values", "absurd")
_RUDDER_BOATS = ("boat", "tanker")
_PROPELLER_BOATS = ("boat", "twin", "tanker")
_ALL = ("boat", "twin", "tanker")
CHANNEL_FAULTS = (
    Fault(
        "propeller in rpm",
        ("unit", "unit_between"),
        _one(lambda s, log, g: _scaled(log, propellers(log), 60.0)),
        _PROPELLER_BOATS,
    ),
    Fault(
        "propeller reversed",
        ("propeller_sign",),
        _one(lambda s, log, g: _scaled(log, propellers(log), -1.0)),
        _PROPELLER_BOATS,
    ),
    Fault(
        "propeller late .7 s",
        _TIMING,
        _inputs_late(propellers),
        _PROPELLER_BOATS,
    ),
    Fault(
        "rudder late .7 s",
        _TIMING,
        _inputs_late(rudders),
        _RUDDER_BOATS,
    ),
    Fault("rudder bias 3 deg", ("rudder_bias",), _one(_rudder_bias), _RUDDER_BOATS),
    Fault("rudder clipped", ("clipping", "rudder_clipped"), _one(_rudder_clipped), _RUDDER_BOATS),
    Fault("15 s interpolated", ("interpolated",), _one(_interpolated), _ALL),
    Fault("frozen GNSS", ("frozen",), _one(_frozen_fix), _ALL),
    Fault(
        "speed +10 %",
        ("gain", "gain_u", "frames"),
        _one(lambda s, log, g: _scaled(log, ["u", "v"], 1.1)),
        _ALL,
    ),
    Fault(
        "course as heading",
        ("course_as_heading", "gain_v", "frames"),
        _one(_course_as_heading),
        _ALL,
    ),
    Fault("course swapped", ("course_as_heading", "gain_v", "frames"), _one(_swapped), _ALL),
    Fault("positions scaled", ("positions_scaled",), _one(_positions_scaled), _ALL),
    Fault("clock 9.5 % off", ("clock_rate", "gain"), _one(_clock), _ALL),
    Fault(
        "rows repeat the fix",
        ("repeated_fix", "repeated_rows", "held", "frozen"),
        _one(_repeated_fix),
        _ALL,
    ),
    Fault("one spike", _ONE_VALUE, _one_cell("spike"), _ALL),
    Fault("fill value", _ONE_VALUE, _one_cell("fill"), _ALL),
    Fault("absurd value", _ONE_VALUE, _one_cell("absurd"), _ALL),
)
