"""Nomoto's model and heading autopilots against golden runs of another implementation
(golden/README.md, g5_nomoto).

Neither the README nor the corrections print the gains of `pd_*` and `timeopt_*` and the steps of
`patrol_*`.
They were read from the files: a linear fit of the unsaturated rows gives the gains to rounding
(poles of 2 rad/s and damping 0.9 for `pd_tuned`; 6 and 6 s for the patrol vessel; layer and linear
law of the time-optimal one), and only steps of 0.05 s (PD) and of 0.25 s (document's controller)
give these rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from exact_steps import NomotoDynamics
from golden_tables import made_by, name_of, run, table
from kinds import of_kind
from torch import Tensor

from residnet.autopilot import BangBangHeading, ClosedLoop, HeadingPD, Policy, RecordedReference
from residnet.autopilot.heading.predictive import DocumentAutopilot, SimulatedPredictor
from residnet.dynamics.base import Dynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Source
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.sources import ScheduleSource
from residnet.physics.hull import RollingHullConfig
from residnet.physics.nomoto import NomotoVessel
from residnet.physics.nomoto_config import NomotoConfig
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel

GAIN = 3.47
TIME = 3.94
LIMIT = float(np.radians(5.0))
PATROL = {"P06": "patrol_p06", "HYB": "patrol_hyb", "MSS": "patrol_mss"}
THRUST = 1960 * 7.71**2

Heading = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Case:
    """What flies: the model and its step, and the source of its rudder for the steps' times."""

    plant: Plant
    model: Dynamics
    source: Callable[[Tensor], Source]


def nomoto(rate: str | None = None) -> NomotoVessel:
    """The vessel of document 004, with a steering gear of `rate` deg/s where there is one."""
    vessel = of_kind(load_vessel("nomoto_oceanos"), NomotoConfig)
    assert (vessel.K.value, vessel.T.value) == (GAIN, TIME)
    limited = vessel.rudder.model_copy(
        update={"rate": None if rate is None else float(np.radians(float(rate)))}
    )
    return vessel.model_copy(update={"rudder": limited}).build()


def patrol(parameters: str) -> Plant:
    """The patrol vessel with a rudder that stands at its command at once."""
    vessel = of_kind(load_vessel(PATROL[parameters]), RollingHullConfig)
    immediate = vessel.actuators.model_copy(update={"rate": None})
    return vessel.model_copy(update={"actuators": immediate}).build().without_environment()


def follow(policy: Policy, heading: Heading, t: Tensor) -> Source:
    """The policy towards a heading in rad at times t [T]."""
    return ClosedLoop(
        policy, RecordedReference(torch.from_numpy(heading(t.numpy()))[None, :, None])
    )


def step_to(degrees: float) -> Heading:
    return lambda t: np.full_like(t, np.radians(degrees))


def approach(tau: float) -> Heading:
    """30 deg (1 - exp(-t / tau)); a step where tau is zero."""
    return (lambda t: np.radians(30.0) * (1.0 - np.exp(-t / tau))) if tau else step_to(30.0)


def exactly(plant: NomotoVessel, source: Callable[[Tensor], Source]) -> Case:
    return Case(plant, NomotoDynamics(plant, 0.01), source)


def rudder_step(angle: str) -> Case:
    plant = nomoto()
    steer = np.radians(float(angle)) / plant.delta_max
    return exactly(
        plant,
        lambda t: ScheduleSource(
            plant.commands_for_demand(torch.ones_like(t)[None], steer * (t >= 1.0)[None])
        ),
    )


def zigzag(angle: str, heading: str, rate: str | None) -> Case:
    plant = nomoto(rate)
    turn = float(np.radians(float(heading)))
    steer = np.radians(float(angle)) / plant.delta_max
    manoeuvre = Zigzag(drive=1.0, steer=steer, start=0.0, heading=turn)
    return exactly(plant, lambda t: Zigzag.build_source([manoeuvre], Helm.from_plant(plant), t))


def document(horizon: str, tau: str) -> Case:
    plant = nomoto()
    predictor = SimulatedPredictor(NomotoDynamics(plant, float(horizon)), plant.state_names, 1)
    policy = DocumentAutopilot(predictor, limit=LIMIT)
    return exactly(plant, partial(follow, policy, approach(float(tau))))


def tuned(heading: str | None = None) -> Case:
    plant = nomoto()
    policy = HeadingPD.from_pole_placement(
        plant.state_names, gain=GAIN, time=TIME, frequency=2.0, damping=0.9, limit=LIMIT
    )
    return exactly(plant, partial(follow, policy, step_to(float(heading or 30))))


def time_optimal(heading: str | None = None) -> Case:
    plant = nomoto()
    policy = BangBangHeading(plant.state_names, gain=GAIN, time=TIME, limit=LIMIT)
    return exactly(plant, partial(follow, policy, step_to(float(heading or 30))))


def patrol_document(spacing: float, parameters: str, horizon: str, tau: str | None) -> Case:
    plant = patrol(parameters)
    h = float(horizon)
    # whole steps of at most 0.25 s make both the spacing of the rows and the horizon
    dt = min(spacing / np.ceil(spacing / 0.25 - 1e-9), h)
    model = RecordedPlantDynamics(plant, dt)
    thrust = torch.tensor([THRUST], dtype=torch.float64)
    policy = DocumentAutopilot(
        SimulatedPredictor(model, plant.state_names, round(h / dt), thrust), limit=LIMIT
    )
    return Case(plant, model, partial(follow, policy, approach(float(tau or 0))))


def patrol_pd(parameters: str, heading: str) -> Case:
    plant = patrol(parameters)
    policy = HeadingPD(plant.state_names, kp=6.0, kd=6.0, limit=LIMIT)
    model = RecordedPlantDynamics(plant, 0.05)
    return Case(plant, model, partial(follow, policy, step_to(float(heading))))


NUMBER = r"(\d+(?:\.\d+)?)"
RUNS: dict[str, Callable[..., Case]] = {
    rf"step{NUMBER}": rudder_step,
    rf"zigzag_{NUMBER}_{NUMBER}(?:_rate{NUMBER})?": zigzag,
    rf"docctrl_h{NUMBER}_tau{NUMBER}": document,
    rf"pd_tuned_step{NUMBER}?": tuned,
    rf"timeopt_step{NUMBER}?": time_optimal,
    rf"patrol_(\w+)_pd_step{NUMBER}": patrol_pd,
}


def case_of(path: Path, spacing: float = 0.25) -> Case:
    """Set-up that a name stands for; `spacing` of its rows in s."""
    patrol = rf"patrol_(\w+)_docctrl_h{NUMBER}(?:_tau{NUMBER})?"
    runs = RUNS | {patrol: partial(patrol_document, spacing)}
    case: Case = made_by(path, name_of(path), runs, "run")
    return case


def fly(case: Case, steps: int) -> dict[str, np.ndarray]:
    """Channels [T] of a run, with the rudder angle and the command that act from each time on."""
    t = torch.arange(steps, dtype=torch.float64) * case.model.dt
    w = torch.zeros(1, steps, len(case.plant.input_names), dtype=torch.float64)
    w[:, :, 1:] = THRUST
    states, inputs = run(case.model, case.plant.make_initial_state(1), w, case.source(t))
    out = dict(zip(case.plant.state_names, states[0, :-1].T.numpy(), strict=True))
    out["delta_cmd"] = inputs[0, :, 0].numpy()
    return {"delta": out["delta_cmd"], **out}


def flown(path: Path, seconds: float) -> dict[str, Any]:
    frame = table(path)
    spacing = float(frame["t"].iloc[1])
    case = case_of(path, spacing=spacing)
    every = round(spacing / case.model.dt)
    length = min(seconds, float(frame["t"].iloc[-1]))
    found = fly(case, round(length / case.model.dt) + 1)
    return {"step": spacing, **{n: found[n][::every] for n in frame.columns.drop("t")}}


FURTHER: dict[str, Any] = {}  # cases hold what flies, and cannot be compared
UNKNOWN = ("turn_5",)


def check_inputs() -> None:
    """Those of names that no file here has."""
    case = case_of(Path("zigzag_20_10_rate10.csv.gz"))
    assert case.plant.state_names[-1] == "delta"
    run = fly(case, 300)
    assert abs(float(np.abs(np.diff(run["delta"])).max()) - np.radians(10.0) * 0.01) < 1e-12
    assert set(np.round(np.degrees(run["delta_cmd"]), 9)) == {20.0, -20.0}
    late = fly(case_of(Path("docctrl_h0.5_tau5.csv.gz")), 2)
    assert late["delta"][0] == 0.0, "the reference begins at the heading"
    patrol_run = Path("patrol_HYB_docctrl_h2.csv.gz")
    steps = [case_of(patrol_run, spacing=spacing).model.dt for spacing in (0.25, 0.5, 0.1)]
    assert steps == [0.25, 0.25, 0.1]
    assert case_of(Path("patrol_HYB_pd_step30.csv.gz")).model.dt == 0.05
    stepped = np.degrees(fly(case_of(Path("step2.5.csv.gz")), 102)["delta"][99:])
    np.testing.assert_allclose(stepped, [0.0, 2.5, 2.5], atol=1e-12)
