"""The report of a fit, and of its evaluation on other logs: its figures and its sections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from residnet.judge.soundness import read_findings
from residnet.report.blocks import Section
from residnet.report.figure import Figure, figures_section, read_figures, write_figures
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections import data, free_runs, manoeuvres, models, runs, verdict

_INTERACTIVE = "free_runs|horizon|residuals"
"""Names of the figures that stand before the numbers."""


def _sections(run: RunFiles) -> list[Callable[[RunFiles], Section | None]]:
    """Return what gives each section of the page, in their order; None is left out.

    A section is added here, and its figures below.
    """
    findings = read_findings(run.path)
    return [
        partial(verdict.cautions, findings=findings),
        verdict.figures_of_lead,
        _looked_into,
        free_runs.limits,
        data.fitted_on_what,
        data.doctor,
        models.models,
        manoeuvres.booklet,
        free_runs.bands,
        models.goodness,
        free_runs.errors,
        _other_figures,
        partial(verdict.sanity, findings=findings),
    ]


def _figures(run: RunFiles) -> Iterator[Figure | None]:
    windows = run.windows(run.focus)
    yield runs.free_runs(run, windows)
    yield runs.horizon(run, windows)
    yield runs.residuals(run)
    yield runs.error_bars(run)
    yield runs.bands(run, windows)
    yield from manoeuvres.booklet_figures(run)
    yield from models.terms(run)
    yield from models.breeding(run)
    yield models.learning(run)


def write_fit_figures(run: RunFiles) -> list[Figure]:
    """Write the figures of a fit or an evaluation; what the folder has no data for is left out.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    return write_figures(run.path / "figures", (one for one in _figures(run) if one is not None))


def write_fit_report(path: Path) -> Path:
    """Write figures and `report.html` of a fit or an evaluation from its folder alone.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    run = RunFiles(path)
    write_fit_figures(run)
    return write_fit_page(run)


def write_fit_page(run: RunFiles) -> Path:
    """Write `report.html` of a fit or an evaluation with the figures that stand in its folder.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    title = str(run.metrics.get("run") or run.path.name)
    return write_page(run.path, title, run.description, verdict.verdict(run), fit_sections(run))


def fit_sections(run: RunFiles) -> list[Section]:
    """Return the sections of the page of a fit, with the figures that stand in its folder.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    found = [section(run) for section in _sections(run)]
    return [section for section in found if section is not None]


def _looked_into(run: RunFiles) -> Section | None:
    found = read_figures(run.path / "figures", _INTERACTIVE)
    return Section("Runs to look into", found) if found else None


def _other_figures(run: RunFiles) -> Section | None:
    return next(iter(figures_section(run.path / "figures", f"(?!({_INTERACTIVE})$).*")), None)
