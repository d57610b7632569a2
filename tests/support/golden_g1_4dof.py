"""The 4-DOF patrol vessel against golden runs of another implementation (golden/README.md,
g1_4dof).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from golden_tables import beside, made_by, name_of, run
from kinds import of_kind

from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Source
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.sources import ScheduleSource, StackedSource
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

DT = 0.01
EVERY = 10
START = 5.0
SETS = {"P06": "patrol_p06", "HYB": "patrol_hyb", "MSS": "patrol_mss"}
RUDDERS = {"foil": "patrol_p06", "lin": "patrol_p06_linear"}
COLUMNS = ("x", "y", "phi", "psi", "u", "v", "p", "r", "delta")
SPEED = 7.71


@dataclass(frozen=True)
class Run:
    """Initial state, thrust and rudder that the last part of a name stands for: a step or a zigzag
    of `rudder` deg from START.
    """

    u: float = SPEED
    phi: float = 0.0
    drive: float = 1.0
    rudder: float = 0.0
    heading: float | None = None


RUNS: dict[str, Callable[..., Run]] = {
    r"straight": Run,
    r"rudder(-?\d+)": lambda angle: Run(rudder=float(angle)),
    r"zigzag(\d+)(?:_(\d+))?": lambda angle, heading: Run(
        rudder=float(angle), heading=float(heading or angle)
    ),
    r"rolldecay": lambda: Run(phi=10.0),
    r"rolldecay_u0": lambda: Run(phi=10.0, u=0.0, drive=0.0),
}


@dataclass(frozen=True)
class Case:
    """Set-up of one file, from its name alone."""

    parameters: str
    rudder: str
    run: Run


def case_of(path: Path) -> Case:
    """Parameter set, rudder and run that a name stands for."""
    parameters, rudder, flight = name_of(path).split("_", 2)
    assert parameters in SETS, f"{path}: no parameter set {parameters}"
    assert rudder in RUDDERS, f"{path}: no rudder {rudder}"
    return Case(parameters, rudder, made_by(path, flight, RUNS, "run"))


def plant_of(case: Case) -> HullPlant:
    """The set with the rudder: the foil's density is the set's own, the linear rudder is the same
    for all.
    """
    vessel = load_vessel(SETS[case.parameters])
    if case.rudder == "lin":
        vessel = vessel.model_copy(update={"actuators": load_vessel(RUDDERS["lin"]).actuators})
    return of_kind(vessel.build(), HullPlant)


def source_of(runs: list[Run], plant: HullPlant, t: torch.Tensor) -> Source:
    """Manoeuvres of runs, first those without, then those with zigzags; angles as shares of the
    largest rudder angle.
    """
    limit = plant.actuators.config.limit
    steps = [run for run in runs if run.heading is None]
    zigzags = [
        Zigzag(
            drive=run.drive,
            steer=np.radians(run.rudder) / limit,
            start=START,
            heading=float(np.radians(run.heading)),
        )
        for run in runs
        if run.heading is not None
    ]
    sources: list[Source] = []
    if steps:
        steer = torch.tensor(np.radians([run.rudder for run in steps]) / limit)
        drive = torch.tensor([run.drive for run in steps], dtype=torch.float64)
        sources.append(
            ScheduleSource(
                plant.commands_for_demand(
                    drive[:, None].expand(-1, len(t)), steer[:, None] * (t >= START)
                )
            )
        )
    if zigzags:
        sources.append(Zigzag.build_source(zigzags, Helm.from_plant(plant), t))
    return StackedSource(sources, [count for count in (len(steps), len(zigzags)) if count])


def flown(path: Path, seconds: float) -> dict[str, Any]:
    case = case_of(path)
    states, commands = trajectories(case.parameters, case.rudder, path.parent, seconds)[path.name]
    channels = dict(zip(COLUMNS, states[::EVERY].T, strict=True))
    return {"step": EVERY * DT, **channels, "delta_cmd": commands[::EVERY]}


@cache
def trajectories(
    parameters: str, rudder: str, folder: Path, seconds: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """States [T+1, 9] and rudder commands [T] of every file of one vessel, flown side by side."""
    files, longest = beside(
        folder,
        lambda path: (case_of(path).parameters, case_of(path).rudder) == (parameters, rudder),
    )
    files.sort(key=lambda path: case_of(path).run.heading is not None)
    steps = round(min(longest, seconds) / DT) + 1
    t = torch.arange(steps, dtype=torch.float64) * DT
    runs = [case_of(path).run for path in files]
    plant = plant_of(case_of(files[0])).without_environment()
    x0 = torch.zeros(len(runs), len(plant.state_names), dtype=torch.float64)
    x0[:, plant.state_names.index("u")] = torch.tensor([one.u for one in runs], dtype=torch.float64)
    x0[:, plant.state_names.index("phi")] = torch.tensor(np.radians([one.phi for one in runs]))
    w = torch.zeros(len(runs), steps, len(plant.input_names), dtype=torch.float64)
    states, inputs = run(RecordedPlantDynamics(plant, DT), x0, w, source_of(runs, plant, t))
    assert plant.state_names == COLUMNS
    return {path.name: (states[i].numpy(), inputs[i, :, 0].numpy()) for i, path in enumerate(files)}


FURTHER = {
    "HYB_foil_zigzag20": Case("HYB", "foil", Run(rudder=20.0, heading=20.0)),
    "MSS_lin_rudder10": Case("MSS", "lin", Run(rudder=10.0)),
    "P06_lin_rolldecay_u0": Case("P06", "lin", Run(u=0.0, phi=10.0, drive=0.0)),
    "P06_foil_zigzag10_5": Case("P06", "foil", Run(rudder=10.0, heading=5.0)),
    "HYB_lin_straight": Case("HYB", "lin", Run()),
}
UNKNOWN = ("P06_foil_loop", "P07_foil_straight")
