"""Files of one trip from several recorders: found, brought to one clock, read as one log."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.log import Log
from residnet.io.drafting.reading import read_mixed_formats
from residnet.io.drafting.trips import refuse_topics
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import hash_files
from residnet.io.readers.joined_files import estimate_clock_offset, group_trip_files

LATE = {0: 12.3, 1: -31.7, 2: 5.05}
"""What the clock of the motors shows less than that of the receiver, in s."""


def motion(log: Log) -> Log:
    kept = {name: log[name] for name in ("x", "y", "psi")}
    return log.replace(channels=kept)


def commands(log: Log) -> Log:
    return log.replace(channels={name: log[name] for name in ("n", "delta")})


@pytest.mark.parametrize("number", [0, 2])
def test_the_shift_of_a_clock_is_found(number: int, ship_logs: list[Log]) -> None:
    log = ship_logs[number]
    other = commands(log).replace(t=log.t - LATE[number])
    found = estimate_clock_offset(motion(log), other)
    assert found.seconds == pytest.approx(LATE[number], abs=0.2)
    assert 1.0 - found.runner_up_share > 1.5 * (1.0 - found.explained_share)
    strange = commands(ship_logs[1 - number // 2])
    assert estimate_clock_offset(motion(log), strange).explained_share < found.explained_share


def test_trips_are_found_by_the_names_of_their_files(tmp_path: Path) -> None:
    def files(*names: str) -> dict[Path, tuple[str, ...]]:
        return {tmp_path / name: (name.partition("_")[0],) for name in names}

    both = group_trip_files(files("gps_1.csv", "gps_2.csv", "motor_1.csv", "motor_2.csv"))
    assert {word: [path.name for path in group] for word, group in both.items()} == {
        "gps": ["gps_1.csv", "gps_2.csv"],
        "motor": ["motor_1.csv", "motor_2.csv"],
    }
    whole = group_trip_files(files("gps_1.csv", "gps_2.csv", "motor_1.csv", "motor_3.csv"))
    assert [path.name for group in whole.values() for path in group] == ["gps_1.csv", "motor_1.csv"]
    assert group_trip_files(files("gps_1.csv", "gps_2.csv", "motor_3.csv", "motor_4.csv")) == {}
    assert group_trip_files(files("a_1.csv", "a_2.csv")) == {}
    apart = {tmp_path / run / f"{word}.csv": (word,) for run in "12" for word in ("imu", "cmd")}
    assert set(group_trip_files(apart)) == {"imu", "cmd"}


def tables(log: Log, late: float = 7.0) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return what a receiver writes each .2 s, and what the motors do each .1 s."""
    pose = {"north [m]": log["x"], "east [m]": log["y"], "heading [deg]": np.degrees(log["psi"])}
    acts = {"shaft [rpm]": 60.0 * log["n"], "rudder [deg]": np.degrees(log["delta"])}
    fixes = pd.DataFrame({"utc [s]": 1.75e9 + log.t, **pose})[::2]
    return fixes, pd.DataFrame({"board [s]": log.t + late, **acts})


def found(folder: Path, **files: pd.DataFrame) -> tuple[set[str], list[str], dict[str, str]]:
    """Return the logs of a folder, what is said of their clocks, and path -> why it is left out."""
    folder.mkdir()
    for name, table in files.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    read = read_mixed_formats(sorted(folder.iterdir()))
    logs = {log.name: log for one in read for log in one.logs.values()}
    said = [f for log in logs.values() for f in log.meta.get("findings", ())]
    told = [f"{f['level']}: {f['text']}" for f in said if f["code"] == "joined"]
    lost = {path.stem: str(why) for one in read for path, why in one.errors.items()}
    return set(logs), told, lost


def moved(text: str) -> tuple[str, float]:
    """Return the level and the part of what is said of a clock, and the time added to it."""
    parts = re.match(r"(.*): estimated clock offset ([+\d.]+) s", text)
    assert parts is not None, text
    return parts[1], float(parts[2])


def test_what_is_no_trip_or_cannot_be_joined_is_told(ship_logs: list[Log], tmp_path: Path) -> None:
    fixes, acts = tables(ship_logs[0])
    others, strange = tables(ship_logs[1])
    logs, told, _ = found(tmp_path / "good", gnss=fixes, motors=acts)
    assert logs == {"gnss"}
    assert moved(told[0]) == ("note: motors", pytest.approx(1.75e9 - 7.0, abs=0.2))
    # motors of another trip, and none that moves: what cannot be sure is a warning
    resting = acts.assign(**dict.fromkeys(map(str, acts), 1.0))
    for name, wrong in (("strange", strange), ("rest", resting)):
        wrong["board [s]"] = acts["board [s]"]
        _, told, _ = found(tmp_path / name, gnss=fixes, motors=wrong)
        assert told[0].startswith("will mislead: "), name
        assert told[0].endswith("set `shift: {motors: ...}`"), name
    _, told, _ = found(tmp_path / "short", gnss=fixes[:10], motors=acts[:30])
    assert "too short for an estimate); both files are assumed to start at the same time" in told[0]
    # a board whose clock is three seconds wrong, by dates
    dated = acts.assign(**{"board [s]": 1.75e9 - 3.0 + ship_logs[0].t})
    _, told, _ = found(tmp_path / "dated", gnss=fixes, motors=dated)
    assert "will mislead: motors: joined by the dates of both, which differ by -" in told[0]
    dated["board [s]"] += 3.0
    _, told, _ = found(tmp_path / "clock", gnss=fixes, motors=dated)
    assert told == ["note: motors: joined by the dates of both"]
    # two boats hold a position each
    boats = {"anna": fixes.merge(acts, left_index=True, right_index=True), "bea": others}
    assert found(tmp_path / "boats", **boats)[:2] == ({"anna", "bea"}, [])
    # a trip that lacks a part, and a list of names beside it
    names = pd.DataFrame({"who": ["Jan"], "what": ["skipper"]})
    logs, _, lost = found(tmp_path / "part", gnss_1=fixes, gnss_2=others, motors_1=acts, crew=names)
    assert logs == {"gnss_1"}
    assert set(lost) == {"gnss_2", "crew"}
    assert "another file of its trip is missing" in lost["gnss_2"]


def test_a_third_recorder_is_joined_by_the_rate_that_it_shares(
    ship_logs: list[Log], tmp_path: Path
) -> None:
    log = ship_logs[0]
    fixes, acts = tables(log)
    rate = pd.DataFrame({"t [s]": log.t + 3.0, "yaw rate [deg/s]": np.degrees(log["r"])})
    _, told, _ = found(tmp_path / "three", gnss=fixes, imu=rate, motors=acts)
    assert all(text.startswith("note: ") for text in told)
    parts = re.match(
        r"note: imu: clock offset ([+\d.]+) s, standard error .* against heading", told[0]
    )
    assert parts is not None, told[0]
    assert float(parts[1]) == pytest.approx(1.75e9 - 3.0, abs=0.03)


def test_topics_of_several_recordings_in_one_folder_are_named(tmp_path: Path) -> None:
    t = np.arange(5) * 1e5
    pose = {"timestamp": t, "x": t, "y": t, "heading": t}
    files = {}
    for folder, columns in (
        ("topics", {"timestamp": t, "control[0]": t}),
        ("kinds of complete logs", {**pose, "u": t}),
    ):
        (tmp_path / folder).mkdir()
        files[folder] = []
        for recording, topic in itertools.product(("log_1", "log_2"), ("vehicle_pose", "servos")):
            files[folder].append(tmp_path / folder / f"{recording}_{topic}.csv")
            table = pose if topic == "vehicle_pose" else columns
            pd.DataFrame(table).to_csv(files[folder][-1], index=False)
    with pytest.raises(UsageError, match=r"2 topics .* of 2 recordings \(log_1, log_2\); move"):
        refuse_topics(files["topics"])
    refuse_topics(files["kinds of complete logs"])


@pytest.mark.parametrize("column", ["gyro_z_dps", "gyro_z"])
def test_a_joined_yaw_rate_gets_the_sign_of_the_heading(
    column: str, ship_logs: list[Log], tmp_path: Path
) -> None:
    log = ship_logs[0]
    fixes, acts = tables(log)
    board = acts.assign(**{column: -np.degrees(log["r"])})
    for name, table in (("gnss", fixes), ("board", board)):
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    (result,) = read_mixed_formats(sorted(tmp_path.iterdir()))
    channels = result.reader["parts"]["board"]["channels"]
    assert channels["r"] == {"column": column, "unit": "deg/s", "sign": -1}
    # the direction of the rudder follows from the corrected yaw rate
    assert "sign" not in channels["delta"]
    (joined,) = result.logs.values()
    expected = np.interp(joined.t - 1.75e9, log.t, log["r"])
    assert float(np.nanmax(np.abs(joined["r"] - expected))) < 0.1 * float(np.abs(log["r"]).max())


def reader_of(**more: Any) -> dict[str, Any]:
    def table(*names: str) -> dict[str, Any]:
        units = {"x": "m", "y": "m", "k": "-"}
        channels = {name: {"column": name, "unit": units[name]} for name in names}
        time = {"column": "t", **more.get("time", {})}
        return {"kind": "csv", "time": time, "channels": channels}

    rest = {key: value for key, value in more.items() if key != "time"}
    return {"kind": "joined", "parts": {"pos": table("x", "y"), "cmd": table("k")}, **rest}


def test_a_shift_that_is_given_and_what_is_wrong(tmp_path: Path) -> None:
    t = np.arange(20.0)
    pd.DataFrame({"t": t, "x": t, "y": -t}).to_csv(tmp_path / "pos1.csv", index=False)
    pd.DataFrame({"t": t + 7.0, "k": t**2}).to_csv(tmp_path / "cmd1.csv", index=False)
    reader = validate_config(reader_of(shift={"cmd": -7.0}), ReaderConfig, "here").build()
    read = reader.read(tmp_path / "pos1.csv")
    both = [tmp_path / "pos1.csv", tmp_path / "cmd1.csv"]
    np.testing.assert_array_equal(read["k"], t**2)
    assert reader.list_member_files(both[0]) == both
    assert read.meta["parts"] == {"pos": hash_files(both[:1]), "cmd": hash_files(both[1:])}
    assert reader.select_logs(sorted(tmp_path.iterdir())) == [tmp_path / "pos1.csv"]
    with pytest.raises(DataError, match="does not contain 'pos'"):
        reader.read(tmp_path / "cmd1.csv")
    far = validate_config(reader_of(shift={"cmd": 100.0}), ReaderConfig, "here").build()
    with pytest.raises(DataError, match=r"from 0\.0 to 19\.0 s, those of cmd from 107\.0"):
        far.read(tmp_path / "pos1.csv")
    with pytest.raises(ConfigError, match="shift: 'pos' is no part"):
        validate_config(reader_of(shift={"pos": 1.0}), ReaderConfig, "here")
    (tmp_path / "cmd1.csv").unlink()
    with pytest.raises(DataError, match=r"cmd1\.csv is missing"):
        reader.read(tmp_path / "pos1.csv")


def test_dates_join_by_themselves(tmp_path: Path) -> None:
    t = np.arange(20.0)
    for name, start, columns in (
        ("pos", "2025-04-11 10:00:05", {"x": t, "y": t}),
        ("cmd", "2025-04-11 10:00:00", {"k": t}),
    ):
        stamps = pd.Timestamp(start) + pd.to_timedelta(t, "s")
        table = pd.DataFrame({"t": stamps.astype(str), **columns})
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    reader = validate_config(reader_of(time={"unit": "date"}), ReaderConfig, "here").build()
    found = reader.read(tmp_path / "pos.csv")["k"]
    np.testing.assert_array_equal(found, t[5:])  # cropped to the overlap
