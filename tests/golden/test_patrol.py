"""The 4-DOF patrol vessel against golden runs of another implementation (golden/README.md,
g1_4dof).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from golden_tables import over_its_length, table
from kinds import of_kind

from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.simulated import PlantDynamics, RecordedPlantDynamics
from residnet.manoeuvres.base import Helm, ScheduleSource, StackedSource
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.physics.actuators.rudders import SternRudders
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

GROUP = "g1_4dof"
DT, EVERY, START = 0.01, 10, 5.0
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
    name = path.name.removesuffix(".csv.gz")
    parameters, rudder, run = name.split("_", 2)
    assert parameters in SETS, f"{name}: no parameter set {parameters}"
    assert rudder in RUDDERS, f"{name}: no rudder {rudder}"
    for pattern, make in RUNS.items():
        if match := re.fullmatch(pattern, run):
            return Case(parameters, rudder, make(*match.groups()))
    raise AssertionError(f"{name}: no run is written {run}")


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
    limit = plant.actuators.delta_max
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
                plant.demand(drive[:, None].expand(-1, len(t)), steer[:, None] * (t >= START))
            )
        )
    if zigzags:
        sources.append(Zigzag.source(zigzags, Helm.from_plant(plant), t))
    return StackedSource(sources, [count for count in (len(steps), len(zigzags)) if count])


@cache
def trajectories(
    parameters: str, rudder: str, folder: Path, seconds: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """States [T+1, 9] and rudder commands [T] of every file of one vessel, flown side by side."""
    files = [
        path
        for path in sorted(folder.glob("*.csv.gz"))
        if (case_of(path).parameters, case_of(path).rudder) == (parameters, rudder)
    ]
    files.sort(key=lambda path: case_of(path).run.heading is not None)
    longest = max(float(table(path)["t"].iloc[-1]) for path in files)
    steps = round(min(longest, seconds) / DT) + 1
    t = torch.arange(steps, dtype=torch.float64) * DT
    runs = [case_of(path).run for path in files]
    plant = plant_of(case_of(files[0])).in_calm_water()
    source = source_of(runs, plant, t)
    x0 = torch.zeros(len(runs), len(plant.state), dtype=torch.float64)
    x0[:, plant.state.index("u")] = torch.tensor([run.u for run in runs], dtype=torch.float64)
    x0[:, plant.state.index("phi")] = torch.tensor(np.radians([run.phi for run in runs]))
    w = torch.zeros(len(runs), steps, len(plant.inputs), dtype=torch.float64)
    with torch.no_grad():
        states, inputs, _ = Rollout(RecordedPlantDynamics(plant, DT), source)(x0, w, x0[:, :0])
    assert plant.state == COLUMNS
    return {path.name: (states[i].numpy(), inputs[i, :, 0].numpy()) for i, path in enumerate(files)}


@over_its_length
def test_trajectory(golden_file: Path, seconds: float) -> None:
    frame, case = table(golden_file), case_of(golden_file)
    frame = frame[frame["t"] <= seconds]
    flown = trajectories(case.parameters, case.rudder, golden_file.parent, seconds)
    states, commands = flown[golden_file.name]
    rows = np.rint(frame["t"].to_numpy() / DT).astype(int)
    np.testing.assert_allclose(frame["t"], rows * DT, atol=1e-9)
    np.testing.assert_array_equal(rows, EVERY * np.arange(len(frame)))
    simulated = dict(zip(COLUMNS, states[rows].T, strict=True)) | {"delta_cmd": commands[rows]}
    for name, values in simulated.items():
        truth = frame[name].to_numpy()
        allowed = 1e-6 * np.ptp(truth) + 1e-12
        assert np.abs(values - truth).max() <= allowed, (
            f"{name} differs by {np.abs(values - truth).max():.3g} (allowed {allowed:.3g})"
        )


def test_from_each_row_to_the_next(golden_file: Path) -> None:
    """Ten steps from every row of the file at once, with all exogenous inputs at zero: no more than
    rounding apart.
    """
    frame = table(golden_file)
    case = case_of(golden_file)
    plant = plant_of(case)
    x = torch.tensor(frame[list(COLUMNS)].to_numpy())
    command = frame["delta_cmd"].to_numpy().copy()
    w = torch.zeros(len(frame), EVERY, len(plant.inputs), dtype=torch.float64)
    w[:, :, 0] = torch.from_numpy(command)[:, None]
    rudders = plant.actuators
    assert isinstance(rudders, SternRudders)
    w[:, :, 1] = case.run.drive * rudders.thrust_max
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, DT))(x, w, x[:, :0])
    # a zigzag may turn its rudder between two rows
    held = command[:-1] == command[1:]
    reached, truth = states[:-1, -1].numpy()[held], frame[list(COLUMNS)].to_numpy()[1:][held]
    assert held.mean() > 0.9
    allowed = 1e-13 * np.abs(truth).max(0) + 1e-15
    assert (np.abs(reached - truth) <= allowed).all(), dict(
        zip(COLUMNS, np.abs(reached - truth).max(0) / allowed, strict=True)
    )


def test_names_of_further_files_are_understood() -> None:
    """Files are kept back for acceptance: names of the same pattern give the set-ups that
    golden/README.md describes.
    """
    assert case_of(Path("HYB_foil_zigzag20.csv.gz")) == Case(
        "HYB", "foil", Run(rudder=20.0, heading=20.0)
    )
    assert case_of(Path("MSS_lin_rudder10.csv.gz")) == Case("MSS", "lin", Run(rudder=10.0))
    assert case_of(Path("P06_lin_rolldecay_u0.csv.gz")) == Case(
        "P06", "lin", Run(u=0.0, phi=10.0, drive=0.0)
    )
    assert case_of(Path("P06_foil_zigzag10_5.csv.gz")).run == Run(rudder=10.0, heading=5.0)
    assert case_of(Path("HYB_lin_straight.csv.gz")).run == Run()
    with pytest.raises(AssertionError, match="no run"):
        case_of(Path("P06_foil_loop.csv.gz"))
    with pytest.raises(AssertionError, match="no parameter set"):
        case_of(Path("P07_foil_straight.csv.gz"))


@pytest.mark.parametrize("parameters", SETS)
@pytest.mark.parametrize("rudder", RUDDERS)
def test_every_set_takes_every_rudder(parameters: str, rudder: str) -> None:
    plant = plant_of(Case(parameters, rudder, Run()))
    t = torch.tensor([0.0, 4.99, 5.0, 6.0], dtype=torch.float64)
    commands, _ = zip(
        *(
            source_of([Run(rudder=-5.0)], plant, t)(
                plant.approach(1), torch.zeros(1, 10), k, torch.zeros(1, 0)
            )
            for k in range(4)
        ),
        strict=True,
    )
    np.testing.assert_allclose(
        np.degrees([float(c[0, 0]) for c in commands]), [0, 0, -5, -5], atol=1e-5
    )
    np.testing.assert_allclose([float(c[0, 1]) for c in commands], 1960 * 7.71**2, rtol=1e-6)
