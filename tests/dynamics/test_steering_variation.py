"""Varied plants: Nomoto's model with other K and T, and the plant itself where nothing varies."""

from __future__ import annotations

import math

import pytest
import torch

from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.dynamics.steering_variation import VariedPlant
from residnet.physics.vessel import load_vessel


def test_effect_and_time_are_gain_and_time_constant() -> None:
    plant = load_vessel("nomoto_oceanos").build()
    variation = torch.tensor([[0.8, 1.2, 0.02], [1.2, 0.8, -0.01]], dtype=torch.float64)
    delta, steps, dt = 0.05, 200, 0.02
    w = torch.full((2, steps, 1), delta, dtype=torch.float64)
    states, _, _ = Rollout(VariedPlant(plant, dt))(plant.approach(2), w, variation)
    t = steps * dt
    for row, (effect, time, bias) in enumerate(variation.tolist()):
        steady, constant = 3.47 * (effect * delta + bias), 3.94 * time
        assert float(states[row, -1, plant.state.index("r")]) == pytest.approx(
            steady * (1 - math.exp(-t / constant)), rel=1e-8
        )


@pytest.mark.parametrize("name", ["nomoto_oceanos", "patrol_p06_linear"])
def test_no_variation_is_the_plant(name: str) -> None:
    plant = load_vessel(name).build()
    w = torch.zeros(1, 60, len(plant.inputs), dtype=torch.float64)
    w[:, :, : plant.commands] = plant.demand(
        torch.ones(1, dtype=torch.float64), torch.full((1,), 0.2, dtype=torch.float64)
    ).unsqueeze(1)
    x = plant.approach(1)
    mine, _, _ = Rollout(VariedPlant(plant, 0.1))(
        x, w, torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    )
    truth, _, _ = Rollout(PlantDynamics(plant, 0.1))(x, w, x[:, :0])
    assert torch.allclose(mine, truth, rtol=0, atol=1e-12)
    assert mine[0, -1, plant.state.index("psi")] > 0.05


def test_vessels_without_a_rudder_command_are_refused() -> None:
    with pytest.raises(ConfigError, match="cmd_delta"):
        VariedPlant(load_vessel("wam_v_cal").build(), 0.1)


def test_a_rudder_with_a_lag_moves_within_the_step_and_its_effect_is_varied() -> None:
    """Half of the effect at twice the angle turns the hull alike, while the gear moves on."""
    plant = load_vessel("mariner").build()
    model, column = VariedPlant(plant, 0.5), plant.state.index("delta")
    x, w = plant.approach(2), torch.zeros(2, len(plant.inputs), dtype=torch.float64)
    w[:, : plant.commands] = plant.demand(torch.ones(2), torch.zeros(2)).double()
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
