"""The interface of residual heads, and the scaling and guard that all of them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.arrays import paged
from residnet.core.columns import zero_acceleration
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.layout import PLANAR
from residnet.core.names import ACCELERATION, nearest
from residnet.core.samples import Samples
from residnet.physics.signals import VelocityBound
from residnet.physics.symmetry import live_of, without_dead
from residnet.regression.estimator import Solution
from residnet.regression.shrinkage import CONSTANT

_LEAST_STD = 1e-9
"""Least standard deviation of a residual that a network's output is scaled by, SI."""


class ResidualHead(nn.Module, ABC):
    """A head: the residual rho [B, n] from channels z [B, nz] and memory s [B, n_state].

    It is in m/s^2, m/s^2 and rad/s^2, on top of the baseline.

    A memoryless head has n_state = 0. Every head is scriptable, however its parameters were found,
    but those with a `refusal`.

    Attributes:
        outputs: names of what it gives.
        copies: number of networks that it holds; rows are then those of one after the other.
        settle: time in s over which it wants to know how wrong accelerations were predicted: n
            channels more, behind the others; 0 for none.
        refusal: why no format of export can hold it; empty where they can.

    Args:
        names: channels of the model, which say what moves; u, v and r where they say nothing.
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        super().__init__()
        self.dof, self.outputs = live_of(names).size, live_of(names).rates
        self.n_state = 0
        self.copies = 1
        self.settle = 0.0
        self.refusal = ""

    def set_step(self, dt: float) -> None:
        """Take the step of the model in s; most heads need none."""

    @abstractmethod
    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, n] at channels z [B, nz], and the memory for the next step.

        Called once per step; the memory is [B, n_state].
        """

    def sequence(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, n] along measured channels [B, T, nz], from an empty memory.

        In other words, teacher forcing.
        """
        return self.forward(z, z[..., :0])[0]

    def accelerations(self, known: Tensor, rho: Tensor) -> Tensor:
        """Return nu_dot [..., n] from the baseline's `known` and this head's residual, [..., n]."""
        return known + rho

    def residual_target(self, samples: Samples, known: Tensor) -> Samples:
        """Return the samples with what the baseline leaves as target, in this head's space.

        The baseline's accelerations are `known` [N, n].
        """
        left = paged.rows(len(samples), samples.target.shape[1])
        for rows in paged.row_pieces(len(samples)):
            torch.sub(samples.target[rows], known[rows], out=left[rows])
        return samples.with_target(left)

    def set_mass(self, mass: Tensor | None) -> None:
        """Take the inertia [3, 3] of the baseline, None where it knows no forces.

        Most heads need none.

        Raises:
            ConfigError: where a head needs one and there is none.
        """

    def effective_baseline(self, baseline: nn.Module) -> nn.Module:
        """Return the baseline as this head changes it.

        Its acceleration plus the residual is nu_dot.
        """
        return baseline

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] that past channels [B, T, nz], oldest first, leave."""
        return torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and the largest value [n_state] that each entry of the memory can have.

        An exported model refuses a memory beyond it. Heads that do not say it take any number.
        """
        limit = torch.full((self.n_state,), torch.inf, dtype=torch.float64)
        return -limit, limit

    def calibrate(self, samples: Samples) -> None:
        """Take scales and ranges from the training samples; called once, before the fit.

        The features, the scale and the bound that a head is made of take theirs by themselves.
        """
        for part in self.modules():
            if isinstance(part, Features | ResidualScale | VelocityBound):
                part.calibrate(samples)

    def residual_std(self) -> Tensor:
        """Return the standard deviation of the residual on the training samples, [n], float64.

        A one-step loss is measured in it; ones where a head keeps none.
        """
        return torch.ones(self.dof, dtype=torch.float64)

    def parameter_count(self) -> list[float]:
        """Return the number of fitted parameters of each axis, all trained ones for each."""
        return [float(sum(parameter.numel() for parameter in self.parameters()))] * self.dof


class ClosedFormHead(ResidualHead):
    """A head whose parameters come from a closed-form solution."""

    def require_samples(self, samples: Samples) -> None:
        """Check that samples are of as many manoeuvres as the fit divides them into.

        Raises:
            FitError: where they are not.
        """

    @abstractmethod
    def solutions(self, samples: Samples) -> list[Solution]:
        """Fit samples whose target is the residual [N, n].

        The solution that one-step errors choose stands first, then those that free runs may prefer.

        Raises:
            FitError: where the data do not determine the parameters.
        """

    def solve(self, samples: Samples) -> dict[str, Any]:
        """Fill the buffers with the first of `solutions` and return the notes of the fit."""
        first = self.solutions(samples)[0]
        self.load_state_dict(first.state, strict=False)
        return first.choice | first.notes

    def parameter_count(self) -> list[float]:
        """Return the number of fitted parameters of each axis.

        Coefficients [J, n] and intercepts [n] that are not zero, where a head does not count
        otherwise.
        """
        fitted = [
            numbers.reshape(-1, self.dof)
            for name, numbers in self.named_buffers()
            if name in ("coefficients", "intercept")
        ]
        return [float((torch.cat(fitted)[:, axis] != 0).sum()) for axis in range(self.dof)]


class EquationHead(ClosedFormHead):
    """A closed-form head that is a sum of few terms."""

    @abstractmethod
    def names(self) -> list[str]:
        """Return the terms in writing, [J]."""

    @abstractmethod
    def along(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the terms [T, J] along channels z [T, nz], and their coefficients [J, n]."""

    def contributions(self, z: Tensor, axis: int) -> dict[str, np.ndarray]:
        """Return each term of an axis times its coefficient [T], along channels z [T, nz]."""
        with torch.no_grad():
            terms, weights = self.along(z)
            values = (terms * weights[:, axis].to(z.dtype)).numpy()
        kept = weights[:, axis].tolist()
        return {name: values[:, j] for j, name in enumerate(self.names()) if kept[j] != 0.0}


class FeatureConfig(Config):
    """The channels that a head sees, and how far beyond the training range it follows them.

    Attributes:
        features: names of channels; empty for all.
        margin: share of the training range that it is widened by. Features are held at the edges of
            the wider range; outside, the residual stays what it was at the edge instead of running
            away.
    """

    features: tuple[str, ...] = ()
    margin: float = Field(default=0.1, ge=0)

    def chosen(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the features among the channels `names`.

        Raises:
            ConfigError: where a feature is no channel.
        """
        for name in self.features:
            if name in ACCELERATION and name not in names:
                raise ConfigError(
                    f"head feature '{name}' is an acceleration: only a residual in force space"
                    " knows it (plsr or ridge, space: force)"
                )
            if name not in names:
                raise ConfigError(
                    f"head feature '{name}' is not a channel of the model{nearest(name, names)}"
                )
        return self.features or without_dead(names)


class HeadKind(FeatureConfig, ABC):
    """The config of a head that another package offers: its `kind` and how the head is built.

    Attributes:
        kind: a `Literal` with the name of the entry point in the group `residnet.heads`.
    """

    kind: str

    @abstractmethod
    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the head, its numbers not yet found, for channels `names`.

        Raises:
            ConfigError: where a channel that it needs is missing.
        """


class Features(nn.Module):
    """The selected, guarded and standardised channels: z [..., nz] -> [..., F].

    They are near zero mean and unit variance on the training data.
    """

    def __init__(self, chosen: Sequence[str], names: Sequence[str], margin: float) -> None:
        super().__init__()
        self.names, self.dof = tuple(chosen), live_of(names).size
        self.count = len(self.names)
        self.margin = margin
        self.index = _places([list(names).index(name) for name in chosen])
        self.mean = nn.Buffer(torch.zeros(self.count, dtype=torch.float64))
        self.std = nn.Buffer(torch.ones(self.count, dtype=torch.float64))
        self.low = nn.Buffer(torch.full((self.count,), -torch.inf, dtype=torch.float64))
        self.high = nn.Buffer(torch.full((self.count,), torch.inf, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Take mean, standard deviation and range of each feature from the samples.

        A constant feature is left unscaled.
        """
        tally, _ = samples.tally()
        low, high, std = (part[self.index] for part in (tally.low, tally.high, tally.std()))
        reach = self.margin * (high - low)
        self.mean.copy_(tally.mean[self.index])
        self.std.copy_(
            torch.where(std > CONSTANT * (1 + self.mean.abs()), std, torch.ones_like(std))
        )
        self.low.copy_(low - reach)
        self.high.copy_(high + reach)

    def guarded(self, z: Tensor) -> Tensor:
        """Return the selected channels [..., F], held at the edge of the training range."""
        return self.held(z.index_select(-1, self.index))

    def held(self, chosen: Tensor) -> Tensor:
        """Return channels that are selected already [..., F], held at the edge of the range."""
        return torch.minimum(
            torch.maximum(chosen, self.low.to(chosen.dtype)), self.high.to(chosen.dtype)
        )

    def forward(self, z: Tensor) -> Tensor:
        """Return the standardised features [..., F]."""
        return (self.guarded(z) - self.mean.to(z.dtype)) / self.std.to(z.dtype)


def _places(of: Sequence[int]) -> nn.Buffer:
    return nn.Buffer(torch.tensor(of, dtype=torch.long), persistent=False)


class ResidualScale(nn.Module):
    """The scale between a network's output near one and accelerations.

    It is the standard deviation of the residual on the training samples.
    """

    def __init__(self, dof: int = PLANAR.dof) -> None:
        super().__init__()
        self.spread = nn.Buffer(torch.ones(dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Take the standard deviation of each axis from the samples' target."""
        self.spread.copy_(samples.tally()[1].std().clamp(min=_LEAST_STD))

    def forward(self, out: Tensor) -> Tensor:
        """Return residual accelerations [..., n] for outputs [..., n] near one."""
        return out * self.spread.to(out.dtype)


@final
class ZeroHead(ResidualHead):
    """A head without a residual, rho = 0: the baseline alone."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return zero_acceleration(z, self.dof), s
