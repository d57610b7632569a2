"""Drafts of what autopilots, simulators and spreadsheets write by habit."""

from __future__ import annotations

import json
import math
import shutil
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from drafted_logs import drafted

import residnet
from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.reading import read_drafted
from residnet.data.drafting.tables import draft_tables
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.readers import ReaderConfig


@pytest.fixture(scope="module")
def log() -> Log:
    """Turns of a boat with a rudder."""
    trial = {"kind": "zigzag", "drive": 0.8, "steer": 0.6, "heading": "70 deg", "start": 3}
    flown = residnet.simulate("example_rudder_boat", [trial], duration=90.0, step=0.2, seed=4)
    return next(iter(flown.logs))


def _drafted(frame: pd.DataFrame, file: Path, **to_csv: Any) -> tuple[Log, Marks]:
    """Return the log that a table's draft reads, and what was marked."""
    frame.to_csv(file, index=False, **to_csv)
    log, _, marks = drafted(file)
    return log, marks


def _guessed(marks: Marks, name: str) -> bool:
    return any(key[-1] == name for key, _ in marks.guesses)


def _fixes(log: Log) -> tuple[np.ndarray, np.ndarray]:
    north, east = log["x"] / 111_132.0, log["y"] / (111_320.0 * math.cos(math.radians(54.3)))
    return 54.3 + north, 10.15 + east


def _at(read: Log, log: Log) -> None:
    """Check positions from the first fix on; the sphere here is no ellipsoid."""
    for name in ("x", "y"):
        moved = log[name] - log[name][0]
        np.testing.assert_allclose(read[name] - read[name][0], moved, atol=0.01 * np.ptp(moved))


def _frame(log: Log, **columns: np.ndarray) -> pd.DataFrame:
    rudder = {"rudder [deg]": np.degrees(log["delta"]), "rpm": 60.0 * log["n"]}
    return pd.DataFrame({"time [s]": log.t, **columns, **rudder})


@pytest.mark.parametrize("ground", [False, True])
def test_velocities_along_x_and_y(ground: bool, log: Log, tmp_path: Path) -> None:
    u, v, psi = log["u"], log["v"], log["psi"]
    if ground:
        u, v = np.cos(psi) * u - np.sin(psi) * v, np.sin(psi) * u + np.cos(psi) * v
    frame = _frame(log, x=log["x"], y=log["y"], yaw=psi, vx=u, vy=v)
    read, marks = _drafted(frame, tmp_path / "log.csv")
    assert ({"u", "v"} <= set(read.channels)) != ground
    assert _guessed(marks, "u") != ground
    assert any("along north and east" in text for _, text in marks.notes) == ground
    np.testing.assert_allclose(read["psi"] - read["psi"][0], psi - psi[0], atol=1e-6)


def test_whole_numbers_of_an_autopilot(log: Log, tmp_path: Path) -> None:
    latitude, longitude = _fixes(log)
    heading = np.round(np.degrees(log["psi"]) % 360.0 * 100.0)
    frame = _frame(log, lat=np.round(latitude * 1e7), lon=np.round(longitude * 1e7), hdg=heading)
    read, marks = _drafted(frame.astype({"lat": int, "lon": int}), tmp_path / "log.csv")
    _at(read, log)
    assert np.cos(read["psi"] - log["psi"]).min() > 0.9999
    assert all(_guessed(marks, name) for name in ("latitude", "longitude", "psi"))


@pytest.mark.parametrize(
    ("names", "sign"), [(("Breite", "Länge", "Kurs [°]"), 1), (("Lat", "Long", "Cap [°]"), -1)]
)
@pytest.mark.parametrize("apart", [False, True])
def test_o_as_a_hemisphere(
    names: tuple[str, str, str], sign: int, apart: bool, log: Log, tmp_path: Path
) -> None:
    latitude, longitude = _fixes(log)
    longitude = longitude if sign > 0 else longitude - 20.0
    size = np.abs(longitude)

    def minutes(angle: float, side: str) -> str:
        return f"{int(angle)}°{angle % 1 * 60:.5f}'{side}"

    north = np.array([minutes(angle, "N") for angle in latitude])
    east = np.array([minutes(angle, "" if apart else "O") for angle in size])
    given = {names[0]: north, names[1]: east, names[2]: np.degrees(log["psi"]) % 360.0}
    given |= {"Seite": np.full(len(log.t), "O")} if apart else {}
    read, marks = _drafted(_frame(log, **given), tmp_path / "log.csv", sep=";")
    _at(read, log)
    assert _guessed(marks, "longitude")


def test_a_workbook_that_begins_with_words(log: Log, tmp_path: Path) -> None:
    file = tmp_path / "log.xlsx"
    frame = _frame(log, x=log["x"], y=log["y"], heading=log["psi"])
    with pd.ExcelWriter(file) as book:
        pd.DataFrame({"Protokoll": ["Probefahrt", "gutes Wetter"]}).to_excel(
            book, sheet_name="Info"
        )
        frame.to_excel(book, sheet_name="Daten", index=False)
    read, content, _ = drafted(file)
    assert content["sheet"] == "Daten"
    np.testing.assert_allclose(read["x"], log["x"], atol=1e-9)


def _attitude(log: Log, names: list[str], anticlockwise: bool) -> dict[str, np.ndarray]:
    """Return the columns of a quaternion x, y, z, w that changes its sign and has some roll."""
    yaw = math.pi / 2 - log["psi"] if anticlockwise else log["psi"]
    roll = 0.05 * np.sin(log.t)
    parts = (
        np.cos(yaw / 2) * np.sin(roll / 2),
        np.sin(yaw / 2) * np.sin(roll / 2),
        np.sin(yaw / 2) * np.cos(roll / 2),
        np.cos(yaw / 2) * np.cos(roll / 2),
    )
    sign = np.where(np.sin(log.t) < 0, -1.0, 1.0)
    return {name: sign * part for name, part in zip(names, parts, strict=True)}


@pytest.mark.parametrize(
    ("names", "anticlockwise"),
    [
        (["qx", "qy", "qz", "qw"], True),
        (
            [
                "pose.orientation.x",
                "pose.orientation.y",
                "pose.orientation.z",
                "pose.orientation.w",
            ],
            False,
        ),
        (["quat_x [-]", "quat_y [-]", "quat_z [-]", "quat_w [-]"], True),
        (["q[1]", "q[2]", "q[3]", "q[0]"], False),
        (["q0", "q1", "q2", "q3"], True),
    ],
)
def test_attitudes_as_quaternions(
    log: Log, tmp_path: Path, names: list[str], anticlockwise: bool
) -> None:
    frame = pd.DataFrame(
        {
            **{"time [s]": log.t, "north [m]": log["x"], "east [m]": log["y"]},
            **_attitude(log, names, anticlockwise),
            "rudder [deg]": np.degrees(log["cmd_delta"]),
        }
    )
    read, marks = _drafted(frame, tmp_path / "log.csv")
    turns = (read["psi"] - log["psi"]) / (2 * math.pi)
    np.testing.assert_allclose(turns - round(turns[0]), 0.0, atol=1e-9)
    assert _guessed(marks, "qw")
    assert not {"qx", "qy", "qz", "qw"} & set(read.channels)


@pytest.mark.parametrize("stem", ["pose.", ".pose.pose.", "field.pose.pose.", ""])
@pytest.mark.parametrize("ned", [False, True])
def test_poses_of_ros(log: Log, tmp_path: Path, stem: str, ned: bool) -> None:
    names = [f"{stem}orientation.{part}" for part in "xyzw"]
    east_first = {f"{stem}position.x": log["y"], f"{stem}position.y": log["x"]}
    north_first = {f"{stem}position.x": log["x"], f"{stem}position.y": log["y"]}
    frame = pd.DataFrame(
        {
            **{"time": log.t, "header.frame_id": np.full(len(log.t), "map_ned" if ned else "map")},
            **(north_first if ned else east_first),
            **_attitude(log, names, not ned),
            "twist.linear.x": log["u"],
            "twist.linear.y": log["v"] if ned else -log["v"],
            "twist.angular.z": log["r"] if ned else -log["r"],
            "rudder [deg]": np.degrees(log["cmd_delta"]),
        }
    )
    read, marks = _drafted(frame, tmp_path / "log.csv")
    for name in ("x", "y", "u", "v", "r"):
        np.testing.assert_allclose(read[name], log[name], atol=1e-9)
    assert np.cos(read["psi"] - log["psi"]).min() > 1.0 - 1e-9
    assert _guessed(marks, "qw")
    assert _guessed(marks, "x")


def test_rates_beside_a_heading_of_ros_alone(log: Log, tmp_path: Path) -> None:
    names = [f"imu.orientation.{part}" for part in "xyzw"]
    frame = _frame(log, **_attitude(log, names, True), **{"twist.angular.z": -log["r"]})
    read, marks = _drafted(frame, tmp_path / "log.csv")
    np.testing.assert_allclose(read["r"], log["r"], atol=1e-9)
    assert np.cos(read["psi"] - log["psi"]).min() > 1.0 - 1e-9
    assert _guessed(marks, "r")


def test_part_of_a_quaternion_is_refused() -> None:
    entry = {"column": "a", "unit": "-"}
    settings = {"kind": "csv", "time": {"column": "t"}, "channels": {"qx": entry, "qw": entry}}
    with pytest.raises(UsageError, match="add qy, qz"):
        validate(settings, ReaderConfig, "test")


def test_json_lines(log: Log, tmp_path: Path) -> None:
    lines = [
        {
            "stamp": t,
            "nav": {"north": x, "east": y, "heading_deg": math.degrees(psi)},
            "act": {"rudder_deg": [math.degrees(delta)]},
            "scan": list(range(40)),
        }
        for t, x, y, psi, delta in zip(
            log.t, log["x"], log["y"], log["psi"], log["cmd_delta"], strict=True
        )
    ]
    file = tmp_path / "log.jsonl"
    whole = "\n".join(map(json.dumps, lines))
    file.write_text(whole + '\n\n{"stamp": 9')
    read, content, marks = drafted(file)
    assert content["kind"] == "json_lines"
    assert any(finding["code"] == "cut_line" for finding in read.meta["findings"])
    for name in ("x", "y", "psi"):
        np.testing.assert_allclose(read[name], log[name], atol=1e-9)
    np.testing.assert_allclose(read["delta"], log["cmd_delta"], atol=1e-9)
    file.write_text(whole.replace("}\n{", "}\n[1]\n{", 1))
    with pytest.raises(DataError, match=r"line 2, '\[1\]', is no JSON object"):
        draft_tables([file], marks)


@pytest.mark.parametrize("names", [("N [m]", "E [m]"), ("N_m", "E_m")])
def test_n_beside_e_is_north(names: tuple[str, str], log: Log, tmp_path: Path) -> None:
    frame = pd.DataFrame(
        {
            **{"time [s]": log.t, names[0]: log["x"], names[1]: log["y"]},
            **{"heading [deg]": np.degrees(log["psi"]), "rpm": 60.0 * log["cmd_n"]},
        }
    )
    read, marks = _drafted(frame, tmp_path / "log.csv")
    for name in ("x", "y", "psi"):
        np.testing.assert_allclose(read[name], log[name], atol=1e-9)
    np.testing.assert_allclose(read["n"], log["cmd_n"], atol=1e-9)
    assert _guessed(marks, "x")


def test_records_beside_each_other_are_told_from_vessels(log: Log, tmp_path: Path) -> None:
    heading, rudder, rpm = np.degrees(log["psi"]), np.degrees(log["delta"]), 60.0 * log["n"]

    def frame(**changes: dict[str, np.ndarray]) -> pd.DataFrame:
        one = {"u": log["u"], "x": log["x"], "y": log["y"], "psi_deg": heading}
        one |= {"delta_deg": rudder, "n_rpm": rpm}
        columns = {"time_s": log.t}
        for word, change in changes.items():
            columns |= {f"{word}_{name}": part for name, part in (one | change).items()}
        return pd.DataFrame(columns)

    still = {name: np.zeros(len(log)) for name in ("u", "x", "y", "psi_deg", "delta_deg", "n_rpm")}
    for words, told in (
        ({"cmd": {"u": 1.0 + 0.0 * log.t}, "meas": {}}, False),
        ({"alpha": still, "bravo": {}}, True),
    ):
        read, marks = _drafted(frame(**words), tmp_path / "table.csv")
        np.testing.assert_allclose(read["u"], log["u"])
        np.testing.assert_allclose(read["delta"], log["delta"])
        assert any("hold a position each" in text for _, text in marks.guesses) == told


@pytest.mark.parametrize("factor", [1.0, math.degrees(1.0), -60.0 * math.degrees(1.0)])
def test_angles_tell_the_unit_and_the_sign_of_their_rates(
    factor: float, log: Log, tmp_path: Path
) -> None:
    roll = 0.1 * np.sin(log.t)
    rates = {"ROT": factor * log["r"], "rollrate": factor * 0.1 * np.cos(log.t)}
    frame = pd.DataFrame({"t": log.t, "heading [rad]": log["psi"], "roll [rad]": roll, **rates})
    read, marks = _drafted(frame, tmp_path / "log.csv")
    np.testing.assert_allclose(read["r"], log["r"], atol=1e-9)
    np.testing.assert_allclose(read["p"], 0.1 * np.cos(log.t), atol=1e-9)
    said = " ".join(text for _, text in marks.guesses)
    assert ("roll angles say that it is positive to port" in said) == (factor < 0.0)


def test_a_speed_is_that_forward_where_no_heading_is_known(tmp_path: Path) -> None:
    t = np.arange(0.0, 60.0, 0.2)
    speed = 1.0 + 0.5 * np.sin(0.1 * t)
    track = {"lat": 54.3 + np.cumsum(0.2 * speed) / 111_132.0, "lon": np.full(t.size, 10.15)}
    frame = pd.DataFrame({"t": t, **track, "sog [m/s]": speed, "motor1 [%]": 50.0 * speed})
    read, marks = _drafted(frame, tmp_path / "log.csv")
    np.testing.assert_allclose(read["u"], speed)
    assert _guessed(marks, "u")
    frame["course over ground [deg]"] = 0.0
    assert "u" not in _drafted(frame, tmp_path / "log.csv")[0].channels


def test_a_document_of_geojson_holds_fixes(log: Log, tmp_path: Path) -> None:
    latitude, longitude = _fixes(log)
    rudder, rpm = np.degrees(log["delta"]), 60.0 * log["n"]
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [east, north]}}
        | {"properties": {"time": t, "rudder_deg": f"{angle:.3f} deg", "rpm": n}}
        for t, north, east, angle, n in zip(log.t, latitude, longitude, rudder, rpm, strict=True)
    ]
    file = tmp_path / "trip.json"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    read, _, _ = drafted(file)
    _at(read, log)
    np.testing.assert_allclose(read["delta"], log["delta"], atol=1e-4)


def test_a_document_of_several_tables_is_refused(log: Log, tmp_path: Path) -> None:
    motors = {"time": log.t.tolist(), "rpm": (60.0 * log["n"]).tolist()}
    fixes = [{"time": t, "north_m": x} for t, x in zip(log.t[::5], log["x"][::5], strict=True)]
    notes = [{"crew": "Ada"}, {"crew": "Bo"}]
    file = tmp_path / "trip.json"
    file.write_text(json.dumps({"motors": motors, "gnss": fixes, "notes": notes}))
    with pytest.raises(DataError, match=r"several tables, motors \(\d+ rows\), gnss \(\d+ rows\);"):
        draft_tables([file], Marks())


@pytest.fixture(scope="module")
def breeze(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Speed in m/s of a true wind in gusts, and where it comes from in rad."""
    return 6.0 + np.sin(0.3 * log.t), 1.0 + 0.05 * np.cos(0.2 * log.t)


@pytest.mark.parametrize("pose", [True, False], ids=["heading", "yaw rate alone"])
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["clockwise", "anticlockwise"])
def test_a_wind_from_the_bow_by_cosine_and_sine_becomes_the_true_wind(
    log: Log, breeze: tuple[np.ndarray, np.ndarray], tmp_path: Path, side: float, pose: bool
) -> None:
    speed, direction = breeze
    angle = side * (direction - log["psi"])
    columns = {name: log[name] for name in ("u", "v", "r")}
    columns |= {"psi": log["psi"]} if pose else {}
    columns |= {"Vw": speed, "alpha_x": np.cos(angle), "alpha_y": np.sin(angle)}
    rudders = {"deltal": log["delta"], "deltar": 0.9 * log["delta"], "n": log["n"]}
    frame = pd.DataFrame({"time": log.t, **columns, **rudders})
    read, marks = _drafted(frame, tmp_path / "ship.tab", sep="\t")
    assert {"delta_port", "delta_stbd", "n"} <= read.channels.keys()
    np.testing.assert_allclose(read["wind_speed"], speed)
    begin = 0.0 if pose else log["psi"][0]
    np.testing.assert_allclose(
        np.exp(1j * read["wind_dir"]), np.exp(1j * (direction - begin)), atol=0.02
    )
    assert _guessed(marks, "wind_angle_cos")


def test_what_the_own_speed_adds_is_taken_from_an_apparent_wind(
    log: Log, breeze: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    speed, direction = breeze
    felt = speed * np.exp(1j * (direction - log["psi"])) + log["u"] + 1j * log["v"]
    columns = {name: log[name] for name in ("x", "y", "psi", "u", "v", "r")}
    for names in (("AWS [m/s]", "AWA [deg]"), ("wind speed [m/s]", "wind direction [deg]")):
        wind = dict(zip(names, (np.abs(felt), np.degrees(np.angle(felt))), strict=True))
        read, _ = _drafted(_frame(log, **columns, **wind), tmp_path / "ship.csv")
        np.testing.assert_allclose(read["wind_speed"], speed, rtol=1e-6)
        np.testing.assert_allclose(np.exp(1j * read["wind_dir"]), np.exp(1j * direction), atol=1e-6)


def test_a_heading_by_cosine_and_sine_is_a_heading(log: Log, tmp_path: Path) -> None:
    columns = {"x": log["x"], "y": log["y"]}
    columns |= {"cos(psi)": np.cos(log["psi"]), "sin(psi)": np.sin(log["psi"])}
    read, _ = _drafted(_frame(log, **columns), tmp_path / "ship.csv")
    np.testing.assert_allclose(np.exp(1j * read["psi"]), np.exp(1j * log["psi"]), atol=1e-9)


def test_a_model_basin_names_its_columns_by_groups_and_its_time_not_at_all(
    log: Log, tmp_path: Path
) -> None:
    columns = {"Hull/Acc/Z3": 0.01 * np.sin(log.t), "Prop/PS/Rpm": 60.0 * log["n"]}
    columns |= {"Rudder/Angle": np.degrees(log["delta"]), "Rudder/MaxAngle": 35.0 + 0.0 * log.t}
    columns |= {"psi": log["psi"], "x0": log["x"], "y0": log["y"], "z0": 0.01 * np.cos(log.t)}
    frame = pd.DataFrame(columns, index=log.t)
    file = tmp_path / "22605.csv"
    frame.to_csv(file)
    read, _, _ = drafted(file)
    np.testing.assert_allclose(read.t, log.t, atol=1e-6)
    for name in ("x", "y", "psi", "delta"):
        np.testing.assert_allclose(read[name], log[name], atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["wind_dir", "wind_angle", "apparent_wind_angle"])
def test_a_wind_is_told_by_what_makes_the_true_wind_steady(
    kind: str, seed: int, tmp_path: Path
) -> None:
    random = np.random.default_rng(seed)
    t = np.arange(0.0, random.uniform(100.0, 400.0), 0.5)

    def wandering(size: float, time: float) -> np.ndarray:
        steps = random.normal(size=t.size) * size * np.sqrt(1.0 / time)
        kept = np.exp(-0.5 / time)
        return np.array([*accumulate(steps, lambda last, step: kept * last + step)])

    own = random.uniform(1.0, 8.0)
    r = np.radians(wandering(random.uniform(2.0, 6.0), 15.0))
    psi, u, v = np.cumsum(r) * 0.5, own + wandering(0.1 * own, 20.0), wandering(0.03 * own, 5.0)
    ground = np.exp(1j * psi) * (u + 1j * v)
    place = np.cumsum(ground) * 0.5
    mean = random.uniform(2.0, 12.0)
    true = np.maximum(mean + wandering(0.15 * mean, 15.0), 0.1)
    true = true * np.exp(1j * (random.uniform(-3.0, 3.0) + wandering(0.15, 30.0)))
    wind = {
        "wind_dir": true,
        "wind_angle": true * np.exp(-1j * psi),
        "apparent_wind_angle": (true + ground) * np.exp(-1j * psi),
    }[kind]
    columns = {"time [s]": t, "x [m]": place.real, "y [m]": place.imag}
    columns |= {"heading [deg]": np.degrees(psi) % 360.0, "rudder [deg]": np.degrees(r)}
    columns |= {"wind speed [m/s]": np.abs(wind)}
    columns |= {"wind direction [deg]": np.degrees(np.angle(wind)) % 360.0}
    file = tmp_path / "wind.csv"
    pd.DataFrame(columns).to_csv(file, index=False)
    assert kind in draft_tables([file], Marks())[0]["channels"]


def test_the_wind_that_is_felt_is_made_true_by_velocities_that_a_smoother_finds(
    log: Log, breeze: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    speed, direction = breeze
    felt = speed * np.exp(1j * (direction - log["psi"])) + log["u"] + 1j * log["v"]
    columns = {name: log[name] for name in ("x", "y", "psi", "r")}
    wind = {"AWS [m/s]": np.abs(felt), "AWA [deg]": np.degrees(np.angle(felt))}
    read, _ = _drafted(_frame(log, **columns, **wind), tmp_path / "ship.csv")
    assert "wind_dir" not in read.channels
    inputs = ("delta", "n", "wind_speed", "wind_dir")
    named = residnet.inspect([read], inputs=inputs)
    assert named.text.str.contains("apparent_wind_angle").any()
    made = complete_motion(read, MotionConfig())
    off = np.exp(1j * made["wind_dir"]) - np.exp(1j * direction)
    assert float(np.abs(off).mean()) < 0.05


def test_a_channels_own_name_goes_before_others(log: Log, tmp_path: Path) -> None:
    psi, ground = log["psi"], np.exp(1j * log["psi"]) * (log["u"] + 1j * log["v"])
    fixed = dict.fromkeys(("lat (rad)", "lon (rad)"), np.full(len(log), 0.7))
    along = {"vx (m/s)": ground.real, "vy (m/s)": ground.imag}
    own = {"u (m/s)": log["u"], "v (m/s)": log["v"]}
    azimuth = {"Thruster_Azimuth_deg": np.degrees(log["delta"])}
    place = {"x (m)": log["x"], "y (m)": log["y"], "psi (rad)": psi}
    frame = _frame(log, **fixed, **place, **along, **own, **azimuth)
    read, marks = _drafted(frame, tmp_path / "log.csv")
    for name in ("u", "v", "x", "y"):
        np.testing.assert_allclose(read[name], log[name], atol=1e-9)
    assert "latitude" not in read.channels
    np.testing.assert_allclose(read["azimuth"], log["delta"], atol=1e-9)
    assert not _guessed(marks, "azimuth")


def test_a_folder_of_messages_whose_values_come_in_turns(log: Log, tmp_path: Path) -> None:
    clock = "timestamp (seconds since 01/01/1970)"
    for number in range(2):
        folder, t = tmp_path / f"20250614_10{number}005_auv", 1_750_000_000.0 + 900.0 * number
        folder.mkdir()
        motion = {f" {name} ({unit})": log[name] for name, unit in (("x", "m"), ("y", "m"))}
        motion[" psi (rad)"] = (log["psi"] + np.pi) % (2.0 * np.pi) - np.pi
        about = {clock: t + log.t, " system": "auv", " entity": "Navigation"}
        state = pd.DataFrame(about | motion)
        state.to_csv(folder / "EstimatedState.csv", index=False)
        fins = [
            pd.DataFrame({clock: t + log.t + 0.01 * k, " id": k, " value (rad)": value})
            for k, value in enumerate((-log["delta"], 0.3 * np.sin(0.2 * log.t)))
        ]
        together = pd.concat(fins).sort_values(clock)
        together.to_csv(folder / "SetServoPosition.csv", index=False)
        motor = pd.DataFrame({clock: t + log.t, " value (rpm)": np.round(60.0 * log["n"])})
        motor.to_csv(folder / "Rpm.csv", index=False)
        pd.DataFrame({clock: t + log.t, " value (V)": 25.0}).to_csv(folder / "Voltage.csv")
    logs = residnet.read_logs(tmp_path)
    assert len(logs) == 2
    read = logs[0]
    assert read.units["servo_1"] == read.units["servo_2"] == "rad"
    # what the folder that holds them is called says nothing of its messages
    (alone,) = residnet.read_logs(shutil.copytree(folder, tmp_path / "one" / folder.name).parent)
    assert {*alone.channels} == {*read.channels}
    inner = slice(20, -20)
    at = np.interp(read.t - read.t[0], log.t, log["delta"])[inner]
    assert np.corrcoef(read["servo_1"][inner], -at)[0, 1] > 0.99
    np.testing.assert_allclose(np.nanmax(read["n"]), np.round(60 * log["n"].max()) / 60, rtol=1e-6)


def test_thrusters_that_no_number_tells_apart_are_one_each(log: Log, tmp_path: Path) -> None:
    columns = {name: log[name] for name in ("x", "y", "psi")}
    called = [f"cmd_thrust_{end}_{side}" for end in ("fore", "aft") for side in ("port", "stbd")]
    called += [f"cmd_thrust_lift_{one.removeprefix('cmd_thrust_')}" for one in called]
    forces = {one: np.sin((0.1 + 0.02 * k) * log.t) for k, one in enumerate(called)}
    read, marks = _drafted(pd.DataFrame({"t": log.t, **columns, **forces}), tmp_path / "rov.csv")
    inputs = [name for name in read.channels if name.startswith("thrust")]
    assert len(inputs) == len(called)
    for one in called:
        assert any(np.array_equal(read[name], forces[one]) for name in inputs)
    assert _guessed(marks, "thrust_port_cmd_1")
    # of a rudder that is told several times one is read, by its own name
    again = {f"rudder {one} [deg]": np.degrees(log["delta"]) + 1.0 for one in ("port tank", "two")}
    read, _ = _drafted(_frame(log, **columns).assign(**again), tmp_path / "boat.csv")
    assert [name for name in read.channels if name.startswith("delta")] == ["delta"]
    np.testing.assert_allclose(read["delta"], log["delta"], atol=1e-9)


def test_logs_with_other_columns_beside_each_other_are_no_messages(
    log: Log, tmp_path: Path
) -> None:
    for k in range(4):
        columns = {"Time [s]": log.t, "speed [m/s]": log["u"], "motor rps": log["n"]}
        columns |= {"battery [V]": 24.0 - 0.01 * log.t} if k % 2 else {}
        pd.DataFrame(columns).to_csv(tmp_path / f"run_{k}.csv", index=False)
    assert len(residnet.read_logs(tmp_path)) == 4


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["dives", "rises"])
def test_planes_are_told_by_the_pitch_that_they_hold(tmp_path: Path, side: float) -> None:
    random, t = np.random.default_rng(3), np.arange(0.0, 120.0, 0.1)
    planes = random.uniform(-0.2, 0.2, 31)[(t / 4.0).astype(int)]
    theta, q = np.zeros(t.size), np.zeros(t.size)
    for k in range(t.size - 1):
        # the pitch rate is gone by the end of most holds, the pitch is not
        turn = -1.5 * q[k] - 0.9 * np.sin(theta[k]) - 0.5 * planes[k]
        theta[k + 1], q[k + 1] = theta[k] + 0.1 * q[k], q[k] + 0.1 * turn
    u, heave = 1.5 + 0.1 * np.sin(0.2 * t), -0.2 * q
    down = heave * np.cos(theta) - u * np.sin(theta)
    frame = pd.DataFrame(
        {
            "Zeit [s]": t,
            "Fahrt [m/s]": u,
            "heave velocity [m/s]": heave,
            "pitch rate [deg/s]": np.degrees(q),
            "pitch [deg]": np.degrees(theta + 1e-4 * random.normal(size=t.size)),
            "Tiefe [m]": 10.0 + 0.1 * np.cumsum(down),
            "Tiefenruder [deg]": np.degrees(side * planes),
            "rpm": 900.0 + 50.0 * np.cos(0.2 * t),
        }
    )
    frame.to_csv(file := tmp_path / "dive.csv", index=False)
    read = read_drafted([file], Marks()).logs[file]
    assert {"u", "w", "q", "theta", "z", "delta_s", "n"} <= read.channels.keys()
    assert "v" not in read.channels
    np.testing.assert_allclose(read["delta_s"], planes, atol=1e-6)
