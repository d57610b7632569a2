"""The task `course` from config to report and export: two way-points, flown by a hardly trained
policy, a PD and the document's law.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from read_page import plain
from tiny import Command, call, read_json, write_yaml
from tiny_tasks import COURSE, autopilot

from residnet.autopilot.tasks.course.config import CourseSpreadConfig

pytestmark = pytest.mark.long

PD = {"kind": "pd", "kp": 1.5, "damping_time": "1.3 s"}
LAW = {
    "kind": "ptos", "lag": "0.3 s", "steepness": 37.0, "share": 0.58, "damping": 0.84,
    "heading_rate": 0.28, "yaw_rate_rate": 2.6, "push_rate": 4.2, "cross_rate": 0.08,
}  # fmt: skip
SHARED: dict[str, Any] = {**COURSE, "legs_change": "wheel_over"}
WHOLE = {
    **SHARED,
    "others": {"document": {"kind": "document", "horizon": "2 s"}},
    "integral": 0.2,
    "line_of_sight": [
        {"kind": "lookahead", "distance": 10.0},
        {"kind": "enclosure", "radius": 12.0},
        {"kind": "integral", "distance": 12.0, "gain": 0.2},
    ],
    "spread": {"flights": 2, "effect": [1.0, 1.0], "time": [1.0, 1.0]},
}
AUTOPILOT = autopilot(Path()) | {"peers": {"pd": PD, "ptos": LAW}, "floor": None}
SIGHTS = ("course", "lookahead", "enclosure", "integral")
FLIGHTS = [*(("enter", sight) for sight in SIGHTS), ("sides", "course")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("course")
    write_yaml(folder / "autopilot.yaml", AUTOPILOT)
    file = write_yaml(folder / "course.yaml", WHOLE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call(patch, "run", file, "--out", folder / "run") == 0
    return folder / "run"


@pytest.fixture(scope="module")
def metrics(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = read_json(run / "metrics.json")
    return found


def rows_of(metrics: dict[str, Any], split: str) -> list[dict[str, Any]]:
    return [row for row in metrics["rows"] if row["split"] == split]


def part(table: pd.DataFrame, row: dict[str, Any], name: str) -> pd.DataFrame:
    """What a table holds of a row's flight."""
    same = (table["protocol"] == row["protocol"]) & (table["guidance"] == row["guidance"])
    return table[same & (table[name] == row["model"])]


def test_a_spread_of_equal_vessels_is_the_nominal_flight(
    run: Path, metrics: dict[str, Any]
) -> None:
    """Of every controller, protocol and guidance."""
    each = pd.read_parquet(run / "spread.parquet")
    assert len(each) == 30
    simulated, spreads = (rows_of(metrics, split) for split in ("simulated", "spread"))
    expected = {(name, *flight) for name in ("policy", "pd", "document") for flight in FLIGHTS}
    for nominal, spread in zip(simulated, spreads, strict=True):
        flight = [(row["model"], row["protocol"], row["guidance"]) for row in (nominal, spread)]
        assert flight[0] == flight[1]
        expected.remove(flight[0])
        own = part(each, nominal, "model")
        assert own["course_time"].tolist() == pytest.approx([nominal["course_time"]] * 2, abs=0.21)
        assert spread["ratio"] == pytest.approx(nominal["ratio"], abs=6e-3)
        assert spread["ratio_worst"] == pytest.approx(nominal["ratio"], abs=6e-3)
        assert spread["margin_worst"] == pytest.approx(nominal["margin"], abs=0.05)
        assert spread["finished"] == float(nominal["finished"])
    assert not expected


def test_the_tuned_pd_passes_as_asked(metrics: dict[str, Any]) -> None:
    """Against the straight lines between the points, which no course through circles of 4 m can cut
    by more than 16 m.
    """
    rows = [row for row in rows_of(metrics, "simulated") if row["model"] == "pd"]
    own = {(row["protocol"], row["guidance"]): row for row in rows}
    straight = math.hypot(50.0, 30.0) + math.hypot(50.0, 10.0)
    assert own["enter", "course"]["finished"]
    assert [own["enter", sight]["entered"] for sight in SIGHTS] == [2] * 4
    assert own["sides", "course"]["right_side"] == own["sides", "course"]["clear"] == 2
    sailed = own["enter", "course"]["course_time"] * metrics["speed"]
    assert straight - 4 * 4 < sailed < straight


def test_an_impossible_radius_is_reported_with_the_smallest(metrics: dict[str, Any]) -> None:
    """Nomoto's vessel turns with U / (K delta)."""
    smallest = metrics["speed"] / (3.47 * math.radians(5))
    assert [one["possible"] for one in metrics["feasibility"]] == [False, True]
    assert metrics["feasibility"][0]["smallest"] == pytest.approx(smallest, rel=1e-3)


def test_the_tracks_say_what_the_rows_say(run: Path, metrics: dict[str, Any]) -> None:
    tracks = pd.read_parquet(run / "tracks.parquet")
    for row in rows_of(metrics, "simulated"):
        own = part(tracks, row, "controller")
        assert own["t"].iloc[-1] == pytest.approx(row["course_time"], abs=0.21)
        aside = np.sqrt((own["cross_track"] ** 2).mean())
        assert aside == pytest.approx(row["cross_track_rms"], rel=1e-6)
        away = np.hypot(own["north"] - 100.0, own["east"] - 20.0).min()
        assert away == pytest.approx(row["distances"][1], abs=1e-6)
    report = plain(run / "report.html")
    assert "enclosure" in report
    assert "10.57" in report
    for protocol in ("enter", "sides"):
        torch.jit.load(str(run / "exports" / f"policy_{protocol}.pt"))


def test_a_policy_flies_the_course_and_is_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    training = AUTOPILOT["policies"]["policy"]["training"] | {"dt": "0.1 s"}
    learned = {"start": "ptos", "units": 3, "training": training}
    course = SHARED | {"policy": "learned", "peers": ["ptos"], "protocols": ["sides"]}
    write_yaml(tmp_path / "autopilot.yaml", AUTOPILOT | {"policies": {"learned": learned}})
    write_yaml(tmp_path / "course.yaml", course)
    monkeypatch.chdir(tmp_path)
    assert command("run", "course.yaml", "--out", "run").code == 0
    rows = read_json(Path("run/metrics.json"))["rows"]
    row = next(row for row in rows if row["model"] == "learned")
    assert row["passed"] is True
    assert row["course_time"] < 42.0
    exported = torch.jit.load("run/exports/learned_sides.pt")
    start = torch.tensor([[0.0, 0.0, 0.5, 3.2, 0.0, 0.0]])
    rudder, memory, fault, arrived = exported.step(start, exported.initial_state(start))
    assert not bool(fault)
    assert not bool(arrived)
    assert float(rudder.abs()) <= math.radians(5.001)
    assert exported.step(start, memory)[2].tolist() == [False]
    # a policy that learned nothing in one epoch costs what the law does that it began with
    assert command("export", "run/autopilot", "--format", "c").code == 0
    assert command("export", "run", "--model", "learned_sides", "--format", "c").code == 0
    card = read_json(Path("run/exports/run_learned_sides.card.json"))
    assert (card["format"], card["dtype"]) == ("c", "float64")
    assert command("export", "run", "--model", "learned", "--format", "c").code == 2
    assert Path("run/autopilot/exports/autopilot.c").is_file()


def test_vessels_and_currents_fill_their_ranges_and_come_again_with_their_seed() -> None:
    settings: dict[str, Any] = {"effect": (0.8, 1.1), "time": (0.9, 1.3), "bias": 0.01}
    spread = CourseSpreadConfig(flights=2000, seed=3, current=0.4, **settings)
    variation, current = spread.sample_vessels()
    assert variation.amin(0).tolist() == pytest.approx([0.8, 0.9, -0.01], abs=2e-3)
    assert variation.amax(0).tolist() == pytest.approx([1.1, 1.3, 0.01], abs=2e-3)
    assert current.norm(dim=1).tolist() == pytest.approx([0.4] * 2000)
    # from all directions alike: the mean of unit vectors has a standard deviation of 1/sqrt(2 N)
    # each way
    assert current.mean(0).abs().max() < 0.4 * 4 / math.sqrt(4000)
    assert torch.equal(spread.sample_vessels().variation, variation)
    assert not torch.equal(
        CourseSpreadConfig(flights=2000, seed=4).sample_vessels().current, current
    )
