"""The report of an autopilot run."""

from __future__ import annotations

from pathlib import Path

from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections.autopilot import FLIGHTS, PLANTS, draw, sections

__all__ = ["FLIGHTS", "PLANTS", "write_autopilot_report"]


def write_autopilot_report(path: Path) -> Path:
    """Write figures and `report.html` of an autopilot run; returns the path of the page."""
    run = RunFiles(path)
    draw(run)
    return write_page(path, run.title, run.description, [], sections(run))
