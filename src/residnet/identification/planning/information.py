"""What a run of a model would tell about its parameters, and how sure it would then be."""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.baselines import ParametricBaseline
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.sensitivities import step_sensitivities


@torch.no_grad()
def moments(
    model: HybridDynamics, states: Tensor, w: Tensor, horizon: int, scales: Tensor
) -> Tensor:
    """Return the sum over a run's samples of squared sensitivities of u, v, r in scales, [P, P].

    The run is cut into free runs of `horizon` steps, each from its own measured state, as a refit
    takes it.

    Args:
        model: a baseline without a head.
        states: of the run [T + 1, 6].
        w: inputs held over each step [T, m].
        horizon: steps of the free runs of a refit.
        scales: of the velocities [3].
    """
    baseline = model.baseline
    assert isinstance(baseline, ParametricBaseline)
    count = max(len(w) // horizon, 1)
    steps = min(horizon, len(w))
    starts = torch.arange(count) * horizon
    size = int(baseline.free_indices().numel())
    s = torch.zeros(count, 4, size, dtype=states.dtype)
    out = torch.zeros(size, size, dtype=states.dtype)
    for k in range(steps):
        p = model.signals.prepare(w[starts + k])
        s = step_sensitivities(model, baseline, states[starts + k], p, s)
        seen = (s[:, 1:] / scales[:, None]).reshape(-1, size)
        out.addmm_(seen.T, seen)
    return out


def after(covariance: Tensor, information: Tensor) -> Tensor:
    """Return the covariance [P, P] once data of some information [P, P] are in.

    Parameters that have no covariance stay as they are.
    """
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    return covariance @ torch.linalg.inv(eye + information @ covariance)


def volume_gain(covariance: Tensor, information: Tensor) -> float:
    """Return by how much the logarithm of the ellipsoid's volume shrinks (D-optimality)."""
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    return 0.5 * float(torch.linalg.slogdet(eye + information @ covariance)[1])


def spread(covariance: Tensor, goal: Tensor) -> float:
    """Return the root mean square uncertainty of what a goal [P, P] weighs (A-optimality)."""
    return float((goal * covariance).sum().clamp(min=0.0).sqrt())
