"""The report of a fit, and of its evaluation on other logs: its figures and its sections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from residnet.report.blocks import Section
from residnet.report.figure import Figure
from residnet.report.figure_files import read_figures, write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections import (
    at_a_glance,
    data,
    derivatives,
    free_runs,
    manoeuvres,
    models,
    runs,
    verdict,
)


def _iterate_fit_sections(run: RunFiles) -> Iterator[Section | None]:
    """Yield the sections of the page in order; None entries are skipped.

    Add a section here and its figures in `write_fit_figures`. Sections that most readers need are
    not collapsed.
    """
    folder = run.path / "figures"
    yield at_a_glance.facts_section(run)
    yield verdict.opening_section(run, read_figures(folder, "track"))
    yield verdict.cautions_section(run)
    yield _figures_section("Error against horizon", folder, "horizon")
    yield free_runs.worst_runs_section(run, read_figures(folder, "free_runs"))
    yield data.quality_section(run)
    yield manoeuvres.booklet_section(run)
    yield derivatives.derivatives_section(run)
    for folded_section in (
        # before tables and lists, since print shows what is folded too
        _figures_section("Figures", folder, "(?!(track|horizon|free_runs)$).*"),
        free_runs.errors_section(run),
        free_runs.limits_section(run),
        data.fit_data_section(run),
        models.models_section(run),
        free_runs.bands_section(run),
        models.goodness_section(run),
        verdict.sanity_section(run),
    ):
        yield folded_section and replace(folded_section, is_folded=True)


def _figures_section(title: str, folder: Path, names: str) -> Section | None:
    figures = read_figures(folder, names)
    return Section(title, figures) if figures else None


def _iterate_fit_figures(run: RunFiles) -> Iterator[Figure | None]:
    windows = run.read_split_windows(run.report_split)
    yield runs.track_figure(run, windows)
    yield runs.free_run_figure(run, windows)
    yield runs.horizon_figure(run, windows)
    yield runs.residual_figure(run)
    yield runs.band_figure(run, windows)
    yield from manoeuvres.booklet_figures(run)
    yield from models.term_figures(run)
    yield from models.evolution_figures(run)
    yield models.learning_figure(run)


def write_fit_figures(run: RunFiles) -> list[Figure]:
    """Write the figures of a fit or an evaluation for which the folder holds data.

    Raises:
        UsageError: if the folder holds no metrics.json.
    """
    return write_figures(
        run.path / "figures", (figure for figure in _iterate_fit_figures(run) if figure is not None)
    )


def fit_sections(run: RunFiles) -> list[Section]:
    """Return the sections of the page of a fit with the figures in its folder.

    Raises:
        UsageError: if the folder holds no metrics.json.
        DataError: if a file in it cannot be read.
    """
    return [section for section in _iterate_fit_sections(run) if section is not None]
