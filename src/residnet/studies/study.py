"""Common parts of the studies: execution, figures, and published numbers of the documents."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, final

import numpy as np

from residnet.core.config import load_config
from residnet.core.files import read_json
from residnet.core.format import format_minus_signs, format_number
from residnet.report.blocks import Cell, Column, Section
from residnet.report.figure import Case, Curve, Figure, GlyphStyle, Panel
from residnet.report.figure_files import read_figures, write_figure
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportWriters, PackageTask, SummaryMetric, TaskOutcome

StudyResults = Mapping[str, Any]
"""Results of a study, as in its file in the run folder."""
StudyConfig = TypeVar("StudyConfig", bound="StudyTask")
"""Config class of a study."""


class StudyTask(PackageTask):
    """A computational experiment of a document, with its results in one JSON file.

    The module `execute` in the package of the config has the `StudyExecutor` of the study.
    """

    executor_class: ClassVar[str]
    """Name of the `StudyExecutor` in the module `execute`, which is imported when it is used."""
    results_file: ClassVar[str] = "study.json"

    @final
    def build_executor(self) -> StudyExecutor[Any]:
        """Import the module of the executor and return its executor for this config."""
        executor_class: type[StudyExecutor[Any]] = getattr(self.executor(), self.executor_class)
        return executor_class(self)

    @final
    def execute(self, folder: RunFolder) -> TaskOutcome:
        executor = self.build_executor()
        results, figures = executor.compute_results(folder)
        folder.write_json(folder.path / self.results_file, results)
        for figure in figures:
            write_figure(folder.figures, figure)
        # reloaded from the file, as the report reads them
        stored_results: StudyResults = read_json(folder.path / self.results_file)
        return TaskOutcome(
            executor.summarize(stored_results),
            executor.main_figures(stored_results),
            exports=executor.export_writers(folder),
        )

    @classmethod
    @final
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        results = read_json(run.path / cls.results_file)
        config = load_config(run.resolved_config, [], cls)
        return config.build_executor().build_sections(results, run.path)


class StudyExecutor(ABC, Generic[StudyConfig]):
    """Work of a study: its results, and what summary and report say about them.

    Args:
        config: settings of the study.
    """

    def __init__(self, config: StudyConfig) -> None:
        self.config = config

    @abstractmethod
    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        """Compute the results for the JSON file of the study, and the figures.

        Args:
            folder: the run folder, for further files.
        """

    @abstractmethod
    def summarize(self, results: StudyResults) -> list[str]:
        """Return complete sentences on the main results, for the head of the report."""

    @abstractmethod
    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        """Return the main figures of the study by name, for summary.json."""

    @abstractmethod
    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        """Return the sections of the report from the results and the figures in the run folder."""

    def export_writers(self, folder: RunFolder) -> ExportWriters:
        """Return functions that write each model for controllers; none by default."""
        return {}


def published_cell(value: float | None, published: float | None, digits: int = 4) -> Cell:
    """Return a table cell with a computed number and, in small print, the published one.

    Args:
        value: computed number; None if unavailable.
        published: published number; None if the document has none.
    """
    # not `format_number`: the published number keeps the digits of the document
    note = "" if published is None else f"published {format_minus_signs(f'{published:.{digits}g}')}"
    return Cell(format_number(value, digits), note)


def comparison_columns(
    key: str, titles: str | Sequence[str], digits: int = 4, factor: float = 1.0
) -> list[Column[Any]]:
    """Return table columns with computed and published numbers.

    Args:
        key: key of the number or numbers in a row, and in the row's `published` entry.
        titles: title of each column.
        factor: factor from SI to the unit of the table, in which the document prints its numbers.
    """

    def make_cell(pick: Callable[[Any], float]) -> Callable[[Any], Cell]:
        def cell(row: Any) -> Cell:
            values = row[key]
            published_values = row["published"].get(key)
            return published_cell(
                None if values is None else factor * pick(values),
                None if published_values is None else pick(published_values),
                digits,
            )

        return cell

    if isinstance(titles, str):
        return [(titles, make_cell(lambda number: number))]
    return [
        (title, make_cell(lambda numbers, i=i: numbers[i]))  # type: ignore[misc]
        for i, title in enumerate(titles)
    ]


def join_numbers(values: Sequence[float], digits: int = 3) -> str:
    """Return several numbers as text, with slashes between them."""
    return " / ".join(format_number(value, digits) for value in values)


def format_notes(notes: Mapping[str, Any]) -> str:
    """Return the choices of an estimator in one line, for example "penalty 0.1; order 3/3/1"."""

    def format_value(value: Any) -> str:
        if isinstance(value, dict):
            return ", ".join(f"{key} {format_value(item)}" for key, item in value.items())
        if isinstance(value, list):
            return "/".join(format_value(item) for item in value)
        return format_number(value, 4) if isinstance(value, float) else str(value)

    return "; ".join(f"{key} {format_value(value)}" for key, value in notes.items())


def find_figures(run: Path, *prefixes: str) -> list[Figure]:
    """Return the figures of a run by prefixes of their names.

    Figures are sorted by prefix, then by name.
    """
    stored = read_figures(run / "figures")
    return [figure for prefix in prefixes for figure in stored if figure.name.startswith(prefix)]


def plot_time_series(
    name: str,
    title_and_caption: tuple[str, str],
    styles: Mapping[str, GlyphStyle],
    t: np.ndarray,
    paths: Mapping[str, np.ndarray],
    units: Sequence[tuple[str, float]],
    *,
    height: int = 165,
    x_label: str = "time [s]",
    shared_traces: Mapping[str, Curve] | None = None,
) -> Figure:
    """Return a figure with one panel per column, below each other, with all paths over time.

    Args:
        name: name of the figure.
        title_and_caption: title and caption of the figure.
        styles: styles of the paths and shared traces by name.
        t: time [T].
        paths: columns [T, n] by name.
        units: label of each column with its unit, and the factor to that unit.
        height: height of a panel in pixels.
        x_label: label of the time axis.
        shared_traces: curves by name that are drawn in all panels.
    """
    panel_traces = [
        dict(shared_traces or {}) | {key: (t, factor * path[:, i]) for key, path in paths.items()}
        for i, (_, factor) in enumerate(units)
    ]
    panels = [Panel(label, x_label, height=height, group="t") for label, _ in units]
    return Figure(name, *title_and_caption, styles, panels, [Case("", panel_traces)])
