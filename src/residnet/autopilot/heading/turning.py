"""Identification of Nomoto's K, T and a delay from records of rudder and yaw rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from residnet.core.errors import FitError

Array = NDArray[np.float64]
_N_TIMES = 20
"""Number of values of T in the coarse grid search."""
_N_DELAYS = 8
"""Number of delays in the coarse grid search."""
_N_RATES = 10
"""Number of rudder rates in the coarse grid search."""
_MAX_COARSE_SAMPLES = 4000
"""Largest number of samples of a manoeuvre in the coarse search."""
_RUDDER_RATE_RANGE = (math.radians(1.0), math.radians(40.0))
"""Range of rudder rates in rad/s of the search: SOLAS II-1/29 requires 2.3 deg/s of ships, and at
the largest rate a rudder angle of 20 deg is reached within half a second.
"""
_MIN_EXPLAINED = 0.5
"""Smallest fraction of the yaw-rate variance that a response must explain."""
_CHI2_95 = 3.84
"""95th percentile of the chi-squared distribution with one degree of freedom."""


@dataclass(frozen=True)
class SteeringResponse:
    """Identified model T r_dot + r = K (delta(t - delay) + bias) with a rudder rate.

    Attributes:
        gain: K in 1/s.
        time: T in s.
        delay: dead time in s.
        bias: effective rudder angle in rad with the rudder amidships.
        rms: RMS error of the simulated yaw rate in rad/s.
        explained_variance: fraction of the yaw-rate variance that the model explains.
        rate: rudder rate in rad/s; None if not identifiable, or if the records hold rudder angles.
        standard_errors: standard errors of `gain`, `time` and `delay`, SI, from the covariance
            of the fit with autocorrelated residuals.
    """

    gain: float
    time: float
    delay: float
    bias: float
    rms: float
    explained_variance: float
    rate: float | None = None
    standard_errors: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ManoeuvreRecord:
    """Record of a manoeuvre on a uniform time grid.

    Attributes:
        dt: time step in s.
        rudder: rudder angle or command [N] in rad.
        yaw_rate: yaw rate [N] in rad/s.
        usable: mask [N] of the samples used in the fit.
    """

    dt: float
    rudder: Array
    yaw_rate: Array
    usable: NDArray[np.bool_]

    def subsample(self) -> ManoeuvreRecord:
        """Return every n-th sample, at most `_MAX_COARSE_SAMPLES` in all."""
        stride = slice(None, None, -(-len(self.rudder) // _MAX_COARSE_SAMPLES))
        dt = self.dt * (stride.step or 1)
        return ManoeuvreRecord(dt, self.rudder[stride], self.yaw_rate[stride], self.usable[stride])


def limit_rudder_rate(command: Array, rate: float, dt: float) -> Array:
    """Return rudder angles [N] for commands [N] in rad under a rate limit in rad/s.

    The first angle is the first command.
    """
    max_change = rate * dt
    if not math.isfinite(max_change):
        return command
    angle = float(command[0])
    angles = []
    for target in command.tolist():
        angle += min(max(target - angle, -max_change), max_change)
        angles.append(angle)
    return np.array(angles)


def fit_response(
    records: Sequence[ManoeuvreRecord], max_delay: float, *, commands: bool = False
) -> SteeringResponse:
    """Fit K, T and delay to the yaw rates of manoeuvres by simulation error.

    K, the bias and the initial yaw rate of each manoeuvre enter linearly and are solved for;
    T, the delay and the rudder rate are searched on a grid, then refined. A rate is included only
    if it reduces the error significantly (chi-squared test).

    Args:
        records: manoeuvres; turns to both sides are most informative.
        max_delay: largest delay of the search in s.
        commands: whether the records hold rudder commands instead of angles.

    Raises:
        FitError: if no response to the rudder is found.
    """
    longest_duration = max(record.dt * len(record.rudder) for record in records)
    min_dt = min(record.dt for record in records)
    subsampled = [record.subsample() for record in records]
    rates = [math.inf, *np.geomspace(*_RUDDER_RATE_RANGE, _N_RATES)] if commands else [math.inf]
    coarse_fits: dict[float, tuple[float, tuple[float, float]]] = {}
    for rate in rates:
        rate_limited = [
            ManoeuvreRecord(
                thin_record.dt,
                limit_rudder_rate(thin_record.rudder, rate, thin_record.dt),
                thin_record.yaw_rate,
                thin_record.usable,
            )
            for thin_record in subsampled
        ]
        coarse_fits[rate] = min(
            (
                _solve_linear_terms(rate_limited, float(time), float(delay))[0],
                (float(time), float(delay)),
            )
            for time in np.geomspace(min_dt, longest_duration, _N_TIMES)
            for delay in np.linspace(0.0, max_delay, _N_DELAYS)
        )
    best = min(rates, key=lambda rate: coarse_fits[rate][0])
    refined_fits = {
        rate: _refine_response(records, *coarse_fits[rate][1], rate, max_delay)
        for rate in (best, math.inf)
    }
    candidate, sum_of_squares, n_independent = refined_fits[best]
    if candidate.gain <= 0 or candidate.explained_variance < _MIN_EXPLAINED:
        raise FitError(
            f"steering: the best response found has K {candidate.gain:.3g} 1/s and explains"
            f" {100 * candidate.explained_variance:.0f} % of the yaw rate; check the sign and unit"
            " of the rudder, and that the vessel responds to it"
        )
    # likelihood-ratio test of the additional parameter: a rate reduces the error even by chance
    relative_gain = refined_fits[math.inf][1] / sum_of_squares - 1.0
    return refined_fits[best if relative_gain * n_independent >= _CHI2_95 else math.inf][0]


def _refine_response(
    records: Sequence[ManoeuvreRecord], time: float, delay: float, rate: float, max_delay: float
) -> tuple[SteeringResponse, float, float]:
    """Refine a response of the grid search; an infinite rate is not changed.

    Returns:
        The response, its sum of squared errors, and the effective number of independent errors.
    """
    from scipy.optimize import least_squares

    def rate_limited_records(rate: float) -> list[ManoeuvreRecord]:
        return [
            replace(record, rudder=limit_rudder_rate(record.rudder, rate, record.dt))
            for record in records
        ]

    def prediction_errors(point: Array) -> Array:
        trial_rate = math.exp(point[4]) if len(point) > 4 else math.inf
        responses = [
            _unit_responses(record, math.exp(point[1]), point[2])
            for record in rate_limited_records(trial_rate)
        ]
        return np.concatenate([point[0] * (a[:, 0] + point[3] * a[:, 1]) - r for a, r in responses])

    _, gain, disturbance = _solve_linear_terms(rate_limited_records(rate), time, delay)
    initial_point = [gain, math.log(time), delay, disturbance / (gain or 1.0)]
    initial_point += [math.log(rate)] if math.isfinite(rate) else []
    lower, upper = np.full((2, len(initial_point)), math.inf) * [[-1.0], [1.0]]
    lower[2], upper[2] = -1e-9, max_delay + 1e-9
    # the delay changes by interpolation between samples, so that default steps near the rounding
    # error would give inaccurate derivatives
    solution = least_squares(
        prediction_errors,
        initial_point,
        bounds=(lower, upper),
        x_scale="jac",
        diff_step=np.full(len(initial_point), 1e-4),
    )
    residuals = solution.fun
    estimates = [*solution.x, math.inf][:5]
    autocorrelation = float(residuals[1:] @ residuals[:-1]) / max(
        float(residuals @ residuals), 1e-30
    )
    # effective sample size of first-order autoregressive errors: N (1 - rho) / (1 + rho)
    n_independent = max(len(residuals) * (1.0 - autocorrelation) / (1.0 + autocorrelation), 8.0)
    sum_of_squares = float(residuals @ residuals)
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * (sum_of_squares / n_independent)
    standard_errors = np.sqrt(np.diag(covariance).clip(min=0.0))
    time = math.exp(estimates[1])
    rate = math.exp(estimates[4])
    yaw_rates = np.concatenate([record.yaw_rate[record.usable] for record in records])
    return (
        SteeringResponse(
            estimates[0],
            time,
            max(estimates[2], 0.0),
            estimates[3],
            math.sqrt(sum_of_squares / len(yaw_rates)),
            1.0 - sum_of_squares / max(float(((yaw_rates - yaw_rates.mean()) ** 2).sum()), 1e-30),
            rate if math.isfinite(rate) else None,
            (
                float(standard_errors[0]),
                time * float(standard_errors[1]),
                float(standard_errors[2]),
            ),
        ),
        sum_of_squares,
        n_independent,
    )


def _unit_responses(record: ManoeuvreRecord, time: float, delay: float) -> tuple[Array, Array]:
    """Return responses [N, 2] to the rudder and to a constant angle for K = 1, and yaw rates [N].

    The unknown initial yaw rate of the record contributes a decaying exponential. It is projected
    out of responses and yaw rates, so that it needs no parameter.
    """
    count = len(record.rudder)
    shifted = np.interp(np.arange(count) - delay / record.dt, np.arange(count), record.rudder)
    decay_factor = float(np.exp(-record.dt / time))
    responses = np.zeros((count, 2))
    responses[1:, 0] = lfilter([1.0 - decay_factor], [1.0, -decay_factor], shifted[:-1])
    initial_response = decay_factor ** np.arange(count)
    responses[:, 1] = 1.0 - initial_response
    usable_responses = responses[record.usable]
    yaw_rate = record.yaw_rate[record.usable]
    initial_direction = initial_response[record.usable]
    initial_direction = initial_direction / max(float(np.linalg.norm(initial_direction)), 1e-12)
    return usable_responses - initial_direction[:, None] * (
        initial_direction @ usable_responses
    ), yaw_rate - initial_direction * (initial_direction @ yaw_rate)


def _solve_linear_terms(
    records: Sequence[ManoeuvreRecord], time: float, delay: float
) -> tuple[float, float, float]:
    """Return the sum of squared errors, K and K bias of the best response for given T and delay."""
    normal_matrix = np.zeros((2, 2))
    normal_rhs = np.zeros(2)
    sum_of_squares = 0.0
    for record in records:
        responses, yaw_rate = _unit_responses(record, time, delay)
        normal_matrix += responses.T @ responses
        normal_rhs += responses.T @ yaw_rate
        sum_of_squares += float(yaw_rate @ yaw_rate)
    solution = np.linalg.lstsq(normal_matrix, normal_rhs, rcond=1e-10)[0]
    return (
        max(sum_of_squares - float(solution @ normal_rhs), 0.0),
        float(solution[0]),
        float(solution[1]),
    )


def compute_response_residual(record: ManoeuvreRecord, response: SteeringResponse) -> Array:
    """Return measured minus simulated yaw rates [N] in rad/s, without the initial transient."""
    if response.rate is not None:
        limited_rudder = limit_rudder_rate(record.rudder, response.rate, record.dt)
        record = replace(record, rudder=limited_rudder)
    responses, yaw_rate = _unit_responses(record, response.time, response.delay)
    gains = np.array([response.gain, response.gain * response.bias])
    residual: Array = yaw_rate - responses @ gains
    return residual


@dataclass(frozen=True)
class NomotoModel:
    """Nomoto's model T r_dot + r = K (delta - c psi) at one speed.

    Attributes:
        gain: K in 1/s.
        time: time constant T in s.
        speed: speed u in m/s.
        restoring: c, the restoring coefficient of a dive angle; zero for the heading.
    """

    gain: float
    time: float
    speed: float
    restoring: float = 0.0

    def to_json(self) -> dict[str, float]:
        """Return the parameters with the keys of stored policies and of controllers.json."""
        return {
            "gain": self.gain,
            "time": self.time,
            "speed": self.speed,
            "righting": self.restoring,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, float]) -> NomotoModel:
        """Read the parameters that `to_json` wrote."""
        return cls(content["gain"], content["time"], content["speed"], content["righting"])
