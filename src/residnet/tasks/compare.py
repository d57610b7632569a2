"""`residnet compare`: compare finished fits over common windows, and their settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from residnet.core.errors import UsageError
from residnet.core.format import format_count, format_number, format_signed
from residnet.core.ownership import record_folder
from residnet.evaluation.intervals import make_resampling_blocks, paired_difference
from residnet.evaluation.records import PairedDifference
from residnet.report.blocks import Cell, Section, Table, build_table, format_paired_interval
from residnet.report.figure import MAX_PREVIEW_HEIGHT, Case, Figure, Panel, style_family
from residnet.report.figure_files import write_figure
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles, StoredWindow
from residnet.report.sections.free_runs import errors_table
from residnet.report.sections.runs import error_growth
from residnet.runs.folder import RunFolder

_MAX_DIFFERENCES = 60
"""Maximum number of different settings on the page."""
_ABSENT = object()
"""Value of a key that is missing in a config; None is a possible value of a key."""


class WindowKey(NamedTuple):
    """Identifies a window of a free run in the rollouts of several runs.

    Attributes:
        log: name of the log.
        evaluation_protocol: name of the evaluation protocol, for example `T100`.
        start_time: time in s at which the free run starts, rounded to 1 ms.
    """

    log: str
    evaluation_protocol: str
    start_time: float


class EvaluatedRun(RunFiles):
    """A finished fit in a comparison, represented by the model of its verdict.

    Attributes:
        name: unique name of the run in the comparison.
        model: name of the model that the report of the run evaluates.
    """

    def __init__(self, name: str, path: Path) -> None:
        super().__init__(RunFolder.open(path).path)
        if not (path / "metrics.json").is_file():
            raise UsageError(f"{path}: has no metrics.json; compare finished runs of the task fit")
        self.name = name
        self.model = self.main_model

    @cached_property
    def windows_by_key(self) -> dict[WindowKey, StoredWindow]:
        """The evaluated free runs by log, protocol and start time."""
        stored_windows = self.read_split_windows(self.report_split)
        return {
            WindowKey(window.log, window.protocol, round(float(window.t[0]), 3)): window
            for window in stored_windows
        }


def compare_runs(paths: Sequence[Path], output_folder: Path) -> tuple[str, Path]:
    """Compare finished fits and return the text for the terminal and the path of the page.

    Args:
        paths: folders of the runs; the first run is the reference.
        output_folder: folder of the page.

    Raises:
        UsageError: if a folder has no finished fit, or the page cannot be written.
    """
    runs = open_fit_runs(paths)
    comparisons = compare_paired(runs)
    error_tables = [errors_table(run, run.report_split) for run in runs]
    for run, table in zip(runs, error_tables, strict=True):
        table.caption = f"{run.name}. {table.caption}"
    config_differences = _find_config_differences([run.resolved_config for run in runs], "")
    config_differences = [
        pair for pair in config_differences if pair[0] not in ("name", "description")
    ]
    truncation_note = (
        f" The first {_MAX_DIFFERENCES} of {len(config_differences)} are shown."
        if len(config_differences) > _MAX_DIFFERENCES
        else ""
    )
    caption = f"Settings in which the runs differ.{truncation_note}"
    difference_table = build_table(
        config_differences[:_MAX_DIFFERENCES],
        [
            ("setting", lambda pair: pair[0]),
            *((run.name, lambda pair, i=i: pair[1][i]) for i, run in enumerate(runs)),
        ],
        caption=caption if config_differences else "The runs have the same settings.",
    )
    paired_tables = [_build_paired_table(runs, comparisons)] if comparisons else []
    verdict = _write_conclusion(runs, comparisons)
    with record_folder(output_folder):
        sections = []
        if comparisons:
            # the top of the page shows the first protocol only
            first_protocol = {protocol: comparisons[protocol] for protocol in list(comparisons)[:1]}
            # the first screen has space for NRMSE, difference and interval of each run only
            summary_table = _build_paired_table(runs, first_protocol).select_columns(3, 6)
            summary_table.caption = (
                f"The model of each run's verdict, {next(iter(first_protocol))}. NRMSE: velocity"
                f" errors divided by the scales of {runs[0].name}; difference from {runs[0].name}."
            )
            figure = _plot_error_growth(runs, output_folder)
            # the first picture of a page needs no JavaScript
            sections.append(Section("", [figure.preview(), summary_table]))
            sections.append(
                Section("Models of the verdicts over common windows", [*paired_tables, figure])
            )
        sections += [
            Section("Every model of every run", error_tables),
            Section("Where the runs differ", [difference_table]),
        ]
        names = " against ".join(run.name for run in runs)
        page = write_page(output_folder, "Comparison of runs", names, [verdict], sections)
    tables = [table.to_text() for table in (*error_tables, *paired_tables, difference_table)]
    return "\n\n".join([*tables, verdict]), page


def open_fit_runs(paths: Sequence[Path]) -> list[EvaluatedRun]:
    """Open the runs of a comparison.

    Raises:
        UsageError: if a folder has no finished fit, or there are fewer than two folders.
    """
    if len(paths) < 2:
        raise UsageError("compare: name at least two runs")
    folder_names = [path.name or path.resolve().name for path in paths]
    names = (
        folder_names
        if len(set(folder_names)) == len(folder_names)
        else [str(path) for path in paths]
    )
    if len(set(names)) < len(names):
        raise UsageError("compare: the same run is given twice")
    runs = [EvaluatedRun(name, path) for name, path in zip(names, paths, strict=True)]
    for run in runs:
        if not common_velocities([runs[0], run]):
            raise UsageError(
                f"compare: {run.name} predicts {', '.join(run.dof.active_states)}, and"
                f" {runs[0].name} {', '.join(runs[0].dof.active_states)}; name runs that share a"
                " velocity (signals.velocities)"
            )
    return runs


def common_velocities(runs: Sequence[EvaluatedRun]) -> list[str]:
    """Return the velocities that all runs model, in the order of the first run."""
    return [
        name for name in runs[0].dof.active_states if all(name in r.dof.active_states for r in runs)
    ]


def _common_windows(runs: Sequence[EvaluatedRun]) -> dict[str, list[WindowKey]]:
    """Return the windows by protocol that all runs evaluated with the same length.

    The main protocol of the first run comes first.
    """
    common_keys = set.intersection(*(set(run.windows_by_key) for run in runs))
    windows_by_protocol: dict[str, list[WindowKey]] = {name: [] for name in runs[0].protocols}
    for window in sorted(common_keys):
        if len({len(run.windows_by_key[window].t) for run in runs}) == 1:
            windows_by_protocol.setdefault(window.evaluation_protocol, []).append(window)
    return {protocol: windows for protocol, windows in windows_by_protocol.items() if windows}


class RunComparison(NamedTuple):
    """The error of the model of one run over the common windows of one protocol.

    Attributes:
        windows: number of windows.
        nrmse: mean error.
        difference: paired difference from the first run.
    """

    windows: int
    nrmse: float
    difference: PairedDifference


def compare_paired(runs: Sequence[EvaluatedRun]) -> dict[str, dict[str, RunComparison]]:
    """Compute paired differences from the first run over common windows.

    Errors are normalised root mean square errors (NRMSE), averaged over the velocities of all runs,
    with the scales of the first run.

    Returns:
        The comparisons by protocol and run.
    """
    comparisons: dict[str, dict[str, RunComparison]] = {}
    scales = _reference_scales(runs)
    for protocol, windows in _common_windows(runs).items():
        errors = [
            np.array(
                [run.windows_by_key[window].mean_nrmse(run.model, scales) for window in windows]
            )
            for run in runs
        ]
        logs = list(dict.fromkeys(window.log for window in windows))
        bootstrap_blocks = make_resampling_blocks([logs.index(window.log) for window in windows])
        comparisons[protocol] = {
            run.name: RunComparison(
                len(windows),
                float(run_errors.mean()),
                paired_difference(run_errors, errors[0], runs[0].name, bootstrap_blocks),
            )
            for run, run_errors in zip(runs, errors, strict=True)
        }
    return comparisons


def _reference_scales(runs: Sequence[EvaluatedRun]) -> dict[str, float]:
    """Return the scales of the first run for the common velocities."""
    return {name: runs[0].metrics.scales[name] for name in common_velocities(runs)}


class _PairedRow(NamedTuple):
    """A line of the table of comparisons."""

    run: EvaluatedRun
    protocol: str
    comparison: RunComparison


def _build_paired_table(
    runs: Sequence[EvaluatedRun], comparisons: Mapping[str, Mapping[str, RunComparison]]
) -> Table:
    """Return the table of paired differences of all runs from the first one, by protocol."""
    reference_name = runs[0].name
    rows = [
        _PairedRow(run, protocol, entries[run.name])
        for protocol, entries in comparisons.items()
        for run in runs
    ]
    lowest_error = {
        protocol: min(entry.nrmse for entry in entries.values())
        for protocol, entries in comparisons.items()
    }

    def format_difference(row: _PairedRow) -> str:
        is_reference = row.run.name == reference_name
        return "" if is_reference else format_signed(row.comparison.difference.nrmse_mean)

    def format_interval(row: _PairedRow) -> Cell:
        is_reference = row.run.name == reference_name
        interval = row.comparison.difference.ci95
        return Cell("") if is_reference else format_paired_interval(interval, "too few logs")

    return build_table(
        rows,
        [
            ("run", lambda row: row.run.name),
            ("model", lambda row: row.run.model),
            ("protocol", lambda row: row.protocol),
            ("windows", lambda row: row.comparison.windows, str),
            ("NRMSE [-]", lambda row: row.comparison.nrmse, format_number),
            ("difference", format_difference, str),
            ("95 % confidence interval", format_interval),
        ],
        caption="Models of the verdicts over the windows that all runs evaluated, with the scales"
        f" of {reference_name}; differences from {reference_name}, negative where the error is"
        " smaller.",
        is_selected=lambda row: row.comparison.nrmse == lowest_error[row.protocol],
        group_key=lambda row: row.protocol,
    )


def _find_config_differences(values: Sequence[Any], path: str) -> list[tuple[str, list[str]]]:
    """Return the keys at which nested settings differ, with their values as text."""
    if all(value == values[0] for value in values):
        return []
    if not all(isinstance(value, Mapping) for value in values):
        return [(path, [_summarize_value(value) for value in values])]
    differences = []
    for key in dict.fromkeys(key for value in values for key in value):
        child_values = [value.get(key, _ABSENT) for value in values]
        differences += _find_config_differences(child_values, f"{path}.{key}" if path else str(key))
    return differences


def _summarize_value(value: Any) -> str:
    """Return a short text of a value; for a mapping its kind or its first items."""
    match value:
        case None | [] | ():
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case {"kind": part_kind}:
            return f"set (kind {part_kind})"
        case Mapping():
            items = [f"{key} {_summarize_value(part)}" for key, part in value.items()]
            ellipsis = " ..." if len(items) > 2 else ""
            return f"set ({', '.join(items[:2])}{ellipsis})" if items else "set"
        case list() | tuple():
            text = ", ".join(map(_summarize_value, value))
        case _:
            text = "not set" if value is _ABSENT else f"{value}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _write_conclusion(
    runs: Sequence[EvaluatedRun], comparisons: Mapping[str, Mapping[str, RunComparison]]
) -> str:
    if not comparisons:
        return "The runs have no common window: their errors cannot be compared in pairs."
    protocol, entries = next(iter(comparisons.items()))
    reference = runs[0]
    reference_error = entries[reference.name].nrmse
    best_run = min(runs, key=lambda run: entries[run.name].nrmse)
    windows_text = f"Over {format_count(entries[best_run.name].windows, 'common window')} of"
    if best_run is reference:
        return (
            f"{windows_text} {protocol}, no run has a lower error than {reference.name}"
            f" ({reference.model}, NRMSE {format_number(reference_error)})."
        )
    entry = entries[best_run.name]
    certainty = "significant" if entry.difference.excludes_zero else "not significant"
    return (
        f"{windows_text} {protocol}, {best_run.name} ({best_run.model}) has the lowest error:"
        f" NRMSE {format_number(entry.nrmse)} instead of {format_number(reference_error)} of"
        f" {reference.name} ({reference.model}); the difference is {certainty}."
    )


def _plot_error_growth(runs: Sequence[EvaluatedRun], output_folder: Path) -> Figure:
    """Plot the growth of the errors of the models over the common windows."""
    protocol, windows = next(iter(_common_windows(runs).items()))
    scales = pd.Series(_reference_scales(runs))
    error_curves = {}
    for run in runs:
        error = (
            error_growth([run.windows_by_key[window] for window in windows], run.model)[
                scales.index
            ]
            / scales
        )
        error_curves[run.name] = (error.index.to_numpy(), error.mean(axis=1).to_numpy())
    figure = Figure(
        "horizon",
        "Error against horizon",
        f"Models of the verdicts over {len(windows)} common windows of {protocol}, mean over"
        f" {', '.join(scales.index)}.",
        style_family(error_curves),
        [Panel("NRMSE [-]", "time from the start of a free run [s]", height=MAX_PREVIEW_HEIGHT)],
        [Case("", [error_curves])],
    )
    return write_figure(output_folder / "figures", figure)
