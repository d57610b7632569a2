"""What a run of a model would tell about its parameters, and how sure it would then be."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from residnet.baselines import ParametricBaseline
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.sensitivities import step_sensitivities


@torch.no_grad()
def moments(
    model: HybridDynamics, runs: Sequence[tuple[Tensor, Tensor]], horizon: int, scales: Tensor
) -> Tensor:
    """Return the sums over each run's samples of squared sensitivities of u, v, r, [R, P, P].

    They are in scales. Each run is cut into free runs of `horizon` steps, each from its own
    measured state, as a refit takes it; what is left at the end does not count.

    Args:
        model: a baseline without a head.
        runs: states [T + 1, 6] and inputs held over each step [T, m] of R runs.
        horizon: steps of the free runs of a refit.
        scales: of the velocities [3].
    """
    baseline = model.baseline
    assert isinstance(baseline, ParametricBaseline)
    places = [
        (run, k * horizon) for run, (_, w) in enumerate(runs) for k in range(len(w) // horizon)
    ]
    size = int(baseline.free_indices().numel())
    out = torch.zeros(len(runs), size, size, dtype=scales.dtype)
    if not places:
        return out
    number = torch.tensor([run for run, _ in places])
    x = torch.stack([runs[run][0][start : start + horizon] for run, start in places])
    w = torch.stack([runs[run][1][start : start + horizon] for run, start in places])
    s = torch.zeros(len(places), 4, size, dtype=scales.dtype)
    for k in range(horizon):
        s = step_sensitivities(model, baseline, x[:, k], model.signals.prepare(w[:, k]), s)
        seen = s[:, 1:] / scales[:, None]
        out.index_add_(0, number, seen.transpose(1, 2) @ seen)
    return out


def after(covariance: Tensor, information: Tensor) -> Tensor:
    """Return the covariance [P, P] once data of some information [P, P] are in.

    Parameters that have no covariance stay as they are.
    """
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    left: Tensor = covariance @ torch.linalg.inv(eye + information @ covariance)
    return left


def volume_gain(covariance: Tensor, information: Tensor) -> float:
    """Return by how much the logarithm of the ellipsoid's volume shrinks (D-optimality)."""
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    return 0.5 * float(torch.linalg.slogdet(eye + information @ covariance)[1])


def spread(covariance: Tensor, goal: Tensor) -> float:
    """Return the root mean square uncertainty of what a goal [P, P] weighs (A-optimality)."""
    return float((goal * covariance).sum().clamp(min=0.0).sqrt())
