"""Network heads with a skip connection: the network learns what a linear model leaves.

Source: Paduart et al. 2010 initialise a nonlinear model by its best linear approximation. Here the
approximation is a partial least squares regression (PLSR) on basis functions, which extrapolates
better than a network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.arrays import paged
from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import Features, ResidualHead
from residnet.heads.basis import BasisHead
from residnet.physics.signals import SoftVelocityLimit
from residnet.regression.estimator import Solution

_MIN_MARGIN = 0.02
"""Smallest margin of the network's weight, so that it is a continuous function."""


@final
class RangeWeight(nn.Module):
    """Weight of a network: 1 in the training range of the features, 0 far outside.

    The weight is exp(-sum (2 e / margin)^2), where e is the distance of a feature from its training
    range as a share of the width of the range. At the margin of a single feature it is .02.

    Args:
        features: features whose range counts.
    """

    def __init__(self, features: Features) -> None:
        super().__init__()
        n_features = features.n_features
        self.names = features.names
        self.margin = max(features.margin, _MIN_MARGIN)
        self.index = nn.Buffer(features.index.clone(), persistent=False)
        self.low = nn.Buffer(torch.full((n_features,), -torch.inf, dtype=torch.float64))
        self.high = nn.Buffer(torch.full((n_features,), torch.inf, dtype=torch.float64))
        self.decay = nn.Buffer(torch.zeros(n_features, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Compute the range of each feature; a constant feature does not change the weight."""
        moments, _ = samples.running_moments()
        self.low.copy_(moments.minimum[self.index])
        self.high.copy_(moments.maximum[self.index])
        width = self.high - self.low
        self.decay.copy_(torch.where(width > 0.0, 2.0 / (self.margin * width), width))

    def forward(self, z: Tensor) -> Tensor:
        """Return the weight [..., 1] at channels z [..., nz]."""
        values = z.index_select(-1, self.index)
        low = self.low.to(z.dtype)
        high = self.high.to(z.dtype)
        distance = values - torch.minimum(torch.maximum(values, low), high)
        return torch.exp(-(distance * self.decay.to(z.dtype)).square().sum(-1, keepdim=True))


@final
class SkipHead(ResidualHead):
    """Head with the residual rho = linear(z) + weight(z) network(z, s).

    The linear part is fitted in closed form before the training, which does not change it. Outside
    the training range, where a network is arbitrary, the residual is the linear part.

    Args:
        linear: linear part.
        network: network, whose output is zero before training.
        names: channels of the model.
        restoring: whether an acceleration returns velocities to their training range.
    """

    def __init__(
        self,
        linear: BasisHead,
        network: ResidualHead,
        names: Sequence[str],
        *,
        restoring: bool = False,
    ) -> None:
        super().__init__(names)
        self.linear = linear
        self.network = network
        self.weight = RangeWeight(linear.features)
        self.n_state = network.n_state
        self.restoring_acceleration: SoftVelocityLimit | None = (
            SoftVelocityLimit(n_channels=self.n_dof, n_dof=self.n_dof) if restoring else None
        )

    def set_step(self, dt: float) -> None:
        self.network.set_step(dt)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        rho, next_memory = self.network(z, s)
        return self.add_to_linear(z, rho), next_memory

    def add_to_linear(self, z: Tensor, network_residual: Tensor) -> Tensor:
        """Return the residual [..., n] from the residual of the network [..., n]."""
        linear: Tensor = self.linear(z, z[..., :0])[0]
        rho: Tensor = linear + self.weight(z) * network_residual
        if self.restoring_acceleration is not None:
            rho = rho + self.restoring_acceleration(z)
        return rho

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        return self.add_to_linear(z, self.network.teacher_forced_residuals(z))

    def warmup(self, z: Tensor) -> Tensor:
        return self.network.warmup(z)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        return self.network.memory_bounds()

    def calibrate(self, samples: Samples) -> None:
        """Fit the linear part and calibrate the network on what remains of the residual.

        The linear part is zero if the samples do not determine it, such as those of one manoeuvre.
        """
        self.weight.calibrate(samples)
        if self.restoring_acceleration is not None:
            self.restoring_acceleration.calibrate(samples)
        self.linear.calibrate(samples)
        solutions = self.linear_solutions(samples)
        if solutions:
            self.linear.load_state_dict(solutions[0].state, strict=False)
        self.calibrate_network(samples)

    def linear_solutions(self, samples: Samples) -> list[Solution]:
        """Return the solutions of the linear part, see `ClosedFormHead.fit_solutions`.

        The list is empty if the samples do not determine it.
        """
        try:
            return self.linear.fit_solutions(samples)
        except FitError:
            return []

    def calibrate_network(self, samples: Samples) -> None:
        """Calibrate the network on the residuals that the linear part leaves."""
        remainders = paged.allocate_rows(len(samples), self.n_dof)
        for rows in paged.iterate_row_chunks(len(samples)):
            z = samples.z[rows]
            torch.sub(samples.target[rows], self.linear(z, z[..., :0])[0], out=remainders[rows])
        self.network.calibrate(samples.with_target(remainders))

    def residual_scale(self) -> Tensor:
        return self.network.residual_scale()

    def zero_residual(self) -> None:
        self.linear.coefficients.zero_()
        self.linear.intercept.zero_()
        self.network.zero_residual()

    def parameter_counts(self) -> list[float]:
        """Return the number of trained parameters plus that of the linear part per axis."""
        counts = zip(self.network.parameter_counts(), self.linear.parameter_counts(), strict=True)
        return [n_network + n_linear for n_network, n_linear in counts]
