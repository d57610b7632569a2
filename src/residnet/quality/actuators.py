"""Checks of propellers, rudders and the clock of the inputs against the motion.

One regression of yaw and one of surge (`ResponseModel`) answer the questions about signs, the
neutral rudder angle and the clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from residnet.core.names import port_starboard_pairs
from residnet.preprocessing.channel_values import nan_median, nan_std
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.findings import Check, Finding, check
from residnet.quality.statistics import (
    MIN_TURN_SHARE,
    STEERING_CHANNELS,
    LeastSquaresFit,
    LogStatistics,
    abs_quantile,
    compute_port_share,
    fit_least_squares,
    interpolate_gaps,
    make_blocks,
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
    steering_share = _steering_share(log, names) if "r" in log and names else 0.0
    turn_ratio = np.inf
    if steering_share > _MIN_STEERING_SHARE:
        # the fastest propeller counts, because one of several may be almost stopped
        max_revolutions = max(abs_quantile(log[name]) for name in names)
        turn_ratio = abs_quantile(log["r"]) / min(steering_share, 1.0) / max(max_revolutions, 1e-12)
    for name in names:
        revolutions = abs_quantile(log[name])
        is_out_of_proportion = revolutions > 20.0 and turn_ratio < _MIN_TURN_RATIO
        if revolutions > _MAX_REVOLUTIONS or is_out_of_proportion:
            text = (
                f"{name} reaches {revolutions:.4g} 1/s, more than any propeller or out of"
                " proportion to the yaw rate: rpm taken as 1/s?"
            )
            yield make_finding(text, {"largest": revolutions})


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
        yield make_finding(text)
    surge_model = None if opposing_propellers else log.cached(_fit_surge_model)
    t_statistic = surge_model.fit().t_statistic if surge_model is not None else 0.0
    if t_statistic < -_MIN_T_STATISTIC:
        text = (
            f"more {', '.join(names)} decelerates the vessel ({-t_statistic:.0f} standard errors)"
        )
        yield make_finding(text, {"t": -t_statistic})


_MAX_SPEED_RATIO_OF_BRAKING = 0.5
"""Largest ratio of the speeds in the last and the first third of a log that is a stop."""


@dataclass(frozen=True)
class ResponseModel:
    """Regression of the changes of a velocity over K blocks on terms of the hull and on one input.

    Attributes:
        names: channels of the input.
        terms: integrals of the terms of the hull over the blocks [K, k].
        inputs: integrals of the effect of the input [K, S], one column for each shift.
        changes: changes of the velocity [K].
        travel: integrals of the velocity [K].
        shifts: times in s by which the input is delayed, increasing and symmetric about zero [S].
    """

    names: tuple[str, ...]
    terms: np.ndarray
    inputs: np.ndarray
    changes: np.ndarray
    travel: np.ndarray
    shifts: np.ndarray

    @cached_property
    def sums_of_squares(self) -> np.ndarray:
        """Residual sum of squares with each shift [S], by partial regression."""
        responses = np.column_stack((self.changes, self.inputs))
        norms = np.maximum(np.linalg.norm(self.terms, axis=0), 1e-300)
        coefficients = np.linalg.lstsq(self.terms / norms, responses, rcond=1e-5)[0]
        residuals = responses - self.terms / norms @ coefficients
        change = residuals[:, 0]
        effects = residuals[:, 1:]
        explained = (change @ effects) ** 2 / np.maximum((effects**2).sum(axis=0), 1e-300)
        return np.asarray(np.maximum(change @ change - explained, 1e-300))

    def best_delay(self, min_delay: float = -np.inf) -> float:
        """Return the delay in s with the smallest residual, among those of at least `min_delay`."""
        is_allowed = self.shifts >= min_delay
        return float(self.shifts[np.argmin(np.where(is_allowed, self.sums_of_squares, np.inf))])

    def sum_of_squares(self, delay: float) -> float:
        """Return the residual sum of squares with an input that is delayed by `delay` s."""
        return float(self.sums_of_squares[np.argmin(np.abs(self.shifts - delay))])

    def fit(self, delay: float = 0.0) -> LeastSquaresFit:
        """Fit the model with an input that is delayed by `delay` s; it is the last column."""
        return fit_least_squares(np.column_stack((self.terms, self._input(delay))), self.changes)

    def fit_travel(self, delay: float = 0.0) -> LeastSquaresFit:
        """Fit the integral of the velocity; the last column is the steady effect of the input.

        Over blocks that are longer than the response (K of Nomoto's model), the velocity is
        proportional to the input, and `fit` cannot separate both.
        """
        regressors = (self.terms[:, 0], self.changes, self._input(delay))
        return fit_least_squares(np.column_stack(regressors), self.travel)

    def _input(self, delay: float) -> np.ndarray:
        return self.inputs[:, np.argmin(np.abs(self.shifts - delay))]


_N_SHIFTS = 61
"""Number of shifts of the input; chosen by hand, their cost is small."""
_MAX_SHIFT = 30.0
"""Largest shift of an input in s."""
_MIN_INPUT_VARIATION = 0.02
"""Relative standard deviation below which an input counts as constant.

24 helices of a torpedo have at most 1.6 %, its zigzags and random steps at least 46 %.
"""
_MIN_ROWS = 60
"""Smallest number of blocks of a regression."""


def _make_response_model(
    log: LogStatistics,
    velocity: str,
    names: tuple[str, ...],
    hull_terms: Sequence[np.ndarray],
    effect: np.ndarray,
) -> ResponseModel | None:
    """Return the model of a velocity; None if the input is constant or the log too short.

    Args:
        log: statistics of the log.
        velocity: velocity that responds.
        names: channels of the input.
        hull_terms: terms without the input [T] each.
        effect: effect of the input [T].
    """
    # half a period away a periodic input fits equally well: shifts end where the velocity is
    # uncorrelated with itself
    values = interpolate_gaps(log.t, log[velocity])
    power_spectrum = np.abs(np.fft.rfft(values - values.mean(), 2 * values.size)) ** 2
    autocorrelation = np.append(np.fft.irfft(power_spectrum)[: values.size], -1.0)
    first_zero = int(np.argmax(autocorrelation < 0.0))
    largest_shift = min(first_zero, len(log) // 16, round(_MAX_SHIFT / log.sampling_interval))
    largest_shift = max(largest_shift, 3)
    blocks = log.cached(make_blocks, velocity)
    starts = blocks.starts
    is_inside = (starts >= largest_shift) & (starts + blocks.length + largest_shift < len(log))
    is_inside &= blocks.are_clear_of(log.near_seam(largest_shift))
    blocks = replace(blocks, starts=starts[is_inside])
    shifts = np.unique(np.linspace(-largest_shift, largest_shift, _N_SHIFTS).round().astype(int))
    terms = blocks.make_integrator(np.stack(hull_terms, axis=-1))(0)
    inputs = blocks.make_integrator(interpolate_gaps(log.t, effect))(shifts)
    changes = blocks.compute_changes(log[velocity])
    is_finite = np.isfinite(terms).all(axis=1) & np.isfinite(changes)
    variation = nan_std(effect) / max(float(np.nanmean(np.abs(effect))), 1e-300)
    if is_finite.sum() < _MIN_ROWS or not variation > _MIN_INPUT_VARIATION:
        return None
    return ResponseModel(
        names,
        terms[is_finite],
        inputs[is_finite],
        changes[is_finite],
        blocks.make_integrator(log[velocity])(0)[is_finite],
        shifts * log.sampling_interval,
    )


def _fit_surge_model(log: LogStatistics) -> ResponseModel | None:
    """Return the model of u with the sum of the thrusts; None without propellers or u."""
    names = log.cached(find_propellers)
    if "u" not in log or not names:
        return None
    u = log["u"]
    thrust = np.sum([log[name] * np.abs(log[name]) for name in names], axis=0)
    # the effect of an almost constant thrust is not identifiable
    if nan_std(thrust) < 0.2 * abs_quantile(thrust, 1.0):
        return None
    drift_terms = [log["v"] * log["r"], log["r"] ** 2] if "v" in log and "r" in log else []
    hull_terms = [np.ones(len(log)), u, u * np.abs(u), *drift_terms]
    return _make_response_model(log, "u", tuple(names), hull_terms, thrust)


def _find_steering(log: LogStatistics) -> tuple[tuple[str, ...], np.ndarray]:
    """Return channels and values [T] of the steering, positive to starboard; no names if unknown.

    The steering of two propellers is the difference of their thrusts.
    """
    for name in STEERING_CHANNELS[:4]:
        if name in log and log.std(name) > 1e-9:
            return (name,), log[name]
    for names in port_starboard_pairs(log).items():
        if log.units[names[0]] != "rad":
            port, starboard = (log[name] * np.abs(log[name]) for name in names)
            if nan_std(port - starboard) > 1e-9:
                return names, port - starboard
    return (), np.zeros(0)


def _rudder_flow(log: LogStatistics, names: tuple[str, ...]) -> np.ndarray:
    """Return the squared inflow speed [T] of the steering; 1 without a rudder or a speed.

    In the race of a propeller it is the sum of the squared speed and n^2, both relative to their
    means.
    """
    if "u" not in log or "delta" not in names[0]:
        return np.ones(len(log))
    speed_squared = np.asarray(log["u"] * np.abs(log["u"]))
    if "n" not in log:
        return speed_squared
    flows = (speed_squared, log["n"] * np.abs(log["n"]))
    relative_flows = [flow / max(float(np.nanmean(np.abs(flow))), 1e-9) for flow in flows]
    return np.asarray(sum(relative_flows))


def _fit_yaw_model(log: LogStatistics) -> ResponseModel | None:
    """Return the model of r with the steering; None without both.

    The first column is the constant moment, and the last one the effect of the steering.
    """
    names, steering = _find_steering(log)
    if not names or "r" not in log:
        return None
    flow_squared = _rudder_flow(log, names)
    r = log["r"]
    speed = np.abs(log["u"]) if "u" in log else np.ones(len(log))
    hull_terms = [flow_squared, r, speed * r, r * np.abs(r)]
    if "v" in log:
        hull_terms += [log["v"], speed * log["v"], log["v"] * np.abs(log["v"])]
    if "wind_speed" in log and "wind_dir" in log:
        wind_angle = log["wind_dir"]
        if "psi" in log:
            wind_angle = wind_angle - log["psi"]
        hull_terms += [log["wind_speed"] ** 2 * np.sin(k * wind_angle) for k in (1.0, 2.0)]
    return _make_response_model(log, "r", names, hull_terms, flow_squared * steering)


class NeutralRudderAngle(NamedTuple):
    """Neutral rudder angle: the angle at which the vessel goes straight.

    Attributes:
        angle: neutral angle in rad.
        standard_error: standard error of the angle in rad.
    """

    angle: float
    standard_error: float


def estimate_neutral_angle(log: LogStatistics) -> NeutralRudderAngle | None:
    """Estimate the neutral angle of delta by a yaw model; None if it is not identifiable.

    Turns to one side only are extrapolated to a straight course, and identify no neutral angle.
    """
    model = log.cached(_fit_yaw_model)
    if model is None or model.names != ("delta",) or "u" not in log:
        return None
    if not MIN_TURN_SHARE < compute_port_share([log]) < 1.0 - MIN_TURN_SHARE:
        return None
    fit = model.fit()
    if log.std("delta") < math.radians(1.0) or not fit.t_statistic > 4.0:
        return None
    moment = float(fit.coefficients[0])
    effect = float(fit.coefficients[-1])
    gradient = np.array([-1.0 / effect, moment / effect**2])
    covariance = fit.covariance[np.ix_((0, -1), (0, -1))]
    standard_error = float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
    return NeutralRudderAngle(-moment / effect, standard_error)


@check(
    "actuators",
    "rudder_bias",
    required_channels=("delta",),
    is_record_fault=True,
    on_subsample=True,
)
def check_rudder_bias(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report a rudder with a large neutral angle."""
    neutral = log.cached(estimate_neutral_angle) if "delta" in log.inputs else None
    # hulls and single propellers cause a neutral angle of about one degree; wind does not explain
    # more than 2.6 degrees
    if neutral is not None and abs(neutral.angle) > max(
        math.radians(2.6), _MIN_T_STATISTIC * neutral.standard_error
    ):
        text = (
            f"the vessel goes straight at delta = {math.degrees(neutral.angle):+.1f} +-"
            f" {math.degrees(2.0 * neutral.standard_error):.1f} deg"
        )
        yield make_finding(
            text,
            {"angle": neutral.angle, "error": neutral.standard_error},
            fix="subtract the offset, or provide a steady wind or current as an input",
        )


_MIN_STEADY_STATISTIC = 3.0
"""t statistic of the steady yaw rate that confirms a sign."""
_MIN_STEERING_IMPROVEMENT = 1.2
"""Smallest ratio of the residual sums of squares without and with the steering inputs."""


@check("inputs", "rudder_sign", required_channels=("r",), is_record_fault=True, on_subsample=True)
def check_rudder_sign(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report the sign of the steering response; a rudder to starboard must turn to starboard."""
    names, steering = _find_steering(log)
    is_finite = np.isfinite(log["r"])
    if not names or is_finite.sum() < 2 * MIN_SAMPLES:
        return
    name = " less ".join(names)
    exchange_fix = "exchange the columns of both sides, or check the sign of r and psi"
    reversal_fix = _REVERSE_SIGN_AND_CHECK_FIX if len(names) == 1 else exchange_fix
    is_finite &= np.isfinite(steering)
    r = log.smoothed("r")[is_finite]
    steering_values = steering[is_finite]
    is_one_sided = all(
        abs(signal.sum()) > 0.95 * np.abs(signal).sum() for signal in (r, steering_values)
    )
    if is_one_sided and float(np.abs(r).mean()) >= 6.0 * log.noise_std("r"):
        # in a turning circle the yaw rate falls with the speed, so only its sign is evaluated
        is_reversed = float(r.sum()) * float(steering_values.sum()) < 0.0
        side = "to the other side" if is_reversed else "to this side"
        text = f"{name} is always on one side and the vessel turns {side}"
        figures = {}
    else:
        model = log.cached(_fit_yaw_model)
        if model is None:
            return
        delay = model.best_delay()
        fit = model.fit(delay)
        without_steering = fit_least_squares(model.terms, model.changes).sum_of_squares
        is_identifiable = without_steering > _MIN_STEERING_IMPROVEMENT * fit.sum_of_squares
        steady_statistic = model.fit_travel(delay).t_statistic * np.sign(fit.t_statistic)
        is_consistent = steady_statistic > _MIN_STEADY_STATISTIC
        if not (is_identifiable and is_consistent) or abs(fit.t_statistic) < _MIN_T_STATISTIC:
            return
        is_reversed = fit.t_statistic < 0.0
        effect = model.fit().coefficients[-1] * np.nanmean(_rudder_flow(log, names))
        figures = {"effect": float(effect), "t": fit.t_statistic, "lag": delay}
        text = (
            f"positive {name} turns the vessel to {'port' if is_reversed else 'starboard'}"
            f" ({abs(fit.t_statistic):.0f} standard errors)"
        )
    if is_reversed:
        yield make_finding(text, figures, fix=reversal_fix)
    else:
        yield make_finding(text, figures, level="note", fix="")


_MIN_LEAD_TIME = 0.45
"""Lead of a response in s above which it is no inaccuracy."""
_MIN_LEAD_SAMPLES = 2.5
"""Lead in samples; 2 samples are possible where velocities are derived from positions."""
_MIN_CAUSAL_RATIO = 2.0
"""Smallest ratio of the residual sum of squares of the best causal delay to that of the best one.

It is 2.1 and more for inputs that are late by twice the response time, and at most 1.8 without.
"""


@check(
    "actuators",
    "acausal",
    fix="the clocks of inputs and motion differ: shift one of them",
    is_record_fault=True,
    on_subsample=True,
)
def check_acausal_response(log: LogStatistics, make_finding: Check) -> Iterator[Finding]:
    """Report inputs whose response precedes them.

    A late response may be due to the actuators, but the delay must then be the same in all logs of
    one vessel (`between`).
    """
    models = {"r": log.cached(_fit_yaw_model), "u": log.cached(_fit_surge_model)}
    for velocity, model in models.items():
        if model is None:
            continue
        delay = model.best_delay()
        causal_residual = model.sum_of_squares(model.best_delay(min_delay=0.0))
        improvement = causal_residual / model.sum_of_squares(delay)
        min_lead_time = max(_MIN_LEAD_TIME, _MIN_LEAD_SAMPLES * log.sampling_interval)
        if improvement > _MIN_CAUSAL_RATIO and -delay > min_lead_time:
            channels = ", ".join(model.names)
            text = (
                f"{velocity} responds {-delay:.2f} s before {channels} (the residual sum of squares"
                f" is {improvement:.1f} times smaller with a shifted input)"
            )
            figures = {"lag": delay, "better": improvement}
            yield make_finding(text, figures)
