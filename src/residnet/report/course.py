"""The report of a course run."""

from __future__ import annotations

from pathlib import Path

from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections.course import COURSES, SPREAD, TRACKS, draw, sections

__all__ = ["COURSES", "SPREAD", "TRACKS", "write_course_report"]


def write_course_report(path: Path) -> Path:
    """Write figures and `report.html` of a course run; returns the path of the page."""
    run = RunFiles(path)
    draw(run)
    return write_page(path, run.title, run.description, [], sections(run))
