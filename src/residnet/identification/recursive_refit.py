"""Recursive refit: after an alarm, the sizes of a few changes are estimated log by log.

A change named by the monitor moves all parameters of the baseline along one direction: more mass
scales every acceleration, a weaker propeller all of its terms. Least squares on the accelerations
of the new logs gives the directions. An extended information filter then estimates the sizes: it
processes one log after the other, free-runs its windows with the current model, and adds their
scores and information.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import islice
from operator import add

import numpy as np
import torch
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import UsageError
from residnet.core.layout import DYNAMIC_STATES
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification.change_scores import (
    PRIOR_STD,
    GroupScores,
    compute_robust_score_sums,
    marginalise,
)
from residnet.identification.changes import PerturbedDynamics, SystemChange
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import (
    ChangeDetector,
    MeasuredWindow,
    MonitorVerdict,
    compute_innovations,
    split_window,
)
from residnet.training.refit import require_parametric_baseline

_MAX_CHANGES = 3
"""Largest number of changes in one refit: the sizes of more changes are not identifiable."""
_DIRECTION_RIDGE = 1e-6
"""Ridge of the least squares for a direction, relative to the information of each parameter."""
_MIN_EXPLAINED_SHARE = 0.7
"""Smallest share of the accelerations due to a change that the parameters must explain."""
_SHORT_STEP_SHARE = 1e-4
"""Short time step over which the accelerations due to a change are evaluated, in time steps."""
_MAX_SAMPLES = 4_000
"""Largest number of samples for the least squares of a direction."""


@dataclass(frozen=True)
class IdentifiedChange:
    """A change that a refit has added to a model.

    Attributes:
        change: the cause that the monitor named.
        estimated_size: estimated size in the unit of the change.
        standard_error: standard error of the size.
        size_by_log: size estimated from the logs up to each one, in time order.
    """

    change: SystemChange
    estimated_size: float
    standard_error: float
    size_by_log: Sequence[float]


@dataclass(frozen=True)
class RecursiveRefit:
    """Result of a recursive refit.

    Attributes:
        model: the model with the changes in its baseline; unchanged without changes.
        identified_changes: the changes, in the order of detection.
        verdict_before: verdict on the logs with the old model.
        verdict_after: verdict with the new model.
        stopping_reason: reason in words why no further change was estimated.
    """

    model: HybridDynamics
    identified_changes: Sequence[IdentifiedChange]
    verdict_before: MonitorVerdict
    verdict_after: MonitorVerdict
    stopping_reason: str


def refit_recursively(
    detector: ChangeDetector, windows_by_log: Sequence[Sequence[MeasuredWindow]]
) -> RecursiveRefit:
    """Estimate the changes named by a monitor in a copy of its model, until none is detected.

    Args:
        detector: detector of the model, which is not modified.
        windows_by_log: windows of the new logs, in time order.

    Raises:
        UsageError: if the model's baseline has no adjustable parameters.
    """
    baseline = detector.model.baseline
    if not isinstance(baseline, ParametricBaseline):
        raise UsageError(
            f"a recursive refit moves the parameters of one baseline; the model's is of class"
            f" {type(baseline).__name__}, which has none; choose another one with --model"
        )
    indexed_groups = [
        (log_index, group)
        for log_index, log in enumerate(windows_by_log)
        for group in detector.group_windows(log)
    ]
    verdict_before = verdict = _evaluate_groups(detector, indexed_groups)
    model = detector.model
    identified_changes = list[IdentifiedChange]()
    while True:
        first_change = verdict.hypotheses[0].change
        stopping_reason = _stopping_reason(
            verdict, [identified_change.change for identified_change in identified_changes]
        )
        if not stopping_reason:
            _, explained_share = _parameter_direction(detector.model, first_change, indexed_groups)
            if explained_share < _MIN_EXPLAINED_SHARE:
                stopping_reason = (
                    f"the terms of the baseline explain only {explained_share:.0%}"
                    f" of the accelerations due to '{first_change.name}'"
                )
        if stopping_reason:
            return RecursiveRefit(
                model, identified_changes, verdict_before, verdict, stopping_reason
            )
        changes = [
            *(identified_change.change for identified_change in identified_changes),
            first_change,
        ]
        information_filter = _InformationFilter(detector, changes)
        identified_changes = information_filter.run_filter(indexed_groups)
        model = information_filter.model
        verdict = _evaluate_groups(detector.with_model(model), indexed_groups)


def make_refitted_model(fitted_model: FittedModel, refit: RecursiveRefit) -> FittedModel:
    """Return the refitted model under a new name, with notes on the changes.

    The prediction intervals of the old model are dropped.
    """
    baseline = require_parametric_baseline(refit.model)
    values_by_parameter = dict(
        zip(baseline.free_parameter_names(), baseline.get_free().tolist(), strict=True)
    )
    notes = dict(fitted_model.notes)
    notes["coefficients"] = [
        {
            **coefficient_row,
            "value": values_by_parameter[coefficient_row["axis"], coefficient_row["term"]],
        }
        for coefficient_row in fitted_model.notes.get("coefficients", ())
        if (coefficient_row["axis"], coefficient_row["term"]) in values_by_parameter
    ]
    notes["refit_of"] = fitted_model.name
    notes["refit_changes"] = [
        {
            "cause": identified_change.change.name,
            "size": identified_change.estimated_size,
            "standard_error": identified_change.standard_error,
        }
        for identified_change in refit.identified_changes
    ]
    spec = fitted_model.spec.model_copy(update={"name": f"{fitted_model.name}_refit", "band": None})
    return FittedModel(spec, copy.deepcopy(refit.model), notes)


def _evaluate_groups(
    detector: ChangeDetector, indexed_groups: Sequence[tuple[int, Sequence[MeasuredWindow]]]
) -> MonitorVerdict:
    # the windows of all groups are run in one batch
    sums_of_windows = iter(
        detector.compute_sums([window for _, group in indexed_groups for window in group])
    )
    sums = [reduce(add, islice(sums_of_windows, len(group))) for _, group in indexed_groups]
    return detector.evaluate([log for log, _ in indexed_groups], sums)


def _stopping_reason(verdict: MonitorVerdict, changes_in_model: Sequence[SystemChange]) -> str:
    """Return why no further change is estimated; empty if one is."""
    first_hypothesis = verdict.hypotheses[0]
    if not verdict.is_alarm:
        return (
            f"no cause exceeds the threshold (largest score {verdict.max_score:.1f} of"
            f" {verdict.threshold:.1f})"
        )
    if first_hypothesis.change.sensor:
        return (
            f"'{first_hypothesis.change.name}' is the first hypothesis, an error of the data;"
            " correct the sensor, since a refit would attribute its error to the vessel"
        )
    if first_hypothesis.change in changes_in_model:
        return (
            f"'{first_hypothesis.change.name}' is the first hypothesis again, although"
            " its size has been estimated"
        )
    if len(changes_in_model) >= _MAX_CHANGES:
        return f"{_MAX_CHANGES} changes have been estimated; fit the model again with the new logs"
    return ""


def _parameter_direction(
    model: HybridDynamics,
    change: SystemChange,
    indexed_groups: Sequence[tuple[int, Sequence[MeasuredWindow]]],
) -> tuple[Tensor, float]:
    """Return the derivative of the free parameters [P] by the size of a change.

    It is the least-squares solution for the accelerations of the change. The second result is the
    fraction of these accelerations that the parameters explain.
    """
    windows = [window for _, group in indexed_groups for window in group]
    states = torch.from_numpy(np.concatenate([window.y[:-1] for window in windows]))
    inputs = torch.from_numpy(np.concatenate([window.w for window in windows]))
    sample_stride = max(len(states) // _MAX_SAMPLES, 1)
    states = states[::sample_stride]
    inputs = inputs[::sample_stride]
    initial_memory = states.new_zeros(len(states), model.n_state)
    # over a whole step the feedback through the changed velocities would reduce the effect
    short_step_model = copy.deepcopy(model)
    short_step_model.dt = _SHORT_STEP_SHARE * model.dt
    with torch.no_grad():
        perturbed_model = PerturbedDynamics(
            short_step_model, [change], len(states), inputs.shape[1]
        )
        added_increment = (
            perturbed_model.step(states, inputs, initial_memory)[0]
            - short_step_model.step(states, inputs, initial_memory)[0]
        )
        target_accelerations = added_increment[:, DYNAMIC_STATES].flatten() / (
            short_step_model.dt * change.size
        )
        sensitivities = (
            require_parametric_baseline(model)
            .parameter_jacobian(model.compute_channels(states, inputs))
            .flatten(0, 1)
        )
        # each axis is divided by its root mean square, so that all axes have the same weight; axes
        # that the change does not affect would otherwise get an infinite one
        axis_weights = added_increment[:, DYNAMIC_STATES].square().mean(0)
        axis_weights = (axis_weights + 1e-4 * axis_weights.max()).rsqrt().repeat(len(states))
        sensitivities = sensitivities * axis_weights[:, None]
        target_accelerations = target_accelerations * axis_weights
        gram = sensitivities.T @ sensitivities
        ridge = torch.diag(_DIRECTION_RIDGE * gram.diagonal() + 1e-300)
        direction = torch.linalg.solve(gram + ridge, sensitivities.T @ target_accelerations)
        unexplained_share = (
            target_accelerations - sensitivities @ direction
        ).square().sum() / target_accelerations.square().sum()
    return direction, 1.0 - float(unexplained_share)


class _InformationFilter:
    """An extended information filter for the sizes of changes.

    Args:
        detector: detector with the statistics of clean logs; F is its number of biases
            (`ChangeDetector.bias_by_fold`): from all clean logs, then without each fold.
        changes: Q changes whose sizes are estimated.

    Attributes:
        sizes: current estimates of the sizes [Q].
        size_steps: steps of the finite differences in the sizes [Q].
        directions: derivatives of the P free parameters by the sizes [P, Q].
    """

    def __init__(self, detector: ChangeDetector, changes: Sequence[SystemChange]) -> None:
        self.detector = detector
        self.changes = changes
        self.model = copy.deepcopy(detector.model)
        self.baseline = require_parametric_baseline(self.model)
        self.initial_parameters = self.baseline.get_free()
        self.size_steps = np.array([change.size for change in changes])
        cause_names = [change.name for change in detector.hypotheses]
        self.cause_indices = [cause_names.index(change.name) for change in changes]
        self.sizes = np.zeros(len(changes))
        self.directions = torch.zeros(
            len(self.initial_parameters), len(changes), dtype=self.initial_parameters.dtype
        )

    def run_filter(
        self, indexed_groups: Sequence[tuple[int, Sequence[MeasuredWindow]]]
    ) -> list[IdentifiedChange]:
        """Process the logs twice in sequence and return the estimated sizes.

        The second pass linearises at the result of the first one.
        """
        for is_second_pass in (False, True):
            linearisation_sizes = np.where(
                np.abs(self.sizes) > self.size_steps, self.sizes, self.size_steps
            )
            self.directions = torch.stack(
                [
                    _parameter_direction(
                        self.detector.model,
                        replace(change, size=float(change_size)),
                        indexed_groups,
                    )[0]
                    for change, change_size in zip(self.changes, linearisation_sizes, strict=True)
                ],
                dim=1,
            )
            sizes_by_log, covariance, sizes_by_fold = self._run_pass(
                indexed_groups, use_initial_sizes=is_second_pass
            )
        score_distribution = self.detector.score_distribution
        variance = np.diag(covariance) + score_distribution.mean_size_variance[self.cause_indices]
        # the bias of the model on clean logs is itself estimated: its variance by the jackknife
        jackknife_variance = (len(sizes_by_fold) - 1) * sizes_by_fold.var(axis=0)
        standard_errors = np.sqrt(
            variance * score_distribution.wishart_inflation + jackknife_variance
        )
        return [
            IdentifiedChange(
                change,
                float(self.sizes[change_index]),
                float(standard_errors[change_index]),
                [float(log_sizes[change_index]) for log_sizes in sizes_by_log],
            )
            for change_index, change in enumerate(self.changes)
        ]

    def _run_pass(
        self,
        indexed_groups: Sequence[tuple[int, Sequence[MeasuredWindow]]],
        *,
        use_initial_sizes: bool,
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Process the logs in sequence and estimate the sizes.

        Args:
            indexed_groups: groups of windows with the index of their log.
            use_initial_sizes: whether all free runs use the sizes at the start of the pass instead
                of the estimates from the logs before.

        Returns:
            Sizes [Q] after each log, their covariance [Q, Q] at the end, and the sizes [F - 1, Q]
            with the bias without each fold.
        """
        precision = np.diag((PRIOR_STD * self.size_steps) ** -2.0)
        information_vectors = np.zeros((len(self.detector.bias_by_fold), len(self.sizes)))
        sizes = self.sizes
        sizes_by_log: list[np.ndarray] = []
        # information form of the Kalman filter: each log adds its information, and the scores about
        # the current sizes; one information vector for each bias
        for log_index in dict.fromkeys(log_number for log_number, _ in indexed_groups):
            self._set_sizes(self.sizes)
            scores, log_information = self._process_log(
                [group for log_number, group in indexed_groups if log_number == log_index]
            )
            precision = precision + log_information
            information_vectors = information_vectors + scores + log_information @ self.sizes
            sizes = np.linalg.solve(precision, information_vectors[0])
            sizes_by_log.append(sizes)
            if not use_initial_sizes:
                self.sizes = sizes
        self.sizes = sizes
        self._set_sizes(sizes)
        covariance = np.linalg.inv(precision)
        return sizes_by_log, covariance, information_vectors[1:] @ covariance

    def _process_log(
        self, groups_of_log: Sequence[Sequence[MeasuredWindow]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return scores [F, Q] and information [Q, Q] of a log, weighted by their variance."""
        score, information = (
            np.stack(arrays)
            for arrays in zip(*map(self._process_group, groups_of_log), strict=True)
        )
        group_scores = GroupScores(np.zeros(len(groups_of_log)), score, information)
        # all groups belong to one log; the design effect accounts for their correlation
        weighted_scores, weighted_information, design_effect = (
            self.detector.score_distribution.select_changes(self.cause_indices).weigh_by_log(
                group_scores
            )
        )
        return (
            weighted_scores[0] / design_effect.mean(),
            weighted_information[0] / design_effect.mean(),
        )

    def _set_sizes(self, sizes: np.ndarray) -> None:
        """Set the parameters of the model for changes of the given sizes [Q]."""
        self.baseline.set_free(self.initial_parameters + self.directions @ torch.from_numpy(sizes))

    def _process_group(self, windows: Sequence[MeasuredWindow]) -> tuple[np.ndarray, np.ndarray]:
        """Return scores [F, Q] and information [Q, Q] of a group about corrections of the sizes."""
        detector = self.detector
        innovations_by_fold: list[list[tuple[np.ndarray, np.ndarray]]] = [
            [] for _ in detector.bias_by_fold
        ]
        for i, n_parts in enumerate(detector.part_counts):
            # the bias on clean logs is defined by the effects of the detector's own model, which
            # are zero in windows with a diverged free run; these windows are ignored
            _, detector_effects = detector.compute_innovations(windows, n_parts)
            is_valid = (detector_effects != 0.0).any(axis=(1, 2))
            window_parts = [item for window in windows for item in split_window(window, n_parts)]
            innovation, nuisance_effects = compute_innovations(
                self.model, window_parts, detector.nuisance_changes
            )
            # effects at the current sizes, by finite differences in the sizes
            change_effects = []
            for change_index, size_step in enumerate(self.size_steps):
                self._set_sizes(
                    self.sizes
                    + np.where(np.arange(len(self.sizes)) == change_index, size_step, 0.0)
                )
                change_effects.append(
                    (innovation - compute_innovations(self.model, window_parts, [])[0]) / size_step
                )
            self._set_sizes(self.sizes)
            all_effects = np.concatenate(
                (np.stack(change_effects, axis=1), nuisance_effects), axis=1
            )
            n_windows = len(windows)
            n_changes = all_effects.shape[1]
            all_effects = all_effects.reshape(n_windows, n_parts, n_changes, -1).swapaxes(1, 2)
            all_effects = all_effects.reshape(n_windows, n_changes, -1) * is_valid[:, None, None]
            for innovations_of_fold, (model_bias, size_bias) in zip(
                innovations_by_fold, detector.bias_by_fold, strict=True
            ):
                # the part that the bias on clean logs explains is not attributed to a change
                expected_innovation = detector.expected_innovations(detector_effects, model_bias[i])
                expected_innovation = expected_innovation + np.einsum(
                    "q,bqn->bn", size_bias, detector_effects[:, : len(detector.hypotheses)]
                )
                innovations_of_fold.append(
                    (
                        (innovation.reshape(n_windows, -1) - expected_innovation)
                        * is_valid[:, None],
                        all_effects,
                    )
                )
        change_indices = [
            *self.cause_indices,
            *range(len(detector.hypotheses), len(detector.all_changes)),
        ]
        prior_precision = detector.prior_precision[np.ix_(change_indices, change_indices)]
        score_sums = [
            compute_robust_score_sums(
                innovations_of_fold, detector.whitening_matrices, prior_precision
            )
            for innovations_of_fold in innovations_by_fold
        ]
        score, information = marginalise(
            np.stack([item.score for item in score_sums]),
            np.stack([item.information for item in score_sums]),
            len(self.sizes),
            detector.nuisance_precision,
        )
        return score, information[0]
