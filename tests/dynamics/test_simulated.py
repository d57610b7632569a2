"""Plants in discrete time: inputs held over a step, or moving within it."""

from __future__ import annotations

import numpy as np
import torch
from kinds import of_kind
from scipy.integrate import solve_ivp
from staged_plant import StagedPlantDynamics

from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.actuators import DifferentialThrust
from residnet.physics.vessel import load_vessel


def test_inputs_that_move_within_a_step() -> None:
    """A sine of force given at the start, middle and end of each step: SciPy sees the same function
    of time.
    """
    plant = load_vessel("wam_v_cal").build()
    dt, steps = 0.05, 200

    def force(t: np.ndarray) -> np.ndarray:
        w = np.zeros((*np.shape(t), len(plant.inputs)))
        w[..., 2] = 100 * np.sin(1.3 * t)
        w[..., 4] = 80 * np.sin(2.1 * t + 0.4)
        return w

    t = dt * np.arange(steps)
    w = torch.from_numpy(np.concatenate([force(t), force(t + dt / 2), force(t + dt)], axis=-1))[
        None
    ]
    x0 = torch.tensor([[0.0, 0.0, 0.1, 1.0, 0.1, 0.05, 20.0, 18.0]], dtype=torch.float64)
    held = of_kind(plant.actuators, DifferentialThrust).n_max
    assert float(x0[0, 6:].max()) < held
    w[..., 0::9], w[..., 1::9] = 20.0, 18.0
    with torch.no_grad():
        states, _, _ = Rollout(StagedPlantDynamics(plant, dt))(x0, w, x0[:, :0])

    def rate(time: float, y: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return plant.rate(
                torch.from_numpy(y)[None], torch.from_numpy(force(np.asarray([time])))
            )[0].numpy()

    truth = solve_ivp(
        rate, (0.0, dt * steps), x0[0].numpy(), method="DOP853", rtol=1e-11, atol=1e-12
    ).y[:, -1]
    np.testing.assert_allclose(states[0, -1], truth, atol=2e-7)


def test_held_inputs_are_the_same_at_every_stage() -> None:
    plant = load_vessel("wam_v_cal").build()
    w = (
        torch.randn(
            3,
            40,
            len(plant.inputs),
            dtype=torch.float64,
            generator=torch.Generator().manual_seed(0),
        )
        * 10
    )
    w[..., 5:7] *= 0.01
    x0 = torch.zeros(3, 8, dtype=torch.float64)
    with torch.no_grad():
        held, _, _ = Rollout(PlantDynamics(plant, 0.02))(x0, w, x0[:, :0])
        staged, _, _ = Rollout(StagedPlantDynamics(plant, 0.02))(x0, w.repeat(1, 1, 3), x0[:, :0])
    torch.testing.assert_close(staged, held, rtol=1e-12, atol=1e-13)
