"""`residnet report`, and the report at the end of a fit."""

from __future__ import annotations

from pathlib import Path

from residnet.report.autopilot import FLIGHTS, write_autopilot_report
from residnet.report.course import TRACKS, write_course_report
from residnet.report.fit import write_fit_report
from residnet.runs.folder import RunFolder


def report_run(path: Path) -> Path:
    """Write figures and report of a finished run from its folder alone; returns the report's path.

    Raises:
        UsageError: where there is no finished run.
    """
    folder = RunFolder.open(path)
    if (folder.path / FLIGHTS).is_file():
        return write_autopilot_report(folder.path)
    if (folder.path / TRACKS).is_file():
        return write_course_report(folder.path)
    return write_fit_report(folder.path)
