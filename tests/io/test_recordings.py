"""Composition of recordings to logs, each fault planted by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from printed_times import EPOCH, printed

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.log import Log
from residnet.core.progress import Progress, on_progress
from residnet.io.readers import ReaderConfig


def folder(tmp_path: Path, **topics: dict[str, Any]) -> Path:
    place = tmp_path / "run"
    place.mkdir()
    for name, columns in topics.items():
        pd.DataFrame(columns).to_csv(place / f"{name}.csv", index=False, float_format="%.17g")
    return place


def read(path: Path, **config: Any) -> Log:
    settings = {"kind": "csv_topics", "standard_messages": False, **config}
    return validate_config(settings, ReaderConfig, "test").build().read(path)


def field(name: str, unit: str = "-", **more: Any) -> dict[str, Any]:
    return {"topic": name, "field": "data", "unit": unit, **more}


def test_commands_hold_measurements_are_interpolated_gaps_stay_gaps(tmp_path: Path) -> None:
    t = np.concatenate((0.1 * np.arange(40), 10.0 + 0.1 * np.arange(40)))
    place = folder(
        tmp_path,
        gyro={"time": t, "data": 2.0 * t},
        order={"time": [0.0, 1.05, 11.02], "data": [1.0, 2.0, 3.0]},
    )
    channels = {
        "r": field("gyro", "deg/s"),
        "cmd_delta": field("order", "deg", hold=True, longest_gap="20 s"),
    }
    log = read(place, channels=channels, clock={"kind": "uniform", "step": "0.04 s"})
    gap = (log.t > 3.9 + 1e-9) & (log.t < 10.0 - 1e-9)
    np.testing.assert_array_equal(np.isnan(log["r"]), gap)
    np.testing.assert_array_equal(log.masks["hard:gap"], gap)
    np.testing.assert_allclose(np.degrees(log["r"][~gap]), 2.0 * log.t[~gap], atol=1e-9)
    expected = np.where(log.t < 1.05 - 1e-9, 1.0, np.where(log.t < 11.02 - 1e-9, 2.0, 3.0))
    before_the_last = log.t <= 11.02
    held = np.degrees(log["cmd_delta"][before_the_last])
    np.testing.assert_allclose(held, expected[before_the_last])


T = 0.05 * np.arange(2400)
PSI = 0.1 * T
# a vessel on a circle of 20 m, bow along the track: u = 2 m/s, v = 0, r = 0.1 rad/s
NORTH = 20.0 * np.sin(PSI)
EAST = -20.0 * np.cos(PSI)
# an antenna 3 m ahead and 1 m to port
ANTENNA = {"x": "3 m", "y": "-1 m"}


def test_lever_and_derived_velocities(tmp_path: Path) -> None:
    c, s = np.cos(PSI), np.sin(PSI)
    sign = np.where(np.arange(T.size) % 3, 1.0, -1.0)
    turned = {
        "q_x": 0 * T,
        "q_y": 0 * T,
        "q_z": sign * np.sin(PSI / 2),
        "q_w": sign * np.cos(PSI / 2),
    }
    place = folder(
        tmp_path,
        fix={"time": T, "n": NORTH + 3.0 * c + 1.0 * s, "e": EAST + 3.0 * s - 1.0 * c},
        heading={"time": T, **turned},
    )
    local = {"kind": "local", "topic": "fix", "north": "n", "east": "e", "antenna": ANTENNA}
    heading = {"kind": "quaternion", "topic": "heading", "field": "q", "frame": "ned"}
    config: dict[str, Any] = {"position": local, "heading": heading}
    clock = {"kind": "uniform", "step": "0.1 s"}
    window = {"kind": "derived", "window": "1 s"}
    derived = read(place, **config, velocity=window, clock=clock)
    assert len(derived) == 1200
    truth = {"u": 2.0, "v": 0.0, "r": 0.1, "x": NORTH[::2], "y": EAST[::2], "psi": PSI[::2]}
    for name, value in truth.items():
        np.testing.assert_allclose(derived[name], value, atol=5e-5, err_msg=name)
    plain = read(place, **config)
    np.testing.assert_allclose(plain["x"], NORTH, atol=1e-9)
    with pytest.raises(ConfigError, match="uniform clock"):
        read(place, **config, velocity={"kind": "derived"})


@pytest.mark.parametrize("kind", ["earth_fixed", "course_speed"])
def test_velocity_of_an_antenna_in_earth_axes(kind: str, tmp_path: Path) -> None:
    # u = 2, v = 0.3 at the centre
    u, v = 2.0 - 0.1 * -1.0, 0.3 + 0.1 * 3.0
    ground = (u + 1j * v) * np.exp(1j * PSI)
    knots = np.abs(ground) * 3600 / 1852
    course = np.degrees(np.angle(ground)) % 360
    fixes = {"n": ground.real, "e": ground.imag, "speed": knots, "course": course}
    place = folder(
        tmp_path,
        gps={"time": T, **fixes},
        compass={"time": T, "data": np.degrees(np.pi / 2 - PSI) % 360},
        gyro={"time": T, "data": np.full(T.size, -0.1)},
    )
    source = {
        "earth_fixed": {"north": "n", "east": "e"},
        "course_speed": {"course": "course", "speed": "speed", "speed_unit": "kn"},
    }[kind]
    log = read(
        place,
        heading={"kind": "angle", **field("compass", "deg"), "frame": "enu"},
        velocity={"kind": kind, "topic": "gps", "antenna": ANTENNA, **source},
        channels={"r": field("gyro", "rad/s", frame="body_fpu")},
    )
    for name, value in (("u", 2.0), ("v", 0.3), ("psi", PSI)):
        np.testing.assert_allclose(log[name], value, atol=1e-9)


def test_a_topic_that_lags_and_one_that_speaks_of_another_point(tmp_path: Path) -> None:
    t = 0.1 * np.arange(3000)
    psi = 2.0 * np.sin(0.05 * t) + 0.5 * np.sin(0.21 * t)
    r = np.gradient(psi, t)
    x, y = 10.0 * np.sin(0.02 * t), 10.0 * np.cos(0.03 * t)
    other = {"pose_position_x": x - 0.8 * np.sin(psi), "pose_position_y": y + 0.8 * np.cos(psi)}
    place = folder(
        tmp_path,
        fix={"time": t, "n": x, "e": y},
        compass={"time": t, "data": psi},
        gyro={"time": t, "data": r},
        filter={"time": t[10:], "twist_angular_z": np.interp(t[10:] - 0.4, t, r)},
        pose={"time": t, **other},
    )
    log = read(
        place,
        position={"kind": "local", "topic": "fix", "north": "n", "east": "e"},
        heading={"kind": "angle", "topic": "compass", "field": "data"},
        channels={"r": field("gyro", "rad/s")},
    )
    figures = {entry["code"]: entry["figures"] for entry in log.meta["findings"]}
    assert figures["topic_lag"]["lag"] == pytest.approx(0.4, abs=0.05)
    assert (figures["lever_arm"]["forward"], figures["lever_arm"]["starboard"]) == pytest.approx(
        (0.0, -0.8), abs=0.02
    )


def test_topics_of_different_length_share_the_stretch_that_all_cover(tmp_path: Path) -> None:
    settings = {
        "channels": {"u": field("a", "m/s"), "v": field("b", "m/s")},
        "clock": {"kind": "uniform", "step": "0.1 s"},
    }
    a = {"time": 0.1 * np.arange(200), "data": 1}
    place = folder(tmp_path, a=a, b={"time": 5.0 + 0.2 * np.arange(50), "data": 1})
    log = read(place, **settings)
    assert (log.t[0], log.t[-1]) == pytest.approx((5.0, 14.8))
    assert not log.masks
    pd.DataFrame({"time": [35.0, 36.0], "data": 1}).to_csv(place / "b.csv", index=False)
    with pytest.raises(DataError, match="recorder_utc_offset"):
        read(place, **settings)


@pytest.mark.parametrize(
    ("channels", "error", "words"),
    [
        ({"r": field("gyr", "rad/s")}, UsageError, "no topic 'gyr'; did you mean 'gyro'"),
        (
            {"r": field("gyro", "rad/s") | {"field": "date"}},
            UsageError,
            "no field 'date'; did you mean",
        ),
        (
            {"r": field("gyro", "rad/s") | {"field": "none"}},
            DataError,
            "field 'none' has no number",
        ),
        ({}, UsageError, "no channel is mapped"),
        ({"r": field("gyro", "rad/s"), "delta": field("rudder", "rad", required=False)}, None, ""),
    ],
)
def test_what_is_missing_is_named(
    channels: dict[str, Any], error: type[Exception] | None, words: str, tmp_path: Path
) -> None:
    t = 0.1 * np.arange(50)
    place = folder(tmp_path, gyro={"time": t, "data": t, "none": np.nan, "words": ["a"] * 50})
    (place / "silent.csv").write_text("")
    (place / "torn.csv").write_text('time,data\n0,"1\n1,2\n')
    if error is not None:
        with pytest.raises(error, match=words):
            read(place, channels=channels)
        return
    log = read(place, channels=channels)
    assert list(log.channels) == ["r"]
    found = {entry["code"] for entry in log.meta["findings"]}
    assert found >= {
        "missing_channels",
        "empty_topic",
        "empty_columns",
        "not_numbers",
        "unreadable",
    }
    with pytest.raises(UsageError, match="no such file"):
        read(tmp_path / "ran", channels=channels)


def test_a_topic_cut_short_in_the_middle_of_a_row(tmp_path: Path) -> None:
    t = EPOCH + 0.1 * np.arange(200)
    time = [f"{pd.Timestamp(s, unit='s'):%Y-%m-%d %H:%M:%S.%f}" for s in t]
    place = folder(tmp_path, gyro={"time": time, "data": t - EPOCH})
    text = (place / "gyro.csv").read_text()
    (place / "gyro.csv").write_text(text[: text.rindex(":") - 3])
    log = read(place, channels={"r": field("gyro", "rad/s")})
    assert len(log) == 199
    assert "cut_short" in {entry["code"] for entry in log.meta["findings"]}


def test_chunks_of_a_topic_give_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ns = EPOCH * 10**9 + 70_533_347 * np.arange(2000)
    values = np.sin(np.arange(2000.0))
    cells = [f"{v!r}" if i % 500 else "lost" for i, v in enumerate(values.tolist())]
    place = folder(
        tmp_path,
        gyro={"time": printed(ns, "unpadded"), "data": cells, "header_frame_id": ["bow"] * 2000},
    )
    whole = read(place, channels={"r": field("gyro", "rad/s")})
    monkeypatch.setattr("residnet.io.readers.formats.topic_folder.LARGE_FOLDER_BYTES", 0)
    pieces = read(place, channels={"r": field("gyro", "rad/s")})
    np.testing.assert_array_equal(pieces.t, whole.t)
    np.testing.assert_array_equal(pieces["r"], whole["r"])
    assert (
        {entry["code"] for entry in pieces.meta["findings"]}
        == {entry["code"] for entry in whole.meta["findings"]}
        >= {"not_numbers", "unpadded_fraction"}
    )
    assert np.isnan(whole["r"]).sum() == 4


def test_one_table_with_dates_latitudes_and_a_compass(tmp_path: Path) -> None:
    # of curvature of WGS 84 at the origin
    radii = 6_386_688.0, 6_395_290.0 * np.cos(np.radians(63.4411))
    times = [f"{pd.Timestamp(EPOCH + s, unit='s'):%Y-%m-%dT%H:%M:%S.%f}+01:00" for s in T[::4]]
    table = {
        "time": times,
        "lat": 63.4411 + np.degrees(NORTH[::4] / radii[0]),
        "lon": 10.4198 + np.degrees(EAST[::4] / radii[1]),
        "compass": np.degrees(PSI[::4]) % 360,
    }
    pd.DataFrame(table)[:400].to_csv(path := tmp_path / "run.csv", index=False)
    origin = {"latitude": "63.4411 deg", "longitude": "10.4198 deg"}
    fixes = {"kind": "geodetic", "latitude": "lat", "longitude": "lon", "origin": origin}
    log = read(
        path,
        position=fixes,
        heading={"kind": "angle", "field": "compass", "unit": "deg"},
        velocity={"kind": "derived"},
        clock={"kind": "uniform", "step": "0.2 s"},
    )
    assert log.name == "run"
    assert log.meta["epoch"] == pytest.approx(EPOCH - 3600)
    np.testing.assert_allclose(log["u"], 2.0, atol=2e-4)
    np.testing.assert_allclose(log["r"], 0.1, atol=1e-5)


def test_reading_a_large_recording_reports_its_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = 0.1 * np.arange(200)
    place = folder(tmp_path, gyro={"time": t, "data": t}, log={"time": t, "data": t})
    reports: list[Progress] = []
    channels = {"r": field("gyro", "rad/s"), "u": field("log", "m/s")}
    with on_progress(reports.append):
        read(place, channels=channels)
    assert not reports
    monkeypatch.setattr("residnet.io.readers.base._PROGRESS_MIN_BYTES", 1)
    with on_progress(reports.append):
        read(place, channels=channels)
    assert {report.stage for report in reports} == {"reading run, per cent"}
    done = [report.done or 0.0 for report in reports]
    assert done == sorted(done)
    assert done[-1] == reports[-1].total == 100.0


def test_the_former_key_of_the_recorders_offset_names_the_new_one() -> None:
    with pytest.raises(ConfigError, match=r"zone: .*recorder_utc_offset") as caught:
        validate_config({"kind": "auto", "zone": "2 h"}, ReaderConfig, "here")
    assert "\n" not in str(caught.value)
