"""Tables as recorders, shells and Excel write them: lines about the names, encodings, odd ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from drafted_logs import assert_read, drafted
from scipy.spatial.transform import Rotation

import residnet
from residnet.core.config import validate_config
from residnet.core.errors import DataError
from residnet.core.layout import SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers import ReaderConfig
from residnet.io.readers.detect import AutoConfig, detect_recording_format
from residnet.io.readers.formats.topic_folder import TopicFolderConfig
from residnet.io.readers.recording import ALL_FIELDS
from residnet.io.readers.tables import read_column_names
from residnet.io.readers.text_encoding import detect_encoding
from residnet.io.split import extract_segment
from residnet.tasks.input_selection import choose_inputs

T = np.arange(0.0, 60.0, 0.2)
PSI = 0.4 * np.sin(0.2 * T)
NORTH = np.cumsum(0.4 * np.cos(PSI))
EAST = np.cumsum(0.4 * np.sin(PSI))
RUDDER = np.radians(20.0) * np.sign(np.cos(0.2 * T))
TRUTH = {"x": NORTH, "psi": PSI, "delta": RUDDER, "n": (600.0 + T) / 60.0}
COLUMNS = {
    "Zeit": T,
    "Nord": NORTH,
    "Ost": EAST,
    "Kurs": np.degrees(PSI) % 360.0,
    "Ruder": np.degrees(RUDDER),
    "Drehzahl": 600.0 + T,
}
UNITS = ("s", "m", "m", "°", "°", "1/min")
JAPANESE = ("時刻", "北", "東", "船首方位", "舵角", "プロペラ回転数")


def text(columns: dict[str, Any], delimiter: str = ";", units: tuple[str, ...] = ()) -> list[str]:
    """The lines of a table, with decimal points."""
    lines = [delimiter.join(columns)]
    lines += [delimiter.join(units)] if units else []
    rows = zip(*columns.values(), strict=True)
    return lines + [delimiter.join(f"{cell:.6f}" for cell in row) for row in rows]


def with_units(names: tuple[str, ...]) -> list[str]:
    """The lines of a table with units beside the names, and commas for decimals."""
    called = [f"{name} [{unit}]" for name, unit in zip(names, UNITS, strict=True)]
    lines = text(dict(zip(called, COLUMNS.values(), strict=True)))
    return [line.replace(".", ",") for line in lines]


LINES = text(COLUMNS, ";", UNITS)
GERMAN = with_units(("Zähler in Sekunden", *[*COLUMNS][1:]))
NOTE = "{} wind rises, sea 2; 300 rows, by JS"
WRITTEN: dict[str, bytes] = {
    **{
        f"{above} above, {delimiter} between": "\n".join(
            [*above, *text(COLUMNS, delimiter, UNITS), ""]
        ).encode()
        for above, delimiter in (
            ([], ";"),
            ([], ","),
            (["# recorder 4.2, vessel No. 7", "# started 2025-06-17"], "\t"),
            (["Data logger XY-7", "Serial: 12345", ""], "|"),
            (["Data logger XY-7", "Serial: 12345", ""], ","),
            (['"Sea trial";"17.06.2025"'], ";"),
        )
    },
    **{
        name: "\r\n".join([*lines, ""]).encode("utf-8-sig")
        for name, lines in {
            "an empty cell behind each row": [LINES[0], *(row + ";" for row in LINES[1:])],
            "empty cells behind the names": [LINES[0] + ";;", *LINES[1:]],
            "an empty cell behind each line": [row + ";" for row in LINES],
        }.items()
    },
    **{
        f"{sign} before notes among the values": "\n".join(
            [*LINES[:100], NOTE.format(sign), *LINES[100:], NOTE.format(sign)]
        ).encode()
        for sign in ("#", "%", "//", "  #")
    },
    **{
        f"{names[0]} in {encoding}": "\r\n".join([*with_units(names), ""]).encode(encoding)
        for names, encodings in (
            (
                ("Zähler in Sekunden", *[*COLUMNS][1:]),
                "utf-8-sig utf-16 utf-16-le utf-16-be utf-32 cp1252 cp850 mac_roman",
            ),
            (JAPANESE, "utf-8 utf-16 cp932"),
        )
        for encoding in encodings.split()
    },
    "a zero behind the end": "\n".join(GERMAN).encode() + b"\x00",
    "many zeros behind the end": "\n".join(GERMAN).encode() + b"\x00" * 200_000,
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_table_is_read_however_it_is_written(name: str, tmp_path: Path) -> None:
    (path := tmp_path / "log.csv").write_bytes(WRITTEN[name])
    log, content, marks = drafted(path)
    assert len(log) == T.size
    assert_read(log, TRUTH, 1e-5)
    assert content["time"]["unit"] == "s"
    # the sign of degrees is another letter in encodings that nobody can tell apart
    unsigned = name.endswith(("cp850", "mac_roman"))
    assert any("no unit" in text for _, text in marks.guessed_values) == unsigned


@pytest.mark.parametrize("lost", [1, 2, 7])
def test_a_file_that_was_cut_within_a_sign(lost: int, tmp_path: Path) -> None:
    (path := tmp_path / "log.csv").write_bytes("\n".join(GERMAN).encode("utf-16")[:-lost])
    assert len(drafted(path)[0]) >= T.size - 1


def test_the_encoding_may_be_told_and_is_checked(tmp_path: Path) -> None:
    (path := tmp_path / "log.csv").write_bytes("\n".join(GERMAN).encode("utf-16"))
    assert len(drafted(path, encoding="utf-16")[0]) == T.size
    with pytest.raises(DataError, match="not UTF-8 text"):
        drafted(path, encoding="utf-8")
    # the first megabyte may be plain ASCII
    path.write_bytes(b"t,note\n" + b"1.0,calm\n" * 130_000 + "2.0,Böe\n".encode("cp1252"))
    assert detect_encoding(path) == "cp1252"


def test_recordings_that_a_shell_of_windows_wrote(tmp_path: Path) -> None:
    bodies = [f"GPRMC,12000{i}.00,A,5954.32{i},N,01030.5,E,4.0,90.0,010124,,,A" for i in range(5)]
    sums = [np.bitwise_xor.reduce([*body.encode()]) for body in bodies]
    lines = "".join(f"${body}*{total:02X}\r\n" for body, total in zip(bodies, sums, strict=True))
    (path := tmp_path / "log.txt").write_bytes(lines.encode("utf-16"))
    found = detect_recording_format(path)
    assert found is not None
    assert found.name == "NMEA 0183"
    latitude = AutoConfig().load(path, ALL_FIELDS).series["RMC"].fields["latitude"]
    np.testing.assert_allclose(latitude, [59 + (54.320 + 0.001 * i) / 60 for i in range(5)])
    (topics := tmp_path / "topics").mkdir()
    for name in ("pose", "speed"):
        rows = "".join(f"{t:.1f},{2 * t:.2f}\n" for t in T)
        (topics / f"{name}.csv").write_bytes(f"time,{name}_x\n{rows}".encode("utf-16"))
    series = TopicFolderConfig().load(topics).series
    np.testing.assert_allclose(series["pose"].fields["pose_x"], 2.0 * T, atol=1e-9)


def test_a_line_is_called_by_its_number_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    lines = ["recorder", "", *LINES]
    path.write_text("\n".join([*lines, ""]))
    _, content, _ = drafted(path)
    cells = lines[30].split(";")
    for wrong, said in (
        ([*cells[:3], "bad", *cells[4:]], "line 31, column 'Kurs': 'bad'"),
        (cells[:3], "line 31 has 3 cells, the header 6"),
    ):
        lines[30] = ";".join(wrong)
        path.write_text("\n".join([*lines, ""]))
        with pytest.raises(DataError, match=said):
            validate_config(content, ReaderConfig, "here").build().read(path)


def test_a_sheet_with_a_title_and_units(tmp_path: Path) -> None:
    rows: list[list[Any]] = [["Sea trial", *[None] * 5], [None] * 6, list(COLUMNS), list(UNITS)]
    rows += [list(row) for row in zip(*COLUMNS.values(), strict=True)]
    pd.DataFrame(rows).to_excel(path := tmp_path / "log.xlsx", index=False, header=False)
    assert_read(drafted(path)[0], TRUTH, 1e-5)


OVER = np.sign(RUDDER)


@pytest.mark.parametrize(
    ("name", "column", "values", "channel", "read"),
    [
        # hard over is taken as 35 deg, and said to be
        ("Ruder", "Ruder [us]", 1500.0 + 400.0 * OVER, "delta", RUDDER * 28.0 / 20.0),
        ("Ruder", "Ruder", 1500.0 + 400.0 * OVER, "delta", RUDDER * 28.0 / 20.0),
        ("Ruder", "Ruder [%]", 50.0 * OVER, "delta", RUDDER * 17.5 / 20.0),
        ("Ruder", "Ruder", 100.0 * OVER, "delta", RUDDER * 35.0 / 20.0),
        ("Ruder", "Ruder", OVER, "delta", RUDDER * 35.0 / 20.0),
        ("Drehzahl", "Motor [%]", 60.0 + 0.1 * T, "throttle", 0.6 + 0.001 * T),
    ],
)
def test_commands_that_are_no_angles_and_no_revolutions(
    name: str, column: str, values: np.ndarray, channel: str, read: np.ndarray, tmp_path: Path
) -> None:
    columns = {key: cells for key, cells in COLUMNS.items() if key != name} | {column: values}
    (path := tmp_path / "log.csv").write_text("\n".join([*text(columns), ""]))
    log, _, marks = drafted(path)
    assert_read(log, {channel: read}, 1e-6)
    told = " ".join(text for key, text in marks.guessed_values if key[-1] == "delta")
    assert ("35 deg" in told) == (name == "Ruder")


def test_times_that_are_days_whole_seconds_or_beside_a_counter(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    days = pd.DataFrame({**COLUMNS, "Zeit": 45825.5 + T / 86400.0})
    days.rename(columns={"Kurs": "Kurs [deg]"}).to_csv(path, index=False, float_format="%.10f")
    log, content, _ = drafted(path)
    assert content["time"]["unit"] == "day"
    np.testing.assert_allclose(log.t - log.t[0], T, atol=1e-3)
    path.write_text("\n".join(text({"No.": np.arange(T.size), **COLUMNS, "Zeit": np.floor(T)})))
    log, content, marks = drafted(path)
    assert content["time"]["column"] == "Zeit", "a counter is no time"
    guesses = [guess for key, guess in marks.guessed_values if key[-1] == "time"]
    assert ["spread evenly" in guess for guess in guesses] == [True]
    np.testing.assert_allclose(log.t - log.t[0], T, atol=1e-9)
    assert "coarse_stamps" in [found["code"] for found in log.meta["findings"]]
    # times of Unix keep their digits where a log is cut
    log = Log("log", 1.75e9 + T, {"x": NORTH}, {"x": "m"})
    first = extract_segment(log, -np.inf, 1.75e9 + 20.0)
    second = extract_segment(log, 1.75e9 + 20.0, np.inf)
    assert first.name != second.name
    assert len(first) + len(second) == len(log)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"1,2,3\n4,5,6\n7,8,9\n", "3 columns of numbers without names"),
        (b"\xff\xfea\x00\x00\xd8;\x00b\x00\n\x001\x00", "not UTF-16 text"),
        (b"name,vessel\na,b\nc,d\n", "column names|contain numbers"),
        ("\n".join(GERMAN).encode().replace(b"0,4", b"\x00\x00\x00"), r"zero byte|no text"),
        (
            b"time,speed,Latitude,Longitude\n0,1,54 68.1N,10 2.3E\n1,2,54 18.2N,10 2.4E\n",
            "54 68.1N.*accepted are",
        ),
    ],
)
def test_what_is_no_table_is_refused_in_one_line(content: bytes, said: str, tmp_path: Path) -> None:
    (path := tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(DataError, match=said) as refused:
        draft_tables([path], DraftNotes())
    assert "\n" not in str(refused.value)


def test_a_second_compass_is_no_input() -> None:
    t = np.arange(0.0, 30.0, 0.1)
    names = ("x", "y", "psi", "u", "v", "r", "delta", "backup_compass_heading", "bucket")
    units = dict.fromkeys(names, "-") | {"delta": "rad"}
    channels = {name: np.sin((1.0 + i) * t) for i, name in enumerate(names)}
    marks = DraftNotes()
    assert choose_inputs([Log("log", t, channels, units)], marks) == ("delta", "bucket")
    assert any("backup_compass" in text for _, text in marks.notes)
    assert any(text.startswith("bucket ") for _, text in marks.guessed_values)


def test_a_name_that_stands_twice(tmp_path: Path) -> None:
    """The first is taken, and the other one noted; either can be told by its number."""
    path = tmp_path / "log.csv"
    lines = text(COLUMNS)
    path.write_text("\n".join([lines[0].replace("Ost", "Kurs"), *lines[1:]]))
    _, content, marks = drafted(path)
    assert any("'Kurs.1' may be psi instead of 'Kurs.0'" in said for _, said in marks.notes)
    entry = content["channels"]["psi"]
    assert entry["column"] == "Kurs.0"
    entry |= {"column": "Kurs.1", "unit": "deg"}
    assert_read(
        validate_config(content, ReaderConfig, "here").build().read(path), {"psi": PSI}, 1e-5
    )


def test_odometry_of_ros_under_water(tmp_path: Path) -> None:
    helix = {"kind": "helix", "drive": 0.6, "steer": 0.4, "dive": 0.4}
    (log,) = residnet.simulate("remus_100", [helix], duration=60.0, step=0.1, seed=2).logs
    down = Rotation.from_euler("ZYX", np.stack([log[n] for n in ("psi", "theta", "phi")], axis=1))
    east = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    up = Rotation.from_matrix(east @ down.as_matrix() @ np.diag([1.0, -1.0, -1.0])).as_quat()
    columns = {"time": log.t}
    columns |= dict(zip((f"pose.pose.orientation.{axis}" for axis in "xyzw"), up.T, strict=True))
    for axis, values in zip("xyz", (log["y"], log["x"], -log["z"]), strict=True):
        columns[f"pose.pose.position.{axis}"] = values
    for kind, names in (("linear", "uvw"), ("angular", "pqr")):
        for axis, name, sign in zip("xyz", names, (1, -1, -1), strict=True):
            columns[f"twist.twist.{kind}.{axis}"] = sign * log[name]
    (folder := tmp_path / "dive").mkdir()
    pd.DataFrame(columns).to_csv(folder / "odom.csv", index=False)
    for name in {*log.channels} - {*SIX_DOF_LAYOUT.state_names, "t"}:
        table = pd.DataFrame({"time": log.t, "data": log[name]})
        table.to_csv(folder / f"{name}.csv", index=False)
    (read,) = residnet.read_logs(folder)
    assert DegreesOfFreedom.from_channels(read.channels).is_six_dof
    for name in ("z", "phi", "theta", "u", "v", "w", "p", "q", "r"):
        at = np.interp(read.t, log.t - log.t[0], log[name])
        np.testing.assert_allclose(read[name], at, atol=1e-3, err_msg=name)
    # of a vessel on the surface nobody asks for its pitch
    columns["pose.pose.position.z"] = 0.01 * np.sin(log.t)
    pd.DataFrame(columns).to_csv(folder / "odom.csv", index=False)
    (read,) = residnet.read_logs(folder)
    assert not {"z", "theta", "w", "q"} & {*read.channels}


def test_table_with_one_variable_on_each_line(tmp_path: Path) -> None:
    rows = [
        (f"{1784000000 + t:.3f}", name, value)
        for t in (0.0, 0.5, 1.0)
        for name, value in (("boat/nav/x", t), ("boat/nav/y", 2.0 * t), ("pilot/rudder", "P"))
    ]
    path = tmp_path / "session.csv"
    pd.DataFrame(rows, columns=["ts", "topic", "value"]).to_csv(path, index=False)
    recording = AutoConfig().load(path, ALL_FIELDS)
    assert {name: sorted(series.fields) for name, series in recording.series.items()} == {
        "boat/nav": ["x", "y"]
    }
    np.testing.assert_allclose(recording["boat/nav"]["y"], [0.0, 1.0, 2.0])
    # a table with three columns of numbers is none
    path.write_text("t,key,value\n0,1,2\n1,2,3\n")
    assert detect_recording_format(path) is None


def test_files_with_other_titles_in_comments_have_the_same_columns(tmp_path: Path) -> None:
    texts = ["# Trial 1\n# 2 Bf\nt,x\n0,1\n", "# Trial 2\nt,x\n0,2\n", "# t,x\n0,1\n", "t,x\n0,1\n"]
    keys = []
    for number, text in enumerate(texts):
        (path := tmp_path / f"{number}.csv").write_text(text)
        keys.append(read_column_names(path))
    assert keys == [("t,x",), ("t,x",), ("# t,x",), ("t,x",)]
    # a row may have text between its numbers, and the names of ROS begin with a percent sign
    for number in range(2):
        path.write_text(f"%time,field.frame,field.x\n1{number},odom,2\n")
        assert read_column_names(path) == ("%time,field.frame,field.x",)
