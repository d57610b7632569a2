"""Task `actuators`: csv logs to lines of a vessel file that the vessel file takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from kinds import of_kind
from tiny import Command, read_json, write_yaml

from residnet.core.config import validate_config
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.actuators.thrusters import Thrusters
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel

pytestmark = pytest.mark.usefixtures("example_tasks")
VESSEL = of_kind(load_vessel("wam_v_cal"), FossenConfig)


def pushed(thrusters: Any, n: np.ndarray) -> np.ndarray:
    """Thrust of one thruster at revolutions in rpm."""
    revolutions = torch.from_numpy(n / 60)[:, None]
    found: np.ndarray = thrusters.thruster_forces.thrust_at(revolutions)[:, 0].numpy()
    return found


@pytest.fixture
def config(tmp_path: Path) -> dict[str, Any]:
    """Made logs of the WAM-V's thrusters and the config that names them."""
    random = np.random.default_rng(0)
    throttle = np.arange(-100, 101, 5)
    rpm = np.clip(28 * throttle, -2380, 2380) + random.normal(size=throttle.size) * 5
    pd.DataFrame({"throttle": throttle, "rpm": rpm}).to_csv(tmp_path / "throttle.csv", index=False)
    t = 0.02 * np.arange(250)
    rpm = np.clip(1500 * (t - 1.0), 0, 2380) + random.normal(size=t.size) * 10
    step = {"time": 1000 * t, "cmd": np.where(t < 1.0, 0.0, 2380.0), "rpm": rpm}
    pd.DataFrame(step).to_csv(tmp_path / "step.csv", index=False)
    n = np.concatenate((np.linspace(-2380, -200, 15), np.linspace(200, 2380, 15)))
    pull = 2 * pushed(of_kind(VESSEL.actuators.build(), Thrusters), n) + random.normal(size=n.size)
    pd.DataFrame({"rpm": n, "pull": pull / 1000}).to_csv(tmp_path / "bollard.csv", index=False)

    def log(name: str, **columns: tuple[str, str]) -> dict[str, Any]:
        named = columns | {"n": ("rpm", "rpm")}
        found = {key: {"column": column, "unit": unit} for key, (column, unit) in named.items()}
        return {"files": [f"{name}.csv"], **found}

    return {
        "task": "actuators",
        "name": "thrusters",
        "throttle": log("throttle", throttle=("throttle", "%")),
        "step": log("step", command=("cmd", "rpm"), t=("time", "ms")),
        "bollard": {**log("bollard", pull=("pull", "kN")), "thrusters": 2},
    }


def test_logs_become_lines_of_a_vessel_file(
    config: dict[str, Any], tmp_path: Path, command: Command
) -> None:
    run = tmp_path / "run"
    assert command("run", write_yaml(tmp_path / "a.yaml", config), "--out", run).code == 0
    lines = yaml.safe_load((run / "actuators.yaml").read_text()) | {"n_max": "2375 rpm"}
    lines |= {"kind": "differential_thrust", "spacing": 2.44}
    found = validate_config(lines, DifferentialThrustConfig, "here")
    n = np.linspace(-2300, 2300, 50)
    known = pushed(of_kind(VESSEL.actuators.build(), Thrusters), n)
    np.testing.assert_allclose(pushed(found.build(), n), known, rtol=0, atol=0.01 * known.max())
    assert found.n_rate * 60 == pytest.approx(1500, rel=0.01)
    numbers = read_json(run / "actuators.json")
    assert numbers["throttle"]["n_max"]["value"] * 60 == pytest.approx(2380, rel=0.005)
    square = numbers["forward"]["c2"]
    assert square["low"] < VESSEL.actuators.forward[2] < square["high"]
    assert (run / "figures" / "01_actuators.png").stat().st_size > 5000
    assert len(read_json(run / "provenance.json")["inputs"]) == 3


def test_a_clock_that_stands_still_and_a_pull_one_way_only_are_refused(
    config: dict[str, Any], tmp_path: Path, command: Command
) -> None:
    table = pd.read_csv(tmp_path / "bollard.csv")
    table[table["rpm"] > 0].to_csv(tmp_path / "bollard.csv", index=False)
    file = write_yaml(tmp_path / "a.yaml", config)
    run = tmp_path / "run"
    said = command("run", file, "--out", run)
    assert said.code == 1
    assert "bollard pull astern: 0 points" in said.err
    assert not (run / "summary.json").exists()
    said = command("check", file, "-s", "step.t.column=cmd")
    assert said.code == 1
    assert "time repeats" in said.err
