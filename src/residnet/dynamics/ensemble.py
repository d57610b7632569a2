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

    def with_spread(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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

    def sequence_with_spread(self, z: Tensor) -> tuple[Tensor, Tensor]:
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
        self.dynamics = dynamics
        self.name = name
        self.theta = theta
        self.n_state = dynamics.n_state

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [M * D, nx] at a stage."""
        return self._each("rate", x, p, rho)[0]

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        after, memory = self._each("step", x, w, s)
        return after, memory

    def _each(self, method: str, *given: Tensor) -> tuple[Tensor, ...]:
        """What a method of the model returns with each draw's parameters for its own rows."""
        called, draws = _Method(self.dynamics, method), self.theta.shape[0]

        def one(theta: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
            out = torch.func.functional_call(called, {f"dynamics.{self.name}": theta}, rows)
            return out if isinstance(out, tuple) else (out,)

        split = [part.reshape(part.shape[0] // draws, draws, part.shape[-1]) for part in given]
        out: tuple[Tensor, ...] = torch.vmap(one, in_dims=(0, *(1 for _ in given)), out_dims=1)(
            self.theta, *split
        )
        return tuple(part.reshape(given[0].shape[0], part.shape[-1]) for part in out)


@final
class _Method(torch.nn.Module):
    """A method of a model as the forward of a module, as `functional_call` wants it."""

    def __init__(self, dynamics: Dynamics, method: str) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.method = method

    def forward(self, *given: Tensor) -> object:
        """Return what the method returns."""
        return getattr(self.dynamics, self.method)(*given)
