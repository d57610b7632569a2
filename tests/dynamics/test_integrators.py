"""Order of the integrators on the WAM-V plant, and agreement with SciPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from residnet.dynamics.base import Dynamics, Integrator
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.vessel import load_vessel

SECONDS = 4.0


class SmoothPlant(Dynamics):
    """The WAM-V plant with propellers that follow a sine of the time, which is the last state:
    smooth, and away from every kink.
    """

    def __init__(self, dt: float, integrator: Integrator) -> None:
        super().__init__(dt, integrator)
        self.plant = load_vessel("wam_v_cal").build()

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        t = x[:, 6]
        n = torch.stack((25 + 5 * torch.sin(t), 18 + 4 * torch.cos(1.3 * t)), dim=-1)
        full = torch.cat((x[:, :6], n), dim=-1)
        still = torch.zeros(len(x), len(self.plant.inputs), dtype=x.dtype)
        return torch.cat((self.plant.rate(full, still)[:, :6], torch.ones_like(t)[:, None]), dim=-1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.integrate(x, w, s), s


START = [0.0, 0.0, 0.3, 1.2, -0.25, 0.3, 0.0]


def run(integrator: Integrator, dt: float) -> np.ndarray:
    model = SmoothPlant(dt, integrator)
    x0 = torch.tensor([START], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(model)(
            x0, torch.zeros(1, round(SECONDS / dt), 0, dtype=torch.float64), x0[:, :0]
        )
    return states[0, -1].numpy()


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    model = SmoothPlant(0.1, "rk4")

    def rate(_: float, x: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            row = torch.from_numpy(x)[None]
            return model.rate(row, row, row)[0].numpy()

    solution = solve_ivp(rate, (0.0, SECONDS), START, method="DOP853", rtol=1e-13, atol=1e-14)
    return solution.y[:, -1]


@pytest.mark.parametrize(
    ("integrator", "order", "steps"),
    [
        ("rk4", 4, (0.2, 0.1)),
        ("heun", 2, (0.05, 0.025)),
        ("euler", 1, (0.02, 0.01)),
        ("semi_implicit_euler", 1, (0.02, 0.01)),
    ],
)
def test_order(
    integrator: Integrator, order: int, steps: tuple[float, float], truth: np.ndarray
) -> None:
    coarse, fine = (np.abs(run(integrator, dt) - truth)[:6] for dt in steps)
    assert np.log2(np.linalg.norm(coarse) / np.linalg.norm(fine)) == pytest.approx(order, abs=0.25)


def test_plant_with_held_commands_equals_dop853() -> None:
    """Propellers at their command, commands held over a step, current and force: SciPy integrates
    step by step.
    """
    plant = load_vessel("wam_v_cal").build()
    dt, steps = 0.1, 30
    rng = np.random.default_rng(0)
    n = np.array([25.0, 15.0])
    w = torch.zeros(1, steps, len(plant.inputs), dtype=torch.float64)
    w[:, :, :2] = torch.from_numpy(n)
    w[0, :, 2:5] = torch.from_numpy(rng.normal(size=(steps, 3)) * [30, 20, 20])
    w[0, :, 5:7] = torch.tensor([0.2, -0.1], dtype=torch.float64)
    w[0, :, 7:] = torch.tensor([15.0, -25.0], dtype=torch.float64)
    x0 = torch.tensor([[0.0, 0.0, 0.1, 1.0, 0.2, 0.2, *n]], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, dt, substeps=5))(x0, w, x0[:, :0])
    x = x0[0].numpy()
    for k in range(steps):
        held = w[:, k]

        def rate(_: float, y: np.ndarray, held: Tensor = held) -> np.ndarray:
            with torch.no_grad():
                return plant.rate(torch.from_numpy(y)[None], held)[0].numpy()

        x = solve_ivp(rate, (0.0, dt), x, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(states[0, k + 1], x, atol=3e-8)


def test_substeps_are_steps_of_the_plant() -> None:
    """Five sub-steps of 0.02 s under one command are five steps of 0.02 s."""
    plant = load_vessel("wam_v_vrx").build()
    rng = torch.Generator().manual_seed(0)
    w = torch.zeros(2, 20, len(plant.inputs), dtype=torch.float64)
    w[:, :, :2] = 40 * torch.rand(2, 20, 2, generator=rng, dtype=torch.float64) - 10
    x0 = torch.zeros(2, 8, dtype=torch.float64)
    with torch.no_grad():
        coarse, _, _ = Rollout(PlantDynamics(plant, 0.1, substeps=5))(x0, w, x0[:, :0])
        fine, _, _ = Rollout(PlantDynamics(plant, 0.02))(
            x0, w.repeat_interleave(5, dim=1), x0[:, :0]
        )
    torch.testing.assert_close(coarse, fine[:, ::5], rtol=1e-13, atol=1e-13)


def test_semi_implicit_euler_keeps_an_undamped_oscillation_bounded() -> None:
    """v' = -y, y' = v at heading zero: explicit Euler gains energy at every step, the semi-implicit
    scheme does not.
    """

    class Spring(Dynamics):
        def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
            zero = torch.zeros_like(x[:, 1])
            return torch.cat(
                (self.kinematics(x), torch.stack((zero, -x[:, 1], zero), dim=-1)), dim=-1
            )

        def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            return self.integrate(x, w, s), s

    x0 = torch.tensor([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    reach = {}
    for integrator in ("euler", "semi_implicit_euler"):
        states, _, _ = Rollout(Spring(0.1, integrator))(
            x0, torch.zeros(1, 2000, 0, dtype=torch.float64), x0[:, :0]
        )
        reach[integrator] = float(states[0, -200:, 1].abs().max())
    assert reach["euler"] > 1e3
    assert reach["semi_implicit_euler"] == pytest.approx(1.0, abs=0.1)
