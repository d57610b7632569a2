"""Estimation of the operating domain and of the excitation from the training logs of a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch

from residnet.core.layout import SURGE
from residnet.core.names import WIND_INPUTS
from residnet.dynamics.domain import monomials
from residnet.dynamics.domain_config import (
    MAX_TABLE_BYTES,
    InputRelation,
    OperatingDomain,
    count_features,
)
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PreparedLog
from residnet.quality.feedback import InputFeedback, cross_validated_r2, detect_feedback

_LIMIT_LEVEL: Final = 0.993
"""Share of the samples of held-out logs within the limit of the density."""
_RIDGE: Final = 1e-4
"""Second moment that is added to that of each monomial. Channels that vary by less than 1 % of
their scale in a direction count as if they varied by 1 %.
"""
_MAX_SAMPLES_PER_LOG: Final = 20_000
_MAX_FOLDS: Final = 10
_MIN_LOGS: Final = 3
"""Number of logs below which parts of logs, not complete logs, are held out."""
_HELD_TOLERANCE: Final = 0.02
"""Tolerance of a held input, as a share of its magnitude, and of a proportional input, as a share
of its range."""
_MIN_LAW_R2: Final = 0.3
"""R^2 of a control law in leave-one-log-out cross-validation, below which the reference of the
controller is no function of the channels of the model.
"""
_EXCESS: Final = 1.5
"""Factor by which new data may exceed the largest deviations from a relation in the logs."""


def detect_feedback_of_logs(
    logs: Sequence[PreparedLog], signals: SignalsConfig, step: float
) -> list[InputFeedback]:
    """Detect feedback in the commanded inputs of prepared logs.

    Args:
        logs: prepared logs on a grid with `step` s.
        signals: inputs of the model.
    """
    names = signals.dof.state_names
    tables = []
    for log in logs:
        states = {name: log.y[:, k] for k, name in enumerate(names)}
        inputs = {name: log.w[:, k] for k, name in enumerate(signals.input_columns)}
        table = {**states, **inputs}
        # an interpolation of unusable samples would hide feedback no more than a gap does
        tables.append({name: _fill_gaps(values) for name, values in table.items()})
    return detect_feedback(tables, signals.inputs, step)


def _fill_gaps(values: np.ndarray) -> np.ndarray:
    is_finite = np.isfinite(values)
    if is_finite.all() or not is_finite.any():
        return np.asarray(np.nan_to_num(values))
    indices = np.arange(len(values))
    return np.asarray(np.interp(indices, indices[is_finite], values[is_finite]))


def estimate_domain(
    logs: Sequence[PreparedLog], signals: SignalsConfig, step: float
) -> OperatingDomain:
    """Estimate relations and density of velocities and inputs of the training logs.

    Args:
        logs: training logs.
        signals: inputs of the model.
        step: step of the grid in s.
    """
    samples = [_usable_samples(log) for log in logs if log.usable.any()]
    names = (*signals.dof.state_names, *signals.input_columns)
    relations = [
        _relate_unexcited_input(name, samples, names, signals.inputs) for name in signals.unexcited
    ]
    is_closed_loop_only = False
    for feedback in detect_feedback_of_logs(logs, signals, step):
        if not feedback.is_closed_loop:
            continue
        law = _fit_control_law(feedback, samples, names)
        is_closed_loop_only |= law is None
        relations += [] if law is None else [law]
    channels, columns = _density_channels(samples, names, signals)
    common = {
        "n_logs": len(logs),
        "relations": tuple(relations),
        "is_closed_loop_only": is_closed_loop_only,
    }
    if not channels:
        return OperatingDomain.model_validate(common)
    rows = [sample[:, columns] for sample in samples]
    centre = np.concatenate(rows).mean(axis=0)
    scale = np.concatenate(rows).std(axis=0)
    fits_table = 8 * count_features(len(channels), 2) ** 2 <= MAX_TABLE_BYTES
    features = [
        monomials(torch.from_numpy((row - centre) / scale), 2 if fits_table else 1).numpy()
        for row in rows
    ]
    moments = np.array([feature.T @ feature / len(feature) for feature in features])
    scores = _held_out_scores(features, moments)
    # each log counts alike, however long it is
    quantile = _weighted_quantile(scores, _LIMIT_LEVEL)
    false_flags = float(np.mean([(score > quantile).mean() for score in scores]))
    factor = _factorize(moments.mean(axis=0))
    return OperatingDomain.model_validate(
        {
            **common,
            "channels": channels,
            "centre": centre.tolist(),
            "scale": scale.tolist(),
            "factor": factor.reshape(-1).tolist(),
            "limit": float(quantile),
            "false_flags": false_flags,
        }
    )


def _usable_samples(log: PreparedLog) -> np.ndarray:
    """Return evenly spread usable states and inputs of a log [K, nx + m]."""
    indices = np.flatnonzero(log.usable)
    indices = indices[:: max(len(indices) // _MAX_SAMPLES_PER_LOG, 1)]
    table = np.column_stack((log.y[indices], log.w[indices]))
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def _density_channels(
    samples: Sequence[np.ndarray], names: Sequence[str], signals: SignalsConfig
) -> tuple[list[str], list[int]]:
    """Return names and columns of the velocities and commanded inputs that vary."""
    joined = np.concatenate(samples)
    first = SURGE
    columns = [
        k
        for k, name in enumerate(names)
        if k >= first
        and name not in (*WIND_INPUTS, *signals.unexcited, *signals.dof.unmodelled_states)
        # the depth of a vessel that dives has no range
        and name != "z"
        and joined[:, k].std() > 1e-6 * max(float(np.abs(joined[:, k]).max()), 1e-9)
    ]
    return [names[k] for k in columns], columns


def _factorize(moment: np.ndarray) -> np.ndarray:
    """Return a factor F [p, p] such that F' F is the inverse of the regularised moment matrix."""
    ridge = _RIDGE * np.eye(len(moment))
    ridge[0, 0] = 0.0
    return np.asarray(np.linalg.inv(np.linalg.cholesky(moment + ridge)))


def _held_out_scores(features: Sequence[np.ndarray], moments: np.ndarray) -> list[np.ndarray]:
    """Return the score of each sample with the moments of the other logs, or of other parts."""
    if len(features) < _MIN_LOGS:
        features = [part for feature in features for part in np.array_split(feature, 4)]
        features = [feature for feature in features if len(feature)]
        moments = np.array([feature.T @ feature / len(feature) for feature in features])
    n_folds = min(len(features), _MAX_FOLDS)
    scores = []
    for fold in range(n_folds):
        is_held_out = np.arange(len(features)) % n_folds == fold
        factor = _factorize(moments[~is_held_out if n_folds > 1 else is_held_out].mean(axis=0))
        scores += [
            ((features[k] @ factor.T) ** 2).sum(axis=1)
            for k in np.flatnonzero(is_held_out).tolist()
        ]
    return scores


def _weighted_quantile(scores: Sequence[np.ndarray], level: float) -> float:
    """Return the quantile of samples, each log with the same weight."""
    joined = np.concatenate(scores)
    weights = np.concatenate([np.full(len(score), 1.0 / len(score)) for score in scores])
    order = np.argsort(joined)
    cumulative = np.cumsum(weights[order]) / weights.sum()
    return float(joined[order][min(int(np.searchsorted(cumulative, level)), len(joined) - 1)])


def _relate_unexcited_input(
    name: str, samples: Sequence[np.ndarray], names: Sequence[str], input_names: Sequence[str]
) -> InputRelation:
    """Return the value that an unexcited input held, or its relation to the nearest other input."""
    joined = np.concatenate(samples)
    values = joined[:, names.index(name)]
    best: tuple[float, str, np.ndarray] = (0.0, "", np.zeros(2))
    for input_name in input_names:
        other = joined[:, names.index(input_name)]
        if min(other.std(), values.std()) <= 1e-9:
            continue
        correlation = float(np.corrcoef(values, other)[0, 1])
        if abs(correlation) > abs(best[0]):
            best = (correlation, input_name, np.polyfit(other, values, 1))
    correlation, input_name, (gain, offset) = best
    # a gain of an almost constant input would be noise
    if abs(correlation) < 0.9:
        level = float(np.median(values))
        deviation = float(np.quantile(np.abs(values - level), 0.999))
        tolerance = max(_EXCESS * deviation, _HELD_TOLERANCE * abs(level), 1e-9)
        return InputRelation(input=name, kind="held", offset=level, tolerance=tolerance)
    other = joined[:, names.index(input_name)]
    deviation = float(np.quantile(np.abs(values - gain * other - offset), 0.999))
    return InputRelation(
        input=name,
        kind="proportional",
        offset=float(offset),
        channels=(input_name,),
        gains=(float(gain),),
        tolerance=max(_EXCESS * deviation, _HELD_TOLERANCE * float(np.ptp(values)), 1e-9),
    )


def _fit_control_law(
    feedback: InputFeedback, samples: Sequence[np.ndarray], names: Sequence[str]
) -> InputRelation | None:
    """Fit an input to the heading relative to one reference, and to the velocities.

    Returns:
        The control law; None where the logs have no common reference of the heading, or follow
        something that is no state of the model, so that the model cannot see a deviation.
    """
    if feedback.source != "the heading" or "psi" not in names:
        return None
    column = names.index(feedback.name)
    heading_column = names.index("psi")
    velocity_names = [name for name in ("v", "r") if name in names]
    joined = np.concatenate(samples)
    reference = float(np.angle(np.exp(1j * joined[:, heading_column]).mean()))

    def regressors(sample: np.ndarray) -> np.ndarray:
        velocities = [sample[:, names.index(name)] for name in velocity_names]
        return np.column_stack((np.sin(sample[:, heading_column] - reference), *velocities))

    designs = [regressors(sample) for sample in samples]
    responses = [sample[:, column] for sample in samples]
    if len(samples) < 2 or cross_validated_r2(designs, responses) < _MIN_LAW_R2:
        return None
    design = np.column_stack((np.ones(len(joined)), np.concatenate(designs)))
    response = np.concatenate(responses)
    coefficients = np.linalg.lstsq(design, response, rcond=None)[0]
    deviation = np.abs(response - design @ coefficients)
    heading = np.angle(np.exp(1j * (joined[:, heading_column] - reference)))
    return InputRelation(
        input=feedback.name,
        kind="feedback",
        offset=float(coefficients[0]),
        channels=tuple(velocity_names),
        gains=tuple(coefficients[2:].tolist()),
        heading=reference,
        heading_gain=float(coefficients[1]),
        max_heading=min(float(np.abs(heading).max()) * _EXCESS + 0.01, math.pi),
        tolerance=max(float(np.quantile(deviation, _LIMIT_LEVEL)), 1e-9),
    )
