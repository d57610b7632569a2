"""The WAM-V plant and the linear model of document 003 against golden runs of another
implementation (golden/README.md, g4_wamv).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from golden_tables import Row, accelerations, beside, made_by, name_of, run, table, tensor
from kinds import of_kind
from scipy.linalg import expm

from residnet.baselines.regressors import RegressorBaseline
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.heads.base import ZeroHead
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.open_loop import AccelerationDeceleration, ConstantInput, ThreeTwoOneOne
from residnet.manoeuvres.sources import StackedSource
from residnet.physics.actuators.thrusters import Thrusters
from residnet.physics.plant import HullPlant
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel

DT = 0.01
EVERY = 5
VESSELS = {"CAL": "wam_v_cal", "VRXNEW": "wam_v_vrx"}


def tenth(text: str) -> float:
    """`05` is 0.5, `10` is 1.0, `-03` is -0.3."""
    return int(text) / 10.0


MANOEUVRES: dict[str, Callable[..., Manoeuvre]] = {
    r"accdec": lambda: AccelerationDeceleration(
        times=(0.0, 15.0, 30.0, 45.0, 60.0, 75.0), levels=(0.2, 0.8, 0.4, 1.0, 0.1, 0.6)
    ),
    r"zz(\d+)_(\d+)": lambda heading, nd: Zigzag(
        drive=0.6, steer=tenth(nd), start=8.0, heading=float(np.radians(float(heading)))
    ),
    r"t3211": lambda: ThreeTwoOneOne(drive=0.5, steer=0.5, start=10.0, unit=3.0, repeat=False),
    r"turn(-?\d+)_(-?\d+)": lambda nm, nd: ConstantInput(drive=tenth(nm), steer=tenth(nd)),
    r"pivot": lambda: ConstantInput(drive=0.0, steer=1.0),
}


@dataclass(frozen=True)
class Case:
    """Set-up of one file, from its name alone."""

    vessel: str
    manoeuvre: Manoeuvre


def case_of(path: Path) -> Case:
    """Vessel and manoeuvre that a name stands for."""
    head, _, rest = name_of(path).partition("_")
    assert head in VESSELS, f"{path}: no parameter set {head}"
    return Case(VESSELS[head], made_by(path, rest, MANOEUVRES, "manoeuvre"))


def is_linear(path: Path) -> bool:
    return path.name.startswith("linear")


@cache
def trajectories(vessel: str, folder: Path, seconds: float) -> dict[str, list[np.ndarray]]:
    """States [T+1, 8] and commands [T, 2] of every file of one vessel, flown side by side."""
    files, longest = beside(
        folder, lambda path: not is_linear(path) and case_of(path).vessel == vessel
    )
    steps = round(min(longest, seconds) / DT) + 1
    t = torch.arange(steps, dtype=torch.float64) * DT
    plant = load_vessel(vessel).build()
    manoeuvres = [case_of(path).manoeuvre for path in files]
    source = StackedSource(
        [type(m).build_source([m], Helm.from_plant(plant), t) for m in manoeuvres], [1] * len(files)
    )
    x0 = torch.zeros(len(files), len(plant.state_names), dtype=torch.float64)
    w = torch.zeros(len(files), steps, len(plant.input_names), dtype=torch.float64)
    states, inputs = run(RecordedPlantDynamics(plant, DT), x0, w, source)
    return {
        path.name: [states[i].numpy(), inputs[i, :, :2].numpy()] for i, path in enumerate(files)
    }


def flown(path: Path, seconds: float) -> dict[str, Any]:
    if is_linear(path):
        return linear(path)
    states, commands = trajectories(case_of(path).vessel, path.parent, seconds)[path.name]
    names = ("x", "y", "psi", "u", "v", "r", "n_port", "n_stbd")
    rpm = dict(zip(("cmd_port", "cmd_stbd"), 60.0 * commands[::EVERY].T, strict=True))
    channels = dict(zip(names, states[::EVERY].T, strict=True))
    rpm |= {name: 60.0 * channels.pop(name) for name in names[6:]}
    return {"step": EVERY * DT, **channels, **rpm}


def by_row(path: Path, frame: pd.DataFrame) -> Iterator[Row]:
    if is_linear(path):
        return
    plant = of_kind(load_vessel(case_of(path).vessel).build(), HullPlant)
    forces = of_kind(plant.actuators, Thrusters).thruster_forces
    n = tensor(frame, "n_port", "n_stbd") / 60
    thrust = forces.thrust_at(n).numpy()
    truth = frame[["T_port", "T_stbd"]].to_numpy()
    # the printed polynomial cancels near zero thrust, where only its largest term bounds the
    # rounding
    yield "thrust", thrust, truth, 1e-12 * (np.abs(truth) + 3.8)
    yield accelerations(plant.hull, tensor(frame, "u", "v", "r"), forces(n), frame)


def linear(path: Path) -> dict[str, Any]:
    """(33), (34) as printed, or with B = -A Phi from Table 1 (corrections W11 to W14), as a
    baseline; and by the matrix exponential, which is exact.
    """
    frame = table(path)
    a, b, c = linear_model(path)
    dt = float(frame["t"].iloc[1])
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:5], block[:3, 5] = a, b, c
    step = expm(block * dt)
    tau = frame[["tau_x", "tau_N"]].to_numpy()
    exact = np.zeros((len(frame), 3))
    for k in range(len(frame) - 1):
        exact[k + 1] = (step @ np.concatenate((exact[k], tau[k], [1.0])))[:3]
    truth = frame[["u", "v_mps", "r_degps"]].to_numpy()
    assert (np.abs(exact - truth).max(0) <= 1e-11 * np.ptp(truth, axis=0)).all()
    # from r in deg/s to rad/s
    scale = np.diag([1.0, 1.0, np.pi / 180.0])
    a, b, c = scale @ a @ np.linalg.inv(scale), scale @ b, scale @ c
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    terms = ("u", "v", "r", "tau_x", "tau_n", "1")
    baseline = RegressorBaseline([terms] * 3, signals.names)
    baseline.theta.data.copy_(torch.from_numpy(np.concatenate((a, b, c[:, None]), axis=1)))
    model = HybridDynamics(signals, baseline, ZeroHead(), dt, "rk4")
    states, _ = run(model, torch.zeros(1, 6, dtype=torch.float64), torch.tensor(tau)[None, :-1])
    nu = states[0, :, 3:].numpy() @ np.linalg.inv(scale)
    return {"step": dt, **dict(zip(("u", "v_mps", "r_degps"), nu.T, strict=True))}


def linear_model(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A [3, 3], B [3, 2], bias [3] of (u, v, r) with r in deg/s and inputs (tau_x, tau_N)."""
    name = name_of(path)
    a = np.array([[-1.3191, 0.0, 0.0], [0.0, 0.0161, -0.0052], [0.0, 8.2861, -0.9860]])
    steer = {
        "linear33_34_printed": np.array([0.0002, 0.0307]),
        "linear33_34_consistent": -a[1:, 1:] @ np.array([2.23e-4, 0.0330]),
    }
    assert name in steer, f"{name}: no linear model of this name"
    b = np.zeros((3, 2))
    b[0, 0], b[1:, 1] = 0.0028, steer[name]
    return a, b, np.array([0.6836, 0.0068, 1.3276])


FURTHER = {
    "VRXNEW_zz20_10": Case(
        "wam_v_vrx", Zigzag(drive=0.6, steer=1.0, start=8.0, heading=float(np.radians(20.0)))
    ),
    "CAL_turn08_02": Case("wam_v_cal", ConstantInput(drive=0.8, steer=0.2)),
    "CAL_t3211": Case(
        "wam_v_cal", ThreeTwoOneOne(drive=0.5, steer=0.5, start=10.0, unit=3.0, repeat=False)
    ),
}
UNKNOWN = ("CAL_loop",)
