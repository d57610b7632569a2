"""Result files of the free runs of a fit, for the run itself and for later evaluations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import ConfigError
from residnet.core.files import read_json
from residnet.core.log import Log, make_remark
from residnet.core.names import CHANNEL_UNITS, POSE_ERROR_UNITS, si_unit
from residnet.core.progress import begin_stage, log_message
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.data_records import DataQualityFile, LogQuality
from residnet.evaluation.goodness import assess_repeatability
from residnet.evaluation.limits_records import LimitsFile
from residnet.evaluation.metrics import LIMITS_SCHEMA
from residnet.evaluation.metrics_file import build_metrics_file
from residnet.evaluation.rollout_tables import write_rollouts
from residnet.identification.identified import SplitEvaluation
from residnet.identification.prepared import compute_velocity_limits
from residnet.io.drafting.log_files import find_log_files
from residnet.io.readers.base import CanonicalConfig
from residnet.io.sources import MeasuredLogs
from residnet.io.split import assign_log_names
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.preprocessing.masks import SpikeMask
from residnet.preprocessing.prepare import PreparedLog, prepare_log
from residnet.quality.records import COMPATIBILITY_FILE, CompatibilityFile
from residnet.report.run_reader import RunFiles
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.verdict import verdict_level, verdict_sentences
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportWriters, SummaryMetric, TaskOutcome

if TYPE_CHECKING:
    from residnet.tasks.fit.config import FitConfig

_MAX_ANALYSED_LOGS = 6
"""Largest number of logs with a table of instrument errors, about a second each."""
EXTERNAL_SPLIT = "external"
"""Name of the split of logs that no fit has seen."""


def write_inspection(
    folder: RunFolder, splits: Mapping[str, Sequence[Log]], config: FitConfig
) -> None:
    """Write doctor.json: the inspection of all logs with the masks of the run."""
    # the check of a config does not need this import
    from residnet.quality import (
        build_inspection,
        inspect_log,
        inspect_log_set,
    )
    from residnet.quality.compatibility import analyse_compatibility

    begin_stage("examining logs")
    inputs = config.signals.regressor_columns
    masks = (*config.prepare.masks, SpikeMask())
    logs = [log for logs_of_split in splits.values() for log in logs_of_split]
    split_of = {log.name: split for split, split_logs in splits.items() for log in split_logs}
    reports = [inspect_log(log, inputs, masks) for log in logs]
    joint_report = inspect_log_set(logs, inputs, split_of)
    for report in reports:
        for finding in report.find_by_code("fill_values"):
            log_message(f"  {report.name}: {finding.text}")
    if not isinstance(config.data, SimulatedTrials):
        # instruments of simulated logs have the declared noise and no errors
        rows = tuple(analyse_compatibility(log) for log in logs[:_MAX_ANALYSED_LOGS])
        folder.write_record(folder.path / COMPATIBILITY_FILE, CompatibilityFile(rows))
    inspection = build_inspection(reports, joint_report)
    folder.write_record(folder.inspection, inspection)
    # a correctable error is reported before the fit takes its time; the verdict counts all findings
    if inspection.first:
        log_message(f"  {inspection.first}")


def write_evaluation(
    folder: RunFolder,
    config: FitConfig,
    evaluations: Mapping[str, SplitEvaluation],
    names: tuple[str, str | None, str],
    logs: Mapping[str, Sequence[PreparedLog]],
) -> None:
    """Write rollouts, metrics.json, limits.json and data_quality.json.

    Args:
        folder: folder of the run, or of an evaluation.
        config: config of the fit.
        evaluations: free runs by split.
        names: names of the selected model, of the selected ensemble, and of the predictor.
        logs: prepared logs by split, including splits without evaluation.
    """
    for split, evaluation in evaluations.items():
        write_rollouts(
            folder.rollouts / split,
            evaluation.free_runs,
            evaluation.logs,
            config.signals.input_columns,
            evaluation.bands_by_model,
        )
    scales = config.evaluation.scales.to_dict()
    states = config.signals.dof.state_names
    units = {
        name: si_unit(unit)
        for name, unit in config.signals.channel_units().items()
        if name in states
    }
    rows = [row for evaluation in evaluations.values() for row in evaluation.rows]
    folder.write_record(
        folder.metrics, build_metrics_file(config.name, units, scales, *names, rows)
    )
    n_commands = len(config.signals.inputs)
    step = config.prepare.grid.step
    evaluated_logs = [log for evaluation in evaluations.values() for log in evaluation.logs]
    limits = LimitsFile(
        schema=LIMITS_SCHEMA,
        run=config.name,
        splits={split: evaluation.limits_by_protocol for split, evaluation in evaluations.items()},
        repeatability={
            name: assess_repeatability(protocol, evaluated_logs, n_commands, scales, step)
            for name, protocol in config.evaluation.protocols.items()
        },
    )
    folder.write_record(folder.limits, limits)
    quality = [
        _summarize_log(log, split) for split, split_logs in logs.items() for log in split_logs
    ]
    folder.write_record(folder.data_quality, DataQualityFile(tuple(quality)))


def _summarize_log(log: PreparedLog, split: str) -> LogQuality:
    """Return the row of data_quality.json of a prepared log."""
    row = {
        **log.to_table_row(split),
        "masked": {
            reason: float(np.mean(mask)) for reason, mask in log.log.masks.items() if mask.any()
        },
        "largest": {
            name: float(np.abs(log.y[log.usable, log.dof.state_names.index(name)]).max())
            for name in log.dof.active_states
        },
    }
    if integrated_channels := log.log.meta.get("integrated"):
        row["integrated"] = integrated_channels
    return LogQuality.model_validate(row)


def build_fit_outcome(
    folder: RunFolder, split: str, exports: ExportWriters | None = None, failure_message: str = ""
) -> TaskOutcome:
    """Return the verdict of a fit or an evaluation, and the errors of its selected model.

    Args:
        folder: folder of the results.
        split: split of the shown errors.
        exports: functions that write the exports when the run ends; None for none.
        failure_message: message if a result failed a check; empty otherwise.
    """
    files = RunFiles(folder.path)
    row = files.find_row(files.main_model, split, files.protocols[0])
    summary_metrics: dict[str, SummaryMetric] = {}
    if row is not None:
        summary_metrics = {
            "nrmse": SummaryMetric(row.mean_nrmse),
            **{
                f"rmse_{name}": SummaryMetric(row.rmse[name], CHANNEL_UNITS[name])
                for name in files.channels
            },
            **{
                f"{name}_error_end": SummaryMetric(error, POSE_ERROR_UNITS[name])
                for name, error in row.final_pose_errors.items()
            },
        }
    sentences = [sentence for sentence in verdict_sentences(files) if sentence]
    return TaskOutcome(
        sentences,
        summary_metrics,
        errors_table(files, split).to_text(),
        failure_message,
        exports or {},
        verdict_level(files),
    )


def read_external_logs(
    config: FitConfig, paths: Sequence[Path]
) -> tuple[list[Path], list[Log], list[PreparedLog]]:
    """Read other logs as a fit reads its own; returns their files, the logs, and prepared logs.

    The reader of the fit is used. Canonical files are recognised by their metadata.

    Raises:
        ResidnetError: if a file cannot be read.
    """
    data = config.data
    fit_reader = CanonicalConfig() if isinstance(data, SimulatedTrials) else data.reader
    # a folder may be a single log, such as a ROS 2 bag
    log_paths = fit_reader.build().select_logs(find_log_files(paths))
    readers = {
        path: (CanonicalConfig() if Log.is_canonical_log(path) else fit_reader).build()
        for path in log_paths
    }
    raw_logs = [
        readers[path].read(path).replace(name=name)
        for path, name in assign_log_names(log_paths).items()
    ]
    signals = config.signals
    logs = [
        prepare_log(log, EXTERNAL_SPLIT, signals.input_columns, config.prepare, signals.dof)
        for log in raw_logs
    ]
    return (
        [
            member_file
            for path in log_paths
            for member_file in readers[path].list_member_files(path)
        ],
        raw_logs,
        logs,
    )


def list_test_files(data: MeasuredLogs | SimulatedTrials) -> set[Path]:
    """Return the files that belong to the test split alone, with which no model was fitted."""
    if not isinstance(data, MeasuredLogs):
        return set()
    try:
        files = {
            split: {path.resolve() for path in paths}
            for split, paths in data.split.resolve_paths().items()
        }
    except ConfigError:
        # the files of the fit were moved
        return set()
    other_files = {path for split, paths in files.items() if split != "test" for path in paths}
    return files.get("test", set()) - other_files


def mark_logs_of_fit(
    logs: Sequence[Log], run: RunFolder, test_files: Collection[Path] = ()
) -> list[Log]:
    """Add a finding to the logs that are among the data of a fit, by their SHA-256.

    Args:
        logs: logs that the models of the fit are evaluated on.
        run: folder of the fit.
        test_files: files of the fit with which no model was fitted.
    """
    inputs = read_json(run.provenance).get("inputs") if run.provenance.is_file() else None
    checksums = {
        checksum
        for file, checksum in (inputs if isinstance(inputs, dict) else {}).items()
        if Path(file).resolve() not in test_files
    }
    text = (
        "this log, or a part of it, is among the data of the fit (same SHA-256): its errors do not"
        " show how well the model predicts new data; evaluate on other logs"
    )
    remark = make_remark("will mislead", "log_of_fit", text)
    return [
        log.replace(meta={**log.meta, "findings": [*log.meta.get("findings", ()), remark]})
        if log.meta.get("sha256") in checksums
        else log
        for log in logs
    ]


def divergence_limit(spec: ModelSpec, config: FitConfig) -> np.ndarray:
    """Return the absolute velocities [n] beyond which a free run of a model has diverged."""
    return compute_velocity_limits(
        np.array(spec.low), np.array(spec.high), config.evaluation.divergence, spec.signals.dof
    )
