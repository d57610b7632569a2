"""One step of a free run, and the derivative of that step with respect to a baseline's parameters
and the offsets beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.baselines import Baseline, ParametricBaseline
from residnet.dynamics.hybrid import HybridDynamics


@final
class Shifted(Baseline):
    """A baseline with an acceleration of its own beside it for every row of a batch, growing with
    the square of the speed as hull forces do.

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
        """nu_dot [B, 3] at channels z [B, nz], which begin with u and v."""
        return self.baseline(z) + self.growth(z) * self.value.repeat(
            z.shape[0] // self.value.shape[0], 1
        )

    def growth(self, z: Tensor) -> Tensor:
        """Square of the speed over that at which the values hold, [B, 1]."""
        return z[:, :2].square().sum(1, keepdim=True) / self.speed**2

    def parameter_count(self) -> list[float]:
        """Parameters of each axis; the offsets are no part of the model."""
        return self.baseline.parameter_count()

    def sensitivity(self, z: Tensor) -> Tensor:
        """Derivative of nu_dot [B, 3, P + a] with respect to the baseline's free parameters and
        to the row's own offsets.
        """
        return torch.cat(
            (self.baseline.sensitivity(z), self.growth(z).unsqueeze(-1) * self.unit), dim=2
        )


def ahead(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """State one step later; of an Euler scheme with the mean yaw rate for the heading."""
    if len(model.nodes) > 1:
        return model.integrate(x, p, torch.zeros_like(x[:, :3]))
    nu = x[:, 3:] + model.dt * model.baseline(model.signals(x, p))
    psi = x[:, 2] + 0.5 * model.dt * (nu[:, 2] + x[:, 5])
    return torch.cat((x[:, :2], psi[:, None], nu), dim=-1)


def carried(
    model: HybridDynamics, baseline: ParametricBaseline | Shifted, x: Tensor, p: Tensor, s: Tensor
) -> Tensor:
    """Sensitivities of (psi, u, v, r) to the parameters one step later, [B, 4, P], from s [B, 4, P]
    at the states x: the scheme's own derivative.
    """
    change, total = torch.zeros_like(s), torch.zeros_like(s)
    place = x
    for node, weight in zip(model.nodes, model.weights, strict=True):
        here = s + node * model.dt * change
        if node > 0.0:
            place = x + node * model.dt * model.rate(place, p, torch.zeros_like(x[:, :3]))
        nu = _slopes(model, place, p) @ here + baseline.sensitivity(model.signals(place, p))
        change = torch.cat((here[:, 3:], nu), dim=1)
        total = total + weight * change
    after = s + model.dt * total
    if len(model.nodes) == 1:
        after = torch.cat(
            (s[:, :1] + 0.5 * model.dt * (after[:, 3:] + s[:, 3:]), after[:, 1:]), dim=1
        )
    return after


def _slopes(model: HybridDynamics, x: Tensor, p: Tensor) -> Tensor:
    """Derivative of nu_dot with respect to (psi, u, v, r), [B, 3, 4], by forward differentiation
    along the four directions at once.
    """
    batch = x.shape[0]
    tangent = torch.zeros(4, batch, x.shape[1], dtype=x.dtype)
    for direction in range(4):
        tangent[direction, :, 2 + direction] = 1.0
    repeated, inputs = x.repeat(4, 1), p.repeat(4, 1)
    slopes = torch.func.jvp(
        lambda state: model.baseline(model.signals(state, inputs)),
        (repeated,),
        (tangent.reshape(-1, x.shape[1]),),
    )[1]
    return slopes.reshape(4, batch, 3).permute(1, 2, 0)
