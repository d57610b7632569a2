"""Workbooks with several tests, angles without units, and vessels that dive by heave."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest

import residnet
from residnet.core.errors import ResidnetError
from residnet.core.layout import SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers.several_tests import list_tests
from residnet.io.sources import MeasuredLogs, list_input_files, read_split_logs
from residnet.io.split import SplitConfig
from residnet.tasks.drafting import write_new_config
from residnet.tasks.registry import load_task

TRUTH = pd.read_csv(Path(__file__).parents[1] / "corpus" / "truth_1.csv")


def make_test(first: int = 0, n_rows: int = 300) -> pd.DataFrame:
    """Return the table of a test of a model basin."""
    rows = TRUTH.iloc[first : first + n_rows]
    return pd.DataFrame(
        {
            "Time [s]": rows.t - rows.t.iloc[0],
            "X [m]": rows.x,
            "Y [m]": rows.y,
            "Heading [deg]": np.degrees(rows.psi),
            "Rudder [deg]": np.degrees(rows.delta),
            "RPM": rows.n * 60.0,
        }
    )


def read_tests(path: Path) -> dict[str, Log]:
    """Return the logs of a file by name."""
    logs = residnet.read_logs(path)
    return {log.name: log for log in logs if isinstance(log, Log)}


def assert_is_test(log: Log, first: int) -> None:
    """Compare a log with the rows of the truth from `first` on."""
    truth = TRUTH.iloc[first : first + len(log)]
    assert len(log) == 300
    for name in ("x", "y", "psi", "delta"):
        difference = (log[name] - log[name][0]) - (truth[name] - truth[name].iloc[0])
        assert np.abs(difference).max() < 1e-3, (log.name, name)


def test_a_sheet_for_each_test_is_a_log(tmp_path: Path) -> None:
    file = tmp_path / "tests.xlsx"
    with pd.ExcelWriter(file) as book:
        pd.DataFrame({"Item": ["Lpp", "B"], "m": [3.2, 0.4]}).to_excel(book, sheet_name="Model")
        make_test().to_excel(book, sheet_name="ZZ 10", index=False, startrow=2)
        make_test(400).to_excel(book, sheet_name="ZZ 20", index=False, startrow=2)
    logs = read_tests(tmp_path)
    assert [*logs] == ["ZZ_10", "ZZ_20"]
    assert {log.manoeuvre for log in logs.values()} == {"zigzag"}
    assert_is_test(logs["ZZ_20"], 400)
    assert_is_test(read_tests(file / "ZZ_20")["ZZ_20"], 400)
    with pytest.raises(ResidnetError, match=r"ZZ_30: no test of this name; did you mean 'ZZ_20'"):
        residnet.read_logs(file / "ZZ_30")


def test_two_sheets_of_each_test_are_joined_by_time(tmp_path: Path) -> None:
    file = tmp_path / "tests.xlsx"
    with pd.ExcelWriter(file) as book:
        for name, first in (("ZZ 10", 0), ("TC 35", 400)):
            table = make_test(first)
            control = table.iloc[:, [0, 4, 5]]
            table.iloc[:, :4].to_excel(book, sheet_name=f"{name} motion", index=False)
            control.to_excel(book, sheet_name=f"{name} control", index=False)
    logs = read_tests(tmp_path)
    assert [*logs] == ["ZZ_10", "TC_35"]
    assert [log.manoeuvre for log in logs.values()] == ["zigzag", "turning_circle"]
    assert_is_test(logs["TC_35"], 400)
    # sheets of different tests
    book = openpyxl.load_workbook(file)
    book["TC 35 control"].title = "TC 20 control"
    book.save(file)
    assert not list_tests(file)


def test_zeros_of_a_lost_pose_are_missing(tmp_path: Path) -> None:
    table = make_test()
    is_lost = np.zeros(len(table), dtype=bool)
    is_lost[[100, 101, 250]] = True
    is_lost[150:180] = True
    pose = ["X [m]", "Y [m]", "Heading [deg]"]
    # the vessel is at rest at the origin at first
    table[pose] -= table.loc[20, pose]
    table.loc[:20, pose] = 0.0
    table.loc[is_lost, pose] = 0.0
    table.to_csv(tmp_path / "log.csv", index=False)
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    for name in ("x", "y", "psi"):
        np.testing.assert_array_equal(np.isnan(log[name]), is_lost, err_msg=name)
    (remark,) = log.meta["findings"]
    assert remark["figures"] == {"count": 33.0}


@pytest.mark.parametrize("mark", ["title", "names", "blank", "restart", "number"])
@pytest.mark.parametrize("ending", ["xlsx", "csv", "tsv"])
def test_tests_below_each_other_are_logs(mark: str, ending: str, tmp_path: Path) -> None:
    rows: list[list[object]] = []
    for first in (0, 400):
        table = make_test(first)
        if mark == "title":
            rows.append([f"Test {first}: turning circle 35"])
        if mark == "number":
            table.insert(0, "Run", first)
        if not rows or mark in ("title", "names"):
            rows.append([*table.columns])
        elif mark == "blank":
            rows.append([])
        rows += table.round(6).to_numpy().tolist()
    file = tmp_path / f"tests.{ending}"
    if ending == "xlsx":
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append(row)
        book.save(file)
    else:
        separator = "\t" if ending == "tsv" else ","
        lines = [separator.join(map(str, row)) for row in rows]
        file.write_text("\n".join(lines) + "\n")
    logs = read_tests(file)
    names = {"title": "Test_{}_turning_circle_35", "number": "Run_{}"}.get(mark, "test_{}")
    numbers = (0, 400) if mark in ("title", "number") else (1, 2)
    if mark == "number":
        names = "Run_{}_0" if ending != "xlsx" else names
    assert [*logs] == [names.format(number) for number in numbers]
    for log, first in zip(logs.values(), (0, 400), strict=True):
        assert_is_test(log, first)
        assert mark != "title" or log.manoeuvre == "turning_circle"


def test_tests_side_by_side_are_logs(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    first = make_test()
    second = make_test(400)
    book.active.append(["Zigzag 10/10", *[None] * 6, "Zigzag 20/20"])
    book.active.append([*first.columns, None, *second.columns])
    for left, right in zip(first.to_numpy().tolist(), second.to_numpy().tolist(), strict=True):
        book.active.append([*left, None, *right])
    book.save(tmp_path / "tests.xlsx")
    logs = read_tests(tmp_path)
    assert [*logs] == ["Zigzag_10_10", "Zigzag_20_20"]
    assert_is_test(logs["Zigzag_20_20"], 400)


def test_a_table_is_one_log_where_only_its_clock_is_corrected(tmp_path: Path) -> None:
    table = make_test()
    marked = [",".join(map(str, row)) for row in table.round(6).to_numpy().tolist()]
    # a mark of the operator, the names once more, and a blank row, while time goes on
    marked[100:100] = ["# turn", ",".join(table.columns), ""]
    (tmp_path / "log.csv").write_text("\n".join([",".join(table.columns), *marked, ""]))
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    assert_is_test(log, 0)
    table["Time [s]"] -= 3.0 * (np.arange(len(table)) > 150)
    assert not list_tests(tmp_path / "log.csv")
    table.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ResidnetError, match="time runs backwards"):
        residnet.read_logs(tmp_path)


def test_short_starts_of_a_recorder_are_left_out(tmp_path: Path) -> None:
    def write(name: str, parts: list[tuple[int, int]]) -> None:
        texts = [make_test(first, n_rows).to_csv(index=False) for first, n_rows in parts]
        (tmp_path / name).write_text("".join(texts))

    write("one.csv", [(0, 3), (0, 1), (0, 1), (400, 300), (0, 3)])
    write("two.csv", [(0, 3), (0, 300), (0, 3), (400, 300)])
    logs = read_tests(tmp_path)
    assert [*logs] == ["one", "test_1", "test_2"]
    for name, first in (("one", 400), ("test_1", 0), ("test_2", 400)):
        assert_is_test(logs[name], first)
    (remark,) = logs["one"].meta["findings"]
    assert "fewer than 10 rows are left out: 4 in one.csv" in remark["text"]
    # a counter that overflows after rows with the column names is no start of a recorder
    table = make_test()
    table["Time [s]"] = (table["Time [s]"] + 2.0**32 * 1e-6 - 15.0).round(6) % (2.0**32 * 1e-6)
    lines = table.to_csv(index=False).splitlines()
    lines[150:150] = [lines[0]]
    (tmp_path / "one.csv").write_text("\n".join([*lines, ""]))
    assert not list_tests(tmp_path / "one.csv")


@pytest.mark.parametrize("has_names", [True, False])
def test_titles_of_vessels_divide_a_table(has_names: bool, tmp_path: Path) -> None:
    header = ",".join(make_test().columns)
    lines: list[str] = []
    for vessel, first, start in (("Vessel A", 0, 0.0), ("Vessel B", 400, 1000.0)):
        lines += [vessel, *([header] if has_names or not lines else [])]
        table = make_test(first)
        table["Time [s]"] += start
        lines += [",".join(map(str, row)) for row in table.round(6).to_numpy().tolist()]
    file = tmp_path / "two.csv"
    file.write_text("\n".join([*lines, ""]))
    logs = read_tests(tmp_path)
    assert [*logs] == ["Vessel_A", "Vessel_B"]
    assert_is_test(logs["Vessel_B"], 400)
    notes = DraftNotes()
    draft_tables(list_tests(file), notes)
    assert any("several vessels (Vessel A, Vessel B)" in text for _, text in notes.guessed_values)


def test_midnight_and_reverse_order_are_no_new_tests(tmp_path: Path) -> None:
    table = make_test()
    seconds = (table["Time [s]"] + 86_390.0).round(3) % 86_400.0
    table["Time [s]"] = [
        f"{int(t) // 3600:02d}:{int(t) // 60 % 60:02d}:{t % 60:06.3f}" for t in seconds
    ]
    table.to_csv(tmp_path / "night.csv", index=False)
    assert not list_tests(tmp_path / "night.csv")
    rows = make_test().iloc[::-1].round(6).to_numpy().tolist()
    lines = [",".join(table.columns), *(",".join(map(str, row)) for row in rows)]
    lines[100:100] = [""]
    (tmp_path / "newest.csv").write_text("\n".join([*lines, ""]))
    assert not list_tests(tmp_path / "newest.csv")


def test_a_config_reads_tests_and_its_provenance_has_the_file(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    with pd.ExcelWriter(logs / "book.xlsx") as book:
        for k in range(5):
            make_test(200 * k, 200).to_excel(book, sheet_name=f"Run {k}", index=False)
    write_new_config([logs / "book.xlsx"], tmp_path / "boat.yaml", None, overwrite=False)
    text = " ".join((tmp_path / "boat.yaml").read_text().replace("#", " ").split())
    assert "book.xlsx has 5 tests, a log each: Run_0, Run_1, Run_2, Run_3, Run_4" in text
    task: Any = load_task(tmp_path / "boat.yaml", [])
    assert list_input_files(task.data) == [logs / "book.xlsx"]
    logs_by_split = read_split_logs(task.data)
    assert sorted(log.name for split in logs_by_split.values() for log in split) == [
        f"Run_{k}" for k in range(5)
    ]
    reader = task.data.reader.model_copy(update={"sheet": "Run 3"})
    split = SplitConfig(root=logs, auto=("book.xlsx",))
    configured = read_split_logs(MeasuredLogs(reader=reader, split=split))
    assert {log.name.split("_")[0] for split_logs in configured.values() for log in split_logs} == {
        "book"
    }


def make_dive() -> dict[str, np.ndarray]:
    """Return the motion of a vessel that dives by heave, with noise of roll and pitch."""
    noise = np.random.default_rng(0).normal(0.0, 0.005, (2, len(TRUTH)))
    phase = TRUTH.t.to_numpy() * 2.0 * np.pi / 40.0
    motion = {name: TRUTH[name].to_numpy() for name in ("x", "y", "psi", "u", "v", "r")}
    motion |= {"phi": noise[0], "theta": noise[1]}
    return motion | {"z": 5.0 + 2.0 * np.sin(phase), "w": 0.1 * np.pi * np.cos(phase)}


def test_small_tilts_without_unit_have_the_unit_of_the_heading(tmp_path: Path) -> None:
    dive = make_dive()
    angles = {"roll": dive["phi"], "pitch": dive["theta"], "yaw": dive["psi"]}
    table = {"t": TRUTH.t, "north": dive["x"], "east": dive["y"], "rudder": TRUTH.delta}
    table |= {"u": dive["u"], "v": dive["v"], "r": dive["r"]}
    table |= {name: np.degrees(values) for name, values in angles.items()}
    pd.DataFrame(table).to_csv(tmp_path / "dive.csv", index=False)
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    assert np.allclose(log["psi"], dive["psi"], atol=1e-3)
    assert np.allclose(log["phi"], dive["phi"], atol=1e-3)


def test_a_vessel_that_dives_by_heave_is_planar_and_one_that_pitches_is_not() -> None:
    dive = make_dive()
    assert DegreesOfFreedom.from_channels(dive).is_planar
    without_tilt = {name: values for name, values in dive.items() if name not in ("phi", "theta")}
    assert DegreesOfFreedom.from_channels(without_tilt).is_planar
    slope = np.cumsum(np.full(len(TRUTH), 0.2)) * 0.05
    pitching = dive | {"theta": -0.1 * np.cos(slope), "z": 5.0 + np.cumsum(0.01 * np.cos(slope))}
    pitching |= {"u": np.full(len(TRUTH), 1.0), "w": np.zeros(len(TRUTH))}
    assert DegreesOfFreedom.from_channels(pitching).velocities == SIX_DOF_LAYOUT.velocities
