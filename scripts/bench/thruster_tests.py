"""Make the tests of thrusters that examples/residnet_tasks/configs/thrusters.yaml identifies.

    python scripts/bench/thruster_tests.py [FOLDER]

The tests are those of document 003, section 4.1: steady revolutions over throttle (Figure 4),
revolutions after steps of the command (Figure 6), and the pull on a tether (Figure 7). They are
simulated with the thrusters of wam_v_cal, with noise of 5 rpm and 1 rpm and of 3 N, since the
document prints curves and no measurements.
"""

from __future__ import annotations

from pathlib import Path

import bench
import numpy as np
import pandas as pd
import torch

from residnet.core.names import to_si
from residnet.physics.actuators.thrusters import Thrusters
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel

FOLDER = bench.CONFIGS.parent / "examples" / "residnet_tasks" / "configs" / "thruster_tests"
RPM = to_si("rpm")
SLOPE = 2800.0
"""Revolutions in rpm per unit of throttle; the document's Figure 4 saturates before full throttle.
"""
STEPS = {"ahead": (0.0, 2380.0), "reversal": (1500.0, -2380.0)}
"""Commanded revolutions in rpm before and after each step."""
SAMPLE = 0.025
LENGTH = 6.0
AT = 1.35
DELAY = 0.1
"""Sampling period, length, time of the step and dead time of the shaft, in s."""


def tables() -> dict[str, pd.DataFrame]:
    """Return the tests by name of their file, in the units of a test engineer."""
    vessel = load_vessel("wam_v_cal")
    random = np.random.default_rng(2018)
    assert isinstance(vessel, FossenConfig)
    unit = vessel.actuators.build()
    assert isinstance(unit, Thrusters)
    limit = float(unit.n_max[0]) / RPM
    rate = unit.servos[0].fastest / RPM
    throttle = np.arange(-100, 101, 5)
    rpm = np.clip(SLOPE / 100 * throttle, -limit, limit) + random.normal(0, 5, throttle.size)
    out = {"throttle": pd.DataFrame({"throttle_percent": throttle, "rpm": rpm.round(1)})}
    t = SAMPLE * np.arange(round(LENGTH / SAMPLE))
    given = np.arange(t.size) >= round(AT / SAMPLE)
    for name, (before, after) in STEPS.items():
        command = np.where(given, after, before)
        moved = rate * np.clip(t - AT - DELAY, 0, None)
        n = before + np.sign(after - before) * np.minimum(moved, abs(after - before))
        measured = (n + random.normal(0, 5, t.size)).round(1)
        columns = {"t_s": t.round(3), "command_rpm": command, "rpm": measured}
        out[f"step_{name}"] = pd.DataFrame(columns)
    n = np.concatenate((np.linspace(-2380, -240, 16), np.linspace(240, 2380, 16)))
    pull = 2 * unit.thruster_forces.thrust_at(torch.from_numpy(n * RPM)[:, None])[
        :, 0
    ].numpy() + random.normal(0, 3, n.size)
    shown = (n + random.normal(0, 1, n.size)).round(1)
    out["bollard"] = pd.DataFrame({"rpm": shown, "pull_N": pull.round(1)})
    return out


def main() -> None:
    """Write the tests into a folder."""
    given = bench.options(__doc__, folder=(str(FOLDER),))
    folder = Path(given.folder[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables().items():
        table.to_csv(folder / f"{name}.csv", index=False)
        print(folder / f"{name}.csv")


if __name__ == "__main__":
    main()
