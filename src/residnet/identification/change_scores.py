"""Score tests of system changes: scores, information, and their variance over clean logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.identification.changes import SystemChange

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
    """Return sums over windows of scores and information.

    The innovations of a window are given several times, for the whole window and for divisions of
    it into shorter free runs. A window that no plausible change explains has a manoeuvre outside
    the range of the model. It is weighted by the inverse of its unexplained residual.

    Args:
        innovations_and_effects: for each division into free runs of n values, the innovations
            [B, runs n] of B windows and their derivatives by the sizes of C changes [B, C, runs n].
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
    n_changes = len(hypotheses)
    # clean logs are assumed to have correct sensors: a sensor fault such as a gain is nearly
    # collinear with the motion itself and would absorb other biases
    prior_std = np.array([0.0 if cause.sensor else cause.size * PRIOR_STD for cause in hypotheses])
    bias_by_channel = np.zeros((n_changes, n_channels))
    for channel in range(n_channels):
        channel_innovations = innovation[:, channel::n_channels].ravel()
        channel_effects = (
            effects[:, :n_changes, channel::n_channels]
            .swapaxes(1, 2)
            .reshape(len(channel_innovations), n_changes)
            * prior_std
        )
        regularized_gram = channel_effects.T @ channel_effects + np.mean(
            channel_innovations**2
        ) * np.eye(n_changes)
        bias_by_channel[:, channel] = prior_std * np.linalg.solve(
            regularized_gram, channel_effects.T @ channel_innovations
        )
    return bias_by_channel


def compute_whitening_matrix(innovations: np.ndarray, n_parts: int) -> np.ndarray:
    """Return the matrix [n, n] that makes innovations of clean logs uncorrelated.

    Args:
        innovations: innovations [B, n_parts n] of windows in `n_parts` free runs.
        n_parts: number of free runs of a window.
    """
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
        score: score of each change [G, Q]; [G, F, Q] for the models of F folds.
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
        inflation_factor: standard deviation of the sizes of long clean segments, relative to their
            standard errors by this distribution.
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
        n_changes = len(self.noise_factor)
        degrees_of_freedom = max(self.n_groups - n_changes - 1, 1)
        return (
            max((self.n_groups - 1) / degrees_of_freedom, 1.0)
            * self.n_groups
            / (degrees_of_freedom + 1)
        )

    def select_changes(self, change_indices: Sequence[int]) -> ScoreDistribution:
        """Return the distribution of the changes with these indices only."""
        indices = list(change_indices)
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

        The explained square of a change is the reduction of the joint score statistic of all
        changes, so that changes are compared on the same scores.
        """
        weighted_scores, weighted_information, design_effect = self.weigh_by_log(groups)
        weighted_scores = weighted_scores / design_effect
        weights = (
            np.diagonal(weighted_information, axis1=1, axis2=2) / design_effect + _TINY_INFORMATION
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
    n_groups, n_changes = score.shape
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
    shrinkage_weight = n_groups / (n_groups + n_changes)
    correlation = shrinkage_weight * second_moment / np.outer(
        root_mean_squares, root_mean_squares
    ) + (1.0 - shrinkage_weight) * np.eye(n_changes)
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
    groups: GroupScores, fold_of_group: np.ndarray, groups_per_segment: int
) -> float:
    """Return the observed scatter of clean segments, relative to that expected from other logs.

    Wind, waves and model errors differ between logs and persist for minutes. The expected scatter
    of a whole segment is therefore tested by cross-validation over logs.

    Args:
        groups: groups of clean windows in time order.
        fold_of_group: fold of each group [G].
        groups_per_segment: number of groups per segment.
    """
    standardized_sizes = []
    for held_out_fold in np.unique(fold_of_group):
        fold_indices = np.flatnonzero(fold_of_group == held_out_fold)
        distribution = fit_score_distribution(groups[fold_of_group != held_out_fold])
        for segment_start in range(0, len(fold_indices), groups_per_segment):
            sizes, standard_errors, _ = distribution.estimate_sizes(
                groups[fold_indices[segment_start : segment_start + groups_per_segment]]
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
