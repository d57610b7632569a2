"""The default fit of a baseline: nonlinear least squares of all its parameters."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline, fit_parameters
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.testing import make_example_samples

VELOCITIES = ("u", "v", "r")


@pytest.fixture(scope="module")
def samples() -> Samples:
    """Samples of simulated trials."""
    return make_example_samples()


def velocity_columns(samples: Samples) -> list[int]:
    """Return the columns of surge, sway and yaw rate."""
    return [samples.names.index(name) for name in VELOCITIES]


class Damping(Baseline):
    """nu_dot = d nu, with d = raw^2 - 1 if squared."""

    def __init__(
        self, samples: Samples, squared: bool = False, n_unused: int = 0, copies: int = 1
    ) -> None:
        super().__init__()
        self.columns = velocity_columns(samples)
        self.squared = squared
        self.raw = nn.Parameter(torch.full((copies, 3), 0.5, dtype=torch.float64))
        self.unused = nn.Parameter(torch.zeros(n_unused, dtype=torch.float64))

    def forward(self, z: Tensor) -> Tensor:
        factor = self.raw.sum(0).to(z.dtype)
        return (factor**2 - 1.0 if self.squared else factor) * z[..., self.columns]


def least_squares(samples: Samples) -> np.ndarray:
    nu = samples.z[:, velocity_columns(samples)]
    return ((nu * samples.target).sum(0) / nu.square().sum(0)).numpy()


def test_fit_parameters_of_a_linear_baseline_is_least_squares(samples) -> None:
    assert len(samples) <= 4000
    solution = fit_parameters(Damping(samples), samples)
    np.testing.assert_allclose(solution.state["raw"][0], least_squares(samples), rtol=1e-8)
    assert [entry.term for entry in solution.table] == ["raw[0]", "raw[1]", "raw[2]"]
    assert all(entry.standard_error > 0 for entry in solution.table)


def test_fit_parameters_of_a_nonlinear_baseline_reaches_the_same_minimum(samples: Samples) -> None:
    raw = fit_parameters(Damping(samples, squared=True), samples).state["raw"][0]
    reachable = np.maximum(least_squares(samples), -1.0)
    np.testing.assert_allclose(raw**2 - 1.0, reachable, atol=1e-3)


def test_fit_parameters_rejects_a_parameter_without_effect(samples: Samples) -> None:
    with pytest.raises(FitError, match="parameter 'unused' of the baseline has no effect"):
        fit_parameters(Damping(samples, n_unused=1), samples)


def test_fit_parameters_rejects_collinear_parameters(samples: Samples) -> None:
    with pytest.raises(FitError, match=r"raw\[0\].* collinear"):
        fit_parameters(Damping(samples, copies=2), samples)
