"""Heading autopilots: their laws by hand, what flies with them on vessels and on learned models,
and the time-optimal floor of a rudder of finite rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from exact_steps import NomotoDynamics
from kinds import of_kind
from made_models import nomoto_model
from scipy.integrate import solve_ivp
from torch import Tensor

from residnet.autopilot import BangBangHeading, ClosedLoop, HeadingPD, Policy, RecordedReference
from residnet.autopilot.evaluation import build_sea_row
from residnet.autopilot.heading.classical import RatedBangBangHeading
from residnet.autopilot.heading.conditions import ClosedLoopTrajectories, simulate_heading_steps
from residnet.autopilot.heading.controllers import BangBangConfig, ControlTask, PdConfig, PidConfig
from residnet.autopilot.heading.predictive import DocumentAutopilot, Predictor, SimulatedPredictor
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredModel, SteeredPlant
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.errors import ConfigError
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.nomoto import NomotoVessel
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel
from residnet.testing.checks import SUBMERGED_SIGNALS, make_example_spec

DEG = math.pi / 180
GAIN = 3.47
TIME = 3.94
LIMIT = 5 * DEG
STATE = ("x", "y", "psi", "u", "v", "r")
OCEANOS = of_kind(load_vessel("nomoto_oceanos").build(), NomotoVessel)
RATED = SteeredPlant(load_vessel("nomoto_oceanos_rate10").build())
NOMINAL = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
NONE = torch.zeros(1, 0, dtype=torch.float64)


def at(psi: float, r: float) -> Tensor:
    return torch.tensor([[0.0, 0.0, psi, 3.2, 0.0, r]], dtype=torch.float64)


def heading(*psi: float) -> Tensor:
    return torch.tensor(psi, dtype=torch.float64)[:, None]


def flown(
    policy: Policy, target: float, seconds: float, dt: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Headings and rudder angles of a step of heading."""
    x0 = OCEANOS.make_initial_state(1)
    source = ClosedLoop(
        policy, RecordedReference(torch.full((1, 1, 1), target, dtype=torch.float64))
    )
    w = torch.zeros(1, round(seconds / dt), 1, dtype=torch.float64)
    with torch.no_grad():
        states, inputs, _ = Rollout(NomotoDynamics(OCEANOS, dt), source)(x0, w, x0[:, :0])
    return states[0, :, 2].numpy(), inputs[0, :, 0].numpy()


def test_the_pd_law_saturates_and_takes_the_shorter_way_round() -> None:
    policy = HeadingPD(STATE, kp=2.0, kd=3.0, limit=0.5)
    for psi, r, wanted, expected in (
        (0.1, 0.02, 0.2, 2 * 0.1 - 3 * 0.02),
        (0.0, 0.0, 1.0, 0.5),
        # 170 to -170 deg is 20 deg to starboard, and a heading that has gone round is where it is
        (170 * DEG, 0.0, -170 * DEG, 0.5),
        (4 * np.pi + 0.1, 0.0, 0.2, 0.2),
    ):
        assert policy(at(psi, r), heading(wanted), NONE)[0].item() == pytest.approx(expected)


def test_placed_poles_show_in_the_response() -> None:
    """Overshoot of a second-order system of damping 0.6, while nothing saturates: exp(-pi zeta /
    sqrt(1 - zeta^2)).
    """
    policy = HeadingPD.from_pole_placement(
        STATE, gain=GAIN, time=TIME, frequency=0.5, damping=0.6, limit=LIMIT
    )
    target = 0.05
    psi, rudder = flown(policy, target, 40.0, 0.02)
    assert np.abs(rudder).max() < LIMIT
    assert psi.max() / target - 1 == pytest.approx(np.exp(-np.pi * 0.6 / 0.8), rel=0.03)
    assert psi[-1] == pytest.approx(target, rel=1e-3)


class Askew(Policy):
    """A rudder that stands askew."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy
        self.n_state = policy.n_state

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        command, s = self.policy(x, reference, s)
        return command + 0.01, s


def test_integral_action_against_a_bias_without_winding_up() -> None:
    """Only the integral takes away the error that it leaves; during saturation it does not grow."""
    target = 30 * DEG
    pd = HeadingPD(STATE, kp=1.0, kd=1.0, limit=LIMIT)
    gains = PidConfig(kp=1.0, damping_time=1.0, integral_time=5.0, filter_time=0.0)
    steering = ControlTask(SteeredPlant(OCEANOS), NomotoModel(GAIN, TIME, 3.2), LIMIT, 0.05)
    assert flown(Askew(pd), target, 40.0, 0.05)[0][-1] - target == pytest.approx(0.01, rel=1e-3)
    psi, _ = flown(Askew(gains.build(steering)), target, 60.0, 0.05)
    assert psi[-1] == pytest.approx(target, abs=1e-5)
    pid = gains.build(steering._replace(dt=0.01))
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
    target = 30 * DEG
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
    expected = [0.2 * 1.5 + 0.8 * 1.25, 1.0]
    assert np.degrees(command[:, 0].numpy()).tolist() == pytest.approx(expected)
    # a vessel that has turned once around, under a heading within +-pi
    x = torch.cat([at(2 * np.pi * turns, 0.6 * DEG) for turns in (1, -2)])
    again, _ = policy(x, heading(*[3.1 * DEG] * 2), x[:, :0])
    assert again[:, 0].tolist() == pytest.approx([float(command[0, 0])] * 2)


@pytest.mark.long
def test_the_document_s_autopilot_creeps_as_errata_says() -> None:
    """With the source's horizon of one step it turns at 0.011 deg/s; with 2 s it arrives."""
    near, far = (
        DocumentAutopilot(SimulatedPredictor(NomotoDynamics(OCEANOS, dt), STATE, 1), limit=LIMIT)
        for dt in (0.01, 2.0)
    )
    psi, _ = flown(near, 30 * DEG, 20.0)
    assert np.degrees(psi[-1] - psi[1000]) / 10.0 == pytest.approx(0.0107, abs=0.0005)
    psi, _ = flown(far, 30 * DEG, 40.0)
    assert np.degrees(psi[-1]) == pytest.approx(30.0, abs=0.3)


def test_a_simulated_predictor_is_the_simulation_of_each_candidate() -> None:
    plant = of_kind(load_vessel("patrol_p06").build(), HullPlant).without_environment()
    model = PlantDynamics(plant, 0.25)
    held = torch.tensor([1e5], dtype=torch.float64)
    x = plant.make_initial_state(2)
    x[1, 3], x[1, 7] = 0.3, 0.02
    rudder = torch.tensor([-0.08, 0.0, 0.08]).double()
    targets = torch.tensor([0.5, 0.4]).double()
    error, rate = SimulatedPredictor(model, plant.state_names, 8, held)(x, targets, rudder)
    assert error.shape == rate.shape == (2, 3)
    for row, target in enumerate(targets.tolist()):
        for column, angle in enumerate(rudder.tolist()):
            w = torch.tensor([angle, 1e5], dtype=torch.float64).expand(1, 8, -1)
            end = Rollout(model)(x[row : row + 1], w, x[:1, :0])[0][0, -1]
            assert error[row, column].item() == pytest.approx(target - end[3].item(), abs=1e-13)
            assert rate[row, column].item() == pytest.approx(end[7].item(), abs=1e-13)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HeadingPD(STATE, kp=1, kd=1, limit=0), "limit must be positive"),
        (lambda: BangBangHeading(STATE, gain=1, time=-1, limit=1), "must be positive"),
        (lambda: DocumentAutopilot(Linear(), limit=1, candidates=1), "candidates >= 2"),
        (lambda: SimulatedPredictor(PlantDynamics(OCEANOS, 0.1), STATE, 0), "one step or more"),
    ],
)
def test_wrong_numbers_stop(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


def made(error: list[list[float]], dt: float = 0.5) -> ClosedLoopTrajectories:
    errors = torch.tensor(error, dtype=torch.float64)
    rudder = torch.full_like(errors[:, 1:], 0.2)
    start = torch.zeros(len(errors))
    about = (dt, ("psi",), HEADING, start, errors.shape[1])
    return ClosedLoopTrajectories(-errors.unsqueeze(-1), rudder, 0.0 * errors[:, 0], *about)


def test_what_is_read_from_a_flight() -> None:
    """It has settled at the last entry between samples, and never where it breaks off."""
    flights = made(
        [
            [3.0, 1.5, 0.5, 0.2, 0.1],
            [3.0, 0.5, -1.5, -0.5, 0.0],
            [0.5, 0.4, 0.3, 0.2, 0.1],
            [3.0, 2.0, 2.0, 2.0, 1.5],
        ]
    )
    assert flights.settling_time(1.0).tolist() == pytest.approx([0.75, 1.25, 0.0, 2.0])
    assert float(made([[3.0, 0.5, math.nan, math.nan]]).settling_time(1.0)[0]) == 1.5
    flights = made([[3.0, 1.0, -1.0, 1.0, -1.0]])
    assert float(flights.control_effort()[0]) == pytest.approx(4 * 0.04 * 0.5)
    row = build_sea_row("pd", "classical", flights, 0.5)
    assert row.heading_rms is not None
    assert row.heading_rms.mean == pytest.approx(1.0)
    assert row.rudder_rms is not None
    assert row.rudder_rms.mean == pytest.approx(0.2)


# 2 s; test_time_optimal_switches_where_the_closed_form_says covers a fast rudder
@pytest.mark.long
def test_the_floor_of_a_slow_rudder_comes_to_rest_in_the_least_time() -> None:
    floor = BangBangConfig().build(
        ControlTask(RATED, RATED.estimate_nomoto(LIMIT, 60.0), LIMIT, 0.01)
    )
    assert isinstance(floor, RatedBangBangHeading)
    changes = torch.tensor([30 * DEG, -30 * DEG])
    flights = simulate_heading_steps(
        RATED, floor, changes, NOMINAL.float().expand(2, -1), dt=0.01, duration=10.0
    )
    # least time from rest to rest with the rudder amidships at both ends, by linear programmes over
    # rudder sequences 0.1 s apart
    least = 6.0
    # on the way to rest the rudder comes back at its rate: heading K/T rate t^3 / 6 is left a time
    # t before
    early = (0.1 * DEG * 6.0 * TIME / (GAIN * 10 * DEG)) ** (1 / 3)
    assert float(flights.settling_time(0.1 * DEG).max()) == pytest.approx(least - early, abs=0.15)
    assert float(flights.overshoot().max()) < 0.05 * DEG
    assert torch.allclose(flights.states[0, :, 2], -flights.states[1, :, 2], atol=1e-9)


class HardOver(Policy):
    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(reference, LIMIT), s


def test_a_flight_is_what_an_ode_solver_says() -> None:
    """Rudder hard over from the start: it moves at its rate, and the heading follows Nomoto's
    equation.
    """
    varied = torch.tensor([[0.9, 1.1, 0.0]])
    flights = simulate_heading_steps(
        RATED, HardOver(), torch.tensor([1.0]), varied, dt=0.005, duration=3.0
    )

    def rates(t: float, y: np.ndarray) -> list[float]:
        return [y[1], (0.9 * GAIN * min(10 * DEG * t, LIMIT) - y[1]) / (1.1 * TIME)]

    truth = solve_ivp(rates, (0.0, 3.0), [0.0, 0.0], rtol=1e-9, atol=1e-12, max_step=0.01).y[:, -1]
    # the rudder moves in steps, which is half a step late
    found = [float(flights.state(name)[0, -1]) for name in ("psi", "r")]
    assert found == pytest.approx(truth.tolist(), rel=5e-3)


@pytest.mark.long
def test_the_turn_of_a_slow_vessel_is_waited_for() -> None:
    """Nomoto's model of second order: the area above the answer is T1 + T2 - T3."""
    turning = SteeredPlant(load_vessel("nomoto_mariner_yaw").build()).estimate_nomoto(
        LIMIT, 100.0, 0.5
    )
    assert turning.gain == pytest.approx(0.18499155, rel=0.01)
    assert turning.time == pytest.approx(117.97831 + 7.7630075 - 18.530161, rel=0.02)
    # the Mariner turns far less in a hard turn than about straight ahead: a yaw rate that
    # overshoots has the time constant of a zigzag
    turning = SteeredPlant(load_vessel("mariner").build()).estimate_nomoto(20 * DEG, 60.0, 0.8)
    assert 0.02 < turning.gain < 0.06
    assert 15.0 < turning.time < 40.0


def test_a_vessel_that_starts_at_rest_runs_up_and_has_the_rate_of_its_lagging_rudder() -> None:
    boat = SteeredPlant(load_vessel("example_rudder_boat").build())
    x, w = boat.straight_course(torch.ones(1, dtype=torch.float64))
    speed = float(x[0, boat.state_column("u")])
    assert speed > 3.0
    assert boat.rate == pytest.approx(25 * DEG)
    variation = NOMINAL
    for _ in range(50):
        x, variation = boat.model(0.1).step(x, w, variation)
    assert float(x[0, boat.state_column("u")]) == pytest.approx(speed, rel=1e-4)


VARIED = torch.tensor(
    [[1.0, 1.0, 0.0], [0.8, 1.2, 0.5 * DEG], [1.2, 0.8, -DEG]], dtype=torch.float64
)


def steered(name: str) -> tuple[SteeredPlant, SteeredModel]:
    vessel = SteeredPlant(load_vessel(name).build())
    spec, model = nomoto_model(GAIN, TIME, 0.1)
    return vessel, SteeredModel(model, spec.signals.input_columns, spec.hold, vessel)


@pytest.mark.long
@pytest.mark.parametrize("name", ["nomoto_oceanos", "nomoto_oceanos_rate10"])
def test_a_perfect_model_flies_as_its_vessel(name: str) -> None:
    """A learned model that is Nomoto's own: with any variation both move alike."""
    pair = steered(name)
    flights = []
    turning = pair[0].estimate_nomoto(LIMIT, 60.0)
    changes = torch.tensor([0.5, 0.3, -0.4])
    for vessel in pair:
        pd = PdConfig(kp=3.0, damping_time=1.5).build(ControlTask(vessel, turning, LIMIT, 0.01))
        flights.append(simulate_heading_steps(vessel, pd, changes, VARIED, dt=0.01, duration=8.0))
    # the model divides what a step changes by `time`, which is of first order in the step
    assert float((flights[0].state("psi") - flights[1].state("psi")).abs().max()) < 1e-3
    assert float((flights[0].command - flights[1].command).abs().max()) < 0.1 * DEG


def test_turning_is_that_of_the_model_and_of_a_rudder_that_lags() -> None:
    turning = steered("nomoto_oceanos")[1].estimate_nomoto(LIMIT, 60.0)
    assert turning.gain == pytest.approx(GAIN, rel=1e-6)
    assert turning.time == pytest.approx(TIME, rel=1e-3)
    # fins of a torpedo in six degrees of freedom follow with a time constant of a second
    vessel, learned = steered("remus_100")
    assert (vessel.rate, vessel.lag) == (None, pytest.approx(1.0, rel=1e-3))
    turning = learned.estimate_nomoto(LIMIT, 60.0)
    assert turning.gain == pytest.approx(GAIN, rel=1e-6)
    assert turning.time == pytest.approx(TIME + 1.0, rel=1e-2)


@pytest.mark.long
def test_planes_of_a_learned_torpedo_pitch_it_as_the_vessel_does() -> None:
    vessel = SteeredPlant(load_vessel("remus_100").build(), axis=DEPTH)
    # accelerations as the parameters of the vessel have them
    known = {
        "u": {"u|u|": -0.192, "n|n|": 0.00508, "|n| u": -0.0312, "w q": -1.9},
        "w": {"u w": -0.48, "w|w|": -2.58, "u q": 0.527, "u^2 delta_s": -0.0594},
        "q": {"q": -1.44, "q|q|": -2.7, "sin(theta)": -0.81, "u^2 delta_s": -0.383},
    }
    known["u"]["u^2 delta_s^2"] = -0.113
    rows = {axis: tuple(known.get(axis, ("u v",))) for axis in SUBMERGED_SIGNALS.dof.velocities}
    changes = {"baseline": RegressorsConfig.model_validate({"terms": rows}), "integrator": "rk4"}
    model = make_example_spec(None, SUBMERGED_SIGNALS).model_copy(update=changes).build().double()
    baseline: Any = model.baseline
    with torch.no_grad():
        for axis, row in known.items():
            for term, value in row.items():
                place = (
                    baseline.output_names.index(f"{axis}_dot"),
                    baseline.library.terms.index(term),
                )
                baseline.theta[place] = value
    learned = SteeredModel(model, SUBMERGED_SIGNALS.input_columns, "start", vessel)
    found, wanted = (one.estimate_nomoto(5 * DEG, 20.0, 0.1) for one in (learned, vessel))
    assert found.gain == pytest.approx(wanted.gain, rel=0.05)
    assert found.time == pytest.approx(wanted.time, rel=0.1)
    with pytest.raises(ConfigError, match="depth control needs a model with the state z"):
        SteeredModel(nomoto_model(GAIN, TIME, 0.1)[1], ("delta",), "start", vessel)


def test_gradients_pass_through_the_model_in_single_precision() -> None:
    _, learned = steered("nomoto_oceanos_rate10")
    model = learned.model(0.1)
    x, w = learned.straight_course(torch.ones(3))
    command = torch.full((3, 20, 1), 0.02, requires_grad=True)
    states, _, _ = Rollout(model, None)(x, command, learned.memory(VARIED.float()))
    states[:, -1, 2].sum().backward()
    assert states.dtype == torch.float32
    # heading per rad of rudder that is held grows with the time that is left
    assert command.grad is not None
    assert bool((command.grad[:, 1] > command.grad[:, 10]).all())
    assert w.shape == (3, 1)


def test_a_model_without_rudder_is_refused() -> None:
    _, model = nomoto_model(GAIN, TIME, 0.1)
    for inputs, said in ((("n_port",), "the input 'delta'"), (("delta", "n"), "does not command")):
        with pytest.raises(ConfigError, match=said):
            SteeredModel(model, inputs, "start", RATED)
