"""`residnet autopilot`: the vessel file and the config of an autopilot, from logs or K and T."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from residnet.control.heading.turning import Record, SteeringResponse, Turning, fit_response
from residnet.core.config import (
    Config,
    MetresPerSecond,
    Radians,
    RadiansPerSecond,
    load_mapping,
    validate,
)
from residnet.core.errors import DataError, UsageError
from residnet.core.files import write_owned
from residnet.core.log import Log
from residnet.core.ownership import require_replaceable
from residnet.core.progress import say
from residnet.data.channels import noise_of
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.reading import log_files, read_drafted
from residnet.data.motion import MotionConfig, complete_motion
from residnet.tasks.autopilot import REFERENCE, least_time
from residnet.tasks.registry import finished_task

_RUDDERS = ("cmd_delta", "delta")
_SAMPLES = 50
"""Usable samples below which K and T are not looked for; chosen by hand."""
_LEAST_SPREAD = 1e-3
"""Least spread of the rudder in rad, rms."""


class IdentifiedSteering(NamedTuple):
    """What logs say about a vessel's steering.

    Attributes:
        response: K, T, delay and rudder rate, and how well they simulate the yaw rates.
        speed: mean surge velocity in m/s; NaN where no log has it.
        noise: standard deviations of the white noise on the heading in rad and on the yaw rate in
            rad/s, at the step of the logs; NaN where no log has the channel.
        dt: median step of the logs in s.
        rudder: largest angle in rad that the logs hold.
    """

    response: SteeringResponse
    speed: float
    noise: tuple[float, float]
    dt: float
    rudder: float


def identify_steering(logs: Sequence[Log], longest_delay: float = 2.0) -> IdentifiedSteering:
    """Return K, T and delay of the vessel that logs are of.

    Args:
        logs: with yaw rate `r` or heading `psi`, and the rudder; turns to both sides tell most. The
            rudder is the command where a log has it, since the delay of the steering gear counts,
            otherwise the measured angle.
        longest_delay: that is searched for, in s.

    Raises:
        DataError: where a log lacks the channels, or the rudder hardly moves.
        FitError: where no response to the rudder is found.
    """
    if not logs:
        raise DataError("steering: no logs given")
    found = [_record(log) for log in logs]
    records, names = [record for record, _ in found], {name for _, name in found}
    spread = max(float(np.std(record.rudder)) for record in records)
    if spread < _LEAST_SPREAD:
        raise DataError(
            f"steering: the rudder of the logs moves by {spread:.2g} rad (rms); K and T need turns,"
            " such as a zigzag"
        )
    moving = [
        complete_motion(log, MotionConfig()) if {"x", "y", "psi"} <= log.channels.keys() else log
        for log in logs
    ]
    speeds = [log["u"][log.usable] for log in moving if "u" in log.channels]
    speed = float(np.nanmean(np.concatenate(speeds))) if speeds else float("nan")
    return IdentifiedSteering(
        fit_response(records, longest_delay, commands=names == {"cmd_delta"}),
        speed,
        (_noise(logs, "psi"), _noise(logs, "r")),
        float(np.median([record.dt for record in records])),
        max(float(np.abs(record.rudder).max()) for record in records),
    )


def _noise(logs: Sequence[Log], name: str) -> float:
    """Return the standard deviation of a channel's white noise; NaN where no log has it."""
    found = [log[name][log.usable] for log in logs if name in log.channels]
    return noise_of(np.concatenate(found)) if found else float("nan")


def _record(log: Log) -> tuple[Record, str]:
    """Return a log on a uniform grid at its median step, and the rudder's channel."""
    name = next((name for name in _RUDDERS if name in log.channels), None)
    source = next((name for name in ("r", "psi") if name in log.channels), None)
    if name is None or source is None:
        raise DataError(
            f"log {log.name}: K and T need the rudder ({' or '.join(_RUDDERS)}) and the yaw rate r"
            f" or the heading psi; it has {', '.join(log.channels)}"
        )
    usable = log.usable & np.isfinite(log[source]) & np.isfinite(log[name])
    if int(usable.sum()) < _SAMPLES:
        raise DataError(
            f"log {log.name}: {int(usable.sum())} usable samples, {_SAMPLES} are needed"
        )
    dt = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1] + 0.5 * dt, dt)
    good = log.t[usable]
    values = np.interp(grid, good, log[source][usable])
    rate = values if source == "r" else np.gradient(values, dt)
    # a command stands until the next
    held = np.clip(np.searchsorted(good, grid + 1e-9 * dt, side="right") - 1, 0, None)
    near = np.clip(np.searchsorted(log.t, grid - 0.5 * dt), 0, len(log.t) - 1)
    return Record(dt, log[name][usable][held], rate, usable[near]), name


_PAIR = re.compile(r"\s*([0-9.eE+-]+)\s*,?\s*([0-9.eE+-]*)\s*")
_SPREAD = 0.2
"""Share by which K and T may be off where nobody has measured how far."""
_LEAST = 0.1
"""Least such share: K goes with the speed and T against it, and few vessels keep their speed within
a tenth in wind and turns.
"""
_DELAY = (0.0, 0.4)
"""Delay in s of electronics that nobody has measured, from at once to two cycles at 5 Hz."""
_NOISE = 0.1
"""Noise in deg and deg/s of a magnetic compass and a MEMS gyro, where no log shows it."""
_BIAS, _PUSH = 1.0, 0.5
"""Rudder offset and slow push in deg that are usual, where logs show no more."""
_TRAINING = {"epochs": 12, "batch": 192, "quiet": 0.25}
"""Of ten drawn vessels' policies one kept swinging after six epochs and one overshot too far; these
cost 13 to 14 % less than the best law after twelve, in place of 9 to 13 %. Of ten others one still
swung with a tenth of quiet flights, and not with a quarter.
"""
_STEP = 0.02
"""Step in s of the vessel of document 004, which `pace` multiplies."""


class OwnVessel(NamedTuple):
    """What is known of a vessel's steering, and how well.

    Attributes:
        gain, time: K in 1/s and T in s.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        speed: at which they hold, in m/s.
        rudder: largest angle in rad that controllers may use.
        effect, slow: ranges of K and T as multiples.
        delay: shortest and longest in s between a command and the steering gear.
        bias: rudder angle in rad that may be felt amidships.
        noise: of heading and yaw rate in rad and rad/s, and the step in s that it is of; None where
            nothing shows it.
        source: where all this is from.
    """

    gain: float
    time: float
    rate: float | None
    speed: float
    rudder: float
    effect: tuple[float, float]
    slow: tuple[float, float]
    delay: tuple[float, float]
    bias: float
    noise: tuple[float, float, float] | None
    source: str


class _Asked(Config):
    """What a user says of the vessel beside logs or K and T."""

    rudder: Radians | None = Field(default=None, gt=0, lt=1.5)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)
    speed: MetresPerSecond | None = Field(default=None, gt=0)


def draft_autopilot(
    source: Sequence[str | Path],
    out: Path,
    *,
    rudder: str | None = None,
    rate: str | None = None,
    speed: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the vessel file and the config of an autopilot; returns the config's path.

    Args:
        source: `K,T` in 1/s and s; logs; or the folder of a finished fit, whose logs are taken.
        out: the config; the vessel's file lies beside it.
        rudder: largest angle that controllers may use, with its unit; by default what the logs
            hold, and 20 deg without logs.
        rate: of the steering gear, with its unit; by default what the logs show.
        speed: at which K and T hold, with its unit; by default the mean of the logs.

    Raises:
        UsageError: where the source is neither, or a file stands there already.
        DataError: where logs lack the channels.
        FitError: where the logs show no answer to the rudder.
    """
    vessel_file = out.with_name(f"{out.stem}_vessel.yaml")
    for file in (out, vessel_file):
        if file.exists() and not overwrite:
            raise UsageError(f"{file}: exists; give --overwrite, or another name by --out")
        require_replaceable(file)
    told = {"rudder": rudder, "rate": rate, "speed": speed}
    given = {key: value for key, value in told.items() if value is not None}
    asked = validate(given, _Asked, "residnet autopilot").model_dump(exclude_none=True)
    vessel = _known(source)
    if math.isnan(asked.get("speed", vessel.speed)):
        say("  speed unknown: give --speed, or u is measured in multiples of the usual speed")
        asked["speed"] = 1.0
    vessel = vessel._replace(**asked)
    with write_owned(vessel_file) as file:
        file.write_text(
            f"# The steering of your vessel, from {vessel.source}; written by `residnet autopilot`."
            "\n" + yaml.safe_dump(_vessel(vessel, vessel_file.stem), sort_keys=False)
        )
    with write_owned(out) as file:
        # each of its own, so that no part is shared under a made-up name
        config = json.loads(json.dumps(_config(vessel, out, vessel_file)))
        file.write_text(
            f"# An autopilot for your vessel, drafted from {vessel.source} by `residnet autopilot`."
            "\n" + yaml.safe_dump(config, sort_keys=False)
        )
    return out


def _known(source: Sequence[str | Path]) -> OwnVessel:
    """Return what a source says of a vessel's steering."""
    pair = _PAIR.fullmatch(str(source[0])) if len(source) == 1 else None
    if pair and not Path(source[0]).exists():
        try:
            gain, time = (float(number) for number in pair.groups())
        except ValueError:
            gain = time = math.nan
        if not (gain > 0 and time > 0):
            raise UsageError(f"{source[0]}: K in 1/s and T in s, both positive, such as 0.12,18")
        spread = (1.0 - _SPREAD, 1.0 + _SPREAD)
        bias = math.radians(_BIAS)
        return OwnVessel(
            gain, time, None, math.nan, math.radians(20.0), spread, spread, _DELAY, bias, None,
            f"K = {gain:g} 1/s and T = {time:g} s as given",
        )  # fmt: skip
    logs, name = _logs([Path(one) for one in source])
    found = identify_steering(logs)
    response, dt = found.response, found.dt
    say(
        f"  {name}: K = {response.gain:.4g} 1/s, T = {response.time:.4g} s, delay"
        f" {response.delay:.2g} s, rudder"
        f" {'at once' if response.rate is None else f'{math.degrees(response.rate):.3g} deg/s'};"
        f" {100 * response.explained:.0f} % of the yaw rate explained"
    )

    def around(value: float, deviation: float) -> tuple[float, float]:
        # two standard deviations hold nineteen of twenty
        share = min(max(2.0 * deviation / value, _LEAST), 0.5)
        return round(1.0 - share, 3), round(1.0 + share, 3)

    gain, time, late = response.spread
    # a command is logged up to a step after it was given
    room = 2.0 * late + 0.5 * dt
    noise = None if math.isnan(found.noise[1]) else (found.noise[0], found.noise[1], dt)
    return OwnVessel(
        response.gain,
        response.time,
        response.rate,
        found.speed if found.speed > 0 else math.nan,
        found.rudder,
        around(response.gain, gain),
        around(response.time, time),
        (round(max(response.delay - room, 0.0), 3), round(response.delay + room, 3)),
        max(abs(response.bias), math.radians(_BIAS)),
        noise,
        name,
    )


def _logs(paths: Sequence[Path]) -> tuple[list[Log], str]:
    """Return the logs of files, or those that a finished fit has learned from, and their name."""
    if len(paths) == 1 and (paths[0] / "resolved.yaml").is_file():
        task = load_mapping(paths[0] / "resolved.yaml").get("task")
        if task != "fit":
            raise UsageError(f"{paths[0]}: a run of task '{task}'; give that of a fit, or logs")
        _, config = finished_task(paths[0], "evaluate")
        splits = config.logs()
        logs = [*splits["train"], *splits["validation"]]
        return logs, f"the logs of run {paths[0]}"
    read = read_drafted(log_files(list(paths)), Marks(None))
    logs = list(read.logs.values())
    if not logs:
        raise DataError(f"{paths[0]}: no log can be used")
    return logs, f"{len(logs)} log{'' if len(logs) == 1 else 's'}, {paths[0]}"


def _vessel(vessel: OwnVessel, name: str) -> dict[str, Any]:
    """Return the content of the vessel's file."""

    def quantity(value: float, unit: str) -> dict[str, Any]:
        return {"value": float(f"{value:.5g}"), "unit": unit, "source": vessel.source}

    gear = {} if vessel.rate is None else {"rate": f"{math.degrees(vessel.rate):.4g} deg/s"}
    return {
        "kind": "nomoto",
        "name": name,
        "description": "Own vessel, Nomoto model of first order",
        # no controller asks for it
        "length": {"value": 1.0, "unit": "m", "source": "not known, and not used for steering"},
        "speed": float(f"{vessel.speed:.4g}"),
        "K": quantity(vessel.gain, "1/s"),
        "T": quantity(vessel.time, "s"),
        "rudder": {"limit": f"{math.degrees(1.001 * vessel.rudder):.4g} deg", **gear},
    }


def _config(vessel: OwnVessel, out: Path, vessel_file: Path) -> dict[str, Any]:
    """Return the content of the config."""
    turning = Turning(vessel.gain, vessel.time, vessel.speed)
    pace = float(
        f"{least_time(turning, vessel.rudder, vessel.rate) / least_time(*REFERENCE, None):.2g}"
    )
    noise = (_NOISE, _NOISE)
    if vessel.noise is not None:
        heading, rate, dt = vessel.noise
        # the same spectrum at the controller's step
        scale = math.degrees(math.sqrt(dt / (_STEP * pace)))
        noise = (_NOISE if math.isnan(heading) else scale * heading, scale * rate)
    bias = min(math.degrees(vessel.bias), 0.3 * math.degrees(vessel.rudder))
    stated = {
        "effect": list(vessel.effect),
        "time": list(vessel.slow),
        "delay": [f"{delay:g} s" for delay in vessel.delay],
        "bias": f"{bias:.3g} deg",
        "push": f"{min(_PUSH, 0.1 * math.degrees(vessel.rudder)):.3g} deg",
        "noise_psi": f"{noise[0]:.3g} deg",
        "noise_r": f"{noise[1]:.3g} deg/s",
    }
    low, high = vessel.delay
    # three quarters up the range, as the configs that come with residnet have it
    lag = {"lag": f"{low + 0.75 * (high - low):.3g} s"} if high > 0 else {}
    beyond = {
        "weak": {**stated, "effect": [0.55, 0.55], "time": [1.6, 1.6]},
        "waves": {**stated, "waves": "0.5 deg"},
        "bias": {**stated, "bias": f"{min(2.0 * bias, 0.6 * math.degrees(vessel.rudder)):.3g} deg"},
    }
    return {
        "task": "autopilot",
        "name": out.stem,
        "description": f"Heading autopilot of a vessel from {vessel.source}",
        # found from wherever a run is exported
        "vessel": str(vessel_file.resolve()),
        "rudder": f"{math.degrees(vessel.rudder):.4g} deg",
        "pace": pace,
        "test": {"heading": "30 deg", "dt": "0.02 s", "duration": "14 s", "plants": 100},
        "conditions": {"stated": stated, "flights": 1000, "beyond": beyond},
        "policies": {"learned": {"start": "ptos", "training": _TRAINING}},
        "peers": {
            "pd": {"kind": "pd"},
            "pid": {"kind": "pid"},
            "lqr": {"kind": "lqr_observer", **lag},
            "ptos": {"kind": "ptos", **lag},
        },
    }
