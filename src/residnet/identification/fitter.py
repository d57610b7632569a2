"""Fitted models, their storage, and the steps of a fit.

The steps are the constant-velocity model, baselines, heads on a baseline, and ensembles.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from residnet.baselines import BaselineConfig
from residnet.baselines.base import Baseline, ParametricBaseline
from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.arrays import paged
from residnet.core.errors import FitError
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.progress import log_message
from residnet.core.samples import Samples
from residnet.dynamics.ensemble import MeanOfTrajectories, mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, rebuild_module
from residnet.evaluation.band import Band
from residnet.evaluation.freerun import Candidate, FreeRunErrors, Prediction, run_free_runs
from residnet.evaluation.protocol import EvaluationConfig, make_windows
from residnet.heads.base import ClosedFormHead
from residnet.identification.domain import estimate_domain
from residnet.identification.member_evidence import MemberSelection, group_windows, select_members
from residnet.identification.prepared import compute_velocity_limits
from residnet.identification.recipe import TrainingDataSummary, has_enough_logs_for_networks
from residnet.identification.records import MemberExclusion, describe_exclusions
from residnet.identification.settings import FitSettings
from residnet.identification.training_schedule import resolve_training
from residnet.preprocessing.prepare import PreparedLog, compute_training_ranges
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.sparse import coefficient_to_dict
from residnet.training.config import TrainingConfig
from residnet.training.refit import refit, require_parametric_baseline
from residnet.training.score import ExampleRun, Score
from residnet.training.selection import select_by_free_run

if TYPE_CHECKING:
    from residnet.training.heads import TrainingSetup
    from residnet.training.trainer import TrainerExtensions


@dataclass(frozen=True)
class FittedModel:
    """A model with the notes of its fit.

    Attributes:
        spec: description of the model without its parameter values.
        model: the model with its parameter values.
        notes: JSON-serialisable notes of the fit: coefficients, validation error, seconds, ...
        covariance: covariance of the coefficients of a baseline refitted through rollouts, [P, P];
            None without a refit.
        bands: prediction intervals by protocol; may be empty.
    """

    spec: ModelSpec
    model: HybridDynamics
    notes: dict[str, Any]
    covariance: Tensor | None = None
    bands: Mapping[str, Band] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name in the config, in tables and in file names."""
        return self.spec.name


class FitStore:
    """Storage of finished models, from which an interrupted fit can resume.

    The base class stores nothing.

    Args:
        training_folder: folder for checkpoints and the TensorBoard log; None for neither.
    """

    def __init__(self, training_folder: Path | None = None) -> None:
        self.training_folder = training_folder

    def load_finished(self, name: str) -> FittedModel | None:
        """Return a head that an interrupted fit had finished, or None."""
        return None

    def save(self, fitted_model: FittedModel) -> None:
        """Store a model as soon as it is fitted, so that an interrupted fit can resume."""


_FIRST_BASELINE = "baseline"
_MIN_GAIN_OF_CANDIDATE = 0.02
"""Smallest relative decrease of the validation error for which a candidate joins an ensemble."""


def find_reference_names(models: Iterable[FittedModel]) -> dict[str, str]:
    """Return the name of each model's reference.

    The reference of a head is its baseline. The reference of an ensemble is the baseline with the
    smallest validation error. Any other model refers to the first baseline, which has no reference.
    """
    models_by_name = {model.name: model for model in models}
    # the number of divergences precedes the error, which excludes diverged windows
    validation_scores = {
        name: (
            int(model.notes.get("validation_diverged", 0)),
            float(model.notes.get("validation", math.inf)),
        )
        for name, model in models_by_name.items()
        if model.spec.role == "baseline"
    }
    best_baseline = min(
        validation_scores, key=lambda name: validation_scores[name], default=_FIRST_BASELINE
    )
    reference_names = {}
    for name, model in models_by_name.items():
        reference_by_role = {
            "head": str(model.notes.get("baseline", _FIRST_BASELINE)),
            "ensemble": best_baseline,
        }
        reference_name = reference_by_role.get(model.spec.role, _FIRST_BASELINE)
        if name != reference_name and reference_name in models_by_name:
            reference_names[name] = reference_name
    return reference_names


def compute_residual_samples(model: HybridDynamics, samples: Samples) -> Samples:
    """Return samples whose target is the residual of the model's baseline.

    The residual is an acceleration (Woo et al. 2018, eq. (19)) or a force (Jervan 2020, eq.
    (3.20)), depending on the head.

    Args:
        model: model with a fitted baseline.
        samples: samples with the measured acceleration as target.
    """
    with torch.no_grad():
        baseline_accelerations = paged.allocate_rows(len(samples), samples.target.shape[1])
        for row_slice in paged.iterate_row_chunks(len(samples)):
            baseline_accelerations[row_slice] = model.baseline(samples.z[row_slice])
            paged.release_pages()
        return model.head.residual_samples(samples, baseline_accelerations)


class ValidationScorer:
    """Free-run scores of models on the windows of the validation logs.

    Args:
        logs: prepared validation logs.
        config: evaluation settings with the `selection` protocol and the scales.
        dt: time step in s.
        velocity_limits: magnitude of the velocities [n] above which a free run has diverged.
        use_overlapping_windows: whether windows overlap, which uses short logs better.

    Raises:
        DataError: if no log is as long as a window of the protocol.
    """

    def __init__(
        self,
        logs: Sequence[PreparedLog],
        config: EvaluationConfig,
        dt: float,
        velocity_limits: np.ndarray,
        *,
        use_overlapping_windows: bool = False,
    ) -> None:
        self.logs = logs
        self.dt = dt
        self.velocity_limits = velocity_limits
        self.state_scales = config.scales.to_array()
        protocol = config.protocols[config.selection]
        self.windows = make_windows(
            protocol, logs, dt, config.selection, is_overlapping=use_overlapping_windows
        )

    def run(self, model: HybridDynamics) -> tuple[list[Prediction], FreeRunErrors]:
        """Return the free runs of a model over the validation windows, in float32, and errors."""
        candidate = Candidate("validated", "head", model)
        predictions = run_free_runs(
            [candidate], self.windows, self.logs, self.dt, self.velocity_limits, dtype=torch.float32
        )["validated"]
        return predictions, FreeRunErrors.from_predictions(self.windows, predictions, self.logs)

    def __call__(self, model: HybridDynamics) -> Score:
        """Return the divergences and the mean NRMSE of the validation windows, run in float32."""
        predictions, errors = self.run(model)
        n_diverged = sum(prediction.has_diverged for prediction in predictions)
        dof = errors.dof
        # states that are constant zero have no error and would reduce the mean
        normalized_rmse = (errors.rmse.mean(0) / self.state_scales)[dof.active_indices]
        window = self.windows[0]
        predicted_states = predictions[0].states
        measured = self.logs[window.log_index].y[
            window.start : window.start + len(predicted_states)
        ]
        measured_and_predicted = (
            torch.from_numpy(trajectory[:, dof.dynamic_columns]).T
            for trajectory in (measured, predicted_states)
        )
        columns = dict(
            zip(dof.dynamic_states, zip(*measured_and_predicted, strict=True), strict=True)
        )
        columns = {name: columns[name] for name in dof.active_states}
        example = ExampleRun(self.dt * torch.arange(len(predicted_states)), columns)
        nrmse_by_channel = dict(zip(dof.active_states, normalized_rmse.tolist(), strict=True))
        return Score(n_diverged, float(normalized_rmse.mean()), nrmse_by_channel, example)


@dataclass(frozen=True)
class HeadFit:
    """A head while it is fitted.

    Attributes:
        spec: description of the model.
        model: model with the fitted baseline and the head, whose parameters are fitted.
        baseline: the fitted baseline.
        residuals: training samples with the residual of the baseline as target.
        seed: seed of the initial weights and of the batches.
        start_time: time of the start, s.
    """

    spec: ModelSpec
    model: HybridDynamics
    baseline: FittedModel
    residuals: Samples
    seed: int
    start_time: float


class Fitter:
    """The steps of a fit on one set of logs.

    Args:
        logs: prepared logs by split; `train` and `validation` are used.
        settings: settings of the identification.
        store: storage of finished models.
        resolve_recipe: whether the recipe's parts and the trainings are still to be derived from
            the logs.
        validation_in_training: whether training uses the validation logs, which then select
            nothing.
        extensions: callbacks and logger of the user for trainings; None for none.
    """

    def __init__(
        self,
        logs: Mapping[str, Sequence[PreparedLog]],
        settings: FitSettings,
        store: FitStore,
        *,
        resolve_recipe: bool = True,
        validation_in_training: bool = False,
        extensions: TrainerExtensions | None = None,
    ) -> None:
        self.store = store
        self.extensions = extensions
        self.validation_in_training = validation_in_training
        self.training_logs = logs["train"]
        self.signals = settings.signals.build()
        self.lower_limits, self.upper_limits = compute_training_ranges(self.training_logs)
        self.domain = estimate_domain(
            self.training_logs, settings.signals, settings.prepare.grid.step
        )
        self.velocity_limits = compute_velocity_limits(
            self.lower_limits,
            self.upper_limits,
            settings.evaluation.divergence,
            settings.signals.dof,
        )
        self.training_samples = make_samples(self.training_logs, self.signals)
        self.validation_samples = make_samples(logs["validation"], self.signals)
        self.settings = (
            _resolve_settings(settings, self.training_samples, self.training_logs)
            if resolve_recipe
            else settings
        )
        settings = self.settings
        self.state_scales = torch.from_numpy(settings.evaluation.scales.to_array())
        self.score_on_validation = ValidationScorer(
            logs["validation"],
            settings.evaluation,
            settings.prepare.grid.step,
            self.velocity_limits,
            use_overlapping_windows=settings.recipe is not None,
        )

    def build_spec(self, name: str, role: str, baseline: BaselineConfig) -> ModelSpec:
        """Return the description of a model of this fit.

        Args:
            role: constant_velocity, baseline, head or ensemble.
        """
        settings = self.settings
        return ModelSpec.model_validate(
            {
                "schema": "residnet.model/1",
                "name": name,
                "role": role,
                "signals": settings.signals.with_thrusters().model_dump(),
                "baseline": baseline.without_file_references().model_dump(),
                "head": settings.heads[name].model_dump() if role == "head" else None,
                "dt": settings.prepare.grid.step,
                "integrator": settings.integrator,
                "hold": settings.prepare.hold,
                "low": self.lower_limits.tolist(),
                "high": self.upper_limits.tolist(),
                "domain": self.domain.model_dump(),
            }
        )

    def build_constant_velocity(self) -> FittedModel:
        """Return the model of constant velocities, the reference of all skill scores."""
        spec = self.build_spec(CONSTANT_VELOCITY, CONSTANT_VELOCITY, ZeroBaselineConfig())
        return self._save_and_reload(FittedModel(spec, spec.build(), {}))

    def fit_baseline(self, name: str = "baseline") -> FittedModel:
        """Identify a baseline by least squares and, if set, refit it through rollouts."""
        spec = self.build_spec(name, "baseline", self.settings.all_baselines[name])
        model = spec.build()
        start_time = time.perf_counter()
        solutions = spec.baseline.fit_solutions(model.baseline, self.training_samples)
        solution, choice_notes = select_by_free_run(
            model, model.baseline, solutions, self.score_on_validation
        )
        coefficients = list(solution.table)
        covariance = _free_covariance(model.baseline, solution)
        notes: dict[str, Any] = {
            "samples": len(self.training_samples),
            **solution.hyperparameters,
            **solution.notes,
            **choice_notes,
            "least_squares": self.score_on_validation(model).error,
        }
        if name in self.settings.refit:
            coefficients, covariance = self._refit_through_rollouts(
                name, model, coefficients, notes
            )
        notes["coefficients"] = [coefficient_to_dict(entry) for entry in coefficients]
        if covariance is not None:
            notes["covariance"] = covariance.tolist()
        notes |= self._validation_notes(model)
        notes["seconds"] = round(time.perf_counter() - start_time, 1)
        is_refitted = name in self.settings.refit
        return self._save_and_reload(
            FittedModel(spec, model, notes, covariance if is_refitted else None)
        )

    def _refit_through_rollouts(
        self,
        name: str,
        model: HybridDynamics,
        coefficients: list[Coefficient],
        notes: dict[str, Any],
    ) -> tuple[list[Coefficient], torch.Tensor]:
        """Refit coefficients through rollouts; return their new table and covariance."""
        refit_config = self.settings.refit[name]
        window_store = WindowStore.from_logs(self.training_logs, torch.float64)
        refitted = refit(
            model, self.training_samples, window_store, refit_config, self.state_scales
        )
        baseline = require_parametric_baseline(model)
        notes["prior"] = refit_config.prior
        parameter_names = baseline.free_parameter_names()
        notes["open"] = [
            name
            for name, is_unidentified in zip(
                parameter_names, refitted.unidentifiable.tolist(), strict=True
            )
            if is_unidentified
        ]
        # names in fit.json: `open` are unidentified parameters, `feeding` those fixed at zero
        notes["feeding"] = [parameter_names[i] for i in refitted.notes["at_rest"]]
        notes["refit"] = refitted.notes
        return baseline.refresh_table(coefficients, refitted.standard_errors), refitted.covariance

    def fit_head(self, name: str, baseline: FittedModel) -> FittedModel:
        """Fit one head on a baseline, or load it from the store of an interrupted fit.

        Args:
            name: name of the head.
            baseline: fitted baseline of the head.

        Raises:
            FitError: if the data do not determine the head.
        """
        finished_model = self.store.load_finished(name)
        if finished_model is not None:
            return finished_model
        head_fit = self.start_head(name, baseline)
        model = head_fit.model
        if isinstance(model.head, ClosedFormHead):
            model.head.calibrate(head_fit.residuals)
            try:
                solutions = model.head.fit_solutions(head_fit.residuals)
                solution, choice_notes = select_by_free_run(
                    model, model.head, solutions, self.score_on_validation
                )
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
            notes = solution.hyperparameters | solution.notes | choice_notes
        else:
            # imported here because it imports Lightning, which takes seconds to load
            from residnet.training.heads import train

            setup = self.make_training_setup(head_fit)
            notes = train(name, setup, self.store.training_folder, self.extensions)
        return self.finish_head(head_fit, notes)

    def start_head(self, name: str, baseline: FittedModel) -> HeadFit:
        """Build the model of a head on a fitted baseline, with the residuals that it learns."""
        spec = self.build_spec(name, "head", self.settings.get_baseline_config(name))
        # the seed depends on the head's name only, so that another head does not change this one
        seed = self.settings.seed * 1_000 + sum(map(ord, name))
        torch.manual_seed(seed)
        model = spec.build_single_model()
        model.baseline.load_state_dict(copy.deepcopy(baseline.model.baseline.state_dict()))
        residuals = compute_residual_samples(model, self.training_samples)
        return HeadFit(spec, model, baseline, residuals, seed, time.perf_counter())

    def make_training_setup(self, head_fit: HeadFit) -> TrainingSetup:
        """Collect windows of the training logs, scales, validation and seed for a network."""
        from residnet.training.heads import TrainingSetup

        training_config = self.settings.training[head_fit.spec.name]
        dtype = torch.float64 if training_config.is_double_precision else torch.float32

        def validate(trained_model: HybridDynamics) -> Score:
            return self.score_on_validation(head_fit.spec.average_networks(trained_model))

        return TrainingSetup(
            head_fit.model,
            head_fit.residuals,
            WindowStore.from_logs(self.training_logs, dtype),
            training_config,
            self.state_scales,
            validate,
            head_fit.seed,
        )

    def finish_head(self, head_fit: HeadFit, notes: dict[str, Any]) -> FittedModel:
        """Validate a fitted head and store it.

        Args:
            notes: notes of the fit or of the training.
        """
        name = head_fit.spec.name
        model = head_fit.spec.average_networks(head_fit.model)
        training_config = self.settings.training.get(name)
        if training_config is not None:
            notes["training"] = training_config.model_dump(mode="json")
            if training_config.require_improvement and self._is_worse_than_baseline(
                model, head_fit.baseline
            ):
                log_message(
                    f"  {name}: no epoch has a smaller validation error than the baseline; the"
                    " residual is set to zero"
                )
                head_fit.model.head.zero_residual()
                notes["zero_residual"] = True
        notes |= {
            "baseline": self.settings.get_baseline_name(name),
            "seconds": round(time.perf_counter() - head_fit.start_time, 1),
            **self._validation_notes(model),
        }
        return self._save_and_reload(FittedModel(head_fit.spec, model, notes))

    def _is_worse_than_baseline(self, model: HybridDynamics, baseline: FittedModel) -> bool:
        """Return whether a model has a larger validation error than its baseline."""
        if "validation" not in baseline.notes:
            # the constant-velocity model
            return False
        score = self.score_on_validation(model)
        baseline_score = (
            baseline.notes["validation_diverged"],
            baseline.notes["validation"],
        )
        return (score.diverged, score.error) > baseline_score

    def build_acceleration_ensemble(self, name: str, members: Sequence[FittedModel]) -> FittedModel:
        """Build, store and reload an ensemble of the mean acceleration of its members."""
        return self._save_and_reload(self._build_ensemble(name, members, "accelerations"))

    def build_trajectory_ensemble(
        self, name: str, members: Sequence[FittedModel], candidates: Sequence[FittedModel] = ()
    ) -> FittedModel:
        """Return the ensemble of fitted models: the mean of their trajectories.

        Members that diverge on a validation window are removed. Candidates join if the validation
        error then decreases, in the order of their own errors. Validation windows decide which of
        the members are used for which velocities (`member_evidence`). Logs used in training do not
        count as evidence, except against members that are worse than constant velocity.

        Raises:
            FitError: if fewer than two members remain.
        """
        retained_members = [
            member for member in members if not member.notes.get("validation_diverged")
        ]
        excluded_names = [member.name for member in members if member not in retained_members]
        if excluded_names:
            log_message(
                f"  {name}: {', '.join(excluded_names)} diverged on validation logs and is excluded"
            )
        if len(retained_members) < 2:
            raise FitError("fewer than two members did not diverge on validation logs")
        if not self.validation_in_training:
            retained_members = self._add_candidates(name, retained_members, candidates)
        selection = self._select_by_evidence(retained_members)
        dynamic_states = self.training_logs[0].dof.dynamic_states
        exclusions = [
            MemberExclusion(
                member=retained_members[exclusion.member].name,
                velocity=dynamic_states[exclusion.velocity],
                reference=exclusion.reference,
                p_value=exclusion.p_value,
            )
            for exclusion in selection.exclusions
        ]
        for sentence in describe_exclusions(exclusions):
            log_message(f"  {name}: {sentence}")
        is_member = np.asarray(selection.is_used.any(axis=1))
        excluded_names += [
            member.name
            for member, is_retained in zip(retained_members, is_member, strict=True)
            if not is_retained
        ]
        retained_members = [
            member
            for member, is_retained in zip(retained_members, is_member, strict=True)
            if is_retained
        ]
        if len(retained_members) < 2:
            raise FitError(
                f"on validation logs no mean has a smaller error than {retained_members[0].name}"
            )
        is_used = selection.is_used[is_member]
        weights = () if is_used.all() else tuple(map(tuple, selection.weights[is_member].tolist()))
        ensemble = self._build_ensemble(name, retained_members, weights=weights)
        ensemble.notes["left_out"] = excluded_names
        if exclusions:
            ensemble.notes["exclusions"] = [exclusion.model_dump() for exclusion in exclusions]
        return self._save_and_reload(ensemble)

    def _add_candidates(
        self, name: str, members: Sequence[FittedModel], candidates: Sequence[FittedModel]
    ) -> list[FittedModel]:
        """Return the members and the candidates that reduce the validation error of their mean."""
        sound_candidates = [
            candidate for candidate in candidates if not candidate.notes["validation_diverged"]
        ]
        extended_members = list(members)
        if not sound_candidates:
            return extended_members
        smallest_error = self._build_ensemble(name, extended_members).notes["validation"]
        for candidate in sorted(sound_candidates, key=lambda one: one.notes["validation"]):
            error = self._build_ensemble(name, [*extended_members, candidate]).notes["validation"]
            if error < (1.0 - _MIN_GAIN_OF_CANDIDATE) * smallest_error:
                log_message(
                    f"  {name}: with {candidate.name} the validation error is {error:.4f} instead"
                    f" of {smallest_error:.4f}"
                )
                extended_members.append(candidate)
                smallest_error = error
        return extended_members

    def _select_by_evidence(self, members: Sequence[FittedModel]) -> MemberSelection:
        """Return which members are used for which velocities, by their validation errors."""
        scorer = self.score_on_validation
        errors_by_member = [scorer.run(member.model)[1] for member in members]
        reference_spec = self.build_spec(CONSTANT_VELOCITY, CONSTANT_VELOCITY, ZeroBaselineConfig())
        constant_velocity = scorer.run(reference_spec.build())[1]
        return select_members(
            [errors.velocity_errors for errors in errors_by_member],
            constant_velocity.velocity_errors,
            lambda errors: np.sqrt(constant_velocity.mean_by_window(errors**2)),
            group_windows(scorer.windows),
            constant_velocity.dof.active_indices,
            compares_members=not self.validation_in_training,
        )

    def _build_ensemble(
        self,
        name: str,
        members: Sequence[FittedModel],
        averaged_quantity: str = "trajectories",
        weights: tuple[tuple[float, ...], ...] = (),
    ) -> FittedModel:
        spec = self.build_spec(name, "ensemble", ZeroBaselineConfig()).model_copy(
            update={
                "members": tuple(member.spec for member in members),
                "of": averaged_quantity,
                "weights": weights,
            }
        )
        member_models = [copy.deepcopy(member.model).to(torch.float64) for member in members]
        trajectory_models = [
            member_model.members[0]
            if isinstance(member_model, MeanOfTrajectories)
            else member_model
            for member_model in member_models
        ]
        model = (
            spec.average_trajectories(trajectory_models)
            if averaged_quantity == "trajectories"
            else mean_of(member_models)
        )
        notes = {"members": [member.name for member in members], **self._validation_notes(model)}
        return FittedModel(spec, model, notes)

    def _validation_notes(self, model: HybridDynamics) -> dict[str, Any]:
        """Return the validation error and the number of diverged windows for the notes."""
        score = self.score_on_validation(model)
        return {"validation": score.error, "validation_diverged": score.diverged}

    def _save_and_reload(self, fitted_model: FittedModel) -> FittedModel:
        """Store a model and return the reloaded one.

        The evaluated model is then identical to the stored one in every bit, and a resumed fit
        gives the same results.
        """
        reloaded = replace(
            fitted_model, model=rebuild_module(fitted_model.spec, fitted_model.model)
        )
        self.store.save(reloaded)
        return reloaded


def derive_settings(training_logs: Sequence[PreparedLog], settings: FitSettings) -> FitSettings:
    """Return the settings with the parts and trainings that follow from the training logs.

    Raises:
        DataError: if no log has trainable samples.
    """
    samples = make_samples(training_logs, settings.signals.build())
    return _resolve_settings(settings, samples, training_logs)


def _resolve_settings(
    settings: FitSettings, samples: Samples, training_logs: Sequence[PreparedLog]
) -> FitSettings:
    """Return the settings with the recipe's parts and the trainings that follow from the logs.

    The trainings of all networks are listed, also those that the user has set.
    """
    summary = TrainingDataSummary.from_logs(
        samples,
        training_logs,
        settings.evaluation,
        settings.prepare.grid.step,
    )
    for pair in summary.asymmetric_pairs:
        log_message(f"  {pair.description}; training windows are not mirrored")
    if settings.recipe is not None:
        settings = settings.with_parts(summary)
    has_enough_logs = has_enough_logs_for_networks(summary)
    # masks, gaps and trimmed ends can exclude most of the samples
    recorded = sum(len(log.trainable) for log in training_logs) * summary.dt
    shortage = (
        f"{summary.n_samples * summary.dt:.0f} s of the {recorded:.0f} s of the training logs can"
        f" be used in a fit, which is shorter than ten free runs of {summary.free_run_length:g} s"
    )
    if settings.recipe is not None and not has_enough_logs:
        log_message(f"  mlp and lstm are left out: {shortage}")
    training_configs = {}
    for name, head_config in settings.heads.items():
        head = head_config.build(samples.names)
        if not isinstance(head, ClosedFormHead):
            training_config = settings.training.get(name, TrainingConfig())
            if settings.recipe is None and training_config.is_derived and not has_enough_logs:
                log_message(f"  {name}: {shortage}; a network may not improve on the baseline")
            training_configs[name] = resolve_training(
                training_config, head, summary, settings.effort
            )
    return settings.model_copy(update={"training": training_configs})


def _free_covariance(baseline: Baseline, solution: Solution) -> torch.Tensor | None:
    """Return the least-squares covariance of the free parameters [P, P]; None if unknown.

    Axes are fitted one at a time, so that parameters of different axes are not correlated.
    """
    if not isinstance(baseline, ParametricBaseline) or solution.covariance is None:
        return None
    free_indices = baseline.free_indices()
    by_axis: torch.Tensor = torch.block_diag(*solution.covariance)
    return by_axis[free_indices][:, free_indices]
