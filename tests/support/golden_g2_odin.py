"""Odin with forces and with water jets against golden runs of another implementation
(golden/README.md, g2_odin).

The author's own jet inputs are sets 1 and 2 of the simulations in the repository that the document
cites as [15] (corrections of document 000).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd
import torch
from golden_tables import Row, accelerations, beside, name_of, rounding_bound, run, tensor
from kinds import of_kind
from scipy.signal import square
from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.physics.actuators.rudders import WaterJetsConfig
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import load_vessel

DT = 0.01
EVERY = 10
END = 300.0
VESSELS = {"force": "odin_forces", "jet": "odin_jets"}
# square waves change within steps, where each implementation has its own rounding
# (golden/README.md)
EDGES = ("jet1", "jetA1", "jetA2")
STEPS = np.array([
    [0, 0, 0], [4000, 0, 0], [4000, 800, 0], [4000, -800, 0], [4000, 0, 1000], [4000, 0, -1000],
    [2500, 600, 800], [2500, -600, -800],
    [5000, 500, -1200], [1000, 0, 600], [0, 0, 0], [3000, -700, 900], [6000, 0, 0],
    [2000, 900, -500], [0, 0, 0],
], dtype=float)  # fmt: skip
Inputs = Callable[[np.ndarray], np.ndarray]


def wave(t: np.ndarray, period: float, phase: float = 0.0) -> np.ndarray:
    return np.sin(2 * np.pi * t / period + phase)


def between(t: np.ndarray, *parts: tuple[float, float, float | np.ndarray]) -> np.ndarray:
    """Zero but for parts (from, to, value)."""
    out = np.zeros_like(t)
    for start, end, value in parts:
        out = np.where((t >= start) & (t < end), value, out)
    return out


def author1(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rpm = np.where(t <= 20, 500.0, np.where(t <= 200, 500 * square(t / 3) + 1000, 1000 + 2 * t))
    nozzle = between(
        t,
        (100, 150, 0.05 * square(t / 2)),
        (150, 200, 0.2 * square(t / 4)),
        (200, 250, 0.01 * square(t / 2)),
    )
    return rpm, np.where((t > 50) & (t < 100), 0.1 * square(t / 3), nozzle)


def author2(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rpm = np.where(t <= 20, 500.0, 700 * square(t / 3) + 1000)
    nozzle = between(
        t, (55, 65, -0.05), (90, 92, 0.05), (95, 105, -0.05), (180, 185, 0.1), (190, 200, -0.1)
    )
    return rpm, np.where((t > 50) & (t < 55), 0.05, nozzle)


# commands over time: forces in N, N, N m; motor speed in rpm, before it is clipped, and nozzle
# angle in rad
DESIGNS: dict[str, Callable[[np.ndarray], tuple[np.ndarray, ...]]] = {
    "force1": lambda t: (
        3000 + 1500 * wave(t, 37) + 900 * wave(t, 11.3),
        900 * wave(t, 23) + 500 * wave(t, 7.1, 1),
        1500 * wave(t, 29, 0.5) + 900 * wave(t, 9.7),
    ),
    "force2": lambda t: tuple(STEPS[np.minimum((t // 20).astype(int), len(STEPS) - 1)].T),
    "force3": lambda t: (
        3500 * wave(t, 61) + 2000 * wave(t, 17),
        1000 * wave(t, 19, 0.3) + 400 * wave(t, 6.3),
        1800 * wave(t, 31) + 800 * wave(t, 8.9, 2),
    ),
    "jet1": lambda t: (
        np.where(t <= 20, 500.0, 1000 + 500 * square(t / 3)),
        np.where(t > 50, 0.1 * square(t / 7 + 0.5), 0.0),
    ),
    "jet2": lambda t: (
        900 + 350 * wave(t, 41) + 200 * wave(t, 13),
        0.12 * wave(t, 17) + 0.08 * wave(t, 5.3, 1),
    ),
    "jet3": lambda t: (800 + 800 * np.sin(t / 3), 0.1 * np.sin(t)),
    "jetA1": author1,
    "jetA2": author2,
}  # fmt: skip


def case_of(path: Path) -> tuple[str, str]:
    """Vessel and design of a file: `jet2_multisine` is design jet2."""
    match = re.fullmatch(r"((force|jet)A?\d+)(_\w+)?", name_of(path))
    assert match, f"{path}: no run is written so"
    assert match[1] in DESIGNS, f"{path}: no inputs are called {match[1]}"
    return VESSELS[match[2]], match[1]


def commands(path: Path) -> Inputs:
    """Commands [T, c] of the plant over time, in SI."""
    vessel, design = case_of(path)
    units = np.array([1 / 60, 1.0]) if vessel == "odin_jets" else np.ones(3)
    return lambda t: np.stack(DESIGNS[design](t), axis=-1) * units


def plant_of(path: Path) -> HullPlant:
    return of_kind(load_vessel(case_of(path)[0]).build(), HullPlant)


def recorded(frame: pd.DataFrame) -> Tensor:
    """Commands [T, c] as the file has them, in SI."""
    if "rpm" in frame:
        return tensor(frame, "rpm", "nozzle") * torch.tensor([1 / 60, 1.0], dtype=torch.float64)
    return tensor(frame, "tau_x", "tau_y", "tau_z")


@final
class StagedPlantDynamics(Dynamics):
    """A plant stepped by RK4 under inputs that move during a step, taken at each stage's time.

    Inputs w [B, 3 m] hold those at the start, the middle and the end of the step side by side.
    """

    def __init__(self, plant: Plant, dt: float) -> None:
        super().__init__(dt, "rk4")
        self.plant = plant

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant under the inputs p [B, m] of one stage."""
        return self.plant.derivative(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after a step; the memory passes through."""
        start, middle, end = torch.chunk(w, 3, dim=-1)
        k1 = self.state_derivative(x, start, s)
        k2 = self.state_derivative(x + 0.5 * self.dt * k1, middle, s)
        k3 = self.state_derivative(x + 0.5 * self.dt * k2, middle, s)
        k4 = self.state_derivative(x + self.dt * k3, end, s)
        return (
            self.plant.finish_step(
                x + self.dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), end, self.dt
            ),
            s,
        )


@cache
def trajectories(folder: Path, vessel: str, seconds: float) -> dict[str, np.ndarray]:
    """States [T+1, 6] at the steps of every file of one vessel, flown side by side."""
    files, _ = beside(folder, lambda path: case_of(path)[0] == vessel)
    plant = plant_of(files[0]).without_environment()
    t = DT * np.arange(round(min(END, seconds) / DT))
    # the last stage sees the input just before the next step (golden/README.md)
    stages = (t, t + DT / 2, t + DT - 1e-12)
    asked = [np.concatenate([commands(path)(at) for at in stages], axis=-1) for path in files]
    x0 = torch.zeros(len(files), 6, dtype=torch.float64)
    states, _ = run(StagedPlantDynamics(plant, DT), x0, torch.from_numpy(np.stack(asked)))
    return {path.name: states[i].numpy() for i, path in enumerate(files)}


def flown(path: Path, seconds: float) -> dict[str, Any]:
    vessel, design = case_of(path)
    states = trajectories(path.parent, vessel, seconds)[path.name][::EVERY].T
    channels = dict(zip(("x", "y", "psi", "u", "v", "r"), states, strict=True))
    shown = ("u", "v", "r") if design in EDGES else tuple(channels)
    return {"step": EVERY * DT, **{name: channels[name] for name in shown}}


def allowed(path: Path, name: str, frame: pd.DataFrame, usual: float) -> float:
    """Where inputs jump within steps, velocities agree to 3e-2."""
    return 3e-2 if case_of(path)[1] in EDGES else usual


def by_row(path: Path, frame: pd.DataFrame) -> Iterator[Row]:
    plant = plant_of(path)
    command = recorded(frame)
    has_jets = "rpm" in frame
    asked = torch.from_numpy(commands(path)(frame["t"].to_numpy()))
    jets = of_kind(load_vessel("odin_jets").actuators, WaterJetsConfig)
    if has_jets:
        asked[:, 0] = asked[:, 0].clamp(0.0, jets.motor.n_max)
    # times in the file are rounded sums; an input that jumps there may be seen before or after
    away = (asked - command).abs() > 1e-9 * command.abs().amax(0) + 1e-12
    jumps = int(away.any(-1).sum())
    assert jumps <= (3 if case_of(path)[1] in (*EDGES, "force2") else 0), f"{jumps} rows"
    nu, tau = tensor(frame, "u", "v", "r"), tensor(frame, "tau_x", "tau_y", "tau_z")
    made = plant.actuators.force(nu[:, :0], command, nu)
    # both parabolas of the jets cancel: exact to the size of their largest part
    size = made.abs()
    if has_jets:
        u, n = nu[:, 0].abs(), command[:, 0].abs()
        (a, b, c), (d, e, f, whole) = (
            [abs(p.value) for _, p in part] for part in (jets.speed, jets.revolutions)
        )
        largest = 2 * (a + u * (b + u * c)) * (d + n * (e + n * f)) / whole
        across = largest * torch.sin(command[:, 1]).abs()
        size = torch.stack((largest, across, 3.82 * across), dim=-1)
    within = rounding_bound(size.numpy(), tau.numpy(), float(size.max()))
    yield "forces", made.numpy(), tau.numpy(), within
    yield accelerations(plant.hull, nu, tau, frame)


FURTHER = {
    "force3": ("odin_forces", "force3"),
    "jet3_author3": ("odin_jets", "jet3"),
    "jetA2_author2": ("odin_jets", "jetA2"),
}
UNKNOWN = ("jet9", "wave1")


def check_inputs() -> None:
    """Those of names that no file here has."""
    t = np.array([0.0, 19.99, 20.0, 119.0, 280.0, 299.9, 300.0])
    np.testing.assert_array_equal(
        commands(Path("force2.csv.gz"))(t), STEPS[[0, 0, 1, 5, 14, 14, 14]]
    )
    rpm, nozzle = commands(Path("jet3.csv.gz"))(np.array([1.5 * np.pi])).T * [[60], [1]]
    np.testing.assert_allclose([rpm[0], nozzle[0]], [1600.0, -0.1])
