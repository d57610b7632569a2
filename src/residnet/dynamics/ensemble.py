"""The mean of several models as one model.

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
        return _summed([member.parameter_count() for member in self.members])  # type: ignore[operator]


@final
class MeanHead(ResidualHead):
    """A head that is the mean residual of several; the memory holds theirs side by side."""

    def __init__(self, members: Sequence[ResidualHead]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)
        self.widths = [member.n_state for member in members]
        self.n_state = sum(self.widths)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, 3] at channels z [B, nz] and the memory for the next step."""
        total = zero_acceleration(z)
        memory: list[Tensor] = []
        begin = 0
        for i, member in enumerate(self.members):
            rho, after = member(z, s[..., begin : begin + self.widths[i]])
            total = total + rho
            memory.append(after)
            begin += self.widths[i]
        return total / len(self.members), torch.cat(memory, dim=-1)

    def told_apart(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean and standard deviation of the members' residuals [B, 3], and the memory."""
        told: list[Tensor] = []
        memory: list[Tensor] = []
        begin = 0
        for i, member in enumerate(self.members):
            rho, after = member(z, s[..., begin : begin + self.widths[i]])
            told.append(rho)
            memory.append(after)
            begin += self.widths[i]
        mean, deviation = _agreement(torch.stack(told))
        return mean, deviation, torch.cat(memory, dim=-1)

    def sequence_told_apart(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of the members' residuals [B, T, 3] along z."""
        told: list[Tensor] = []
        for member in self.members:
            told.append(member.sequence(z))  # type: ignore[operator]
        return _agreement(torch.stack(told))

    def sequence(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, 3] along channels [B, T, nz], from an empty memory."""
        total = zero_acceleration(z)
        for member in self.members:
            total = total + member.sequence(z)  # type: ignore[operator]
        return total / len(self.members)

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
        ranges = [member.memory_range() for member in self.members]  # type: ignore[operator]
        return torch.cat([low for low, _ in ranges]), torch.cat([high for _, high in ranges])

    def parameter_count(self) -> list[float]:
        """Return the parameters of each axis, those of all members together."""
        return _summed([member.parameter_count() for member in self.members])  # type: ignore[operator]


def _agreement(told: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation [..., 3] of what members tell [K, ..., 3]."""
    mean = told.mean(dim=0)
    # the root has no slope at zero
    return mean, torch.sqrt((told - mean).square().mean(dim=0) + 1e-18)


def _summed(counts: Sequence[Sequence[float]]) -> list[float]:
    return [sum(axis) for axis in zip(*counts, strict=True)]


def mean_of(members: Sequence[HybridDynamics]) -> HybridDynamics:
    """Return the mean of models with the same signals, step and integrator."""
    first = members[0]
    baseline, head = (
        MeanBaseline([member.head.effective_baseline(member.baseline) for member in members]),
        MeanHead([member.head for member in members]),
    )
    return HybridDynamics(first.signals, baseline, head, first.dt, first.integrator)
