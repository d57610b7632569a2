"""Integrators and plants against closed forms, SciPy and each other: orders, sub-steps, currents,
varied steering, and how much may be simulated.
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from mutations import at, put
from scipy.integrate import solve_ivp
from tiny_tasks import TINY_TASKS
from torch import Tensor

from residnet.autopilot.heading.steering_variation import DEPTH, HEADING, Axis, VariedPlant
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError, ExportError
from residnet.core.frames import to_body
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import InAmbientCurrent, PlantDynamics
from residnet.dynamics.time_steps import MAX_STEPS, Integrator, check_steps
from residnet.engine import lowering
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.plant import Plant
from residnet.physics.vessel import load_vessel
from residnet.tasks.registry import load_task


class Stepped(Dynamics):
    """A motion that has a rate and no more."""

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


class Smooth(Stepped):
    """The WAM-V plant with propellers that follow a sine of the time, which is the last state:
    smooth, and away from every kink.
    """

    plant: Plant = load_vessel("wam_v_cal").build()

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        t = x[:, 6]
        n = torch.stack((25 + 5 * torch.sin(t), 18 + 4 * torch.cos(1.3 * t)), dim=-1)
        full = torch.cat((x[:, :6], n), dim=-1)
        still = torch.zeros(len(x), len(self.plant.input_names), dtype=x.dtype)
        return torch.cat(
            (self.plant.derivative(full, still)[:, :6], torch.ones_like(t)[:, None]), dim=-1
        )


class Spring(Stepped):
    """v' = -y, y' = v at heading zero."""

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        zero = torch.zeros_like(x[:, 1])
        return torch.cat((self.kinematics(x), torch.stack((zero, -x[:, 1], zero), dim=-1)), dim=-1)


def run(model: Dynamics, start: Tensor, w: Tensor, s: Tensor | None = None) -> Tensor:
    with torch.no_grad():
        return Rollout(model)(start, w, start[:, :0] if s is None else s)[0]


START = [0.0, 0.0, 0.3, 1.2, -0.25, 0.3, 0.0]
SECONDS = 4.0


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    model = Smooth(0.1, "rk4")

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        row = torch.from_numpy(x)[None]
        return model.state_derivative(row, row, row)[0].numpy()

    solution = solve_ivp(rate, (0.0, SECONDS), START, method="DOP853", rtol=1e-13, atol=1e-14)
    return solution.y[:, -1]


@pytest.mark.parametrize(
    ("integrator", "order", "dt"),
    [("rk4", 4, 0.2), ("heun", 2, 0.05), ("euler", 1, 0.02), ("semi_implicit_euler", 1, 0.02)],
)
def test_order(integrator: Integrator, order: int, dt: float, truth: np.ndarray) -> None:
    errors = []
    for step in (dt, 0.5 * dt):
        none = torch.zeros(1, round(SECONDS / step), 0, dtype=torch.float64)
        found = run(Smooth(step, integrator), torch.tensor([START], dtype=torch.float64), none)
        errors.append(np.linalg.norm((found[0, -1].numpy() - truth)[:6]))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


def test_semi_implicit_euler_keeps_an_undamped_oscillation_bounded() -> None:
    """Explicit Euler gains energy at every step, the semi-implicit scheme does not."""
    x0 = torch.tensor([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    none = torch.zeros(1, 2000, 0, dtype=torch.float64)
    schemes: tuple[Integrator, ...] = ("euler", "semi_implicit_euler")
    gained, kept = (
        float(run(Spring(0.1, scheme), x0, none)[0, -200:, 1].abs().max()) for scheme in schemes
    )
    assert gained > 1e3
    assert kept == pytest.approx(1.0, abs=0.1)


def test_substeps_are_steps_under_one_command() -> None:
    plant = load_vessel("wam_v_cal").build()
    random = torch.Generator().manual_seed(0)
    w = torch.rand(2, 10, len(plant.input_names), generator=random, dtype=torch.float64)
    x0 = plant.make_initial_state(2)
    states = run(PlantDynamics(plant, 0.1, substeps=5), x0, w)
    fine = run(PlantDynamics(plant, 0.02), x0, w.repeat_interleave(5, dim=1))
    torch.testing.assert_close(states, fine[:, ::5], rtol=1e-13, atol=1e-13)


def test_a_plant_that_cannot_be_recorded_is_stepped_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise ExportError("a step that Python decides by values")

    plant = load_vessel("wam_v_vrx").build()
    x = plant.make_initial_state(2)
    w, s = torch.ones(2, len(plant.input_names), dtype=torch.float64), x[:, :0]
    wanted = PlantDynamics(plant, 0.1, 5).step(x, w, s)[0]
    recorded = RecordedPlantDynamics(plant, 0.1, 5)
    assert torch.allclose(recorded.step(x, w, s)[0], wanted, rtol=1e-13, atol=1e-15)
    monkeypatch.setattr(lowering, "lower", refuse)
    assert torch.equal(RecordedPlantDynamics(plant, 0.1, 5).step(x, w, s)[0], wanted)


# 3 s; training/test_current.py covers the current of a hull
@pytest.mark.long
def test_in_an_ambient_current_it_moves_over_ground_as_a_hull_in_the_current() -> None:
    """Against the same hull that feels the current through its velocity relative to the water; with
    little rudder, for that one leaves out the current's part along the rolled vessel's vertical
    axis, of the roll angle's second order.
    """
    calm, felt = (
        SteeredPlant(load_vessel("patrol_p06").build(), in_calm_water=still)
        for still in (True, False)
    )
    current = torch.tensor([[0.7, -0.4], [0.0, 1.0]], dtype=torch.float64)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(2, -1)
    steps = 600
    one = torch.ones(2, dtype=torch.float64)
    x, w = calm.straight_course(one)
    w[:, 0] = 0.01
    held = w.unsqueeze(1).expand(-1, steps, -1)
    model = InAmbientCurrent(calm.model(0.1), calm.state)
    water = run(model, x, held, torch.cat((current, nominal), dim=1))
    y, w = felt.straight_course(one)
    w[:, 0] = 0.01
    w[:, [felt.inputs.index(f"current_{name}") for name in ("north", "east")]] = current
    # over ground it begins with the current's speed on top
    carried = torch.stack(
        to_body(current[:, 0], current[:, 1], y[:, felt.state_column("psi")]), dim=1
    )
    y[:, [felt.state_column("u"), felt.state_column("v")]] += carried
    ground = run(felt.model(0.1), y, w.unsqueeze(1).expand(-1, steps, -1), nominal)
    for name in ("x", "y", "psi", "r", "p"):
        found = water[:, -1, calm.state_column(name)]
        wanted = ground[:, -1, felt.state_column(name)]
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-6)
    assert float((water[:, -1, 0] - x[:, 0]).abs().min()) > 50.0


def test_effect_and_time_of_a_varied_plant_are_gain_and_time_constant() -> None:
    plant = load_vessel("nomoto_oceanos").build()
    variation = torch.tensor([[0.8, 1.2, 0.02], [1.2, 0.8, -0.01]], dtype=torch.float64)
    delta = 0.05
    steps = 200
    dt = 0.02
    w = torch.full((2, steps, 1), delta, dtype=torch.float64)
    states = run(VariedPlant(plant, dt), plant.make_initial_state(2), w, variation)
    for row, (effect, time, bias) in enumerate(variation.tolist()):
        steady = 3.47 * (effect * delta + bias)
        constant = 3.94 * time
        wanted = steady * (1 - math.exp(-steps * dt / constant))
        assert float(states[row, -1, plant.state_names.index("r")]) == pytest.approx(
            wanted, rel=1e-8
        )
    with pytest.raises(ConfigError, match="cmd_delta"):
        VariedPlant(load_vessel("wam_v_cal").build(), 0.1)


@pytest.mark.parametrize("name", ["nomoto_oceanos", "patrol_p06_linear"])
def test_no_variation_is_the_plant(name: str) -> None:
    plant = load_vessel(name).build()
    w = torch.zeros(1, 60, len(plant.input_names), dtype=torch.float64)
    demand = torch.tensor([[1.0], [0.2]], dtype=torch.float64)
    w[:, :, : plant.n_commands] = plant.commands_for_demand(*demand).unsqueeze(1)
    x = plant.make_initial_state(1)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    mine = run(VariedPlant(plant, 0.1), x, w, nominal)
    torch.testing.assert_close(mine, run(PlantDynamics(plant, 0.1), x, w), rtol=0, atol=1e-12)
    assert mine[0, -1, plant.state_names.index("psi")] > 0.05


@pytest.mark.parametrize(("name", "axis"), [("patrol_mss", HEADING), ("remus_100", DEPTH)])
def test_nominal_model_equals_the_model_without_variation(name: str, axis: Axis) -> None:
    vessel = SteeredPlant(load_vessel(name).build(), axis=axis)
    x, w = vessel.straight_course(torch.tensor([1.0, 0.8], dtype=torch.float64))
    w[:, 0] = torch.tensor([0.2, -0.3])
    w = w.unsqueeze(1).repeat(1, 30, 1)
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(2, -1)
    expected = run(vessel.model(0.4), x, w, nominal)
    found = run(vessel.nominal_model(0.4), x, w, nominal)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    with pytest.raises(ConfigError, match=axis.command):
        SteeredPlant(load_vessel("wam_v_cal").build(), axis=axis).nominal_model(0.4)


def test_a_rudder_with_a_lag_moves_within_the_step_and_its_effect_is_varied() -> None:
    """Half of the effect at twice the angle turns the hull alike, while the gear moves on."""
    plant = load_vessel("mariner").build()
    model = VariedPlant(plant, 0.5)
    column = plant.state_names.index("delta")
    x, w = plant.make_initial_state(2), torch.zeros(2, len(plant.input_names), dtype=torch.float64)
    w[:, : plant.n_commands] = plant.commands_for_demand(torch.ones(2), torch.zeros(2)).double()
    x[:, column] = torch.tensor([0.1, 0.2], dtype=torch.float64)
    w[:, 0] = x[:, column]
    s = torch.tensor([[1.0, 1.0, 0.0], [0.5, 1.0, 0.0]], dtype=torch.float64)
    after, _ = model.step(x, w, s)
    hull = [i for i in range(x.shape[1]) if i != column]
    assert torch.allclose(after[0, hull], after[1, hull], atol=1e-12)
    assert torch.equal(after[:, column], x[:, column])
    w[:, 0] = 0.3
    moved, _ = model.step(x, w, s)
    assert bool((moved[:, column] > x[:, column]).all())


def test_two_days_at_ten_steps_a_second_are_simulated_and_years_are_not() -> None:
    check_steps(2 * 86_400.0, 0.1)
    with pytest.raises(ValueError, match=f"at most {MAX_STEPS:,}"):
        check_steps(3.15e7, 0.1)


@pytest.mark.parametrize(
    ("task", "keys"),
    [
        ("simulated", ("data", "duration")),
        ("simulated", ("data", "trials", 0, "count")),
        ("flown", ("programme", "duration")),
        ("autopilot", ("test", "duration")),
        ("autopilot", ("policies", "policy", "training", "epochs")),
        ("measured", ("heads", "mlp", "hidden", 0)),
        ("measured", ("training", "mlp", "steps")),
        ("measured", ("training", "mlp", "one_step", "epochs")),
    ],
)
def test_a_million_times_as_much_is_a_slip(
    task: str, keys: tuple[str | int, ...], tmp_path: Path
) -> None:
    config: dict[str, Any] = copy.deepcopy(TINY_TASKS[task](tmp_path))
    given = at(config, keys)
    put(config, keys, "6e6 s" if isinstance(given, str) else given * 1_000_000)
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match=r"at most|less than or equal"):
        load_task(file)
