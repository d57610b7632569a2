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
from golden_tables import Row, accelerations, beside, name_of, rounding_bound, run, table, tensor
from kinds import of_kind
from torch import Tensor

from residnet.autopilot import (
    ClosedLoop,
    HullFeedForward,
    MotionPID,
    MotionPIDConfig,
    Reference,
    ReferenceFilter,
    ReferenceFilterConfig,
)
from residnet.core.config import load_config
from residnet.core.registry import find_vessel_files
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.physics.hull import MassMatrixConfig
from residnet.physics.plant import HullPlant

DT = 0.02
OPEN_DT = 0.01
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
    mass = np.array([2389.657, 2533.911, 5068.910])
    w = np.array([0.4, 0.4, 0.6])
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
    name = name_of(path)
    if name == "ol_coast_u1_perturbed":
        return OpenLoop((125.0, 0.0, 0.0), (0.9, 0.001, 0.0))
    if match := re.fullmatch(r"ol_(surge|sway|yaw)(-?\d+)", name):
        x, y, n = (float(match[2]) * (axis == match[1]) for axis in ("surge", "sway", "yaw"))
        return OpenLoop((x, y, n))
    match = re.fullmatch(r"(cal|lit)_(half|matched)((?:_dist|_FFonly)*)", name)
    assert match, f"{name}: no run is written so"
    laps = 2 if name == "cal_half" else 1
    guidance = ReferenceFilterConfig(
        waypoints=LAP * laps, interval=60.0, frequency=FREQUENCY[match[1]], damping=(0.7, 0.7, 0.7)
    )
    return Flight(SCALE[match[2]], "_dist" in match[3], guidance, "_FFonly" not in match[3])


def vessel(scale: float) -> HullPlant:
    config = load_config(
        find_vessel_files()["milliampere"], [f"scale={scale}", *UNLIMITED], MassMatrixConfig
    )
    return config.build()


@cache
def flights(folder: Path, scale: float, disturbed: bool, seconds: float) -> dict[str, pd.DataFrame]:
    """Every file of one vessel and weather, flown side by side, with all columns of the golden
    files at their rows.
    """

    def alike(path: Path) -> bool:
        case = case_of(path)
        return isinstance(case, Flight) and (case.scale, case.disturbed) == (scale, disturbed)

    files, longest = beside(folder, alike)
    cases = [of_kind(case_of(path), Flight) for path in files]
    steps = round(min(longest, seconds) / DT) + 1
    plant = vessel(scale)
    if not disturbed:
        plant.without_environment()
    believed = HullFeedForward(vessel(1.0).hull)
    guidance = Watched(ReferenceFilter([case.guidance for case in cases], DT), EVERY["closed"])
    controller = MotionPID([pid(case.feedback) for case in cases], DT, believed)
    x0 = torch.zeros(len(cases), len(plant.state_names), dtype=torch.float64)
    w = torch.zeros(len(cases), steps, len(plant.input_names), dtype=torch.float64)
    for name, force in (("force_north", 200.0), ("force_east", 100.0)) if disturbed else ():
        w[..., plant.input_names.index(name)] = force
    loop = ClosedLoop(controller, guidance)
    states, inputs = run(RecordedPlantDynamics(plant, DT), x0, w, loop)
    every = range(0, steps, EVERY["closed"])
    reference = torch.stack(guidance.asked)
    waypoint = torch.stack(guidance.waypoints)
    out = {}
    for i, path in enumerate(files):
        x = states[i, every]
        command = inputs[i, every, :3]
        desired = reference[:, i]
        forward = believed(desired[:, 6:9], desired[:, 3:6])
        rate = plant.derivative(x, w[i, every])[:, 3:6]
        columns = (x[:, :9], rate, command, forward, command - forward, desired, waypoint[:, i])
        out[path.name] = pd.DataFrame(torch.cat(columns, dim=-1).numpy(), columns=NAMES)
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
        self.guidance = guidance
        self.every = every
        self.n_state = guidance.n_state
        self.asked: list[Tensor] = []
        self.waypoints: list[Tensor] = []

    def initial_state(self, x: Tensor) -> Tensor:
        return self.guidance.initial_state(x)

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        desired, s = self.guidance(x, k, s)
        if k % self.every == 0:
            self.asked.append(desired)
            self.waypoints.append(self.guidance.waypoint_at(k).expand(x.shape[0], -1))
        return desired, s


def simulated(path: Path, seconds: float) -> pd.DataFrame:
    """The columns of a file as residnet has them."""
    case = case_of(path)
    if isinstance(case, Flight):
        return flights(path.parent, case.scale, case.disturbed, seconds)[path.name]
    plant = vessel(1.0)
    x0 = torch.zeros(1, len(plant.state_names), dtype=torch.float64)
    x0[0, 3:6] = torch.tensor(case.nu, dtype=torch.float64)
    # as body forces, which act at once; the thrusters rest
    steps = round(min(100.0, seconds + OPEN_DT) / OPEN_DT)
    w = torch.zeros(1, steps, len(plant.input_names), dtype=torch.float64)
    w[..., 3:6] = torch.tensor(case.force, dtype=torch.float64)
    assert plant.input_names[3:6] == ("force_x", "force_y", "force_n")
    states, _ = run(RecordedPlantDynamics(plant, OPEN_DT), x0, w)
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
    the desired motion.
    """
    case = case_of(path)
    if not isinstance(case, Flight):
        return
    nu, tau = tensor(frame, "u", "v", "r"), tensor(frame, "tau_u", "tau_v", "tau_r")
    psi = frame["psi"].to_numpy()
    c, s = np.cos(psi), np.sin(psi)
    push = np.stack((200.0 * c + 100.0 * s, 100.0 * c - 200.0 * s, 0.0 * psi), axis=1)
    tau = tau + case.disturbed * torch.from_numpy(push)
    yield accelerations(vessel(case.scale).hull, nu, tau, frame)
    believed = vessel(1.0).hull
    nu_d = tensor(frame, "ud", "vd", "rd")
    nu_dot_d = tensor(frame, "dud", "dvd", "drd")
    water = believed.terms(nu_d).abs() @ believed.coefficients.abs()
    size = ((nu_dot_d @ believed.mass.T).abs() + water).numpy()
    forward = frame[["ff_u", "ff_v", "ff_r"]].to_numpy()
    asked = believed.required_force(nu_dot_d, nu_d).numpy()
    allowed = 2.0 * rounding_bound(size, forward, float(size.max()))
    yield "feed-forward", asked, forward, allowed


def described(case: Flight | OpenLoop) -> Any:
    if isinstance(case, OpenLoop):
        return case.force
    frequency = case.guidance.frequency[0]
    laps = case.guidance.duration / 720.0
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
