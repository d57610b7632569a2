"""The ferry milliAmpere, its controller and its reference filter against golden runs of another
implementation (golden/README.md, g3_milliampere).

The gains that the README prints are rounded; the files were made by those of correction J10.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from golden_tables import Row, accelerations, table, tensor
from torch import Tensor

from residnet.control import (
    ClosedLoop,
    HullFeedForward,
    MotionPID,
    MotionPIDConfig,
    Reference,
    ReferenceFilter,
    ReferenceFilterConfig,
)
from residnet.core.config import load_config
from residnet.core.frames import wrap
from residnet.dynamics.rollout import Playback, Rollout
from residnet.dynamics.simulated import RecordedPlantDynamics
from residnet.physics.hull import MassMatrixConfig
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import vessel_files

DT, OPEN_DT = 0.02, 0.01
EVERY = {"closed": 5, "open": 10}
# Table 4.1, row 4 as correction J12 has it; rows 13 to 24 repeat these
TABLE = (
    (0, -15, -90), (15, -15, 0), (15, 0, 0), (30, 0, 0), (30, -15, 0), (30, -15, 180),
    (15, -15, 180), (15, 0, 135), (0, 0, 135), (0, 0, -45), (0, -15, -45), (0, 0, 0),
)  # fmt: skip
LAP = tuple((float(x), float(y), float(np.radians(psi))) for x, y, psi in TABLE)
FREQUENCY = {"cal": (0.2, 0.2, 0.4), "lit": (0.5, 0.5, 0.5)}
SCALE = {"half": 0.5, "matched": 1.0}
# limits beyond what any trajectory asks for: the golden runs do not saturate (correction J26)
UNLIMITED = ("actuators.x_max=1e6", "actuators.y_max=1e6", "actuators.n_max=1e6")
STATE = ("x", "y", "psi", "u", "v", "r", "tau_u", "tau_v", "tau_r")


def pid(feedback: bool) -> MotionPIDConfig:
    """Gains by correction J10, or none."""
    mass, w = np.array([2389.657, 2533.911, 5068.910]), np.array([0.4, 0.4, 0.6])
    p = 0.5 * mass * w**2
    return MotionPIDConfig(
        proportional=tuple(feedback * p),
        integral=tuple(feedback * p * w / 12),
        derivative=tuple(feedback * 0.9 * mass * w),
    )


@dataclass(frozen=True)
class Flight:
    """A run through the waypoints."""

    scale: float
    disturbed: bool
    guidance: ReferenceFilterConfig
    feedback: bool


@dataclass(frozen=True)
class OpenLoop:
    """A run under a constant force, without the lag of the thrusters."""

    force: tuple[float, float, float]
    nu: tuple[float, float, float] = (0.0, 0.0, 0.0)


def case_of(path: Path) -> Flight | OpenLoop:
    """What a name stands for."""
    name = path.name.removesuffix(".csv.gz")
    if name == "ol_coast_u1_perturbed":
        return OpenLoop((125.0, 0.0, 0.0), (0.9, 0.001, 0.0))
    if match := re.fullmatch(r"ol_(surge|sway|yaw)(-?\d+)", name):
        axis = ("surge", "sway", "yaw").index(match[1])
        force = [0.0, 0.0, 0.0]
        force[axis] = float(match[2])
        return OpenLoop((force[0], force[1], force[2]))
    match = re.fullmatch(r"(cal|lit)_(half|matched)((?:_dist|_FFonly)*)", name)
    assert match, f"{name}: no run is written so"
    laps = 2 if name == "cal_half" else 1
    guidance = ReferenceFilterConfig(
        waypoints=LAP * laps, interval=60.0, frequency=FREQUENCY[match[1]], damping=(0.7, 0.7, 0.7)
    )
    return Flight(SCALE[match[2]], "_dist" in match[3], guidance, "_FFonly" not in match[3])


def vessel(scale: float) -> HullPlant:
    config = load_config(
        vessel_files()["milliampere"], [f"scale={scale}", *UNLIMITED], MassMatrixConfig
    )
    return config.build()


@cache
def flights(folder: Path, scale: float, disturbed: bool, seconds: float) -> dict[str, pd.DataFrame]:
    """Every file of one vessel and weather, flown side by side, with all columns of the golden
    files at their rows.
    """
    cases = {
        path: case
        for path in sorted(folder.glob("*.csv.gz"))
        if isinstance(case := case_of(path), Flight)
    }
    cases = {
        path: case
        for path, case in cases.items()
        if (case.scale, case.disturbed) == (scale, disturbed)
    }
    longest = max(case.guidance.duration for case in cases.values())
    steps = round(min(longest, seconds) / DT) + 1
    plant = vessel(scale)
    if not disturbed:
        plant.in_calm_water()
    believed = HullFeedForward(vessel(1.0).hull)
    guidance = Watched(
        ReferenceFilter([case.guidance for case in cases.values()], DT), EVERY["closed"]
    )
    controller = MotionPID([pid(case.feedback) for case in cases.values()], DT, believed)
    x0 = torch.zeros(len(cases), len(plant.state), dtype=torch.float64)
    w = torch.zeros(len(cases), steps, len(plant.inputs), dtype=torch.float64)
    if disturbed:
        w[..., plant.inputs.index("force_north")], w[..., plant.inputs.index("force_east")] = (
            200.0,
            100.0,
        )
    with torch.no_grad():
        states, inputs, _ = Rollout(
            RecordedPlantDynamics(plant, DT), ClosedLoop(controller, guidance)
        )(x0, w, x0[:, :0])
        every = range(0, steps, EVERY["closed"])
        reference, waypoint = torch.stack(guidance.asked), torch.stack(guidance.waypoints)
        out = {}
        for i, path in enumerate(cases):
            x, command, desired = states[i, every], inputs[i, every, :3], reference[:, i]
            forward = believed(desired[:, 6:9], desired[:, 3:6])
            rate = plant.rate(x, w[i, every])[:, 3:6]
            columns = torch.cat(
                (x[:, :9], rate, command, forward, command - forward, desired, waypoint[:, i]),
                dim=-1,
            )
            out[path.name] = pd.DataFrame(columns.numpy(), columns=NAMES)
    return out


NAMES = (
    *STATE, "du", "dv", "dr", "tc_u", "tc_v", "tc_r", "ff_u", "ff_v", "ff_r", "fb_u", "fb_v",
    "fb_r",
    "xd", "yd", "psid", "ud", "vd", "rd", "dud", "dvd", "drd", "wx", "wy", "wpsi",
)  # fmt: skip


class Watched(Reference):
    """Guidance that remembers what it asked for, and the waypoint of that time, every few steps."""

    def __init__(self, guidance: ReferenceFilter, every: int) -> None:
        super().__init__()
        self.guidance, self.every, self.n_state = guidance, every, guidance.n_state
        self.asked: list[Tensor] = []
        self.waypoints: list[Tensor] = []

    def initial_state(self, x: Tensor) -> Tensor:
        return self.guidance.initial_state(x)

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        desired, s = self.guidance(x, k, s)
        if k % self.every == 0:
            self.asked.append(desired)
            self.waypoints.append(self.guidance.waypoint(k).expand(x.shape[0], -1))
        return desired, s


def simulated(path: Path, seconds: float) -> pd.DataFrame:
    """The columns of a file as residnet has them."""
    case = case_of(path)
    if isinstance(case, Flight):
        return flights(path.parent, case.scale, case.disturbed, seconds)[path.name]
    plant = vessel(1.0)
    x0 = torch.zeros(1, len(plant.state), dtype=torch.float64)
    x0[0, 3:6] = torch.tensor(case.nu, dtype=torch.float64)
    # as body forces, which act at once; the thrusters rest
    steps = round(min(100.0, seconds + OPEN_DT) / OPEN_DT)
    w = torch.zeros(1, steps, len(plant.inputs), dtype=torch.float64)
    w[..., 3:6] = torch.tensor(case.force, dtype=torch.float64)
    assert plant.inputs[3:6] == ("force_x", "force_y", "force_n")
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, OPEN_DT), Playback())(x0, w, x0[:, :0])
    return pd.DataFrame(states[0, :: EVERY["open"], :6].numpy(), columns=STATE[:6])


def flown(path: Path, seconds: float) -> dict[str, Any]:
    found = simulated(path, seconds)
    closed = isinstance(case_of(path), Flight)
    step = EVERY["closed"] * DT if closed else EVERY["open"] * OPEN_DT
    assert set(table(path).columns) == {"t", *found.columns}
    return {"step": step, **{str(name): found[name].to_numpy() for name in found.columns}}


def allowed(path: Path, name: str, frame: pd.DataFrame, usual: float) -> float:
    """What is left of the command without the feed-forward is as exact as these."""
    if not name.startswith("fb_"):
        return usual
    return max(usual, 1e-12 * float(frame[f"tc{name[2:]}"].abs().max()))


def by_row(path: Path, frame: pd.DataFrame) -> Iterator[Row]:
    """nu_dot from the measured velocities and the forces behind the thrusters; feed-forward from
    the desired motion, and feedback whose integral grows as the errors between the rows say.
    """
    case = case_of(path)
    if not isinstance(case, Flight):
        return
    nu, tau = tensor(frame, "u", "v", "r"), tensor(frame, "tau_u", "tau_v", "tau_r")
    psi = frame["psi"].to_numpy()
    push = [
        200.0 * np.cos(psi) + 100.0 * np.sin(psi),
        100.0 * np.cos(psi) - 200.0 * np.sin(psi),
        0.0 * psi,
    ]
    tau = tau + case.disturbed * torch.from_numpy(np.stack(push, axis=1))
    yield accelerations(vessel(case.scale).hull, nu, tau, frame)
    believed = vessel(1.0).hull
    controller = MotionPID([pid(case.feedback)], DT, HullFeedForward(believed))
    x = tensor(frame, *STATE[:6])
    desired = tensor(frame, "xd", "yd", "psid", "ud", "vd", "rd", "dud", "dvd", "drd")
    command, memory = controller(x, desired, torch.zeros(len(frame), 3, dtype=torch.float64))
    nu_d, nu_dot_d = desired[:, 3:6], desired[:, 6:9]
    water = believed.terms(nu_d).abs() @ believed.coefficients.abs()
    size = ((nu_dot_d @ believed.mass.T).abs() + water).numpy()
    forward = frame[["ff_u", "ff_v", "ff_r"]].to_numpy()
    asked = believed.required(nu_dot_d, nu_d).numpy()
    yield "feed-forward", asked, forward, 2e-12 * np.maximum(size, np.abs(forward))
    integral = tensor(frame, "tc_u", "tc_v", "tc_r") - command
    if not case.feedback:
        assert float(integral.abs().max()) <= 1e-11 * float(command.abs().max())
        return
    integral = integral / controller.gains[1]
    assert torch.equal(memory, DT * controller.error(x, desired))
    # over the five steps between two rows, by the trapezoidal rule: the error bends little in 0.1 s
    error = controller.error(x, desired)
    grown = 0.5 * EVERY["closed"] * DT * (error[1:] + error[:-1]) - 0.5 * DT * (
        error[1:] - error[:-1]
    )
    found = integral[1:] - integral[:-1]
    assert float((found - grown).abs().max()) <= 2e-3 * float(grown.abs().max())
    assert float(wrap(desired[:, 2] - x[:, 2]).abs().max()) < np.pi


def described(case: Flight | OpenLoop) -> Any:
    if isinstance(case, OpenLoop):
        return case.force
    frequency, laps = case.guidance.frequency[0], case.guidance.duration / 720.0
    return case.scale, case.disturbed, frequency, case.feedback, laps


FURTHER = {
    "cal_matched": (1.0, False, 0.2, True, 1.0),
    "cal_half_dist": (0.5, True, 0.2, True, 1.0),
    "cal_half": (0.5, False, 0.2, True, 2.0),
    "lit_matched": (1.0, False, 0.5, True, 1.0),
    "lit_half_FFonly": (0.5, False, 0.5, False, 1.0),
    "cal_matched_FFonly": (1.0, False, 0.2, False, 1.0),
    "ol_yaw100": (0.0, 0.0, 100.0),
}
UNKNOWN = ("cal_third",)
