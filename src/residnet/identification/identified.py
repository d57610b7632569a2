"""Results of a fit: free runs of all models, model selection, residual analysis."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.errors import UsageError
from residnet.core.model_names import CONSTANT_VELOCITY, ENSEMBLE, PLANT
from residnet.core.stretches import find_runs
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.evaluation.band import BandsByModel
from residnet.evaluation.freerun import Candidate, FreeRun, run_free_runs
from residnet.evaluation.goodness import OneStepResiduals, build_goodness_table
from residnet.evaluation.limits_records import ProtocolLimits
from residnet.evaluation.metrics import ProtocolEvaluation
from residnet.evaluation.metrics_file import build_metrics_table
from residnet.evaluation.protocol import EvaluationConfig
from residnet.evaluation.records import GoodnessRow, MetricsRow, SanityRow
from residnet.evaluation.selection import (
    Selection,
    SelectionCandidate,
    block_error_shares,
    block_log_errors,
    make_selection_blocks,
    select_models,
)
from residnet.evaluation.soundness import TrainingPoints, check_model
from residnet.heads.base import ClosedFormHead, EquationHead
from residnet.identification.fitter import FittedModel, find_reference_names
from residnet.identification.recipe import SINGLE_MODEL_NAME
from residnet.identification.settings import FitSettings
from residnet.io.sources import MeasuredLogs
from residnet.manoeuvres.trials import build_plant
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.samples import compute_channels

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class SplitEvaluation:
    """The free runs of models over the logs of one split.

    Attributes:
        split: train, validation, test or external.
        logs: logs of the split; `log_index` of the windows refers to this order.
        free_runs: free runs by protocol, without protocols that have no window.
        rows: rows of metrics.json, without `selected`.
        limits_by_protocol: contents of limits.json by protocol.
        bands_by_model: prediction intervals of the models, by model and protocol.
    """

    split: str
    logs: Sequence[PreparedLog]
    free_runs: list[FreeRun]
    rows: list[MetricsRow]
    limits_by_protocol: dict[str, ProtocolLimits]
    bands_by_model: BandsByModel = field(default_factory=dict)

    @property
    def metrics_table(self) -> pd.DataFrame:
        """The rows as a table, see `residnet.evaluation.metrics_file.build_metrics_table`."""
        return build_metrics_table(self.rows)


def evaluate_splits(
    models: Sequence[Candidate],
    splits: Mapping[str, Sequence[PreparedLog]],
    config: EvaluationConfig,
    dt: float,
    velocity_limits: np.ndarray,
) -> dict[str, SplitEvaluation]:
    """Free-run models over all protocols of several splits, all windows of a model in one batch.

    Args:
        models: models to evaluate, see `make_candidates`.
        splits: logs by split, at least one each.
        config: protocols and scales.
        dt: time step of the grid in s.
        velocity_limits: magnitude of the velocities [n] above which a free run has diverged.
    """
    windows_by_split_and_protocol = {
        (split, name): [
            window
            for log_index, log in enumerate(logs)
            for window in protocol.make_windows(log, log_index, dt)
        ]
        for split, logs in splits.items()
        for name, protocol in config.protocols.items()
    }
    all_logs = [log for logs in splits.values() for log in logs]
    # windows of all splits refer to one list of logs while they are run as one batch
    log_offsets = dict(
        zip(splits, np.cumsum([0, *map(len, splits.values())]).tolist(), strict=False)
    )
    all_windows = [
        replace(window, log_index=window.log_index + log_offsets[split])
        for (split, _), windows in windows_by_split_and_protocol.items()
        for window in windows
    ]
    predictions = run_free_runs(models, all_windows, all_logs, dt, velocity_limits)
    bands = {model.name: model.bands for model in models}
    scales = config.scales.to_dict()
    evaluations = {
        split: SplitEvaluation(split, logs, [], [], {}, bands) for split, logs in splits.items()
    }
    protocol_evaluations: dict[tuple[str, str], ProtocolEvaluation] = {}
    first_window = 0
    for (split, name), windows in windows_by_split_and_protocol.items():
        if not windows:
            continue
        last_window = first_window + len(windows)
        predictions_of_run = {
            model: model_predictions[first_window:last_window]
            for model, model_predictions in predictions.items()
        }
        first_window = last_window
        evaluation = evaluations[split]
        logs = splits[split]
        free_run = FreeRun(name, split, windows, predictions_of_run)
        evaluation.free_runs.append(free_run)
        protocol_evaluation = ProtocolEvaluation(free_run, models, logs, scales)
        evaluation.rows.extend(protocol_evaluation.build_rows(config.groups))
        protocol_evaluations[split, name] = protocol_evaluation
    for (split, name), protocol_evaluation in protocol_evaluations.items():
        # all splits estimate the spread between logs
        other_splits = [
            other
            for (other_split, other_name), other in protocol_evaluations.items()
            if other_name == name and other_split != split
        ]
        limits = protocol_evaluation.build_limits(dt, other_splits)
        evaluations[split].limits_by_protocol[name] = limits
    return evaluations


def make_candidates(
    fitted_models: Iterable[FittedModel], data: MeasuredLogs | SimulatedTrials | None = None
) -> list[Candidate]:
    """Return the models to evaluate, each with its reference.

    Args:
        fitted_models: fitted models.
        data: source of the logs; simulated trials add the plant that generated them.
    """
    models_by_name = {fitted_model.name: fitted_model for fitted_model in fitted_models}
    reference_names = find_reference_names(models_by_name.values())
    spread_members = spread_member_names(models_by_name.values())
    candidate_models = [
        Candidate(
            name,
            fitted_model.spec.role,
            fitted_model.model,
            reference=reference_names.get(name),
            training_ranges=fitted_model.spec.ranges,
            bands=fitted_model.bands,
            members=trajectory_member_names(fitted_model),
            spread_members=spread_members,
            domain=fitted_model.spec.domain,
            domain_inputs=tuple(fitted_model.spec.signals.input_columns),
        )
        for name, fitted_model in models_by_name.items()
    ]
    plant_candidate = _make_plant_candidate(data) if isinstance(data, SimulatedTrials) else None
    return candidate_models if plant_candidate is None else [*candidate_models, plant_candidate]


def trajectory_member_names(fitted_model: FittedModel) -> tuple[str, ...]:
    """Return the members of an ensemble that averages trajectories; empty for other models."""
    return tuple(
        member.name
        for member in fitted_model.spec.members
        if fitted_model.spec.of == "trajectories"
    )


def spread_member_names(fitted_models: Iterable[FittedModel]) -> tuple[str, ...]:
    """Return the models whose disagreement measures extrapolation.

    These are baselines and closed-form heads, which are quickly refitted without some of the logs.
    The prediction intervals use their typical disagreement in free runs over those logs.
    """
    return tuple(
        fitted_model.name
        for fitted_model in fitted_models
        if fitted_model.spec.role == "baseline" or has_closed_form_head(fitted_model)
    )


def has_closed_form_head(fitted_model: FittedModel) -> bool:
    """Return whether a model has a closed-form head that is quickly solved again."""
    head = fitted_model.model.head
    is_quickly_refitted = isinstance(head, ClosedFormHead) and not isinstance(head, EquationHead)
    return fitted_model.spec.role == "head" and is_quickly_refitted


def _make_plant_candidate(data: SimulatedTrials) -> Candidate | None:
    """Return the plant that generated the logs; None if its state is not completely logged."""
    plant = build_plant(data.vessel, data.disturbance)
    if any(name.startswith("_") for name in plant.state_names):
        # the content of a delay line is not logged, so that a free run could not start from a log
        return None
    command_names = plant.input_names[: plant.n_commands]
    model = RecordedPlantDynamics(plant, data.step, data.substeps)
    # the remaining inputs, such as wind and current, are not known to the models either
    n_unknown_inputs = len(plant.input_names) - len(command_names)
    return Candidate(
        PLANT, PLANT, model, plant.state_names, command_names, n_unknown_inputs, "baseline"
    )


_DIVERGENCE_CHECKED_SPLITS = ("train", "validation")
"""Splits in which a divergence excludes a model from the selection, which test data must not
influence.
"""


def model_family(fitted_model: FittedModel) -> str:
    """Return the family of a model, one of `residnet.evaluation.selection.FAMILIES`."""
    if isinstance(fitted_model.model, MeanOfTrajectories):
        return "ensemble"
    if fitted_model.spec.role != "head":
        is_refitted = fitted_model.spec.role == "baseline" and "refit" in fitted_model.notes
        return "refitted baseline" if is_refitted else str(fitted_model.spec.role)
    return "closed-form head" if isinstance(fitted_model.model.head, ClosedFormHead) else "network"


def count_parameters(model: HybridDynamics) -> int:
    """Return the number of fitted parameters of baseline and head together."""
    if isinstance(model, MeanOfTrajectories):
        return sum(map(count_parameters, model.members))
    n_head_parameters = (
        sum(model.head.parameter_counts())
        if isinstance(model.head, ClosedFormHead)
        else sum(parameter.numel() for parameter in model.head.parameters())
    )
    return round(sum(model.baseline.parameter_counts()) + n_head_parameters)


@dataclass(frozen=True)
class IdentifiedModels(Mapping[str, FittedModel]):
    """The fitted models by name: constant_velocity, baselines, heads and ensembles, in this order.

    Attributes:
        settings: settings of the fit.
        models: fitted models by name.
        velocity_limits: magnitude of the velocities [n] above which a free run has diverged.
        training_logs: logs used in training.
        validation_in_training: whether the training logs include the validation logs.
    """

    settings: FitSettings
    models: dict[str, FittedModel]
    velocity_limits: np.ndarray
    training_logs: Sequence[PreparedLog]
    validation_in_training: bool = False

    def evaluate(
        self,
        splits: Mapping[str, Sequence[PreparedLog]],
        data: MeasuredLogs | SimulatedTrials | None = None,
    ) -> dict[str, SplitEvaluation]:
        """Free-run all models over the logs of several splits.

        Args:
            splits: logs by split, prepared as those of the fit.
            data: source of the logs; simulated trials add the plant as a candidate.
        """
        settings = self.settings
        return evaluate_splits(
            make_candidates(self.values(), data),
            splits,
            settings.evaluation,
            settings.prepare.grid.step,
            self.velocity_limits,
        )

    @cached_property
    def sanity_findings(self) -> dict[str, list[SanityRow]]:
        """Results of the physical checks by model, without `constant_velocity`."""
        fitted_models = list(self.values())
        settings = self.settings
        training_points = TrainingPoints.from_logs(self.training_logs, settings.prepare.grid.step)
        return {
            fitted_model.name: check_model(
                fitted_model.spec,
                fitted_model.model,
                training_points,
                settings.evaluation.divergence,
            )
            for fitted_model in fitted_models
            if fitted_model.spec.role != CONSTANT_VELOCITY
        }

    def select_models(self, evaluations: Mapping[str, SplitEvaluation]) -> Selection:
        """Choose a single model and an ensemble by their free runs over the validation logs.

        With the recipe nothing is chosen, since the differences between its models are smaller than
        their uncertainty: the hull is the single model, unless it diverged in a window, and the
        mean of the trajectories is the ensemble.

        Args:
            evaluations: results of `evaluate_splits` by split; `validation` is required, and
                divergences in `train` count if it is included.

        Raises:
            UsageError: if the validation logs have not been evaluated.
        """
        config = self.settings.evaluation
        validation = evaluations.get("validation")
        validation_runs = [] if validation is None else validation.free_runs
        selection_run = next(
            (free_run for free_run in validation_runs if free_run.protocol == config.selection),
            None,
        )
        if validation is None or selection_run is None:
            raise UsageError(
                f"select: no free runs over validation logs by protocol '{config.selection}';"
                " evaluate the validation split first"
            )
        # errors are compared by blocks (logs or long segments), since successive windows
        # are correlated
        blocks, block_numbers = make_selection_blocks(selection_run)
        checked_runs = {
            split: evaluations[split].free_runs
            for split in _DIVERGENCE_CHECKED_SPLITS
            if split in evaluations
        }
        scales = config.scales.to_dict()
        error_shares = {
            name: block_error_shares(
                selection_run, name, validation.logs, scales, block_numbers, len(blocks.weights)
            )
            for name in self
        }
        block_scores = block_log_errors(error_shares, blocks.weights)
        candidates = []
        for fitted_model in self.values():
            divergences = [
                (
                    n_diverged,
                    f"{n_diverged} of its {len(free_run.windows)} {split} windows diverged"
                    f" ({free_run.protocol})",
                )
                for split, free_runs in checked_runs.items()
                for free_run in free_runs
                if (
                    n_diverged := sum(
                        item.has_diverged for item in free_run.predictions[fitted_model.name]
                    )
                )
            ]
            sanity_faults = [
                item.fault for item in self.sanity_findings.get(fitted_model.name, ()) if item.fault
            ]
            candidates.append(
                SelectionCandidate(
                    fitted_model.name,
                    model_family(fitted_model),
                    count_parameters(fitted_model.model),
                    float(error_shares[fitted_model.name].sum()),
                    block_scores[fitted_model.name],
                    sum(n_diverged for n_diverged, _ in divergences),
                    (*(divergence_text for _, divergence_text in divergences), *sanity_faults),
                )
            )
        selection = select_models(candidates, blocks)
        # parts that the user has listed are selected by their errors alone
        if self.settings.recipe is None or ENSEMBLE not in self.models:
            return selection
        selection = replace(selection, selected_ensemble=ENSEMBLE, default_ensemble=ENSEMBLE)
        hull_candidate = next(
            (item for item in selection.candidates if item.name == SINGLE_MODEL_NAME), None
        )
        # a hull that diverged is no usable simulator, so that the selection by errors applies
        # instead
        if hull_candidate is None or hull_candidate.n_diverged:
            return selection
        faults_text = (
            f", with these faults: {'; '.join(hull_candidate.faults)}"
            if hull_candidate.faults
            else ""
        )
        return replace(
            selection,
            selected=SINGLE_MODEL_NAME,
            reason=f"{SINGLE_MODEL_NAME} is the recipe's single model{faults_text}.",
        )

    def __getitem__(self, name: str) -> FittedModel:
        return self.models[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)


@dataclass(frozen=True)
class TeacherForcedRun:
    """Accelerations of a model along the measured states of a log, with zero initial memory.

    Attributes:
        channels: channels that baseline and head see [T, nz].
        baseline_accelerations: accelerations of the baseline [T, n].
        predicted_accelerations: accelerations of baseline and head together [T, n].
    """

    channels: Tensor
    baseline_accelerations: np.ndarray
    predicted_accelerations: np.ndarray


def run_teacher_forced(model: HybridDynamics, log: PreparedLog) -> TeacherForcedRun:
    """Evaluate a model along the measured states of a log.

    Args:
        model: the model, in float64.
        log: prepared log; gaps are filled with 0, and predictions there are meaningless.
    """
    # in float64, so that the residuals to be tested contain no rounding errors
    model = model.to(torch.float64)
    z = compute_channels(log, model.signals)
    with torch.no_grad():
        baseline_accelerations = model.baseline_acceleration(z).numpy()
        predicted_accelerations = model.one_step_accelerations(z[None])[0].numpy()
    return TeacherForcedRun(z, baseline_accelerations, predicted_accelerations)


def build_residual_table(
    fitted_models: Iterable[FittedModel], logs: Sequence[PreparedLog], max_samples: int = 1500
) -> pd.DataFrame:
    """Return residual targets and head predictions along the measured states.

    Every head runs teacher-forced over each log.

    Args:
        fitted_models: models; those without a head are skipped.
        max_samples: approximate number of evenly spaced samples per model and axis.

    Returns:
        Columns model, axis, target, predicted (accelerations, SI); empty without heads.
    """
    rows: list[tuple[Any, ...]] = []
    for fitted_model in fitted_models:
        if fitted_model.spec.role != "head":
            continue
        residual_pairs = []
        for log in logs:
            teacher_forced_run = run_teacher_forced(fitted_model.model, log)
            residuals = (
                log.nu_dot - teacher_forced_run.baseline_accelerations,
                teacher_forced_run.predicted_accelerations
                - teacher_forced_run.baseline_accelerations,
            )
            residual_pairs.append(np.stack(residuals, axis=-1)[log.trainable])
        pooled_pairs = np.concatenate(residual_pairs)
        pooled_pairs = pooled_pairs[:: max(len(pooled_pairs) // max_samples, 1)]
        rows += [
            (fitted_model.name, name, *pooled_pairs[:, axis].T)
            for axis, name in _identified_accelerations(logs)
        ]
    return _concatenate_table(["model", "axis", "target", "predicted"], rows)


def build_term_table(
    fitted_models: Iterable[FittedModel], logs: Sequence[PreparedLog]
) -> pd.DataFrame:
    """Return the terms of every head in equation form along the longest log.

    Args:
        fitted_models: models; heads that are not equations are skipped.
        logs: logs of one split, at least one.

    Returns:
        Columns model, log, axis, term, t (s), value (the term times its coefficient). The term
        `baseline_residual` is the measured acceleration minus the baseline, NaN in gaps.
    """
    log = max(logs, key=len)
    time = log.log.t - log.log.t[0]
    rows: list[tuple[Any, ...]] = []
    for fitted_model in fitted_models:
        head = fitted_model.model.head if fitted_model.spec.role == "head" else None
        if not isinstance(head, EquationHead):
            continue
        teacher_forced_run = run_teacher_forced(fitted_model.model, log)
        baseline_residual = np.where(
            log.trainable[:, None], log.nu_dot - teacher_forced_run.baseline_accelerations, np.nan
        )
        for axis, name in _identified_accelerations([log]):
            term_values = {
                "target": baseline_residual[:, axis],
                **head.term_contributions(teacher_forced_run.channels, axis),
            }
            rows += [
                (fitted_model.name, log.log.name, name, term, time, term_values[term])
                for term in term_values
            ]
    return _concatenate_table(["model", "log", "axis", "term", "t", "value"], rows)


def _concatenate_table(column_names: list[str], rows: list[tuple[Any, ...]]) -> pd.DataFrame:
    """Return a table from rows of scalars and arrays; scalars are repeated along the arrays."""
    import pandas as pd

    tables = [pd.DataFrame(dict(zip(column_names, row, strict=True))) for row in rows]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=column_names)


def _identified_accelerations(logs: Sequence[PreparedLog]) -> list[tuple[int, str]]:
    """Return index and name of each measured acceleration."""
    dof = logs[0].dof
    return [
        (axis_index, dof.derivative_names[axis_index]) for axis_index in dof.active_velocity_indices
    ]


GOODNESS_SPLITS = ("train", "test")


def build_goodness_rows(
    fitted_models: Iterable[FittedModel], logs: Mapping[str, Sequence[PreparedLog]], dt: float
) -> dict[str, list[GoodnessRow]]:
    """Return statistics of the one-step residuals of each model, by split.

    Large data sets are thinned to evenly spaced logs with 200,000 samples.

    Args:
        fitted_models: fitted models.
        logs: prepared logs by split; training and test logs are used.
        dt: time step in s.
    """
    models_by_name = {fitted_model.name: fitted_model for fitted_model in fitted_models}
    reference_names = find_reference_names(models_by_name.values())
    rows_by_split = {}
    for split in GOODNESS_SPLITS:
        log_stride = -(-sum(len(log) for log in logs[split]) // paged.MAX_SAMPLES_IN_MEMORY)
        selected_logs = logs[split][:: max(log_stride, 1)]
        measured_accelerations = [
            segment for log in selected_logs for segment in _trainable_segments(log, log.nu_dot)
        ]
        one_step_residuals = [
            OneStepResiduals(
                name,
                fitted_model.spec.role,
                _count_parameters_by_axis(fitted_model.model),
                [
                    segment
                    for log in selected_logs
                    for segment in _trainable_segments(
                        log,
                        log.nu_dot
                        - run_teacher_forced(fitted_model.model, log).predicted_accelerations,
                    )
                ],
                reference_names.get(name),
            )
            for name, fitted_model in models_by_name.items()
        ]
        axes = _identified_accelerations(selected_logs) if measured_accelerations else []
        rows_by_split[split] = (
            build_goodness_table(one_step_residuals, measured_accelerations, dt, axes)
            if measured_accelerations
            else []
        )
    return rows_by_split


def _trainable_segments(log: PreparedLog, values: np.ndarray) -> list[np.ndarray]:
    """Return the values [T, n] of each trainable segment."""
    return [
        values[segment_start:segment_stop]
        for segment_start, segment_stop in zip(*find_runs(log.trainable), strict=True)
    ]


def _count_parameters_by_axis(model: HybridDynamics) -> list[float]:
    """Return the number of fitted parameters of each axis, of baseline and head together."""
    if isinstance(model, MeanOfTrajectories):
        member_counts = map(_count_parameters_by_axis, model.members)
        return [sum(counts_of_axis) for counts_of_axis in zip(*member_counts, strict=True)]
    return [
        n_baseline_parameters + n_head_parameters
        for n_baseline_parameters, n_head_parameters in zip(
            model.baseline.parameter_counts(), model.head.parameter_counts(), strict=True
        )
    ]
