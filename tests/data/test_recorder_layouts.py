"""Tables as recorders write them: lines above the names, units beneath, pulses, odd ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from drafted_logs import drafted
from scipy.spatial.transform import Rotation

import residnet
from residnet.core.config import validate
from residnet.core.errors import DataError
from residnet.core.layout import SIX, Live
from residnet.core.log import Log
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.tables import draft_tables
from residnet.data.readers import ReaderConfig
from residnet.data.split import stretch_of
from residnet.tasks.drafting import driving

T = np.arange(0.0, 60.0, 0.2)
PSI = 0.4 * np.sin(0.2 * T)
NORTH, EAST = np.cumsum(0.4 * np.cos(PSI)), np.cumsum(0.4 * np.sin(PSI))
RUDDER = np.radians(20.0) * np.sign(np.cos(0.2 * T))
COLUMNS = {
    "Zeit": T,
    "Nord": NORTH,
    "Ost": EAST,
    "Kurs": np.degrees(PSI) % 360.0,
    "Ruder": np.degrees(RUDDER),
    "Drehzahl": 600.0 + T,
}
UNITS = ("s", "m", "m", "°", "°", "1/min")


def text(columns: dict[str, Any], delimiter: str = ";", units: tuple[str, ...] = ()) -> list[str]:
    """The lines of a table, with decimal points."""
    lines = [delimiter.join(columns)]
    lines += [delimiter.join(units)] if units else []
    rows = zip(*columns.values(), strict=True)
    return lines + [delimiter.join(f"{cell:.6f}" for cell in row) for row in rows]


def same(log: Log) -> bool:
    """Whether a log holds what was written."""
    wanted = {"x": NORTH, "psi": PSI, "delta": RUDDER, "n": (600.0 + T) / 60.0}
    return all(np.allclose(log[name], values, atol=1e-5) for name, values in wanted.items())


@pytest.mark.parametrize("delimiter", [";", "\t", "|", ","])
@pytest.mark.parametrize(
    "above",
    [
        [],
        ["# recorder 4.2, vessel No. 7", "# started 2025-06-17"],
        ["Data logger XY-7", "Serial: 12345", ""],
        ['"Sea trial";"17.06.2025"'],
    ],
)
def test_lines_above_the_names_and_units_beneath(
    above: list[str], delimiter: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\n".join([*above, *text(COLUMNS, delimiter, UNITS)]) + "\n")
    log, content, marks = drafted(path)
    assert same(log)
    assert content["time"]["unit"] == "s"
    assert content["channels"]["n"]["column"] == "Drehzahl"
    assert not [text for _, text in marks.guesses if "no unit" in text]


def test_an_empty_cell_at_the_end_of_lines(tmp_path: Path) -> None:
    names, *rows = text(COLUMNS, ";", UNITS)
    for lines in (
        [names, *(row + ";" for row in rows)],
        [names + ";;", *rows],
        [names + ";", *(row + ";" for row in rows)],
    ):
        path = tmp_path / "log.csv"
        path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8-sig")
        assert same(drafted(path)[0])


def test_a_line_is_called_by_its_number_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    lines = ["recorder", "", *text(COLUMNS, ";", UNITS)]
    path.write_text("\n".join(lines) + "\n")
    _, content, _ = drafted(path)
    cells = lines[30].split(";")
    lines[30] = ";".join([*cells[:3], "bad", *cells[4:]])
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"line 31, column 'Kurs': 'bad'"):
        validate(content, ReaderConfig, "here").build().read(path)
    lines[30] = ";".join(cells[:3])
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match="line 31 has 3 cells, the header 6"):
        validate(content, ReaderConfig, "here").build().read(path)


def test_a_sheet_with_a_title_and_units(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    rows: list[list[Any]] = [["Sea trial", *[None] * 5], [None] * 6, list(COLUMNS), list(UNITS)]
    rows += [list(row) for row in zip(*COLUMNS.values(), strict=True)]
    path = tmp_path / "log.xlsx"
    pd.DataFrame(rows).to_excel(path, index=False, header=False)
    assert same(drafted(path)[0])


@pytest.mark.parametrize(
    ("column", "values", "factor"),
    [
        ("Ruder [us]", 1500.0 + 400.0 * np.sign(RUDDER), 28.0 / 20.0),
        ("Ruder", 1500.0 + 400.0 * np.sign(RUDDER), 28.0 / 20.0),
        ("Ruder [%]", 50.0 * np.sign(RUDDER), 17.5 / 20.0),
        ("Ruder", 100.0 * np.sign(RUDDER), 35.0 / 20.0),
        ("Ruder", np.sign(RUDDER), 35.0 / 20.0),
    ],
)
def test_a_rudder_that_is_no_angle_becomes_one_by_a_guess(
    column: str, values: np.ndarray, factor: float, tmp_path: Path
) -> None:
    """Hard over is taken as 35 deg, and said to be."""
    columns = {name: cells for name, cells in COLUMNS.items() if name != "Ruder"}
    path = tmp_path / "log.csv"
    path.write_text("\n".join(text(columns | {column: values})) + "\n")
    log, _, marks = drafted(path)
    np.testing.assert_allclose(log["delta"], factor * RUDDER, atol=1e-6)
    told = [text for key, text in marks.guesses if key[-1] == "delta"]
    assert any("35 deg" in text for text in told)


def test_revolutions_in_per_cent_are_a_throttle(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    columns = {name: cells for name, cells in COLUMNS.items() if name != "Drehzahl"}
    path.write_text("\n".join(text(columns | {"Motor [%]": 60.0 + 0.1 * T})) + "\n")
    log, content, _ = drafted(path)
    assert content["channels"]["throttle"]["unit"] == "%"
    np.testing.assert_allclose(log["throttle"], 0.6 + 0.001 * T, atol=1e-6)


def test_days_as_excel_counts_them(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    days = 45825.5 + T / 86400.0
    rows = zip(days, NORTH, EAST, np.degrees(PSI), np.degrees(RUDDER), strict=True)
    lines = ["time,north [m],east [m],heading [deg],rudder [deg]"]
    lines += [",".join(f"{cell:.10f}" for cell in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    log, content, _ = drafted(path)
    assert content["time"]["unit"] == "day"
    np.testing.assert_allclose(log.t - log.t[0], T, atol=1e-3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"1,2,3\n4,5,6\n7,8,9\n", "no line holds names of columns"),
        (b"\xff\xfea\x00\x00\xd8;\x00b\x00\n\x001\x00", "not UTF-16 text"),
        (b"name,vessel\na,b\nc,d\n", "names of columns|hold numbers"),
        (
            b"time,speed,Latitude,Longitude\n0,1,54 68.1N,10 2.3E\n1,2,54 18.2N,10 2.4E\n",
            "54 68.1N.*forms that are read",
        ),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said) as refused:
        draft_tables([path], Marks())
    assert "\n" not in str(refused.value)


def test_a_second_compass_is_no_input() -> None:
    t = np.arange(0.0, 30.0, 0.1)
    names = ("x", "y", "psi", "u", "v", "r", "delta", "backup_compass_heading", "bucket")
    units = dict.fromkeys(names, "-") | {"delta": "rad"}
    channels = {name: np.sin((1.0 + i) * t) for i, name in enumerate(names)}
    marks = Marks()
    inputs = driving([Log("log", t, channels, units)], marks)
    assert inputs == ("delta", "bucket")
    assert any("backup_compass" in text for _, text in marks.notes)
    assert any(text.startswith("bucket is taken") for _, text in marks.guesses)


def test_times_of_unix_keep_their_digits(tmp_path: Path) -> None:
    log = Log("log", 1.75e9 + T, {"x": NORTH}, {"x": "m"})
    first = stretch_of(log, -np.inf, 1.75e9 + 20.0)
    second = stretch_of(log, 1.75e9 + 20.0, np.inf)
    assert first.name != second.name
    assert len(first) + len(second) == len(log)
    path = tmp_path / "log.csv"
    lines = text({"No.": np.arange(T.size), **COLUMNS, "Zeit": np.floor(T)}, ";")
    path.write_text("\n".join(lines) + "\n")
    read, content, _ = drafted(path)
    assert content["time"]["column"] == "Zeit", "a counter is no time"
    np.testing.assert_allclose(read.t - read.t[0], T, atol=1e-9)
    assert "coarse_stamps" in [found["code"] for found in read.meta["findings"]]


@pytest.mark.parametrize("ending", ["", "\n"])
@pytest.mark.parametrize("sign", ["#", "%", "//", "  #"])
def test_comments_among_the_values(sign: str, ending: str, tmp_path: Path) -> None:
    """A recorder says at the end how many rows it wrote; somebody notes what happened."""
    lines = text(COLUMNS)
    note = f"{sign} wind rises, sea 2; 300 rows, by JS"
    path, plain = tmp_path / "log.csv", tmp_path / "plain.csv"
    plain.write_text("\n".join(lines) + "\n")
    path.write_text("\n".join([*lines[:100], note, *lines[100:], note]) + ending)
    log, _, _ = drafted(path)
    truth, _, _ = drafted(plain)
    np.testing.assert_array_equal(log.t, truth.t)
    for name, values in truth.channels.items():
        np.testing.assert_array_equal(log[name], values)


def test_a_name_that_stands_twice(tmp_path: Path) -> None:
    """The first is taken, and said to be; either can be told by its number."""
    path = tmp_path / "log.csv"
    rows = zip(T, NORTH, EAST, np.degrees(PSI), np.degrees(PSI) + 2.0, strict=True)
    lines = ["t [s],north [m],east [m],heading [deg],heading [deg]"]
    path.write_text("\n".join([*lines, *(",".join(map(str, row)) for row in rows)]) + "\n")
    log, content, marks = drafted(path)
    np.testing.assert_allclose(log["psi"], PSI, atol=1e-9)
    assert any("more than once" in said for _, said in marks.guesses)
    entry = content["channels"]["psi"]
    assert entry["column"] == "heading [deg].0"
    entry["column"] = "heading [deg].1"
    other = validate(content, ReaderConfig, "here").build().read(path)
    np.testing.assert_allclose(other["psi"] - log["psi"], np.radians(2.0), atol=1e-9)


def test_odometry_of_ros_under_water(tmp_path: Path) -> None:
    helix = {"kind": "helix", "drive": 0.6, "steer": 0.4, "dive": 0.4}
    log = next(iter(residnet.simulate("remus_100", [helix], duration=60.0, step=0.1, seed=2).logs))
    down = Rotation.from_euler("ZYX", np.stack([log[n] for n in ("psi", "theta", "phi")], axis=1))
    east = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    up = Rotation.from_matrix(east @ down.as_matrix() @ np.diag([1.0, -1.0, -1.0])).as_quat()
    columns = {"time": log.t}
    columns |= dict(zip((f"pose.pose.orientation.{axis}" for axis in "xyzw"), up.T, strict=True))
    for axis, values in zip("xyz", (log["y"], log["x"], -log["z"]), strict=True):
        columns[f"pose.pose.position.{axis}"] = values
    for name, sign in (("u", 1), ("v", -1), ("w", -1), ("p", 1), ("q", -1), ("r", -1)):
        kind, names = ("linear", "uvw") if name in "uvw" else ("angular", "pqr")
        axis = "xyz"[names.index(name)]
        columns[f"twist.twist.{kind}.{axis}"] = sign * log[name]
    (tmp_path / "dive").mkdir()
    pd.DataFrame(columns).to_csv(tmp_path / "dive" / "odom.csv", index=False)
    inputs = {name: log[name] for name in log.channels if name not in (*SIX.names, "t")}
    for name, values in inputs.items():
        table = pd.DataFrame({"time": log.t, "data": values})
        table.to_csv(tmp_path / "dive" / f"{name}.csv", index=False)
    (read,) = residnet.read_logs(tmp_path / "dive")
    assert Live.told(read.channels).spatial
    for name in ("z", "phi", "theta", "u", "v", "w", "p", "q", "r"):
        at = np.interp(read.t, log.t - log.t[0], log[name])
        np.testing.assert_allclose(read[name], at, atol=1e-3, err_msg=name)
    # of a vessel on the surface nobody asks for its pitch
    columns["pose.pose.position.z"] = 0.01 * np.sin(log.t)
    pd.DataFrame(columns).to_csv(tmp_path / "dive" / "odom.csv", index=False)
    (read,) = residnet.read_logs(tmp_path / "dive")
    assert not {"z", "theta", "w", "q"} & {*read.channels}
