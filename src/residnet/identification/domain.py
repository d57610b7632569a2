"""Estimation of the operating domain and of the excitation from the training logs of a fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.stats
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

FALSE_FLAG_SHARE: Final = 0.008
"""Share of the samples of a new log of the same kind that may be flagged, all criteria together.

It is less than half of the 2 % that `scripts/bench/excitation.py` allows, because a few logs
estimate a quantile with much scatter."""
_MAX_RANGE_MARGIN: Final = 0.75
"""Largest margin of the ranges in standard deviations of a channel: a quarter of the range of a
uniform distribution. Logs whose extremes differ more are of different kinds, and their differences
do not predict the range of a new log."""
_RIDGE: Final = 1e-4
"""Second moment that is added to that of each monomial. Channels that vary by less than 1 % of
their scale in a direction count as if they varied by 1 %.
"""
_MAX_SAMPLES: Final = 200_000
"""Samples of all logs that are used, about; they bound time and memory of the estimate."""
_MIN_SAMPLES_PER_LOG: Final = 1_000
"""Samples of a log that are used at least, even if there are very many logs."""
_MAX_FOLDS: Final = 10
"""Largest number of folds of the cross-validation over logs."""
_MIN_LOGS: Final = 3
"""Number of logs below which parts of logs, not complete logs, are held out."""
_NEW_EXTREME_SHARE: Final = 0.01
"""Share of new logs whose largest value of a channel lies beyond the margin of its range."""
_HELD_TOLERANCE: Final = 0.02
"""Smallest tolerance of a held input, as a share of its magnitude, and of a proportional input, as
a share of its range."""
MAX_VARIANCE_INFLATION: Final = 400.0
"""Largest variance inflation of an input: 5 % of its standard deviation vary by themselves."""
_MIN_LAW_R2: Final = 0.3
"""R^2 of a control law in leave-one-log-out cross-validation, below which the reference of the
controller is no function of the channels of the model.
"""
_MIN_HEADING_LIMIT: Final = math.radians(0.5)
"""Smallest limit of the deviation of a heading from the reference, a compass's error."""


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
        # the detection needs uniform samples; few interpolated ones do not hide feedback
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
    """Estimate ranges, relations and density of velocities and inputs of the training logs.

    All limits are calibrated together by leave-one-log-out cross-validation: each criterion is
    estimated from the other logs and scores the held-out samples. The scores are divided by their
    quantile at the level 1 - FALSE_FLAG_SHARE, the joint score of a sample is its largest ratio,
    and the quantile of the joint scores at the same level multiplies every limit. Each log has the
    same weight. Hence all criteria together flag FALSE_FLAG_SHARE of the held-out samples.

    Args:
        logs: training logs.
        signals: inputs of the model.
        step: step of the grid in s.
    """
    samples = [_usable_samples(log, len(logs)) for log in logs if log.usable.any()]
    names = (*signals.dof.state_names, *signals.input_columns)
    relations, is_closed_loop_only = _relate_inputs(logs, samples, signals, step)
    parts = samples
    if len(samples) < _MIN_LOGS:
        parts = [part for sample in samples for part in np.array_split(sample, 4) if len(part)]
    folds = _make_folds(len(parts))
    scores = [_held_out_deviations(relation, parts, folds, names) for relation in relations]
    smallest_limits = [relation.tolerance for relation in relations]
    largest_limits = [math.inf] * len(relations)
    # the heading of a controlled vessel has a range, too
    controlled = [k for k, relation in enumerate(relations) if relation.heading is not None]
    for k in controlled:
        scores.append(_heading_deviations(relations[k], parts, names))
        smallest_limits.append(_MIN_HEADING_LIMIT)
        largest_limits.append(math.pi)
    channels, columns = _varying_channels(parts, names, signals)
    margins = np.zeros(0)
    if channels:
        rows = [part[:, columns] for part in parts]
        scale = np.concatenate(rows).std(axis=0)
        margins = np.minimum(_predict_range_margins(rows), _MAX_RANGE_MARGIN * scale)
        scores.append(_held_out_range_excesses(rows, np.maximum(margins, 1e-9 * scale), folds))
        smallest_limits.append(1.0)
        largest_limits.append(math.inf)
    density: dict[str, object] = {}
    density_channels, density_columns = _select_density_channels(channels, columns, signals)
    if density_channels:
        density, features, moments = _estimate_density(parts, density_channels, density_columns)
        scores.append(_held_out_scores(features, moments, folds))
        smallest_limits.append(1e-9)
        # the mean of q over the training logs is the number of features, so that by Markov's
        # inequality a larger limit would tell of logs of different kinds, not of their distribution
        largest_limits.append(math.sqrt(features[0].shape[1] / FALSE_FLAG_SHARE))
    limits, false_flags = _calibrate_limits(scores, smallest_limits, largest_limits)
    n_relations = len(relations)
    for k, relation in enumerate(relations):
        relations[k] = relation.model_copy(update={"tolerance": limits[k]})
    for limit, k in zip(limits[n_relations:], controlled, strict=False):
        relations[k] = relations[k].model_copy(update={"max_heading": limit})
    if channels:
        scale = np.concatenate(parts)[:, columns].std(axis=0)
        factor = limits[n_relations + len(controlled)]
        margins = np.minimum(factor * margins, _MAX_RANGE_MARGIN * scale)
    if density:
        density["limit"] = limits[-1] ** 2
    return OperatingDomain.model_validate(
        {
            "n_logs": len(logs),
            "relations": tuple(relations),
            "is_closed_loop_only": is_closed_loop_only,
            "range_margins": dict(zip(channels, margins.tolist(), strict=True)),
            "false_flags": false_flags,
            **density,
        }
    )


def estimate_density(logs: Sequence[PreparedLog], signals: SignalsConfig) -> OperatingDomain:
    """Estimate the density of velocities and inputs of logs, without ranges, relations and limit.

    Args:
        logs: training logs.
        signals: inputs of the model.
    """
    samples = [_usable_samples(log, len(logs)) for log in logs if log.usable.any()]
    names = (*signals.dof.state_names, *signals.input_columns)
    density: dict[str, object] = {}
    if samples:
        channels, columns = _varying_channels(samples, names, signals)
        channels, columns = _select_density_channels(channels, columns, signals)
        if channels:
            density = _estimate_density(samples, channels, columns)[0]
    return OperatingDomain.model_validate({"n_logs": max(len(logs), 1), **density})


def _select_density_channels(
    channels: Sequence[str], columns: Sequence[int], signals: SignalsConfig
) -> tuple[list[str], list[int]]:
    """Return the channels of the density with their columns: without wind and unexcited inputs."""
    is_in_density = [name not in (*WIND_INPUTS, *signals.unexcited) for name in channels]
    return (
        list(itertools.compress(channels, is_in_density)),
        list(itertools.compress(columns, is_in_density)),
    )


def _estimate_density(
    parts: Sequence[np.ndarray], channels: Sequence[str], columns: Sequence[int]
) -> tuple[dict[str, object], list[np.ndarray], np.ndarray]:
    """Return the keys of the density of a domain, and the monomials and moments of each part.

    Args:
        parts: samples of the logs or of their parts, [K, nx + m] each.
        channels: channels of the density.
        columns: their columns.
    """
    rows = [part[:, columns] for part in parts]
    centre = np.concatenate(rows).mean(axis=0)
    scale = np.concatenate(rows).std(axis=0)
    fits_table = 8 * count_features(len(channels), 2) ** 2 <= MAX_TABLE_BYTES
    degree = 2 if fits_table else 1
    features = [monomials(torch.from_numpy((row - centre) / scale), degree).numpy() for row in rows]
    moments = np.array([feature.T @ feature / len(feature) for feature in features])
    density: dict[str, object] = {
        "channels": channels,
        "centre": centre.tolist(),
        "scale": scale.tolist(),
        "factor": _factorize(moments.mean(axis=0)).reshape(-1).tolist(),
    }
    return density, features, moments


def _relate_inputs(
    logs: Sequence[PreparedLog], samples: Sequence[np.ndarray], signals: SignalsConfig, step: float
) -> tuple[list[InputRelation], bool]:
    """Return the relations of inputs to each other and to the motion.

    Returns:
        Relations of unexcited, collinear and controlled inputs, and whether a controller follows
        a reference that the model cannot see.
    """
    names = (*signals.dof.state_names, *signals.input_columns)
    relations = [
        _relate_unexcited_input(name, samples, names, signals.inputs) for name in signals.unexcited
    ]
    relations += _relate_collinear_inputs(samples, names, signals.inputs)
    is_closed_loop_only = False
    for feedback in detect_feedback_of_logs(logs, signals, step):
        if not feedback.is_closed_loop:
            continue
        law = _fit_control_law(feedback, samples, names)
        is_closed_loop_only |= law is None
        relations += [] if law is None else [law]
    return relations, is_closed_loop_only


def _calibrate_limits(
    scores: Sequence[Sequence[np.ndarray]],
    smallest_limits: Sequence[float],
    largest_limits: Sequence[float],
) -> tuple[list[float], float]:
    """Return the limits of some criteria at the joint level 1 - FALSE_FLAG_SHARE.

    Extreme scores come from a few logs, so that limits from all logs flag more of a new log than of
    these. Limits from the other logs therefore score each log, and the quantile of these scores
    multiplies the limits from all logs.

    Args:
        scores: of each criterion, the scores [K] of the held-out samples of each log.
        smallest_limits: smallest limit of each criterion.
        largest_limits: largest limit of each criterion.

    Returns:
        The limit of each criterion, and the share of the samples beyond any of them.
    """
    if not scores:
        return [], 0.0
    bounds = list(zip(smallest_limits, largest_limits, strict=True))
    n_parts = len(scores[0])
    ratios = [np.zeros(0)] * n_parts
    for others, held_out in _make_folds(n_parts):
        limits = _joint_limits([[score[k] for k in others] for score in scores], bounds)
        for k in held_out:
            ratios[k] = _joint_scores([score[k] for score in scores], limits, bounds)
    factor = max(_weighted_quantile(ratios, 1.0 - FALSE_FLAG_SHARE), 1.0)
    limits = [
        float(np.clip(factor * limit, *bound))
        for limit, bound in zip(_joint_limits(scores, bounds), bounds, strict=True)
    ]
    flags = [
        np.any([score[k] > limit for score, limit in zip(scores, limits, strict=True)], axis=0)
        for k in range(n_parts)
    ]
    return limits, float(np.mean([flag.mean() for flag in flags]))


def _joint_limits(
    scores: Sequence[Sequence[np.ndarray]], bounds: Sequence[tuple[float, float]]
) -> list[float]:
    """Return the limits of some criteria, which together flag FALSE_FLAG_SHARE of the samples.

    Args:
        scores: of each criterion, the scores [K] of the samples of each log.
        bounds: smallest and largest limit of each criterion.
    """
    level = 1.0 - FALSE_FLAG_SHARE
    limits = [
        float(np.clip(_weighted_quantile(score, level), *bound))
        for score, bound in zip(scores, bounds, strict=True)
    ]
    joint_scores = [
        _joint_scores([score[k] for score in scores], limits, bounds) for k in range(len(scores[0]))
    ]
    factor = max(_weighted_quantile(joint_scores, level), 1.0)
    return [
        float(np.clip(factor * limit, *bound)) for limit, bound in zip(limits, bounds, strict=True)
    ]


def _joint_scores(
    scores: Sequence[np.ndarray],
    limits: Sequence[float],
    bounds: Sequence[tuple[float, float]],
) -> np.ndarray:
    """Return the largest ratio [K] of the scores [K] of some criteria to their limits.

    A score beyond the largest limit is flagged in any case and must not widen other criteria.
    """
    ratios = [
        np.minimum(score, bound[1]) / limit
        for score, limit, bound in zip(scores, limits, bounds, strict=True)
    ]
    return np.asarray(np.max(ratios, axis=0))


Fold = tuple[np.ndarray, np.ndarray]
"""Indices of the other parts of the logs, and of the held-out ones."""


def _make_folds(n_parts: int) -> list[Fold]:
    """Return the folds of leave-one-log-out cross-validation, at most `_MAX_FOLDS`.

    A single part is scored with itself.
    """
    n_folds = min(n_parts, _MAX_FOLDS)
    fold_numbers = np.arange(n_parts) % n_folds
    if n_folds == 1:
        return [(np.array([0]), np.array([0]))]
    return [
        (np.flatnonzero(fold_numbers != fold), np.flatnonzero(fold_numbers == fold))
        for fold in range(n_folds)
    ]


def _usable_samples(log: PreparedLog, n_logs: int) -> np.ndarray:
    """Return evenly spread usable states and inputs of one of some logs [K, nx + m]."""
    indices = np.flatnonzero(log.usable)
    max_samples = max(_MAX_SAMPLES // n_logs, _MIN_SAMPLES_PER_LOG)
    indices = indices[:: -(-len(indices) // max_samples)]
    table = np.column_stack((log.y[indices], log.w[indices]))
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def _varying_channels(
    samples: Sequence[np.ndarray], names: Sequence[str], signals: SignalsConfig
) -> tuple[list[str], list[int]]:
    """Return names and columns of the velocities and inputs that vary."""
    pooled_samples = np.concatenate(samples)
    columns = [
        k
        for k, name in enumerate(names)
        if k >= SURGE
        and name not in signals.dof.unmodelled_states
        # the depth of a vessel that dives has no range
        and name != "z"
        and pooled_samples[:, k].std() > 1e-6 * max(float(np.abs(pooled_samples[:, k]).max()), 1e-9)
    ]
    return [names[k] for k in columns], columns


def _factorize(moment: np.ndarray) -> np.ndarray:
    """Return a factor F [p, p] such that F' F is the inverse of the regularised moment matrix."""
    ridge = _RIDGE * np.eye(len(moment))
    ridge[0, 0] = 0.0
    return np.asarray(np.linalg.inv(np.linalg.cholesky(moment + ridge)))


def _held_out_scores(
    features: Sequence[np.ndarray], moments: np.ndarray, folds: Sequence[Fold]
) -> list[np.ndarray]:
    """Return the distance of each sample from the other logs, by the moments of its monomials.

    It is sqrt(phi' M^-1 phi) for the monomials phi of the sample and the moment matrix M of the
    other logs: the root of the inverse Christoffel function, and for linear monomials a Mahalanobis
    distance.
    """
    scores = [np.zeros(0)] * len(features)
    for other_logs, held_out in folds:
        factor = _factorize(moments[other_logs].mean(axis=0))
        for k in held_out.tolist():
            scores[k] = np.linalg.norm(features[k] @ factor.T, axis=1)
    return scores


def _predict_range_margins(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Return the margins [c] beyond the ranges of some logs that hold the ranges of a new log.

    The largest value of a new log exceeds the largest of K logs with probability 1 / (K + 1). If
    each log has its own amplitude, many samples of the new log then do. The margin is the distance
    of the upper prediction limit of a new extreme value, mean + t sqrt(1 + 1 / K) times the
    standard deviation of the extreme values of the logs, to the largest of them. Source: G. J. Hahn
    and W. Q. Meeker, Statistical Intervals (1991), section 4.7.
    """
    n_logs = len(rows)
    if n_logs < 2:
        return np.zeros(rows[0].shape[1])
    quantile = float(scipy.stats.t.ppf(1.0 - _NEW_EXTREME_SHARE, n_logs - 1))
    factor = quantile * math.sqrt(1.0 + 1.0 / n_logs)
    margins = np.zeros(rows[0].shape[1])
    for sign in (-1.0, 1.0):
        extremes = np.array([(sign * row).max(axis=0) for row in rows])
        limit = extremes.mean(axis=0) + factor * extremes.std(axis=0, ddof=1)
        margins = np.maximum(margins, limit - extremes.max(axis=0))
    return margins


def _held_out_range_excesses(
    rows: Sequence[np.ndarray], scale: np.ndarray, folds: Sequence[Fold]
) -> list[np.ndarray]:
    """Return by how much each sample exceeds the ranges of the other logs.

    Args:
        rows: channels of each log [K, c].
        scale: unit of the excess of each channel [c].
        folds: folds of the logs.

    Returns:
        The largest excess of a channel at each sample [K]; 0 within all ranges.
    """
    lowest = np.array([row.min(axis=0) for row in rows])
    highest = np.array([row.max(axis=0) for row in rows])
    excesses = [np.zeros(0)] * len(rows)
    for other_logs, held_out in folds:
        lower = lowest[other_logs].min(axis=0)
        upper = highest[other_logs].max(axis=0)
        for k in held_out.tolist():
            excess = np.maximum(lower - rows[k], rows[k] - upper) / scale
            excesses[k] = np.maximum(excess.max(axis=1), 0.0)
    return excesses


def _held_out_deviations(
    relation: InputRelation,
    samples: Sequence[np.ndarray],
    folds: Sequence[Fold],
    names: Sequence[str],
) -> list[np.ndarray]:
    """Return the deviation of each sample from a relation whose gains come from other logs."""
    designs = [_relation_regressors(relation, sample, names) for sample in samples]
    responses = [sample[:, names.index(relation.input)] for sample in samples]
    deviations = [np.zeros(0)] * len(samples)
    for other_logs, held_out in folds:
        response = np.concatenate([responses[k] for k in other_logs])
        design = np.concatenate([designs[k] for k in other_logs])
        if relation.kind == "held":
            # the level is a median, so that a few other values do not move it
            coefficients = np.array([np.median(response)])
        else:
            coefficients = np.linalg.lstsq(design, response, rcond=None)[0]
        for k in held_out.tolist():
            deviations[k] = np.abs(responses[k] - designs[k] @ coefficients)
    return deviations


def _heading_deviations(
    relation: InputRelation, samples: Sequence[np.ndarray], names: Sequence[str]
) -> list[np.ndarray]:
    """Return the deviation of the heading from the reference of a controller at each sample."""
    assert relation.heading is not None
    column = names.index("psi")
    return [
        np.abs(np.angle(np.exp(1j * (sample[:, column] - relation.heading)))) for sample in samples
    ]


def _relation_regressors(
    relation: InputRelation, sample: np.ndarray, names: Sequence[str]
) -> np.ndarray:
    """Return a constant, the sine of the heading if it counts, and the channels [K, 1 + c]."""
    columns = [np.ones(len(sample))]
    if relation.heading is not None:
        columns.append(np.sin(sample[:, names.index("psi")] - relation.heading))
    columns += [sample[:, names.index(channel)] for channel in relation.channels]
    return np.column_stack(columns)


def _weighted_quantile(scores: Sequence[np.ndarray], level: float) -> float:
    """Return the quantile of samples, each log with the same weight."""
    pooled_scores = np.concatenate(scores)
    weights = np.concatenate([np.full(len(score), 1.0 / len(score)) for score in scores])
    order = np.argsort(pooled_scores)
    cumulative = np.cumsum(weights[order]) / weights.sum()
    return float(
        pooled_scores[order][min(int(np.searchsorted(cumulative, level)), len(pooled_scores) - 1)]
    )


def _relate_unexcited_input(
    name: str, samples: Sequence[np.ndarray], names: Sequence[str], input_names: Sequence[str]
) -> InputRelation:
    """Return the value that an unexcited input held, or its relation to the nearest other input.

    The tolerance is a smallest value, `_HELD_TOLERANCE`; calibration may increase it.
    """
    pooled_samples = np.concatenate(samples)
    values = pooled_samples[:, names.index(name)]
    best: tuple[float, str, np.ndarray] = (0.0, "", np.zeros(2))
    for input_name in input_names:
        other = pooled_samples[:, names.index(input_name)]
        if min(other.std(), values.std()) <= 1e-9:
            continue
        correlation = float(np.corrcoef(values, other)[0, 1])
        if abs(correlation) > abs(best[0]):
            best = (correlation, input_name, np.polyfit(other, values, 1))
    correlation, input_name, (gain, offset) = best
    # with a weaker correlation the gain would be noise
    if abs(correlation) < 0.9:
        level = float(np.median(values))
        tolerance = max(_HELD_TOLERANCE * abs(level), 1e-9)
        return InputRelation(input=name, kind="held", offset=level, tolerance=tolerance)
    return InputRelation(
        input=name,
        kind="proportional",
        offset=float(offset),
        channels=(input_name,),
        gains=(float(gain),),
        tolerance=max(_HELD_TOLERANCE * float(np.ptp(values)), 1e-9),
    )


def _relate_collinear_inputs(
    samples: Sequence[np.ndarray], names: Sequence[str], input_names: Sequence[str]
) -> list[InputRelation]:
    """Return the relations of inputs that another input before them explains almost completely."""
    pooled_samples = np.concatenate(samples)
    relations = []
    for k, name in enumerate(input_names):
        relation = _relate_unexcited_input(name, samples, names, input_names[:k])
        if relation.kind != "proportional":
            continue
        other = pooled_samples[:, names.index(relation.channels[0])]
        correlation = float(np.corrcoef(pooled_samples[:, names.index(name)], other)[0, 1])
        if correlation**2 > 1.0 - 1.0 / MAX_VARIANCE_INFLATION:
            relations.append(relation)
    return relations


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
    heading_column = names.index("psi")
    pooled_samples = np.concatenate(samples)
    reference = float(np.angle(np.exp(1j * pooled_samples[:, heading_column]).mean()))
    velocity_names = tuple(name for name in ("v", "r") if name in names)
    law = InputRelation(
        input=feedback.name,
        kind="feedback",
        offset=0.0,
        channels=velocity_names,
        gains=(0.0,) * len(velocity_names),
        heading=reference,
        tolerance=1e-9,
    )
    # the regression has a constant of its own
    designs = [_relation_regressors(law, sample, names)[:, 1:] for sample in samples]
    responses = [sample[:, names.index(law.input)] for sample in samples]
    if len(samples) < 2 or cross_validated_r2(designs, responses) < _MIN_LAW_R2:
        return None
    design = np.column_stack((np.ones(len(pooled_samples)), np.concatenate(designs)))
    coefficients = np.linalg.lstsq(design, np.concatenate(responses), rcond=None)[0]
    return law.model_copy(
        update={
            "offset": float(coefficients[0]),
            "heading_gain": float(coefficients[1]),
            "gains": tuple(coefficients[2:].tolist()),
        }
    )
