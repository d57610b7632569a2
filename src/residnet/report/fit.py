"""The report of a fit, and of its evaluation on other logs."""

from __future__ import annotations

from pathlib import Path

from residnet.judge.verdict.sanity_file import read_findings
from residnet.report.blocks import Section
from residnet.report.figures.files import figures_section
from residnet.report.figures.fit import write_figures
from residnet.report.interactive.free_runs import explorers
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections.fit import (
    bands,
    booklet,
    coefficients,
    data,
    doctor,
    equations,
    free_runs,
    goodness,
    limits,
    models,
    sanity,
)
from residnet.report.sections.fit.verdict import caution_section, verdict
from residnet.report.sections.fit.verdict import figures_section as selected_section

_DIVERGENCE = 3.0
"""Times the training envelope beyond which a run has diverged, where the config gives none."""


def write_fit_report(path: Path) -> Path:
    """Write figures and `report.html` of a fit or an evaluation from its folder alone.

    Parts that the folder holds nothing of are left out.

    Args:
        path: folder with metrics.json.

    Returns:
        Path of the page.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    run = RunFiles(path)
    write_figures(run)
    return write_fit_page(run)


def write_fit_page(run: RunFiles) -> Path:
    """Write `report.html` of a fit or an evaluation with the figures that stand in its folder.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    title = str(run.metrics.get("run") or run.path.name)
    return write_page(run.path, title, run.description, verdict(run), fit_sections(run))


def fit_sections(run: RunFiles) -> list[Section]:
    """Return the sections of the page of a fit, with the figures that stand in its folder.

    Raises:
        UsageError: where the folder holds no metrics.json.
        DataError: where a file in it cannot be read.
    """
    divergence = float(run.evaluation.get("divergence") or _DIVERGENCE)
    findings = read_findings(run.path, divergence=divergence)
    found = [
        caution_section(run, findings),
        selected_section(run),
        _interactive(run),
        limits.section(run),
        data.section(run),
        doctor.section(run),
        _models(run),
        booklet.section(run),
        bands.section(run),
        goodness.section(run),
        free_runs.section(run),
        figures_section(run.path / "figures", "tracks|history_.*|horizon_.*|residuals.*"),
        sanity.section(run, findings),
    ]
    return [section for section in found if section is not None]


def _interactive(run: RunFiles) -> Section | None:
    """Return the section of interactive figures, None where there are no free runs."""
    found = explorers(run)
    return Section("Runs to look into", found) if found else None


def _models(run: RunFiles) -> Section | None:
    """Return the section on what was identified and learned."""
    parts = [coefficients.section(run), models.section(run), *equations.sections(run)]
    there = [part for part in parts if part is not None]
    return Section("Models", there) if there else None
