"""The example of predictive control: better along a course than PID, and quick enough."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from tiny import call

import residnet

EXAMPLE = Path(__file__).parents[2] / "examples" / "casadi_mpc"
SHORT = (
    "data.trials=[{kind: constant, drive: [0.3, 0.6, 0.9], steer: [-0.5, 0.0, 0.5]},"
    " {kind: zigzag, count: 10, heading: [20 deg]}, {kind: acceleration_deceleration, count: 3},"
    " {kind: three_two_one_one, count: 3}]",
    "data.identification={zigzag: 8, acceleration_deceleration: 2, three_two_one_one: 2}",
    "data.validation={zigzag: 1, acceleration_deceleration: 0, three_two_one_one: 0}",
    "data.step=0.1 s",
    "data.substeps=1",
    "data.duration=40 s",
    "prepare.grid.step=0.1 s",
    "baseline.settled=20 s",
    "prepare.derivative.window=1.1 s",
    "~heads.mlp",
    "~heads.lstm",
    "~training",
)


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The module steer.py, imported as a user runs it: from its own folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLE)
        names = ("steer", "controllers", "model", "track")
        __import__("steer")
        yield sys.modules["steer"]
        for name in names:
            sys.modules.pop(name, None)


def test_a_track_is_as_long_and_bent_as_it_is_drawn(example: ModuleType) -> None:
    track = example.Track([[0, 0], [50, 0], [50, 40]], radius=8.0, easing=4.0)
    assert track.length == pytest.approx(90.0 - (2.0 - np.pi / 2) * 8.0, abs=0.3)
    assert track.direction[-1] == pytest.approx(np.pi / 2)
    assert track.points[-1] == pytest.approx([50.0, 40.0], abs=0.5)
    assert track.aside(10.0, 0.7, 10.0) == pytest.approx(0.7)
    assert track.place(12.3, 0.5, near=10.0) == pytest.approx(12.3, abs=1e-6)
    with pytest.raises(ValueError, match=r"leg 2 of 5.0 m is 3.0 m too short for arcs of 8 m"):
        example.Track([[0, 0], [50, 0], [50, 5]], radius=8.0)


@pytest.mark.exporters
def test_predictive_control_follows_a_course_better_than_pid(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = Path(residnet.__file__).parents[2] / "configs" / "quickstart.yaml"
    overrides = [part for text in SHORT for part in ("-s", text)]
    assert call(monkeypatch, "run", config, "--out", tmp_path / "run", *overrides) == 0
    file = tmp_path / "plsr.casadi"
    exported = ("--model", "plsr", "--format", "casadi", "--out", file)
    assert call(monkeypatch, "export", tmp_path / "run", *exported) == 0
    model = example.Identified(file)
    track = example.Track([[0, 0], [20, 0], [25, 20]], radius=5.0, easing=2.5)
    found = example.compared(model, example.Plant("wam_v_cal", model), track, 1.2)
    assert found["mpc"]["rms"] < found["pid"]["rms"] < 0.2
    # times belong to the machine: what is kept here is that solutions are found, not how quickly
    assert found["solutions"] > 20
    assert np.isfinite(found["mpc"]["largest"])
