"""Identification of K and T in closed loop, with logged set points of the heading.

In a closed loop the rudder is correlated with the disturbances that it counteracts, and a fit of
the yaw rate to the rudder is biased. Steps of the set point are not correlated with disturbances.
The two-stage method first explains rudder and yaw rate by the set point alone, a finite impulse
response by least squares. It then fits the explained yaw rate to the explained rudder, from both of
which the disturbances are removed. Both stages together are an estimate by instrumental variables
with the set point as the instrument. Sources: P. M. J. Van den
Hof and R. J. P. Schrama, An indirect method for transfer function estimation from closed loop data,
Automatica 29 (1993); U. Forssell and L. Ljung, Closed-loop identification revisited, Automatica 35
(1999).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from residnet.autopilot.heading.turning import (
    Array,
    ManoeuvreRecord,
    SteeringResponse,
    fit_response,
)
from residnet.core.errors import FitError
from residnet.quality.feedback import cross_validated_r2, response_time

MIN_INSTRUMENT_SHARE: Final = 0.1
"""Smallest share of the rudder's variance that the set point explains in leave-one-log-out
cross-validation: a weaker instrument gives estimates without a finite variance."""
_RESPONSE_TIMES: Final = 12.0
"""Length of the impulse response in units of the response time of the yaw rate."""
_N_LAGS: Final = 24
"""Number of intervals of the impulse response, the shorter the smaller the lag."""
_MIN_LOGS: Final = 3
"""Smallest number of logs for standard errors."""
_MAX_FOLDS: Final = 6
"""Largest number of groups of logs of the jackknife; bounds the computing time."""
_HAUSMAN_LIMIT: Final = 2.0
"""Standard errors by which the estimates must differ for the direct one to be rejected (5 %)."""


class InstrumentedResponse(NamedTuple):
    """A steering response by the two-stage method.

    Attributes:
        response: K, T and delay; their standard errors are those of a jackknife over logs.
        instrument_share: share of the rudder's variance that the set point explains.
    """

    response: SteeringResponse
    instrument_share: float


def fit_with_set_points(
    records: Sequence[ManoeuvreRecord],
    set_points: Sequence[Array],
    max_delay: float,
    *,
    commands: bool = False,
) -> InstrumentedResponse:
    """Fit K, T and delay with the set point of the heading as instrument.

    Args:
        records: at least three records of rudder and yaw rate.
        set_points: set point of the heading in rad on the grid of each record.
        max_delay: largest delay of the search in s.
        commands: whether the records hold rudder commands instead of angles.

    Raises:
        FitError: if there are fewer than three records, if the set point explains too little of the
            rudder, or if no response to the rudder is found.
    """
    if len(records) < _MIN_LOGS:
        raise FitError(
            f"steering: {len(records)} logs with set points, {_MIN_LOGS} are needed to use them"
        )
    unit = response_time([record.yaw_rate for record in records], records[0].dt)
    designs = [
        _set_point_regressors(set_point, record.dt, _RESPONSE_TIMES * unit)
        for record, set_point in zip(records, set_points, strict=True)
    ]
    designs = [design[record.usable] for design, record in zip(designs, records, strict=True)]
    rudders = [record.rudder[record.usable] for record in records]
    share = cross_validated_r2(designs, rudders)
    if share < MIN_INSTRUMENT_SHARE:
        raise FitError(
            f"steering: the set point psi_d explains {100 * max(share, 0.0):.0f} % of the rudder in"
            f" leave-one-log-out cross-validation, {100 * MIN_INSTRUMENT_SHARE:.0f} % are needed;"
            " log larger steps of the course"
        )
    response = _fit_explained_parts(records, designs, max_delay, commands=commands)
    n_folds = min(len(records), _MAX_FOLDS)
    estimates = []
    for fold in range(n_folds):
        training_records = [k for k in range(len(records)) if k % n_folds != fold]
        fold_solution = _fit_explained_parts(
            [records[k] for k in training_records],
            [designs[k] for k in training_records],
            max_delay,
            commands=commands,
        )
        estimates.append((fold_solution.gain, fold_solution.time, fold_solution.delay))
    # delete-group jackknife: the residuals of the second stage hold no disturbances any more
    variances = (n_folds - 1) * np.var(np.array(estimates), axis=0)
    gain_error, time_error, delay_error = np.sqrt(variances).tolist()
    errors = (gain_error, time_error, delay_error)
    return InstrumentedResponse(replace(response, standard_errors=errors), share)


def is_direct_estimate_rejected(direct: SteeringResponse, instrumented: SteeringResponse) -> bool:
    """Return whether K or T of a direct fit contradict those with instruments.

    Durbin-Wu-Hausman test: without correlation of the rudder with disturbances both estimates agree
    and the direct one has the smaller variance, so that the variance of their difference is the
    difference of their variances. Source: J. A. Hausman, Specification tests in econometrics,
    Econometrica 46 (1978).
    """
    pairs = (
        (direct.gain, instrumented.gain, 0),
        (direct.time, instrumented.time, 1),
    )
    for first, second, k in pairs:
        variance = instrumented.standard_errors[k] ** 2 - direct.standard_errors[k] ** 2
        # a direct estimate that is no better than the other gives no scale for the difference
        scale = math.sqrt(max(variance, 0.1 * instrumented.standard_errors[k] ** 2))
        if abs(first - second) > _HAUSMAN_LIMIT * scale:
            return True
    return False


def _set_point_regressors(set_point: Array, dt: float, length: float) -> Array:
    """Return the changes of the set point [N, k] in intervals of past time up to `length` s."""
    # quadratic spacing resolves the first response to a step best
    knots = np.unique(np.round((np.arange(_N_LAGS + 1) / _N_LAGS) ** 2 * length / dt)).astype(int)
    indices = np.arange(len(set_point))
    lagged = np.stack([set_point[np.maximum(indices - lag, 0)] for lag in knots.tolist()], axis=1)
    return np.asarray(lagged[:, :-1] - lagged[:, 1:])


def _fit_explained_parts(
    records: Sequence[ManoeuvreRecord],
    designs: Sequence[Array],
    max_delay: float,
    *,
    commands: bool,
) -> SteeringResponse:
    """Fit the response of the explained yaw rate to the explained rudder.

    Args:
        records: records of rudder and yaw rate.
        designs: regressors of the set point at the usable samples of each record.
        max_delay: largest delay of the search in s.
        commands: whether the records hold rudder commands.
    """
    design = np.concatenate([np.column_stack((np.ones(len(part)), part)) for part in designs])
    responses = np.column_stack(
        [
            np.concatenate([record.rudder[record.usable] for record in records]),
            np.concatenate([record.yaw_rate[record.usable] for record in records]),
        ]
    )
    explained = design @ np.linalg.lstsq(design, responses, rcond=None)[0]
    boundaries = np.cumsum([len(part) for part in designs])[:-1]
    explained_records = []
    for record, part in zip(records, np.split(explained, boundaries), strict=True):
        rudder = record.rudder.copy()
        yaw_rate = record.yaw_rate.copy()
        rudder[record.usable] = part[:, 0]
        yaw_rate[record.usable] = part[:, 1]
        explained_records.append(replace(record, rudder=rudder, yaw_rate=yaw_rate))
    response = fit_response(explained_records, max_delay, commands=commands)
    # errors refer to the measured yaw rate, of which the disturbances are a part
    unexplained = responses[:, 1] - explained[:, 1]
    mean_square = response.rms**2 + float((unexplained**2).mean())
    return replace(
        response,
        rms=math.sqrt(mean_square),
        explained_variance=1.0 - mean_square / float(responses[:, 1].var()),
    )
