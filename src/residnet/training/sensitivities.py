"""Derivatives of a rollout's step with respect to a baseline's parameters and offsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.baselines.base import Baseline, ParametricBaseline
from residnet.core.layout import HEADING, PLANAR, YAW_RATE, zero_acceleration
from residnet.dynamics.hybrid import HybridDynamics

# sensitivities have a row for the heading and one for each velocity
_HEADING_ROW = slice(0, 1)
_YAW_RATE_ROW = slice(YAW_RATE - HEADING, len(PLANAR.names) - HEADING)


@final
class OffsetBaseline(Baseline):
    """A baseline with an acceleration of its own for every row of a batch.

    The accelerations grow with the square of the speed, as hull forces do.

    Args:
        baseline: as it is without.
        value: accelerations [B, 3] at `speed`; a batch of several times B rows repeats them.
        axes: a of surge, sway and yaw (0, 1, 2), in which the values may move.
        speed: in m/s.
    """

    def __init__(
        self, baseline: ParametricBaseline, value: Tensor, axes: Sequence[int], speed: float
    ) -> None:
        super().__init__()
        self.baseline = baseline
        self.value = value
        self.unit = torch.eye(3, dtype=value.dtype)[:, list(axes)]
        self.speed = speed

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [B, 3] at channels z [B, nz], which begin with u and v."""
        offsets = self.value.repeat(z.shape[0] // self.value.shape[0], 1)
        nu_dot: Tensor = self.baseline(z) + self.growth(z) * offsets
        return nu_dot

    def growth(self, z: Tensor) -> Tensor:
        """Return the square of the speed over that at which the values hold, [B, 1]."""
        return z[:, :2].square().sum(1, keepdim=True) / self.speed**2

    def along(self, z: Tensor, ahead: Tensor) -> Tensor:
        """Return the derivatives of nu_dot [D, B, 3] at z [B, nz] along directions [D, B, nz]."""
        offsets = self.value.repeat(z.shape[0] // self.value.shape[0], 1)
        growth = 2.0 * (z[:, :2] * ahead[..., :2]).sum(-1, keepdim=True) / self.speed**2
        return self.baseline.along(z, ahead) + growth * offsets

    def parameter_count(self) -> list[float]:
        """Return the parameters of each axis; the offsets are no part of the model."""
        return self.baseline.parameter_count()

    def sensitivity(self, z: Tensor) -> Tensor:
        """Return the derivative of nu_dot by free parameters and offsets, [B, 3, P + a].

        The parameters are those that the baseline may move; the offsets are the row's own.
        """
        return torch.cat(
            (self.baseline.sensitivity(z), self.growth(z).unsqueeze(-1) * self.unit), dim=2
        )


def step_sensitivities(
    model: HybridDynamics,
    baseline: ParametricBaseline | OffsetBaseline,
    x: Tensor,
    p: Tensor,
    s: Tensor,
) -> Tensor:
    """Return the sensitivities of (psi, u, v, r) one step later, [B, 4, P].

    They are the exact derivative of `Dynamics.integrate` with the residual at zero, whatever the
    integrator.

    Args:
        model: that steps.
        baseline: its baseline.
        x: states at the step's start [B, 6].
        p: prepared inputs, held over the step [B, k].
        s: sensitivities at the step's start [B, 4, P].
    """
    stage_x, stage_s = x, s
    after, stage_rate = s, s
    for node, weight in zip(model.nodes, model.weights, strict=True):
        if node > 0.0:
            stage_s = torch.add(s, stage_rate, alpha=node * model.dt)
            residual = zero_acceleration(x)
            stage_x = x + node * model.dt * model.rate(stage_x, p, residual)
        z = model.signals(stage_x, p)
        slopes = baseline.along(z, model.signals.slopes(stage_x, p)).permute(1, 2, 0)
        nu_dot = torch.baddbmm(baseline.sensitivity(z), slopes, stage_s)
        stage_rate = torch.cat((stage_s[:, _YAW_RATE_ROW], nu_dot), dim=1)
        after = torch.add(after, stage_rate, alpha=weight * model.dt)
    if model.semi_implicit:
        # the heading moves with the new yaw rate
        turned = s[:, _HEADING_ROW] + model.dt * after[:, _YAW_RATE_ROW]
        after = torch.cat((turned, after[:, _HEADING_ROW.stop :]), dim=1)
    return after
