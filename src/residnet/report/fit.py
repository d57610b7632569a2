"""The report of a fit, and of its evaluation on other logs: its figures and its sections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from residnet.judge.soundness import read_findings
from residnet.report.blocks import Section
from residnet.report.figure import Figure
from residnet.report.figure_files import read_figures, write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections import data, free_runs, manoeuvres, models, runs, verdict


def _sections(run: RunFiles) -> Iterator[Section | None]:
    """Yield the sections of the page in their order; None is left out.

    A section is added here, and its figures below. What most readers look for stands open.
    """
    folder, findings = run.path / "figures", read_findings(run.path)
    yield verdict.opening(run, read_figures(folder, "track"))
    yield verdict.cautions(run, findings)
    yield _figures_as("Error against horizon", folder, "horizon")
    yield free_runs.worst(run, read_figures(folder, "free_runs"))
    yield data.doctor(run)
    yield manoeuvres.booklet(run)
    for found in (
        free_runs.errors(run),
        free_runs.limits(run),
        data.fitted_on_what(run),
        models.models(run),
        free_runs.bands(run),
        models.goodness(run),
        _figures_as("Figures", folder, "(?!(track|horizon|free_runs)$).*"),
        verdict.sanity(run, findings),
    ):
        yield found and replace(found, folded=True)


def _figures_as(title: str, folder: Path, names: str) -> Section | None:
    found = read_figures(folder, names)
    return Section(title, found) if found else None


def _figures(run: RunFiles) -> Iterator[Figure | None]:
    windows = run.windows(run.focus)
    yield runs.track(run, windows)
    yield runs.free_runs(run, windows)
    yield runs.horizon(run, windows)
    yield runs.residuals(run)
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


def fit_sections(run: RunFiles) -> list[Section]:
    """Return the sections of the page of a fit, with the figures that stand in its folder.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    return [section for section in _sections(run) if section is not None]
