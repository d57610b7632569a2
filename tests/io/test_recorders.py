"""Marine electronics and autopilots: NMEA 0183, PX4 and ArduPilot logs give the trial back to what
their digits hold.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import written_recorders
from written_logs import EPOCH, reader_for, trial
from written_recorders import ORIGIN

import residnet
from residnet.core.config import validate_config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import read_drafted
from residnet.io.readers import ReaderConfig
from residnet.io.readers.detect import detect_recording_format

pytestmark = pytest.mark.usefixtures("omit_currents")


def read(path: Path, **config: Any) -> Log:
    return validate_config(config, ReaderConfig, "test").build().read(path)


def codes(log: Log) -> set[str]:
    return {finding["code"] for finding in log.meta["findings"]}


def test_sentences_of_a_receiver_and_a_compass(tmp_path: Path) -> None:
    log = trial(20.0)
    path = written_recorders.nmea(log, tmp_path)
    origin = {"latitude": f"{ORIGIN[0]} deg", "longitude": f"{ORIGIN[1]} deg"}
    got = read(path, kind="nmea", position={"kind": "geodetic", "topic": "RMC", "origin": origin})
    assert set(got.channels) == {"x", "y", "psi", "u", "v", "r"}
    assert got.meta["start_utc"] == "2025-04-11T09:15:45.000000000Z"
    np.testing.assert_allclose(got.t, log.t, atol=1e-6)
    # 1e-7 minutes are 0.2 mm
    for name in ("x", "y"):
        np.testing.assert_allclose(got[name], log[name], atol=1e-3)
    for name in ("psi", "u", "v", "r"):
        np.testing.assert_allclose(got[name], log[name], atol=1e-5, err_msg=name)
    assert "estimated_times" in codes(got)
    # NMEA 0183 is north-east-down; only messages of ROS are turned from ENU
    assert got.meta["frames"]
    assert not any("REP-103" in text for text in got.meta["frames"])


def test_sentences_that_fail_their_checksum_or_have_no_fix(tmp_path: Path) -> None:
    path = written_recorders.nmea(trial(5.0), tmp_path)
    lines = path.read_text().splitlines()
    lines[30] = lines[30].replace(",A,", ",V,", 1)[:-2] + "00"
    lines[33] = "$GPRMC,091546.10,V,,,,,,,110425,,,N*77"
    lines.insert(10, "garbage \x00")
    path.write_text("\n".join(lines))
    got = reader_for(path).read(path)
    assert "bad_lines" in codes(got)
    assert len(got) in (49, 50)
    path.write_text("nothing here\n")
    with pytest.raises(DataError, match="no NMEA 0183 sentence"):
        read(path, kind="nmea")


@pytest.mark.parametrize("write", [written_recorders.nmea, written_recorders.ulog])
def test_no_other_frame_is_tried_where_the_format_fixes_it(
    write: Callable[[Log, Path], Path], tmp_path: Path
) -> None:
    log = trial(60.0)
    way = np.cumsum((log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])) * 0.1
    # north and east exchanged: motion and pose disagree, and other frames would fit
    path = write(log.replace(channels={**log.channels, "x": way.imag, "y": way.real}), tmp_path)
    (got,) = residnet.read_logs([path])
    for name in ("psi", "u", "v", "r"):
        np.testing.assert_allclose(got[name], log[name], atol=1e-5, err_msg=name)
    assert "standard_messages" not in residnet.draft_config(path).config["data"]["reader"]


@pytest.mark.parametrize(
    "notation", ["candump3", "candump2", "can_frame_ascii_raw", "n2k_ascii", "basic_string"]
)
def test_frames_of_nmea_2000_in_each_notation(notation: str, tmp_path: Path) -> None:
    pytest.importorskip("nmea2000")
    log = trial(20.0)
    path = written_recorders.nmea2000(log, tmp_path, notation)
    found = detect_recording_format(path)
    assert found is not None
    assert found.name == "NMEA 2000"
    origin = {"latitude": f"{ORIGIN[0]} deg", "longitude": f"{ORIGIN[1]} deg"}
    position = {"kind": "geodetic", "topic": "positionRapidUpdate", "origin": origin}
    got = read(path, kind="nmea2000", position=position)
    assert set(got.channels) == {"x", "y", "psi", "u", "v", "r", "delta", "n_port", "n_stbd"}
    assert got.meta["start_utc"].startswith("2025-04-11T09:15:45")
    np.testing.assert_allclose(got.t, log.t, atol=2e-3)
    # 1e-7 deg are 11 mm, 1e-4 rad and 1 cm/s are the digits of directions and speeds; frames of
    # one printed time follow each other by 0.25 ms, 1e-4 rad of a turn
    tolerances = {"x": 0.012, "y": 0.012, "psi": 4e-4, "u": 0.011, "v": 0.011, "r": 1e-4}
    for name, tolerance in tolerances.items():
        np.testing.assert_allclose(got[name][1:], log[name][1:], atol=tolerance, err_msg=name)
    expected = 0.1 * np.sin(0.3 * log.t)
    np.testing.assert_allclose(got["delta"][1:], expected[1:], atol=2e-4)
    for side in ("port", "stbd"):
        steady = np.isfinite(got[f"n_{side}"])
        assert steady.mean() > 0.9
        assert np.median(np.abs(got[f"n_{side}"] - np.abs(log[f"cmd_{side}"]))[steady]) < 1e-2


@pytest.mark.parametrize("sentences", ["HDG", "HDM with RMC", "HDM"])
def test_magnetic_headings_of_nmea_0183(sentences: str, tmp_path: Path) -> None:
    log = trial(10.0)
    path = written_recorders.nmea(log, tmp_path)
    lines = []
    for line in path.read_text().splitlines():
        text = line[1:].split("*")[0]
        if text.startswith("HEHDT"):
            magnetic = float(text.split(",")[1]) + 12.4
            text = f"HCHDG,{magnetic - 1.5:.6f},1.5,E,12.4,W"
            if sentences != "HDG":
                text = f"HCHDM,{magnetic:.6f},M"
        elif text.startswith("GPRMC") and sentences == "HDM with RMC":
            text = text.replace("110425,,,", "110425,12.4,W,")
        lines.append(f"${text}*{functools.reduce(operator.xor, text.encode()):02X}")
    path.write_text("\n".join(lines) + "\n")
    got = read(path, kind="nmea")
    offset = np.radians(12.4) if sentences == "HDM" else 0.0
    np.testing.assert_allclose(got["psi"] - offset, log["psi"], atol=1e-5)
    assert {"u", "v", "r"} <= set(got.channels)
    levels = [f["level"] for f in got.meta["findings"] if f["code"] == "magnetic_heading"]
    assert levels == ["will mislead" if sentences == "HDM" else "note"]


def test_magnetic_headings_of_nmea_2000(tmp_path: Path) -> None:
    pytest.importorskip("nmea2000")
    log = trial(10.0)
    path = written_recorders.nmea2000(log, tmp_path, variation_deg=-12.4)
    got = read(path, kind="nmea2000")
    for name, tolerance in {"psi": 4e-4, "u": 0.011, "v": 0.011}.items():
        np.testing.assert_allclose(got[name][1:], log[name][1:], atol=tolerance, err_msg=name)
    assert "magnetic_heading" in codes(got)
    # codes of devices and references are no quantities
    reader = residnet.draft_config(path).config["data"]["reader"]
    assert "channels" not in reader, reader
    # without the variation the user has to set it
    lines = [line for line in path.read_text().splitlines() if "09F11A" not in line]
    path.write_text("\n".join(lines) + "\n")
    (finding,) = [
        finding
        for finding in read(path, kind="nmea2000").meta["findings"]
        if finding["code"] == "magnetic_heading" and "heading is" in finding["text"]
    ]
    assert finding["level"] == "will mislead"


def test_damaged_files_of_nmea_2000(tmp_path: Path) -> None:
    pytest.importorskip("nmea2000")
    path = written_recorders.nmea2000(trial(5.0), tmp_path)
    lines = path.read_text().splitlines()
    lines[3] = lines[3][:40]
    lines[9] = "(1744362945.2) can0 09F802"
    lines.insert(7, "(1744362945.100000) can0 09FEFE03#0011")
    path.write_text("\n".join(lines))
    assert {"bad_lines", "unknown_groups"} <= codes(read(path, kind="nmea2000"))
    path.write_text("\n".join(line.partition(" ")[2] for line in lines))
    with pytest.raises(DataError, match="no line has a time: record with `candump -L`"):
        read(path, kind="nmea2000")


def test_telemetry_of_a_ground_station(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    log = trial(20.0)
    path = written_recorders.tlog(log, tmp_path)
    found = detect_recording_format(path)
    assert found is not None
    assert found.name == "MAVLink telemetry log"
    origin = {"latitude": f"{ORIGIN[0]} deg", "longitude": f"{ORIGIN[1]} deg"}
    position = {"kind": "geodetic", "topic": "GLOBAL_POSITION_INT", "origin": origin}
    position |= {"latitude": "lat", "longitude": "lon"}
    servo = {"topic": "SERVO_OUTPUT_RAW", "field": "servo1_raw", "unit": "us", "hold": True}
    got = read(path, kind="mavlink", position=position, channels={"servo_1": servo})
    assert {"x", "y", "psi", "u", "v", "r", "servo_1"} <= set(got.channels)
    assert got.meta["start_utc"].startswith("2025-04-11T09:15:45")
    # the autopilot's clock is even although messages arrive late
    np.testing.assert_allclose(got.t, log.t, atol=2e-3)
    for name, digits in {"x": 0.012, "y": 0.012, "psi": 1e-6, "r": 1e-6}.items():
        np.testing.assert_allclose(got[name], log[name], atol=digits, err_msg=name)
    for name in ("u", "v"):
        np.testing.assert_allclose(got[name], log[name], atol=0.01, err_msg=name)


def test_past_midnight(tmp_path: Path) -> None:
    path = tmp_path / "a.nmea"
    path.write_text(
        "\n".join(
            f"$GPGGA,{moment},6326.0,N,01025.0,E,4,12,0.8,43.8,M,,M,,"
            for moment in ("235958.00", "235959.00", "000000.00", "000001.00")
        )
    )
    got = read(path, kind="nmea")
    np.testing.assert_allclose(np.diff(got.t), 1.0)
    assert "undated" in codes(got)


@pytest.mark.parametrize(
    ("write", "late", "exact", "single"),
    [
        (written_recorders.ulog, 1e-6, ("psi", "r"), ("x", "y", "u", "v")),
        # the attitude has single precision, in degrees
        (written_recorders.ardupilot, 2e-3, ("x", "y", "r"), ("psi", "u", "v")),
    ],
)
def test_autopilots(
    write: Callable[[Log, Path], Path],
    late: float,
    exact: tuple[str, ...],
    single: tuple[str, ...],
    tmp_path: Path,
) -> None:
    log = trial(20.0)
    got = reader_for(path := write(log, tmp_path)).read(path)
    assert set(got.channels) == {"x", "y", "psi", "phi", "u", "v", "r", "p"}
    assert got.meta["epoch"] == pytest.approx(EPOCH, abs=late)
    np.testing.assert_allclose(got.t, log.t, atol=1e-9)
    for names, most in ((exact, 1e-9), (single, 2e-6)):
        for name in names:
            np.testing.assert_allclose(got[name], log[name], atol=most, err_msg=name)


def test_a_field_of_px4_that_a_config_names(tmp_path: Path) -> None:
    log = trial(20.0)
    path = written_recorders.ulog(log, tmp_path)
    assert "quaternion_flips" in codes(reader_for(path).read(path))
    exact = read(
        path,
        kind="ulog",
        standard_messages=False,
        channels={"x": {"topic": "vehicle_local_position", "field": "exact_x", "unit": "m"}},
    )
    np.testing.assert_allclose(exact["x"], log["x"], atol=1e-12)
    assert exact.meta["topics_not_used"] == [
        "vehicle_angular_velocity",
        "vehicle_attitude",
        "vehicle_gps_position",
    ]


def test_text_log_of_ardurover_2_46(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink")
    log = trial(60.0)
    path = written_recorders.ardurover_246(log, tmp_path)
    reader = residnet.draft_config(path).config["data"]["reader"]
    # the pulses of the servo repeat the steering of CTUN
    assert set(reader["channels"]) == {"cmd_delta", "cmd_throttle"}
    (got,) = residnet.read_logs([path])
    for name, tolerance in {"x": 1e-4, "y": 1e-4, "psi": 1e-4, "u": 2e-4, "v": 2e-4}.items():
        np.testing.assert_allclose(got[name], log[name], atol=tolerance, err_msg=name)
    # 2000 hundredths of a degree are 20 deg
    assert np.degrees(np.abs(got["cmd_delta"]).max()) == pytest.approx(20.0, abs=0.1)
    assert got["cmd_throttle"].max() == pytest.approx(0.49, abs=0.01)


def test_ardupilot_of_2014_counts_milliseconds(tmp_path: Path) -> None:
    log = trial(20.0)
    got = reader_for(path := written_recorders.ardupilot_2014(log, tmp_path)).read(path)
    assert {"x", "y", "psi", "r"} <= set(got.channels)
    middle = (got.t > 2.0) & (got.t < 18.0)
    for name, most in (("psi", 0.02), ("r", 0.02)):
        true = np.interp(got.t, log.t, log[name])
        apart = got[name] - true
        apart -= 2.0 * np.pi * np.round(np.median(apart) / (2.0 * np.pi)) if name == "psi" else 0.0
        assert np.abs(apart[middle]).max() < most
    away = got["x"] - np.interp(got.t, log.t, log["x"])
    assert np.ptp(away[middle]) < 0.2


def test_ardupilot_as_text(tmp_path: Path) -> None:
    log = trial(20.0)
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 130, 30, XKF1, QBffff, TimeUS,C,PN,PE,VN,VE",
        "FMT, 131, 20, ATT, Qff, TimeUS,Roll,Yaw",
        "FMT, 132, 20, RCOU, QHHH, TimeUS,C1,C2,C3",
    ]
    for i, t in enumerate(log.t.tolist()):
        at, psi = round(5e6 + 1e6 * t), log["psi"][i]
        ground = np.exp(1j * psi) * (log["u"][i] + 1j * log["v"][i])
        place = f"{log['x'][i]:.6f}, {log['y'][i]:.6f}, {ground.real:.6f}, {ground.imag:.6f}"
        lines.append(f"XKF1, {at}, 0, {place}")
        lines.append(f"ATT, {at}, 0.0, {np.degrees(psi) % 360.0:.6f}")
        pulses = [1500 + round(300.0 * np.sin(0.1 * k * t)) for k in (1, 2)]
        lines.append(f"RCOU, {at}, {pulses[0]}, 0, {pulses[1]}")
    path = tmp_path / "00000042.log"
    path.write_text("\n".join(lines) + "\n")
    found = detect_recording_format(path)
    assert found is not None
    assert found.name == "ArduPilot log"
    (read,) = residnet.read_logs(path)
    assert {"servo_1", "servo_3"} <= set(read.channels)
    for name in ("x", "y", "u", "v"):
        at_ours = np.interp(read.t - 5.0, log.t, log[name])
        np.testing.assert_allclose(read[name], at_ours, atol=0.02, err_msg=name)


def test_topics_whose_standard_messages_lack_a_heading_are_mapped_by_name(tmp_path: Path) -> None:
    t = 0.1 * np.arange(600)
    psi = 0.6 * np.sin(0.1 * t)
    x, y = np.cumsum(0.2 * np.cos(psi)), np.cumsum(0.2 * np.sin(psi))
    zeros = np.zeros(t.size)
    velocity = {"vx": 2.0 * np.cos(psi), "vy": 2.0 * np.sin(psi), "vz": zeros}
    quaternion = (np.cos(0.5 * psi), zeros, zeros, np.sin(0.5 * psi))
    tables = {
        "vehicle_local_position_0": {"x": x, "y": y, "z": zeros, **velocity, "heading": psi},
        "vehicle_attitude_0": {f"q[{k}]": part for k, part in enumerate(quaternion)},
        "actuator_servos_0": {"control[0]": np.cos(0.1 * t)},
    }
    for name, columns in tables.items():
        path = tmp_path / "log0" / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        pd.DataFrame({"timestamp": (1e6 * t).astype(int), **columns}).to_csv(path, index=False)
    result = read_drafted([tmp_path / "log0"], DraftNotes())
    (log,) = result.logs.values()
    assert np.ptp(log["psi"]) > 1.0
