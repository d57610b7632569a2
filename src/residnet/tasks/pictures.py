"""The figures that a run left, as a section of its report."""

from __future__ import annotations

from residnet.report.blocks import Figure, Section
from residnet.report.figures.fit import read_figures
from residnet.runs.folder import RunFolder


def figures_section(run: RunFolder) -> Section:
    """Return a section with all figures of a run folder."""
    figures = [
        Figure(figure.path, figure.title, figure.caption) for figure in read_figures(run.path)
    ]
    return Section("Figures", figures)
