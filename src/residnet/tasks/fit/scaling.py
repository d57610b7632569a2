"""Full-scale run of a fit by Froude's law of similarity (command `scale`).

The new run contains the scaled logs in `logs`, the scaled models, and their evaluation, so that the
other commands apply to it as to any fit.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from residnet.core.config import dump_config, validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import make_file_stem
from residnet.core.log import Log
from residnet.core.names import suggest_name
from residnet.core.progress import begin_stage, log_message
from residnet.dynamics.scaling import ScaleEffects
from residnet.dynamics.store import resolve_model_name
from residnet.evaluation.band import build_bands_file
from residnet.evaluation.booklet import BookletConfig
from residnet.identification.fitter import FittedModel
from residnet.identification.identified import evaluate_splits, make_candidates
from residnet.identification.prepared import convert_to_motion_through_water, prepare_splits
from residnet.identification.scaling import scale_fitted_model, scale_log
from residnet.io.sources import LogsBySplit
from residnet.manoeuvres.input_shares import InputShare
from residnet.physics.similarity import FroudeScaling
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.runs.folder import Provenance, RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import FinishedRun, TaskOutcome
from residnet.tasks.fit.booklet import write_booklet
from residnet.tasks.fit.derivatives import write_derivatives
from residnet.tasks.fit.outcome import build_fit_outcome, divergence_limit, write_evaluation

if TYPE_CHECKING:
    from residnet.tasks.fit.config import FitConfig
    from residnet.tasks.scale_settings import ScaleRequest

LOG_FOLDER = "logs"
"""Folder of the scaled logs in the run folder."""


def write_scaled_run(config: FitConfig, request: ScaleRequest) -> FinishedRun:
    """Scale the models and logs of a fit and write them into a new run folder.

    Args:
        config: config of the fit.
        request: the run, its new folder, and the ratios.

    Raises:
        UsageError: if a named model cannot be scaled, or the folder may not be used.
        DataError: if the logs of the fit cannot be read.
    """
    run = request.run
    output_folder = request.output_folder
    scaling = request.scaling
    if output_folder.resolve().is_relative_to(run.path.resolve()):
        raise UsageError(
            f"{output_folder}: lies in the run {run.path}, which is not changed; choose another"
            " --out"
        )
    if run.path.resolve().is_relative_to(output_folder.resolve()):
        raise UsageError(f"{output_folder}: contains the run {run.path}; choose another --out")
    if output_folder.exists() and not output_folder.is_dir():
        raise UsageError(f"{output_folder}: is a file, expected a folder; choose another --out")
    store = RunModelStore(run)
    names = _resolve_models(run, store, request.model_names)
    begin_stage(f"{config.name}: reading logs")
    scaled_logs = _scale_logs(config, scaling)
    scaled_config = scale_fit_config(config, scaling, output_folder, scaled_logs)
    resolved = dump_config(scaled_config)
    RunFolder(output_folder).require_usable(resolved, overwrite=request.overwrite)
    input_paths = [run.models / name / "model.json" for name in names]
    provenance = Provenance(run.resolved_config, (), config.seed, input_paths, time.time())

    def write_results(folder: RunFolder) -> TaskOutcome:
        for split, logs in scaled_logs.items():
            for index, log in enumerate(logs):
                log.save(folder.path / _log_file(split, index, log))
        begin_stage("scaling models")
        scaled_models = _scale_models(
            store, names, scaling, request.effects, is_strict=bool(request.model_names)
        )
        new_store = RunModelStore(folder)
        for fitted_model in scaled_models:
            new_store.save(fitted_model)
        bands = {model.name: model.bands for model in scaled_models}
        if any(bands.values()):
            folder.write_record(folder.bands, build_bands_file(scaled_config.name, bands))
        return _evaluate(scaled_config, run, folder, scaled_models, scaling)

    output_folder.mkdir(parents=True, exist_ok=True)
    with RunFolder(output_folder).lock():
        folder = RunFolder.create(output_folder, resolved, overwrite=request.overwrite)
        return scaled_config.run_in_folder(folder, provenance, write_results)


def _resolve_models(run: RunFolder, store: RunModelStore, model_names: Sequence[str]) -> list[str]:
    stored_names = store.names()
    for name in model_names:
        resolved_name = resolve_model_name(run.path, name)
        if resolved_name not in stored_names:
            raise UsageError(f"{run.path}: no model '{name}'{suggest_name(name, stored_names)}")
    resolved = [resolve_model_name(run.path, name) for name in model_names]
    references = [name for name in ("constant_velocity", "baseline") if name in stored_names]
    return list(dict.fromkeys((*references, *resolved))) if resolved else stored_names


def _scale_models(
    store: RunModelStore,
    names: Sequence[str],
    scaling: FroudeScaling,
    effects: ScaleEffects,
    *,
    is_strict: bool,
) -> list[FittedModel]:
    """Return the scaled models; those that cannot be scaled are reported and left out."""
    scaled_models = []
    for name in names:
        try:
            scaled_models.append(scale_fitted_model(store.load(name), scaling, effects))
        except UsageError as error:
            if is_strict:
                raise
            log_message(f"  {error}")
    if not any(model.spec.role != "constant_velocity" for model in scaled_models):
        raise UsageError(f"{store.folder.path}: none of its models can be scaled")
    return scaled_models


def _scale_logs(config: FitConfig, scaling: FroudeScaling) -> LogsBySplit:
    """Return the logs of a fit at the target scale, with the motion at every sample.

    Raises:
        DataError: if a log cannot be read.
    """
    try:
        logs_by_split = config.load_logs()
    except DataError as error:
        raise DataError(f"{error}; the logs of the fit are needed for its full-scale run") from None
    # estimated velocities depend on settings in seconds, so that they are estimated before scaling
    return {
        split: [
            scale_log(complete_motion(log, config.prepare.motion, config.signals.dof), scaling)
            for log in logs
        ]
        for split, logs in logs_by_split.items()
    }


def _log_file(split: str, index: int, log: Log) -> str:
    # parts of one recording have equal names
    return f"{LOG_FOLDER}/{split}_{index + 1:03d}_{make_file_stem(log.name)}.parquet"


def scale_fit_config(
    config: FitConfig, scaling: FroudeScaling, folder: Path, logs: LogsBySplit
) -> FitConfig:
    """Return the config of the full-scale run, whose logs are in its folder.

    Args:
        config: config of the fit.
        scaling: ratios of lengths and densities.
        folder: folder of the full-scale run.
        logs: scaled logs by split.

    Raises:
        ConfigError: if a value at the target scale is out of its range.
    """
    scaled = scaling.scale_config(config)
    root = folder.resolve()
    files = {
        split: [_log_file(split, index, log) for index, log in enumerate(logs_of_split)]
        for split, logs_of_split in logs.items()
    }
    text = f"scaled by Froude's law with ratio {scaling.scale:g}"
    update = {
        "name": f"{config.name}_full_scale",
        "description": f"{config.description}; {text}" if config.description else text,
        "prepare": scaled.prepare.model_copy(update={"motion": MotionConfig()}),
        "booklet": None if config.booklet is None else scale_booklet(config.booklet, scaling),
        "derivatives": None
        if scaled.derivatives is None
        else scaled.derivatives.model_copy(
            update={
                "scale": scaled.derivatives.scale / scaling.scale,
                "density_ratio": scaled.derivatives.density_ratio / scaling.density_ratio,
            }
        ),
        "study": None,
        "export": config.export.model_copy(update={"models": ()}),
    }
    scaled = scaled.model_copy(update=update)
    # the root exists when the logs are read, not yet when the config is validated
    root.mkdir(parents=True, exist_ok=True)
    content = scaled.model_dump(mode="json", by_alias=True)
    content["data"] = {
        "kind": "measured",
        "reader": {"kind": "canonical"},
        "split": {"root": str(root), **files},
    }
    return validate_config(content, type(config), "full-scale config")


def scale_booklet(config: BookletConfig, scaling: FroudeScaling) -> BookletConfig:
    """Return the manoeuvring booklet at the target scale.

    Its `scale` is the remaining factor to the size of the ship.
    """

    scaled = scaling.scale_config(config)

    def scale_share(name: str, share: InputShare) -> InputShare:
        # values of the input at full propulsion and full steering command, and without both
        drive, steer, centre, limit, rate = share.to_si(name)
        factor = scaling.channel_factor(name)
        # lag and delay have units in the config and are scaled already
        return scaled.inputs[name].model_copy(
            update={
                "drive": drive * factor,
                "steer": steer * factor,
                "centre": centre * factor,
                "limit": limit * factor,
                "rate": None if share.rate is None else rate * factor / scaling.time_factor,
            }
        )

    return scaled.model_copy(
        update={
            "scale": config.scale / scaling.scale,
            "inputs": {name: scale_share(name, share) for name, share in config.inputs.items()},
            "initial": {
                name: float(value) * scaling.channel_factor(name)
                for name, value in config.initial.items()
            },
        }
    )


def _evaluate(
    config: FitConfig,
    run: RunFolder,
    folder: RunFolder,
    models: Sequence[FittedModel],
    scaling: FroudeScaling,
) -> TaskOutcome:
    """Evaluate scaled models on the scaled logs; write results and manoeuvring booklet."""
    begin_stage("free runs")
    logs = prepare_splits(config.load_logs(), config)
    logs, _ = convert_to_motion_through_water(logs, config)
    models_by_name = {model.name: model for model in models}
    reference = next(model for model in models if model.spec.role != "constant_velocity")
    limits = divergence_limit(reference.spec, config)
    evaluations = evaluate_splits(
        make_candidates(models),
        {str(split): logs[split] for split in config.evaluation.splits},
        config.evaluation,
        config.prepare.grid.step,
        limits,
    )
    metrics = run.read_metrics()

    def choose(name: str | None) -> str:
        return name if name in models_by_name and name is not None else reference.name

    selected_ensemble = metrics.selected_ensemble
    write_evaluation(
        folder,
        config,
        evaluations,
        (
            choose(metrics.selected),
            selected_ensemble if selected_ensemble in models_by_name else None,
            choose(metrics.predictor),
        ),
        logs,
    )
    failure = ""
    if config.booklet is not None and config.booklet.model in models_by_name:
        try:
            fitted_model = models_by_name[config.booklet.model]
            log_message("  " + write_booklet(folder, config.booklet, fitted_model, logs, limits))
        except DataError as error:
            failure = str(error)
    if config.derivatives is not None and config.derivatives.model in models_by_name:
        write_derivatives(folder, config.derivatives, models_by_name[config.derivatives.model])
    outcome = build_fit_outcome(folder, "test", failure_message=failure)
    sentence = (
        f"Models and logs are scaled by Froude's law of similarity with ratio {scaling.scale:g};"
        " the errors are those of the model tests at full scale, not of full-scale trials."
    )
    return replace(outcome, verdict=[*outcome.verdict, sentence])
