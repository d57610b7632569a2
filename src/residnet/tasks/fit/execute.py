"""Carry out the task `fit`: identify, evaluate, write the results, and serve its commands."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.core.config import dump_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import read_json
from residnet.core.model_names import CONSTANT_VELOCITY, PLANT
from residnet.core.names import suggest_name
from residnet.core.progress import begin_stage, log_message
from residnet.dynamics.store import load_model, model_names
from residnet.evaluation.band import build_bands_file
from residnet.evaluation.goodness import build_goodness_file
from residnet.evaluation.soundness import build_sanity_file
from residnet.evaluation.verdict import (
    describe_diverged_heads,
    list_model_objections,
    rate_model,
    write_verdict,
)
from residnet.export import get_exporter
from residnet.export.vessel import ExportedVessel
from residnet.identification.excitation import assess_excitation
from residnet.identification.fit import fit_models
from residnet.identification.identified import (
    build_goodness_rows,
    build_residual_table,
    build_term_table,
    evaluate_splits,
    make_candidates,
)
from residnet.identification.prepared import (
    check_window_fits,
    convert_to_motion_through_water,
    prepare_splits,
)
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.report.run_reader import RunFiles
from residnet.report.sections.verdict import collect_evidence
from residnet.runs.folder import Provenance, RunFolder, require_apart
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import ExportRequest, FinishedRun, TaskOutcome
from residnet.tasks.fit.booklet import write_booklet
from residnet.tasks.fit.derivatives import write_derivatives
from residnet.tasks.fit.outcome import (
    EXTERNAL_SPLIT,
    build_fit_outcome,
    divergence_limit,
    list_test_files,
    mark_logs_of_fit,
    read_external_logs,
    write_evaluation,
    write_inspection,
)
from residnet.training.records import CurrentsFile

if TYPE_CHECKING:
    from residnet.dynamics.hybrid import HybridDynamics
    from residnet.dynamics.store import ModelSpec
    from residnet.tasks.fit.config import FitConfig
    from residnet.tasks.fit.service import MonitoredLog, NextTrials, RefitResult
    from residnet.tasks.scale_settings import ScaleRequest


def execute(config: FitConfig, folder: RunFolder) -> TaskOutcome:
    """Fit all models, evaluate them in free runs, and write the results.

    If the config asks for currents, logs are converted to the motion through the water.

    Raises:
        ResidnetError: if the logs cannot be used, or do not determine a model.
    """
    begin_stage(f"{config.name}: reading logs")
    raw_logs = config.load_logs()
    write_inspection(folder, raw_logs, config)
    logs = prepare_splits(raw_logs, config)
    log_message("  " + ", ".join(f"{split} {len(members)} logs" for split, members in logs.items()))
    logs, currents = convert_to_motion_through_water(logs, config)
    if config.current is not None:
        folder.write_record(folder.currents, CurrentsFile(tuple(currents)))
    identified_models = fit_models(logs, config, store=RunModelStore(folder))
    begin_stage("free runs")
    fitted_models = list(identified_models.values())
    time_step = config.prepare.grid.step
    if config.bands is not None:
        bands = {entry.name: entry.bands for entry in fitted_models}
        folder.write_record(folder.bands, build_bands_file(config.name, bands))
    evaluation_logs = {str(split): logs[split] for split in config.evaluation.splits}
    evaluations = identified_models.evaluate(evaluation_logs, config.data)
    selection = identified_models.select_models(evaluations)
    predictor_text = (
        "" if selection.default_ensemble is None else f"; predictor: {selection.default_ensemble}"
    )
    log_message(f"  selected: {selection.selected}{predictor_text}")
    for warning in describe_diverged_heads(selection.to_record()):
        log_message(f"  {warning}")
    folder.write_record(folder.selection, selection.to_record())
    folder.write_record(folder.sanity, build_sanity_file(identified_models.sanity_findings))
    folder.write_record(
        folder.excitation,
        assess_excitation(
            logs, config.signals, time_step, fitted_models[0].spec.domain, config.name
        ),
    )
    names = (selection.selected, selection.selected_ensemble, selection.default_model)
    write_evaluation(folder, config, evaluations, names, logs)
    for table_path, result_table in {
        folder.residuals: build_residual_table(fitted_models, logs["test"]),
        folder.path / "terms.parquet": build_term_table(fitted_models, logs["test"]),
    }.items():
        if len(result_table):
            folder.write_table(table_path, result_table)
    goodness_by_split = build_goodness_rows(fitted_models, logs, time_step)
    folder.write_record(
        folder.goodness, build_goodness_file(config.name, goodness_by_split, time_step)
    )
    failure = ""
    if config.booklet is not None:
        refitted = identified_models[config.booklet.model]
        try:
            log_message(
                "  "
                + write_booklet(
                    folder, config.booklet, refitted, logs, identified_models.velocity_limits
                )
            )
        except DataError as error:
            # the fit is complete: write its report before the error ends the run
            failure = str(error)
    if config.derivatives is not None:
        write_derivatives(folder, config.derivatives, identified_models[config.derivatives.model])
    exports = {
        name: partial(export_model, config, ExportRequest(folder, name))
        for name in config.export.models
    }
    return build_fit_outcome(folder, "test", exports, failure)


def evaluate_on_logs(
    config: FitConfig,
    run: RunFolder,
    logs: Sequence[Path],
    output_folder: Path | None,
    *,
    resume: bool = False,
    overwrite: bool = False,
) -> FinishedRun:
    """Evaluate all models in free run on other logs; see `FitConfig.evaluate_on_logs`."""
    folder_path = output_folder or run.path / time.strftime("external-%Y%m%dT%H%M%S")
    resolved = dump_config(config)
    # refuse an unusable folder before the logs are read, which may take long
    if run.resolved_config.resolve().is_relative_to(folder_path.resolve()):
        raise UsageError(
            f"{folder_path}: contains the run {run.path} that is evaluated; choose another --out,"
            " or none for a new folder in the run"
        )
    RunFolder(folder_path).require_usable(resolved, resume=resume, overwrite=overwrite)
    input_paths, raw_logs, prepared = read_external_logs(config, logs)
    raw_logs = mark_logs_of_fit(raw_logs, run, list_test_files(config.data))
    for log in prepared:
        check_window_fits(log, config)
    provenance = Provenance(run.resolved_config, (), config.seed, input_paths, time.time())
    if resume:
        provenance.require_same_inputs(RunFolder(folder_path))
    if overwrite:
        require_apart(folder_path, input_paths)

    def evaluate_models(folder: RunFolder) -> TaskOutcome:
        store = RunModelStore(run)
        model_order = [CONSTANT_VELOCITY, *config.model_names]
        fitted_models = [store.load(name) for name in store.names()]
        fitted_models.sort(key=lambda model: (*model_order, model.name).index(model.name))
        log_message(f"{config.name}: {len(prepared)} logs, {len(fitted_models)} models")
        write_inspection(folder, {EXTERNAL_SPLIT: raw_logs}, config)
        is_simulated = isinstance(config.data, SimulatedTrials) and all(
            "vessel" in log.meta for log in raw_logs
        )
        models = [
            candidate
            for candidate in make_candidates(fitted_models, config.data)
            if candidate.model_kind != PLANT or is_simulated
        ]
        limit = divergence_limit(fitted_models[0].spec, config)
        evaluations = evaluate_splits(
            models, {EXTERNAL_SPLIT: prepared}, config.evaluation, config.prepare.grid.step, limit
        )
        # the report shows bands and model selection of the fit
        for source_path, target_path in (
            (run.bands, folder.bands),
            (run.selection, folder.selection),
            (run.excitation, folder.excitation),
        ):
            if source_path.is_file():
                folder.write(target_path, source_path.read_text(encoding="utf-8"))
        fit_metrics = run.read_metrics()
        names = (fit_metrics.selected, fit_metrics.selected_ensemble, fit_metrics.predictor)
        write_evaluation(folder, config, evaluations, names, {EXTERNAL_SPLIT: prepared})
        return build_fit_outcome(folder, EXTERNAL_SPLIT)

    with RunFolder(folder_path).lock():
        folder = RunFolder.create(folder_path, resolved, resume=resume, overwrite=overwrite)
        return config.run_in_folder(folder, provenance, evaluate_models)


def export_model(config: FitConfig, request: ExportRequest) -> Path:
    """Export one model of a finished fit; see `FitConfig.export_model`."""
    run = request.run
    name = request.model
    metrics = request.run.read_metrics()
    aliases = {"predictor": metrics.predictor, "selected": metrics.selected}
    model_name = aliases.get(name, name)
    available_models = model_names(run.models)
    if model_name not in available_models:
        raise UsageError(
            f"{run.path}: no model '{name}'{suggest_name(name, [*aliases, *available_models])}"
        )
    spec, model = load_model(run.models / model_name)
    if name in aliases and not get_exporter(request.file_format).supports(spec):
        model_name, (spec, model) = find_supported_model(request, model_name)
    rows = [row for row in metrics.rows if row.model == model_name and row.manoeuvre == "all"]
    evidence = collect_evidence(RunFiles(run.path), model_name)
    # a model without free runs on the reported split has no verdict
    sentences = write_verdict(evidence) if model_name in evidence.rows_by_model else []
    model_verdict = (rate_model(evidence), sentences)
    file = request.write(
        ExportedVessel(spec, model, rows),
        list_model_objections(evidence),
        model_name,
        model_verdict,
    )
    is_ensemble = model_name == metrics.selected_ensemble and model_name != metrics.selected
    if is_ensemble and get_exporter(request.file_format).is_for_microcontrollers:
        card = read_json(file.with_suffix(".card.json"))
        ensemble_bytes = int(card["size"]["code_bytes"])
        text = describe_single_model(run, model_name, metrics.selected, ensemble_bytes)
        log_message(f"  {text}")
    return file


def find_supported_model(
    request: ExportRequest, reported: str
) -> tuple[str, tuple[ModelSpec, HybridDynamics]]:
    """Return name, spec and module of the best model of a run that a format can hold.

    Models without a learned part come first, then the selected model, then the order of the run.

    Args:
        request: the export request.
        reported: name of the model reported first, which the format cannot hold.

    Raises:
        UsageError: if the format can hold no model of the run.
    """
    run = request.run
    export_format = get_exporter(request.file_format)
    selected = run.read_metrics().selected
    loaded = {name: load_model(run.models / name) for name in model_names(run.models)}
    candidates = [name for name, (spec, _) in loaded.items() if export_format.supports(spec)]
    if not candidates:
        raise UsageError(
            f"{run.path}: the format {request.file_format} can hold no model of this run"
            f" ({', '.join(loaded)}); choose another --format"
        )
    best = min(candidates, key=lambda name: (loaded[name][0].head is not None, name != selected))
    log_message(
        f"  the format {request.file_format} cannot hold {reported}; the model is {best} (--model)"
    )
    return best, loaded[best]


def describe_single_model(run: RunFolder, ensemble: str, single: str, ensemble_bytes: int) -> str:
    """Compare code size and validation error of the selected single model with the ensemble.

    Args:
        run: the finished run.
        ensemble: name of the ensemble that is exported.
        single: name of the selected single model.
        ensemble_bytes: bytes of code and constants of the exported ensemble.

    Returns:
        A sentence with the command that exports the single model.
    """
    from residnet.export.c import measure_c_export

    size = measure_c_export(ExportedVessel(*load_model(run.models / single)))
    share = ensemble_bytes / max(size["code_bytes"], 1)
    selection = RunFiles(run.path).selection
    rows = {row.model: row for row in selection.models} if selection is not None else {}
    error_text = ""
    if ensemble in rows:
        # errors of the rows are relative to the single model
        increase = -math.log(rows[ensemble].ratio)
        is_within = increase <= rows[ensemble].standard_error
        percentage = 100.0 * math.expm1(increase)
        error_text = (
            f"; its validation error is {abs(percentage):.1f} %"
            f" {'higher' if percentage > 0.0 else 'lower'} than the ensemble's"
            f" ({'within' if is_within else 'beyond'} one standard error)"
        )
    return (
        f"for microcontrollers: {single}, the selected single model, takes"
        f" {size['code_bytes']:,} bytes of code and constants (1/{share:.0f} of the ensemble),"
        f" {size['largest_stack_bytes']:,} bytes of stack and {size['memory_bytes']:,} bytes of"
        f" memory between steps{error_text}; export it with: residnet export {run.path} --format c"
        " --model selected"
    )


def monitor_run(
    config: FitConfig,
    run: RunFolder,
    logs: Sequence[Path],
    model: str,
    settings: Mapping[str, Any],
    refit_folder: Path | None,
) -> tuple[list[MonitoredLog], RefitResult | None]:
    """Test new logs for changes, and refit the model; see `FitConfig.monitor`."""
    from residnet.tasks.fit.service import FittedModelMonitor, require_refit_folder, run_refit

    if refit_folder is not None:
        require_refit_folder(run, refit_folder, config)
    monitor = FittedModelMonitor(config, run, logs, model, settings)
    monitored_logs = monitor.monitor_logs()
    refit_result = None if refit_folder is None else run_refit(monitor, refit_folder)
    return monitored_logs, refit_result


def plan_trial(
    config: FitConfig, run: RunFolder, model: str, trial_limits: Mapping[str, Any]
) -> NextTrials:
    """Plan the next trials for a refitted baseline; see `FitConfig.plan_trial`."""
    from residnet.tasks.fit.service import plan_next_trials

    return plan_next_trials(config, run, model, trial_limits)


def scale_run(config: FitConfig, request: ScaleRequest) -> FinishedRun:
    """Write the run of another scale; see `FitConfig.scale_run`."""
    from residnet.tasks.fit.scaling import write_scaled_run

    return write_scaled_run(config, request)
