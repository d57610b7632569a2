"""Every task's page: its sections render from a made-up folder and show the numbers in it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from browser import browser, layout
from made_run import made_run, write_fit_page
from made_task_runs import (
    made_actuators,
    made_autopilot,
    made_course,
    made_import,
    made_simulate,
    made_study,
)
from read_page import Page, plain

from residnet.judge.verdict import LEVELS
from residnet.report.blocks import Section
from residnet.report.fit import fit_sections, write_fit_figures
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections import autopilot, course, manoeuvres
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.actuators import ActuatorsTaskConfig
from residnet.tasks.import_logs import ImportConfig
from residnet.tasks.study import StudyConfig

needs_browser = pytest.mark.skipif(browser() is None, reason="no browser is installed")


@dataclass(frozen=True)
class Reported:
    """A task's made-up folder, and its sections."""

    make: Callable[[Path], Path]
    sections: Callable[[RunFiles], Sequence[Section]]


def page(task: type[Task]) -> Callable[[RunFiles], Sequence[Section]]:
    return lambda run: task.report_sections(RunFolder(run.path))


TASKS = {
    "actuators": Reported(made_actuators, page(ActuatorsTaskConfig)),
    "autopilot": Reported(made_autopilot, autopilot.sections),
    "course": Reported(made_course, course.sections),
    "fit": Reported(made_run, fit_sections),
    "import": Reported(made_import, page(ImportConfig)),
    "simulate": Reported(made_simulate, manoeuvres.sections),
    "study": Reported(made_study, page(StudyConfig)),
}


@pytest.fixture(scope="module")
def page_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Writes the page of a made-up run of a task, once."""

    def written(task: str) -> Path:
        reported = TASKS[task]
        run = RunFiles(reported.make(tmp_path_factory.mktemp(task) / "run"))
        return write_page(run.path, run.title, "Made by hand.", ["Done."], reported.sections(run))

    return cache(written)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_page_whose_sections_hold_something(
    task: str, page_of: Callable[[str], Path]
) -> None:
    path = page_of(task)
    text = plain(path)
    page = Page(text)
    assert len(page.sections) == len(set(page.sections)) >= 3
    assert page.tables
    for table in page.tables:
        assert len(table) > 1, table
    pictures = sum(source.startswith("data:image") for source in page.sources)
    assert pictures == len(list((path.parent / "figures").glob("*.png")))
    shown = re.sub(r"data:image/png;base64,[^\"]+|<script.*?</script>", "", text, flags=re.DOTALL)
    shown = shown.partition('id="provenance"')[0]
    assert re.findall(r"\b(?:None|nan|inf|Undefined)\b|[{}]{2}", shown.partition("<body>")[2]) == []
    # the page of a finished run can be written again, and is the same
    reported = TASKS[task]
    run = RunFiles(path.parent)
    write_page(path.parent, run.title, "Made by hand.", ["Done."], reported.sections(run))
    assert plain(path) == text


@pytest.mark.long
@needs_browser
@pytest.mark.parametrize("task", TASKS)
def test_nothing_is_wider_than_the_window_and_no_word_is_broken(
    task: str, page_of: Callable[[str], Path], tmp_path: Path
) -> None:
    page = page_of(task)
    for width in (360, 820):
        found = layout(page, width, tmp_path)
        assert (found.overflow, found.broken) == (0, []), width


def judged(run: Path, level: str) -> RunFiles:
    """A made-up run whose verdict has that level; a log has a clock that jumps."""
    ends = {"position": 0.4, "heading": 0.01}
    # what the end of an interval allows counts
    most = 100.0 if level == "limited" else 1.1
    spans = {of: [0.9 * x, most * x] for of, x in ends.items()}
    horizon = {
        "seconds": 30.0,
        "windows": 3 if level == "too few windows" else 12,
        **{"logs": 4, "slowest": 0.9, "fastest": 1.1, "sailed": 30.0, "floor": ends},
        "models": {"plsr": {**ends, "intervals": spans}},
    }
    path = made_run(run)
    content = {"splits": {"test": {"whole": {"horizons": [horizon]}}}}
    (path / "limits.json").write_text(json.dumps(content))
    late = {"code": "gaps", "level": "will mislead", "text": "a gap", "action": "", "effect": 0.2}
    logs = [{"name": "zigzag_01", "findings": [late]}, {"name": "zigzag_02", "findings": []}]
    (path / "doctor.json").write_text(json.dumps({"logs": logs, "together": []}))
    if level == "do not use":
        metrics = json.loads((path / "metrics.json").read_text())
        for row in metrics["rows"]:
            row["nrmse"]["mean"] *= 100.0 if row["model"] == "plsr" else 1.0
        (path / "metrics.json").write_text(json.dumps(metrics))
    found = RunFiles(path)
    write_fit_figures(found)
    return found


@needs_browser
@pytest.mark.parametrize(
    "level", [pytest.param(one, marks=[] if one == "good" else pytest.mark.long) for one in LEVELS]
)
def test_five_questions_are_answered_by_the_first_screen_alone(level: str, tmp_path: Path) -> None:
    page = write_fit_page(judged(tmp_path / "run", level))
    for width, height in ((1400, 900), (390, 844)):
        first = layout(page, width, tmp_path).first
        assert first["pictures"]
        assert max(first["verdict"], *first["pictures"]) < height
        # what is selected, the baseline, and zero
        assert first["rows"][2] < height
        assert first["words"] < 6_000
        told = first["told"]
        seen = " | ".join(" ".join(text.split()) for text, end in told if end < height)
        # how far off after 30 s, better than doing nothing, and which model
        assert "error after 30 s" in seen
        assert "plsr (selected) | 0.40 | 0.57" in seen
        assert "zero | 12 | 12" in seen
        # may I use it, and what is wrong with the data
        assert LEVELS[level] in seen
        assert "1 of 2 logs hold something that would mislead a fit: gaps (1)." in seen


@pytest.mark.long
@needs_browser
def test_the_browser_sees_what_is_too_wide_and_what_is_broken(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(
        "<!DOCTYPE html><html><body><div style='width:900px'>wide</div>"
        "<p style='width:3em;overflow-wrap:anywhere'>tacticaldiameter</p></body></html>"
    )
    found = layout(page, 360, tmp_path)
    assert found.overflow > 400
    assert found.broken == ["tacticaldiameter"]


def test_controllers_are_compared_by_settling_time_and_effort(
    page_of: Callable[[str], Path],
) -> None:
    page = Page(plain(page_of("autopilot")))
    # the first screen has a picture and the first columns
    assert page.tables[0][1] == ["net", "15.00", "1.000", "15.00"]
    cells = {line[0]: line[1:] for line in page.tables[1]}
    assert cells["pd"] == [
        "16.50",
        "1.100",
        "16.50",
        "11.00",
        "13.20",
        "0.300",
        "0.2500",
        "0.2500",
        "4",
    ]
    effort = next(table for table in page.tables if "sea, root mean square [deg]" in table[0])
    assert (
        effort[2] == ["net", "57.30", "68.75", "28.65", "34.38", "328.28", "393.94"] + ["2.000"] * 3
    )


def test_a_course_shows_what_was_missed(page_of: Callable[[str], Path]) -> None:
    text = plain(page_of("course"))
    page = Page(text)
    glance, entered, spread, sides, _ = page.tables
    assert glance[1] == ["net", "course", "61.50", "2 of 2", "1.0250"]
    assert entered[1][:6] == ["net", "course", "61.50", "2 of 2", "1.0250", "0.9500"]
    assert sides[1][3:5] == ["2 of 2", "1 of 2"]
    assert spread[1][2:5] == ["75.0", "100.0", "1.0400"]
    assert 'class="bad">1 of 2' in text
    assert "The circles of buoy 1 (20.00 m) are tighter than that" in text
    assert "The reference takes 60.00 s." in text


def test_indices_stand_flight_by_flight_or_by_kind(
    page_of: Callable[[str], Path], tmp_path: Path
) -> None:
    few = Page(plain(page_of("simulate")))
    # what did not end as it should comes first
    assert few.tables[0][1] == ["constant_01", "ship", "timed out after 60 s", "–"]
    assert few.tables[0][2] == ["zigzag_01", "ship", "first overshoot", "9.000 deg"]
    assert few.tables[1] == [
        ["index", "unit", "ship", "model", "difference", "ship [L]", "model [L]", "IMO limit"],
        ["first overshoot", "deg", "9.000", "11.00", "2.000", "", "", "10.00|exceeded"],
        ["initial turning distance", "m", "8.000", "8.000", "0", "2.00", "2.00", ""],
    ]
    run = RunFiles(made_simulate(tmp_path / "many", logs=13))
    text = plain(write_page(run.path, "many", "", [], manoeuvres.sections(run)))
    flights, table = Page(text).tables
    assert len(flights) == 1 + 12
    assert table[0] == ["log", "first overshoot [deg]", "initial turning distance [m]"]
    assert len(table) == 1 + 2 * 13
    assert table[2] == ["zigzag_01 (model)", "11.00|beyond the IMO limit", "8.000"]
    assert "Flights without indices: constant." in text


def test_currents_of_logs_stand_with_their_errors(tmp_path: Path) -> None:
    run = made_run(tmp_path)
    rows = [
        {"log": name, "fitted": fitted, "current_north": 0.31, "current_east": -0.1,
         "standard_error": [0.02, 0.015]}
        for name, fitted in (("zigzag_01", True), ("zigzag_02", False))
    ]  # fmt: skip
    (run / "currents.json").write_text(json.dumps(rows))
    write_fit_page(RunFiles(run))
    text = plain(run / "report.html")
    assert "0.31 ± 0.020" in text
    assert "of other logs" in text


def test_an_import_shows_gaps_channels_and_findings(page_of: Callable[[str], Path]) -> None:
    text = plain(page_of("import"))
    page = Page(text)
    cells = page.table("log", "first")
    assert cells["first"] == ["100", "0.1000", "9.900", "2", "9", "1", "1"]
    assert cells["second"][-2:] == ["0", "1"]
    channels = page.table("channel", "u")
    assert channels["u"] == ["m/s", "1.00", "1.00", "1.00", "50"]
    assert channels["psi"][0] == "deg"
    assert "first: will mislead: a gap of −5 s" in text


def test_actuator_parameters_come_with_intervals(page_of: Callable[[str], Path]) -> None:
    cells = Page(plain(page_of("actuators"))).table("parameter", "largest revolutions")
    assert cells["largest revolutions"] == ["2400 rpm", "2160 to 2640"]
    assert cells["dead time"] == ["0.2500 s", "0.2250 to 0.2750"]
    assert cells["forward thrust, c0"][0].endswith(" N s²")
    assert cells["reverse thrust, rms residual"] == ["1.50 N", "–"]


def test_variants_are_compared_with_the_reference(page_of: Callable[[str], Path]) -> None:
    page = Page(plain(page_of("study")))
    cells = page.table("variant", "no_head")
    assert cells["no_head"][:4] == ["0.2500", "0.0100", "+0.0500", "+0.0250 to +0.0750"]
    assert cells["recipe"][2:4] == ["", ""]
    assert cells["no_head"][-1] == "~heads"
