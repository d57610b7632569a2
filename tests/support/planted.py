"""Logs with one planted fault each, and what the doctor may call it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.log import Log
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.quality.actuators import estimate_neutral_angle
from residnet.quality.statistics import LogStatistics

Random = np.random.Generator
Range = tuple[float, float]
_POSE = ("x", "y", "psi")
_MOTION = (*_POSE, "u", "v", "r")
KINDS = ("zigzag", "three_two_one_one", "random_steps", "turning_circle")


@dataclass(frozen=True)
class Ship:
    """A simulated vessel: how long its trials last, and how well its sensors measure."""

    name: str
    vessel: str
    duration: str
    step: str
    noise: dict[str, Any]
    lag: Range
    arm: Range
    bias: Range
    steer: tuple[str, ...] = ("delta", "cmd_delta")
    actual: str = "delta"
    demand: str = "cmd_delta"


def _noise(velocity: float, rate: str, place: float, heading: str) -> dict[str, Any]:
    sensors = {"x": {"noise": place}, "y": {"noise": place}, "psi": {"noise": heading}}
    return {"u": velocity, "v": velocity, "r": rate, "sensors": sensors}


_WAM_V = _noise(0.03, "0.2 deg/s", 0.05, "0.3 deg")
_PATROL = _noise(0.05, "0.1 deg/s", 0.1, "0.2 deg")
_MARINER = _noise(0.05, "0.05 deg/s", 0.2, "0.2 deg")
_FERRY = _noise(0.02, "0.2 deg/s", 0.02, "0.2 deg")
_SIDES = (("n_port",), "n_port", "cmd_port")
_FORCE = (("tau_n",), "acting_tau_n", "tau_n")
# fmt: off
SHIPS = (
    Ship("wam_v", "wam_v_cal", "120 s", "0.1 s", _WAM_V, (0.5, 1.5), (1.0, 2.5), (0.2, 0.5),
         *_SIDES),
    Ship("patrol", "patrol_p06", "300 s", "0.2 s", _PATROL, (0.8, 2.0), (3.0, 10.0), (0.1, 0.3)),
    Ship("mariner", "mariner", "900 s", "0.5 s", _MARINER, (3.0, 6.0), (20.0, 60.0), (0.06, 0.2)),
    Ship("ferry", "milliampere", "120 s", "0.1 s", _FERRY, (0.5, 1.5), (0.6, 2.0), (0.2, 0.5),
         *_FORCE),
)
# fmt: on


def clean(ship: Ship, seed: int, kinds: Sequence[str] = KINDS[:3]) -> list[Log]:
    """Logs of a vessel, one of each kind of manoeuvre."""
    trials: list[dict[str, Any]] = [{"kind": kind, "count": 1} for kind in KINDS if kind in kinds]
    for entry in trials:
        entry |= {"heading": ["20 deg"]} if entry["kind"] == "zigzag" else {}
    config = SimulatedTrials.model_validate(
        {
            **{"vessel": ship.vessel, "seed": seed, "duration": ship.duration, "step": ship.step},
            **{"noise": ship.noise, "trials": trials, "identification": {}, "validation": {}},
        }
    )
    return simulate_trial_logs(config.draw_manoeuvres(), config)


class Undecidable(Exception):
    """The host's channels cannot show the fault."""


Plant = Callable[[Ship, list[Log], Random], list[Log]]
Damage = Callable[[Ship, Log, Random], Log]


@dataclass(frozen=True)
class Fault:
    """`plant` damages the first of some logs, `codes` are the findings that name the fault.

    `ships` and `hosts` are the shipped vessels and further kinds of logs that can show it; a
    `harmless` one is told as a note where a fit would not notice it.
    """

    name: str
    codes: tuple[str, ...]
    plant: Plant
    ships: tuple[str, ...]
    hosts: tuple[str, ...]
    harmless: bool = False


FAULTS: list[Fault] = []
_ALL, _ANY = ("wam_v", "patrol", "mariner", "ferry"), ("boat", "twin", "tanker")
_RUDDER = ("boat", "tanker")


def fault(
    name: str,
    *codes: str,
    ships: tuple[str, ...] = _ALL,
    hosts: tuple[str, ...] = _ANY,
    harmless: bool = False,
) -> Callable[[Damage], Damage]:
    """Register what damages one log."""

    def register(damage: Damage) -> Damage:
        def plant(ship: Ship, logs: list[Log], random: Random) -> list[Log]:
            return [damage(ship, logs[0], random)]

        FAULTS.append(Fault(name, codes, plant, ships, hosts, harmless))
        return damage

    return register


def changed(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def at_rows(log: Log, keep: np.ndarray) -> Log:
    return log.replace(t=log.t[keep], channels={n: v[keep] for n, v in log.channels.items()})


def late(log: Log, lag: float, *names: str) -> Log:
    return changed(log, **{name: np.interp(log.t - lag, log.t, log[name]) for name in names})


def scaled(log: Log, names: Sequence[str], factor: float) -> Log:
    return changed(log, **{name: factor * log[name] for name in names if name in log.channels})


def driving(log: Log) -> list[str]:
    return [name for name in log.channels if name not in (*_MOTION, "phi", "p")]


def step_of(log: Log) -> float:
    return float(np.median(np.diff(log.t)))


def sign(random: Random) -> float:
    return float(random.choice([-1.0, 1.0]))


def stretch(log: Log, random: Random, low: float, high: float) -> np.ndarray:
    """[T] bool: a stretch of so large a share of the log, away from its ends."""
    count = int(random.uniform(low, high) * len(log))
    start = int(random.integers(len(log) // 5, int(0.9 * len(log)) - count))
    at = np.arange(len(log))
    return (at >= start) & (at < start + count)


def held(log: Log, names: Sequence[str], at: np.ndarray) -> Log:
    first = int(np.argmax(at))
    return changed(log, **{name: np.where(at, log[name][first], log[name]) for name in names})


# what each line damages, for all that one expression says
_LAGS = (
    *("lag", "lag_psi", "lag_xy"),
    *("acausal", "gain_v", "gain_u", "heading"),
)
_SIGNS = ("frames", "gain", "gain_v", "gain_u", "rudder_sign")
_PROPELLERS = ("n", "n_port", "n_stbd")
_KNOT = 1.0 / 0.5144
_SIMPLE: list[tuple[str, tuple[str, ...], Damage]] = [
    ("time gap", ("gaps",), lambda s, log, g: at_rows(log, ~stretch(log, g, 0.02, 0.1))),
    ("r in deg/s", ("gain",), lambda s, log, g: scaled(log, ["r"], 180.0 / np.pi)),
    (
        "psi in deg",
        ("frames", "gain", "heading_wrap"),
        lambda s, log, g: scaled(log, ["psi"], 180.0 / np.pi),
    ),
    (
        "u, v in knots",
        ("frames", "gain", "gain_u"),
        lambda s, log, g: scaled(log, ["u", "v"], _KNOT),
    ),
    (
        "u in knots",
        ("frames", "gain", "gain_u"),
        lambda s, log, g: scaled(log, ["u"], _KNOT),
    ),
    ("r reversed", _SIGNS, lambda s, log, g: scaled(log, ["r"], -1.0)),
    ("psi reversed", _SIGNS, lambda s, log, g: scaled(log, ["psi"], -1.0)),
    ("v reversed", _SIGNS, lambda s, log, g: scaled(log, ["v"], -1.0)),
    ("ENU heading", ("frames",), lambda s, log, g: changed(log, psi=np.pi / 2 - log["psi"])),
    ("x, y exchanged", ("frames",), lambda s, log, g: changed(log, x=log["y"], y=log["x"])),
    ("lag of u, v", _LAGS, lambda s, log, g: late(log, g.uniform(*s.lag), "u", "v")),
    ("lag of psi", _LAGS, lambda s, log, g: late(log, g.uniform(*s.lag), "psi")),
    ("lag of x, y", _LAGS, lambda s, log, g: late(log, g.uniform(*s.lag), "x", "y")),
    ("clock offset of u, v, r", _LAGS, lambda s, log, g: late(log, g.uniform(*s.lag), *"uvr")),
    ("inputs late", ("acausal",), lambda s, log, g: late(log, 2.0 * s.lag[1], *driving(log))),
    (
        "gyro bias",
        ("yaw_drift",),
        lambda s, log, g: changed(log, r=log["r"] + np.radians(g.uniform(*s.bias))),
    ),
    (
        "gyro drift",
        ("yaw_drift",),
        lambda s, log, g: changed(
            log, r=log["r"] + np.radians(2.0 * g.uniform(*s.bias)) * log.t / log.t[-1]
        ),
    ),
]
_HARMLESS = ("time gap", "lag of x, y", "lag of psi", "lag of u, v")
for _name, _codes, _damage in _SIMPLE:
    fault(_name, *_codes, harmless=_name in _HARMLESS)(_damage)

fault("rudder in deg", "unit", ships=("patrol", "mariner"), hosts=_RUDDER)(
    lambda s, log, g: scaled(log, ["delta"], 180.0 / np.pi)
)
fault("propeller in rpm", "unit", "contradicts_scale", ships=())(
    lambda s, log, g: scaled(log, _PROPELLERS, 60.0)
)
fault("propeller reversed", "propeller_sign", ships=())(
    lambda s, log, g: scaled(log, _PROPELLERS, -1.0)
)
fault("speed +10 %", "gain", "gain_u", "frames", ships=())(
    lambda s, log, g: scaled(log, ["u", "v"], 1.1)
)
fault("clock 9.5 % off", "gain", ships=())(
    lambda s, log, g: log.replace(t=log.t[0] + (log.t - log.t[0]) * 1.095)
)


@fault("repeated stamps", "duplicate_rows")
def _same_stamp(ship: Ship, log: Log, random: Random) -> Log:
    again = random.choice(len(log), 20, replace=False)
    return at_rows(log, np.sort(np.r_[np.arange(len(log)), again]))


@fault("repeated rows", "repeated_rows")
def _same_rows(ship: Ship, log: Log, random: Random) -> Log:
    twice = _same_stamp(ship, log, random)
    return twice.replace(t=step_of(log) * np.arange(len(twice)))


@fault("NaN stretch", "nan", harmless=True)
def _nan(ship: Ship, log: Log, random: Random) -> Log:
    name = str(random.choice(["x", "psi", "u", "v", "r", ship.steer[0]]))
    return changed(log, **{name: np.where(stretch(log, random, 0.03, 0.15), np.nan, log[name])})


@fault("outliers", "outliers", "spikes", harmless=True)
def _spiky(ship: Ship, log: Log, random: Random) -> Log:
    size = {"x": 3.0, "y": 3.0, "psi": 0.3, "u": 0.8, "v": 0.8, "r": 0.08}
    name = str(random.choice(list(size)))
    values = log[name].copy()
    count = max(len(log) // 200, 5)
    at = random.choice(np.arange(10, len(log) - 10), count, replace=False)
    values[at] += size[name] * random.choice([-1.0, 1.0], count) * random.uniform(1.0, 2.0, count)
    return changed(log, **{name: values})


@fault("frozen sensor", "frozen")
def _freeze(ship: Ship, log: Log, random: Random) -> Log:
    names = [["x", "y"], ["psi"], ["u"], ["v"], ["r"]][int(random.integers(5))]
    return held(log, names, stretch(log, random, 0.05, 0.15))


@fault("frozen GNSS", "frozen", ships=())
def _frozen_fix(ship: Ship, log: Log, random: Random) -> Log:
    at = stretch(log, random, 0.04, 0.12)
    return held(log, _POSE[:2] if random.random() < 0.5 else ("x", "y", "u", "v"), at)


@fault("clipping", "clipping", "frozen")
def _clip(ship: Ship, log: Log, random: Random) -> Log:
    name = str(random.choice(["u", "r", "v"]))
    limit = np.quantile(log[name], random.uniform(0.75, 0.95))
    return changed(log, **{name: np.minimum(log[name], limit)})


@fault("steering reversed", "rudder_sign")
def _steer_reversed(ship: Ship, log: Log, random: Random) -> Log:
    if "n_port" not in log.channels:
        return scaled(log, [n for n in driving(log) if "delta" in n or "tau_n" in n], -1.0)
    sides = (("n_port", "n_stbd"), ("cmd_port", "cmd_stbd"))
    pairs = [pair for pair in sides if pair[0] in log.channels]
    return changed(log, **{a: log[b] for a, b in pairs}, **{b: log[a] for a, b in pairs})


@fault("lag of r", "lag")
def _rate_late(ship: Ship, log: Log, random: Random) -> Log:
    """A late yaw rate; one that hardly changes hides its lag."""
    out = late(log, random.uniform(*ship.lag), "r")
    if float(np.std(out["r"] - log["r"])) < 0.1 * float(np.std(log["r"])):
        raise Undecidable
    return out


@fault("heading wrap", "heading_wrap")
def _wrapped(ship: Ship, log: Log, random: Random) -> Log:
    turn = np.pi - np.median(log["psi"])
    place = (log["x"] + 1j * log["y"]) * np.exp(1j * turn)
    psi = (log["psi"] + turn + np.pi) % (2.0 * np.pi) - np.pi
    return changed(log, psi=psi, x=place.real, y=place.imag)


@fault("lever arm", "lever_arm", "position_jump", "frames", harmless=True)
def _arm(ship: Ship, log: Log, random: Random) -> Log:
    ahead = random.uniform(*ship.arm) * sign(random)
    arm = (ahead + 1j * random.uniform(0.0, 0.3) * ship.arm[0]) * np.exp(1j * log["psi"])
    return changed(log, x=log["x"] + arm.real, y=log["y"] + arm.imag)


@fault("stuck actuator", "stuck", hosts=())
def _stuck(ship: Ship, log: Log, random: Random) -> Log:
    return held(log, [ship.actual], stretch(log, random, 0.3, 0.45))


@fault("dropped decimals", "resolution", "held")
def _decimals(ship: Ship, log: Log, random: Random) -> Log:
    name = str(random.choice(["u", "v", "r", "psi"]))
    span = float(np.quantile(log[name], 0.95) - np.quantile(log[name], 0.05))
    return changed(log, **{name: np.round(log[name], int(np.ceil(-np.log10(span / 3.0))))})


@fault("standing still", "standing", harmless=True)
def _resting(ship: Ship, log: Log, random: Random) -> Log:
    count = int(random.uniform(0.2, 0.4) * len(log))
    noise = {"x": 0.02, "y": 0.02, "psi": 0.003, "u": 0.03, "v": 0.03, "r": 0.0035}
    channels = {}
    for name, values in log.channels.items():
        rest = noise.get(name, 0.0) * random.standard_normal(count)
        channels[name] = np.append(rest + (values[0] if name in _POSE else 0.0), values)
    return log.replace(t=step_of(log) * np.arange(count + len(log)), channels=channels)


@fault("rudder bias 3 deg", "rudder_bias", ships=(), hosts=_RUDDER)
def _rudder_bias(ship: Ship, log: Log, random: Random) -> Log:
    neutral = estimate_neutral_angle(LogStatistics(log))
    if neutral is None or neutral.standard_error > np.radians(0.5):
        raise Undecidable
    bias = np.radians(random.uniform(3.0, 5.0)) * sign(random)
    return changed(log, delta=log["delta"] + bias)


@fault("15 s interpolated", "interpolated", ships=())
def _interpolated(ship: Ship, log: Log, random: Random) -> Log:
    count = max(round(15.0 / step_of(log)), 30)
    start = int(random.integers(len(log) // 5, len(log) - count - 10))
    at = np.arange(len(log))
    out = (at <= start) | (at >= start + count)
    return changed(log, **{n: np.interp(at, at[out], log[n][out]) for n in _MOTION})


def course(log: Log) -> np.ndarray:
    """Course over ground [T] from smoothed velocities and heading, continuous."""
    return np.asarray(log["psi"] + np.arctan2(log["v"], np.maximum(log["u"], 1e-3)))


_COURSE = ("course", "gain_v", "frames")
fault("course as heading", *_COURSE, ships=())(lambda s, log, g: changed(log, psi=course(log)))
fault("course swapped", *_COURSE, ships=())(
    lambda s, log, g: changed(log, psi=course(log), course=log["psi"])
)


@fault("rows repeat the fix", "repeated_rows", "held", "frozen", ships=())
def _repeated_fix(ship: Ship, log: Log, random: Random) -> Log:
    old = random.random(len(log)) < random.uniform(0.15, 0.4)
    old[0] = False
    last = np.maximum.accumulate(np.where(old, 0, np.arange(len(log))))
    names = _POSE[:2] if random.random() < 0.5 else _MOTION
    return changed(log, **{name: log[name][last] for name in names})


def _one_cell(name: str, value: Callable[[Random, float, float], float]) -> None:
    """Register a wrong cell; `value` makes it of what stands there and the channel's span."""

    @fault(name, "spikes", "outliers", "fill_values", "absurd", ships=())
    def damage(ship: Ship, log: Log, random: Random) -> Log:
        # a wind may come from anywhere at any moment
        names = [n for n in log.channels if float(np.ptp(log[n])) > 1e-6 and n != "wind_dir"]
        channel = str(random.choice(names))
        values = log[channel].copy()
        at = int(random.integers(20, len(log) - 20))
        low, high = np.nanquantile(values, (0.01, 0.99))
        values[at] = value(random, values[at], float(high - low))
        return changed(log, **{channel: values})


_FILLS = [-999.0, -9999.0, 9.96921e36, 1e20, -32768.0]
_one_cell("one spike", lambda g, here, span: here + span * g.uniform(2.0, 6.0) * sign(g))
_one_cell("fill value", lambda g, here, span: float(g.choice(_FILLS)))
_one_cell("absurd value", lambda g, here, span: 10.0 ** g.uniform(6, 30) * sign(g))


def _copied(ship: Ship, logs: list[Log], random: Random) -> list[Log]:
    start = len(logs[1]) // 3
    part = logs[1].select_rows(slice(start, start + int(random.uniform(0.2, 0.5) * len(logs[1]))))
    return [logs[0], logs[1], part.replace(name="cut", t=part.t - part.t[0])]


def _spliced(ship: Ship, logs: list[Log], random: Random) -> list[Log]:
    size = min(len(logs[0]), len(logs[1]))
    at = (np.arange(len(logs[0])) - size // 3) // (size // 4) == 0
    other = {n: np.resize(logs[1][n], len(logs[0])) for n in logs[0].channels}
    return [changed(logs[0], **{n: np.where(at, v, logs[0][n]) for n, v in other.items()}), logs[1]]


def _steady(ship: Ship, logs: list[Log], random: Random) -> list[Log]:
    noise = {"x": 0.03, "y": 0.03, "psi": 0.003, "u": 0.03, "v": 0.03, "r": np.radians(0.05)}
    out = []
    for log in logs:
        speed = float(np.nanmax(log["u"]))
        count = len(log)
        level = dict.fromkeys(_MOTION, 0.0) | {"x": speed * log.t, "u": speed}
        channels = {n: np.full(count, float(np.median(v))) for n, v in log.channels.items()}
        channels |= {n: level[n] + noise[n] * random.standard_normal(count) for n in _MOTION}
        out.append(log.replace(channels=channels))
    return out


_SPLICES = ("copied_part", "position_jump", "heading_jump", "jump")
FAULTS += [
    Fault("copied part", ("copied_part",), _copied, _ALL, _ANY),
    Fault("spliced part", _SPLICES, _spliced, _ALL, _ANY),
    Fault("no excitation", ("no_excitation",), _steady, _ALL, ()),
]
