"""Kinds of recordings that were met in the field, each as a small made input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.tables import draft_tables
from residnet.data.readers.messages import standard_plan
from residnet.data.readers.quantities import Angle, Local, Plan
from residnet.data.readers.recording import Recording, Series


@pytest.fixture(scope="module")
def turning() -> Log:
    """A vessel that turns to and fro, its velocities those of its pose."""
    t = 0.1 * np.arange(1200)
    psi, u = 0.8 * np.sin(0.15 * t) + 0.1 * t, 1.5 + 0.3 * np.sin(0.05 * t)
    x, y = (np.cumsum(0.1 * u * f(psi)) for f in (np.cos, np.sin))
    noise = np.random.default_rng(2).normal(size=(4, t.size))
    channels = {"x": x + 0.01 * noise[0], "y": y + 0.01 * noise[1], "psi": psi}
    channels |= {"u": u + 0.01 * noise[2], "v": 0.01 * noise[3], "r": np.gradient(psi, t)}
    return Log("turning", t, {**channels, "delta": 0.3 * np.sin(0.15 * t + 1.0)})


def test_a_gyro_that_is_dead_is_said_to_be_dead(turning: Log) -> None:
    dead = 4e-7 + 1e-9 * np.sin(turning.t)
    log = turning.replace(channels={**turning.channels, "r": dead})
    told = {one.code: one for one in inspect(log, ["delta"]).findings}["follows_r"]
    assert "r does not move" in told.text
    assert "it follows from the heading" in told.action
    assert "sign" not in told.action
    told = {one.code: one for one in inspect(turning, ["delta"]).findings}["follows_r"]
    assert told.level == "note"


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/Pose2D", ""])
def test_a_pose_in_the_plane_counts_from_east(kind: str) -> None:
    t = np.arange(10.0)
    fields = {"x": 2.0 * t, "y": 3.0 * t, "theta": 0.1 * t}
    series = Series("/boat/pose", kind, fields, t)
    plan = standard_plan(Recording(Path("run"), {series.name: series}), Plan())
    assert plan.position == Local(topic="/boat/pose", north="y", east="x")
    assert plan.heading == Angle(topic="/boat/pose", field="theta", frame="enu")


@pytest.mark.parametrize("name", ["magnetic heading [deg]", "Compass [deg]", "heading_mag [deg]"])
def test_a_magnetic_heading_is_marked(name: str, turning: Log, tmp_path: Path) -> None:
    for column, marked in ((name, True), ("heading [deg]", False)):
        table = {"time [s]": turning.t, "north [m]": turning["x"], "east [m]": turning["y"]}
        table |= {column: np.degrees(turning["psi"]) % 360.0}
        pd.DataFrame(table).to_csv(tmp_path / "run.csv", index=False)
        marks = Marks()
        assert "psi" in draft_tables([tmp_path / "run.csv"], marks)[0]["channels"]
        assert any("minus the declination" in text for _, text in marks.guesses) == marked


def test_what_a_recording_holds_is_told_where_no_channel_is_found() -> None:
    t = np.arange(5.0)
    series = [
        Series("/chatter", "std_msgs/msg/String", {}, t),
        Series("tank", "", {"level": t, "volts": t}, t),
    ]
    whole = Recording(Path("run"), {one.name: one for one in series})
    assert whole.contents == "/chatter (String), tank (level, volts)"
    many = Recording(Path("run"), {f"s{i}": series[0] for i in range(23)})
    assert many.contents.endswith("s19 (String), and 3 more")
    assert Recording(Path("run"), {}).contents == "nothing"
