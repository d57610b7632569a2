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

from residnet.autopilot.heading.set_points import (
    InstrumentedResponse,
    fit_with_set_points,
    is_direct_estimate_rejected,
)
from residnet.autopilot.heading.turning import (
    ManoeuvreRecord,
    NomotoModel,
    SteeringResponse,
    compute_response_residual,
    fit_response,
)
from residnet.autopilot.heading.wave_motion import WaveMotion, estimate_wave_motion
from residnet.autopilot.tasks.autopilot.config import REFERENCE_STEERING, minimum_turn_time
from residnet.core.config import (
    Config,
    MetresPerSecond,
    Radians,
    RadiansPerSecond,
    load_mapping,
    validate_config,
)
from residnet.core.errors import DataError, FitError, UsageError
from residnet.core.files import write_owned
from residnet.core.log import Log
from residnet.core.names import SET_POINT_CHANNELS
from residnet.core.ownership import require_replaceable
from residnet.core.progress import log_message
from residnet.io.drafting.log_files import find_log_files
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import read_drafted
from residnet.preprocessing.channel_values import estimate_noise_std
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.quality.feedback import InputFeedback, detect_feedback
from residnet.tasks.registry import open_finished_task

_RUDDER_CHANNELS = ("cmd_delta", "delta")
_MIN_SAMPLES = 50
"""Smallest number of usable samples for an identification of K and T."""
_MIN_RUDDER_STD = 1e-3
"""Smallest standard deviation of the rudder in rad for an identification."""


class IdentifiedSteering(NamedTuple):
    """Steering of a vessel, identified from logs.

    Attributes:
        response: K, T, delay and rudder rate, with the error of the simulated yaw rates.
        speed: mean surge velocity in m/s; NaN if it is in no log.
        noise: standard deviations of the white noise on the heading in rad and on the yaw rate in
            rad/s, at the step of the logs; NaN for a channel that is in no log.
        dt: median step of the logs in s.
        rudder: largest rudder angle in rad in the logs.
        waves: wave-frequency heading motion in the logs; None if there is none.
    """

    response: SteeringResponse
    speed: float
    noise: tuple[float, float]
    dt: float
    rudder: float
    waves: WaveMotion | None


def identify_steering(logs: Sequence[Log], longest_delay: float = 2.0) -> IdentifiedSteering:
    """Identify K, T and delay of a vessel from logs.

    Args:
        logs: logs with yaw rate `r` or heading `psi`, and the rudder; turns to both sides are best.
            The rudder command is preferred to the measured angle, since the identified delay must
            include the steering gear. With the set point of the heading `psi_d` in every log, K
            and T are also estimated with it as instrument. That estimate is used if a controller
            set the rudder, or if the two contradict each other.
        longest_delay: largest delay of the search, in s.

    Raises:
        DataError: if a log lacks the channels, the rudder is nearly constant, or a controller set
            it without independent excitation and without steps of a logged set point, so that K
            and T cannot be identified.
        FitError: if no response to the rudder is found.
    """
    if not logs:
        raise DataError("steering: no logs given")
    records_and_names = [_to_uniform_record(log) for log in logs]
    records = [record for record, _ in records_and_names]
    names = {name for _, name in records_and_names}
    max_rudder_std = max(float(np.std(record.rudder)) for record in records)
    if max_rudder_std < _MIN_RUDDER_STD:
        raise DataError(
            f"steering: the rudder of the logs varies by only {max_rudder_std:.2g} rad (rms);"
            " K and T need turns, such as a zigzag"
        )
    response = _fit_steering(logs, records, longest_delay, commands=names == {"cmd_delta"})
    logs_with_motion = [
        complete_motion(log, MotionConfig()) if {"x", "y", "psi"} <= log.channels.keys() else log
        for log in logs
    ]
    speeds = [log["u"][log.usable] for log in logs_with_motion if "u" in log.channels]
    speed = float(np.nanmean(np.concatenate(speeds))) if speeds else float("nan")
    residuals = [compute_response_residual(record, response) for record in records]
    return IdentifiedSteering(
        response,
        speed,
        (_estimate_noise(logs, "psi"), _estimate_noise(logs, "r")),
        float(np.median([record.dt for record in records])),
        max(float(np.abs(record.rudder).max()) for record in records),
        estimate_wave_motion(residuals, float(np.median([record.dt for record in records]))),
    )


def _fit_steering(
    logs: Sequence[Log],
    records: Sequence[ManoeuvreRecord],
    longest_delay: float,
    *,
    commands: bool,
) -> SteeringResponse:
    """Fit K, T and delay; in closed loop with the set point of the heading as instrument.

    Raises:
        DataError: if feedback explains the rudder beyond its effect on the yaw rate, and no set
            point identifies the response.
        FitError: if no response to the rudder is found.
    """
    feedback = _detect_rudder_feedback(logs, records)
    instrumented: InstrumentedResponse | None = None
    objection = "log a zigzag, 3-2-1-1 or steps of the course with the set point as psi_d"
    if all(SET_POINT_CHANNELS[0] in log.channels for log in logs):
        set_points = [
            _interpolate_heading(log, SET_POINT_CHANNELS[0], record)
            for log, record in zip(logs, records, strict=True)
        ]
        try:
            instrumented = fit_with_set_points(
                records, set_points, longest_delay, commands=commands
            )
        except FitError as error:
            objection = str(error).removeprefix("steering: ")
    if feedback is not None and instrumented is None:
        raise DataError(
            "steering: a controller set the rudder: feedback from the heading explains"
            f" {100 * feedback.share:.0f} % of the variance that the yaw rate does not explain, so"
            f" that K and T are not identifiable; {objection}, or give K and T, such as 0.12,18"
        )
    if instrumented is not None and feedback is not None:
        log_message(
            "steering: a controller set the rudder; K and T are estimated with the set point"
            " psi_d as instrument"
        )
        return instrumented.response
    direct = fit_response(records, longest_delay, commands=commands)
    if instrumented is None or not is_direct_estimate_rejected(direct, instrumented.response):
        return direct
    log_message(
        f"steering: K {direct.gain:.3g} 1/s and T {direct.time:.3g} s by simulation error"
        f" contradict K {instrumented.response.gain:.3g} 1/s and T {instrumented.response.time:.3g}"
        " s with the set point psi_d as instrument (Durbin-Wu-Hausman test): feedback biases the"
        " former, and the latter are used"
    )
    return instrumented.response


def _detect_rudder_feedback(
    logs: Sequence[Log], records: Sequence[ManoeuvreRecord]
) -> InputFeedback | None:
    """Return the feedback in a rudder that a controller set without steps or manoeuvres."""
    signals = []
    for log, record in zip(logs, records, strict=True):
        heading = np.cumsum(record.yaw_rate) * record.dt
        if "psi" in log.channels and np.isfinite(log["psi"]).sum() > _MIN_SAMPLES:
            heading = _interpolate_heading(log, "psi", record)
        signals.append({"psi": heading, "r": record.yaw_rate, "rudder": record.rudder})
    step = float(np.median([record.dt for record in records]))
    closed_loops = (
        feedback
        for feedback in detect_feedback(signals, ("rudder",), step)
        if feedback.is_closed_loop
    )
    return next(closed_loops, None)


def _interpolate_heading(log: Log, name: str, record: ManoeuvreRecord) -> np.ndarray:
    """Return a heading of a log, unwrapped, on the time grid of its record; 0 if it is unknown."""
    is_finite = np.isfinite(log[name])
    grid = log.t[0] + record.dt * np.arange(len(record.rudder))
    if not is_finite.any():
        return np.zeros(len(grid))
    return np.asarray(np.interp(grid, log.t[is_finite], np.unwrap(log[name][is_finite])))


def _estimate_noise(logs: Sequence[Log], name: str) -> float:
    """Return the standard deviation of a channel's white noise; NaN if it is in no log."""
    channel_values = [log[name][log.usable] for log in logs if name in log.channels]
    return estimate_noise_std(np.concatenate(channel_values)) if channel_values else float("nan")


def _to_uniform_record(log: Log) -> tuple[ManoeuvreRecord, str]:
    """Return a log resampled to its median step, and the name of its rudder channel."""
    name = next((name for name in _RUDDER_CHANNELS if name in log.channels), None)
    source = next((name for name in ("r", "psi") if name in log.channels), None)
    if name is None or source is None:
        raise DataError(
            f"log {log.name}: K and T need the rudder ({' or '.join(_RUDDER_CHANNELS)}) and the"
            f" yaw rate r or the heading psi; it has {', '.join(log.channels)}"
        )
    usable = log.usable & np.isfinite(log[source]) & np.isfinite(log[name])
    if int(usable.sum()) < _MIN_SAMPLES:
        raise DataError(
            f"log {log.name}: {int(usable.sum())} usable samples, {_MIN_SAMPLES} are needed"
        )
    dt = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1] + 0.5 * dt, dt)
    usable_times = log.t[usable]
    values = np.interp(grid, usable_times, log[source][usable])
    rate = values if source == "r" else np.gradient(values, dt)
    # a command is constant until the next one: zero-order hold instead of interpolation
    held_indices = np.clip(
        np.searchsorted(usable_times, grid + 1e-9 * dt, side="right") - 1, 0, None
    )
    nearest_indices = np.clip(np.searchsorted(log.t, grid - 0.5 * dt), 0, len(log.t) - 1)
    return ManoeuvreRecord(dt, log[name][usable][held_indices], rate, usable[nearest_indices]), name


_GAIN_TIME_PATTERN = re.compile(r"\s*([0-9.eE+-]+)\s*,?\s*([0-9.eE+-]*)\s*")
_DEFAULT_UNCERTAINTY = 0.2
"""Relative uncertainty of K and T that are given without one."""
_MIN_UNCERTAINTY = 0.1
"""Smallest relative uncertainty of identified K and T: K is proportional to speed and T inversely,
and few vessels keep their speed within a tenth in wind and turns.
"""
_DEFAULT_DELAY = (0.0, 0.4)
"""Range in s of an unknown delay of the electronics: from none to two cycles at 5 Hz."""
_DEFAULT_NOISE_DEG = 0.1
"""Noise in deg and deg/s of a magnetic compass and a MEMS gyro, if unknown."""
_DEFAULT_BIAS_DEG = 1.0
"""Typical rudder offset in deg; used unless the logs have a larger one."""
_DEFAULT_PUSH_DEG = 0.5
"""Typical standard deviation of the slow disturbance, as a rudder angle in deg."""
_DEFAULT_WAVES_DEG = 0.5
"""Wave-frequency heading motion in deg if the logs have none.

A law that was tuned in calm water moves the rudder with every wave: a policy that was trained
without waves cost 59 s in this motion, a PD law 44 s.
"""
_WAVE_PERIOD_FACTORS = (0.75, 1.35)
"""Range of peak periods relative to that of the logs."""
_TRAINING_SETTINGS = {"epochs": 12, "batch": 192, "quiet": 0.25}
"""Training of the policy, chosen on random vessels.

After six epochs one of ten policies oscillated and one overshot; after twelve the costs of these
two were 13 to 14 % below that of the best law, instead of 9 to 13 %. Of ten further policies one
still oscillated with a share of 0.1 of simulations without noise and disturbances (`quiet`), none
with 0.25.
"""
_REFERENCE_TIME_STEP = 0.02
"""Step in s of the vessel of Gouletas 2020, which `pace` multiplies."""


class SteeringDescription(NamedTuple):
    """Identified steering of a vessel with its uncertainty.

    Attributes:
        gain, time_constant: K in 1/s and T in s.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
        speed: speed in m/s at which K and T are valid.
        rudder: largest rudder angle in rad of the controllers.
        gain_range, time_range: ranges of K and T as multiples.
        delay: smallest and largest delay in s between a command and the steering gear.
        bias: largest effective rudder angle in rad with the rudder amidships.
        noise: standard deviations of heading and yaw rate in rad and rad/s, and their step in s;
            None if unknown.
        waves: wave-frequency heading motion; None if unknown.
        source: origin of these values, in words.
    """

    gain: float
    time_constant: float
    rate: float | None
    speed: float
    rudder: float
    gain_range: tuple[float, float]
    time_range: tuple[float, float]
    delay: tuple[float, float]
    bias: float
    noise: tuple[float, float, float] | None
    waves: WaveMotion | None
    source: str


class _UserSettings(Config):
    """Optional settings of the vessel in addition to logs or K and T."""

    rudder: Radians | None = Field(default=None, gt=0, lt=1.5)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)
    speed: MetresPerSecond | None = Field(default=None, gt=0)


def draft_autopilot_config(
    source: Sequence[str | Path],
    output_file: Path,
    *,
    rudder: str | None = None,
    rate: str | None = None,
    speed: str | None = None,
    classical: bool = False,
    overwrite: bool = False,
) -> Path:
    """Write the vessel file and the config of an autopilot; returns the config's path.

    Args:
        source: `K,T` in 1/s and s; logs; or the folder of a finished fit, whose logs are used.
        output_file: config to write; the vessel file is written to the same folder.
        rudder: rudder limit of the controllers with its unit; by default the largest angle in the
            logs, and 20 deg without logs.
        rate: rate of the steering gear with its unit; by default identified from the logs.
        speed: speed at which K and T are valid, with its unit; by default the mean of the logs.
        classical: whether the config has the tuned classical law alone, without a trained policy.
        overwrite: whether existing files are replaced.

    Raises:
        UsageError: if the source is neither, or an output file exists already.
        DataError: if logs lack the channels.
        FitError: if the logs have no response to the rudder.
    """
    vessel_file = output_file.with_name(f"{output_file.stem}_vessel.yaml")
    for file in (output_file, vessel_file):
        if file.exists() and not overwrite:
            raise UsageError(f"{file}: exists; give --overwrite, or another name by --out")
        require_replaceable(file)
    options = {"rudder": rudder, "rate": rate, "speed": speed}
    given_options = {key: value for key, value in options.items() if value is not None}
    user_settings = validate_config(given_options, _UserSettings, "residnet autopilot").model_dump(
        exclude_none=True
    )
    steering = _describe_steering(source)
    if math.isnan(user_settings.get("speed", steering.speed)):
        log_message(
            "  speed unknown: give --speed; without it u is in multiples of the usual speed"
        )
        user_settings["speed"] = 1.0
    steering = steering._replace(**user_settings)
    with write_owned(vessel_file) as file:
        file.write_text(
            f"# The steering of your vessel, from {steering.source}; written by `residnet"
            " autopilot`."
            "\n" + yaml.safe_dump(_build_vessel_file(steering, vessel_file.stem), sort_keys=False)
        )
    with write_owned(output_file) as file:
        # a copy through JSON: YAML would write shared dictionaries as anchors and aliases
        config = json.loads(
            json.dumps(
                _build_autopilot_config(steering, output_file, vessel_file, classical=classical)
            )
        )
        file.write_text(
            f"# An autopilot for your vessel, drafted from {steering.source} by `residnet"
            " autopilot`."
            "\n" + yaml.safe_dump(config, sort_keys=False)
        )
    return output_file


def _describe_steering(source: Sequence[str | Path]) -> SteeringDescription:
    """Return the steering of a vessel from K and T, logs or a finished fit."""
    gain_time_match = _GAIN_TIME_PATTERN.fullmatch(str(source[0])) if len(source) == 1 else None
    if gain_time_match and not Path(source[0]).exists():
        try:
            gain, time_constant = (float(number) for number in gain_time_match.groups())
        except ValueError:
            gain = time_constant = math.nan
        if not (gain > 0 and time_constant > 0):
            raise UsageError(
                f"{source[0]}: K in 1/s and T in s, both positive, for example 0.12,18"
            )
        relative_range = (1.0 - _DEFAULT_UNCERTAINTY, 1.0 + _DEFAULT_UNCERTAINTY)
        bias = math.radians(_DEFAULT_BIAS_DEG)
        return SteeringDescription(
            gain,
            time_constant,
            None,
            math.nan,
            math.radians(20.0),
            relative_range,
            relative_range,
            _DEFAULT_DELAY,
            bias,
            None,
            None,
            f"K = {gain:g} 1/s and T = {time_constant:g} s",
        )
    logs, name = _read_source_logs([Path(item) for item in source])
    identified = identify_steering(logs)
    response = identified.response
    dt = identified.dt
    log_message(
        f"  {name}: K = {response.gain:.4g} 1/s, T = {response.time:.4g} s, delay"
        f" {response.delay:.2g} s, rudder"
        f" {'at once' if response.rate is None else f'{math.degrees(response.rate):.3g} deg/s'};"
        f" {100 * response.explained_variance:.0f} % of the yaw rate explained"
    )

    def relative_interval(value: float, deviation: float) -> tuple[float, float]:
        # two standard deviations: a 95 % interval
        relative_error = min(max(2.0 * deviation / value, _MIN_UNCERTAINTY), 0.5)
        return round(1.0 - relative_error, 3), round(1.0 + relative_error, 3)

    gain, time_constant, delay_deviation = response.standard_errors
    # a command is logged up to one step after it was issued
    delay_margin = 2.0 * delay_deviation + 0.5 * dt
    noise = (
        None if math.isnan(identified.noise[1]) else (identified.noise[0], identified.noise[1], dt)
    )
    return SteeringDescription(
        response.gain,
        response.time,
        response.rate,
        identified.speed if identified.speed > 0 else math.nan,
        identified.rudder,
        relative_interval(response.gain, gain),
        relative_interval(response.time, time_constant),
        (
            round(max(response.delay - delay_margin, 0.0), 3),
            round(response.delay + delay_margin, 3),
        ),
        max(abs(response.bias), math.radians(_DEFAULT_BIAS_DEG)),
        noise,
        identified.waves,
        name,
    )


def _read_source_logs(paths: Sequence[Path]) -> tuple[list[Log], str]:
    """Return the logs of files, or the training and validation logs of a fit, and their name."""
    if len(paths) == 1 and (paths[0] / "resolved.yaml").is_file():
        task = load_mapping(paths[0] / "resolved.yaml").get("task")
        if task != "fit":
            raise UsageError(
                f"{paths[0]}: a run of task '{task}'; give the folder of a fit, or logs"
            )
        _, config = open_finished_task(paths[0], "evaluate")
        splits = config.logs()
        logs = [*splits["train"], *splits["validation"]]
        return logs, f"the logs of run {paths[0]}"
    draft_result = read_drafted(find_log_files(list(paths)), DraftNotes(None))
    logs = list(draft_result.logs.values())
    if not logs:
        raise DataError(f"{paths[0]}: no log can be used")
    return logs, f"{len(logs)} log{'' if len(logs) == 1 else 's'}, {paths[0]}"


def _build_vessel_file(steering: SteeringDescription, name: str) -> dict[str, Any]:
    """Return the content of the vessel's file."""

    def quantity(value: float, unit: str) -> dict[str, Any]:
        return {"value": float(f"{value:.5g}"), "unit": unit, "source": steering.source}

    steering_gear = (
        {} if steering.rate is None else {"rate": f"{math.degrees(steering.rate):.4g} deg/s"}
    )
    return {
        "kind": "nomoto",
        "name": name,
        "description": "Own vessel, Nomoto model of first order",
        # required by the format of vessel files; no controller uses it
        "length": {"value": 1.0, "unit": "m", "source": "not known, and not used for steering"},
        "speed": float(f"{steering.speed:.4g}"),
        "K": quantity(steering.gain, "1/s"),
        "T": quantity(steering.time_constant, "s"),
        "rudder": {"limit": f"{math.degrees(1.001 * steering.rudder):.4g} deg", **steering_gear},
    }


def _build_autopilot_config(
    steering: SteeringDescription, output_file: Path, vessel_file: Path, *, classical: bool
) -> dict[str, Any]:
    """Return the config of the task `autopilot` for a vessel with this steering response."""
    nomoto = NomotoModel(steering.gain, steering.time_constant, steering.speed)
    turn_time = minimum_turn_time(nomoto, steering.rudder, steering.rate)
    # rounded to two digits, for a readable config
    pace = float(f"{turn_time / minimum_turn_time(*REFERENCE_STEERING, None):.2g}")
    noise = (_DEFAULT_NOISE_DEG, _DEFAULT_NOISE_DEG)
    if steering.noise is not None:
        heading, rate, dt = steering.noise
        # white noise of equal spectral density: the variance is proportional to 1 / step
        scale = math.degrees(math.sqrt(dt / (_REFERENCE_TIME_STEP * pace)))
        noise = (_DEFAULT_NOISE_DEG if math.isnan(heading) else scale * heading, scale * rate)
    bias = min(math.degrees(steering.bias), 0.3 * math.degrees(steering.rudder))
    main_conditions = {
        "effect": list(steering.gain_range),
        "time": list(steering.time_range),
        "delay": [f"{delay:g} s" for delay in steering.delay],
        "bias": f"{bias:.3g} deg",
        "push": f"{min(_DEFAULT_PUSH_DEG, 0.1 * math.degrees(steering.rudder)):.3g} deg",
        "noise_psi": f"{noise[0]:.3g} deg",
        "noise_r": f"{noise[1]:.3g} deg/s",
        "waves": f"{_DEFAULT_WAVES_DEG:g} deg",
    }
    if steering.waves is not None:
        main_conditions["waves"] = f"{math.degrees(steering.waves.heading_std):.2g} deg"
        main_conditions["wave_period"] = [
            f"{factor * steering.waves.period:.3g} s" for factor in _WAVE_PERIOD_FACTORS
        ]
    lower, upper = steering.delay
    # at three quarters of the range, as in the configs of the repository
    lag_settings = {"lag": f"{lower + 0.75 * (upper - lower):.3g} s"} if upper > 0 else {}
    further_conditions = {
        "weak": {**main_conditions, "effect": [0.55, 0.55], "time": [1.6, 1.6]},
        "calm": {**main_conditions, "waves": "0 deg"},
        "bias": {
            **main_conditions,
            "bias": f"{min(2.0 * bias, 0.6 * math.degrees(steering.rudder)):.3g} deg",
        },
    }
    policies: dict[str, Any] = {"learned": {"start": "ptos", "training": _TRAINING_SETTINGS}}
    peers: dict[str, Any] = {
        "pd": {"kind": "pd"},
        "pid": {"kind": "pid"},
        "lqr": {"kind": "lqr_observer", **lag_settings},
        "ptos": {"kind": "ptos", **lag_settings},
    }
    if classical:
        policies = {"classical": {"start": "ptos", "units": 0, "training": None}}
        peers = {name: peers[name] for name in ("pd", "ptos")}
    return {
        "task": "autopilot",
        "name": output_file.stem,
        "description": f"Heading autopilot of a vessel from {steering.source}",
        # absolute, so that an export from any folder finds it
        "vessel": str(vessel_file.resolve()),
        "rudder": f"{math.degrees(steering.rudder):.4g} deg",
        "pace": pace,
        "test": {"heading": "30 deg", "dt": "0.02 s", "duration": "14 s", "plants": 100},
        "conditions": {"stated": main_conditions, "flights": 1000, "beyond": further_conditions},
        "policies": policies,
        "peers": peers,
    }
