"""Several models as one: means of models, and one model with many sets of parameters.

`mean_of` averages accelerations inside one free run. `MeanOfTrajectories` lets each member run on
velocities of its own and averages these. Either steps, warms up and exports like any other model.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.baselines.given import ZeroBaselineConfig
from residnet.core.columns import dynamic_states, pose, zero_acceleration
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import FARTHEST, HybridDynamics
from residnet.heads.base import ResidualHead, ZeroHead


@final
class MeanBaseline(Baseline):
    """A baseline that is the mean acceleration of several baselines."""

    def __init__(self, members: Sequence[nn.Module], dof: int) -> None:
        super().__init__()
        self.members, self.dof = nn.ModuleList(members), dof

    def forward(self, z: Tensor) -> Tensor:
        total = zero_acceleration(z, self.dof)
        for member in self.members:
            total = total + member(z)
        return total / len(self.members)

    def parameter_counts(self) -> list[float]:
        return _parameters(self.members)


@final
class MeanHead(ResidualHead):
    """A head that is the mean residual of several; the memory holds theirs side by side."""

    def __init__(self, members: Sequence[ResidualHead]) -> None:
        super().__init__()
        self.n_dof = members[0].n_dof
        self.members = nn.ModuleList(members)
        self.widths = [member.n_state for member in members]
        self.n_state = sum(self.widths)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        residuals: list[Tensor] = []
        memory: list[Tensor] = []
        begin = 0
        for i, member in enumerate(self.members):
            rho, after = member(z, s[..., begin : begin + self.widths[i]])
            residuals.append(rho)
            memory.append(after)
            begin += self.widths[i]
        return torch.stack(residuals).mean(dim=0), torch.cat(memory, dim=-1)

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        residuals: list[Tensor] = []
        for member in self.members:
            residuals.append(member.sequence(z))  # type: ignore[operator]
        return torch.stack(residuals).mean(dim=0)

    def warmup(self, z: Tensor) -> Tensor:
        memory: list[Tensor] = []
        for member in self.members:
            memory.append(member.warmup(z))  # type: ignore[operator]
        return torch.cat(memory, dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        ranges = [member.memory_range() for member in self.members]  # type: ignore[operator]
        low, high = zip(*ranges, strict=True)
        return torch.cat(low), torch.cat(high)

    def parameter_counts(self) -> list[float]:
        return _parameters(self.members)


def _parameters(members: nn.ModuleList) -> list[float]:
    counts = [member.parameter_count() for member in members]  # type: ignore[operator]
    return [sum(axis) for axis in zip(*counts, strict=True)]


def mean_of(members: Sequence[HybridDynamics]) -> HybridDynamics:
    """Return the mean of models with the same signals, step and integrator."""
    first = members[0]
    baselines = [member.head.effective_baseline(member.baseline) for member in members]
    head = MeanHead([member.head for member in members])
    known = MeanBaseline(baselines, first.dof)
    return HybridDynamics(first.signals, known, head, first.dt, first.integrator)


_TOLD = 1e-3
"""Share of a velocity's training range by which a measurement differs from a prediction.

Accelerations change velocities by more in a step, and no rounding of float32 by as much.
"""


@final
class MeanOfTrajectories(HybridDynamics):
    """The mean of what several models predict, each on velocities of its own.

    The memory holds what the mean predicted, and for every member how far its own velocities lie
    from that, with the member's memory. Where the next state is what was predicted, each member
    goes on from where it was; where it is measured instead, all of them start from it. In between
    the distances fade with the square of the ratio of what was missed to a small velocity, so that
    a step has derivatives. Members share the heading and the position that follow from the mean.

    Args:
        members: with the same signals and step. Each weighs the same, whatever its copies.
        low: least of what moves in the training data [n].
        high: their largest [n].
    """

    def __init__(
        self, members: Sequence[HybridDynamics], low: Sequence[float], high: Sequence[float]
    ) -> None:
        first = members[0]
        super().__init__(
            first.signals,
            ZeroBaselineConfig().build(first.signals.names),
            ZeroHead(first.signals.names),
            first.dt,
            first.integrator,
        )
        self.members: Sequence[HybridDynamics] = nn.ModuleList(members)  # type: ignore[assignment]
        for member in self.members:
            # the pose follows from the mean
            member.positions = False
        self.copies = [member.head.batch_ensemble_size for member in members]
        self.widths = [self.dof + member.n_state for member in members]
        *self.begins, self.n_state = accumulate(
            (copies * width for copies, width in zip(self.copies, self.widths, strict=True)),
            # whether there is a prediction, and it
            initial=1 + self.dof,
        )
        small = [_TOLD * max(b - a, 1e-6) for a, b in zip(low, high, strict=True)]
        self.small = nn.Buffer(torch.tensor(small, dtype=torch.float64), persistent=False)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        x = self.alive(x)
        kept = self._kept(x, s)
        reached: list[Tensor] = []
        memory: list[Tensor] = []
        for i, member in enumerate(self.members):
            at, part = self._own(x, s, kept, i)
            given = w.repeat(self.copies[i], 1)
            after, own = member.step(at, given, part)
            reached.append(after)
            memory.append(own)
        return self._joined(x, reached, memory)

    def _kept(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the share [B, 1] of their distances from the mean that members keep."""
        missed = (dynamic_states(x, self.dof) - s[:, 1 : 1 + self.dof]) / self.small.to(x.dtype)
        return s[:, :1] / (1.0 + missed.square().sum(dim=-1, keepdim=True))

    def _part(self, s: Tensor, i: int) -> Tensor:
        """Return a member's share of the memory [K, B, n + n_state]."""
        copies, width = self.copies[i], self.widths[i]
        own = s[:, self.begins[i] : self.begins[i] + copies * width]
        return own.reshape(s.shape[0], copies, width).transpose(0, 1)

    def _own(self, x: Tensor, s: Tensor, kept: Tensor, i: int) -> tuple[Tensor, Tensor]:
        """Return the states and memories [K B, ...] that a member steps from."""
        copies, rows, part = self.copies[i], x.shape[0], self._part(s, i)
        moved = dynamic_states(x, self.dof) + kept * part[..., : self.dof]
        at = torch.cat((pose(x).expand(copies, rows, 3), moved), dim=-1)
        width = self.widths[i] - self.dof
        own = part[..., self.dof :].reshape(copies * rows, width)
        return at.reshape(copies * rows, -1), own

    def _joined(
        self, x: Tensor, states: list[Tensor], memories: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the mean's state and memory from those of the members, [K B, ...] each."""
        nu, rows = dynamic_states(x, self.dof), x.shape[0]
        total = torch.zeros_like(nu)
        own: list[Tensor] = []
        memory: list[Tensor] = []
        for i in range(len(states)):
            reached = dynamic_states(states[i], self.dof).reshape(self.copies[i], rows, self.dof)
            total = total + reached.mean(dim=0)
            own.append(reached)
            memory.append(memories[i].reshape(self.copies[i], rows, self.widths[i] - self.dof))
        mean = total / len(self.widths)
        parts = [torch.ones_like(mean[:, :1]), mean]
        for i in range(len(own)):
            both = torch.cat((own[i] - mean, memory[i]), dim=-1)
            parts.append(both.transpose(0, 1).reshape(rows, self.copies[i] * self.widths[i]))
        # the pose moves with the mean of the velocities at both ends
        half = 0.5 * (nu + mean)
        turned = pose(x) + self.dt * self.kinematics(torch.cat((pose(x), half), dim=-1))
        middle = torch.cat((pose(x)[:, :2], 0.5 * (pose(x) + turned)[:, 2:], half), dim=-1)
        moved_pose = pose(x) + self.dt * self.kinematics(middle)
        return torch.cat((moved_pose, mean), dim=-1), torch.cat(parts, dim=-1)

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        s = y_history.new_zeros((y_history.shape[0], self.n_state))
        # nothing is trained through the mean, and a long past would keep all of its steps
        with torch.no_grad():
            for k in range(y_history.shape[1]):
                s = self.step(y_history[:, k], w_history[:, k], s)[1]
        return s

    @property
    def observes(self) -> bool:
        return any(member.observes for member in self.members)

    def known(self, z: Tensor) -> Tensor:
        total = zero_acceleration(z, self.dof)
        for member in self.members:
            total = total + member.baseline(z)
        return total / len(self.widths)

    def one_step(self, z: Tensor) -> Tensor:
        total = zero_acceleration(z, self.dof)
        for member in self.members:
            total = total + member.one_step(z)
        return total / len(self.widths)

    def acceleration(self, x: Tensor, w: Tensor, s: Tensor) -> Tensor:
        """Return the mean change of what moves [B, n] over a step, by its length."""
        after = dynamic_states(self.step(x, w, s)[0], self.dof)
        return (after - dynamic_states(x, self.dof)) / self.dt

    def memory_range(self) -> tuple[Tensor, Tensor]:
        limit = torch.full((1 + self.dof,), FARTHEST, dtype=torch.float64)
        limit[0] = 1.0
        low, high = [torch.cat((0.0 * limit[:1], -limit[1:]))], [limit]
        for copies, member in zip(self.copies, self.members, strict=True):
            least, most = member.memory_range()
            apart = torch.full((self.dof,), FARTHEST, dtype=torch.float64)
            low.append(torch.cat((-apart, least.double())).repeat(copies))
            high.append(torch.cat((apart, most.double())).repeat(copies))
        return torch.cat(low), torch.cat(high)


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
        draws, parameter = self.theta.shape[0], f"dynamics.{self.name}"

        def one(theta: Tensor, *rows: Tensor) -> tuple[Tensor, Tensor]:
            after: tuple[Tensor, Tensor] = torch.func.functional_call(
                self.stepped, {parameter: theta}, rows
            )
            return after

        split = [part.unflatten(0, (len(part) // draws, draws)) for part in (x, w)]
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
