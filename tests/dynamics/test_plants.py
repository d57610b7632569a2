"""Every kind of vessel in discrete time: order of the integrators, and the fast ways to step
against the plain one.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from residnet.dynamics.base import Dynamics, Integrator
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, TracedPlantDynamics
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

# away from every kink: nothing saturates, no rate limit is reached, and u, v, r keep their sign
STARTS = {
    "example_rudder_boat": ([0.0, 0.0, 0.3, 3.0, -0.25, 0.12, 0.14, 14.0], [0.15, 14.0]),
    "mariner": ([0.0, 0.0, 0.3, 7.4, -0.4, 0.006, 0.10], [0.12]),
}
STEPS = {
    "example_rudder_boat": {"rk4": 0.1, "semi_implicit_euler": 0.01},
    "mariner": {"rk4": 0.4, "semi_implicit_euler": 0.1},
}
SECONDS = {"example_rudder_boat": 2.0, "mariner": 8.0}


class Held(Dynamics):
    """A plant under commands that never change, by any integrator."""

    def __init__(self, name: str, dt: float, integrator: Integrator) -> None:
        super().__init__(dt, integrator)
        self.plant = load_vessel(name).build()
        self.w = torch.zeros(1, len(self.plant.inputs), dtype=torch.float64)
        command = torch.tensor(STARTS[name][1], dtype=torch.float64)
        self.w[0, : len(command)] = command
        for key, value in (
            ("current_north", 0.2),
            ("force_east", 50.0),
            ("wind_speed", 6.0),
            ("wind_dir", 1.0),
        ):
            if key in self.plant.inputs:
                self.w[0, self.plant.inputs.index(key)] = value

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return self.plant.rate(x, self.w)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


def end(name: str, integrator: Integrator, dt: float) -> np.ndarray:
    x0 = torch.tensor([STARTS[name][0]], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(Held(name, dt, integrator))(
            x0, torch.zeros(1, round(SECONDS[name] / dt), 0, dtype=torch.float64), x0[:, :0]
        )
    sign = torch.sign(states[0, :, 3:6])
    assert bool((sign == sign[0]).all()), "the run crosses a kink"
    return states[0, -1].numpy()


@pytest.mark.parametrize("name", STARTS)
@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4), ("semi_implicit_euler", 1)])
def test_order_on_plants(name: str, integrator: Integrator, order: int) -> None:
    model = Held(name, 0.1, "rk4")

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return model.plant.rate(torch.from_numpy(x)[None], model.w)[0].numpy()

    truth = solve_ivp(
        rate, (0.0, SECONDS[name]), STARTS[name][0], method="DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    dt = STEPS[name][integrator]
    coarse, fine = (np.linalg.norm(end(name, integrator, step) - truth) for step in (dt, dt / 2))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


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


def test_the_compact_hull_holds_with_coupling_and_has_the_same_gradient() -> None:
    """Off-diagonal mass, so that no Coriolis term vanishes."""
    from residnet.core.config import load_config
    from residnet.physics.fossen import FossenConfig, FossenVessel
    from residnet.physics.vessel import vessel_files

    skewed = [
        "rigid_body.x_G.value=0.4",
        "added_mass.Y_rdot.value=-60",
        "added_mass.N_vdot.value=-90",
    ]
    plain, compact = (
        load_config(vessel_files()["wam_v_cal"], skewed, FossenConfig).build() for _ in range(2)
    )
    assert isinstance(compact, FossenVessel)
    compact.hull.compact()
    nu = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 3)))
    tau = torch.from_numpy(np.random.default_rng(1).normal(size=(50, 3)) * 300)
    torch.testing.assert_close(compact.hull(nu, tau), plain.hull(nu, tau), rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(compact.hull, (nu.requires_grad_(), tau.requires_grad_()))
