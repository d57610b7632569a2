"""`residnet inspect`: check log files for errors that would mislead a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import ConfigError, DataError, ResidnetError, UsageError
from residnet.core.files import write_owned
from residnet.core.log import Log
from residnet.core.progress import report_progress
from residnet.io.drafting.log_files import find_log_files
from residnet.io.drafting.problems import group_problems, strip_file_name
from residnet.io.drafting.questions import dump_commented_yaml
from residnet.io.drafting.reading import read_mixed_formats
from residnet.io.split import assign_log_names
from residnet.quality import (
    Finding,
    InspectionReport,
    build_inspection,
    compute_condition_number,
    inspect_log,
    inspect_log_set,
    summarize_inspection,
)
from residnet.quality.records import InspectionFile, Level

if TYPE_CHECKING:
    from residnet.tasks.fit.config import FitConfig

_ILL_CONDITIONED = 1e6
"""Condition number of regressors above which noise dominates the coefficients."""


@dataclass(frozen=True)
class InspectionResult:
    """Findings of an inspection.

    Attributes:
        text: text for the terminal.
        inspection: contents of the JSON file.
    """

    text: str
    inspection: InspectionFile

    @property
    def has_problems(self) -> bool:
        """Whether the findings would mislead a fit to these logs."""
        return self.inspection.misled

    def write(self, file: Path) -> None:
        """Write the findings as JSON.

        Raises:
            UsageError: if the file cannot be written.
        """
        with write_owned(file) as temporary_path:
            temporary_path.write_text(self.inspection.to_json_text(), encoding="utf-8")


def inspect_logs(paths: Sequence[Path], config: Path | None) -> InspectionResult:
    """Inspect each log, and the logs in comparison.

    Args:
        paths: files or folders of logs.
        config: config of a fit or import whose channel map reads the logs; None for logs that
            describe themselves, or to draft a channel map.

    Raises:
        ResidnetError: if a path does not exist, the config cannot be used, or the only log
            cannot be read.
    """
    task, fit_config = (None, None) if config is None else _load_logs_task(config)
    inputs, masks = (
        (fit_config.signals.regressor_columns, fit_config.prepare.masks)
        if fit_config is not None
        else (None, ())
    )
    configured_reader = None if task is None else getattr(task, "reader", None) or task.data.reader
    files = find_log_files(paths)
    results = dict[Path, Log | ResidnetError]()
    channel_map_lines = list[str]()
    if configured_reader is None:
        results, channel_map_lines = _read_drafted_results(files)
    else:
        reader = configured_reader.build()
        for file in reader.select_logs(files):
            try:
                results[file] = reader.read(file)
            except DataError as error:
                results[file] = error
    # companion files of another log are not logs; tests of other sheets are not read
    files = sorted(results, key=lambda file: files.index(file) if file in files else len(files))
    names = assign_log_names(files)
    logs: list[Log] = []
    reports: list[InspectionReport] = []
    unreadable_files: dict[Path, str] = {}
    for number, path in enumerate(files):
        report_progress("inspecting logs", number, len(files))
        log = results[path]
        try:
            if isinstance(log, ResidnetError):
                raise DataError(str(log)) if len(files) > 1 else log
            log = log.replace(name=names[path])
            quality_report = inspect_log(log, inputs, masks)
            logs.append(log)
        except DataError as error:
            if len(files) == 1:
                raise
            message = strip_file_name(files, str(error))
            unreadable_files[path] = message
            unreadable = Finding("fatal", "unreadable", f"{path}: {message}")
            quality_report = InspectionReport(names[path], (unreadable,), str(path))
        reports.append(quality_report)
    splits = {} if fit_config is None else _split_of_logs(fit_config, names)
    joint_report = (
        inspect_log_set(logs, inputs, splits) if logs else InspectionReport("together", ())
    )
    if fit_config is not None and logs:
        joint_report = InspectionReport(
            "together", (*joint_report.findings, *_check_regressor_conditioning(logs, fit_config))
        )
    report_progress("inspecting logs", len(files), len(files))
    # one line for each reason why files cannot be read
    lines = [f"fatal: {line}" for line in group_problems(unreadable_files)]
    lines += [
        line
        for quality_report_of_log in (*reports, joint_report)
        if not quality_report_of_log.find_by_code("unreadable")
        for line in quality_report_of_log.to_lines()
    ]
    inspection = build_inspection(reports, joint_report)
    sentences = summarize_inspection(inspection).sentences
    return InspectionResult("\n".join((*sentences, *lines, *channel_map_lines)), inspection)


def _read_drafted_results(
    files: Sequence[Path],
) -> tuple[dict[Path, Log | ResidnetError], list[str]]:
    """Read files with drafted readers.

    Returns:
        The log or the error of each file, and the guessed channel maps as lines of YAML.
    """
    results = dict[Path, Log | ResidnetError]()
    channel_map_lines = list[str]()
    for draft in read_mixed_formats(files):
        results |= {**draft.logs, **draft.errors}
        # only these readers have a channel map; other formats describe their channels themselves
        if {"channels", "parts"} & set(draft.reader):
            drafted_config = {"data": {"kind": "measured", "reader": draft.reader}}
            channel_map_lines += ["channel map as guessed, to check and paste into a config:"]
            channel_map_lines += dump_commented_yaml(
                drafted_config, draft.draft_notes.comments_at
            ).splitlines()
    return results, channel_map_lines


def _load_logs_task(config: Path) -> tuple[Any, FitConfig | None]:
    """Load a config with a channel map; returns the task, and the task again if it is a fit.

    Raises:
        ConfigError: if the config has no channel map.
    """
    # torch is not needed to inspect logs without a config
    from residnet.io.sources import MeasuredLogs
    from residnet.tasks.fit.config import FitConfig
    from residnet.tasks.registry import load_task

    task = load_task(config)
    is_measured_fit = isinstance(task, FitConfig) and isinstance(task.data, MeasuredLogs)
    # a task of another package may have a reader, such as `import` of examples/residnet_tasks
    if not is_measured_fit and not hasattr(task, "reader"):
        raise ConfigError(
            f"{config}: has no channel map (data.kind is not 'measured'); leave --config out for"
            " logs that describe themselves"
        )
    return task, task if isinstance(task, FitConfig) else None


def _split_of_logs(fit_config: FitConfig, names: Mapping[Path, str]) -> dict[str, str]:
    """Return the split of each log that is part of the config's split."""
    from residnet.io.sources import MeasuredLogs

    assert isinstance(fit_config.data, MeasuredLogs)
    try:
        resolved = fit_config.data.split.resolve_paths()
    except ConfigError:
        # other logs can be inspected although files of the split are missing
        return {}
    split_by_path = {path.resolve(): split for split, paths in resolved.items() for path in paths}
    return {
        n: split_by_path[resolved_path]
        for path, n in names.items()
        if (resolved_path := path.resolve()) in split_by_path
    }


def _check_regressor_conditioning(logs: Sequence[Log], fit_config: FitConfig) -> list[Finding]:
    """Return findings on the condition number of the regressors of each baseline."""
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.preprocessing.prepare import prepare_log
    from residnet.preprocessing.samples import make_samples

    try:
        signals = fit_config.signals
        prepared = [
            prepare_log(log, "train", signals.input_columns, fit_config.prepare, signals.dof)
            for log in logs
        ]
        data = make_samples(
            [log for log in prepared if log.trainable.any()], fit_config.signals.build()
        )
    except (DataError, UsageError) as error:
        text = f"the config cannot prepare these logs: {error}"
        return [Finding("will mislead", "not_prepared", text)]
    findings = []
    for name, config in fit_config.all_baselines.items():
        baseline = config.build(data.names)
        if not isinstance(baseline, RegressorBaseline):
            continue
        regressor_matrix = baseline.library(data.z).numpy()
        terms = list(baseline.library.terms)
        is_varying = np.ptp(regressor_matrix, axis=0) > 1e-12 * np.abs(regressor_matrix).max(
            axis=0, initial=0.0
        )
        varying_indices = np.flatnonzero(is_varying)
        if len(varying_indices) < 2 or len(regressor_matrix) <= 2 * len(varying_indices):
            continue
        condition, collinear_terms = compute_condition_number(
            regressor_matrix[:, varying_indices], [terms[j] for j in varying_indices]
        )
        constant_terms = [
            term
            for term, varies in zip(terms, is_varying, strict=True)
            if not varies and term != "1"
        ]
        text = (
            f"regressors of {name} over these logs: {len(varying_indices)} move, condition number"
            f" {condition:.3g} (centred, scaled)"
        )
        text += f"; constant: {', '.join(constant_terms)}" if constant_terms else ""
        text += f"; {', '.join(collinear_terms)} move together" if condition > 30.0 else ""
        is_ill_conditioned = condition > _ILL_CONDITIONED
        action = (
            "leave regressors out, give the baseline a ridge, or add manoeuvres"
            if is_ill_conditioned
            else ""
        )
        conditioning_figures = {"condition": condition, "regressors": len(varying_indices)}
        # one or two logs are inspected, but not fitted: other logs may excite the regressors
        level: Level = "will mislead" if is_ill_conditioned and len(logs) > 2 else "note"
        findings.append(Finding(level, "regressors", text, conditioning_figures, action))
    return findings
