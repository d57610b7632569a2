"""Simulated logs with one planted fault each, and what the doctor may call it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.log import Log
from residnet.data.simulated import SimulatedTrials, simulate


@dataclass(frozen=True)
class Ship:
    """A simulated vessel: how long its trials last, and how well its sensors measure."""

    name: str
    vessel: str
    duration: str
    step: str
    noise: dict[str, Any]
    lag: tuple[float, float]
    arm: tuple[float, float]
    bias: tuple[float, float]
    steer: tuple[str, ...]
    actual: str
    demand: str


def _noise(velocity: float, rate: str, place: float, heading: str) -> dict[str, Any]:
    return {
        "u": velocity,
        "v": velocity,
        "r": rate,
        "sensors": {"x": {"noise": place}, "y": {"noise": place}, "psi": {"noise": heading}},
    }


_RUDDER: dict[str, Any] = {
    "steer": ("delta", "cmd_delta"),
    "actual": "delta",
    "demand": "cmd_delta",
}
SHIPS = (
    Ship(
        "wam_v",
        "wam_v_cal",
        "120 s",
        "0.1 s",
        _noise(0.03, "0.2 deg/s", 0.05, "0.3 deg"),
        (0.5, 1.5),
        (1.0, 2.5),
        (0.2, 0.5),
        ("n_port",),
        "n_port",
        "cmd_port",
    ),
    Ship(
        "patrol",
        "patrol_p06",
        "300 s",
        "0.2 s",
        _noise(0.05, "0.1 deg/s", 0.1, "0.2 deg"),
        (0.8, 2.0),
        (3.0, 10.0),
        (0.1, 0.3),
        **_RUDDER,
    ),
    Ship(
        "mariner",
        "mariner",
        "900 s",
        "0.5 s",
        _noise(0.05, "0.05 deg/s", 0.2, "0.2 deg"),
        (3.0, 6.0),
        (20.0, 60.0),
        (0.06, 0.2),
        **_RUDDER,
    ),
    Ship(
        "ferry",
        "milliampere",
        "120 s",
        "0.1 s",
        _noise(0.02, "0.2 deg/s", 0.02, "0.2 deg"),
        (0.5, 1.5),
        (0.6, 2.0),
        (0.2, 0.5),
        ("tau_n",),
        "acting_tau_n",
        "tau_n",
    ),
)
_TRIALS = [
    {"kind": "zigzag", "count": 1, "heading": ["20 deg"]},
    {"kind": "three_two_one_one", "count": 1},
    {"kind": "random_steps", "count": 1},
    {"kind": "turning_circle", "count": 1},
]


def clean(
    ship: Ship, seed: int, kinds: Sequence[str] = ("zigzag", "three_two_one_one", "random_steps")
) -> list[Log]:
    """Logs of a vessel, one of each kind of manoeuvre."""
    trials = [entry for entry in _TRIALS if entry["kind"] in kinds]
    content = {
        "vessel": ship.vessel,
        "seed": seed,
        "duration": ship.duration,
        "step": ship.step,
        "noise": ship.noise,
        "trials": trials,
    }
    config = SimulatedTrials.model_validate({**content, "identification": {}, "validation": {}})
    return simulate(config.draw(), config)


def _with(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def _rows(log: Log, keep: np.ndarray, t: np.ndarray | None = None) -> Log:
    return log.replace(
        t=log.t[keep] if t is None else t,
        channels={name: values[keep] for name, values in log.channels.items()},
    )


def _late(log: Log, lag: float, *names: str) -> Log:
    return _with(log, **{name: np.interp(log.t - lag, log.t, log[name]) for name in names})


def _stretch(log: Log, random: np.random.Generator, low: float, high: float) -> slice:
    """A stretch of so many hundredths of the log, away from its ends."""
    count = int(random.uniform(low, high) * len(log))
    start = int(random.integers(len(log) // 5, int(0.9 * len(log)) - count))
    return slice(start, start + count)


Plant = Callable[[Ship, list[Log], np.random.Generator], list[Log]]


@dataclass(frozen=True)
class Fault:
    """A fault of `ships`: `plant` damages the first of some logs, `codes` are the findings that
    name it. `hosts` are further kinds of logs that it can be planted in.
    """

    name: str
    codes: tuple[str, ...]
    plant: Plant
    ships: tuple[str, ...] = tuple(ship.name for ship in SHIPS)
    hosts: tuple[str, ...] = ()


def _one(damage: Callable[[Ship, Log, np.random.Generator], Log]) -> Plant:
    return lambda ship, logs, random: [damage(ship, logs[0], random)]


def _gap(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    run = _stretch(log, random, 0.02, 0.1)
    return _rows(log, np.r_[0 : run.start, run.stop : len(log)])


def _jitter(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    step = float(np.median(np.diff(log.t)))
    return log.replace(t=log.t + random.uniform(-0.3, 0.3, len(log)) * step)


def _same_stamp(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    again = np.sort(np.r_[np.arange(len(log)), random.choice(len(log), 20, replace=False)])
    return _rows(log, again)


def _same_rows(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    again = np.sort(np.r_[np.arange(len(log)), random.choice(len(log), 20, replace=False)])
    return _rows(log, again, float(np.median(np.diff(log.t))) * np.arange(again.size))


def _nan(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    name = str(random.choice(["x", "psi", "u", "v", "r", ship.steer[0]]))
    values = log[name].copy()
    values[_stretch(log, random, 0.03, 0.15)] = np.nan
    return _with(log, **{name: values})


def _spiky(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    name = str(random.choice(["x", "y", "psi", "u", "v", "r"]))
    values = log[name].copy()
    at = random.choice(np.arange(10, len(log) - 10), max(len(log) // 200, 5), replace=False)
    size = {"x": 3.0, "y": 3.0, "psi": 0.3, "u": 0.8, "v": 0.8, "r": 0.08}[name]
    values[at] += size * random.choice([-1.0, 1.0], at.size) * random.uniform(1.0, 2.0, at.size)
    return _with(log, **{name: values})


def _freeze(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    names = [["x", "y"], ["psi"], ["u"], ["v"], ["r"]][int(random.integers(5))]
    run = _stretch(log, random, 0.05, 0.15)
    return _with(
        log,
        **{
            name: np.where(
                np.isin(np.arange(len(log)), np.arange(run.start, run.stop)),
                log[name][run.start],
                log[name],
            )
            for name in names
        },
    )


def _clip(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    name = str(random.choice(["u", "r", "v"]))
    return _with(
        log, **{name: np.minimum(log[name], np.quantile(log[name], random.uniform(0.75, 0.95)))}
    )


def _wrapped(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    away = log["psi"] + np.pi - np.median(log["psi"])
    turn = np.pi - np.median(log["psi"])
    c, s = np.cos(turn), np.sin(turn)
    return _with(
        log,
        psi=(away + np.pi) % (2.0 * np.pi) - np.pi,
        x=c * log["x"] - s * log["y"],
        y=s * log["x"] + c * log["y"],
    )


def _arm(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    ahead, side = (
        random.uniform(*ship.arm) * random.choice([-1.0, 1.0]),
        random.uniform(0.0, 0.3) * ship.arm[0],
    )
    c, s = np.cos(log["psi"]), np.sin(log["psi"])
    return _with(log, x=log["x"] + c * ahead - s * side, y=log["y"] + s * ahead + c * side)


def _stuck(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    run = _stretch(log, random, 0.3, 0.45)
    values = log[ship.actual].copy()
    values[run] = values[run.start]
    return _with(log, **{ship.actual: values})


def _decimals(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    name = str(random.choice(["u", "v", "r", "psi"]))
    span = float(np.quantile(log[name], 0.95) - np.quantile(log[name], 0.05))
    digits = int(np.ceil(-np.log10(span / 3.0)))
    return _with(log, **{name: np.round(log[name], digits)})


def _copied(ship: Ship, logs: list[Log], random: np.random.Generator) -> list[Log]:
    source, run = (
        logs[1],
        slice(len(logs[1]) // 3, len(logs[1]) // 3 + int(random.uniform(0.2, 0.5) * len(logs[1]))),
    )
    part = Log(
        "cut",
        source.t[run] - source.t[run.start],
        {name: values[run] for name, values in source.channels.items()},
        source.units,
    )
    return [logs[0], source, part]


def _spliced(ship: Ship, logs: list[Log], random: np.random.Generator) -> list[Log]:
    size = min(len(logs[0]), len(logs[1]))
    run = slice(size // 3, size // 3 + size // 4)
    channels = {name: values.copy() for name, values in logs[0].channels.items()}
    for name, values in channels.items():
        values[run] = logs[1][name][run]
    return [logs[0].replace(channels=channels), logs[1]]


def _resting(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    count = int(random.uniform(0.2, 0.4) * len(log))
    step = float(np.median(np.diff(log.t)))
    noise = {"x": 0.02, "y": 0.02, "psi": 0.003, "u": 0.03, "v": 0.03, "r": 0.0035}
    channels = {}
    for name, values in log.channels.items():
        level = values[0] if name in ("x", "y", "psi") else 0.0
        channels[name] = np.concatenate(
            (level + noise.get(name, 0.0) * random.standard_normal(count), values)
        )
    return log.replace(t=step * np.arange(count + len(log)), channels=channels)


def _steady(ship: Ship, log: Log, random: np.random.Generator) -> Log:
    speed = float(np.nanmax(log["u"]))
    count, t = len(log), log.t
    channels = {
        name: np.full(count, float(np.median(values))) for name, values in log.channels.items()
    }
    rate = np.radians(0.05)
    channels |= {
        "x": speed * t + 0.03 * random.standard_normal(count),
        "y": 0.03 * random.standard_normal(count),
    }
    channels |= {
        "psi": 0.003 * random.standard_normal(count),
        "u": speed + 0.03 * random.standard_normal(count),
    }
    channels |= {
        "v": 0.03 * random.standard_normal(count),
        "r": rate * random.standard_normal(count),
    }
    return log.replace(channels=channels)


_LAGS = (
    "lag",
    "lag_u",
    "lag_v",
    "lag_psi",
    "lag_xy",
    "follows_u",
    "follows_v",
    "follows_r",
    "acausal",
    "gain_v",
    "gain_u",
    "heading",
)
_SIGNS = ("frames", "follows_u", "follows_v", "follows_r", "gain_v", "gain_u", "rudder_sign")
FAULTS = (
    Fault("time gap", ("gaps",), _one(_gap)),
    Fault("jitter", ("clock",), _one(_jitter)),
    Fault("repeated stamps", ("duplicate_rows",), _one(_same_stamp)),
    Fault("repeated rows", ("repeated_rows",), _one(_same_rows)),
    Fault("NaN stretch", ("nan",), _one(_nan)),
    Fault("outliers", ("outliers", "spikes"), _one(_spiky)),
    Fault("frozen sensor", ("frozen",), _one(_freeze)),
    Fault("clipping", ("clipping", "frozen"), _one(_clip)),
    Fault(
        "r in deg/s",
        ("follows_r", "gain"),
        _one(lambda s, log, g: _with(log, r=np.degrees(log["r"]))),
    ),
    Fault(
        "psi in deg",
        ("follows_r", "frames", "gain", "heading_wrap"),
        _one(lambda s, log, g: _with(log, psi=np.degrees(log["psi"]))),
    ),
    Fault(
        "rudder in deg",
        ("unit",),
        _one(lambda s, log, g: _with(log, delta=np.degrees(log["delta"]))),
        ("patrol", "mariner"),
    ),
    Fault(
        "u, v in knots",
        ("frames", "gain", "gain_u"),
        _one(lambda s, log, g: _with(log, u=log["u"] / 0.5144, v=log["v"] / 0.5144)),
    ),
    Fault(
        "u in knots",
        ("frames", "gain", "gain_u", "follows_u"),
        _one(lambda s, log, g: _with(log, u=log["u"] / 0.5144)),
    ),
    Fault("r reversed", _SIGNS, _one(lambda s, log, g: _with(log, r=-log["r"]))),
    Fault("psi reversed", _SIGNS, _one(lambda s, log, g: _with(log, psi=-log["psi"]))),
    Fault("v reversed", _SIGNS, _one(lambda s, log, g: _with(log, v=-log["v"]))),
    Fault("steering reversed", ("rudder_sign",), lambda s, logs, g: [_steer_reversed(s, logs[0])]),
    Fault(
        "ENU heading", ("frames",), _one(lambda s, log, g: _with(log, psi=np.pi / 2.0 - log["psi"]))
    ),
    Fault(
        "x, y exchanged", ("frames",), _one(lambda s, log, g: _with(log, x=log["y"], y=log["x"]))
    ),
    Fault(
        "lag of r", ("lag", "follows_r"), _one(lambda s, log, g: _late(log, g.uniform(*s.lag), "r"))
    ),
    Fault("lag of u, v", _LAGS, _one(lambda s, log, g: _late(log, g.uniform(*s.lag), "u", "v"))),
    Fault("lag of psi", _LAGS, _one(lambda s, log, g: _late(log, g.uniform(*s.lag), "psi"))),
    Fault("lag of x, y", _LAGS, _one(lambda s, log, g: _late(log, g.uniform(*s.lag), "x", "y"))),
    Fault(
        "clock offset of u, v, r",
        _LAGS,
        _one(lambda s, log, g: _late(log, g.uniform(*s.lag), "u", "v", "r")),
    ),
    Fault(
        "inputs late",
        ("acausal",),
        _one(lambda s, log, g: _late(log, 2.0 * s.lag[1], *_driving(log))),
    ),
    Fault(
        "gyro bias",
        ("yaw_drift",),
        _one(lambda s, log, g: _with(log, r=log["r"] + np.radians(g.uniform(*s.bias)))),
    ),
    Fault(
        "gyro drift",
        ("yaw_drift",),
        _one(
            lambda s, log, g: _with(
                log, r=log["r"] + np.radians(2.0 * g.uniform(*s.bias)) * log.t / log.t[-1]
            )
        ),
    ),
    Fault("heading wrap", ("heading_wrap",), _one(_wrapped)),
    Fault("lever arm", ("lever_arm", "position_jump", "frames"), _one(_arm)),
    Fault("stuck actuator", ("stuck",), _one(_stuck)),
    Fault("dropped decimals", ("resolution", "held"), _one(_decimals)),
    Fault("copied part", ("copied_part",), _copied),
    Fault("spliced part", ("copied_part", "position_jump", "heading_jump", "jump"), _spliced),
    Fault("standing still", ("standing",), _one(_resting)),
    Fault(
        "no excitation",
        ("no_excitation",),
        lambda s, logs, g: [_steady(s, log, g) for log in logs],
    ),
)


def _driving(log: Log) -> list[str]:
    return [
        name for name in log.channels if name not in ("x", "y", "psi", "phi", "u", "v", "r", "p")
    ]


def _steer_reversed(ship: Ship, log: Log) -> Log:
    if "n_port" in log.channels:
        sides = (("n_port", "n_stbd"), ("cmd_port", "cmd_stbd"))
        pairs = [pair for pair in sides if pair[0] in log.channels]
        swapped = {a: log[b] for a, b in pairs} | {b: log[a] for a, b in pairs}
        return _with(log, **swapped)
    names = [name for name in _driving(log) if "delta" in name or "tau_n" in name]
    return _with(log, **{name: -log[name] for name in names})
