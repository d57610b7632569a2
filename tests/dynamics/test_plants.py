"""Every kind of vessel in discrete time: order of the integrators, and the fast ways to step
against the plain one.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, TracedPlantDynamics
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

VESSELS = ["wam_v_cal", "wam_v_vrx", "example_rudder_boat", "mariner"]


def runs(plant: HullPlant, rows: int, steps: int) -> tuple[Tensor, Tensor]:
    """Start and commands [B, T, c] of random manoeuvres."""
    rng = torch.Generator().manual_seed(0)
    drive, steer = (
        torch.rand(rows, steps // 20, generator=rng, dtype=torch.float64).repeat_interleave(
            20, dim=1
        )
        for _ in range(2)
    )
    return plant.approach(rows), plant.demand(drive, 2 * steer - 1)


def rolled(model: Dynamics, x: Tensor, w: Tensor) -> Tensor:
    with torch.no_grad():
        return Rollout(model)(x, w, x[:, :0])[0]


@pytest.mark.parametrize("name", VESSELS)
def test_calm_water_and_the_recorded_step_are_the_same_vessel(name: str) -> None:
    """To rounding: with all exogenous inputs at zero, without them, and as TorchScript at another
    batch size than recorded.
    """
    full, calm = load_vessel(name).build(), load_vessel(name).build()
    assert isinstance(full, HullPlant)
    assert isinstance(calm, HullPlant)
    assert calm.in_calm_water().inputs == full.actuators.commands
    x, command = runs(full, 5, 200)
    w = torch.cat(
        (command, torch.zeros(5, 200, len(full.inputs) - full.commands, dtype=torch.float64)),
        dim=-1,
    )
    if full.wind is not None:
        # a vessel with wind coefficients meets the air that it drives through
        full.wind = None
        w = w[:, :, :-2]
    plain = rolled(PlantDynamics(full, 0.05, substeps=2), x, w)
    assert float(plain[:, -1, 3].min()) > 0.2
    torch.testing.assert_close(
        rolled(PlantDynamics(calm, 0.05, substeps=2), x, command), plain, rtol=1e-9, atol=1e-10
    )
    recorded = TracedPlantDynamics(calm, 0.05, substeps=2)
    torch.testing.assert_close(rolled(recorded, x, command), plain, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(
        rolled(recorded, x[:1], command[:1]), plain[:1], rtol=1e-9, atol=1e-10
    )


@pytest.mark.parametrize("name", VESSELS)
def test_what_a_step_holds_changes_nothing(name: str) -> None:
    plant = load_vessel(name).build()
    rng = torch.Generator().manual_seed(1)
    x = (
        plant.approach(6)
        + torch.randn(6, len(plant.state), generator=rng, dtype=torch.float64) * 0.1
    )
    w = torch.randn(6, len(plant.inputs), generator=rng, dtype=torch.float64)
    assert torch.equal(plant.held_rate(x, plant.prepare(x, w)), plant.rate(x, w))
