"""Complete the motion of a log at every sample if velocities are missing or positions are sparse.

Position, heading and velocities are combined by a smoother that accounts for the lever arm of the
antenna and the delay of its positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from residnet.core.config import Config, Metres, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.frames import rotate, unwrap_angle
from residnet.core.layout import SIX_DOF_LAYOUT, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.log import Log, make_remark
from residnet.core.names import (
    BOW_WIND_CHANNELS,
    CHANNEL_UNITS,
    POSE_NAMES,
    STATE_NAMES,
    WIND_INPUTS,
)
from residnet.core.result_cache import cache_results
from residnet.preprocessing.channel_values import (
    estimate_noise_std,
    find_hampel_outliers,
    mask_held_values,
)

_MIN_DENSE_QUANTILE = 0.9
"""A channel is dense if this quantile of the intervals between its values is one sample."""
MAX_BRIDGED_INTERVALS = 3.0
"""Longest gap that is interpolated, in median intervals between the values of a channel."""
_JERK_LEVELS = 10.0 ** (0.5 * np.arange(-8, 5))
"""Candidate jerk intensities, in noise over the cube of the median position interval."""
_MAX_TUNING_SAMPLES = 4000
"""Largest number of samples for the estimate of the jerk intensity."""
_CACHE_BYTES = 50_000_000
"""Largest total size of the stored results of `smooth_track`."""
_PRODUCT_BLOCK = 1000
"""Number of samples whose transition matrices are computed at once."""


class Antenna(Config):
    """Lever arm of an antenna from the vessel's centre, in body axes.

    Attributes:
        x: distance forward of the centre in m.
        y: distance to starboard of the centre in m.
    """

    x: Metres = 0.0
    y: Metres = 0.0


class MotionConfig(Config):
    """Settings of the completion of states at every sample.

    A channel that is measured at every sample is not changed. A missing or sparse channel (for
    example a position at 1 Hz in a log at 10 Hz, with empty or repeated values in between) is
    estimated by a smoother from all other channels. Gaps in position or heading of more than three
    median intervals remain gaps.

    Attributes:
        antenna: lever arm of the antenna; null if x and y refer to the vessel's centre.
        delay: delay of the positions in s: x and y at t are the position at t - delay.
    """

    antenna: Antenna | None = None
    delay: Seconds = Field(default=0.0, ge=0.0)

    @property
    def has_position_offset(self) -> bool:
        """Whether positions must be corrected for a lever arm or a delay."""
        return self.delay > 0.0 or self.antenna is not None


def complete_motion(log: Log, config: MotionConfig, dof: DegreesOfFreedom = SURGE_SWAY_YAW) -> Log:
    """Return the log with all states of a model at every sample, measured or smoothed.

    Smoothed channels are listed in `meta["smoothed"]` and as a note in `meta["findings"]`. Relative
    wind is converted to true wind.

    Args:
        log: log in SI units.
        config: settings of the completion.
        dof: active velocities; the others are zero. With p the log needs the roll angle.

    Raises:
        UsageError: if the log lacks position or heading, or the roll angle of a model with roll.
        DataError: if these have too few values.
    """
    return add_true_wind(_complete_states(log, config, dof))


def _complete_states(log: Log, config: MotionConfig, dof: DegreesOfFreedom) -> Log:
    log = _complete_vertical_plane(log, dof) if dof.is_vertical_plane else log
    log = _complete_yaw_rate(log if dof.is_complete else _fill_zero_motion(log, dof))
    log = _complete_roll(log) if dof.has_roll and not dof.is_six_dof else log
    if dof.is_six_dof:
        log = _complete_six_dof(log)
        dense_states = [
            name for name in dof.state_names if name in log.channels and _is_dense(log[name])
        ]
        if missing_states := [
            name for name in dof.state_names if name not in (*STATE_NAMES, *dense_states)
        ]:
            raise UsageError(
                f"log {log.name}: {', '.join(missing_states)}"
                f" {'are' if len(missing_states) > 1 else 'is'} not measured at every sample, which"
                f" a model of {', '.join(dof.velocities)} needs; name the columns, or let it move"
                " on the surface only (signals.velocities: [u, v, r])"
            )
    log_without_held = mask_held_values(log)
    missing_channels = [name for name in STATE_NAMES if name not in log.channels]
    estimated_names = {
        name
        for name in STATE_NAMES
        if name in missing_channels or not _is_dense(log_without_held[name])
    }
    if not (estimated_names or config.has_position_offset):
        return log
    if missing_pose := [name for name in POSE_NAMES if name in missing_channels]:
        # a heading integrated from the yaw rate would not agree with measured positions
        if {"x", "y"} <= set(missing_channels) <= set(POSE_NAMES):
            return _integrate_pose(log, missing_pose)
        dof = DegreesOfFreedom.from_channels(log.channels)
        velocities_text = ", ".join(dof.velocities)
        velocities_text = (
            f", or use a model with {velocities_text} only (signals.velocities:"
            f" [{velocities_text}])"
        )
        raise UsageError(
            f"log {log.name}: no channel {', '.join(missing_channels)}; a model"
            " needs position and heading, or u, v and r without a position; name their columns"
            f"{'' if dof.is_complete else velocities_text}"
        )
    estimated_names |= set(POSE_NAMES) if config.has_position_offset else set()
    smoothed_names = [name for name in STATE_NAMES if name in estimated_names]
    smoothed_motion = _smooth_planar_motion(log_without_held, config)
    # the smoother estimates a missing sway velocity together with its derivative
    estimated_channels = [*smoothed_names, *(["v_dot"] if "v_dot" in smoothed_motion else [])]
    note = f"{', '.join(smoothed_names)} come from a smoother of the measured motion: "
    note += ", ".join(
        f"{name} {_describe_source(log_without_held, name)}" for name in smoothed_names
    )
    return _with_channels(
        log,
        {name: smoothed_motion[name] for name in estimated_channels},
        note,
        smoothed=estimated_channels,
    )


def _with_channels(
    log: Log,
    new_channels: Mapping[str, np.ndarray],
    finding_text: str = "",
    code: str = "smoothed_motion",
    **meta: Any,
) -> Log:
    """Return the log with computed channels, and with a note if there is a text."""
    if finding_text:
        finding = make_remark("note", code, finding_text, channels=len(new_channels))
        meta["findings"] = [*log.meta.get("findings", ()), finding]
    return log.replace(
        channels={**log.channels, **new_channels},
        units={**log.units, **{name: CHANNEL_UNITS[name] for name in new_channels}},
        meta={**log.meta, **meta},
    )


def add_true_wind(log: Log) -> Log:
    """Compute the true wind from a wind relative to the bow.

    `wind_angle` is the direction that the true wind comes from, clockwise from the bow.
    `apparent_wind_angle` and `apparent_wind_speed` are measured on the moving vessel. Without a
    heading, directions are relative to the initial heading.
    """
    has_apparent_wind = {"apparent_wind_angle", "apparent_wind_speed"} <= log.channels.keys()
    required_channels = ("u", "v") if has_apparent_wind else ("wind_angle", "wind_speed")
    heading_channel = "psi" if "psi" in log.channels else "r"
    if (
        "wind_dir" in log.channels
        or not {heading_channel, *required_channels} <= log.channels.keys()
    ):
        return log
    if not _is_dense(log[heading_channel]) or (
        has_apparent_wind and not all(_is_dense(log[name]) for name in required_channels)
    ):
        # called again after the smoother has completed the motion
        return log
    if has_apparent_wind:
        # the apparent wind is the true wind minus the velocity of the vessel
        complex_wind = log["apparent_wind_speed"] * np.exp(1j * log["apparent_wind_angle"])
        complex_wind = complex_wind - (log["u"] + 1j * log["v"])
        speed = np.abs(complex_wind)
        angle = np.angle(complex_wind)
    else:
        speed = log["wind_speed"]
        angle = log["wind_angle"]
    heading = log["psi"] if heading_channel == "psi" else _integrate_rate(log.t, log["r"])
    return _with_channels(log, {"wind_speed": speed, "wind_dir": unwrap_angle(heading + angle)})


def original_input_names(log: Log, inputs: Sequence[str]) -> list[str]:
    """Return the recorded channels of inputs, before the completion of the motion.

    The true wind is replaced by the channels of the relative wind if the log has only these.
    """
    missing_wind = {*WIND_INPUTS} & {*inputs} - {*log.channels}
    bow_wind_channels = [
        name for name in (*BOW_WIND_CHANNELS, *WIND_INPUTS) if missing_wind and name in log.channels
    ]
    return [
        *(name for name in inputs if not bow_wind_channels or name not in WIND_INPUTS),
        *bow_wind_channels,
    ]


def _fill_zero_motion(log: Log, dof: DegreesOfFreedom) -> Log:
    """Return the log with zeros for inactive velocities, and only the pose of the active ones.

    The heading is retained if the yaw rate is active, the position if also a linear velocity is.
    """
    retained_pose = {"psi"} if dof.has_heading else set[str]()
    if dof.has_heading and dof.has_position and log.channels.keys() >= {*POSE_NAMES}:
        retained_pose = {*POSE_NAMES}
    channels = {
        n: values for n, values in log.channels.items() if n not in {*POSE_NAMES} - retained_pose
    }
    channels |= dict.fromkeys(dof.fixed_states, np.zeros(len(log)))
    return log.replace(
        channels=channels,
        units={name: log.units.get(name, CHANNEL_UNITS.get(name, "-")) for name in channels},
    )


def _complete_yaw_rate(log: Log) -> Log:
    """Return a log without positions with the yaw rate derived from its heading."""
    if "psi" not in log.channels or {"x", "y"} & log.channels.keys():
        return log
    if "r" in log.channels and _is_dense(log["r"]):
        return log
    heading = unwrap_angle(log["psi"])
    is_finite = np.isfinite(heading)
    if is_finite.sum() < 5:
        return log
    yaw_rate = np.where(
        _is_within_bridged_interval(log.t, log.t[is_finite]),
        _smooth_angle(log, heading, "r")[1],
        np.nan,
    )
    log = log.replace(channels={**log.channels, "psi": heading})
    return _with_channels(
        log, {"r": yaw_rate}, "r comes from a smoother of the heading", smoothed=["r"]
    )


def _complete_roll(log: Log) -> Log:
    """Return a log with roll angle and roll rate at every sample, smoothed if necessary."""
    roll_angle = log.channels.get("phi", np.full(len(log), np.nan))
    is_finite = np.isfinite(roll_angle)
    if is_finite.sum() < 5:
        raise UsageError(
            f"log {log.name}: no roll angle phi, which signals.velocities with p need; name its"
            " column, or leave p out"
        )
    missing_channels = [n for n in ("phi", "p") if n not in log.channels or not _is_dense(log[n])]
    if not missing_channels:
        return log
    is_bridged = _is_within_bridged_interval(log.t, log.t[is_finite])
    smoothed_roll = dict(zip(("phi", "p"), _smooth_angle(log, roll_angle, "p"), strict=True))
    note = f"{', '.join(missing_channels)} come from a smoother of the roll: "
    note += ", ".join(f"{name} {_describe_source(log, name)}" for name in missing_channels)
    return _with_channels(
        log, {n: np.where(is_bridged, smoothed_roll[n], np.nan) for n in missing_channels}, note
    )


def _complete_six_dof(log: Log) -> Log:
    """Return a log of six degrees of freedom with missing velocities and angular rates derived.

    They follow from attitude and depth, and from the position if u or v was not measured.
    """
    missing_channels = [
        n for n in SIX_DOF_LAYOUT.velocities if n not in log.channels or not _is_dense(log[n])
    ]
    missing_linear = {"u", "v"} & {*missing_channels}
    required_channels = ("z", "phi", "theta", "psi", *(("x", "y") if missing_linear else ()))
    if not missing_channels or not all(
        n in log.channels and _is_dense(log[n]) for n in required_channels
    ):
        return log
    rates = {name: _smooth_angle(log, log[name], "")[1] for name in required_channels}
    phi = log["phi"]
    theta = log["theta"]
    # kinematics of the Euler angles: heading, then pitch, then roll
    pitch_rate = rates["theta"]
    projected_yaw_rate = rates["psi"] * np.cos(theta)
    derived = {
        "p": rates["phi"] - rates["psi"] * np.sin(theta),
        "q": pitch_rate * np.cos(phi) + projected_yaw_rate * np.sin(phi),
        "r": projected_yaw_rate * np.cos(phi) - pitch_rate * np.sin(phi),
    }
    if missing_linear:
        forward_velocity, lateral_velocity = rotate(rates["x"], rates["y"], -log["psi"])
        downward_velocity = forward_velocity * np.sin(theta) + rates["z"] * np.cos(theta)
        derived["u"] = forward_velocity * np.cos(theta) - rates["z"] * np.sin(theta)
        derived["v"] = lateral_velocity * np.cos(phi) + downward_velocity * np.sin(phi)
        derived["w"] = downward_velocity * np.cos(phi) - lateral_velocity * np.sin(phi)
    else:
        heave_numerator = (
            rates["z"] + log["u"] * np.sin(theta) - log["v"] * np.cos(theta) * np.sin(phi)
        )
        derived["w"] = heave_numerator / (np.cos(theta) * np.cos(phi))
    note = (
        f"{', '.join(missing_channels)} are not measured and follow from"
        f" {', '.join(required_channels)}"
    )
    return _with_channels(log, {name: derived[name] for name in missing_channels}, note)


def _complete_vertical_plane(log: Log, dof: DegreesOfFreedom) -> Log:
    """Return a log of a motion in the vertical plane with missing channels derived.

    Pitch and pitch rate follow from each other, heave and depth with the surge velocity. Sparse
    depth and pitch are smoothed.
    """
    dense_channels = {name: log[name] for name in log.channels if _is_dense(log[name])}
    derived: dict[str, np.ndarray] = {}
    zeros = np.zeros(len(log))
    smoothed_rates = {}
    for channel, rate_name in (("theta", "q"), ("z", "w")):
        is_finite = np.isfinite(log.channels.get(channel, np.array(np.nan)))
        if (
            rate_name not in dof.velocities
            or not is_finite.any()
            or {channel, rate_name} <= dense_channels.keys()
        ):
            continue
        smoothed, smoothed_rates[channel] = _smooth_angle(
            log, log[channel], rate_name if channel == "theta" else ""
        )
        if channel not in dense_channels:
            derived[channel] = np.where(
                _is_within_bridged_interval(log.t, log.t[is_finite]), smoothed, np.nan
            )
    if "theta" in smoothed_rates and "q" not in dense_channels:
        derived["q"] = smoothed_rates["theta"]
    elif "q" in dense_channels and "theta" not in {*dense_channels, *derived}:
        derived["theta"] = _integrate_rate(log.t, dense_channels["q"])
    theta = {**dense_channels, **derived}.get("theta", zeros) if "q" in dof.velocities else zeros
    forward_velocity = dense_channels.get("u", zeros) if "u" in dof.velocities else zeros
    if "z" in smoothed_rates and "w" not in dense_channels:
        derived["w"] = (smoothed_rates["z"] + forward_velocity * np.sin(theta)) / np.cos(theta)
    if "z" not in {*dense_channels, *derived}:
        heave_velocity = (
            {**dense_channels, **derived}.get("w", zeros) if "w" in dof.velocities else zeros
        )
        derived["z"] = _integrate_rate(
            log.t, heave_velocity * np.cos(theta) - forward_velocity * np.sin(theta)
        )
    if not derived:
        return log
    note = f"{', '.join(derived)} are not measured at every sample and follow from the motion"
    return _with_channels(log, derived, note)


def _smooth_angle(log: Log, angle: np.ndarray, rate_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Smooth an angle with its rate, if that is measured.

    Args:
        log: the log.
        angle: measured angle [T] in rad.
        rate_name: channel of the rate; it may be missing.

    Returns:
        Angle [T] in rad and rate [T] in rad/s.
    """
    angular_rate = log.channels.get(rate_name, np.full(angle.size, np.nan))
    noise_ratio = max(estimate_noise_std(angular_rate), 1e-7) / max(estimate_noise_std(angle), 1e-7)
    track = smooth_track(
        log.t, np.stack((angle, angular_rate), axis=1)[:, :, None], (1.0, noise_ratio)
    )
    return track[:, 0, 0], track[:, 1, 0]


def _integrate_rate(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the integral [T] of a rate [T] by the trapezoidal rule, 0 at the first sample."""
    dt = np.diff(t, prepend=t[:1])
    finite_rate = np.nan_to_num(rate)
    return np.asarray(
        np.cumsum(0.5 * dt * (finite_rate + np.concatenate((finite_rate[:1], finite_rate[:-1]))))
    )


def _integrate_pose(log: Log, missing_names: Sequence[str]) -> Log:
    """Return a log of velocities with the pose integrated from the origin.

    A model of velocities needs no measured pose. Errors of position and heading then refer to the
    integrated velocities.
    """
    integrated_pose = {
        "psi": (
            _integrate_rate(log.t, log["r"]) if "psi" in missing_names else np.asarray(log["psi"])
        )
    }
    heading = np.exp(1j * np.nan_to_num(integrated_pose["psi"]))
    forward_velocity = np.nan_to_num(log["u"])
    if {"w", "theta"} <= log.channels.keys():
        theta = np.nan_to_num(log["theta"])
        forward_velocity = forward_velocity * np.cos(theta) + np.nan_to_num(log["w"]) * np.sin(
            theta
        )
    earth_velocity = heading * (forward_velocity + 1j * np.nan_to_num(log["v"]))
    integrated_pose |= {
        "x": _integrate_rate(log.t, earth_velocity.real),
        "y": _integrate_rate(log.t, earth_velocity.imag),
    }
    new_channels = {name: integrated_pose[name] for name in missing_names}
    note = (
        f"{', '.join(missing_names)} were not measured and are integrated from the velocities:"
        " errors of position and heading are errors of the integrated velocities"
    )
    return _with_channels(
        log, new_channels, note, "integrated_pose", integrated=list(missing_names)
    )


def remove_pauses(t: np.ndarray) -> np.ndarray:
    """Return times [T] in s from zero, with pauses shortened to the longest interpolated gap."""
    time_steps = np.diff(t)
    return np.append(
        0.0, np.cumsum(np.minimum(time_steps, MAX_BRIDGED_INTERVALS * np.median(time_steps)))
    )


def fill_sparse(log: Log, channel_names: tuple[str, ...], held_channels: tuple[str, ...]) -> Log:
    """Return the log with sparse channels interpolated or held at every sample.

    Gaps of more than three median intervals between values remain gaps.

    Args:
        log: the log.
        channel_names: channels to fill.
        held_channels: channels that are held instead of interpolated.
    """
    filled_channels = {}
    for name in channel_names:
        values = log[name]
        is_finite = np.isfinite(values)
        if is_finite.all() or is_finite.sum() < 2:
            continue
        measurement_times = log.t[is_finite]
        if name in held_channels:
            previous_index = np.clip(
                np.searchsorted(measurement_times, log.t, side="right") - 1,
                0,
                measurement_times.size - 1,
            )
            filled_values = np.where(
                log.t >= measurement_times[0], values[is_finite][previous_index], np.nan
            )
        else:
            unwrapped_values = unwrap_angle(values) if log.units[name] == "rad" else values
            filled_values = np.interp(
                log.t, measurement_times, unwrapped_values[is_finite], left=np.nan, right=np.nan
            )
        filled_channels[name] = np.where(
            _is_within_bridged_interval(log.t, measurement_times), filled_values, np.nan
        )
    return log.replace(channels={**log.channels, **filled_channels}) if filled_channels else log


def _is_dense(values: np.ndarray) -> bool:
    """Return whether a channel has values at nearly all samples outside of gaps."""
    intervals = np.diff(np.flatnonzero(np.isfinite(values)))
    return bool(
        intervals.size
        and np.median(intervals) == 1
        and np.quantile(intervals, _MIN_DENSE_QUANTILE) == 1
    )


def _describe_source(log: Log, name: str) -> str:
    """Describe how often a channel was measured."""
    if name not in log.channels:
        return "was not measured"
    measurement_times = log.t[np.isfinite(log[name])]
    median_interval = (
        float(np.median(np.diff(measurement_times))) if measurement_times.size > 1 else float("inf")
    )
    return f"every {median_interval:.3g} s"


def _is_within_bridged_interval(t: np.ndarray, measurement_times: np.ndarray) -> np.ndarray:
    """Return [T] bool: samples between two measurements with a regular interval."""
    median_interval = float(np.median(np.diff(measurement_times)))
    is_inside = (t >= measurement_times[0] - 1e-9) & (t <= measurement_times[-1] + 1e-9)
    next_times = measurement_times[
        np.clip(np.searchsorted(measurement_times, t, side="left"), 0, measurement_times.size - 1)
    ]
    previous_times = measurement_times[
        np.clip(
            np.searchsorted(measurement_times, t, side="right") - 1, 0, measurement_times.size - 1
        )
    ]
    return np.asarray(
        is_inside
        & (next_times - previous_times <= MAX_BRIDGED_INTERVALS * median_interval * (1.0 + 1e-6))
    )


def _smooth_planar_motion(log: Log, config: MotionConfig) -> dict[str, np.ndarray]:
    """Smooth the planar motion; NaN in gaps of position or heading.

    Without sway, but with surge, the motion is reconstructed in body axes with the derivative v_dot
    of the sway velocity.
    """
    t = log.t
    psi = unwrap_angle(log["psi"])
    positions = np.stack((log["x"], log["y"]), axis=1)
    is_heading_outlier, *is_position_outlier = find_hampel_outliers([psi, log["x"], log["y"]])
    psi[is_heading_outlier] = np.nan
    positions[np.logical_or(*is_position_outlier)] = np.nan
    fix_indices = np.flatnonzero(np.isfinite(positions).all(axis=1))
    heading_indices = np.flatnonzero(np.isfinite(psi))
    if min(fix_indices.size, heading_indices.size) < 5:
        raise DataError(
            f"log {log.name}: {fix_indices.size} positions and {heading_indices.size} headings, at"
            " least 5 of each are needed to estimate the motion; exclude the log"
        )
    u, v = (log.channels.get(name, np.full(t.size, np.nan)) for name in ("u", "v"))
    # delayed positions belong to times between the samples
    fix_times = t[fix_indices] - config.delay
    is_observed = _is_within_bridged_interval(t, fix_times) & _is_within_bridged_interval(
        t, t[heading_indices]
    )
    antenna = config.antenna or Antenna()
    if "v" not in log.channels and "u" in log.channels:
        # scipy is imported only if a log needs it
        from residnet.preprocessing.compatibility.sway import reconstruct_without_sway

        fix_headings = np.interp(fix_times, t[heading_indices], psi[heading_indices])
        lever_arm = np.stack(rotate(antenna.x, antenna.y, fix_headings), axis=1)
        motion = reconstruct_without_sway(
            t, fix_times, positions[fix_indices] - lever_arm, psi, log["u"], log.channels.get("r")
        )
        if motion is not None:
            return {name: np.where(is_observed, values, np.nan) for name, values in motion.items()}
    heading, yaw_rate = _smooth_angle(log, psi, "r")
    filter_times = np.union1d(t, fix_times) if config.delay else t
    sample_indices = np.searchsorted(filter_times, t)
    filter_headings = np.interp(filter_times, t, heading)
    measurements = np.full((filter_times.size, 2, 2), np.nan)
    measurements[np.searchsorted(filter_times, fix_times), 0] = positions[fix_indices]
    measurements[:, 0] -= np.stack(rotate(antenna.x, antenna.y, filter_headings), axis=1)
    noise_ratio = 1.0
    if "u" in log.channels and "v" in log.channels:
        measurements[sample_indices, 1] = np.stack(
            rotate(u, v, filter_headings[sample_indices]), axis=1
        )
        fix_positions = measurements[np.isfinite(measurements[:, 0]).all(axis=1), 0]
        position_noise = max(
            estimate_noise_std(fix_positions[:, 0]), estimate_noise_std(fix_positions[:, 1])
        )
        noise_ratio = max(estimate_noise_std(u), estimate_noise_std(v), 1e-6) / max(
            position_noise, 1e-6
        )
    track = smooth_track(filter_times, measurements, (1.0, noise_ratio))[sample_indices]
    u, v = rotate(track[:, 1, 0], track[:, 1, 1], -heading)
    channels_and_values = zip(
        STATE_NAMES, (track[:, 0, 0], track[:, 0, 1], heading, u, v, yaw_rate), strict=True
    )
    return {name: np.where(is_observed, values, np.nan) for name, values in channels_and_values}


def smooth_measured_motion(
    measurements: np.ndarray, noise: Sequence[float], dt: float
) -> np.ndarray:
    """Smooth measured x, y, psi, u, v, r, u_dot, v_dot, r_dot [N, 9] in SI units.

    Heading and its derivatives are smoothed first, then north and east with the smoothed heading.

    Args:
        measurements: measured, the heading unwrapped; a quantity without a measurement has an
            infinite noise.
        noise: standard deviations of the nine.
        dt: sampling interval in s.
    """
    if not np.isfinite(measurements).all():
        sample_index, column = (
            int(index_array[0]) for index_array in np.nonzero(~np.isfinite(measurements))
        )
        raise DataError(
            f"measured motion: column {column} is not finite at sample {sample_index}; mask or fill"
            " the gap first"
        )
    t = dt * np.arange(len(measurements))
    noise_std = np.asarray(noise)
    x, y, psi, u, v, r, surge_acceleration, sway_acceleration, yaw_acceleration = measurements.T
    yaw_measurements = np.stack((psi, r, yaw_acceleration), axis=1)[:, :, None]
    psi, r, yaw_acceleration = smooth_track(t, yaw_measurements, noise_std[[2, 5, 8]])[:, :, 0].T
    earth_rates = (
        rotate(u, v, psi),
        rotate(surge_acceleration - r * v, sway_acceleration + r * u, psi),
    )
    earth_measurements = np.moveaxis(np.array(((x, y), *earth_rates)), 2, 0)
    tracks = [
        smooth_track(
            t,
            earth_measurements[:, :, [axis_index]],
            noise_std[[axis_index, 3 + axis_index, 6 + axis_index]],
        )[:, :, 0]
        for axis_index in (0, 1)
    ]
    (x, north, north_dot), (y, east, east_dot) = (track.T for track in tracks)
    u, v = rotate(north, east, -psi)
    surge_acceleration, sway_acceleration = rotate(north_dot, east_dot, -psi)
    return np.stack(
        (
            x,
            y,
            psi,
            u,
            v,
            r,
            surge_acceleration + r * v,
            sway_acceleration - r * u,
            yaw_acceleration,
        ),
        axis=1,
    )


@cache_results(_CACHE_BYTES)
def smooth_track(t: np.ndarray, measurements: np.ndarray, noise_std: ArrayLike) -> np.ndarray:
    """Smooth position, rate and acceleration along one or more axes by a Kalman smoother.

    The model is a triple integrator driven by white jerk. The Rauch-Tung-Striebel smoother (1965)
    has no lag. Jerk intensity and noise level are maximum-likelihood estimates.

    Args:
        t: times [T] in s, increasing.
        measurements: measured positions, then rates, then accelerations as far as there are any,
            [T, k, A]; NaN for missing measurements.
        noise_std: standard deviations [k], of which ratios count; infinite where nothing is
            measured.
    """
    noise_std = np.maximum(np.asarray(noise_std, dtype=np.float64), 1e-9)
    measurements = np.where(np.isfinite(noise_std)[None, :, None], measurements, np.nan)
    is_measured = np.isfinite(measurements).all(axis=2)
    first_derivative_order = int(np.argmax(is_measured.any(axis=0)))
    measurement_times = t[is_measured[:, first_derivative_order]]
    median_interval = (
        float(np.median(np.diff(measurement_times))) if measurement_times.size > 1 else 1.0
    )
    jerk_intensities = (
        _JERK_LEVELS
        * float(noise_std[first_derivative_order])
        / median_interval ** (3 - first_derivative_order)
    )
    tuning_slice = slice(0, min(t.size, _MAX_TUNING_SAMPLES))
    cost, _ = _filter_track(
        t[tuning_slice], measurements[tuning_slice], noise_std, jerk_intensities
    )
    best_index = int(np.argmin(cost))
    _, ((predicted_states, predicted_covariances), (smoothed_states, filtered_covariances)) = (
        _filter_track(t, measurements, noise_std, jerk_intensities[best_index : best_index + 1])
    )
    transitions = _transition_matrices(np.diff(t, prepend=t[0]))
    gains = (
        filtered_covariances[:-1]
        @ transitions[1:].transpose(0, 2, 1)
        @ np.linalg.pinv(predicted_covariances[1:])
    )
    for k in range(len(t) - 2, -1, -1):
        smoothed_states[k] += gains[k].dot(smoothed_states[k + 1] - predicted_states[k + 1])
    return smoothed_states


_StatesAndCovariances = tuple[np.ndarray, np.ndarray]


def _filter_track(
    t: np.ndarray, measurements: np.ndarray, noise: np.ndarray, jerk_intensities: np.ndarray
) -> tuple[np.ndarray, tuple[_StatesAndCovariances, _StatesAndCovariances]]:
    """Run a Kalman filter for several jerk intensities.

    Returns:
        Minus twice the log-likelihood of each intensity [K], and predicted and filtered states
        [T, 3, A] and covariances [T, 3, 3] of the first intensity.
    """
    n_samples = t.size
    n_levels = jerk_intensities.size
    n_axes = measurements.shape[2]
    width = 3 + n_axes
    dt = np.diff(t, prepend=t[0])
    is_measured = np.isfinite(measurements).all(axis=2)
    first_derivative_order = int(np.argmax(is_measured.any(axis=0)))
    # A step of this loop costs as much as its calls of NumPy. The covariance and the states of all
    # intensities are therefore one array [3, 3 + A, K], predicted by one product.
    transitions = _transition_matrices(dt)
    column_transitions = np.tile(np.eye(width), (n_samples, 1, 1))
    column_transitions[:, :3, :3] = transitions
    process_covariances = np.zeros((n_samples, 3, width, 1))
    process_covariances[:, :, :3, 0] = _jerk_covariances(dt)
    process_covariances = process_covariances * jerk_intensities**2
    targets = np.zeros((n_samples, measurements.shape[1], width, 1))
    targets[:, :, 3:, 0] = measurements
    first_measurements = measurements[
        is_measured[:, first_derivative_order], first_derivative_order
    ]
    columns = np.zeros((3, width, n_levels))
    columns[first_derivative_order, 3:] = first_measurements[0][:, None]
    # the initial covariance is large, because unmeasured states are unknown
    initial_std = float(np.ptp(first_measurements, axis=0).max(initial=0.0)) + 1.0
    columns[range(3), range(3)] = initial_std**2
    predicted = np.empty((n_samples, 3, width))
    filtered = np.empty((n_samples, 3, width))
    innovation_variances = np.empty((int(is_measured.sum()), n_levels))
    innovations = np.empty((len(innovation_variances), width, n_levels))
    variance = (noise**2).tolist()
    measured_orders = [
        [order for order, is_present in enumerate(row) if is_present]
        for row in is_measured.tolist()
    ]
    n_updates = 0
    for k in range(n_samples):
        if k % _PRODUCT_BLOCK == 0:
            # F P F' of the covariance and F x of the states as one matrix per step
            block = slice(k, k + _PRODUCT_BLOCK)
            products = (
                transitions[block, :, None, :, None] * column_transitions[block, None, :, None]
            )
            products = products.reshape(-1, 3 * width, 3 * width)
        if k:
            columns = products[k % _PRODUCT_BLOCK].dot(columns.reshape(3 * width, n_levels))
            columns = columns.reshape(3, width, n_levels)
            columns += process_covariances[k]
        predicted[k] = columns[:, :, 0]
        for order in measured_orders[k]:
            row = np.subtract(columns[order], targets[k, order], out=innovations[n_updates])
            # rounding may make a variance negative
            innovation_variance = np.maximum(row[order], 0.0, out=innovation_variances[n_updates])
            innovation_variance += variance[order]
            gain = columns[:, order] / innovation_variance
            columns -= gain[:, None] * row
            n_updates += 1
        filtered[k] = columns[:, :, 0]
    normalized_squares = (innovations[:, 3:] ** 2).sum(axis=1) / innovation_variances
    log_determinant = n_axes * np.log(innovation_variances).sum(axis=0)
    # the noise level is the maximum-likelihood estimate for each intensity
    n_measurements = n_axes * n_updates
    mean_square = normalized_squares.sum(axis=0) / max(n_measurements, 1)
    cost = n_measurements * np.log(np.maximum(mean_square, 1e-60)) + log_determinant
    return cost, (
        (predicted[:, :, 3:], predicted[:, :, :3]),
        (filtered[:, :, 3:], filtered[:, :, :3]),
    )


def _transition_matrices(dt: np.ndarray) -> np.ndarray:
    """Return the transition matrices of the triple integrator over each step [T, 3, 3]."""
    transitions = np.tile(np.eye(3), (dt.size, 1, 1))
    transitions[:, 0, 1] = transitions[:, 1, 2] = dt
    transitions[:, 0, 2] = dt**2 / 2
    return transitions


def _jerk_covariances(dt: np.ndarray) -> np.ndarray:
    """Return the process noise covariances of unit white jerk over each step [T, 3, 3]."""
    position_variance = dt**5 / 20
    position_rate_covariance = dt**4 / 8
    position_acceleration_covariance = dt**3 / 6
    rate_variance = dt**3 / 3
    rate_acceleration_covariance = dt**2 / 2
    return np.array(
        [
            [position_variance, position_rate_covariance, position_acceleration_covariance],
            [position_rate_covariance, rate_variance, rate_acceleration_covariance],
            [position_acceleration_covariance, rate_acceleration_covariance, dt],
        ]
    ).transpose(2, 0, 1)
