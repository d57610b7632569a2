"""Change detection by score tests on the innovations of short free runs.

Windows are free-run as a whole and divided into parts, each from its measured start. The bias of
the model on clean logs is subtracted from the innovations, which are whitened by their covariance
over clean logs. For each possible change the score test evaluates whether a small change of this
kind explains the recent windows, after wind and current are marginalised. Scores are divided by
their standard deviation over groups of clean windows. The joint scores of all changes rank the
explanations.
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
from residnet.identification.change_scores import (
    PRIOR_STD,
    GroupScores,
    ScoreSums,
    compute_robust_score_sums,
    compute_whitening_matrix,
    estimate_model_bias,
    estimate_score_inflation,
    fit_score_distribution,
    marginalise,
)
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
"""Largest number of blocks of a window; errors are averaged over each block to reduce noise."""


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
    """Return consecutive windows of a log, without the windows that have unusable samples.

    Args:
        log: log, prepared as the logs of the fit.
        n_steps: number of steps of a window.
        n_warmup: number of samples before a window, which must be usable too; they initialise the
            memory of a head and may be samples of the window before.
    """
    windows = []
    window_start = n_warmup
    while window_start + n_steps < len(log):
        row_slice = slice(window_start - n_warmup, window_start + n_steps + 1)
        is_valid = (
            log.usable[row_slice]
            & (log.segment[row_slice] == log.segment[window_start])
            & (log.segment[window_start] >= 0)
        )
        if not is_valid.all():
            # the next window starts after the last unusable sample
            window_start = row_slice.start + int(np.flatnonzero(~is_valid)[-1]) + 1 + n_warmup
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


_TESTS_PER_PERIOD = 3.0
"""Effective number of independent tests while the tested period slides by its own length."""
_N_FOLDS = 5
"""Number of folds of the cross-validation by which clean windows are scored."""
_MIN_GROUPS = 5
"""Smallest number of groups of clean windows from which a false alarm rate can be estimated."""
_N_WINDOW_PARTS = 5
"""Number of parts of a window that are also free-run, each from its measured start."""
_MIN_PART_STEPS = 10
"""Smallest number of steps of a part; shorter windows are not divided."""
_MAX_GROUPS_PER_BATCH = 32
"""Largest number of groups of clean windows that are run in one batch."""
_DIVERGENCE_FACTOR = 3.0
"""Innovation above which a free run has diverged, relative to the largest clean velocity."""
_MAX_HEADING_INNOVATION = 2.0 * np.pi
"""Innovation of the heading above which a free run has diverged."""
_MAX_DIVERGED_SHARE = 0.5
"""Largest share of clean windows with a diverged free run."""
_CURRENT_STD = 0.5
"""Prior standard deviation of a current in m/s."""
_WIND_ACCELERATION_STD = 0.05
"""Prior standard deviation of the acceleration of the vessel by wind in m/s^2."""


class MonitorConfig(Config):
    """Settings of a monitor.

    Attributes:
        window: length of the free runs, in s.
        stretch: length of the recent period that is tested, in s.
        false_alarm: mean time between false alarms, in s.
        group: length of a group of windows in s. Wind and current count as constant within a group,
            and the scores of clean groups give the standard deviation of the scores.
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
        test_statistic: magnitude of the estimated size divided by its standard error; this is the
            score that is compared with the threshold.
        estimated_size: estimated size of the change in its unit.
        standard_error: standard error of the size.
        score_reduction: part of the joint score statistic of all changes that this change explains
            alone.
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
        """The largest test statistic of any change."""
        return max(hypothesis.test_statistic for hypothesis in self.hypotheses)


_InnovationsAndEffects = tuple[np.ndarray, np.ndarray]


class ChangeDetector:
    """Statistics of clean logs, and score tests against them.

    Each window is evaluated in one or two divisions: as a whole, and in parts if it is long enough.
    The innovations of clean logs have two biases. The model bias [Q, c] of a division is a size of
    each of Q changes for each of c channels; it is subtracted from the innovations. The size bias
    [Q] is the size of each change that the scores still show on clean logs afterwards.

    Args:
        spec: description of the model.
        model: the model.
        clean_windows: windows of clean logs, ordered by log; all of equal length.
        config: settings of the monitor.

    Attributes:
        part_counts: number of parts of a window in each division; 1 for the window as a whole.
        bias_by_fold: model bias of each division, and size bias; first from all clean logs, then
            without each fold.

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
        nuisance_precisions = [_CURRENT_STD**-2] * 2 + [_WIND_ACCELERATION_STD**-2] * 2
        self.nuisance_precision = np.diag(nuisance_precisions)
        prior_precisions = [(PRIOR_STD * item.size) ** -2 for item in self.hypotheses]
        self.prior_precision = np.diag([*prior_precisions, *nuisance_precisions])
        self.window_steps = round(config.window / spec.dt)
        self.n_warmup = count_warmup_samples(model)
        indexed_groups = [
            (k, windows_of_group)
            for k, windows_of_log in enumerate(clean_windows)
            for windows_of_group in self.group_windows(windows_of_log)
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
        innovations_by_group = self._compute_innovations_of_groups(
            [windows_of_group for _, windows_of_group in indexed_groups]
        )
        # windows with a diverged free run have zero innovations, see `compute_innovations`
        has_diverged = np.concatenate(
            [(group[0][0] == 0.0).all(axis=1) for group in innovations_by_group]
        )
        if has_diverged.mean() > _MAX_DIVERGED_SHARE:
            raise DataError(
                f"model {spec.name}: free runs of {config.window:g} s diverge in"
                f" {has_diverged.sum()} of {len(has_diverged)} clean windows; use another model or"
                f" a shorter window"
            )
        # bias and covariance of the innovations over all clean groups
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
        groups_per_segment = max(round(config.stretch / config.group), 1)
        self.score_distribution = replace(
            fit_score_distribution(cross_validated_groups),
            inflation_factor=estimate_score_inflation(
                cross_validated_groups, np.sort(fold_of_group), groups_per_segment
            ),
        )
        # two-sided threshold with a Bonferroni correction over tests in time and hypotheses
        n_tests = config.false_alarm / config.stretch * _TESTS_PER_PERIOD * len(self.hypotheses)
        self.threshold = float(scipy.stats.t.isf(0.5 / n_tests, len(innovations_by_group) - 1))

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

        In service the bias comes from other logs than the tested ones, so that scores vary more
        than on the clean logs. The scores of each fold with the bias of the other folds vary as in
        service.

        Args:
            innovations_by_group: innovations and effects of each group and division of windows.
            model_bias: model bias of all groups for each division of windows.
            log_of_group: number of the log of each group [G].
            fold_of_group: number of the fold of each group [G].
            prior_precision: prior precision of the sizes of the changes [Q, Q].

        Returns:
            `bias_by_fold`, and the scores of each group with the biases of the other folds.
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
            held_out_groups.append(groups[fold_of_group == fold])
        cross_validated_groups = GroupScores(
            np.concatenate([groups.log_index for groups in held_out_groups]),
            np.concatenate([groups.score for groups in held_out_groups]),
            np.concatenate([groups.information for groups in held_out_groups]),
        )
        return biases, cross_validated_groups

    def _estimate_bias(
        self, innovations_by_group: Sequence[Sequence[_InnovationsAndEffects]]
    ) -> list[np.ndarray]:
        """Return the model bias for each division of windows, from groups of clean windows."""
        bias_by_division = []
        for innovations_of_division in zip(*innovations_by_group, strict=True):
            innovation, effects = map(np.concatenate, zip(*innovations_of_division, strict=True))
            bias_by_division.append(
                estimate_model_bias(
                    innovation, effects, self.hypotheses, len(self.innovation_columns)
                )
            )
        return bias_by_division

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
        """The changes of the vessel, then the changes of its environment."""
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
        """Return the score sums of each window alone, with the model bias of all clean logs."""
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

    def _compute_innovations_of_groups(
        self, groups: Sequence[Sequence[MeasuredWindow]]
    ) -> list[list[_InnovationsAndEffects]]:
        """Return innovations and effects of each group of windows and each division of windows."""
        innovations_by_group: list[list[_InnovationsAndEffects]] = []
        for first in range(0, len(groups), _MAX_GROUPS_PER_BATCH):
            # a step of many windows takes little longer than that of one group
            batch = groups[first : first + _MAX_GROUPS_PER_BATCH]
            windows = [window for group in batch for window in group]
            group_stops = np.cumsum([len(group) for group in batch])[:-1]
            innovations_by_division = [
                [
                    np.split(values, group_stops)
                    for values in self.compute_innovations(windows, n_parts)
                ]
                for n_parts in self.part_counts
            ]
            innovations_by_group += [
                [(innovations[k], effects[k]) for innovations, effects in innovations_by_division]
                for k in range(len(batch))
            ]
        return innovations_by_group

    def expected_innovations(self, effects: np.ndarray, model_bias: np.ndarray) -> np.ndarray:
        """Return the expected innovations [B, n] of clean logs, given their effects [B, C, n].

        Args:
            effects: derivatives of the innovations by the size of each change.
            model_bias: model bias of this division of windows [Q, c].
        """
        bias_by_column = np.tile(model_bias, effects.shape[2] // len(self.innovation_columns))
        return np.asarray((effects[:, : len(self.hypotheses)] * bias_by_column).sum(axis=1))

    def _compute_score_sums(
        self,
        innovations_and_effects: Sequence[_InnovationsAndEffects],
        bias_by_division: Sequence[np.ndarray],
    ) -> ScoreSums:
        """Return the score sums of windows, evaluated as a whole and in parts."""
        corrected_innovations = [
            (innovation - self.expected_innovations(effects, model_bias), effects)
            for (innovation, effects), model_bias in zip(
                innovations_and_effects, bias_by_division, strict=True
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
            FaultHypothesis(
                change,
                float(abs(estimated_size) / standard_error),
                float(estimated_size),
                float(standard_error),
                float(explained_square),
            )
            for change, estimated_size, standard_error, explained_square in zip(
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
"""Distance in standard deviations of the scores below the threshold at which an alarm ends."""


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
        """Add the score sums of a window, and return the verdict on the recent period."""
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
