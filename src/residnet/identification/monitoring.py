"""Change detection by score tests on the innovations of short free runs.

Windows are free-run as a whole and in parts, each from its measured start. The bias of the model on
clean logs is subtracted from the innovations, which are whitened by their covariance over clean
logs. For each possible change the score test evaluates whether a small change of this kind explains
the recent windows, after wind and current are marginalised. The scatter of the scores over clean
logs sets the scale of the scores. The joint scores of all changes rank the explanations.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import DYNAMIC_STATES, HEADING, DegreesOfFreedom
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout
from residnet.identification.changes import (
    PerturbedDynamics,
    SystemChange,
    compute_sensor_effect,
    make_fault_hypotheses,
    make_nuisance_changes,
)
from residnet.physics.symmetry import get_dof
from residnet.preprocessing.prepare import PreparedLog


def innovation_columns(dof: DegreesOfFreedom) -> dict[str, int]:
    """Return the channels of the innovations with their columns in states."""
    columns = {name: dof.state_names.index(name) for name in dof.active_states}
    return columns | ({"heading": HEADING} if dof.has_heading else {})


_WARMUP_DURATION = 5.0
"""Measured time in s before a window from which the memory of a head is initialised."""
_MAX_BLOCKS = 5
"""Largest number of blocks of a window; errors are averaged over each, which reduces noise."""


@dataclass(frozen=True)
class MeasuredWindow:
    """A measured window of K steps.

    Attributes:
        y: states [K + 1, 3 + n].
        w: inputs held over each step [K, m].
        past_y: states before the window, which initialise a memory [P, 3 + n].
        past_w: inputs before the window [P, m].
    """

    y: np.ndarray
    w: np.ndarray
    past_y: np.ndarray
    past_w: np.ndarray


def compute_innovations(
    model: HybridDynamics, windows: Sequence[MeasuredWindow], changes: Sequence[SystemChange]
) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations [B, k] and their derivatives by the size of each change [B, C, k].

    Args:
        model: model in float64 and evaluation mode.
        windows: B windows of equal length, whose measured pasts also have equal length.
        changes: C changes of the vessel, its environment or a sensor.
    """
    y = torch.from_numpy(np.stack([window.y for window in windows]))
    w = torch.from_numpy(np.stack([window.w for window in windows]))
    no_change = SystemChange("none", "", "", 1.0)
    # the nominal run and all changed ones are one batch: C + 1 blocks of B rows
    all_changes = [no_change, *changes]
    n_windows = len(windows)
    n_steps = w.shape[1]
    n_changes = len(all_changes)
    n_blocks = min(_MAX_BLOCKS, n_steps)
    block_average = torch.zeros(n_blocks, n_steps, dtype=torch.float64)
    block_edges = np.linspace(0, n_steps, n_blocks + 1).round().astype(int)
    for block, (block_start, block_stop) in enumerate(pairwise(block_edges.tolist())):
        block_average[block, block_start:block_stop] = 1.0 / (block_stop - block_start)
    with torch.no_grad():
        initial_memory = model.warmup(
            torch.from_numpy(np.stack([window.past_y for window in windows])),
            torch.from_numpy(np.stack([window.past_w for window in windows])),
        )
        initial_accelerations = (y[:, 1] - y[:, 0])[:, DYNAMIC_STATES] / model.dt
        x0 = torch.cat(
            [
                y[:, 0]
                + compute_sensor_effect(
                    applied_change.sensor, y[:, 0], initial_accelerations, applied_change.size
                )
                for applied_change in all_changes
            ]
        )
        perturbed_model = PerturbedDynamics(model, all_changes, n_windows, w.shape[2])
        predicted_states, _, _ = compile_rollout(Rollout(perturbed_model), n_steps)(
            x0, w.repeat(n_changes, 1, 1), initial_memory.repeat(n_changes, 1)
        )
    predicted_states = predicted_states.reshape(n_changes, n_windows, n_steps + 1, -1)
    # sensor faults are computed from predicted states: with measured states, their effects would be
    # correlated with the measurement noise in the innovations
    mean_accelerations = (
        block_average @ predicted_states[0].diff(dim=1)[..., DYNAMIC_STATES] / model.dt
    )
    predicted_states = block_average @ predicted_states[:, :, 1:]
    columns = [*innovation_columns(get_dof(model.signals.names)).values()]
    innovation = _flatten_innovations(block_average @ y[:, 1:] - predicted_states[0], columns)
    effects = [
        _flatten_innovations(
            predicted_states[change_index + 1] - predicted_states[0]
            if not change.sensor
            else compute_sensor_effect(
                change.sensor, predicted_states[0], mean_accelerations, change.size
            )
            - (predicted_states[change_index + 1] - predicted_states[0]),
            columns,
        )
        / change.size
        for change_index, change in enumerate(changes)
    ]
    if not effects:
        return innovation.numpy(), np.zeros((len(innovation), 0, innovation.shape[1]))
    return innovation.numpy(), torch.stack(effects, dim=1).numpy()


def split_window(window: MeasuredWindow, n_parts: int) -> list[MeasuredWindow]:
    """Return equal parts of a window, each with its measured past; a remainder is dropped."""
    n_warmup = len(window.past_y)
    steps_per_part = len(window.w) // n_parts
    y = np.concatenate((window.past_y, window.y))
    w = np.concatenate((window.past_w, window.w))
    return [
        MeasuredWindow(
            y[n_warmup + part_start : n_warmup + part_start + steps_per_part + 1],
            w[n_warmup + part_start : n_warmup + part_start + steps_per_part],
            y[part_start : n_warmup + part_start],
            w[part_start : n_warmup + part_start],
        )
        for part_start in range(0, n_parts * steps_per_part, steps_per_part)
    ]


def _flatten_innovations(states: Tensor, columns: Sequence[int]) -> Tensor:
    """Return columns [c] of differences of states [B, k, 3 + n] as innovations [B, k c]."""
    return states[..., list(columns)].flatten(1)


def make_measured_windows(log: PreparedLog, n_steps: int, n_warmup: int) -> list[MeasuredWindow]:
    """Return back-to-back windows of a log whose samples are all usable.

    Args:
        log: log, prepared as the logs of the fit.
        n_warmup: samples before a window for the warm-up of a memory; the first windows have none.
    """
    windows = []
    window_start = n_warmup
    while window_start + n_steps < len(log):
        row_slice = slice(window_start - n_warmup, window_start + n_steps + 1)
        is_trusted = (
            log.usable[row_slice]
            & (log.segment[row_slice] == log.segment[window_start])
            & (log.segment[window_start] >= 0)
        )
        if not is_trusted.all():
            # the next window starts after the last unusable sample
            window_start = row_slice.start + int(np.flatnonzero(~is_trusted)[-1]) + 1 + n_warmup
            continue
        windows.append(
            MeasuredWindow(
                log.y[window_start : window_start + n_steps + 1],
                log.w[window_start : window_start + n_steps],
                log.y[window_start - n_warmup : window_start],
                log.w[window_start - n_warmup : window_start],
            )
        )
        window_start += n_steps
    return windows


def count_warmup_samples(model: HybridDynamics) -> int:
    """Return the number of samples that initialise the memory of a model; 0 without memory."""
    return round(_WARMUP_DURATION / model.dt) if model.n_state else 0


_SHRINKAGE = 0.1
"""Shrinkage of the covariance of innovations towards its diagonal."""
PRIOR_STD = 15.0
"""Prior standard deviation of the bias of a model, in units of the `size` of each change."""


@dataclass(frozen=True)
class ScoreSums:
    """Sums over windows.

    Attributes:
        score: scores, the gradients of the log-likelihood [Q].
        information: Fisher information [Q, Q].
        squared_innovations: squares of the innovations [n].
        n_windows: number of windows.
    """

    score: np.ndarray
    information: np.ndarray
    squared_innovations: np.ndarray
    n_windows: int

    def __add__(self, other: ScoreSums) -> ScoreSums:
        field_pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return ScoreSums(*(value + other_value for value, other_value in field_pairs))


def compute_robust_score_sums(
    innovations_and_effects: Sequence[tuple[np.ndarray, np.ndarray]],
    whitening_matrices: Sequence[np.ndarray],
    prior_precision: np.ndarray,
) -> ScoreSums:
    """Return sums over windows of scores and information, from whole windows and from parts.

    A window that no plausible change explains holds a manoeuvre outside the model. It is weighted
    by the inverse of its unexplained residual.

    Args:
        innovations_and_effects: innovations [B, parts n] and effects [B, C, parts n] of each
            division.
        whitening_matrices: matrix [n, n] of each division.
        prior_precision: prior precision of the sizes of the changes [C, C].
    """
    sums_by_division = []
    n_innovations = 0
    for (innovation, effects), whitening_matrix in zip(
        innovations_and_effects, whitening_matrices, strict=True
    ):
        block_size = len(whitening_matrix)
        (n_windows, n_changes, n_values) = effects.shape
        whitened_innovations = (
            innovation.reshape(n_windows, -1, block_size) @ whitening_matrix.T
        ).reshape(n_windows, n_values)
        whitened_effects = (
            effects.reshape(n_windows, n_changes, -1, block_size) @ whitening_matrix.T
        ).reshape(effects.shape)
        sums_by_division.append(
            (
                np.einsum("bqn,bn->bq", whitened_effects, whitened_innovations),
                whitened_effects @ whitened_effects.swapaxes(1, 2),
                whitened_innovations**2,
            )
        )
        n_innovations += n_values
    scores, informations, squares = zip(*sums_by_division, strict=True)
    score = np.sum(scores, axis=0)
    information = np.sum(informations, axis=0)
    # the most plausible sizes for each window alone; the rest of the square is unexplained
    estimated_sizes = np.linalg.solve(information + prior_precision, score[..., None])[..., 0]
    unexplained_squares = np.sum(
        [division_squares.sum(axis=1) for division_squares in squares], axis=0
    ) - (score * estimated_sizes).sum(axis=1)
    window_weights = 1.0 / np.maximum(unexplained_squares / n_innovations, 1.0)
    return ScoreSums(
        window_weights @ score,
        np.tensordot(window_weights, information, 1),
        squares[0].sum(axis=0),
        len(squares[0]),
    )


def marginalise(
    score: np.ndarray, information: np.ndarray, n_target_changes: int, prior_precision: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return scores [..., Q] and information [..., Q, Q] with nuisance parameters marginalised.

    Args:
        score: scores of Q changes, then of n environment parameters [..., Q + n].
        information: Fisher information of changes and environment [..., Q + n, Q + n].
        n_target_changes: number Q of changes whose scores are returned.
        prior_precision: prior precision of the environment parameters [n, n].
    """
    target_information = information[..., :n_target_changes, :n_target_changes]
    cross_information = information[..., n_target_changes:, :n_target_changes]
    # Schur complement: information about the changes that wind and current do not also explain
    regression_coefficients = np.linalg.solve(
        information[..., n_target_changes:, n_target_changes:] + prior_precision, cross_information
    )
    marginal_information = (
        target_information
        - information[..., :n_target_changes, n_target_changes:] @ regression_coefficients
    )
    explained_score = np.einsum(
        "...np,...n->...p", regression_coefficients, score[..., n_target_changes:]
    )
    return score[..., :n_target_changes] - explained_score, marginal_information + 1e-300 * np.eye(
        n_target_changes
    )


def estimate_model_bias(
    innovation: np.ndarray, effects: np.ndarray, hypotheses: Sequence[SystemChange], n_channels: int
) -> np.ndarray:
    """Return the bias of a model on clean logs: a size [Q, 4] of each change for each channel.

    The sizes differ between channels, since no single set of sizes corrects an error of the model
    structure.

    Args:
        innovation: innovations [B, n] of clean logs.
        effects: derivatives by the size of each change [B, C, n], hypotheses first.
        hypotheses: Q changes.
        n_channels: number of channels of the innovations.
    """
    n_causes = len(hypotheses)
    # clean logs are assumed to have correct sensors: a sensor fault such as a gain is nearly
    # collinear with the motion itself and would absorb other biases
    prior_std = np.array([0.0 if cause.sensor else cause.size * PRIOR_STD for cause in hypotheses])
    bias_by_channel = np.zeros((n_causes, n_channels))
    for channel in range(n_channels):
        channel_innovations = innovation[:, channel::n_channels].ravel()
        channel_effects = (
            effects[:, :n_causes, channel::n_channels]
            .swapaxes(1, 2)
            .reshape(len(channel_innovations), n_causes)
            * prior_std
        )
        regularized_gram = channel_effects.T @ channel_effects + np.mean(
            channel_innovations**2
        ) * np.eye(n_causes)
        bias_by_channel[:, channel] = prior_std * np.linalg.solve(
            regularized_gram, channel_effects.T @ channel_innovations
        )
    return bias_by_channel


def compute_whitening_matrix(innovations: np.ndarray, n_parts: int) -> np.ndarray:
    """Return the matrix [n, n] that makes innovations [B, parts n] of clean logs uncorrelated."""
    # windows with a diverged free run have zero innovations, see `compute_innovations`
    innovations = innovations[(innovations != 0.0).any(axis=1)]
    innovations = innovations.reshape(len(innovations) * n_parts, -1)
    second_moment = innovations.T @ innovations / len(innovations)
    covariance = (1.0 - _SHRINKAGE) * second_moment + _SHRINKAGE * np.diag(np.diag(second_moment))
    whitening_matrix: np.ndarray = np.linalg.inv(
        np.linalg.cholesky(covariance + 1e-18 * np.eye(len(second_moment)))
    )
    return whitening_matrix


_NOISE_VARIANCE_GRID = np.geomspace(1.0, 30.0, 25)
"""Grid of noise variances, relative to white innovations."""
_SIZE_VARIANCE_GRID = np.concatenate(([0.0], np.geomspace(1e-4, 1e3, 40)))
"""Grid of size variances, relative to the median information of a group."""
_MAX_DEVIANCE_DIFFERENCE = 1.0
"""Largest deviance, relative to the maximum likelihood, of an accepted larger scatter.

A difference of 1 is one standard error. The larger scatter is used because the model was fitted on
the clean logs, so that they scatter less than new logs.
"""
_TINY_INFORMATION = 1e-12
"""Lower bound of an information in a denominator."""
_HUBER_CONSTANT = 1.345
"""Tuning constant of the Huber weights in standard deviations; the usual value.

It has 95 % efficiency for normal errors.
"""
_HUBER_ITERATIONS = 8
"""Number of reweighting iterations."""


@dataclass(frozen=True)
class GroupScores:
    """Scores of G groups of windows, with the environment marginalised.

    Attributes:
        log_index: log of each group [G].
        score: score of each change [G, Q]; [G, F, Q] with F cross-fitted values.
        information: Fisher information of the changes [G, Q, Q].
    """

    log_index: np.ndarray
    score: np.ndarray
    information: np.ndarray

    def __getitem__(self, selection: np.ndarray | slice) -> GroupScores:
        return GroupScores(
            self.log_index[selection], self.score[selection], self.information[selection]
        )

    @property
    def diagonal_information(self) -> np.ndarray:
        """Information about the size of each change alone [G, Q], at least a tiny number."""
        return np.diagonal(self.information, axis1=1, axis2=2) + _TINY_INFORMATION

    def subtract_bias(self, bias: np.ndarray) -> GroupScores:
        """Return the groups without the scores expected from a bias [Q] of the sizes."""
        return replace(self, score=self.score - self.information @ bias)

    def sum_by_log(self, values: np.ndarray) -> np.ndarray:
        """Return the sums of values [G, ...] over the groups of each log [K, ...]."""
        log_indices = dict.fromkeys(self.log_index.tolist())
        return np.stack(
            [values[self.log_index == log_index].sum(axis=0) for log_index in log_indices]
        )


@dataclass(frozen=True)
class ScoreDistribution:
    """Distribution of the scores of clean groups.

    Attributes:
        noise_factor: variance of each score in units of its information [Q].
        size_variance: variance of the apparent sizes of groups [Q].
        shared_size_variance: part of `size_variance` that is common to the groups of a log [Q].
        mean_size_variance: variance of the mean size over all clean logs [Q].
        correlation: correlation of the scores of different changes [Q, Q].
        n_groups: number of clean groups.
        inflation_factor: ratio of the scatter of long clean segments to the scatter in this model.
    """

    noise_factor: np.ndarray
    size_variance: np.ndarray
    shared_size_variance: np.ndarray
    mean_size_variance: np.ndarray
    correlation: np.ndarray
    n_groups: int
    inflation_factor: float = 1.0

    def variance(self, diagonal_information: np.ndarray) -> np.ndarray:
        """Return the variance of scores [..., Q] with diagonal information [..., Q]."""
        return np.asarray(
            self.noise_factor * diagonal_information + self.size_variance * diagonal_information**2
        )

    @property
    def wishart_inflation(self) -> float:
        """Factor on variances because their covariance matrix is itself an estimate.

        Optimal weights from few groups underestimate the variance (R. N. Kackar and D. A. Harville,
        1984); the factors are those of the Wishart distribution.
        """
        n_causes = len(self.noise_factor)
        degrees_of_freedom = max(self.n_groups - n_causes - 1, 1)
        return (
            max((self.n_groups - 1) / degrees_of_freedom, 1.0)
            * self.n_groups
            / (degrees_of_freedom + 1)
        )

    def select_causes(self, cause_indices: Sequence[int]) -> ScoreDistribution:
        """Return the distribution of selected changes, by index."""
        indices = list(cause_indices)
        selected_fields = {
            name: getattr(self, name)[indices]
            for name in (
                "noise_factor",
                "size_variance",
                "shared_size_variance",
                "mean_size_variance",
            )
        }
        return replace(
            self, correlation=self.correlation[np.ix_(indices, indices)], **selected_fields
        )

    def weigh_by_log(self, groups: GroupScores) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return scores [K, ..., Q] and information [K, Q, Q] of each log, weighted by the scatter.

        The groups of one log are correlated. The third result is the variance inflation by this
        correlation (design effect 1 + (m - 1) rho) [K, Q].
        """
        diagonal_information = groups.diagonal_information
        variance = self.variance(diagonal_information)
        std = np.sqrt(variance)
        covariance = self.correlation * std[:, :, None] * std[:, None, :]
        gain = np.linalg.solve(covariance, groups.information).swapaxes(1, 2)
        weighted_scores = groups.sum_by_log(np.einsum("gqp,g...p->g...q", gain, groups.score))
        weighted_information = groups.sum_by_log(gain @ groups.information)
        n_groups_of_log = groups.sum_by_log(np.ones_like(diagonal_information))
        intraclass_correlation = (
            groups.sum_by_log(self.shared_size_variance * diagonal_information**2 / variance)
            / n_groups_of_log
        )
        return (
            weighted_scores,
            weighted_information,
            1.0 + (n_groups_of_log - 1.0) * intraclass_correlation,
        )

    def estimate_sizes(self, groups: GroupScores) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the size of each change alone [Q], its standard error, and the explained square.

        All scores are used jointly for each change. The explained square is the reduction of the
        joint score statistic. All changes are compared on the same scores: agreement between logs
        on the size of one change, or its small variance on clean logs, is no evidence for another
        one.
        """
        weighted_scores, weighted_information, redundancy = self.weigh_by_log(groups)
        weighted_scores = weighted_scores / redundancy
        weights = (
            np.diagonal(weighted_information, axis1=1, axis2=2) / redundancy + _TINY_INFORMATION
        )
        sizes, total_weight = _huber_mean(weighted_scores, weights)
        inflation = self.wishart_inflation * self.inflation_factor**2
        explained_squares = weighted_scores.sum(axis=0) ** 2 / weights.sum(axis=0) / inflation
        return (
            sizes,
            np.sqrt((1.0 / total_weight + self.mean_size_variance) * inflation),
            explained_squares,
        )


def _huber_mean(weighted_sizes: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the size [Q] on which logs agree, and the weight behind it (P. J. Huber, 1964).

    A change of the vessel appears in all logs. A single log with a deviating size, such as one with
    a rare manoeuvre, has a linear instead of a quadratic influence.

    Args:
        weighted_sizes: sizes times weights of the logs [K, Q].
        weights: inverse variances of the sizes [K, Q].
    """
    sizes_by_log = weighted_sizes / weights
    root_weights = np.sqrt(weights)
    huber_weights = np.ones_like(weights)
    mean_size = weighted_sizes.sum(axis=0) / weights.sum(axis=0)
    for _ in range(_HUBER_ITERATIONS):
        standardized_residuals = np.abs(sizes_by_log - mean_size) * root_weights
        huber_weights = np.minimum(1.0, _HUBER_CONSTANT / np.maximum(standardized_residuals, 1e-9))
        mean_size = (huber_weights * weighted_sizes).sum(axis=0) / (huber_weights * weights).sum(
            axis=0
        )
    return mean_size, (huber_weights * weights).sum(axis=0)


def fit_score_distribution(groups: GroupScores) -> ScoreDistribution:
    """Estimate the distribution of the scores of groups of clean windows about zero."""
    score = groups.score
    diagonal_information = groups.diagonal_information
    n_groups, n_causes = score.shape
    noise_factor, size_variance = np.array(
        [
            _fit_variance_components(*values)
            for values in zip(score.T, diagonal_information.T, strict=True)
        ]
    ).T
    variance = noise_factor * diagonal_information + size_variance * diagonal_information**2
    standardized_scores = score / np.sqrt(variance)
    second_moment = standardized_scores.T @ standardized_scores / n_groups
    root_mean_squares = np.sqrt(np.diag(second_moment)) + _TINY_INFORMATION
    # correlations estimated from few groups are unreliable: shrinkage towards independence
    shrinkage_weight = n_groups / (n_groups + n_causes)
    correlation = shrinkage_weight * second_moment / np.outer(
        root_mean_squares, root_mean_squares
    ) + (1.0 - shrinkage_weight) * np.eye(n_causes)
    np.fill_diagonal(correlation, 1.0)
    # covariance of pairs of groups within logs: (sum)^2 - sum of squares = sum over pairs; without
    # any pair all variance is assumed to be common, the conservative case
    common_square, common_weight = (
        (groups.sum_by_log(values) ** 2 - groups.sum_by_log(values**2)).sum(axis=0)
        for values in (diagonal_information * score / variance, diagonal_information**2 / variance)
    )
    shared_variance = (
        np.clip(common_square / np.maximum(common_weight, 1e-300), 0.0, size_variance)
        if common_weight.any()
        else size_variance
    )
    log_precision = groups.sum_by_log(
        diagonal_information**2 / (variance - shared_variance * diagonal_information**2)
    )
    mean_size_variance = 1.0 / (
        _TINY_INFORMATION + (log_precision / (1.0 + shared_variance * log_precision)).sum(axis=0)
    )
    return ScoreDistribution(
        noise_factor, size_variance, shared_variance, mean_size_variance, correlation, n_groups
    )


def estimate_score_inflation(
    groups: GroupScores, fold_of_group: np.ndarray, groups_per_stretch: int
) -> float:
    """Return the observed scatter of clean segments, relative to that expected from other logs.

    Wind, waves and model errors differ between logs and persist for minutes. The expected scatter
    of a whole segment is therefore tested by cross-validation over logs.

    Args:
        groups: groups of clean windows in time order.
        fold_of_group: fold of each group [G].
        groups_per_stretch: number of groups per segment.
    """
    standardized_sizes = []
    for held_out_fold in np.unique(fold_of_group):
        fold_indices = np.flatnonzero(fold_of_group == held_out_fold)
        distribution = fit_score_distribution(groups[fold_of_group != held_out_fold])
        for stretch_start in range(0, len(fold_indices), groups_per_stretch):
            sizes, standard_errors, _ = distribution.estimate_sizes(
                groups[fold_indices[stretch_start : stretch_start + groups_per_stretch]]
            )
            standardized_sizes.append(sizes / standard_errors)
    return max(1.0, float(np.sqrt(np.mean(np.square(standardized_sizes)))))


def _fit_variance_components(
    scores: np.ndarray, diagonal_information: np.ndarray
) -> tuple[float, float]:
    """Return the variances of noise and sizes of scores [G], at their upper standard error."""
    size_variances = _SIZE_VARIANCE_GRID / np.median(diagonal_information)
    variance = (
        _NOISE_VARIANCE_GRID[:, None, None] * diagonal_information[None, None, :]
        + size_variances[None, :, None] * diagonal_information[None, None, :] ** 2
    )
    log_determinant = np.log(variance).sum(axis=2)
    deviance = log_determinant + (scores**2 / variance).sum(axis=2)
    # the largest scatter among the acceptable ones, since few logs determine it poorly
    is_acceptable = deviance <= deviance.min() + _MAX_DEVIANCE_DIFFERENCE
    i, j = np.unravel_index(
        int(np.where(is_acceptable, log_determinant, -np.inf).argmax()), deviance.shape
    )
    return float(_NOISE_VARIANCE_GRID[i]), float(size_variances[j])


_LOOKS_PER_STRETCH = 3.0
"""Equivalent number of independent tests while the sliding tested period moves by its length."""
_N_FOLDS = 5
"""Number of folds of clean windows for cross-fitted scales."""
_MIN_GROUPS = 5
"""Smallest number of groups of clean windows from which a false alarm rate can be estimated."""
_N_WINDOW_PARTS = 5
"""Number of parts of a window that are also free-run, each from its measured start."""
_MIN_PART_STEPS = 10
"""Smallest number of steps of a part; shorter windows are not divided."""
_DIVERGENCE_FACTOR = 3.0
"""Innovation above which a free run has diverged, relative to the largest clean velocity."""
_MAX_HEADING_INNOVATION = 2.0 * np.pi
"""Innovation of the heading above which a free run has diverged."""
_MAX_DIVERGED_SHARE = 0.5
"""Largest share of clean windows with a diverged free run."""
_CURRENT_STD = 0.5
"""Prior standard deviation of a current in m/s."""
_PUSH_STD = 0.05
"""Prior standard deviation of the acceleration by the wind in m/s^2."""


class MonitorConfig(Config):
    """Settings of a monitor.

    Attributes:
        window: length of the free runs, in s.
        stretch: length of the recent period that is tested, in s.
        false_alarm: mean time between false alarms, in s.
        group: length of the stretches of clean logs whose scatter sets the scale, in s.
    """

    window: Seconds = Field(default=10.0, gt=0)
    stretch: Seconds = Field(default=300.0, gt=0)
    false_alarm: Seconds = Field(default=36_000.0, gt=0)
    group: Seconds = Field(default=60.0, gt=0)


@dataclass(frozen=True)
class FaultHypothesis:
    """A possible change with its test statistic and estimated size.

    Attributes:
        change: the change.
        test_statistic: statistic of the score test, in standard deviations of clean logs.
        estimated_size: size of the change in its unit.
        standard_error: standard error of the size.
        score_reduction: reduction of the joint score statistic by this change alone.
    """

    change: SystemChange
    test_statistic: float
    estimated_size: float
    standard_error: float
    score_reduction: float


@dataclass(frozen=True)
class MonitorVerdict:
    """Verdict of a monitor after a window.

    Attributes:
        is_alarm: whether the largest score exceeds the threshold; an online detector keeps the
            alarm until the scores are clearly below the threshold.
        threshold: threshold of the scores.
        hypotheses: possible changes in descending order of `score_reduction`.
        innovation_rms: root mean square of the whitened innovations of each channel; 1 on clean
            logs.
    """

    is_alarm: bool
    threshold: float
    hypotheses: Sequence[FaultHypothesis]
    innovation_rms: dict[str, float]

    @property
    def max_score(self) -> float:
        """The largest score of any change."""
        return max(hypothesis.test_statistic for hypothesis in self.hypotheses)


_InnovationsAndEffects = tuple[np.ndarray, np.ndarray]


class ChangeDetector:
    """Statistics of clean logs, and score tests against them.

    Args:
        spec: description of the model.
        model: the model.
        clean_windows: windows of clean logs, ordered by log; all of equal length.
        config: settings of the monitor.

    Raises:
        DataError: if there are too few clean logs.
    """

    def __init__(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        clean_windows: Sequence[Sequence[MeasuredWindow]],
        config: MonitorConfig,
    ) -> None:
        self.model = model.to(torch.float64).eval()
        self.config = config
        self.hypotheses = make_fault_hypotheses(spec.signals)
        self.innovation_columns = innovation_columns(spec.signals.dof)
        self.nuisance_changes = make_nuisance_changes()
        nuisance_precisions = [_CURRENT_STD**-2] * 2 + [_PUSH_STD**-2] * 2
        self.nuisance_precision = np.diag(nuisance_precisions)
        prior_precisions = [(PRIOR_STD * item.size) ** -2 for item in self.hypotheses]
        self.prior_precision = np.diag([*prior_precisions, *nuisance_precisions])
        self.window_steps = round(config.window / spec.dt)
        self.n_warmup = count_warmup_samples(model)
        indexed_groups = [
            (k, windows_of_group)
            for k, log_of_group in enumerate(clean_windows)
            for windows_of_group in self.group_windows(log_of_group)
        ]
        if len(indexed_groups) < _MIN_GROUPS:
            raise DataError(
                f"the clean logs hold {len(indexed_groups)} stretches of {config.group:g} s; a"
                f" monitor needs at least {_MIN_GROUPS} to estimate the scatter of innovations"
            )
        log_of_group = np.array([k for k, _ in indexed_groups])
        self.divergence_limits = self._find_divergence_limits(
            [window for _, windows_of_group in indexed_groups for window in windows_of_group]
        )
        self.part_counts = (
            [1, _N_WINDOW_PARTS] if self.window_steps >= _MIN_PART_STEPS * _N_WINDOW_PARTS else [1]
        )
        innovations_by_group = [
            [self.compute_innovations(windows_of_group, parts) for parts in self.part_counts]
            for _, windows_of_group in indexed_groups
        ]
        has_diverged = np.concatenate(
            [(group[0][0] == 0.0).all(axis=1) for group in innovations_by_group]
        )
        if has_diverged.mean() > _MAX_DIVERGED_SHARE:
            raise DataError(
                f"model {spec.name}: free runs of {config.window:g} s diverge in"
                f" {has_diverged.sum()} of {len(has_diverged)} clean windows; use another model or"
                f" a shorter window"
            )
        model_bias = self._estimate_bias(innovations_by_group)
        self.whitening_matrices = [
            compute_whitening_matrix(
                np.concatenate(
                    [
                        innovations_of_group[i][0]
                        - self.expected_innovations(innovations_of_group[i][1], model_bias[i])
                        for innovations_of_group in innovations_by_group
                    ]
                ),
                parts,
            )
            for i, parts in enumerate(self.part_counts)
        ]
        # groups of one log are correlated, so that folds consist of whole logs if there are enough
        fold_of_group = (
            log_of_group
            if len(set(log_of_group)) >= _N_FOLDS
            else np.arange(len(innovations_by_group))
        ) % _N_FOLDS
        self.bias_by_fold, cross_validated_groups = self._cross_validate(
            innovations_by_group, model_bias, log_of_group, fold_of_group, np.diag(prior_precisions)
        )
        groups_per_stretch = max(round(config.stretch / config.group), 1)
        self.score_distribution = replace(
            fit_score_distribution(cross_validated_groups),
            inflation_factor=estimate_score_inflation(
                cross_validated_groups, np.sort(fold_of_group), groups_per_stretch
            ),
        )
        # two-sided threshold with a Bonferroni correction over tests in time and hypotheses
        n_looks = config.false_alarm / config.stretch * _LOOKS_PER_STRETCH * len(self.hypotheses)
        self.threshold = float(scipy.stats.t.isf(0.5 / n_looks, len(innovations_by_group) - 1))

    def _find_divergence_limits(self, clean_windows: Sequence[MeasuredWindow]) -> np.ndarray:
        """Return the innovations above which a free run has diverged, by innovation column."""
        max_states = np.max([np.abs(window.y).max(axis=0) for window in clean_windows], axis=0)
        max_states[HEADING] = _MAX_HEADING_INNOVATION
        return np.asarray(_DIVERGENCE_FACTOR * max_states[[*self.innovation_columns.values()]])

    def _cross_validate(
        self,
        innovations_by_group: Sequence[Sequence[_InnovationsAndEffects]],
        model_bias: list[np.ndarray],
        log_of_group: np.ndarray,
        fold_of_group: np.ndarray,
        prior_precision: np.ndarray,
    ) -> tuple[list[tuple[list[np.ndarray], np.ndarray]], GroupScores]:
        """Estimate biases with all groups and without each fold, and the scores of each fold.

        In service the bias is estimated from other logs than those tested, so that scores scatter
        more than on the clean logs themselves.

        Args:
            innovations_by_group: innovations and effects of each group and division of windows.
            model_bias: model bias of all groups for each division of windows.
            log_of_group: number of the log of each group [G].
            fold_of_group: number of the fold of each group [G].
            prior_precision: prior precision of the sizes of the changes [Q, Q].

        Returns:
            Model bias and size bias [Q] of all groups and without each fold; the scores of each
            group with the biases of the other folds.
        """

        def estimate_size_bias(
            model_bias: list[np.ndarray], is_used: np.ndarray
        ) -> tuple[np.ndarray, GroupScores]:
            """Return the joint size bias [Q] of the used groups, and all groups without it."""
            group_scores = self._to_group_scores(
                log_of_group,
                [
                    self._compute_score_sums(innovations_of_group, model_bias)
                    for innovations_of_group in innovations_by_group
                ],
            )
            # the prior regularises changes with similar effects, such as damping and gain
            information = group_scores.information[is_used].sum(axis=0) + prior_precision
            size_bias = np.linalg.solve(information, group_scores.score[is_used].sum(axis=0))
            return size_bias, group_scores.subtract_bias(size_bias)

        biases = [(model_bias, estimate_size_bias(model_bias, log_of_group >= 0)[0])]
        held_out_groups = []
        for fold in range(_N_FOLDS):
            fold_model_bias = self._estimate_bias(
                [
                    innovations_of_group
                    for innovations_of_group, group_fold in zip(
                        innovations_by_group, fold_of_group, strict=True
                    )
                    if group_fold != fold
                ]
            )
            size_bias, groups = estimate_size_bias(fold_model_bias, fold_of_group != fold)
            biases.append((fold_model_bias, size_bias))
            held_out_groups.append(vars(groups[fold_of_group == fold]).values())
        cross_validated_groups = GroupScores(
            *(np.concatenate(parts) for parts in zip(*held_out_groups, strict=True))
        )
        return biases, cross_validated_groups

    def _estimate_bias(
        self, innovations_by_group: Sequence[Sequence[_InnovationsAndEffects]]
    ) -> list[np.ndarray]:
        """Return the model bias for each division of windows, from groups of clean windows."""
        bias_by_look = []
        for innovations_of_look in zip(*innovations_by_group, strict=True):
            innovation, effects = map(np.concatenate, zip(*innovations_of_look, strict=True))
            bias_by_look.append(
                estimate_model_bias(
                    innovation, effects, self.hypotheses, len(self.innovation_columns)
                )
            )
        return bias_by_look

    @classmethod
    def from_logs(
        cls,
        spec: ModelSpec,
        model: HybridDynamics,
        clean_logs: Sequence[PreparedLog],
        config: MonitorConfig,
    ) -> ChangeDetector:
        """Return the change detector of a model from clean logs, prepared as those of the fit."""
        n_steps = round(config.window / spec.dt)
        n_warmup = count_warmup_samples(model)
        return cls(
            spec,
            model,
            [make_measured_windows(log, n_steps, n_warmup) for log in clean_logs],
            config,
        )

    def make_windows(self, log: PreparedLog) -> list[MeasuredWindow]:
        """Return the windows of a new log.

        Raises:
            DataError: if it holds none.
        """
        windows = make_measured_windows(log, self.window_steps, self.n_warmup)
        if not windows:
            raise DataError(
                f"log {log.log.name}: holds no window of {self.config.window:g} s without a gap;"
                " shorten the window or remove the log"
            )
        return windows

    @property
    def all_changes(self) -> list[SystemChange]:
        """The changes of the vessel, then those of its environment."""
        return [*self.hypotheses, *self.nuisance_changes]

    def group_windows(self, windows: Sequence[MeasuredWindow]) -> list[Sequence[MeasuredWindow]]:
        """Divide the windows of a log into groups in which wind and current count as constant."""
        windows_per_group = max(round(self.config.group / self.config.window), 1)
        return [
            windows[first : first + windows_per_group]
            for first in range(0, len(windows), windows_per_group)
        ]

    def with_model(self, model: HybridDynamics) -> ChangeDetector:
        """Return the detector for another model, with the clean-log statistics of this one."""
        detector = copy.copy(self)
        detector.model = model
        return detector

    def compute_sums(self, windows: Sequence[MeasuredWindow]) -> list[ScoreSums]:
        """Return the scores of each of several windows."""
        innovations_and_effects = [
            self.compute_innovations(windows, n_parts) for n_parts in self.part_counts
        ]
        return [
            self._compute_score_sums(
                [
                    (innovation[i : i + 1], effects[i : i + 1])
                    for innovation, effects in innovations_and_effects
                ],
                self.bias_by_fold[0][0],
            )
            for i in range(len(windows))
        ]

    def compute_innovations(
        self, windows: Sequence[MeasuredWindow], n_parts: int
    ) -> _InnovationsAndEffects:
        """Return innovations [B, parts n] and effects [B, C, parts n] of windows cut into parts."""
        window_parts = [part for window in windows for part in split_window(window, n_parts)]
        innovation, effects = compute_innovations(self.model, window_parts, self.all_changes)
        n_windows = len(windows)
        effects_by_change = effects.reshape(n_windows, n_parts, len(self.all_changes), -1).swapaxes(
            1, 2
        )
        innovation = innovation.reshape(n_windows, -1)
        effects = effects_by_change.reshape(n_windows, len(self.all_changes), -1)
        limits = np.tile(self.divergence_limits, innovation.shape[1] // len(self.divergence_limits))
        change_sizes = np.array([change.size for change in self.all_changes])[:, None]
        # comparisons with NaN are false, so that NaN counts as diverged
        is_innovation_valid = (np.abs(innovation) <= limits).all(axis=1)
        has_diverged = np.asarray(
            ~(is_innovation_valid & (np.abs(effects * change_sizes) <= limits).all(axis=(1, 2)))
        )
        innovation[has_diverged], effects[has_diverged] = 0.0, 0.0
        return innovation, effects

    def expected_innovations(self, effects: np.ndarray, model_bias: np.ndarray) -> np.ndarray:
        """Return the expected innovations [B, n] of clean logs, given their effects [B, C, n].

        Args:
            model_bias: mean sizes on clean logs for this division of windows [Q, 4].
        """
        bias_by_column = np.tile(model_bias, effects.shape[2] // len(self.innovation_columns))
        return np.asarray((effects[:, : len(self.hypotheses)] * bias_by_column).sum(axis=1))

    def _compute_score_sums(
        self,
        innovations_and_effects: Sequence[_InnovationsAndEffects],
        bias_by_look: Sequence[np.ndarray],
    ) -> ScoreSums:
        """Return the score sums of windows, evaluated as a whole and in parts."""
        corrected_innovations = [
            (innovation - self.expected_innovations(effects, model_bias), effects)
            for (innovation, effects), model_bias in zip(
                innovations_and_effects, bias_by_look, strict=True
            )
        ]
        return compute_robust_score_sums(
            corrected_innovations, self.whitening_matrices, self.prior_precision
        )

    def _to_group_scores(
        self, log_indices: Sequence[int] | np.ndarray, sums_by_group: Sequence[ScoreSums]
    ) -> GroupScores:
        """Return scores and information of the changes with the environment marginalised."""
        score, information = (
            np.stack([getattr(group_sums, name) for group_sums in sums_by_group])
            for name in ("score", "information")
        )
        return GroupScores(
            np.asarray(log_indices),
            *marginalise(score, information, len(self.hypotheses), self.nuisance_precision),
        )

    def evaluate(
        self, log_indices: Sequence[int], sums_by_group: Sequence[ScoreSums]
    ) -> MonitorVerdict:
        """Return the verdict on groups of windows, each with its own wind and current.

        Args:
            log_indices: index of the log of each group.
            sums_by_group: score sums of each group.
        """
        group_scores = self._to_group_scores(log_indices, sums_by_group).subtract_bias(
            self.bias_by_fold[0][1]
        )
        sizes, standard_errors, explained_squares = self.score_distribution.estimate_sizes(
            group_scores
        )
        hypotheses = [
            FaultHypothesis(change, float(abs(a) / b), float(a), float(b), float(c))
            for change, a, b, c in zip(
                self.hypotheses, sizes, standard_errors, explained_squares, strict=True
            )
        ]
        is_alarm = max(hypothesis.test_statistic for hypothesis in hypotheses) > self.threshold
        hypotheses.sort(key=lambda hypothesis: -hypothesis.score_reduction)
        n_windows = sum(group_sums.n_windows for group_sums in sums_by_group)
        squares = (
            np.sum([group_sums.squared_innovations for group_sums in sums_by_group], axis=0)
            / n_windows
        )
        mean_squares = squares.reshape(-1, len(self.innovation_columns)).mean(axis=0)
        innovation_rms = dict(
            zip(self.innovation_columns, np.sqrt(mean_squares).tolist(), strict=True)
        )
        return MonitorVerdict(is_alarm, self.threshold, hypotheses, innovation_rms)


_ALARM_HYSTERESIS = 1.0
"""Standard deviations by which scores fall below the threshold before an alarm ends."""


class OnlineChangeDetector:
    """Sample-by-sample change detector.

    Alarms have hysteresis: an alarm ends when all scores are clearly below the threshold.

    Args:
        detector: statistics of clean logs.
    """

    def __init__(self, detector: ChangeDetector) -> None:
        self.detector = detector
        self.n_warmup = detector.n_warmup
        self.window_steps = detector.window_steps
        self.windows_per_group = max(round(detector.config.group / detector.config.window), 1)
        self.max_windows = max(round(detector.config.stretch / detector.config.window), 1)
        self.recent_groups: deque[tuple[int, ScoreSums]] = deque()
        self.log_index = 0
        self.is_group_closed = True
        self.is_alarmed = False
        self.measured_states: list[np.ndarray] = []
        self.measured_inputs: list[np.ndarray] = []

    def update(self, y: np.ndarray, w: np.ndarray) -> MonitorVerdict | None:
        """Take one sample: measured state [3 + n], and the inputs [m] held over the step after it.

        Returns:
            The verdict if a window is complete, else None. A sample with NaN ends its window.
        """
        if not (np.isfinite(y).all() and np.isfinite(w).all()):
            self.start_new_log()
            return None
        self.measured_states.append(np.asarray(y, dtype=float))
        self.measured_inputs.append(np.asarray(w, dtype=float))
        if len(self.measured_states) < self.n_warmup + self.window_steps + 1:
            return None
        states = np.stack(self.measured_states)
        inputs = np.stack(self.measured_inputs)
        window = MeasuredWindow(
            states[self.n_warmup :],
            inputs[self.n_warmup : -1],
            states[: self.n_warmup],
            inputs[: self.n_warmup],
        )
        # the last state of this window is the first of the next one
        n_retained = self.n_warmup + 1
        self.measured_states = self.measured_states[-n_retained:]
        self.measured_inputs = self.measured_inputs[-n_retained:]
        return self.update_with_sums(self.detector.compute_sums([window])[0])

    def start_new_log(self) -> None:
        """Begin a new log with its own wind and current."""
        self.measured_states = []
        self.measured_inputs = []
        self.log_index += 1
        self.is_group_closed = True

    def update_with_sums(self, window_sums: ScoreSums) -> MonitorVerdict:
        """Take the scores of a window, and return the verdict on the last stretch."""
        if self.is_group_closed or self.recent_groups[-1][1].n_windows >= self.windows_per_group:
            self.recent_groups.append((self.log_index, window_sums))
        else:
            self.recent_groups[-1] = (self.log_index, self.recent_groups[-1][1] + window_sums)
        self.is_group_closed = False
        windows_per_recent_group = [group.n_windows for _, group in self.recent_groups]
        while sum(windows_per_recent_group) - windows_per_recent_group[0] >= self.max_windows:
            self.recent_groups.popleft()
            windows_per_recent_group.pop(0)
        verdict = self.detector.evaluate(
            [log for log, _ in self.recent_groups],
            [group_sums for _, group_sums in self.recent_groups],
        )
        alarm_persists = (
            self.is_alarmed and verdict.max_score > verdict.threshold - _ALARM_HYSTERESIS
        )
        self.is_alarmed = verdict.is_alarm or alarm_persists
        return replace(verdict, is_alarm=self.is_alarmed)
