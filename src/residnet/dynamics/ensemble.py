"""Several models as one: the mean of models, and one model with many sets of parameters.

Accelerations are averaged inside one free run, so that it steps, warms up and exports like any
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.layout import zero_acceleration
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ResidualHead


@final
class MeanBaseline(Baseline):
    """A baseline that is the mean acceleration of several baselines."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        total = zero_acceleration(z)
        for member in self.members:
            total = total + member(z)
        return total / len(self.members)

    def parameter_count(self) -> list[float]:
        """Return the parameters of each axis, those of all members together."""
        return _parameters(self.members)


@final
class MeanHead(ResidualHead):
    """A head that is the mean residual of several; the memory holds theirs side by side."""

    def __init__(self, members: Sequence[ResidualHead]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)
        self.widths = [member.n_state for member in members]
        self.n_state = sum(self.widths)

    def _each(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the members' residuals [K, B, 3] and their memories side by side."""
        residuals: list[Tensor] = []
        memory: list[Tensor] = []
        begin = 0
        for i, member in enumerate(self.members):
            rho, after = member(z, s[..., begin : begin + self.widths[i]])
            residuals.append(rho)
            memory.append(after)
            begin += self.widths[i]
        return torch.stack(residuals), torch.cat(memory, dim=-1)

    def _sequences(self, z: Tensor) -> Tensor:
        """Return the members' residuals [K, B, T, 3] along channels [B, T, nz]."""
        residuals: list[Tensor] = []
        for member in self.members:
            residuals.append(member.sequence(z))  # type: ignore[operator]
        return torch.stack(residuals)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, 3] at channels z [B, nz] and the memory for the next step."""
        residuals, memory = self._each(z, s)
        return residuals.mean(dim=0), memory

    def with_spread(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean and standard deviation of the members' residuals [B, 3], and the memory."""
        residuals, memory = self._each(z, s)
        mean, deviation = _agreement(residuals)
        return mean, deviation, memory

    def sequence(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, 3] along channels [B, T, nz], from an empty memory."""
        return self._sequences(z).mean(dim=0)

    def sequence_with_spread(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of the members' residuals [B, T, 3] along z."""
        return _agreement(self._sequences(z))

    def warms_by_steps(self) -> bool:
        """Return whether all members do."""
        return all(member.warms_by_steps() for member in self.members)  # type: ignore[operator]

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] that past channels [B, T, nz] leave."""
        memory: list[Tensor] = []
        for member in self.members:
            memory.append(member.warmup(z))  # type: ignore[operator]
        return torch.cat(memory, dim=-1)

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], that of all members side by side."""
        low, high = zip(*(member.memory_range() for member in self.members), strict=True)  # type: ignore[operator]
        return torch.cat(low), torch.cat(high)

    def parameter_count(self) -> list[float]:
        """Return the parameters of each axis, those of all members together."""
        return _parameters(self.members)


def _agreement(residuals: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation [..., 3] of members' residuals [K, ..., 3]."""
    mean = residuals.mean(dim=0)
    # the root has no slope at zero
    return mean, torch.sqrt((residuals - mean).square().mean(dim=0) + 1e-18)


def _parameters(members: nn.ModuleList) -> list[float]:
    counts = [member.parameter_count() for member in members]  # type: ignore[operator]
    return [sum(axis) for axis in zip(*counts, strict=True)]


def mean_of(members: Sequence[HybridDynamics]) -> HybridDynamics:
    """Return the mean of models with the same signals, step and integrator."""
    first = members[0]
    baselines = [member.head.effective_baseline(member.baseline) for member in members]
    head = MeanHead([member.head for member in members])
    return HybridDynamics(first.signals, MeanBaseline(baselines), head, first.dt, first.integrator)


@final
class SampledDynamics(Dynamics):
    """A model that runs with many samples of one parameter side by side.

    Rows [M * D] of a batch are M manoeuvres with D samples each (samples vary fastest); sample d
    runs with theta[d] in place of the parameter.

    Args:
        dynamics: the model, memoryless or not.
        name: of the parameter within `dynamics`.
        theta: its values by draw, [D, ...].
    """

    def __init__(self, dynamics: Dynamics, name: str, theta: Tensor) -> None:
        super().__init__(dynamics.dt, dynamics.integrator)
        self.stepped = _Stepped(dynamics)
        self.name, self.theta = name, theta
        self.n_state = dynamics.n_state

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later, each draw with its own parameters."""
        draws, parameter = self.theta.shape[0], f"dynamics.{self.name}"

        def one(theta: Tensor, *rows: Tensor) -> tuple[Tensor, Tensor]:
            after: tuple[Tensor, Tensor] = torch.func.functional_call(
                self.stepped, {parameter: theta}, rows
            )
            return after

        split = [part.reshape(-1, draws, part.shape[-1]) for part in (x, w)]
        split.append(s.reshape(x.shape[0] // draws, draws, s.shape[-1]))
        after, memory = torch.vmap(one, in_dims=(0, 1, 1, 1), out_dims=1)(self.theta, *split)
        return after.reshape(x.shape), memory.reshape(s.shape)


@final
class _Stepped(nn.Module):
    """The step of a model as the forward of a module, as `functional_call` wants it."""

    def __init__(self, dynamics: Dynamics) -> None:
        super().__init__()
        self.dynamics = dynamics

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        return self.dynamics.step(x, w, s)
