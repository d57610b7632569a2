"""Check the consistency of position, heading and velocities of a log.

Frames, signs and units are checked first, then gains, lags and biases (`kinematics`). All checks
use a log on a uniform grid, with NaN at invalid samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from residnet.core.names import POSE_NAMES, VELOCITY_NAMES
from residnet.preprocessing.channel_values import (
    NEGLIGIBLE_MOTION_SHARE,
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
)
from residnet.quality.kinematic_findings import POSITION_LIMITS, YAW_LIMITS, make_cause_findings
from residnet.quality.kinematics import estimate_position_causes, estimate_yaw_causes
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
_MIN_YAW_RATE_STD = math.radians(0.1)
"""Smallest standard deviation of a yaw rate in rad/s that is compared with another."""


@dataclass(frozen=True)
class AveragedRates:
    """Rates of a log on a uniform grid, averaged over the same window.

    The common window gives derivatives of the pose and measured velocities the same filter.

    Attributes:
        ground_velocity: derivative of the position, north + 1j east, [T] in m/s.
        body_velocity: velocity over ground from psi, u, v [T] in m/s, by convention.
        yaw_rate: derivative of psi [T] in rad/s.
        measured_yaw_rate: averaged r of the log [T] in rad/s; NaN without one.
        yaw_rate_noise: larger standard deviation of the noise of both yaw rates in rad/s.
    """

    ground_velocity: np.ndarray
    body_velocity: dict[str, np.ndarray]
    yaw_rate: np.ndarray
    measured_yaw_rate: np.ndarray
    yaw_rate_noise: float


def compute_averaged_rates(log: LogStatistics) -> AveragedRates:
    """Compute rates over windows in which the pose changes by several times its noise."""
    u, v, r = (
        log[name] if name in log and np.isfinite(log[name]).any() else np.full(len(log), np.nan)
        for name in VELOCITY_NAMES
    )
    has_yaw_rate = bool(np.isfinite(r).any())

    def choose_half_window(noise: float, typical_rate: float) -> int:
        duration = max(1.5, 10.0 * noise / max(typical_rate, 1e-9))
        duration = min(duration, float(log.t[-1] - log.t[0]) / 15.0)
        return max(round(0.5 * duration / log.sampling_interval), 3)

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
    yaw_half_window = choose_half_window(
        log.noise_std("psi"), log.std("r") if has_yaw_rate else 0.0
    )
    yaw_rate_noise = np.sqrt(0.5) * log.noise_std("psi") / (yaw_half_window * log.sampling_interval)
    if has_yaw_rate:
        yaw_rate_noise = max(yaw_rate_noise, log.noise_std("r") / np.sqrt(2.0 * yaw_half_window))
    rotation = np.exp(1j * log["psi"])
    velocity = u + 1j * v
    velocity_by_convention = {
        "as declared": rotation * velocity,
        "psi reversed": rotation.conj() * velocity,
        "v reversed": rotation * velocity.conj(),
        "earth axes": velocity,
    }
    return AveragedRates(
        central_difference(log["x"] + 1j * log["y"], position_half_window),
        {
            name: trapezoidal_mean(values, position_half_window)
            for name, values in velocity_by_convention.items()
        },
        central_difference(log["psi"], yaw_half_window),
        trapezoidal_mean(r, yaw_half_window),
        yaw_rate_noise,
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
        speed_ratio: ratio of the norms of the declared velocity and of the velocity over ground.
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


_MAX_SPEED_RATIO = 5.0
"""Largest ratio of a speed from positions to its 95 % quantile."""


def compare_frames(log: LogStatistics) -> FrameAgreement | None:
    """Compare position and velocities; None with fewer than 50 samples in motion.

    If a lever arm of the receiver explains a difference better than another convention, the
    declared one is compared at the vessel's centre.
    """
    averaged_rates = log.cached(compute_averaged_rates)
    is_finite = np.isfinite(averaged_rates.ground_velocity)
    for values in averaged_rates.body_velocity.values():
        is_finite &= np.isfinite(values)
    # a jump of the position, which has a check of its own, is no motion
    speed = np.abs(np.where(is_finite, averaged_rates.ground_velocity, 0.0))
    is_finite &= speed <= _MAX_SPEED_RATIO * float(np.quantile(speed, 0.95))
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
    # a receiver at the bow sways as a reversed v does, because v and r are nearly proportional
    arm = np.nan_to_num(1j * (averaged_rates.yaw_rate * np.exp(1j * log["psi"]))[is_finite])
    regressors = np.stack((declared_velocity, arm), axis=1)
    lever_arm = np.linalg.lstsq(regressors, ground_velocity, rcond=1e-10)[0][1]
    centre_velocity = ground_velocity - lever_arm * arm
    norms = float(np.linalg.norm(centre_velocity)) * float(np.linalg.norm(declared_velocity))
    overlap_of_centre = complex(np.vdot(declared_velocity, centre_velocity)) / max(norms, 1e-300)
    if abs(overlap_of_centre) > max(map(abs, overlaps.values())):
        overlaps["as declared"] = overlap_of_centre
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
    velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    text = "position jumps {} times by more than {:.2g} m beyond u, v, at most by {:.2g} m"
    yield from _report_jumps(log, make_finding, log["x"] + 1j * log["y"], velocity, text)


def _compute_unexplained_steps(
    log: LogStatistics, pose: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """Return the sizes of the steps [T - 1] of a pose beyond the integral of its rate [T].

    They are NaN where the integral is unknown, as over a gap.
    """
    dt = np.diff(log.t)
    dt = np.where(dt > 3.5 * log.sampling_interval, np.nan, dt)
    return np.asarray(np.abs(np.diff(pose) - 0.5 * dt * (rate[1:] + rate[:-1])))


def _report_jumps(
    log: LogStatistics,
    make_finding: Check,
    pose: np.ndarray,
    rate: np.ndarray,
    text: str,
    min_jump: float = 0.0,
    display_factor: float = 1.0,
) -> Iterator[Finding]:
    """Yield a finding if steps of a pose [T] exceed the integral of its rate [T].

    Args:
        log: statistics of the log.
        make_finding: the check that reports.
        pose: measured pose [T]; a position is complex.
        rate: its rate from the velocities [T].
        text: text with places for the number of jumps, the limit and the largest jump.
        min_jump: smallest jump in m or rad.
        display_factor: factor from m or rad to the unit of the text.
    """
    excess = np.nan_to_num(_compute_unexplained_steps(log, pose, rate))
    steps = np.abs(np.diff(pose))
    steps = steps[np.isfinite(steps)]
    if steps.size:
        min_jump = max(min_jump, 0.5 * nan_quantiles(steps, 0.95)[0])
    limit = max(15.0 * nan_median(excess), min_jump)
    is_jump = excess > limit
    if is_jump.any():
        worst = int(np.argmax(excess))
        sizes = display_factor * limit, display_factor * excess[worst]
        time = float(log.t[worst + 1])
        yield make_finding(
            text.format(int(is_jump.sum()), *sizes) + f" at t = {time:.2f} s",
            {"count": is_jump.sum(), "largest": excess[worst], "t": time},
            sample_mask=np.append(is_jump, False) | np.append(False, is_jump),
        )


_MIN_HEADING_RESET = math.radians(20.0)
"""Smallest jump of the heading in rad that distorts the causes in the position."""


@check("grid", "position_causes", required_channels=_PLANAR_MOTION, on_subsample=True)
def check_position_causes(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the causes of differences between position and velocities in correct frames."""
    frame_agreement = log.cached(compare_frames)
    if frame_agreement is None or not frame_agreement.is_consistent:
        return
    if "r" in log and "course" in log.cached(estimate_yaw_causes):
        return
    if "r" in log:
        excess = _compute_unexplained_steps(log, log["psi"], log["r"])
        # a reset of the pose, which has a check of its own, looks like delays and scales
        if np.nanmax(excess, initial=0.0) > _MIN_HEADING_RESET:
            return
    causes = log.cached(estimate_position_causes)
    yield from make_cause_findings(causes, POSITION_LIMITS, log, make_finding)


_YAW_MOTION = ("psi", "r")
_MIN_YAW_CORRELATION = 0.5
"""Smallest correlation, at any lag and sign, of a yaw rate with the derivative of the heading."""


@check(
    "grid",
    "yaw_rate",
    "fatal",
    "are both columns of this vessel and this clock?",
    required_channels=(*POSE_NAMES, "r"),
    on_subsample=True,
)
def check_yaw_rate(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a yaw rate that has nothing in common with the derivative of the heading."""
    rates = log.cached(compute_averaged_rates)
    yaw_rate = rates.measured_yaw_rate
    min_std = max(5.0 * rates.yaw_rate_noise, _MIN_YAW_RATE_STD)
    reference_std = nan_std(rates.yaw_rate)
    if reference_std <= min_std or not np.isfinite(yaw_rate).any():
        return
    if nan_std(yaw_rate) < NEGLIGIBLE_MOTION_SHARE * reference_std:
        yield make_finding(
            "r does not move, while the rate of psi does; the gyro is dead or another column",
            {"correlation": 0.0},
            level="will mislead",
            fix="leave r out of the channel map: it follows from the heading",
        )
        return
    agreement = estimate_agreement(rates.yaw_rate, yaw_rate, log.sampling_interval)
    # the samples that all lags share may be a steady turn, whose rates are noise about their mean
    if agreement is None or agreement.reference_std <= min_std:
        return
    if abs(agreement.correlation) < _MIN_YAW_CORRELATION:
        yield make_finding(
            f"r against the rate of psi: correlation {agreement.correlation:.3f} at a lag of"
            f" {agreement.lag:+.2f} s; they do not describe one motion",
            {"correlation": agreement.correlation, "lag": agreement.lag},
        )


@check(
    "grid",
    "heading_jump",
    fix="mask it (kind: jump, channel: psi), or split the log there",
    required_channels=_YAW_MOTION,
)
def check_heading_jumps(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report jumps of the heading that the yaw rate does not explain."""
    text = "psi jumps {} times by more than {:.2g} deg beyond r, at most by {:.1f} deg"
    yield from _report_jumps(
        log, make_finding, log["psi"], log["r"], text, math.radians(2.0), math.degrees(1.0)
    )


@check("grid", "yaw_drift", required_channels=_YAW_MOTION, is_record_fault=True)
def check_yaw_drift(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the bias of r against psi."""
    causes = log.subsample.cached(estimate_yaw_causes)
    if "gain" in causes and causes["gain"].is_gross:
        # the sign or the unit of r is wrong
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
    yield make_finding(
        text,
        {"end": final_drift, "most": max_drift, "bias": bias},
        level=level,
        fix=fix,
    )


@check("grid", "yaw_causes", required_channels=_YAW_MOTION, on_subsample=True)
def check_yaw_causes(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report sign, gain and lag of r against psi, or a course over ground in place of psi."""
    yield from make_cause_findings(log.cached(estimate_yaw_causes), YAW_LIMITS, log, make_finding)


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
