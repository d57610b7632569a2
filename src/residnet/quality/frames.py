"""Check the consistency of position, heading and velocities of a log.

Frames, signs and units are checked first, then gains, lags and biases (`kinematics`). All checks
use a log on a uniform grid, with NaN at invalid samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.names import POSE_NAMES, VELOCITY_NAMES
from residnet.preprocessing.channel_values import (
    NEGLIGIBLE_MOTION_SHARE,
    SIGMA_OF_MAD,
    nan_median,
    nan_quantiles,
    nan_std,
)
from residnet.preprocessing.statistics import MIN_SAMPLES, estimate_agreement
from residnet.quality.findings import (
    Check,
    Finding,
    Level,
    check,
    describe_unit_confusion,
    make_correction,
    with_channels,
)
from residnet.quality.kinematics import (
    MIN_LAG,
    POSITION_LIMITS,
    YAW_LIMITS,
    estimate_position_causes,
    estimate_yaw_causes,
    make_cause_findings,
)
from residnet.quality.statistics import LogStatistics, interpolate_gaps

# (reversed channel, constant angle in deg) -> description; reversals of psi, y and v are complete,
# because any two of them equal the third
_CONVENTION_TEXTS = {
    ("as declared", 180): "u and v (or x and y) with reversed sign",
    ("psi reversed", 0): "psi counted counter-clockwise (sign: -1)",
    ("psi reversed", 90): "psi counted counter-clockwise from east (frame: enu)",
    ("y reversed", 0): "y positive to the west (sign: -1)",
    ("y reversed", -90): "x and y exchanged (x is north, y is east)",
    ("v reversed", 0): "v positive to port (frame: body_fpu)",
    ("v reversed", 180): "u positive astern (sign: -1)",
    ("earth axes", 0): "u, v as velocities in earth axes (frame: ned)",
}
_PLANAR_MOTION = (*POSE_NAMES, "u", "v")


@dataclass(frozen=True)
class AveragedRates:
    """Rates of a log on a uniform grid, averaged over the same window.

    The common window gives derivatives of the pose and measured velocities the same filter.

    Attributes:
        ground_velocity: derivative of the position, north + 1j east, [T] in m/s.
        body_velocity: velocity over ground from psi, u, v [T] in m/s, by convention.
        yaw_rate: derivative of psi [T] in rad/s.
        averaged_velocities: averaged u, v, r of the log [T].
        yaw_rate_noise: larger standard deviation of the noise of `yaw_rate` and averaged r, rad/s.
        sway_noise: standard deviation of the noise of averaged v, m/s.
    """

    ground_velocity: np.ndarray
    body_velocity: dict[str, np.ndarray]
    yaw_rate: np.ndarray
    averaged_velocities: dict[str, np.ndarray]
    yaw_rate_noise: float
    sway_noise: float


def compute_averaged_rates(log: LogStatistics) -> AveragedRates:
    """Compute rates over windows in which the pose changes by several times its noise."""
    velocity_names = [name for name in log.velocities if np.isfinite(log[name]).any()]
    yaw_rate_std = log.std("r") if "r" in velocity_names else 0.0

    def choose_half_window(noise: float, typical_rate: float) -> int:
        max_duration = float(log.t[-1] - log.t[0]) / 15.0
        return max(
            round(
                0.5
                * min(max(1.5, 10.0 * noise / max(typical_rate, 1e-9)), max_duration)
                / log.sampling_interval
            ),
            3,
        )

    def central_difference(values: np.ndarray, half_window: int) -> np.ndarray:
        """Return central differences [T] over the window, NaN at the ends."""
        differences = np.full(values.shape, np.nan, dtype=values.dtype)
        if values.size > 2 * half_window:
            differences[half_window:-half_window] = (
                values[2 * half_window :] - values[: -2 * half_window]
            ) / (2 * half_window * log.sampling_interval)
        differences[log.near_seam(half_window)] = np.nan
        return differences

    def trapezoidal_mean(values: np.ndarray, half_window: int) -> np.ndarray:
        """Return trapezoidal means [T] over the window, NaN at the ends and near gaps."""
        means = np.full(values.shape, np.nan, dtype=values.dtype)
        if values.size > 2 * half_window:
            weights = np.ones(2 * half_window + 1)
            is_finite = np.isfinite(values)
            has_missing = np.convolve(~is_finite, weights, mode="valid") > 0.5
            weights[[0, -1]] = 0.5
            window_means = np.convolve(
                np.where(is_finite, values, 0.0), weights / (2 * half_window), mode="valid"
            )
            means[half_window:-half_window] = np.where(has_missing, np.nan, window_means)
        return means

    position_half_window = choose_half_window(
        max(log.noise_std("x"), log.noise_std("y")), log.rms_speed
    )
    yaw_half_window = choose_half_window(log.noise_std("psi"), yaw_rate_std)
    u, v = (
        log[name] if name in velocity_names else np.full(len(log), np.nan) for name in ("u", "v")
    )
    yaw_rate_noise = np.sqrt(0.5) * log.noise_std("psi") / (yaw_half_window * log.sampling_interval)
    return AveragedRates(
        central_difference(log["x"] + 1j * log["y"], position_half_window),
        {
            "as declared": trapezoidal_mean(
                np.exp(1j * log["psi"]) * (u + 1j * v), position_half_window
            ),
            "psi reversed": trapezoidal_mean(
                np.exp(-1j * log["psi"]) * (u + 1j * v), position_half_window
            ),
            "v reversed": trapezoidal_mean(
                np.exp(1j * log["psi"]) * (u - 1j * v), position_half_window
            ),
            "earth axes": trapezoidal_mean(u + 1j * v, position_half_window),
        },
        central_difference(log["psi"], yaw_half_window),
        {
            name: trapezoidal_mean(
                log[name], yaw_half_window if name == "r" else position_half_window
            )
            for name in velocity_names
        },
        max(
            yaw_rate_noise,
            log.noise_std("r") / np.sqrt(2.0 * yaw_half_window) if "r" in velocity_names else 0.0,
        ),
        log.noise_std("v") / np.sqrt(2.0 * position_half_window) if "v" in velocity_names else 0.0,
    )


@check("grid", "frames_unchecked", "note")
def report_unchecked_frames(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a log without the channels for the checks of frames."""
    missing_names = [name for name in POSE_NAMES if name not in log]
    if missing_names or not log.velocities:
        yield make_finding(
            f"frames not checked: the log has no {', '.join(missing_names or VELOCITY_NAMES)}"
        )


@dataclass(frozen=True)
class FrameAgreement:
    """Agreement of the velocity over ground with R(psi) [u, v] under several conventions.

    Attributes:
        overlaps: convention -> complex correlation. Its absolute value is the coherence (1 for full
            agreement); its angle is the correction of psi in rad.
        speed_ratio: norm of the declared velocity over that of the velocity over ground.
    """

    overlaps: dict[str, complex]
    speed_ratio: float

    @property
    def best_name(self) -> str:
        """Convention with the largest coherence; on a straight course the declared one."""
        return max(
            self.overlaps,
            key=lambda name: abs(self.overlaps[name]) + 1e-3 * (name == "as declared"),
        )

    @property
    def is_better_undeclared(self) -> bool:
        """Whether another convention leaves less than half of the incoherence of the declared."""
        best = abs(self.overlaps[self.best_name])
        declared = self.overlaps["as declared"].real
        is_material = best > declared + 0.02 or 1.0 - best < 0.1 * (1.0 - declared)
        is_half = best > 0.8 and 1.0 - best < 0.5 * (1.0 - declared)
        return self.best_name != "as declared" and is_half and is_material

    @property
    def is_consistent(self) -> bool:
        """Whether frames and units agree, so that smaller inconsistencies can be estimated."""
        is_declared = self.overlaps["as declared"].real > 0.8 and not self.is_better_undeclared
        return is_declared and 0.8 < self.speed_ratio < 1.25


def compare_frames(log: LogStatistics) -> FrameAgreement | None:
    """Compare position and velocities; None with fewer than 50 samples in motion."""
    averaged_rates = log.cached(compute_averaged_rates)
    is_finite = np.isfinite(averaged_rates.ground_velocity)
    for values in averaged_rates.body_velocity.values():
        is_finite &= np.isfinite(values)
    ground_velocity = averaged_rates.ground_velocity[is_finite]
    declared_velocity = averaged_rates.body_velocity["as declared"][is_finite]
    if is_finite.sum() < MIN_SAMPLES or not ground_velocity.any() or not declared_velocity.any():
        return None
    velocity_pairs = {
        name: (ground_velocity, values[is_finite])
        for name, values in averaged_rates.body_velocity.items()
    }
    velocity_pairs["y reversed"] = ground_velocity.conj(), declared_velocity
    overlaps = {
        name: (
            complex(np.vdot(body_values, ground_values))
            / float(np.linalg.norm(ground_values) * np.linalg.norm(body_values))
        )
        for name, (ground_values, body_values) in velocity_pairs.items()
    }
    return FrameAgreement(
        overlaps, float(np.linalg.norm(declared_velocity) / np.linalg.norm(ground_velocity))
    )


@check(
    "grid",
    "frames",
    fix="correct it in the channel map",
    required_channels=_PLANAR_MOTION,
    on_subsample=True,
)
def check_frames(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report wrong frames, signs and units of position and velocities."""
    agreement_ = log.cached(compare_frames)
    if agreement_ is None:
        text = f"u, v not checked against position: fewer than {MIN_SAMPLES} samples with motion"
        yield make_finding(text, code="frames_unchecked", level="note", fix="")
        return
    overlaps = agreement_.overlaps
    speed_ratio = agreement_.speed_ratio
    declared_coherence = overlaps["as declared"].real
    heading_offset_deg = math.degrees(np.angle(overlaps["as declared"]))
    best_name = agreement_.best_name
    best_coherence = abs(overlaps[best_name])
    best_offset_deg = math.degrees(np.angle(overlaps[best_name]))
    text = (
        f"x, y rates against R(psi) [u, v]: coherence {declared_coherence:.3f}, heading off by"
        f" {heading_offset_deg:+.1f} deg, speed ratio {speed_ratio:.3f}"
    )
    level: Level = "will mislead"
    fix = None
    is_much_better = declared_coherence < 0.8 and best_coherence > declared_coherence + 0.1
    if is_much_better or agreement_.is_better_undeclared:
        convention_text = f"{best_name}, {best_offset_deg:+.1f} deg added to psi"
        for (name, nominal_angle), description in _CONVENTION_TEXTS.items():
            if (
                name == best_name
                and abs((best_offset_deg - nominal_angle + 180.0) % 360.0 - 180.0) < 15.0
            ):
                convention_text = description
        text += f"; the frames do not fit: coherence {best_coherence:.3f} with {convention_text}"
    elif declared_coherence < 0.8:
        level = "fatal"
        fix = "are the columns of one run, one clock and one vessel?"
        text += "; no change of sign or angle makes them fit"
    elif not 0.8 < speed_ratio < 1.25:
        text += (
            f"; check the units of u, v and x, y{describe_unit_confusion(speed_ratio, 'm/s', 'm')}"
        )
    elif abs(heading_offset_deg) > 5.0:
        text += "; a compass offset, or velocities through the water in a current"
        fix = "correct psi, or provide the current as an input"
    else:
        level = "note"
        fix = ""
    yield make_finding(
        text,
        {
            "coherence": declared_coherence,
            "offset": math.radians(heading_offset_deg),
            "speed_ratio": speed_ratio,
            "best_coherence": best_coherence,
            "best_offset": math.radians(best_offset_deg),
        },
        level=level,
        fix=fix,
    )


@check(
    "grid",
    "position_jump",
    fix="mask them (kind: frozen or jump), or split the log there",
    required_channels=_PLANAR_MOTION,
)
def check_position_jumps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report jumps of the position that the velocities do not explain."""
    earth_velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    explained_steps = (
        0.5 * _time_steps_without_gaps(log) * (earth_velocity[1:] + earth_velocity[:-1])
    )
    unexplained_steps = np.abs(np.nan_to_num(np.diff(log["x"] + 1j * log["y"]) - explained_steps))
    explained_distances = np.abs(explained_steps[np.isfinite(explained_steps)])
    high_distance = (
        0.5 * nan_quantiles(explained_distances, 0.95)[0] if explained_distances.size else 0.0
    )
    limit = max(15.0 * nan_median(unexplained_steps), high_distance)
    message_template = (
        f"position jumps {{}} times by more than {limit:.2g} m beyond u, v, at most by {{:.2g}} m"
    )
    yield from _report_jumps(
        log, make_finding, unexplained_steps, limit, message_template, ("x", "y")
    )


def _time_steps_without_gaps(log: LogStatistics) -> np.ndarray:
    """Return the time steps [T - 1] in s, NaN for gaps."""
    dt = np.diff(log.t)
    return np.where(dt > 3.5 * log.sampling_interval, np.nan, dt)


def _report_jumps(
    log: LogStatistics,
    make_finding: Check,
    excess_steps: np.ndarray,
    limit: float,
    message_template: str,
    channels: tuple[str, ...],
    factor: float = 1.0,
) -> Iterator[Finding]:
    """Yield a finding if the excess of a pose step [T - 1] exceeds a limit."""
    is_jump = np.abs(excess_steps) > limit
    if is_jump.any():
        worst_index = int(np.argmax(np.abs(excess_steps)))
        largest_excess = float(abs(excess_steps[worst_index]))
        time = float(log.t[worst_index + 1])
        yield make_finding(
            message_template.format(int(is_jump.sum()), factor * excess_steps[worst_index])
            + f" at t = {time:.2f} s",
            {"count": is_jump.sum(), "largest": largest_excess, "t": time},
            sample_mask=np.append(is_jump, False) | np.append(False, is_jump),
            channels=channels,
        )


@check(
    "grid",
    "course_as_heading",
    fix="take psi from the compass",
    required_channels=_PLANAR_MOTION,
    on_subsample=True,
)
def check_course_as_heading(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a heading that equals the course over ground although the vessel drifts."""
    averaged_rates = log.cached(compute_averaged_rates)
    agreement = log.cached(compare_frames)
    # velocities in earth axes have no drift angle
    is_earth_fixed = agreement is not None and agreement.best_name == "earth axes"
    if not {"u", "v"} <= averaged_rates.averaged_velocities.keys() or is_earth_fixed:
        return
    drift_angles = np.angle(
        averaged_rates.averaged_velocities["u"] + 1j * averaged_rates.averaged_velocities["v"]
    )
    course_angles = np.angle(averaged_rates.ground_velocity * np.exp(-1j * log["psi"]))
    is_valid = np.isfinite(course_angles) & np.isfinite(drift_angles)
    speed = np.abs(averaged_rates.ground_velocity)
    if is_valid.any():
        is_valid &= (speed > 0.3 * nan_quantiles(speed[is_valid], 0.9)[0]) & (
            np.abs(drift_angles) < 1.2
        )
    drift_std = float(np.std(drift_angles[is_valid])) if is_valid.sum() >= 100 else 0.0
    # heading and course are distinguishable only if the drift angle varies beyond its noise
    drift_noise = (
        float(np.sqrt(np.mean((averaged_rates.sway_noise / speed[is_valid]) ** 2)))
        if drift_std
        else 0.0
    )
    if drift_std < math.hypot(math.radians(1.0), drift_noise):
        return
    rms_as_heading, rms_as_course = (
        float(np.sqrt(np.mean(np.angle(np.exp(1j * angle)) ** 2)))
        for angle in (course_angles[is_valid] - drift_angles[is_valid], course_angles[is_valid])
    )
    if rms_as_course < 0.6 * min(rms_as_heading, drift_std):
        text = (
            "psi is the course over ground: it follows the positions to"
            f" {math.degrees(rms_as_course):.1f} deg without the drift of v over u, and to"
            f" {math.degrees(rms_as_heading):.1f} deg with it"
        )
        yield make_finding(
            text,
            {"as_course": rms_as_course, "as_heading": rms_as_heading},
            repair=lambda log: with_channels(log, psi=log["psi"] - np.arctan2(log["v"], log["u"])),
        )


@check("grid", "follows", required_channels=_PLANAR_MOTION, on_subsample=True)
def check_velocities_against_position(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report sign, gain and lag of u and v against the derivative of the position."""
    frame_agreement = log.cached(compare_frames)
    body_ground_velocity = log.cached(compute_averaged_rates).ground_velocity * np.exp(
        -1j * log["psi"]
    )
    if (
        frame_agreement is None
        or not frame_agreement.is_consistent
        or not np.isfinite(body_ground_velocity).any()
    ):
        return
    # the comparison of increments detects an offset or a current, but not wrong axes
    is_certain = any(
        cause.is_significant for cause in log.cached(estimate_position_causes).values()
    )
    min_spread = 0.05 * float(np.sqrt(np.nanmean(np.abs(body_ground_velocity) ** 2)))
    for name, axis_name, reference in (
        ("u", "x", body_ground_velocity.real),
        ("v", "y", body_ground_velocity.imag),
    ):
        reference_text = f"the position's rate along {axis_name}"
        finding_arguments = _compare_channel(
            log, name, reference, min_spread, reference_text, is_certain
        )
        if finding_arguments:
            yield make_finding(**finding_arguments)


def _compare_channel(
    log: LogStatistics,
    name: str,
    reference: np.ndarray,
    min_spread: float,
    reference_text: str,
    is_certain: bool,
) -> dict[str, Any]:
    """Return the arguments of a finding about sign, gain and lag of a channel.

    Args:
        log: statistics of the log.
        name: channel to compare.
        reference: derivative of the pose [T].
        min_spread: smallest standard deviation for a comparison.
        reference_text: description of the reference.
        is_certain: whether the comparison of increments found a significant difference. Only then
            a lag misleads, because slow channels correlate at any lag.

    Returns:
        Keyword arguments of the check; empty if the comparison is not possible.
    """
    averaged_rates = log.cached(compute_averaged_rates)
    channel_std, reference_std = (
        nan_std(signal) for signal in (averaged_rates.averaged_velocities[name], reference)
    )
    if (
        name == "r"
        and reference_std > 5.0 * averaged_rates.yaw_rate_noise
        and channel_std < NEGLIGIBLE_MOTION_SHARE * reference_std
    ):
        return {
            "text": (
                f"{name} does not move, while {reference_text} does; the gyro is dead or another"
                " column"
            ),
            "figures": {"correlation": 0.0, "gain": 0.0, "lag": 0.0},
            "code": f"follows_{name}",
            "level": "will mislead",
            "fix": f"leave {name} out of the channel map: it follows from the heading",
        }
    channel_agreement = estimate_agreement(
        reference, averaged_rates.averaged_velocities[name], log.sampling_interval
    )
    if channel_agreement is None or channel_agreement.reference_std < min_spread:
        return {}
    correlation, gain, lag, reference_spread = channel_agreement
    text = (
        f"{name} against {reference_text}: correlation {correlation:.3f}, gain {gain:.3f}, lag"
        f" {lag:+.2f} s"
    )
    level: Level = "will mislead"
    fix = ""
    is_above_noise = name != "r" or reference_spread > 5.0 * averaged_rates.yaw_rate_noise
    if correlation < -0.8 or (correlation < -0.5 and is_above_noise):
        text = f"{text}; it has the opposite sign"
        fix = "turn it in the channel map (sign: -1)"
    elif correlation < 0.5 and name == "r" and is_above_noise:
        level = "fatal"
        fix = "are both columns of this vessel and this clock?"
        text += "; they do not describe one motion"
    elif correlation > 0.9 and is_above_noise and not 0.6 < gain < 1.6:
        text += f"; check its unit{describe_unit_confusion(gain, log.units[name])}"
        fix = "correct the unit in the channel map"
    else:
        # the causes of `kinematics` distinguish the channels, so the lag is only a note here
        level = "note"
        if (
            correlation > 0.9
            and abs(lag) > max(MIN_LAG, log.sampling_interval)
            and is_above_noise
            and is_certain
        ):
            text += f"; it {'trails' if lag > 0.0 else 'leads'}, a filter or another clock"
    figures = {"correlation": correlation, "gain": gain, "lag": lag}
    return {"text": text, "figures": figures, "code": f"follows_{name}", "level": level, "fix": fix}


@check("grid", "position_causes", required_channels=_PLANAR_MOTION, on_subsample=True)
def check_position_causes(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the causes of differences between position and velocities in correct frames."""
    frame_agreement = log.cached(compare_frames)
    if frame_agreement is not None and frame_agreement.is_consistent:
        yield from make_cause_findings(
            log.cached(estimate_position_causes), POSITION_LIMITS, log, make_finding
        )


def compare_yaw_rate(log: LogStatistics) -> dict[str, Any]:
    """Return the arguments of a finding about r against the derivative of psi."""
    if "r" not in log.cached(compute_averaged_rates).averaged_velocities:
        return {}
    is_certain = any(cause.is_significant for cause in log.cached(estimate_yaw_causes).values())
    heading_rate = log.cached(compute_averaged_rates).yaw_rate
    return _compare_channel(
        log, "r", heading_rate, math.radians(0.1), "the rate of psi", is_certain
    )


def _is_yaw_consistent(log: LogStatistics) -> bool:
    """Return whether psi and r agree in sign, unit and scale."""
    has_both_channels = min(int(np.isfinite(log[name]).sum()) for name in ("psi", "r")) > 1
    return has_both_channels and log.cached(compare_yaw_rate).get("level", "note") == "note"


_YAW_MOTION = (*POSE_NAMES, "r")


@check("grid", "follows", required_channels=_YAW_MOTION, on_subsample=True)
def check_yaw_rate_against_heading(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report sign, gain and lag of r against the derivative of psi."""
    finding_arguments = log.cached(compare_yaw_rate)
    if finding_arguments:
        yield make_finding(**finding_arguments)


@check(
    "grid",
    "heading_jump",
    fix="mask it (kind: jump, channel: psi), or split the log there",
    required_channels=_YAW_MOTION,
)
def check_heading_jumps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report jumps of the heading that the yaw rate does not explain."""
    psi = log["psi"]
    r = log["r"]
    excess_steps = np.diff(psi) - 0.5 * _time_steps_without_gaps(log) * (r[1:] + r[:-1])
    scatter = nan_median(np.abs(excess_steps)) if np.isfinite(excess_steps).any() else 0.0
    noise = max(log.noise_std("psi") * math.sqrt(2.0), SIGMA_OF_MAD * scatter)
    limit = max(10.0 * noise, math.radians(2.0))
    message_template = "psi jumps {} times beyond what r explains, at most by {:+.1f} deg"
    finite_excess = np.nan_to_num(excess_steps)
    yield from _report_jumps(
        log, make_finding, finite_excess, limit, message_template, ("psi",), math.degrees(1.0)
    )


@check("grid", "yaw_drift", required_channels=_YAW_MOTION, is_record_fault=True)
def check_yaw_drift(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the bias of r against psi."""
    if not _is_yaw_consistent(log.subsample):
        return
    psi = interpolate_gaps(log.t, log["psi"])
    r = interpolate_gaps(log.t, log["r"])
    heading_drift = (
        psi - psi[0] - np.append(0.0, np.cumsum(0.5 * np.diff(log.t) * (r[1:] + r[:-1])))
    )
    final_drift = float(heading_drift[-1])
    max_drift = float(np.abs(heading_drift).max())
    duration = float(log.t[-1] - log.t[0])
    yaw_rate_std = max(log.std("r"), 1e-12)
    bias = final_drift / duration
    causes = log.subsample.cached(estimate_yaw_causes)
    bias_cause = causes.get("bias") or causes.get("ramp")
    # a bias misleads above 1.8 deg per minute and 5 % of the yaw rate, or by its integral
    is_large = abs(bias) > max(math.radians(0.03), 0.05 * yaw_rate_std) or max_drift > math.radians(
        15.0
    )
    is_significant = bias_cause is not None and bias_cause.is_significant and is_large
    text = (
        f"heading minus the integral of r: {math.degrees(final_drift):+.1f} deg at the end, at most"
        f" {math.degrees(max_drift):.1f} deg, a bias of {math.degrees(bias):+.4f} deg/s"
        f" ({100.0 * abs(bias) / yaw_rate_std:.2g} % of the standard deviation of r)"
    )
    level: Level = "will mislead" if is_significant else "note"
    fix = "take the bias off r, or use the rate of psi in its place" if is_significant else ""
    repair = make_correction(("r",), offset=bias)
    yield make_finding(
        text,
        {"end": final_drift, "most": max_drift, "bias": bias},
        level=level,
        fix=fix,
        repair=repair,
    )


@check("grid", "yaw_causes", required_channels=_YAW_MOTION, on_subsample=True)
def check_yaw_causes(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report gain and lag of r against psi."""
    if _is_yaw_consistent(log):
        yield from make_cause_findings(
            log.cached(estimate_yaw_causes), YAW_LIMITS, log, make_finding
        )


_MIN_ROLL_CORRELATION = 0.8
"""Smallest correlation of angle increments and rate integrals for a comparison of scales."""


@check(
    "grid",
    "roll_rate",
    fix="correct the sign or the unit of one",
    required_channels=("phi", "p"),
    on_subsample=True,
)
def check_roll_rate(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a roll rate with a wrong sign or unit against the roll angle."""
    phi = interpolate_gaps(log.t, log["phi"])
    p = interpolate_gaps(log.t, log["p"])
    integrated_rate = np.append(0.0, np.cumsum(0.5 * np.diff(log.t) * (p[1:] + p[:-1])))
    one_second_slice = slice(None, None, max(round(1.0 / log.sampling_interval), 1))
    angle_increments = np.diff(phi[one_second_slice])
    rate_integrals = np.diff(integrated_rate[one_second_slice])
    norm_product = float(np.linalg.norm(angle_increments) * np.linalg.norm(rate_integrals))
    if (
        angle_increments.size < MIN_SAMPLES
        or norm_product == 0.0
        or abs(float(angle_increments @ rate_integrals)) < _MIN_ROLL_CORRELATION * norm_product
    ):
        return
    gain = float(angle_increments @ rate_integrals) / float(rate_integrals @ rate_integrals)
    # a wrong sign gives a gain of -1, a wrong unit 57 or 1/57
    if not 0.5 < gain < 2.0:
        yield make_finding(f"phi moves by {gain:.2g} times what its rate p says")
