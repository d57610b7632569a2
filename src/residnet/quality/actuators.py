"""Checks of propellers, rudders and the clock of the inputs against the motion."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.core.names import port_starboard_pairs
from residnet.core.stretches import find_runs
from residnet.preprocessing.channel_values import SIGMA_OF_MAD, nan_median, nan_quantiles, nan_std
from residnet.preprocessing.statistics import CHUNK_SAMPLES, MIN_SAMPLES, OverlappingBlocks
from residnet.quality.findings import Check, Finding, check, make_correction
from residnet.quality.statistics import (
    MIN_TURN_SHARE,
    N_SECTIONS,
    SMOOTHING_SAMPLES,
    STEERING_CHANNELS,
    LeastSquaresFit,
    LogStatistics,
    abs_quantile,
    compute_port_share,
    fit_least_squares,
    make_blocks,
    make_input_terms,
    make_velocity_terms,
    smooth_by_parabola,
)

_MIN_T_STATISTIC = 6.0
"""t statistic of a wrong sign: high, because reversing a correct sign would ruin a fit."""
_REVERSE_SIGN_FIX = "reverse it in the channel map (sign: -1)"
_REVERSE_SIGN_AND_CHECK_FIX = f"{_REVERSE_SIGN_FIX}, and check the sign of r and psi"


def find_propellers(log: LogStatistics) -> list[str]:
    """Return the inputs in revolutions per second that are not always zero."""
    revolution_inputs = [
        name
        for name in log.inputs
        if log.units[name] == "1/s" and abs_quantile(log[name], 1.0) > 0.0
    ]
    # measured revolutions are preferred to commands
    return [name for name in revolution_inputs if not name.startswith("cmd_")] or revolution_inputs


_MIN_TURN_RATIO = 8e-4
"""Smallest plausible yaw angle per propeller revolution at full rudder in rad; vessels have .003 to
.03.
"""
_MAX_TURN_RATIO = 0.3
"""Largest plausible yaw angle per propeller revolution at full rudder in rad."""
_MAX_REVOLUTIONS = 250.0
"""Largest plausible propeller revolutions in 1/s."""
_FULL_RUDDER = 0.35
"""Full rudder angle in rad."""
_MIN_STEERING_SHARE = 0.2
"""Smallest share of full rudder for which the yaw rate indicates the unit of revolutions."""


@check(
    "actuators",
    "unit",
    fix="correct its unit in the channel map",
    is_record_fault=True,
    on_subsample=True,
)
def check_propeller_unit(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report revolutions whose unit cannot be 1/s."""
    names = log.cached(find_propellers)
    # the fastest propeller counts, because one of several may be almost stopped
    max_revolutions = max((abs_quantile(log[name]) for name in names), default=0.0)
    for name in names:
        revolutions = abs_quantile(log[name])
        factor = 0.0
        text = f"{name} reaches {revolutions:.3g} 1/s, out of proportion to the yaw rate"
        steering_share = _steering_share(log, names) if "r" in log else 0.0
        if revolutions > _MAX_REVOLUTIONS:
            text = f"{name} reaches {revolutions:.4g} 1/s, more than any propeller"
            factor = 60.0
        elif steering_share > _MIN_STEERING_SHARE:
            turn_ratio = (
                abs_quantile(log["r"]) / min(steering_share, 1.0) / max(max_revolutions, 1e-12)
            )
            if revolutions > 20.0 and turn_ratio < _MIN_TURN_RATIO:
                factor = 60.0
            elif max_revolutions < 1.0 and turn_ratio > _MAX_TURN_RATIO:
                factor = 1.0 / 60.0
        if factor:
            text += ": rpm taken as 1/s?" if factor > 1.0 else ": 1/s taken as rpm?"
            yield make_finding(
                text, {"largest": revolutions}, repair=make_correction((name,), factor=factor)
            )


def _steering_share(log: LogStatistics, names: Sequence[str]) -> float:
    """Return the steering effort as a share of full rudder.

    Without a rudder angle, it is the difference of the propeller revolutions over their size.

    Args:
        log: statistics of the log.
        names: channels of propeller revolutions.
    """
    rudder_shares = [
        abs_quantile(log[name]) / _FULL_RUDDER for name in ("delta", "cmd_delta") if name in log
    ]
    if rudder_shares:
        return max(rudder_shares)
    revolutions = np.stack([log[name] for name in names])
    return abs_quantile(np.ptp(revolutions, axis=0)) / max(
        abs_quantile(np.abs(revolutions).max(axis=0)), 1e-12
    )


@check(
    "actuators",
    "propeller_sign",
    fix=_REVERSE_SIGN_FIX,
    required_channels=("u",),
    is_record_fault=True,
    on_subsample=True,
)
def check_propeller_sign(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report propellers whose sign contradicts the direction of motion or the acceleration."""
    names = log.cached(find_propellers)
    is_moving = np.abs(log["u"]) > 0.3 * abs_quantile(log["u"], 0.9)
    if not names or not is_moving.any():
        return
    opposing_propellers = [
        name
        for name in names
        if float(np.mean((log[name] != 0.0)[is_moving])) > 0.5
        and float(np.mean((log[name] * log["u"])[is_moving & (log[name] != 0.0)] < 0.0)) > 0.9
    ]
    yaw_rate = log["r"][is_moving & np.isfinite(log["r"])] if "r" in log else np.zeros(0)
    is_one_sided = not yaw_rate.size or abs(float(yaw_rate.mean())) > 0.8 * float(
        np.abs(yaw_rate).mean()
    )
    early_speed, *_, late_speed = (
        nan_median(np.abs(part)) if np.isfinite(part).any() else 0.0
        for part in np.array_split(log["u"], 3)
    )
    is_braking = late_speed < _MAX_SPEED_RATIO_OF_BRAKING * early_speed
    # the bucket of a water jet reverses its thrust, not the direction of its propeller
    has_bucket = any("nozzle" in name for name in log)
    if is_braking or has_bucket or (len(opposing_propellers) < len(names) and is_one_sided):
        # propellers that run astern stop a vessel; in a turn one runs ahead and one astern
        opposing_propellers = []
    for name in opposing_propellers:
        text = f"{name} turns against the direction of motion"
        yield make_finding(text, repair=make_correction((name,), factor=-1.0))
    for name, t_statistic in (
        () if opposing_propellers else _find_reversed_propellers(log, names).items()
    ):
        text = f"more {name} decelerates the vessel ({t_statistic:.0f} standard errors)"
        yield make_finding(text, {"t": t_statistic}, repair=make_correction((name,), factor=-1.0))


_MAX_SPEED_RATIO_OF_BRAKING = 0.5
"""Largest ratio of the speeds in the last and the first third of a log that is a stop."""


def _find_reversed_propellers(log: LogStatistics, names: Sequence[str]) -> dict[str, float]:
    """Find propellers with a reversed sign by regression of the surge acceleration.

    All combinations of signs are compared by the residual of a fit with the sum of the thrusts,
    because the effects of single propellers are collinear when one runs ahead and one astern.

    Returns:
        Name of a reversed propeller -> absolute t statistic of the thrust.
    """
    blocks = log.cached(make_blocks, "u")
    u = log["u"]
    drift_terms = [log["v"] * log["r"], log["r"] ** 2] if "v" in log and "r" in log else []
    thrusts = np.stack([log[name] * np.abs(log[name]) for name in names], axis=-1)
    regressors = np.column_stack((np.ones(len(log)), u, u * np.abs(u), *drift_terms, thrusts))
    integrated_regressors = blocks.make_integrator(regressors)(0)
    velocity_changes = blocks.compute_changes(u)
    if (np.isfinite(integrated_regressors).all(axis=1) & np.isfinite(velocity_changes)).sum() < 40:
        return {}
    common_terms = integrated_regressors[:, : -len(names)]
    thrust_integrals = integrated_regressors[:, -len(names) :]
    sign_choices = [
        np.array((1.0, *other_signs))
        for other_signs in itertools.product((1.0, -1.0), repeat=len(names) - 1)
    ]
    fits = [
        fit_least_squares(
            np.column_stack((common_terms, thrust_integrals @ signs)), velocity_changes
        )
        for signs in sign_choices
    ]
    best_index = min(range(len(fits)), key=lambda i: fits[i].sum_of_squares)
    # other signs must reduce the residual clearly below that of the recorded signs
    best_index = best_index if fits[best_index].sum_of_squares < 0.6 * fits[0].sum_of_squares else 0
    signs = sign_choices[best_index]
    t_statistic = fits[best_index].t_statistic
    total_thrust = thrusts @ signs
    # the effect of an almost constant thrust is not identifiable
    relative_variation = nan_std(total_thrust) / max(abs_quantile(total_thrust, 1.0), 1e-12)
    if abs(t_statistic) < _MIN_T_STATISTIC or relative_variation < 0.2:
        return {}
    return {
        n: abs(t_statistic)
        for n, sign in zip(names, signs * np.sign(t_statistic), strict=True)
        if sign < 0.0
    }


@dataclass(frozen=True)
class NeutralRudderAngle:
    """Neutral rudder angle: the angle at which the vessel goes straight.

    Attributes:
        angle: neutral angle in rad.
        standard_error: standard error of the angle in rad.
        rudder_effect: coefficient of the rudder angle in the yaw model.
        rudder_effect_error: standard error of that coefficient.
    """

    angle: float
    standard_error: float
    rudder_effect: float
    rudder_effect_error: float


def estimate_neutral_angle(log: LogStatistics) -> NeutralRudderAngle | None:
    """Estimate the neutral angle of delta by a yaw model; None if it is not identifiable.

    Turns to one side only are extrapolated to a straight course, and identify no neutral angle.
    """
    yaw_fit = _fit_yaw_model(log)
    if yaw_fit is None or not MIN_TURN_SHARE < compute_port_share([log]) < 1.0 - MIN_TURN_SHARE:
        return None
    if not abs(yaw_fit.coefficients[1]) > 4.0 * yaw_fit.standard_errors[1]:
        return None
    moment, rudder_effect = (float(value) for value in yaw_fit.coefficients[:2])
    gradient = np.array([-1.0 / rudder_effect, moment / rudder_effect**2])
    standard_error = float(np.sqrt(max(gradient @ yaw_fit.covariance[:2, :2] @ gradient, 0.0)))
    return NeutralRudderAngle(
        -moment / rudder_effect, standard_error, rudder_effect, float(yaw_fit.standard_errors[1])
    )


def _yaw_regression_data(
    log: LogStatistics, *additional_angles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors [K, k] and response [K] of a yaw model that is linear in the rudder angle.

    The first two columns are the constant moment and the effect of the rudder, followed by one
    column for each of `additional_angles` [T], which act like the rudder angle.
    """
    blocks = log.cached(make_blocks, "r")
    u = log["u"]
    r = log["r"]
    v = log["v"] if "v" in log else np.zeros(len(log))
    flow_squared = u * np.abs(u)
    if "n" in log:
        propeller_race = log["n"] * np.abs(log["n"])
        flow_squared, propeller_race = (
            flow / max(float(np.nanmean(np.abs(flow))), 1e-9)
            for flow in (flow_squared, propeller_race)
        )
        flow_squared = flow_squared + propeller_race
    regressors = [
        flow_squared,
        flow_squared * log["delta"],
        *(flow_squared * angle for angle in additional_angles),
    ]
    regressors += [np.abs(u) * r, r * np.abs(r), np.abs(u) * v, v * np.abs(v)]
    if "wind_speed" in log and "wind_dir" in log:
        relative_wind_angle = log["wind_dir"] - (log["psi"] if "psi" in log else np.zeros(len(log)))
        regressors += [log["wind_speed"] ** 2 * np.sin(k * relative_wind_angle) for k in (1.0, 2.0)]
    return blocks.make_integrator(np.stack(regressors, axis=-1))(0), blocks.compute_changes(r)


def _fit_yaw_model(log: LogStatistics, *additional_angles: np.ndarray) -> LeastSquaresFit | None:
    """Fit the yaw model; None with missing channels, too few rows or a constant rudder."""
    if any(name not in log for name in ("delta", "u", "r")):
        return None
    yaw_fit = fit_least_squares(*_yaw_regression_data(log, *additional_angles))
    is_rudder_excited = log.std("delta") >= math.radians(1.0)
    return yaw_fit if yaw_fit.residuals.size >= 60 and is_rudder_excited else None


@check(
    "actuators",
    "rudder_bias",
    required_channels=("delta",),
    is_record_fault=True,
    on_subsample=True,
)
def check_rudder_bias(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a rudder with a large neutral angle or a reversed sign."""
    neutral = log.cached(estimate_neutral_angle) if "delta" in log.inputs else None
    if neutral is None:
        return
    if neutral.rudder_effect < -_MIN_T_STATISTIC * neutral.rudder_effect_error:
        text = "positive delta turns the vessel to port"
        yield make_finding(
            text,
            {"effect": neutral.rudder_effect},
            code="rudder_sign",
            fix=_REVERSE_SIGN_AND_CHECK_FIX,
        )
    # hulls and single propellers cause a neutral angle of about one degree; wind does not explain
    # more than 2.6 degrees
    elif abs(neutral.angle) > max(math.radians(2.6), _MIN_T_STATISTIC * neutral.standard_error):
        text = (
            f"the vessel goes straight at delta = {math.degrees(neutral.angle):+.1f} +-"
            f" {math.degrees(2.0 * neutral.standard_error):.1f} deg"
        )
        yield make_finding(
            text,
            {"angle": neutral.angle, "error": neutral.standard_error},
            fix="subtract the offset, or provide a steady wind or current as an input",
            repair=make_correction(("delta",), offset=-neutral.angle),
        )


_WIDER_RANGE_FIX = "log with a wider range, or exclude these parts"


_MIN_SHARE_AT_LIMIT = 0.03
"""Smallest share of the time at the limit of a record for a finding."""
_MIN_EFFECT_RATIO = 1.3
"""Smallest ratio of the actual yaw moment at the limit to that of the recorded angle."""
_MIN_T_STATISTIC_AT_LIMIT = 4.5
"""Smallest t statistic of their difference."""
_MIN_BLOCKS_AT_SMALLER_ANGLES = 10
"""Smallest number of overlapping blocks with a constant smaller angle for a comparison. A zigzag
has none: its smaller angles are those of a turning rudder, whose effect is extrapolated."""


@check(
    "actuators",
    "rudder_clipped",
    fix=_WIDER_RANGE_FIX,
    required_channels=("delta", "u", "r"),
    is_record_fault=True,
    on_subsample=True,
)
def check_rudder_clipping(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a clipped rudder record: at its limit the yaw moment exceeds the model.

    Nothing is reported of a rudder that does not rest at smaller angles.
    """
    rudder_limit = abs_quantile(log["delta"], 1.0)
    is_at_limit = np.abs(log["delta"]) > 0.999 * rudder_limit
    share_at_limit = float(is_at_limit.mean())
    n_visits = find_runs(is_at_limit)[0].size
    # several visits are needed, because a turning circle is at one angle throughout
    if (
        "delta" not in log.inputs
        or not _MIN_SHARE_AT_LIMIT < share_at_limit < 1.0 - _MIN_SHARE_AT_LIMIT
        or n_visits < 3
    ):
        return
    is_resting = _rests_at_smaller_angle(log, is_at_limit)
    if is_resting.sum() < _MIN_BLOCKS_AT_SMALLER_ANGLES:
        return
    yaw_fit = _fit_yaw_model(log, np.sign(log["delta"]) * is_at_limit)
    excess_statistic = 0.0
    if yaw_fit is not None:
        t_statistic = float(abs(yaw_fit.coefficients[2]) / yaw_fit.standard_errors[2])
        relative_effect = float(yaw_fit.coefficients[2] / (yaw_fit.coefficients[1] * rudder_limit))
        excess_statistic = (
            t_statistic
            if relative_effect > _MIN_EFFECT_RATIO - 1.0 and t_statistic > _MIN_T_STATISTIC_AT_LIMIT
            else 0.0
        )
    excess_statistic = max(
        excess_statistic,
        _excess_turning_at_limit(log, is_at_limit, is_resting) if n_visits >= 8 else 0.0,
    )
    if excess_statistic > 0.0:
        text = (
            f"at {math.degrees(rudder_limit):.1f} deg of delta the vessel turns faster than"
            f" predicted from smaller angles ({excess_statistic:.1f} times the residual): the"
            " record is clipped"
        )
        yield make_finding(text, {"limit": rudder_limit, "harder": excess_statistic})


def _rests_at_smaller_angle(log: LogStatistics, is_at_limit: np.ndarray) -> np.ndarray:
    """Return the blocks [K] bool away from the rudder limit with a constant angle other than zero.

    Args:
        log: statistics of the log.
        is_at_limit: samples at the recorded limit [T] bool.
    """
    blocks = log.cached(make_blocks, "r")
    values = log["delta"]
    max_angle = abs_quantile(values, 1.0)
    # the changes over a block and over its half exclude a rudder that returns to its first angle
    half_blocks = replace(blocks, length=blocks.length // 2)
    rudder_travel = np.abs(blocks.compute_changes(values))
    rudder_travel = rudder_travel + np.abs(half_blocks.compute_changes(values))
    return np.asarray(
        blocks.are_clear_of(is_at_limit)
        & (rudder_travel < 0.05 * max_angle)
        & (np.abs(values[blocks.starts]) > 0.15 * max_angle)
    )


def _excess_turning_at_limit(
    log: LogStatistics, is_at_limit: np.ndarray, is_resting: np.ndarray
) -> float:
    """Return the mean excess of the yaw acceleration at the rudder limit, over the RMS residual.

    The yaw model is fitted to the blocks away from the limit. The result is 0 if these contain too
    few constant smaller angles, or if the excess is not significant.

    Args:
        log: statistics of the log.
        is_at_limit: samples at the recorded limit [T] bool.
        is_resting: blocks with a constant smaller angle [K] bool.
    """
    blocks = log.cached(make_blocks, "r")
    initial_angles = log["delta"][blocks.starts]
    x, y = _yaw_regression_data(log)
    is_finite = np.isfinite(x).all(axis=1) & np.isfinite(y)
    is_inside_limit = is_finite & blocks.are_clear_of(~is_at_limit)
    is_outside_limit = is_finite & blocks.are_clear_of(is_at_limit)
    if is_inside_limit.sum() < 10 or (is_finite & is_resting).sum() < 20:
        return 0.0
    yaw_fit = fit_least_squares(x[is_outside_limit], y[is_outside_limit])
    rms_residual = max(float(np.sqrt(np.mean(yaw_fit.residuals**2))), 1e-300)
    limit_residuals = (y - x @ yaw_fit.coefficients)[is_inside_limit] * np.sign(
        initial_angles[is_inside_limit] * yaw_fit.coefficients[1]
    )
    excess = float(np.mean(limit_residuals)) / rms_residual
    return excess if excess > _MIN_T_STATISTIC_AT_LIMIT else 0.0


_MIN_SHIFT_IMPROVEMENT = 1.3
"""Smallest ratio of the residual sums of squares with unshifted and with shifted inputs."""
_MIN_STEERING_IMPROVEMENT = 1.2
"""Smallest ratio of the residual sums of squares without and with the steering inputs."""


@check("inputs", "rudder_sign", required_channels=("r",), is_record_fault=True, on_subsample=True)
def check_rudder_sign(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the sign of the steering response; a rudder to starboard must turn to starboard."""
    name, steering = _find_steering(log)
    if not name or np.isfinite(log["r"]).sum() < 2 * MIN_SAMPLES:
        return
    is_finite = np.isfinite(log["r"]) & np.isfinite(steering)
    r = log.smoothed("r")[is_finite]
    steering_values = steering[is_finite]
    if is_finite.sum() >= 2 * MIN_SAMPLES and float(np.abs(r).mean()) >= 6.0 * log.noise_std("r"):
        is_one_sided = all(
            abs(signal.sum()) > 0.95 * np.abs(signal).sum() for signal in (r, steering_values)
        )
        # in a turning circle the yaw rate falls with the speed, so only its sign is evaluated
        if is_one_sided and float(r.sum()) * float(steering_values.sum()) < 0.0:
            text = f"{name} is always on one side and the vessel turns to the other side"
            yield make_finding(text, fix=_REVERSE_SIGN_AND_CHECK_FIX)
        elif is_one_sided:
            text = f"{name} is always on one side and the vessel turns to this side"
            yield make_finding(text, level="note", fix="")
        if is_one_sided:
            return
    # the rudder force is proportional to the square of the inflow speed
    flow_speed = np.ones(len(log))
    if "delta" in name and "u" in log:
        flow_speed = np.abs(log.smoothed("u"))
        is_finite = is_finite & np.isfinite(log["u"])
    sum_of_squares_without_steering, fits_by_shift = _fit_steering_responses(
        log, steering, flow_speed, is_finite
    )
    if not fits_by_shift:
        return
    unshifted_fit = fits_by_shift[0]
    best_shift = min(fits_by_shift, key=lambda shift: fits_by_shift[shift].sum_of_squares)
    unshifted_t_statistic = unshifted_fit.t_statistic
    shifted_t_statistic = fits_by_shift[best_shift].t_statistic
    # the shifted fit counts if it is more significant and has the same sign
    is_consistent = (
        unshifted_t_statistic * shifted_t_statistic > 0.0
        and abs(unshifted_t_statistic) > 0.5 * _MIN_T_STATISTIC
    )
    t_statistic = (
        shifted_t_statistic
        if is_consistent and abs(shifted_t_statistic) > abs(unshifted_t_statistic)
        else unshifted_t_statistic
    )
    improvement = unshifted_fit.sum_of_squares / max(
        fits_by_shift[best_shift].sum_of_squares, 1e-300
    )
    is_identifiable = sum_of_squares_without_steering / max(
        unshifted_fit.sum_of_squares, 1e-300
    ) > _MIN_STEERING_IMPROVEMENT and (
        improvement < _MIN_SHIFT_IMPROVEMENT or shifted_t_statistic < 0.0
    )
    effect = float(unshifted_fit.coefficients[-1] * np.nanmean(flow_speed**2))
    figures = {
        "effect": effect,
        "t": unshifted_t_statistic,
        "lag": best_shift * log.sampling_interval,
        "better": improvement,
    }
    coarse_sign = _estimate_coarse_steering_sign(log, steering, max(best_shift, 0))
    t_statistic = t_statistic if t_statistic * coarse_sign >= 0.0 else 0.0
    if t_statistic < -_MIN_T_STATISTIC and is_identifiable:
        text = (
            f"positive {name} turns the vessel to port (yaw acceleration {effect:.3g} per unit,"
            f" {-t_statistic:.0f} standard errors)"
        )
        exchange_fix = "exchange the columns of both sides, or check the sign of r and psi"
        yield make_finding(
            text, figures, fix=_REVERSE_SIGN_AND_CHECK_FIX if name in log else exchange_fix
        )
    elif t_statistic > _MIN_T_STATISTIC:
        text = f"positive {name} turns the vessel to starboard ({t_statistic:.0f} standard errors)"
        yield make_finding(text, figures, level="note", fix="")


_MIN_COARSE_INTERVAL = 0.25
"""Sampling interval in s from which the smoother spans several time constants of a small boat."""
_MIN_STEERING_CORRELATION = 0.6
"""Correlation of yaw rate and steering that determines the sign; chosen by hand.

It is .8 to .97 in 12 coarsely sampled logs of a boat with random steps of the rudder.
"""


def _estimate_coarse_steering_sign(log: LogStatistics, steering: np.ndarray, delay: int) -> float:
    """Return the sign of the steering effect in a coarsely sampled log; 0 if not identifiable.

    Over blocks that are longer than the response the yaw rate is proportional to the steering. A
    regression on both then does not identify the sign, whereas their correlation does.

    Args:
        log: statistics of a log with r.
        steering: steering channel [T].
        delay: largest delay of the response in samples.
    """
    r = log.smoothed("r")
    smoothed_steering = smooth_by_parabola(log.t, steering)
    if log.sampling_interval < _MIN_COARSE_INTERVAL or nan_std(smoothed_steering) <= 0.0:
        return 0.0
    correlations = [
        float(np.corrcoef(r[shift:], smoothed_steering[: r.size - shift])[0, 1])
        for shift in range(min(delay, r.size // 8) + 1)
    ]
    correlation = max(correlations, key=abs)
    return float(np.sign(correlation)) if abs(correlation) > _MIN_STEERING_CORRELATION else 0.0


def _find_steering(log: LogStatistics) -> tuple[str, np.ndarray]:
    """Return name and values [T] of the steering, positive to starboard; empty name if unknown."""
    for name in STEERING_CHANNELS[:4]:
        if name in log and log.std(name) > 1e-9:
            return name, log[name]
    for port_name, starboard_name in port_starboard_pairs(log).items():
        if log.units[port_name] != "rad":
            steering = log[port_name] * np.abs(log[port_name]) - log[starboard_name] * np.abs(
                log[starboard_name]
            )
            if nan_std(steering) > 1e-9:
                return f"{port_name} less {starboard_name}", steering
    return "", np.zeros(0)


_MIN_STEERING_VARIATION = 0.02
"""Relative standard deviation below which a rudder counts as constant.

24 helices of a torpedo have at most 1.6 %, its zigzags and random steps at least 46 %.
"""
_MAX_BLOCKS = 10_000
"""Largest number of blocks for the steering response: more only overlap."""


def _fit_steering_responses(
    log: LogStatistics, steering: np.ndarray, flow: np.ndarray, is_known: np.ndarray
) -> tuple[float, dict[int, LeastSquaresFit]]:
    """Fit a yaw model without steering, with steering, and with steering shifted in time.

    The change of r over blocks of about one second is regressed on the integrals of U^2, U r, r|r|,
    U v, v|v| and U^2 times the steering.

    Args:
        log: statistics of a log with r.
        steering: steering channel [T].
        flow: inflow speed U [T]; 1 if the steering does not depend on it.
        is_known: valid samples [T] bool.

    Returns:
        Sum of squares without steering, and shift in samples -> fit for no shift and for the best
        shift; empty if the response is not identifiable.
    """
    r = log.smoothed("r")
    block_length = max(round(1.0 / log.sampling_interval), SMOOTHING_SAMPLES)
    lower, upper = nan_quantiles(log["r"], 0.05, 0.95)
    v = np.zeros(len(log))
    if "v" in log and np.isfinite(log["v"]).sum() > 2 * MIN_SAMPLES:
        v = log.smoothed("v")
    # shifts are limited to the first zero of the autocorrelation of the yaw rate
    power_spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * r.size)) ** 2
    autocorrelation = np.append(np.fft.irfft(power_spectrum)[: r.size], -1.0)
    max_shift = max(
        min(
            int(np.argmax(autocorrelation < 0.0)), r.size // 8, round(30.0 / log.sampling_interval)
        ),
        3,
    )
    is_gap = (
        ~is_known
        | (np.append(np.diff(log.t), log.sampling_interval) > 3.0 * log.sampling_interval)
        | log.near_seam(max_shift + block_length)
    )
    n_margin_samples = max_shift + SMOOTHING_SAMPLES
    stride = max(round(0.2 / log.sampling_interval), len(log) // _MAX_BLOCKS, 1)
    block_starts = np.arange(n_margin_samples, len(log) - n_margin_samples - block_length, stride)
    blocks = OverlappingBlocks(log.t, block_starts, block_length)
    blocks = replace(blocks, starts=block_starts[blocks.are_clear_of(is_gap)])
    if blocks.starts.size < MIN_SAMPLES or upper - lower < 4.0 * log.noise_std("r"):
        return 0.0, {}
    regressors = np.stack((flow**2, flow * r, r * np.abs(r), flow * v, v * np.abs(v)), axis=-1)
    integrated_terms = blocks.make_integrator(regressors)(0)
    y = blocks.compute_changes(r)
    steering_integrals = blocks.make_integrator((flow**2 * np.nan_to_num(steering))[:, None])
    candidate_shifts = sorted(
        {round(float(shift)) for shift in np.linspace(-max_shift, max_shift, 61)}
    )
    is_finite = np.isfinite(integrated_terms).all(axis=1) & np.isfinite(y)
    # with a constant rudder in a steady turn, only shifted steps at its start would correlate
    mean_steering = steering_integrals(0)[is_finite, 0] / np.maximum(
        integrated_terms[is_finite, 0], 1e-300
    )
    if (
        is_finite.sum() < MIN_SAMPLES
        or mean_steering.std() < _MIN_STEERING_VARIATION * np.abs(mean_steering).mean()
    ):
        return 0.0, {}
    column_norms = np.maximum(np.linalg.norm(integrated_terms[is_finite], axis=0), 1e-300)
    left_singular_vectors, singular_values, _ = np.linalg.svd(
        integrated_terms[is_finite] / column_norms, full_matrices=False
    )
    left_singular_vectors = left_singular_vectors[:, singular_values > 1e-5 * singular_values[0]]
    # partial regression: both sides are orthogonalised to the other terms
    shifted_steering = steering_integrals(candidate_shifts)[is_finite][..., 0]
    residual_response, residual_steering = (
        signal - left_singular_vectors @ (left_singular_vectors.T @ signal)
        for signal in (y[is_finite], shifted_steering)
    )
    explained_squares = (residual_response @ residual_steering) ** 2 / np.maximum(
        (residual_steering**2).sum(axis=0), 1e-300
    )
    best_shift = candidate_shifts[int(np.argmax(explained_squares))]
    fits_by_shift = {
        s: fit_least_squares(np.column_stack((integrated_terms, steering_integrals(s))), y)
        for s in sorted({0, best_shift})
    }
    return fit_least_squares(integrated_terms, y).sum_of_squares, fits_by_shift


# a response earlier than this in s is not an inaccuracy
MIN_LEAD_TIME = 0.45
# number of minima that are refined
_N_MINIMA = 4
# ratio to the smallest sum of squares up to which fits are equivalent
_MAX_EQUIVALENT_RATIO = 1.15
_N_SHIFTS_PER_SIDE = 12
"""Coarse shifts to either side; chosen by hand, because each costs a fit."""


@dataclass(frozen=True)
class ResponseDelay:
    """Delay between an input and the response of a velocity.

    Attributes:
        delay: delay in s; negative if the response precedes the input.
        standard_error: standard error of the delay in s.
        improvement: residual sum of squares without the shift over that with it.
        causal_ratio: residual sum of squares of the best shift with which the response does not
            precede the input, over that of the best shift of all.
    """

    delay: float
    standard_error: float
    improvement: float
    causal_ratio: float


def estimate_delays(
    log: LogStatistics,
) -> dict[tuple[str, str], tuple[tuple[str, ...], ResponseDelay]]:
    """Estimate the delays of the first steering channel and of all propellers together.

    Returns:
        (names of the channels, responding velocity) -> the channels and their delay.
    """
    input_groups: list[tuple[tuple[str, ...], str]] = []
    rudder_name = next((name for name in STEERING_CHANNELS if name in log.inputs), "")
    propeller_names = tuple(
        name for name in log.cached(find_propellers) if not name.startswith("cmd_")
    )
    input_groups += [((rudder_name,), "r")] if rudder_name else []
    input_groups += (
        [(propeller_names, "u" if len(propeller_names) == 1 else "r")] if propeller_names else []
    )
    delays_by_input = {}
    for names, velocity in input_groups:
        is_excited = all(log.std(n) > 0.02 * np.nanmax(np.abs(log[n])) for n in names)
        delay = estimate_delay(log, names, velocity) if velocity in log and is_excited else None
        if delay is not None:
            delays_by_input[", ".join(names), velocity] = names, delay
    return delays_by_input


def _find_local_minima(sum_of_squares_by_shift: Mapping[int, float]) -> list[int]:
    """Return the shifts of the local minima among the evaluated shifts, the lowest first."""
    shifts = sorted(sum_of_squares_by_shift)
    sums_of_squares = np.array([sum_of_squares_by_shift[shift] for shift in shifts])
    padded = np.concatenate(([np.inf], sums_of_squares, [np.inf]))
    minimum_indices = np.flatnonzero(
        (sums_of_squares <= padded[:-2]) & (sums_of_squares <= padded[2:])
    )
    return [shifts[i] for i in minimum_indices[np.argsort(sums_of_squares[minimum_indices])]]


def _choose_shift(
    sum_of_squares_by_shift: Mapping[int, float], min_sum_of_squares: float, step: float
) -> int:
    """Return the smallest causal shift among the minima that are as low as the lowest one.

    A periodic input, as in a zigzag, fits equally well half a period away.
    """
    equivalent_shifts = [
        shift
        for shift in _find_local_minima(sum_of_squares_by_shift)
        if sum_of_squares_by_shift[shift] <= _MAX_EQUIVALENT_RATIO * min_sum_of_squares
    ]
    return min(equivalent_shifts, key=lambda shift: (-shift * step > MIN_LEAD_TIME, abs(shift)))


def _estimate_shift_error(
    squared_residuals_by_shift: Mapping[int, np.ndarray], is_finite: np.ndarray, step: float
) -> float:
    """Return the standard error of a delay in s, from the best shifts of sections of the log.

    Args:
        squared_residuals_by_shift: squared residuals [K] of the fit with each shift.
        is_finite: blocks [K] that are used.
        step: sampling interval in s.
    """
    delays = np.array([*squared_residuals_by_shift]) * step
    squared_residuals = np.array([*squared_residuals_by_shift.values()])
    sections = np.array_split(np.flatnonzero(is_finite), N_SECTIONS // 2)
    best_delays = [
        delays[np.argmin(np.nan_to_num(squared_residuals[:, section].sum(axis=1), nan=np.inf))]
        for section in sections
    ]
    scatter = SIGMA_OF_MAD * float(
        np.median(np.abs(np.array(best_delays) - np.median(best_delays)))
    )
    return float(max(1.5 * scatter / np.sqrt(len(sections)), 0.25 * step))


def _fit_residuals(x: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals of S least-squares fits.

    Args:
        x: regressors [S, K, n]; NaN where unknown.
        target: target of all fits [K]; NaN where unknown.

    Returns:
        Residuals [S, K], zero in rows with unknown values, and whether a row is known [S, K].
    """
    is_finite = np.isfinite(x).all(axis=2) & np.isfinite(target)
    regressors = np.where(is_finite[..., None], x, 0.0)
    known_target = np.where(is_finite, target, 0.0)[..., None]
    # columns of unit length make the small ridge relative; it keeps collinear terms solvable
    regressors /= np.maximum(np.linalg.norm(regressors, axis=1, keepdims=True), 1e-300)
    transposed = regressors.transpose(0, 2, 1)
    gram = transposed @ regressors + 1e-9 * np.eye(regressors.shape[2])
    solution = np.linalg.solve(gram, transposed @ known_target)
    return (known_target - regressors @ solution)[..., 0], is_finite


def estimate_delay(log: LogStatistics, names: Sequence[str], velocity: str) -> ResponseDelay | None:
    """Estimate the delay of inputs by the time shift with the smallest one-step residual.

    Args:
        log: statistics of the log.
        names: input channels that are shifted together.
        velocity: velocity that responds.

    Returns:
        None if the log is too short or the best shift is at the end of the range.
    """
    # blocks that remain within the log for every shift, without a seam of two stretches
    step = log.sampling_interval
    blocks = log.cached(make_blocks, velocity)
    max_shift = max(2 * blocks.length, round(3.0 / step))
    if len(log) < max(20 * blocks.length, 6 * max_shift):
        return None
    block_starts = blocks.starts
    is_inside = (block_starts >= max_shift) & (block_starts + blocks.length + max_shift < len(log))
    blocks = replace(
        blocks, starts=block_starts[is_inside & blocks.are_clear_of(log.near_seam(max_shift))]
    )
    other_inputs = [
        name for name in log if name in ("n", "delta", "wind_speed") and name not in names
    ]
    velocity_changes = blocks.compute_changes(log[velocity])
    # shift -> squared residuals [K] of the fit with shifted inputs (NaN if unknown), and their sum
    squared_residuals_by_shift: dict[int, np.ndarray] = {}
    sum_of_squares_by_shift: dict[int, float] = {}
    # the inflow of the rudder falls in a turn: without the product of both the response seems early
    velocity_columns = {name: log[name][:, None] for name in log.velocities}
    driving_inputs = [name for name in (*other_inputs, *names) if log.std(name) > 0.0]
    is_linear = len(driving_inputs) > 4

    def make_shifted_terms(
        input_names: Sequence[str], shifts: Sequence[int] | np.ndarray
    ) -> list[np.ndarray]:
        """Return input terms [T, S], one column for each shift in samples."""
        shifted_indices = np.arange(len(log))[:, None] - np.array(shifts)
        inputs = [
            np.take(log[name], shifted_indices, mode="wrap")
            for name in driving_inputs
            if name in input_names
        ]
        return make_input_terms(inputs, velocity_columns.get("u"), is_linear=is_linear)

    def integrate_columns(columns: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([blocks.make_integrator(column)(0) for column in columns], axis=-1)

    fixed_terms = integrate_columns(
        [
            np.ones((len(log), 1)),
            *make_velocity_terms(velocity_columns),
            *make_shifted_terms(other_inputs, [0]),
        ]
    )

    def evaluate_shifts(candidate_shifts: Iterable[int]) -> None:
        new_shifts = [
            k
            for k in dict.fromkeys(candidate_shifts)
            if k not in squared_residuals_by_shift and abs(k) <= max_shift
        ]
        shift_batches = (
            np.array_split(new_shifts, -(-len(new_shifts) * len(log) // CHUNK_SAMPLES))
            if new_shifts
            else ()
        )
        for shift_batch in shift_batches:
            shifted_terms = integrate_columns(make_shifted_terms(names, shift_batch))
            x = np.concatenate(
                (fixed_terms.repeat(shift_batch.size, axis=1), shifted_terms), axis=2
            ).transpose(1, 0, 2)
            residuals, is_finite = _fit_residuals(x, velocity_changes)
            squared_residuals_by_shift.update(
                zip(shift_batch.tolist(), np.where(is_finite, residuals**2, np.nan), strict=True)
            )
            sum_of_squares_by_shift.update(
                zip(shift_batch.tolist(), (residuals**2).sum(axis=1).tolist(), strict=True)
            )

    # a coarse grid over the range, then a fine grid around its best local minima
    evaluate_shifts(
        round(k * max_shift / _N_SHIFTS_PER_SIDE)
        for k in range(-_N_SHIFTS_PER_SIDE, _N_SHIFTS_PER_SIDE + 1)
    )
    coarse_spacing = max(round(max_shift / _N_SHIFTS_PER_SIDE), 1)
    evaluate_shifts(
        min_shift + round(k * coarse_spacing / 6)
        for min_shift in _find_local_minima(sum_of_squares_by_shift)[:_N_MINIMA]
        for k in range(-6, 7)
    )
    min_sum_of_squares = max(min(sum_of_squares_by_shift.values()), 1e-300)
    best_shift = _choose_shift(sum_of_squares_by_shift, min_sum_of_squares, step)
    is_finite = np.isfinite(squared_residuals_by_shift[best_shift]) & np.isfinite(
        squared_residuals_by_shift[0]
    )
    if abs(best_shift) >= max_shift - coarse_spacing or is_finite.sum() < 5 * (
        fixed_terms.shape[2] + len(make_shifted_terms(names, [0]))
    ):
        return None
    standard_error = _estimate_shift_error(squared_residuals_by_shift, is_finite, step)
    best_sum_of_squares = max(
        float(squared_residuals_by_shift[best_shift][is_finite].sum()), 1e-300
    )
    # a large ratio is evidence that the response precedes the input: no causal shift fits as well
    causal_ratio = (
        min(
            value
            for shift, value in sum_of_squares_by_shift.items()
            if -shift * step <= MIN_LEAD_TIME
        )
        / min_sum_of_squares
    )
    return ResponseDelay(
        best_shift * step,
        standard_error,
        float(squared_residuals_by_shift[0][is_finite].sum()) / best_sum_of_squares,
        causal_ratio,
    )


@check(
    "actuators",
    "acausal",
    fix="the clocks of inputs and motion differ: shift one of them",
    is_record_fault=True,
    on_subsample=True,
)
def check_acausal_response(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report inputs whose response precedes them.

    A response cannot precede its input. A late response may be due to the actuators, but the delay
    must then be the same in all logs of one vessel (`between`).
    """
    for (channels, velocity), (names, delay) in log.cached(estimate_delays).items():
        lead_time = -delay.delay
        is_significant = delay.improvement > 1.35 and delay.causal_ratio > _MAX_EQUIVALENT_RATIO
        if is_significant and lead_time > max(
            MIN_LEAD_TIME, 1.5 * log.sampling_interval, 3.0 * delay.standard_error
        ):
            text = (
                f"{velocity} responds {lead_time:.2f} +- {2.0 * delay.standard_error:.2f} s before"
                f" {channels} (the residual sum of squares is {delay.improvement:.1f} times smaller"
                " with a shifted input)"
            )
            figures = {
                "lag": delay.delay,
                "error": delay.standard_error,
                "better": delay.improvement,
            }
            yield make_finding(text, figures, repair=make_correction(names, delay=lead_time))
