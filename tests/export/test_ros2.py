"""`examples/ros2_autopilot`: the node in C, stepped by a harness of rclc's interface."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported_policies import DT, LIMIT, SPEED, observed

from residnet.export import exporter, policy
from residnet.export.c import compile_shared
from residnet.export.policy import ExportedHeading

ROOT = Path(__file__).parents[2]
NODE = ROOT / "examples" / "ros2_autopilot" / "src" / "steering_node.c"
HARNESS = ROOT / "tests" / "support" / "rclc"
STEPS, ASKED, LAST, AGAIN = 400, 60, 199, 301
"""A heading is asked for; odometry comes a last time, and again."""


@pytest.mark.parametrize("safe", ["amidships", "hold"])
def test_the_node_answers_as_the_policy(
    safe: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "PARITY_STEPS", 60)
    own = observed(math.radians(10))[1]
    exported = ExportedHeading("pilot", own, safe=safe, about={}, metrics=[])
    exporter("c").export(exported, tmp_path / "pilot.c")
    flags = [
        f"-I{HARNESS}", f"-I{tmp_path}", "-Dmain=node_main", "-DMODEL=pilot",
        "-DMODEL_UPPER=PILOT", '-DMODEL_HEADER="pilot.h"', "-DPILOT_DOUBLE",
    ]  # fmt: skip
    sources = [NODE, HARNESS / "harness.c", tmp_path / "pilot.c"]
    library = ctypes.CDLL(str(compile_shared(sources, tmp_path / "node.so", flags)))
    library.drive.restype = ctypes.c_double

    random = np.random.default_rng(0)
    psi = 3.0 + np.cumsum(0.01 * random.normal(size=STEPS))
    r = 0.02 * random.normal(size=STEPS)
    yaw = 0.5 * math.pi - psi
    rows = np.zeros((STEPS, 9))
    # every other step has an odometry, after a first one without
    rows[1::2, 0] = 1.0
    rows[LAST + 1 : AGAIN, 0] = 0.0
    rows[:, 3], rows[:, 4] = np.sin(0.5 * yaw), np.cos(0.5 * yaw)
    # a heel that leaves the heading as it is: the quaternion of yaw, then roll
    roll = 0.2
    rows[:, 1] = np.cos(0.5 * yaw) * math.sin(0.5 * roll)
    rows[:, 2] = np.sin(0.5 * yaw) * math.sin(0.5 * roll)
    rows[:, 3] *= math.cos(0.5 * roll)
    rows[:, 4] *= math.cos(0.5 * roll)
    rows[:, 5], rows[:, 6] = SPEED, -r
    rows[ASKED, 7:] = 1.0, -2.5
    out = np.zeros((STEPS, 2))
    at = [ctypes.c_void_p(part.ctypes.data) for part in (rows, out)]
    assert library.drive(at[0], STEPS, at[1]) == pytest.approx(DT)

    module: Any = exported.controller(torch.float64)
    within = policy.PARITY_TOLERANCE * LIMIT
    s, seen, age, asked = None, torch.zeros(1, 3).double(), 0.0, math.nan
    for k in range(STEPS):
        if rows[k, 0]:
            heading = math.remainder(psi[k], 2.0 * math.pi)
            seen, age = torch.tensor([[heading, SPEED, r[k]]]).double(), 0.0
            if s is None:
                s, asked = module.initial_state(seen), heading
        asked = rows[k, 8] if rows[k, 7] else asked
        if s is None:
            assert out[k].tolist() == [0.0, 1.0]
            continue
        if age > 1.0:
            seen = torch.full_like(seen, math.nan)
        age += DT
        with torch.no_grad():
            command, s, fault = module.step(seen, torch.tensor([[asked]]).double(), s)
        assert out[k, 0] == pytest.approx(float(command), abs=within), k
        # it is too old after a second
        assert bool(out[k, 1]) == bool(fault) == (LAST + 50 <= k < AGAIN), k
    assert np.abs(out[:, 0]).max() == pytest.approx(LIMIT, rel=1e-3)
    assert abs(out[AGAIN - 1, 0]) == pytest.approx(LIMIT if safe == "hold" else 0.0, abs=1e-6)
