"""Prediction intervals (bands) of fitted models, calibrated on logs not used in their fit."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import nn

from residnet.core.arrays import paged
from residnet.core.errors import FitError
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.progress import begin_stage
from residnet.core.samples import Samples
from residnet.dynamics.domain_config import OperatingDomain
from residnet.dynamics.hybrid import HybridDynamics
from residnet.evaluation.band import (
    Band,
    BandsConfig,
    compute_run_weights,
    conformal_level,
    effective_sample_size,
    weighted_quantile,
)
from residnet.evaluation.bands import (
    RunErrors,
    calibrate_band,
    compute_run_errors,
    describe_few_logs,
)
from residnet.evaluation.freerun import Candidate, run_free_runs
from residnet.evaluation.protocol import Window
from residnet.heads.base import ClosedFormHead
from residnet.identification.command_variance import (
    draw_command_flights,
    widen_for_other_commands,
)
from residnet.identification.domain import estimate_density
from residnet.identification.fitter import (
    FittedModel,
    compute_residual_samples,
    find_reference_names,
)
from residnet.identification.identified import (
    IdentifiedModels,
    has_closed_form_head,
    spread_member_names,
    trajectory_member_names,
)
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.regression.estimator import Solution
from residnet.training.left_out import PriorMeans, estimate_leave_one_out
from residnet.training.refit import require_parametric_baseline


def assign_logs_to_folds(manoeuvre_kinds: Sequence[str], max_folds: int, seed: int) -> np.ndarray:
    """Return the fold of each log [L]; logs of one kind are spread over the folds.

    Args:
        manoeuvre_kinds: kind of manoeuvre of each log.
        max_folds: largest number of folds; no more than the number of logs.
        seed: seed of the random order within a kind.
    """
    # the second number separates this random stream from others with the same seed
    generator = np.random.default_rng([seed, 3])
    shuffled_indices = [
        log_index
        for manoeuvre_kind in sorted(set(manoeuvre_kinds))
        for log_index in generator.permutation(
            [i for i, log_kind in enumerate(manoeuvre_kinds) if log_kind == manoeuvre_kind]
        ).tolist()
    ]
    fold_of_log = np.empty(len(manoeuvre_kinds), dtype=int)
    fold_of_log[shuffled_indices] = np.arange(len(manoeuvre_kinds)) % min(
        max_folds, len(manoeuvre_kinds)
    )
    return fold_of_log


class LeaveFoldOutModels:
    """Models of a fit, fitted again without each fold of the training logs.

    Refitted baselines take one Gauss-Newton step from the parameters of the whole fit; closed forms
    are solved again with the complexity selected in the whole fit. Networks, symbolic equations and
    ensembles are not included, because fitting them again would take too long.

    Args:
        identified: fitted models.
        fold_of_log: index of the fold of each training log [L].
    """

    def __init__(self, identified: IdentifiedModels, fold_of_log: np.ndarray) -> None:
        self.identified = identified
        self.fold_of_log = torch.from_numpy(fold_of_log)
        self.n_folds = int(fold_of_log.max()) + 1
        self.training_samples = make_samples(
            identified.training_logs, identified.settings.signals.build()
        )
        self.failure_reasons: dict[str, str] = {}

    @cached_property
    def models_by_fold(self) -> list[dict[str, HybridDynamics]]:
        """For each model by name, the models fitted without each fold."""
        models_by_fold: list[dict[str, HybridDynamics]] = [{} for _ in range(self.n_folds)]
        for name, fitted_model in self.identified.items():
            try:
                refitted_models = self._fit_without_folds(fitted_model, models_by_fold)
            except FitError as error:
                self.failure_reasons[name] = str(error)
                continue
            for models, model in zip(models_by_fold, refitted_models, strict=False):
                models[name] = model
        return models_by_fold

    def _fit_without_folds(
        self, fitted_model: FittedModel, models_by_fold: Sequence[dict[str, HybridDynamics]]
    ) -> list[HybridDynamics]:
        """Return a model fitted without each fold; empty if it cannot quickly be fitted again."""
        role = fitted_model.spec.role
        if role == CONSTANT_VELOCITY:
            return [copy.deepcopy(fitted_model.model) for _ in range(self.n_folds)]
        if role == "baseline":
            return self._fit_baseline_without_folds(fitted_model)
        name = self.identified.settings.get_baseline_name(fitted_model.name)
        if not has_closed_form_head(fitted_model) or name not in models_by_fold[0]:
            return []
        return [
            self._fit_head_without_fold(fitted_model, models_by_fold[k][name], k)
            for k in range(self.n_folds)
        ]

    def _fit_baseline_without_folds(self, fitted_model: FittedModel) -> list[HybridDynamics]:
        """Return a baseline fitted without each fold: one refit step, or least squares."""
        settings = self.identified.settings
        refit_config = settings.refit.get(fitted_model.name)
        full_model = copy.deepcopy(fitted_model.model).to(torch.float64)
        fold_models = [copy.deepcopy(full_model) for _ in range(self.n_folds)]
        if refit_config is None or "refit" not in fitted_model.notes:
            for k, model in enumerate(fold_models):
                config = fitted_model.spec.baseline
                fold_samples = self._samples_without_fold(k)
                _load_matching_solution(
                    model.baseline, config.fit_solutions(model.baseline, fold_samples), fitted_model
                )
            return fold_models
        prior_weight = float(fitted_model.notes["prior"])
        parameters_by_fold = estimate_leave_one_out(
            full_model,
            self.training_samples,
            WindowStore.from_logs(self.identified.training_logs, torch.float64),
            refit_config.with_prior(prior_weight),
            torch.from_numpy(settings.evaluation.scales.to_array()),
            self.fold_of_log,
            fitted_model.notes["refit"]["at_rest"],
            self._solve_prior_means(fitted_model) if prior_weight >= _MIN_PRIOR_WEIGHT else None,
        )
        for model, theta in zip(fold_models, parameters_by_fold, strict=True):
            require_parametric_baseline(model).theta.data.copy_(theta)
        return fold_models

    def _solve_prior_means(self, fitted_model: FittedModel) -> PriorMeans:
        """Return the least-squares solutions of a baseline with and without each fold."""
        solutions = []
        for k in (None, *range(self.n_folds)):
            model = copy.deepcopy(fitted_model.model).to(torch.float64)
            samples = self.training_samples if k is None else self._samples_without_fold(k)
            _load_matching_solution(
                model.baseline,
                fitted_model.spec.baseline.fit_solutions(model.baseline, samples),
                fitted_model,
            )
            solutions.append(require_parametric_baseline(model).get_free().detach().clone())
        return PriorMeans(solutions[0], torch.stack(solutions[1:]))

    def _fit_head_without_fold(
        self, fitted_model: FittedModel, baseline: HybridDynamics, fold: int
    ) -> HybridDynamics:
        """Return a closed-form head fitted without a fold, on the baseline of that fold."""
        model = fitted_model.spec.build()
        model.baseline.load_state_dict(copy.deepcopy(baseline.baseline.state_dict()))
        assert isinstance(model.head, ClosedFormHead)
        residual_samples_of_fold = compute_residual_samples(model, self._samples_without_fold(fold))
        model.head.calibrate(residual_samples_of_fold)
        _load_matching_solution(
            model.head, model.head.fit_solutions(residual_samples_of_fold), fitted_model
        )
        return model.eval().requires_grad_(False)

    def _samples_without_fold(self, fold: int) -> Samples:
        """Return the training samples of a cross-validation model, whose fold is left out."""
        return self.training_samples.select(self.fold_of_log[self.training_samples.group] != fold)


def _load_matching_solution(
    module: nn.Module, solutions: Sequence[Solution], fitted_model: FittedModel
) -> None:
    """Load the solution with the hyperparameters of the fitted model, or the first solution."""
    matching_solutions = (
        solution
        for solution in solutions
        if all(
            fitted_model.notes.get(key) == value for key, value in solution.hyperparameters.items()
        )
    )
    module.load_state_dict(next(matching_solutions, solutions[0]).state, strict=False)


_MIN_PRIOR_WEIGHT = 0.1
"""Weight of the least-squares prior of a refit from which it is solved again without each fold."""
_MIN_KINDS = 3
"""Kinds of manoeuvres from which widths depend on the distance to the training data. Of two kinds,
models without one of them know a single kind and extrapolate more than the model itself: on six
simulated vessels the interval score was 3 to 11 % larger with this dependence than without."""
_MAX_CALIBRATION_SAMPLES = 1_000_000
"""Largest total number of samples of the calibration windows; more windows are thinned."""


def calibrate_bands(
    identified: IdentifiedModels, validation: Sequence[PreparedLog], config: BandsConfig
) -> dict[str, FittedModel]:
    """Return the models of a fit with prediction intervals under all protocols.

    Training logs are predicted by models fitted without them, validation logs by the models
    themselves. A model that is not refitted without logs takes the shape of its reference's
    intervals, scaled to its errors on the validation logs. If the fit used the validation logs too,
    ensembles take the intervals of their reference unchanged, and networks have none.
    """
    begin_stage("calibrating bands")
    fold_of_log = assign_logs_to_folds(
        [log.log.manoeuvre for log in identified.training_logs], config.folds, config.seed
    )
    fold_models = LeaveFoldOutModels(identified, fold_of_log)
    models_by_fold = fold_models.models_by_fold if int(fold_of_log.max()) > 0 else [{}]
    kinds, kind_of_log = np.unique(
        [log.log.manoeuvre for log in identified.training_logs], return_inverse=True
    )
    models_by_kind = (
        LeaveFoldOutModels(identified, kind_of_log).models_by_fold
        if len(kinds) >= _MIN_KINDS
        else []
    )
    bands_by_model: dict[str, dict[str, Band]] = {}
    for protocol in identified.settings.evaluation.protocols:
        calibration = _ProtocolCalibration(
            identified, protocol, config, fold_models.failure_reasons
        )
        for fold_index, models in enumerate(models_by_fold):
            logs_of_fold = _select_logs(identified.training_logs, fold_of_log == fold_index)
            other_logs = _select_logs(identified.training_logs, fold_of_log != fold_index)
            calibration.add_runs(
                models,
                logs_of_fold,
                calibration.cross_validated_errors,
                # a log in its own domain would be closer to the training data than a new one
                estimate_density(other_logs or logs_of_fold, identified.settings.signals),
            )
        for kind_index, models in enumerate(models_by_kind):
            other_logs = _select_logs(identified.training_logs, kind_of_log != kind_index)
            calibration.add_runs(
                models,
                _select_logs(identified.training_logs, kind_of_log == kind_index),
                calibration.other_kind_errors,
                estimate_density(other_logs, identified.settings.signals),
            )
        if not identified.validation_in_training:
            calibration.add_runs(
                {name: entry.model for name, entry in identified.items()},
                validation,
                calibration.validation_errors,
                estimate_density(identified.training_logs, identified.settings.signals),
            )
        for name, band in calibration.calibrate_all().items():
            bands_by_model.setdefault(name, {})[protocol] = band
    models_with_bands = dict(identified)
    for name, bands in bands_by_model.items():
        # an exported model has one band: the one with the longest horizon
        longest_band = max(bands.values(), key=lambda band: band.horizon)
        spec = models_with_bands[name].spec.model_copy(update={"band": longest_band.to_table()})
        models_with_bands[name] = replace(models_with_bands[name], spec=spec, bands=bands)
    return models_with_bands


def _select_logs(logs: Sequence[PreparedLog], is_selected: np.ndarray) -> Sequence[PreparedLog]:
    """Return the selected logs [L] bool."""
    return paged.PageReleasingList(
        log for log, selected in zip(logs, is_selected, strict=True) if selected
    )


class _ProtocolCalibration:
    """Free runs that calibrate the prediction intervals of one protocol.

    Args:
        identified: fitted models.
        protocol_name: name of the protocol.
        config: settings of the calibration.
        failure_reasons: reason by model for which it was not fitted without some of the logs.
    """

    def __init__(
        self,
        identified: IdentifiedModels,
        protocol_name: str,
        config: BandsConfig,
        failure_reasons: Mapping[str, str],
    ) -> None:
        self.failure_reasons = failure_reasons
        self.fitted_models = identified
        self.protocol = identified.settings.evaluation.protocols[protocol_name]
        self.config = config
        self.dt = identified.settings.prepare.grid.step
        n_expected_windows = (
            sum(len(log) for log in identified.training_logs) * self.dt / config.every
        )
        window_length = max(
            (
                window.stop - window.start
                for log in identified.training_logs[:1]
                for window in self._make_windows([log])
            ),
            default=1,
        )
        self.window_stride = max(
            1, round(n_expected_windows * window_length / _MAX_CALIBRATION_SAMPLES)
        )
        self.cross_validated_errors: dict[str, list[RunErrors]] = {}
        self.validation_errors: dict[str, list[RunErrors]] = {}
        self.other_kind_errors: dict[str, list[RunErrors]] = {}

    def add_runs(
        self,
        models: Mapping[str, HybridDynamics],
        logs: Sequence[PreparedLog],
        errors_by_model: dict[str, list[RunErrors]],
        domain: OperatingDomain,
    ) -> None:
        """Add the errors of free runs over logs that the models were not fitted on.

        Args:
            models: models by name.
            logs: the logs.
            errors_by_model: where the errors are added.
            domain: density of the logs that the models were fitted on.
        """
        is_validation = errors_by_model is self.validation_errors
        windows = self._make_windows(logs)[:: 1 if is_validation else self.window_stride]
        if not windows or not models:
            return
        spread_members = spread_member_names(self.fitted_models[name] for name in models)
        candidates = [
            Candidate(
                name,
                self.fitted_models[name].spec.role,
                model,
                members=trajectory_member_names(self.fitted_models[name]),
                spread_members=spread_members,
                domain=domain,
                domain_inputs=tuple(self.fitted_models.settings.signals.input_columns),
            )
            for name, model in models.items()
        ]
        predictions_by_model = run_free_runs(
            candidates, windows, logs, self.dt, self.fitted_models.velocity_limits
        )
        for name, predictions in predictions_by_model.items():
            errors_of_runs = compute_run_errors(windows, predictions, logs)
            errors_by_model.setdefault(name, []).extend(errors_of_runs)

    def _make_windows(self, logs: Sequence[PreparedLog]) -> list[Window]:
        return [
            window
            for log_index, log in enumerate(logs)
            for window in self.protocol.make_overlapping_windows(
                log, log_index, self.dt, self.config.every
            )
        ]

    def calibrate_all(self) -> dict[str, Band]:
        """Return the band of each model; empty if no log is long enough."""
        reference_errors = self.cross_validated_errors.get(
            CONSTANT_VELOCITY, []
        ) + self.validation_errors.get(CONSTANT_VELOCITY, [])
        if not reference_errors:
            return {}
        constant_velocity_errors = np.concatenate([run.error for run in reference_errors])
        score_unit = np.zeros(constant_velocity_errors.shape[1])
        is_scored = np.isfinite(constant_velocity_errors).any(axis=0)
        score_unit[is_scored] = np.sqrt(
            np.nanmean(np.compress(is_scored, constant_velocity_errors, axis=1) ** 2, axis=0)
        )
        # a channel without any error of constant velocity would give a zero scale
        score_unit = np.where(score_unit > 0, score_unit, 1.0)
        bands_by_model: dict[str, Band] = {}
        for name in self.cross_validated_errors:
            errors_of_runs = self.cross_validated_errors[name] + self.validation_errors.get(
                name, []
            )
            bands_by_model[name] = calibrate_band(
                errors_of_runs,
                self.config.level,
                self.dt,
                score_unit,
                self.other_kind_errors.get(name, ()),
            )
        reference_names = find_reference_names(self.fitted_models.values())
        for name, fitted_model in self.fitted_models.items():
            reference_name = reference_names.get(name, "baseline")
            if name not in bands_by_model and self.validation_errors.get(name):
                bands_by_model[name] = self._borrow_band(
                    fitted_model, bands_by_model, reference_name, score_unit
                )
            elif (
                name not in bands_by_model
                and trajectory_member_names(fitted_model)
                and reference_name in bands_by_model
            ):
                band = bands_by_model[reference_name]
                cautions = (_REFERENCE_BAND_CAUTION.format(reference_name), *band.cautions)
                bands_by_model[name] = replace(band, cautions=cautions)
        logs = self.fitted_models.training_logs
        flights = draw_command_flights(
            self._make_windows(logs), logs, self.fitted_models.settings.signals
        )
        widened_bands = widen_for_other_commands(
            bands_by_model,
            self.fitted_models.models,
            flights,
            self.dt,
            self.fitted_models.velocity_limits,
        )
        return {name: widened_bands[name] for name in self.fitted_models if name in widened_bands}

    def _borrow_band(
        self,
        fitted_model: FittedModel,
        known_bands: Mapping[str, Band],
        reference_name: str,
        score_unit: np.ndarray,
    ) -> Band:
        """Return the band of a model that was not fitted again without some of the logs.

        It has the shape of the reference's band, which is known from many logs. The factor on its
        width is the ratio of the two models' error quantiles over the same validation logs.
        """
        errors_of_runs = self.validation_errors[fitted_model.name]
        n_logs = len({run.log for run in errors_of_runs})
        if reference_name not in known_bands or not self.validation_errors.get(reference_name):
            band = calibrate_band(errors_of_runs, self.config.level, self.dt, score_unit)
            reason_text = (
                f" ({self.failure_reasons[fitted_model.name]})"
                if fitted_model.name in self.failure_reasons
                else ""
            )
            return replace(
                band,
                cautions=(
                    _VALIDATION_ONLY_CAUTION.format(n_logs, reason_text),
                    *describe_few_logs(n_logs, self.config.level),
                ),
            )
        reference_band = known_bands[reference_name]
        width_ratios = _normalized_error_quantile(
            errors_of_runs, reference_band, self.config.level
        ) / _normalized_error_quantile(
            self.validation_errors[reference_name], reference_band, self.config.level
        )
        width_ratios = np.where(np.isfinite(width_ratios), width_ratios, 1.0)
        return replace(
            reference_band,
            half_width=reference_band.half_width * width_ratios,
            unconditional_width=reference_band.unconditional_width * width_ratios,
            constant_width=reference_band.constant_width * width_ratios,
            n_logs=n_logs,
            cautions=(
                _SCALED_CAUTION.format(reference_name, n_logs),
                *describe_few_logs(n_logs, self.config.level),
            ),
        )


_SCALED_CAUTION = (
    "This model was not fitted again without the calibration logs: its band has the shape of that"
    " of {} and a width from {} validation logs, which also selected models or stopped the training"
    " early."
)
_VALIDATION_ONLY_CAUTION = (
    "This band is calibrated on only {} validation logs, because no model could be fitted without"
    " some of the training logs{}. These logs also selected models or stopped the training early."
)
_REFERENCE_BAND_CAUTION = (
    "This model was fitted on all logs, because they are short: its band is that of {}, which was"
    " fitted again without some of them."
)


def _normalized_error_quantile(
    errors_of_runs: Sequence[RunErrors], band: Band, level: float
) -> np.ndarray:
    """Return the quantile [c] of the ratios of errors to the half widths of a band."""
    names = [run.log for run in errors_of_runs]
    run_weights = compute_run_weights(names)
    normalized_errors = [run.error / run.half_widths(band) for run in errors_of_runs]
    coverage = np.array([np.nanmean(ratio <= 1.0) for ratio in normalized_errors])
    # correction for the small number of independent runs, as in the calibration of a band
    corrected_level = conformal_level(
        level, effective_sample_size(coverage, run_weights, names, level)
    )
    pooled_errors = np.concatenate(normalized_errors)
    sample_weights = np.repeat(run_weights, [len(ratio) for ratio in normalized_errors])
    return np.array(
        [
            weighted_quantile(pooled_errors[:, i], sample_weights, corrected_level)
            for i in range(pooled_errors.shape[1])
        ]
    )
