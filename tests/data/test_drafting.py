"""Channel maps from tables that nobody described: names, units, signs and axes are found again."""

from __future__ import annotations

from pathlib import Path

import foreign_tables
import numpy as np
import pandas as pd
import pytest
from foreign_tables import CHANNELS, NAMES, Style

from residnet.core.config import validate
from residnet.core.log import Log
from residnet.data.drafting.questions import Marks, Question
from residnet.data.drafting.tables import draft_tables
from residnet.data.drafting.words import input_channel, state_channel, words_of, written_unit
from residnet.data.readers import ReaderConfig

GERMAN = Style(
    language="German",
    units={"psi": "°", "u": "kn", "v": "kn", "r": "°/min", "delta": "°", "n": "U/min"},
    delimiter=";",
    decimal=",",
    dates="%d.%m.%Y %H:%M:%S,%f",
    encoding="cp1252",
)
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
def test_a_table_is_read_as_it_was(style: Style, logs: list[Log], tmp_path: Path) -> None:
    files, marks = foreign_tables.write(logs, tmp_path, style), Marks()
    content, _ = draft_tables(files, marks)
    reader = validate(content, ReaderConfig, "here").build()
    for file, truth in zip(files, logs, strict=True):
        read = reader.read(file)
        for name in set(CHANNELS) & set(truth.channels):
            there, was = read[name], truth[name]
            if name == "psi":
                there = there - 2 * np.pi * np.rint((there[0] - was[0]) / (2 * np.pi))
            size = float(np.abs(was).max()) + 1e-3
            np.testing.assert_allclose(there, was, atol=1e-6 * size, err_msg=name)
    told = {".".join(key) for key, _ in marks.guesses}
    if not style.told:
        assert {f"data.reader.channels.{name}" for name in ("psi", "u", "r", "delta")} <= told


def test_a_heading_that_is_not_wrapped_may_be_large_in_radians(
    logs: list[Log], tmp_path: Path
) -> None:
    """Its size says degrees, and only the motion tells that it is not."""
    turning = logs[1]
    assert float(np.ptp(turning["psi"])) > 7.0
    columns = {"t": turning.t, **{name: turning[name] for name in ("x", "y", "psi", "u", "v", "r")}}
    pd.DataFrame(columns).to_csv(tmp_path / "turn.csv", index=False)
    channels = draft_tables([tmp_path / "turn.csv"], Marks())[0]["channels"]
    assert (channels["psi"]["unit"], channels["r"]["unit"]) == ("rad", "rad/s")


def test_letters_of_axes_are_told_by_their_units(logs: list[Log], tmp_path: Path) -> None:
    """`N [m]` is no propeller, and `X [kN]` no place."""
    log = logs[0]
    columns = {"t [s]": log.t, "N [m]": log["x"], "E [m]": log["y"], "X [kN]": log["n"]}
    columns |= {"HDG [deg]": np.degrees(log["psi"]) % 360.0, "left rpm": 60.0 * log["n"]}
    pd.DataFrame(columns).to_csv(tmp_path / "turn.csv", index=False)
    channels = draft_tables([tmp_path / "turn.csv"], Marks())[0]["channels"]
    found = {name: entry["column"] for name, entry in channels.items()}
    assert found == {"x": "N [m]", "y": "E [m]", "psi": "HDG [deg]", "n_port": "left rpm"}


@pytest.mark.parametrize("language", NAMES)
def test_words_of_a_language(language: str) -> None:
    time, *columns = NAMES[language]
    assert words_of(time).has("time")
    found = [state_channel(words_of(name)) or input_channel(words_of(name)) for name in columns]
    assert found == list(CHANNELS)


CALLED: dict[str | None, str] = {
    "apparent_wind_angle": "wind_dir_relative_mid [rad]|scheinbare Windrichtung [°]|AWA",
    "wind_speed": "wind_velo_true [m/s]|TWS|wind speed x",
    None: "Kurs über Grund [°]|course over ground|alloc_age|lateral acceleration"
    "|Battery_V|engine temperature [°C]|engine load|oil pressure main engine"
    "|twist.linear.z",
    "speed": "speed over ground [kn]|speed through water",
    "v": "speed to starboard [kn]|Vy [m/s]|SpeedTrans_kn|pose.twist.linear.y",
    "cmd_delta": "rudder_cmd|Ruderlage soll|Rudersollwinkel",
    "n_port": "engine rpm port|left_rpm|Motor L (%)",
    "tau_n_estimate": "tau_n_est",
    "p": "roll rate",
    "latitude": "Latitude",
    "u": "Longitudinal velocity|Velocidad longitudinal|vx|velocity_x_mps|twist.linear.x"
    "|Long. speed",
    "thrust_stbd": "thruster right",
    "wind_dir": "TWD",
    "x": "local_x|Nordposition [m]|pos_n|Nordwert [m]",
    "y": "Posición Y|Ostposition [m]|Ost-Koordinate|Rechtswert|Ostwert [m]|Ostkoordinate",
    "r": "Taux de virage|yaw rate r|旋回角速度",
    "delta": "steering angle",
    "n": "Istdrehzahl [U/min]|Motordrehzahl [1/min]|erpm",
    "servo_3": "servo3_raw",
    "n_stbd": "Motor R (%)",
    "throttle_port": "thr_port",
    "psi": "Gyro [deg]|Stävriktning|船首角",
    "longitude": "Longitudine",
    "throttle": "Gashendel",
}


@pytest.mark.parametrize("channel", CALLED)
def test_what_a_name_is_about(channel: str | None) -> None:
    about = {name: words_of(name) for name in CALLED[channel].split("|")}
    found = {name: state_channel(w) or input_channel(w) for name, w in about.items()}
    assert found == dict.fromkeys(about, channel)


@pytest.mark.parametrize(
    ("column", "expected", "unit"),
    [
        ("r [°/min]", "rad/s", "deg/min"),
        ("yaw_rate_deg_s", "rad/s", "deg/s"),
        ("RollRate_deg_per_s", "rad/s", "deg/s"),
        ("ROT_degmin", "rad/s", "deg/min"),
        ("speed (kn)", "m/s", "kn"),
        ("heading deg", "rad", "deg"),
        ("Winkel [Grad]", "rad", "deg"),
        ("n [U/min]", "1/s", "1/min"),
        ("course", "rad", None),
        ("tau_n", "N m", None),
    ],
)
def test_the_unit_in_a_header(column: str, expected: str, unit: str | None) -> None:
    assert written_unit(column, expected) == unit


def test_axes_that_are_called_by_letters(logs: list[Log], tmp_path: Path) -> None:
    # x east, y north, heading counter-clockwise from east, velocities forward and to port
    turned = []
    for log in logs:
        new = {
            **log.channels,
            "x": log["y"],
            "y": log["x"],
            "psi": np.pi / 2 - log["psi"],
            "v": -log["v"],
            "r": -log["r"],
        }
        turned.append(log.replace(channels=new))
    names = dict(zip(NAMES["English"][1:3], ("x", "y"), strict=True))
    files = foreign_tables.write(turned, tmp_path, Style())
    for file in files:
        head, _, rest = file.read_text().partition("\n")
        for old, letter in names.items():
            head = head.replace(old, letter)
        file.write_text(f"{head}\n{rest}")
    marks = Marks()
    channels = draft_tables(files, marks)[0]["channels"]
    # the mirror image fits as well, and is marked
    assert (channels["x"]["column"], "frame" in channels["psi"]) == ("x [m]", False)
    assert "data.reader.channels.x" in {".".join(key) for key, _ in marks.guesses}


def test_a_header_that_is_wrong_is_asked_about(logs: list[Log], tmp_path: Path) -> None:
    files = foreign_tables.write(logs, tmp_path, Style(units={"r": "°/min"}))
    for file in files:
        file.write_text(file.read_text().replace("[°/min]", "[deg/s]"))
    asked: list[Question] = []

    def answer(question: Question) -> str:
        asked.append(question)
        return question.default

    content = draft_tables(files, Marks(answer))[0]
    assert content["channels"]["r"]["unit"] == "deg/min"
    assert [question.options for question in asked] == [("deg/min", "deg/s")]
    marks = Marks()
    draft_tables(files, marks)
    assert any("the header says deg/s" in text for _, text in marks.guesses)
