"""Channel maps from tables that nobody described: names, units, signs and axes are found again,
and are the same through every door of residnet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import foreign_tables
import numpy as np
import pandas as pd
import pytest
import yaml
from drafted_logs import assert_read
from fleets import drawn
from foreign_tables import CHANNELS, NAMES, Style

import residnet
from residnet.core.config import validate_config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.questions import DraftNotes, Question
from residnet.io.drafting.tables import draft_tables
from residnet.io.header_vocabulary import (
    guess_scaling,
    match_depth_channel,
    match_input_channel,
    match_state_channel,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers import ReaderConfig
from residnet.io.readers.quantities import FieldMap
from residnet.tasks.inspection import inspect_logs

GERMAN = Style(
    language="German",
    units={"psi": "°", "u": "kn", "v": "kn", "r": "°/min", "delta": "°", "n": "U/min"},
    delimiter=";",
    decimal=",",
    dates="%d.%m.%Y %H:%M:%S,%f",
    encoding="cp1252",
)

pytestmark = pytest.mark.usefixtures("omit_currents")
STYLES = {
    "SI without units": Style(told=False),
    "degrees without units": Style(
        told=False, units={"psi": "deg", "r": "deg/s", "delta": "deg", "n": "rpm"}
    ),
    "knots and minutes without units": Style(
        told=False, units={"psi": "deg", "u": "kn", "v": "kn", "r": "°/min", "delta": "deg"}
    ),
    "port is positive": Style(told=False, signs=("v", "r")),
    "German": GERMAN,
    "Japanese": Style(
        language="Japanese",
        units={"psi": "°", "u": "kn", "v": "kn", "r": "deg/s", "delta": "deg", "n": "rpm"},
        encoding="cp932",
    ),
    "French": Style(language="French", units={"u": "km/h", "v": "km/h"}, delimiter=";"),
    "Dutch": Style(language="Dutch", units={"psi": "deg", "n": "1/min"}, delimiter="\t"),
}


@pytest.fixture
def logs(ship_logs: list[Log]) -> list[Log]:
    return ship_logs


@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES.keys())
def test_draft_tables_reads_a_table_as_written(
    style: Style, logs: list[Log], tmp_path: Path
) -> None:
    files = foreign_tables.write(logs, tmp_path, style)
    marks = DraftNotes()
    content, _ = draft_tables(files, marks)
    reader = validate_config(content, ReaderConfig, "here").build()
    for file, log in zip(files, logs, strict=True):
        for name in set(CHANNELS) & set(log.channels):
            size = float(np.abs(log[name]).max()) + 1e-3
            assert_read(reader.read(file), {name: log[name]}, 1e-6 * size)
    told = {".".join(key) for key, _ in marks.guessed_values}
    if not style.told:
        assert {f"data.reader.channels.{name}" for name in ("psi", "u", "r", "delta")} <= told


def test_draft_tables_accepts_large_headings_in_radians(logs: list[Log], tmp_path: Path) -> None:
    """Its size says degrees, and only the motion tells that it is not."""
    turning = logs[1]
    assert float(np.ptp(turning["psi"])) > 7.0
    columns = {"t": turning.t, **{name: turning[name] for name in ("x", "y", "psi", "u", "v", "r")}}
    pd.DataFrame(columns).to_csv(tmp_path / "turn.csv", index=False)
    channels = draft_tables([tmp_path / "turn.csv"], DraftNotes())[0]["channels"]
    assert (channels["psi"]["unit"], channels["r"]["unit"]) == ("rad", "rad/s")


@pytest.mark.parametrize("language", NAMES)
def test_parse_name_of_a_language(language: str) -> None:
    time, *columns = NAMES[language]
    assert parse_name(time).has_all("time")
    found = [
        match_state_channel(parse_name(name)) or match_input_channel(parse_name(name))
        for name in columns
    ]
    assert found == list(CHANNELS)


CALLED: dict[str | None, str] = {
    "apparent_wind_angle": "wind_dir_relative_mid [rad]|scheinbare Windrichtung [°]|AWA",
    "wind_speed": "wind_velo_true [m/s]|TWS|wind speed x",
    None: "Kurs über Grund [°]|course over ground|alloc_age|lateral acceleration"
    "|Battery_V|cooling fan [%]|engine temperature [°C]|engine load|oil pressure main engine"
    "|twist.linear.z|v_z|ang_vel_x|angular_velocity_y|mocap_z",
    "speed": "speed over ground [kn]|speed through water|nopeus",
    "v": "speed to starboard [kn]|Vy [m/s]|SpeedTrans_kn|pose.twist.linear.y",
    "cmd_delta": "rudder_cmd|Ruderlage soll|Rudersollwinkel",
    "n_port": "engine rpm port|left_rpm|Motor L (%)|/tug/thruster/port/state.rpm",
    "tau_n_estimate": "tau_n_est",
    "p": "roll rate|p_dps|p_degps",
    "latitude": "Latitude",
    "u": "Longitudinal velocity|Velocidad longitudinal|vx|velocity_x_mps|twist.linear.x"
    "|Long. speed|dvl_vx_mm_s",
    "thrust_stbd": "thruster right",
    "cmd_thrust_port": "/thrusters/left/cmd/data",
    "wind_dir": "TWD",
    "x": "X_CG|xcog|mocap_x|x_m|north_m|local_x|Nordposition [m]|pos_n|Nordwert [m]",
    "y": "Posición Y|Ostposition [m]|Ost-Koordinate|Rechtswert|Ostwert [m]|Ostkoordinate",
    "r": "Taux de virage|yaw rate r|旋回角速度|IMU.GyrZ|SCALED_IMU.zgyro|r_dps"
    "|yaw_rate_degps|r_radps|r_rps|gyro_z_rads|ang_vel_z|girrate",
    "delta": "steering angle|styreutslag",
    "cmd_port": "u_left",
    "n": "Istdrehzahl [U/min]|Motordrehzahl [1/min]|erpm",
    "servo_3": "servo3_raw",
    "n_stbd": "Motor R (%)|right_fan [%]",
    "throttle_port": "thr_port",
    "psi": "Gyro [deg]|Stävriktning|船首角",
    "longitude": "Longitudine",
    "throttle": "Gashendel|Propeller pitch [deg]|CPP [%]",
    "azimuth_diff": "azi_diff_deg",
    "n_bow": "rpm_fwd",
}


@pytest.mark.parametrize("channel", CALLED)
def test_match_channel_of_names(channel: str | None) -> None:
    about = {name: parse_name(name) for name in CALLED[channel].split("|")}
    found = {name: match_state_channel(w) or match_input_channel(w) for name, w in about.items()}
    assert found == dict.fromkeys(about, channel)


@pytest.mark.parametrize(
    ("name", "channel"),
    [("v_z", "w"), ("wx", "p"), ("ang_vel_y", "q"), ("mocap_z", "z"), ("Z_CG [m]", "z")],
)
def test_match_depth_channel_of_names(name: str, channel: str) -> None:
    assert match_depth_channel(parse_name(name)) == channel


@pytest.mark.parametrize(
    ("column", "expected", "unit"),
    [
        ("r [°/min]", "rad/s", "deg/min"),
        ("yaw_rate_deg_s", "rad/s", "deg/s"),
        ("yaw_rate_degps", "rad/s", "deg/s"),
        ("r_radps", "rad/s", "rad/s"),
        ("r_rps", "rad/s", "rad/s"),
        ("n_rps", "1/s", "1/s"),
        ("time_s", "s", "s"),
        ("time_ms", "s", "ms"),
        ("u_ms", "m/s", "m/s"),
        ("speed_kn", "m/s", "kn"),
        ("x_m", "m", "m"),
        ("north_m", "m", "m"),
        ("thrust_n", "N", "N"),
        ("tau_n_nm", "N m", "N m"),
        ("ax_mps2", "m/s^2", "m/s^2"),
        ("pos_n", "m", None),
        ("RollRate_deg_per_s", "rad/s", "deg/s"),
        ("ROT_degmin", "rad/s", "deg/min"),
        ("speed (kn)", "m/s", "kn"),
        ("heading deg", "rad", "deg"),
        ("gz_mdps", "rad/s", "mdeg/s"),
        ("Winkel [Grad]", "rad", "deg"),
        ("n [U/min]", "1/s", "1/min"),
        ("course", "rad", None),
        ("tau_n", "N m", None),
    ],
)
def test_parse_header_unit_of_names(column: str, expected: str, unit: str | None) -> None:
    assert parse_header_unit(column, expected) == unit


def test_letters_of_sides_need_their_pair(tmp_path: Path) -> None:
    names = ["Azimuth P [deg]", "Azimuth S [deg]", "Pitch P [%]", "Pitch S [%]", "Engine P [%]"]
    channels = match_channels([*names, "p [deg/s]", "s [m]"], DraftNotes())
    assert channels.pop("p") == "p [deg/s]"
    suffixes = ("port", "stbd")
    expected = [f"{name}_{side}" for name in ("azimuth", "throttle") for side in suffixes]
    assert [channels.pop(name) for name in expected] == names[:4]
    assert [*channels] == ["throttle"]


def test_a_speed_through_water_is_the_surge_velocity() -> None:
    names = ["Heading [deg]", "SOG [kn]", "COG [deg]", "STW [kn]", "Rudder [deg]"]
    assert match_channels(names, DraftNotes())["u"] == "STW [kn]"
    assert match_channels(names[:3], DraftNotes())["u"] == "SOG [kn]"


def test_an_azimuth_is_unwrapped() -> None:
    true_angle = np.radians(np.linspace(-30.0, 20.0, 40))
    recorded = np.degrees(true_angle) % 360.0
    recorded[7] = np.nan
    converted = FieldMap(field="a", unit="deg").convert("azimuth_port", recorded)
    assert np.isnan(converted[7])
    np.testing.assert_allclose(np.delete(converted, 7), np.delete(true_angle, 7), atol=1e-12)
    # a range without its end stays as it is
    steady = FieldMap(field="a", unit="deg").convert("azimuth_port", recorded[:20])
    assert float(np.nanmin(steady)) > np.pi


def test_a_nozzle_in_per_cent_is_no_angle_in_degrees() -> None:
    values = np.linspace(-60.0, 60.0, 50)
    scaling = guess_scaling("azimuth_port", "Nozzle Port [%]", values)
    assert scaling is not None
    assert scaling.settings == {"unit": "deg", "scale": 0.35}
    assert guess_scaling("azimuth_port", "azimuth port", values) is None


def test_draft_tables_recognises_exchanged_axis_letters(logs: list[Log], tmp_path: Path) -> None:
    # x east, y north, heading counter-clockwise from east, velocities forward and to port
    log = logs[0]
    new = {"x": log["y"], "y": log["x"], "psi": np.pi / 2 - log["psi"]}
    new |= {name: -log[name] for name in ("v", "r")}
    turned = [log.replace(channels={**log.channels, **new})]
    names = dict(zip(NAMES["English"][1:3], ("x", "y"), strict=True))
    files = foreign_tables.write(turned, tmp_path, Style())
    for file in files:
        head, _, rest = file.read_text().partition("\n")
        for old, letter in names.items():
            head = head.replace(old, letter)
        file.write_text(f"{head}\n{rest}")
    marks = DraftNotes()
    channels = draft_tables(files, marks)[0]["channels"]
    # the mirror image fits as well, and is marked
    assert (channels["x"]["column"], "frame" in channels["psi"]) == ("x [m]", False)
    assert "data.reader.channels.x" in {".".join(key) for key, _ in marks.guessed_values}


def test_draft_tables_asks_about_a_wrong_header_unit(logs: list[Log], tmp_path: Path) -> None:
    files = foreign_tables.write(logs, tmp_path, Style(units={"r": "°/min"}))
    for file in files:
        file.write_text(file.read_text().replace("[°/min]", "[deg/s]"))
    asked: list[Question] = []

    def answer(question: Question) -> str:
        asked.append(question)
        return question.default

    content = draft_tables(files, DraftNotes(answer))[0]
    assert content["channels"]["r"]["unit"] == "deg/min"
    assert [question.options for question in asked] == [("deg/min", "deg/s")]
    marks = DraftNotes()
    draft_tables(files, marks)
    assert any("the header has deg/s" in text for _, text in marks.guessed_values)


def _told(work: Callable[..., object], files: Sequence[Path]) -> dict[str, Any]:
    """The map that a function of Python reports to whoever listens."""
    lines: list[str] = []
    work(files, lambda told: lines.append(told.message))
    begun = next(i for i, line in enumerate(lines) if "guessed channel map" in line)
    drafted = takewhile(lambda line: line.startswith("  "), lines[begun + 1 :])
    text = "\n".join(line.removeprefix("  ") for line in drafted)
    return dict(yaml.safe_load(text)["data"]["reader"])


def _doors(files: Sequence[Path]) -> dict[str, dict[str, Any]]:
    shown = inspect_logs(files, None).text.partition("paste into a config:\n")[2]
    return {
        "new": residnet.draft_config(files).config["data"]["reader"],
        "inspect": yaml.safe_load(shown)["data"]["reader"],
        "read_logs": _told(lambda f, hear: residnet.read_logs(f, progress=hear), files),
        "fit": _told(lambda f, hear: residnet.prepare(f, ["delta", "n"], progress=hear), files),
    }


# `test_draft_tables_reads_a_table_as_written` reads dates and German names among the fast tests
@pytest.mark.parametrize("dated", [pytest.param(True, marks=pytest.mark.long), False])
def test_channel_map_is_equal_in_all_commands(dated: bool, logs: list[Log], tmp_path: Path) -> None:
    degrees = {"psi": "deg", "r": "deg/s", "delta": "deg", "n": "rpm"}
    style = GERMAN if dated else Style(units=degrees, signs=("delta",))
    files = foreign_tables.write(logs, tmp_path, style)
    for file in files[: 0 if dated else None]:
        table = pd.read_csv(file)
        table["time"] = 1_717_000_000_000 + np.rint(1e3 * table["time"]).astype(int)
        table.to_csv(file, index=False)
    found = _doors(files)
    for door, reader in found.items():
        assert reader == found["new"], door
    for log, truth in zip(residnet.read_logs(files), logs, strict=True):
        np.testing.assert_allclose(log.t - log.t[0], truth.t - truth.t[0], atol=1e-3)


def test_read_logs_keeps_logs_without_roll(tmp_path: Path) -> None:
    t = np.arange(0.0, 20.0, 0.1)
    for number in range(3):
        table = pd.DataFrame({"t": t, "surge [m/s]": 1.0 + 0.1 * np.sin(t), "rudder [deg]": t % 7})
        table["roll [deg]"] = np.nan if number == 1 else 3.0 * np.sin(t)
        table.insert(0, "spare", np.nan if number == 1 else np.cos(t))
        table.to_csv(tmp_path / f"run_{number}.csv", index=False)
    logs = residnet.read_logs(tmp_path)
    assert [sorted(log.channels) for log in logs] == [["delta", "u"]] * 3
    (tmp_path / "stopped.csv").write_text("t,surge [m/s],rudder [deg]\n")
    with pytest.raises(DataError, match="no row of numbers below it"):
        residnet.read_logs(tmp_path / "stopped.csv")


@pytest.mark.parametrize(
    ("volts", "thrusters"),
    [("batt_v", ("Schub BB [%]", "Schub StB [%]")), ("xx_v", ("left_pct", "right_pct"))],
)
def test_draft_tables_excludes_volts_and_per_cents(
    logs: list[Log], tmp_path: Path, volts: str, thrusters: tuple[str, str]
) -> None:
    """By the name where it says so, else by what position and heading tell."""
    log = logs[0]
    file = tmp_path / "log.csv"
    columns = {
        "t": log.t,
        "North [m]": log["x"],
        "East [m]": log["y"],
        "hdg [deg]": np.degrees(log["psi"]) % 360.0,
        volts: 49.0 + 0.1 * np.sin(log.t),
        thrusters[0]: np.linspace(0.0, 100.0, len(log)),
        thrusters[1]: np.linspace(100.0, 0.0, len(log)),
    }
    pd.DataFrame(columns).to_csv(file, index=False)
    channels = draft_tables([file], DraftNotes())[0]["channels"]
    assert channels.keys() == {"x", "y", "psi", "throttle_port", "throttle_stbd"}
    assert channels["throttle_port"] == {"column": thrusters[0], "unit": "%"}


def test_draft_tables_resolves_mirror_image_by_thrusters(tmp_path: Path) -> None:
    """A camera's x ahead and y to the left, headings anticlockwise, as in a laboratory."""
    (fleet,) = drawn("twin", 14, 1, fewest=3, most=3)
    files = [tmp_path / f"{log.name}.csv" for log in fleet.logs]
    for file, log in zip(files, fleet.logs, strict=True):
        camera = {"t": log.t, "x [m]": log["x"], "y [m]": -log["y"], "yaw [rad]": -log["psi"]}
        thrust = {"left [1/s]": log["n_port"], "right [1/s]": log["n_stbd"]}
        pd.DataFrame({**camera, **thrust}).to_csv(file, index=False)
    channels = draft_tables(files, DraftNotes())[0]["channels"]
    assert {name: channels[name]["column"] for name in ("x", "y")} == {"x": "y [m]", "y": "x [m]"}
    assert channels["psi"]["frame"] == "enu"


def test_draft_tables_finds_gyro_unit_with_a_reversed_log(tmp_path: Path) -> None:
    """A slow ship, in deg/s without a unit: by their size alone they would be rad/s."""
    (fleet,) = drawn("twin", 14, 1, fewest=3, most=3)
    for log, way in zip(fleet.logs, (1.0, 1.0, -1.0), strict=True):
        pose = {"t": 20.0 * log.t, "x [m]": log["x"], "y [m]": log["y"], "psi [rad]": log["psi"]}
        rate = {"gyro_z": way * np.degrees(log["r"]) / 20.0, "rudder": np.zeros(len(log))}
        pd.DataFrame({**pose, **rate}).to_csv(tmp_path / f"{log.name}.csv", index=False)
    channels = draft_tables(sorted(tmp_path.glob("*.csv")), DraftNotes())[0]["channels"]
    assert channels["r"] == {"column": "gyro_z", "unit": "deg/s"}
