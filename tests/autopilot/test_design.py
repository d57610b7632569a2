"""From logs of one's own vessel, or K and T, to the config of its autopilot, and its pace."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pictures import omit_drawings
from pydantic import ValidationError

from residnet.autopilot import export
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.tasks.autopilot.config import AutopilotConfig, minimum_turn_time
from residnet.autopilot.tasks.design import draft_autopilot_config
from residnet.core.config import load_config, load_mapping
from residnet.core.errors import ConfigError, UsageError
from residnet.core.progress import on_progress
from residnet.tasks.registry import load_task

GAIN = 0.31
TIME = 7.4
GEAR = 6.0
DELAY = 0.3
NOISE = 0.15
SPEED = 2.5


def zigzag(file: Path, angle: float, seed: int) -> Path:
    """Write a zigzag of Nomoto's model with a steering gear, integrated here by Euler's rule."""
    dt = 0.1
    fine = 10
    rng = np.random.default_rng(seed)
    r = psi = rudder = north = east = 0.0
    side = 1.0
    held = [0.0] * (round(DELAY / dt) + 1)
    rows = []
    for k in range(2400):
        side = -side if side * psi > angle else side
        noise = NOISE * rng.normal(size=2)
        fix = north + 2.0 * noise[1], east - 2.0 * noise[0]
        rows.append((k * dt, psi + noise[0], r + noise[1], side * angle, *fix))
        held.append(side * angle)
        for _ in range(fine):
            step = GEAR * dt / fine
            rudder += min(max(held[-1 - round(DELAY / dt)] - rudder, -step), step)
            r += dt / fine * (GAIN * rudder - r) / TIME
            psi += dt / fine * r
            north += dt / fine * SPEED * math.cos(math.radians(psi))
            east += dt / fine * SPEED * math.sin(math.radians(psi))
    names = ["time [s]", "heading [deg]", "yaw rate [deg/s]", "rudder command [deg]"]
    names += ["north [m]", "east [m]"]
    pd.DataFrame(rows, columns=names).to_csv(file, index=False)
    return file


def test_logs_give_the_vessel_and_the_conditions(tmp_path: Path) -> None:
    logs = [zigzag(tmp_path / f"zigzag{a}.csv", a, a) for a in (10, 20)]
    file = draft_autopilot_config(logs, tmp_path / "mine.yaml")
    vessel = load_mapping(tmp_path / "mine_vessel.yaml")
    assert vessel["K"]["value"] == pytest.approx(GAIN, rel=0.03)
    assert vessel["T"]["value"] == pytest.approx(TIME, rel=0.05)
    assert float(vessel["rudder"]["rate"].split()[0]) == pytest.approx(GEAR, rel=0.05)
    assert vessel["speed"] == pytest.approx(SPEED, rel=0.02)
    config = load_config(file, [], AutopilotConfig)
    config.check()
    assert config.conditions is not None
    stated = config.conditions.stated
    assert stated.delay[0] < DELAY < stated.delay[1] < 0.6
    # as dense over frequency as that of the logs
    assert not isinstance(config.pace, str)
    density = math.degrees(stated.noise_r) * math.sqrt(0.02 * config.pace)
    assert density == pytest.approx(NOISE * math.sqrt(0.1), rel=0.1)
    assert stated.effect[0] >= 0.8
    # calm logs: the default motion
    assert math.degrees(stated.waves) == pytest.approx(0.5)
    assert config.conditions.beyond["calm"].waves == 0.0
    assert math.degrees(config.rudder) == pytest.approx(20.0, rel=1e-3)


def test_gain_and_time_are_enough(tmp_path: Path) -> None:
    told: list[str] = []
    with on_progress(lambda progress: told.append(progress.message)):
        file = draft_autopilot_config(
            ["0.31, 7.4"], tmp_path / "kt.yaml", rate="6 deg/s", rudder="15 deg"
        )
    assert any("give --speed" in line for line in told)
    config = load_config(file, [], AutopilotConfig)
    assert math.degrees(config.steered_vessel.rate or 0.0) == pytest.approx(6.0)
    turning = config.steered_vessel.estimate_nomoto(config.rudder, config.turning_time)
    # the gear's way to its angle is no part of T
    assert turning.time == pytest.approx(7.4, rel=0.02)
    for given, out, rudder, said in (
        ("0.31,7.4", "kt", None, "exists; give --overwrite"),
        ("0,7.4", "other", None, "both positive"),
        ("0.31", "other", None, "for example 0.12,18"),
        ("0.31,7.4", "other", "15 kg", "rudder"),
    ):
        with pytest.raises(UsageError, match=said):
            draft_autopilot_config([given], tmp_path / f"{out}.yaml", rudder=rudder)


# 10 s; test_gain_and_time_are_enough covers the design, configs of .ci/run the export
@pytest.mark.long
def test_the_classical_law_is_exported_without_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    omit_drawings(monkeypatch)
    monkeypatch.setattr(export, "PARITY_STEPS", 60)
    lines: list[str] = []
    file = draft_autopilot_config(["0.31,7.4"], tmp_path / "law.yaml", classical=True)
    overrides = ["conditions.evolution.generations=3", "conditions.flights=50", "test.plants=5"]
    task = load_task(file, overrides)
    with on_progress(lambda progress: lines.append(f"{progress.stage} {progress.done}")):
        result = task.run(source=file, output_folder=tmp_path / "run")
    assert {"tuning ptos 1", "tuning pd 3"} <= set(lines)
    assert any("hold for the linear model" in sentence for sentence in result.outcome.verdict)
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    costs = {(row["model"], row["protocol"]): row["cost"]["mean"] for row in rows if "cost" in row}
    # the exported law is the tuned one
    for protocol in ("conditions", "beyond_calm"):
        law_cost = costs["classical", protocol]
        assert law_cost == pytest.approx(costs["ptos", protocol], rel=1e-3)
    with pytest.raises(ConfigError, match="tuned law alone"):
        load_config(file, ["policies.classical.units=16"], AutopilotConfig)


CONFIG: dict[str, Any] = {
    "task": "autopilot",
    "name": "slow",
    "vessel": "nomoto_ship",
    "rudder": "20 deg",
    "test": {"duration": "14 s"},
    "conditions": {"beyond": {"late": {"delay": ["0.6 s", "0.6 s"]}}},
    "policies": {"learned": {"start": "ptos"}},
    "peers": {"ptos": {"kind": "ptos"}},
}


def test_the_least_time_is_that_of_two_pulses() -> None:
    # without damping: half the way at full acceleration, half at full braking
    turning = NomotoModel(1e4, 1e6, 1.0)
    acceleration = turning.gain * 0.1 / turning.time
    two = 2.0 * math.sqrt(math.radians(30.0) / acceleration)
    assert minimum_turn_time(turning, 0.1, None) == pytest.approx(two, rel=1e-3)
    # at once at its speed: the angle over the yaw rate
    quick = NomotoModel(1.0, 1e-4, 1.0)
    assert minimum_turn_time(quick, 0.1, None) == pytest.approx(math.radians(30.0) / 0.1, rel=1e-3)
    assert minimum_turn_time(quick, 0.1, 0.05) == pytest.approx(
        math.radians(30.0) / 0.1 + 4.0, rel=1e-3
    )


def test_times_follow_the_pace_and_delays_do_not() -> None:
    slow = AutopilotConfig.model_validate(CONFIG | {"pace": 8.0}).with_scaled_times()
    assert slow.conditions is not None
    assert (slow.test.duration, slow.test.dt) == (112.0, 0.16)
    for conditions in (slow.conditions.stated, slow.conditions.beyond["late"]):
        assert (conditions.duration, conditions.dt, conditions.hold) == (112.0, 0.16, 40.0)
        assert conditions.overshoot_weight == 4.0
    assert slow.conditions.stated.delay == (0.0, 0.4)
    assert slow.policies["learned"].training.dt == 0.32
    assert slow.with_scaled_times() == slow
    odd = AutopilotConfig.model_validate(CONFIG | {"pace": 2.9}).with_scaled_times()
    assert odd.test.dt == 0.058


def test_the_pace_of_a_vessel_is_measured_and_belongs_to_conditions() -> None:
    slow = AutopilotConfig.model_validate(CONFIG | {"pace": "vessel"}).with_scaled_times()
    assert slow.test.duration == pytest.approx(14.0 * 8.7, rel=0.05)
    without = CONFIG | {"pace": 2.0, "conditions": None, "policies": {}, "peers": {}}
    without |= {"predictive": {"document": {"horizon": 2.0}}}
    with pytest.raises(ValidationError, match="pace: it scales the times of 'conditions'"):
        AutopilotConfig.model_validate(without)
