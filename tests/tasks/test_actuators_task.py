"""Task `actuators`: csv logs to lines of a vessel file that the vessel file takes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from kinds import of_kind
from tiny import call

from residnet.core.config import validate
from residnet.physics.actuators import DifferentialThrustConfig, Thrusters
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel


@pytest.fixture
def config(tmp_path: Path) -> dict[str, Any]:
    """Made logs of the WAM-V's thrusters and the config that names them."""
    vessel, random = load_vessel("wam_v_cal"), np.random.default_rng(0)
    assert isinstance(vessel, FossenConfig)
    unit = of_kind(vessel.actuators.build(), Thrusters)
    throttle = np.arange(-100, 101, 5)
    rpm = np.clip(28 * throttle, -2380, 2380) + random.normal(size=throttle.size) * 5
    pd.DataFrame({"throttle": throttle, "rpm": rpm}).to_csv(tmp_path / "throttle.csv", index=False)
    t = 0.02 * np.arange(250)
    command = np.where(t < 1.0, 0.0, 2380.0)
    pd.DataFrame(
        {
            "time": 1000 * t,
            "cmd": command,
            "rpm": np.clip(1500 * (t - 1.0), 0, 2380) + random.normal(size=t.size) * 10,
        }
    ).to_csv(tmp_path / "step.csv", index=False)
    n = np.concatenate((np.linspace(-2380, -200, 15), np.linspace(200, 2380, 15)))
    pull = 2 * unit.forces.thrust(torch.from_numpy(n / 60)[:, None])[:, 0].numpy() + random.normal(
        size=n.size
    )
    pd.DataFrame({"rpm": n, "pull": pull / 1000}).to_csv(tmp_path / "bollard.csv", index=False)
    rev = {"column": "rpm", "unit": "rpm"}
    return {
        "task": "actuators",
        "name": "thrusters",
        "throttle": {"files": ["throttle.csv"], "n": rev}
        | {"throttle": {"column": "throttle", "unit": "%"}},
        "step": {"files": ["step.csv"], "n": rev, "command": {"column": "cmd", "unit": "rpm"}}
        | {"t": {"column": "time", "unit": "ms"}},
        "bollard": {"files": ["bollard.csv"], "n": rev, "thrusters": 2}
        | {"pull": {"column": "pull", "unit": "kN"}},
    }


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "actuators.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_logs_become_lines_of_a_vessel_file(
    config: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call(monkeypatch, "run", written(tmp_path, config), "--out", tmp_path / "run") == 0
    lines = yaml.safe_load((tmp_path / "run" / "actuators.yaml").read_text())
    lines["n_max"] = "2375 rpm"
    found = validate(
        lines | {"kind": "differential_thrust", "spacing": 2.44}, DifferentialThrustConfig, "here"
    )
    vessel = load_vessel("wam_v_cal")
    assert isinstance(vessel, FossenConfig)
    n = torch.linspace(-2300, 2300, 50, dtype=torch.float64) / 60
    known = of_kind(vessel.actuators.build(), Thrusters).forces.thrust(n[:, None])
    assert float((found.build().forces.thrust(n[:, None]) - known).abs().max()) < 0.01 * float(
        known.max()
    )
    assert found.n_rate * 60 == pytest.approx(1500, rel=0.01)
    numbers = json.loads((tmp_path / "run" / "actuators.json").read_text())
    assert numbers["throttle"]["n_max"]["value"] * 60 == pytest.approx(2380, rel=0.005)
    assert (
        numbers["forward"]["c2"]["low"]
        < vessel.actuators.forward[2]
        < numbers["forward"]["c2"]["high"]
    )
    assert (tmp_path / "run" / "figures" / "01_actuators.png").stat().st_size > 5000
    inputs = json.loads((tmp_path / "run" / "provenance.json").read_text())["inputs"]
    assert len(inputs) == 3


def test_a_clock_that_stands_still(
    config: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config["step"]["t"]["column"] = "cmd"
    assert call(monkeypatch, "check", written(tmp_path, config)) == 1
    assert "time repeats" in capsys.readouterr().err


def test_a_pull_in_one_direction_only(
    config: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = pd.read_csv(tmp_path / "bollard.csv")
    table[table["rpm"] > 0].to_csv(tmp_path / "bollard.csv", index=False)
    assert call(monkeypatch, "run", written(tmp_path, config), "--out", tmp_path / "run") == 1
    assert "bollard pull astern: 0 points" in capsys.readouterr().err
    assert not (tmp_path / "run" / "summary.json").exists()
