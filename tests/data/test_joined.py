"""Files of one trip from several recorders: found, brought to one clock, read as one log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import residnet
from residnet.core.config import validate
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.data.readers import ReaderConfig
from residnet.data.readers.joined import clock_shift, partners

LATE = {0: 12.3, 1: -31.7, 2: 5.05}
"""What the clock of the motors shows less than that of the receiver, in s."""


def motion(log: Log) -> Log:
    kept = {name: log[name] for name in ("x", "y", "psi")}
    return log.replace(channels=kept)


def commands(log: Log) -> Log:
    return log.replace(channels={name: log[name] for name in ("n", "delta")})


def write(logs: list[Log], folder: Path) -> Path:
    """gnss_1.csv at 5 Hz in Unix time beside motors_1.csv at 10 Hz in ms of its own."""
    folder.mkdir(exist_ok=True)
    for number, log in enumerate(logs):
        here = {"when": 1.75e9 + 1e5 * number + log.t, "north [m]": log["x"], "east [m]": log["y"]}
        here |= {"heading [deg]": np.degrees(log["psi"]) % 360.0}
        pd.DataFrame(here)[::2].to_csv(folder / f"gnss_{number + 1}.csv", index=False)
        there = {"ms": np.round(1000 * (log.t + 50.0 - LATE[number]))}
        there |= {"motor us": np.round(1500 + 10 * log["n"])}
        there |= {"rudder us": np.round(1500 + 500 * np.degrees(log["delta"]) / 35)}
        pd.DataFrame(there).to_csv(folder / f"motors_{number + 1}.csv", index=False)
    return folder


@pytest.mark.parametrize("number", [0, 2])
def test_the_shift_of_a_clock_is_found(number: int, ship_logs: list[Log]) -> None:
    log = ship_logs[number]
    other = commands(log).replace(t=log.t - LATE[number])
    found = clock_shift(motion(log), other)
    assert found.seconds == pytest.approx(LATE[number], abs=0.2)
    assert 1.0 - found.other > 1.5 * (1.0 - found.explained)
    strange = commands(ship_logs[1 - number // 2])
    assert clock_shift(motion(log), strange).explained < found.explained


def test_trips_are_found_by_the_names_of_their_files(tmp_path: Path) -> None:
    def files(*names: str) -> dict[Path, tuple[str, ...]]:
        return {tmp_path / name: (name.partition("_")[0],) for name in names}

    both = partners(files("gps_1.csv", "gps_2.csv", "motor_1.csv", "motor_2.csv"))
    assert {word: [path.name for path in group] for word, group in both.items()} == {
        "gps": ["gps_1.csv", "gps_2.csv"],
        "motor": ["motor_1.csv", "motor_2.csv"],
    }
    whole = partners(files("gps_1.csv", "gps_2.csv", "motor_1.csv", "motor_3.csv"))
    assert [path.name for group in whole.values() for path in group] == ["gps_1.csv", "motor_1.csv"]
    assert partners(files("gps_1.csv", "gps_2.csv", "motor_3.csv", "motor_4.csv")) == {}
    assert partners(files("a_1.csv", "a_2.csv")) == {}
    apart = {tmp_path / run / f"{word}.csv": (word,) for run in "12" for word in ("imu", "cmd")}
    assert set(partners(apart)) == {"imu", "cmd"}


def test_two_files_a_trip_are_one_log_at_every_door(ship_logs: list[Log], tmp_path: Path) -> None:
    folder = write(ship_logs, tmp_path / "trips")
    read = residnet.read_logs(folder)
    assert [log.name for log in read] == ["gnss_1", "gnss_2", "gnss_3"]
    for log, true in zip(read, ship_logs, strict=True):
        assert set(log.channels) == {"x", "y", "psi", "throttle", "delta"}
        assert len(log) == len(true) // 2 + len(true) % 2
        inside = np.isfinite(log["delta"])
        assert inside.mean() > 0.9
        apart = np.interp(log.t - log.t[0], true.t, true["delta"]) - log["delta"]
        assert np.median(np.abs(apart[inside])) < np.radians(1.0)
        assert sum(found["code"] == "joined" for found in log.meta["findings"]) == 1
    draft = residnet.draft(folder, folder=tmp_path)
    reader = draft.config["data"]["reader"]
    assert (reader["kind"], list(reader["parts"])) == ("joined", ["gnss", "motors"])
    assert reader["parts"]["motors"]["channels"]["throttle"]["offset"] == 1500
    again = validate(reader, ReaderConfig, "here").build().read(folder / "gnss_2.csv")
    np.testing.assert_array_equal(again["delta"], read[1]["delta"])


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
    reader = validate(reader_of(shift={"cmd": -7.0}), ReaderConfig, "here").build()
    np.testing.assert_array_equal(reader.read(tmp_path / "pos1.csv")["k"], t**2)
    assert reader.logs_among(sorted(tmp_path.iterdir())) == [tmp_path / "pos1.csv"]
    with pytest.raises(DataError, match="its name holds no 'pos'"):
        reader.read(tmp_path / "cmd1.csv")
    far = validate(reader_of(shift={"cmd": 100.0}), ReaderConfig, "here").build()
    with pytest.raises(DataError, match=r"from 0\.0 to 19\.0 s, that of cmd from 107\.0"):
        far.read(tmp_path / "pos1.csv")
    with pytest.raises(ConfigError, match="'pos' is no part whose clock can be moved"):
        validate(reader_of(shift={"pos": 1.0}), ReaderConfig, "here")
    (tmp_path / "cmd1.csv").unlink()
    with pytest.raises(DataError, match=r"cmd1\.csv is not beside it"):
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
    reader = validate(reader_of(time={"unit": "date"}), ReaderConfig, "here").build()
    found = reader.read(tmp_path / "pos.csv")["k"]
    np.testing.assert_array_equal(found[:15], t[5:])
    assert np.isnan(found[15:]).all()
