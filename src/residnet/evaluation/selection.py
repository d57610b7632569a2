"""Selection of one model: the simplest whose error is not significantly above the smallest.

Models are compared by the ratio of their errors, block by block, as means of log errors. A single
bad stretch would dominate a mean of the errors themselves, and its standard error would be too
large for few logs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from residnet.core.format import format_number
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.evaluation.freerun import FreeRun, FreeRunErrors
from residnet.evaluation.intervals import MIN_LOGS_AS_BLOCKS, TARGET_BLOCKS
from residnet.evaluation.records import BlockCount, SelectionFile, SelectionRow
from residnet.preprocessing.prepare import PreparedLog

SCHEMA: Final = "residnet.selection/2"
MODEL_FAMILIES = (
    CONSTANT_VELOCITY,
    "baseline",
    "refitted baseline",
    "closed-form head",
    "network",
    "ensemble",
)
"""Families of models in ascending order of complexity."""

_EQUIVALENCE_STANDARD_ERRORS = {"logs": 1.0, "stretches": 0.5}
"""Standard errors within which models are equally good; segments of few logs are correlated."""
_ERROR_OFFSET_SHARE = 0.1
"""Share of the smallest mean error that is added to the error of every block."""


@dataclass(frozen=True)
class SelectionCandidate:
    """A model with the criteria of the selection.

    Attributes:
        name: name of the model.
        family: one of `MODEL_FAMILIES`.
        n_parameters: number of fitted parameters.
        mean_nrmse: mean NRMSE over the validation windows.
        block_scores: contribution of each block of the validation data to the mean logarithm of
            the error, [B]; see `block_log_errors`.
        n_diverged: number of validation windows in which the model diverged, over all protocols.
        faults: texts on failed checks and divergences; empty for a sound model.
    """

    name: str
    family: str
    n_parameters: int
    mean_nrmse: float
    block_scores: np.ndarray
    n_diverged: int = 0
    faults: tuple[str, ...] = ()

    @property
    def mean_log_error(self) -> float:
        """Mean logarithm of the error: the sum of the contributions of all blocks."""
        return float(self.block_scores.sum())

    @property
    def is_sound(self) -> bool:
        """Whether the model passed all checks."""
        return not self.faults

    @property
    def complexity_rank(self) -> tuple[int, int]:
        """Sort key of the complexity: family, then the number of parameters."""
        return MODEL_FAMILIES.index(self.family), self.n_parameters


@dataclass(frozen=True)
class SelectionBlocks:
    """The blocks of the validation data over which errors are paired.

    Attributes:
        weights: share of each block in the mean over windows, [B]; their sum is 1.
        block_kind: `logs` if a block is all windows of a log, else `stretches` of logs.
    """

    weights: np.ndarray
    block_kind: Literal["logs", "stretches"]

    @property
    def n_blocks(self) -> int:
        """Number of blocks of validation data."""
        return len(self.weights)

    @property
    def equivalence_standard_errors(self) -> float:
        """Number of standard errors within which two models count as equally good."""
        return _EQUIVALENCE_STANDARD_ERRORS[self.block_kind]

    def standard_error(self, contributions: np.ndarray, other_contributions: np.ndarray) -> float:
        """Return the standard error of the difference of two means; zero for a single block.

        Args:
            contributions: contribution of each block to the first mean, [B].
            other_contributions: contribution of each block to the second mean, [B].
        """
        if self.n_blocks < 2:
            return 0.0
        differences = contributions - other_contributions
        # deviation of each contribution from its share of the difference: delta method for a ratio
        residuals = differences - self.weights * differences.sum()
        return math.sqrt(self.n_blocks / (self.n_blocks - 1) * float(residuals @ residuals))


def log_error_ratio(
    candidate: SelectionCandidate, reference: SelectionCandidate, blocks: SelectionBlocks
) -> tuple[float, float]:
    """Return the mean logarithm of the ratio of two models' errors, and its standard error.

    A logarithm of 0.1 is a difference of about 10 %.
    """
    mean_log_ratio = float((candidate.block_scores - reference.block_scores).sum())
    return mean_log_ratio, blocks.standard_error(candidate.block_scores, reference.block_scores)


@dataclass(frozen=True)
class Selection:
    """The selected models and the reason.

    Attributes:
        selected: name of the selected single model.
        selected_ensemble: name of the best ensemble; None without ensembles.
        reason: one sentence on the choice of the single model.
        candidates: all models, in their given order.
        blocks: blocks over which errors are paired.
        default_ensemble: name of an ensemble that is always reported first; None for none.
    """

    selected: str
    selected_ensemble: str | None
    reason: str
    candidates: tuple[SelectionCandidate, ...]
    blocks: SelectionBlocks
    default_ensemble: str | None = None

    @property
    def default_model(self) -> str:
        """Name of the model that is reported first and exported by default."""
        return self.selected if self.default_ensemble is None else self.default_ensemble

    def to_record(self) -> SelectionFile:
        """Return the contents of selection.json."""
        selected_candidate = next(
            candidate for candidate in self.candidates if candidate.name == self.selected
        )
        rows = []
        for candidate in self.candidates:
            mean_log_ratio, standard_error = log_error_ratio(
                candidate, selected_candidate, self.blocks
            )
            rows.append(
                SelectionRow(
                    model=candidate.name,
                    family=candidate.family,
                    parameters=candidate.n_parameters,
                    nrmse_mean=candidate.mean_nrmse,
                    ratio=math.exp(mean_log_ratio),
                    standard_error=standard_error,
                    diverged=candidate.n_diverged,
                    sound=candidate.is_sound,
                    faults=candidate.faults,
                )
            )
        return SelectionFile(
            schema=SCHEMA,
            selected=self.selected,
            selected_ensemble=self.selected_ensemble,
            predictor=self.default_model,
            reason=self.reason,
            blocks=BlockCount(of=self.blocks.block_kind, count=self.blocks.n_blocks),
            models=tuple(rows),
        )


def select_models(candidates: Iterable[SelectionCandidate], blocks: SelectionBlocks) -> Selection:
    """Select a single model and an ensemble.

    One-standard-error rule (Breiman and others 1984, Classification and Regression Trees, section
    3.4.3), paired over blocks because all models run over the same windows. Among the models
    without divergence, those within one standard error of the smallest error are equally good. With
    fewer than five logs half a standard error is used, since segments of a log are correlated.
    Among equally good models sound ones come first, then the simplest. A failed check can therefore
    cost no more accuracy than the data can resolve.

    Args:
        candidates: `constant_velocity` and at least one other model.
    """
    all_candidates = tuple(candidates)
    selected_model, reason = _simplest_equivalent(
        [candidate for candidate in all_candidates if candidate.family != "ensemble"], blocks
    )
    ensembles = [candidate for candidate in all_candidates if candidate.family == "ensemble"]
    best_ensemble = min(
        ensembles, key=lambda model: (model.n_diverged, model.mean_log_error), default=None
    )
    return Selection(
        selected_model.name,
        None if best_ensemble is None else best_ensemble.name,
        reason,
        all_candidates,
        blocks,
    )


def _simplest_equivalent(
    single_models: Sequence[SelectionCandidate], blocks: SelectionBlocks
) -> tuple[SelectionCandidate, str]:
    """Return the simplest model equivalent to the best, preferably a sound one, and the reason."""
    bounded_models = [model for model in single_models if not model.n_diverged]
    most_accurate = min(bounded_models, key=lambda model: model.mean_log_error)
    tolerance_text = (
        "one standard error"
        if blocks.equivalence_standard_errors == 1.0
        else "half a standard error"
    )
    for candidate in sorted(
        bounded_models,
        key=lambda model: (not model.is_sound, *model.complexity_rank, model.mean_log_error),
    ):
        mean_log_ratio, standard_error = log_error_ratio(candidate, most_accurate, blocks)
        if mean_log_ratio <= (tolerance := blocks.equivalence_standard_errors * standard_error):
            break
    error_text = f"mean validation error {format_number(candidate.mean_nrmse)}"
    if candidate.family == CONSTANT_VELOCITY:
        reason = f"No model is better than constant velocity by more than {tolerance_text}"
    elif candidate is most_accurate:
        reason = f"{candidate.name} has the smallest error ({error_text})"
        if any(model.complexity_rank < most_accurate.complexity_rank for model in bounded_models):
            reason += (
                f", and no {'simpler' if most_accurate.is_sound else 'sound'} one is"
                f" within {tolerance_text}"
            )
    else:
        superlative = "simplest sound" if candidate.is_sound else "simplest"
        reason = (
            f"{candidate.name} is the {superlative} model within {tolerance_text}"
            f" ({format_number(100.0 * tolerance, 2)} %) of"
            f" the best one, {most_accurate.name} ({error_text} and"
            f" {format_number(most_accurate.mean_nrmse)})"
        )
    diverged_models = [
        model
        for model in single_models
        if model.mean_log_error < candidate.mean_log_error and model.n_diverged
    ]
    if diverged_models:
        diverged_text = ", ".join(f"{model.name} ({model.faults[0]})" for model in diverged_models)
        reason += f"; excluded: {diverged_text}"
    if not candidate.is_sound:
        reason += f", with these faults: {'; '.join(candidate.faults)}"
    return candidate, reason + "."


def make_selection_blocks(free_run: FreeRun) -> tuple[SelectionBlocks, list[np.ndarray]]:
    """Return the blocks of validation windows, and the block index of each sample.

    With five or more logs a block is a log, so that the selection holds for new logs. Fewer logs
    are cut into contiguous segments of equal length, about eight in all.

    Returns:
        The blocks, and block indices [L] for each window.
    """
    log_indices = np.array([window.log_index for window in free_run.windows])
    window_lengths = np.array([window.stop - window.start for window in free_run.windows])
    logs = np.unique(log_indices)
    block_numbers: list[np.ndarray] = [np.zeros(length, dtype=int) for length in window_lengths]
    segments_per_log = (
        1 if len(logs) >= MIN_LOGS_AS_BLOCKS else math.ceil(TARGET_BLOCKS / len(logs))
    )
    for log_position, log_index in enumerate(logs.tolist()):
        window_indices = np.flatnonzero(log_indices == log_index)
        n_segments = min(segments_per_log, int(window_lengths[window_indices].sum()))
        sample_groups = np.array_split(np.arange(window_lengths[window_indices].sum()), n_segments)
        log_block_numbers = np.concatenate(
            [
                np.full(len(window_block_numbers), i)
                for i, window_block_numbers in enumerate(sample_groups)
            ]
        )
        for window_index, window_block_numbers in zip(
            window_indices,
            np.split(log_block_numbers, np.cumsum(window_lengths[window_indices])[:-1]),
            strict=True,
        ):
            block_numbers[window_index] = log_position * segments_per_log + window_block_numbers
    # a log with fewer samples than segments leaves unused numbers, which are removed
    unique_blocks, log_block_numbers = np.unique(np.concatenate(block_numbers), return_inverse=True)
    block_numbers = np.split(log_block_numbers, np.cumsum(window_lengths)[:-1])
    weights = np.zeros(len(unique_blocks))
    for window_blocks in block_numbers:
        weights += np.bincount(window_blocks, minlength=len(unique_blocks)) / (
            len(window_blocks) * len(block_numbers)
        )
    return SelectionBlocks(weights, "logs" if segments_per_log == 1 else "stretches"), block_numbers


def block_error_shares(
    free_run: FreeRun,
    model_name: str,
    logs: Sequence[PreparedLog],
    scales: Mapping[str, float],
    block_numbers: Sequence[np.ndarray],
    n_blocks: int,
) -> np.ndarray:
    """Return the contribution of each block to a model's mean NRMSE, [n_blocks].

    A window's root mean square error is distributed in proportion to the squared errors, so that
    the sum is the mean NRMSE of the rows of metrics.json.

    Args:
        free_run: free runs over the windows.
        model_name: name of the model.
        logs: logs of the windows.
        scales: denominators of the nrmse.
        block_numbers: block index of each sample of each window.
        n_blocks: number of blocks.
    """
    errors = FreeRunErrors.from_predictions(
        free_run.windows, free_run.predictions[model_name], logs
    )
    weighted_rmse = errors.rmse * np.add.reduceat(
        errors.is_scored, errors.window_starts, dtype=float
    )
    scaled_columns = [logs[0].dof.dynamic_states.index(name) for name in scales]
    # a window without error contributes zero; the divisor must not be zero
    weighted_rmse = np.where(weighted_rmse > 0, weighted_rmse, 1.0).take(scaled_columns, axis=1)
    weighted_rmse = weighted_rmse * np.array(list(scales.values()))
    velocity_errors = errors.velocity_errors.take(scaled_columns, axis=1)
    sample_contributions = (
        velocity_errors**2 / np.repeat(weighted_rmse, errors.window_lengths, axis=0)
    ).sum(1)
    sample_shares = sample_contributions / (weighted_rmse.shape[1] * len(free_run.windows))
    return np.bincount(np.concatenate(block_numbers), sample_shares, n_blocks)


def block_log_errors(
    error_shares: Mapping[str, np.ndarray], block_weights: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the contribution of each block to the mean logarithm of the error, [B] by model.

    A tenth of the smallest mean error is added to each error. Otherwise blocks in which all models
    are nearly exact would dominate the mean of the logarithms.

    Args:
        error_shares: contribution of each block to the mean NRMSE, [B] by model.
        block_weights: weights of the blocks, [B].
    """
    least_mean_error = min(
        (float(share_of_model.sum()) for share_of_model in error_shares.values()), default=0.0
    )
    # the smallest positive float only avoids log(0) if all errors are zero
    offset = max(_ERROR_OFFSET_SHARE * least_mean_error, float(np.finfo(float).tiny))
    return {
        name: block_weights * np.log(share_of_model / block_weights + offset)
        for name, share_of_model in error_shares.items()
    }
