"""Heading autopilots: their laws by hand, and what flies with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from exact_steps import NomotoDynamics
from kinds import of_kind
from torch import Tensor

from residnet.control import (
    BangBangHeading,
    ClosedLoop,
    GivenReference,
    HeadingPD,
    Policy,
)
from residnet.control.heading.controllers import PidConfig, Steering
from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.documents.gouletas2020.law import DocumentAutopilot, Predictor, SimulatedPredictor
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.nomoto import SteeringVessel
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

GAIN, TIME, LIMIT = 3.47, 3.94, float(np.radians(5.0))
STATE = ("x", "y", "psi", "u", "v", "r")


def at(psi: float, r: float) -> Tensor:
    return torch.tensor([[0.0, 0.0, psi, 3.2, 0.0, r]], dtype=torch.float64)


def heading(*psi: float) -> Tensor:
    return torch.tensor(psi, dtype=torch.float64)[:, None]


def flown(policy: Policy, target: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Headings and rudder angles of a step of heading, 0.01 s apart."""
    plant = of_kind(load_vessel("nomoto_oceanos").build(), SteeringVessel)
    steps = round(100 * seconds)
    x0 = plant.approach(1)
    source = ClosedLoop(policy, GivenReference(torch.full((1, 1, 1), target, dtype=torch.float64)))
    with torch.no_grad():
        states, inputs, _ = Rollout(NomotoDynamics(plant, 0.01), source)(
            x0, torch.zeros(1, steps, 1, dtype=torch.float64), x0[:, :0]
        )
    return states[0, :, 2].numpy(), inputs[0, :, 0].numpy()


def test_pd_law_saturation_and_wrapped_error() -> None:
    policy = HeadingPD(STATE, kp=2.0, kd=3.0, limit=0.5)
    none = torch.zeros(1, 0, dtype=torch.float64)
    assert policy(at(0.1, 0.02), heading(0.2), none)[0].item() == pytest.approx(2 * 0.1 - 3 * 0.02)
    assert policy(at(0.0, 0.0), heading(1.0), none)[0].item() == 0.5
    # 170 deg to -170 deg is 20 deg to starboard, and a heading that has gone round is where it is
    assert policy(at(np.radians(170), 0.0), heading(np.radians(-170)), none)[
        0
    ].item() == pytest.approx(0.5)
    assert policy(at(4 * np.pi + 0.1, 0.0), heading(0.2), none)[0].item() == pytest.approx(0.2)


def test_placed_poles_show_in_the_response() -> None:
    """Overshoot of a second-order system of damping 0.6, while nothing saturates: exp(-pi zeta /
    sqrt(1 - zeta^2)).
    """
    policy = HeadingPD.placed(STATE, gain=GAIN, time=TIME, frequency=0.5, damping=0.6, limit=LIMIT)
    target = 0.05
    psi, rudder = flown(policy, target, 40.0)
    assert np.abs(rudder).max() < LIMIT
    assert psi.max() / target - 1 == pytest.approx(np.exp(-np.pi * 0.6 / 0.8), rel=0.03)
    assert psi[-1] == pytest.approx(target, rel=1e-3)


def test_integral_action_against_a_bias_without_winding_up() -> None:
    """A rudder that stands askew leaves an error that only the integral takes away; during
    saturation it does not grow.
    """

    class Askew(Policy):
        def __init__(self, policy: Policy) -> None:
            super().__init__()
            self.policy, self.n_state = policy, policy.n_state

        def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            command, s = self.policy(x, reference, s)
            return command + 0.01, s

    target = float(np.radians(30.0))
    pd = HeadingPD(STATE, kp=1.0, kd=1.0, limit=LIMIT)
    vessel = SteeredPlant(load_vessel("nomoto_oceanos").build())
    gains = PidConfig(kp=1.0, damping_time=1.0, integral_time=5.0, filter_time=0.0)
    pid = gains.build(Steering(vessel, Turning(GAIN, TIME, 3.2), LIMIT, 0.01))
    assert flown(Askew(pd), target, 60.0)[0][-1] - target == pytest.approx(0.01, rel=1e-3)
    psi, _ = flown(Askew(pid), target, 60.0)
    assert psi[-1] == pytest.approx(target, abs=1e-5)
    s = torch.tensor([[0.3, 0.0, 0.0]], dtype=torch.float64)
    held, after = pid(at(0.0, 0.0), heading(target), s)
    waits = "saturated towards the target: the integral waits"
    assert (held.item(), after[0, 0].item()) == (LIMIT, 0.3), waits
    s = torch.tensor([[3.0, target + 0.1, 0.0]], dtype=torch.float64)
    _, after = pid(at(target + 0.1, 0.0), heading(target), s)
    assert after[0, 0].item() == pytest.approx(3.0 - 0.001), "saturated, but the error unwinds it"


def test_time_optimal_switches_where_the_closed_form_says() -> None:
    """The shortest turn from rest to rest: full rudder for t1, full counter-rudder for t2, with the
    sums of their effects on r and psi.
    """
    target = float(np.radians(30.0))
    psi, rudder = flown(BangBangHeading(STATE, gain=GAIN, time=TIME, limit=LIMIT), target, 20.0)
    steady = GAIN * LIMIT
    # r(t1) = steady (1 - e^(-t1/T)), back to zero in t2 = T ln(1 + r1/steady), heading steady (t1 -
    # t2) in all
    t1 = 0.0
    for _ in range(200):
        t1 = target / steady + TIME * np.log(2.0 - np.exp(-t1 / TIME))
    switch = np.flatnonzero(rudder <= 0)[0] * 0.01
    assert switch == pytest.approx(t1, abs=0.03)
    assert rudder[: round(100 * switch) - 5].min() == LIMIT
    shortest = t1 + TIME * np.log(2.0 - np.exp(-t1 / TIME))
    arrived = np.flatnonzero(np.abs(psi - target) > np.radians(0.25))[-1] * 0.01
    assert arrived < shortest + 0.2
    assert psi[-1] == pytest.approx(target, abs=1e-4)


class Linear(Predictor):
    """Errors and rates that are linear in the rudder."""

    def forward(self, x: Tensor, heading: Tensor, rudder: Tensor) -> tuple[Tensor, Tensor]:
        return heading[:, None] - x[:, 2:3] - 2.0 * rudder, x[:, 5:6] - 0.5 * rudder


def test_document_law_mixes_two_choices() -> None:
    """(6.4): 0.2 of the angle for the error, 0.8 of the one for the yaw rate, both from the grid of
    0.25 deg.
    """
    policy = DocumentAutopilot(Linear(), limit=LIMIT)
    assert np.degrees(policy.rudder.numpy()).tolist() == pytest.approx(np.arange(-5, 5.25, 0.25))
    assert policy.rudder[20].item() == 0.0
    x = torch.cat((at(0.0, np.radians(0.6)), at(0.0, 0.0)))
    command, _ = policy(x, heading(np.radians(3.1), np.radians(40.0)), x[:, :0])
    # row 0: error wants 1.55 deg -> 1.5, rate wants 1.2 deg -> 1.25; row 1: the error saturates,
    # the rate wants none
    assert np.degrees(command[:, 0].numpy()).tolist() == pytest.approx(
        [0.2 * 1.5 + 0.8 * 1.25, 1.0]
    )


def test_document_law_takes_the_shorter_way_round() -> None:
    """A vessel that has turned once around, under a heading within +-pi."""
    policy = DocumentAutopilot(Linear(), limit=LIMIT)
    x = torch.cat(
        (at(0.0, np.radians(0.6)), at(2 * np.pi, np.radians(0.6)), at(-4 * np.pi, np.radians(0.6)))
    )
    command, _ = policy(x, heading(*[np.radians(3.1)] * 3), x[:, :0])
    assert command[:, 0].tolist() == pytest.approx([float(command[0, 0])] * 3)


@pytest.mark.long
def test_document_autopilot_creeps_as_errata_says() -> None:
    """With the source's horizon of one step it turns at 0.011 deg/s; with 2 s it arrives."""
    plant = of_kind(load_vessel("nomoto_oceanos").build(), SteeringVessel)
    target = float(np.radians(30.0))
    near = DocumentAutopilot(
        SimulatedPredictor(NomotoDynamics(plant, 0.01), plant.state, 1), limit=LIMIT
    )
    far = DocumentAutopilot(
        SimulatedPredictor(NomotoDynamics(plant, 2.0), plant.state, 1), limit=LIMIT
    )
    psi, _ = flown(near, target, 20.0)
    assert np.degrees(psi[-1] - psi[1000]) / 10.0 == pytest.approx(0.0107, abs=0.0005)
    psi, _ = flown(far, target, 40.0)
    assert np.degrees(psi[-1]) == pytest.approx(30.0, abs=0.3)


def test_a_simulated_predictor_is_the_simulation_of_each_candidate() -> None:
    plant = of_kind(load_vessel("patrol_p06").build(), HullPlant).in_calm_water()
    model = PlantDynamics(plant, 0.25)
    x = plant.approach(2)
    x[1, 3], x[1, 7] = 0.3, 0.02
    rudder = torch.tensor([-0.08, 0.0, 0.08], dtype=torch.float64)
    error, rate = SimulatedPredictor(
        model, plant.state, 8, torch.tensor([1e5], dtype=torch.float64)
    )(x, torch.tensor([0.5, 0.4], dtype=torch.float64), rudder)
    assert error.shape == rate.shape == (2, 3)
    for row, target in enumerate((0.5, 0.4)):
        for column, angle in enumerate(rudder.tolist()):
            w = torch.tensor([angle, 1e5], dtype=torch.float64).expand(1, 8, -1)
            states, _, _ = Rollout(model)(x[row : row + 1], w, x[:1, :0])
            assert error[row, column].item() == pytest.approx(
                target - states[0, -1, 3].item(), abs=1e-13
            )
            assert rate[row, column].item() == pytest.approx(states[0, -1, 7].item(), abs=1e-13)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HeadingPD(STATE, kp=1, kd=1, limit=0), "limit must be positive"),
        (lambda: BangBangHeading(STATE, gain=1, time=-1, limit=1), "must be positive"),
        (lambda: DocumentAutopilot(Linear(), limit=1, candidates=1), "candidates >= 2"),
        (
            lambda: SimulatedPredictor(
                PlantDynamics(load_vessel("nomoto_oceanos").build(), 0.1), STATE, 0
            ),
            "one step or more",
        ),
    ],
)
def test_wrong_numbers_stop(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()
