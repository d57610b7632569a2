"""The lag of actuators against SciPy's integration and against a vessel with known lag."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from residnet.autopilot.actuator_lag import fit_lag, simulate_lagged_force
from residnet.autopilot.motion_config import ActuatorLag
from residnet.core.errors import FitError

DT = 0.1


def commands(n: int = 1200) -> torch.Tensor:
    t = np.arange(n) * DT
    columns = [
        np.sin(0.31 * t + a) + 0.5 * np.sin(1.3 * t * (1 + 0.1 * a)) - np.sin(a)
        for a in (0.0, 1.0, 2.0)
    ]
    return torch.from_numpy(np.stack(columns, axis=1) * [100.0, 50.0, 200.0])


@pytest.mark.parametrize("delay", [0.0, 0.23])
def test_followed_is_the_differential_equation(delay: float) -> None:
    u = commands(200).numpy()[:, 1]
    t = np.arange(200) * DT
    late = np.interp(t - delay, t, u, left=0.0)

    def rate(time: float, y: np.ndarray) -> list[float]:
        return [y[1], 9.0 * (np.interp(time, t, late) - y[0]) - 2 * 0.6 * 3.0 * y[1]]

    wanted = solve_ivp(rate, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.02)
    lag = ActuatorLag(frequency=3.0, damping=0.6, delay=delay)
    mine = simulate_lagged_force(commands(200), lag, DT)[:, 1].numpy()
    # a delayed polygon has its corners between samples: exact only where the delay is a whole
    # number of them
    np.testing.assert_allclose(mine, wanted.y[0], atol=1e-5 if delay == 0 else 0.5)


@pytest.mark.parametrize(
    "true",
    [ActuatorLag(frequency=2.0, damping=0.8), ActuatorLag(frequency=4.0, damping=0.5, delay=0.3)],
)
def test_lag_and_regression_together(true: ActuatorLag) -> None:
    command = commands()
    acting = simulate_lagged_force(command, true, DT)
    velocity = torch.cumsum(acting, 0) * DT / 1000.0
    basis = torch.cat((velocity, velocity * velocity.abs(), acting / 1000.0), dim=1)
    needed = 2.0 * acting + 30.0 * velocity
    found = fit_lag(command, needed, basis, DT)
    assert found.frequency == pytest.approx(true.frequency, rel=0.02)
    assert found.damping == pytest.approx(true.damping, rel=0.03)
    assert found.delay == pytest.approx(true.delay, abs=0.02)


def test_a_constant_command_shows_no_lag() -> None:
    with pytest.raises(FitError, match="constant"):
        fit_lag(commands(50) ** 0, torch.zeros(50, 3), torch.rand(50, 2).double(), DT)
