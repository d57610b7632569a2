"""The task `course` from config to report and export: two way-points, flown by a hardly trained
policy, a PD and the document's law.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from read_page import plain
from tiny import call
from tiny_tasks import autopilot

from residnet.tasks.course import CourseSpreadConfig

pytestmark = pytest.mark.long

PD = {"kind": "pd", "kp": 1.5, "damping_time": "1.3 s"}
LAW = {
    "kind": "ptos", "lag": "0.3 s", "steepness": 37.0, "share": 0.58, "damping": 0.84,
    "heading_rate": 0.28, "yaw_rate_rate": 2.6, "push_rate": 4.2, "cross_rate": 0.08,
}  # fmt: skip
COURSE: dict[str, Any] = {
    "task": "course",
    "name": "bend",
    "autopilot": "autopilot.yaml",
    "peers": ["pd"],
    "others": {"document": {"kind": "document", "horizon": "2 s"}},
    "course": {
        "buoys": [
            {"north": 50.0, "east": 30.0, "leave_to": "port", "radius": 10.0},
            {"north": 100.0, "east": 20.0, "leave_to": "starboard", "radius": 12.0},
        ],
        "acceptance": 4.0,
        "lookahead": 10.0,
        "planning_dt": "0.2 s",
    },
    "integral": 0.2,
    "line_of_sight": [
        {"kind": "lookahead", "distance": 10.0},
        {"kind": "enclosure", "radius": 12.0},
        {"kind": "integral", "distance": 12.0, "gain": 0.2},
    ],
    "legs_change": "wheel_over",
    "spread": {"flights": 2, "effect": [1.0, 1.0], "time": [1.0, 1.0]},
    "dt": "0.2 s",
    "duration": "42 s",
}
AUTOPILOT = autopilot(Path()) | {"peers": {"pd": PD, "ptos": LAW}, "floor": None}
FLIGHTS = {
    ("enter", "course"),
    ("enter", "lookahead"),
    ("enter", "enclosure"),
    ("enter", "integral"),
    ("sides", "course"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("course")
    (folder / "autopilot.yaml").write_text(yaml.safe_dump(AUTOPILOT))
    config = folder / "course.yaml"
    config.write_text(yaml.safe_dump(COURSE))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call(patch, "run", config, "--out", folder / "run") == 0
    return folder / "run"


def rows_of(run: Path, split: str) -> list[dict[str, Any]]:
    return [row for row in metrics(run)["rows"] if row["split"] == split]


def metrics(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return found


def test_every_controller_flies_every_protocol_and_guidance(run: Path) -> None:
    for split in ("simulated", "spread"):
        rows = rows_of(run, split)
        assert {(row["model"], row["protocol"], row["guidance"]) for row in rows} == {
            (name, *flight) for name in ("policy", "pd", "document") for flight in FLIGHTS
        }
        assert len(rows) == 15


def test_a_spread_of_equal_vessels_is_the_nominal_flight(run: Path) -> None:
    each = pd.read_parquet(run / "spread.parquet")
    assert len(each) == 30
    for nominal, spread in zip(rows_of(run, "simulated"), rows_of(run, "spread"), strict=True):
        own = each[
            (each["model"] == nominal["model"])
            & (each["guidance"] == nominal["guidance"])
            & (each["protocol"] == nominal["protocol"])
        ]
        assert own["course_time"].tolist() == pytest.approx([nominal["course_time"]] * 2, abs=0.21)
        assert spread["ratio"] == pytest.approx(nominal["ratio"], abs=6e-3)
        assert spread["ratio_worst"] == pytest.approx(nominal["ratio"], abs=6e-3)
        assert spread["margin_worst"] == pytest.approx(nominal["margin"], abs=0.05)
        assert spread["finished"] == float(nominal["finished"])


def test_the_tuned_pd_passes_as_asked(run: Path) -> None:
    """Against the straight lines between the points, which no course through circles of 4 m can cut
    by more than 16 m.
    """
    own = {
        (row["protocol"], row["guidance"]): row
        for row in rows_of(run, "simulated")
        if row["model"] == "pd"
    }
    straight = math.hypot(50.0, 30.0) + math.hypot(50.0, 10.0)
    assert own[("enter", "course")]["finished"]
    assert [
        own[("enter", guidance)]["entered"]
        for guidance in ("course", "lookahead", "enclosure", "integral")
    ] == [2] * 4
    assert own[("sides", "course")]["right_side"] == own[("sides", "course")]["clear"] == 2
    assert (
        straight - 4 * 4
        < own[("enter", "course")]["course_time"] * metrics(run)["speed"]
        < straight
    )


def test_an_impossible_radius_is_reported_with_the_smallest(run: Path) -> None:
    """Nomoto's vessel turns with U / (K delta)."""
    found = metrics(run)
    smallest = found["speed"] / (3.47 * math.radians(5))
    assert [one["possible"] for one in found["feasibility"]] == [False, True]
    assert found["feasibility"][0]["smallest"] == pytest.approx(smallest, rel=1e-3)


def test_the_tracks_say_what_the_rows_say(run: Path) -> None:
    tracks = pd.read_parquet(run / "tracks.parquet")
    for row in rows_of(run, "simulated"):
        own = tracks[
            (tracks["controller"] == row["model"])
            & (tracks["protocol"] == row["protocol"])
            & (tracks["guidance"] == row["guidance"])
        ]
        assert own["t"].iloc[-1] == pytest.approx(row["course_time"], abs=0.21)
        assert np.sqrt((own["cross_track"] ** 2).mean()) == pytest.approx(
            row["cross_track_rms"], rel=1e-6
        )
        away = np.hypot(own["north"] - 100.0, own["east"] - 20.0).min()
        assert away == pytest.approx(row["distances"][1], abs=1e-6)


def test_report_and_exports_are_there(run: Path) -> None:
    report = plain(run / "report.html")
    assert "enclosure" in report
    assert "10.57" in report
    for protocol in ("enter", "sides"):
        torch.jit.load(str(run / "exports" / f"policy_{protocol}.pt"))


def test_a_policy_flies_the_course_and_is_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = AUTOPILOT["policies"]["policy"]["training"] | {"dt": "0.1 s"}
    steered = AUTOPILOT | {"policies": {"learned": {"start": "ptos", "training": training}}}
    steered["policies"]["learned"]["units"] = 3
    dropped = ("line_of_sight", "others", "spread", "integral")
    course = {key: value for key, value in COURSE.items() if key not in dropped}
    course |= {"policy": "learned", "peers": ["ptos"], "protocols": ["sides"]}
    (tmp_path / "autopilot.yaml").write_text(yaml.safe_dump(steered))
    (tmp_path / "course.yaml").write_text(yaml.safe_dump(course))
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "run", "course.yaml", "--out", "run") == 0
    row = next(row for row in metrics(tmp_path / "run")["rows"] if row["model"] == "learned")
    assert row["passed"] is True
    assert row["course_time"] < 42.0
    exported = torch.jit.load(str(tmp_path / "run" / "exports" / "learned_sides.pt"))
    start = torch.tensor([[0.0, 0.0, 0.5, 3.2, 0.0, 0.0]])
    command, memory, fault, arrived = exported.step(start, exported.initial_state(start))
    assert not bool(fault)
    assert not bool(arrived)
    assert float(command.abs()) <= math.radians(5.001)
    assert exported.step(start, memory)[2].tolist() == [False]
    # a policy that learned nothing in one epoch costs what the law does that it began with
    assert call(monkeypatch, "export", "run/autopilot", "--format", "c") == 0
    assert call(monkeypatch, "export", "run", "--model", "learned_sides", "--format", "c") == 0
    card = json.loads((tmp_path / "run/exports/learned_sides.card.json").read_text())
    assert (card["format"], card["dtype"]) == ("c", "float64")
    assert call(monkeypatch, "export", "run", "--model", "learned", "--format", "c") == 2
    assert (tmp_path / "run/autopilot/exports/learned.c").is_file()


def test_vessels_and_currents_fill_their_ranges_and_come_again_with_their_seed() -> None:
    settings: dict[str, Any] = {"effect": (0.8, 1.1), "time": (0.9, 1.3), "bias": 0.01}
    spread = CourseSpreadConfig(flights=2000, seed=3, current=0.4, **settings)
    variation, current = spread.draw()
    assert variation.amin(0).tolist() == pytest.approx([0.8, 0.9, -0.01], abs=2e-3)
    assert variation.amax(0).tolist() == pytest.approx([1.1, 1.3, 0.01], abs=2e-3)
    assert current.norm(dim=1).tolist() == pytest.approx([0.4] * 2000)
    # from all directions alike: the mean of unit vectors has a standard deviation of 1/sqrt(2 N)
    # each way
    assert current.mean(0).abs().max() < 0.4 * 4 / math.sqrt(4000)
    again = CourseSpreadConfig(flights=2000, seed=3, current=0.4, **settings).draw()
    assert torch.equal(again.variation, variation)
    assert not torch.equal(CourseSpreadConfig(flights=2000, seed=4).draw().current, current)
