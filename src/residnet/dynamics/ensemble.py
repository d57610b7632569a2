"""Several models as one: means of models, and one model with many parameter vectors.

`mean_of` averages accelerations inside one free run. `MeanOfTrajectories` integrates each member
with its own velocities and averages the trajectories. Both step, warm up and export like any other
model.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import cast, final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.columns import dynamic_states, pose, zero_acceleration
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import MAX_MEMORY, HybridDynamics
from residnet.heads.base import ResidualHead, ZeroHead


@final
class MeanBaseline(Baseline):
    """A baseline that is the mean acceleration of several baselines."""

    def __init__(self, members: Sequence[nn.Module], dof: int) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)
        self.dof = dof

    def forward(self, z: Tensor) -> Tensor:
        total = zero_acceleration(z, self.dof)
        for member in self.members:
            total = total + member(z)
        return total / len(self.members)

    def parameter_counts(self) -> list[float]:
        return _sum_parameter_counts(self.members)


@final
class MeanHead(ResidualHead):
    """A head that is the mean residual of several heads; its memory concatenates their memories."""

    def __init__(self, members: Sequence[ResidualHead]) -> None:
        super().__init__()
        self.n_dof = members[0].n_dof
        self.members = nn.ModuleList(members)
        self.memory_sizes = [member.n_state for member in members]
        self.n_state = sum(self.memory_sizes)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        residuals: list[Tensor] = []
        memories: list[Tensor] = []
        for member, memory in zip(self.members, s.split(self.memory_sizes, dim=-1), strict=True):
            rho, next_memory = member(z, memory)
            residuals.append(rho)
            memories.append(next_memory)
        return torch.stack(residuals).mean(dim=0), torch.cat(memories, dim=-1)

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        # ModuleList has no type of its members
        members = cast("Sequence[ResidualHead]", self.members)
        residuals = [member.teacher_forced_residuals(z) for member in members]
        return torch.stack(residuals).mean(dim=0)

    def warmup(self, z: Tensor) -> Tensor:
        members = cast("Sequence[ResidualHead]", self.members)
        return torch.cat([member.warmup(z) for member in members], dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        members = cast("Sequence[ResidualHead]", self.members)
        bounds = [member.memory_bounds() for member in members]
        lower, upper = zip(*bounds, strict=True)
        return torch.cat(lower), torch.cat(upper)

    def parameter_counts(self) -> list[float]:
        return _sum_parameter_counts(self.members)


def _sum_parameter_counts(members: nn.ModuleList) -> list[float]:
    counts = [member.parameter_counts() for member in members]  # type: ignore[operator]
    return [sum(axis) for axis in zip(*counts, strict=True)]


def mean_of(members: Sequence[HybridDynamics]) -> HybridDynamics:
    """Return the mean of models with the same signals, step and integrator."""
    first = members[0]
    baselines = [member.head.effective_baseline(member.baseline) for member in members]
    head = MeanHead([member.head for member in members])
    baseline = MeanBaseline(baselines, first.dof)
    return HybridDynamics(first.signals, baseline, head, first.dt, first.integrator)


_MEASUREMENT_SHARE = 1e-3
"""Scale of the innovation that distinguishes a measured state from a predicted one.

As a share of the training range of a velocity. Measurement noise exceeds it, rounding in float32
does not.
"""


@final
class MeanOfTrajectories(HybridDynamics):
    """The mean trajectory of several models, each of which integrates its own velocities.

    The memory holds the prediction of the mean, and for every member the deviation of its
    velocities from the mean and its own memory. If the next state is the prediction, each member
    continues from its own velocities; if the next state is measured, all members start from it.
    After a warm-up the next state is known to be measured. After a step, the innovation
    distinguishes them: the deviations decrease with the square of its ratio to a small velocity, so
    that the step is differentiable. Members share heading and position, which are integrated with
    the mean velocities.

    Args:
        members: models with the same signals and time step.
        low: smallest dynamic states in the training data [n].
        high: largest dynamic states in the training data [n].
        weights: weight of each member in each dynamic state [M, n], with a sum of 1 over the
            members; empty for equal weights.
    """

    def __init__(
        self,
        members: Sequence[HybridDynamics],
        low: Sequence[float],
        high: Sequence[float],
        weights: Sequence[Sequence[float]] = (),
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
            # the pose is integrated with the mean velocities
            member.has_position = False
        equal_weights = [[1.0 / len(members)] * self.dof] * len(members)
        self.member_weights = nn.Buffer(
            torch.tensor(weights or equal_weights, dtype=torch.float64), persistent=False
        )
        self.has_equal_weights = not weights
        self.copies = [member.head.batch_ensemble_size for member in members]
        self.memory_sizes = [self.dof + member.n_state for member in members]
        # memory of the mean: a flag whether there is a prediction, and the predicted velocities;
        # then the memories of the members
        *self.offsets, self.n_state = accumulate(
            (copies * size for copies, size in zip(self.copies, self.memory_sizes, strict=True)),
            initial=1 + self.dof,
        )
        innovation_scale = [
            _MEASUREMENT_SHARE * max(upper - lower, 1e-6)
            for lower, upper in zip(low, high, strict=True)
        ]
        self.innovation_scale = nn.Buffer(
            torch.tensor(innovation_scale, dtype=torch.float64), persistent=False
        )

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        x = self.zero_inactive_velocities(x)
        continuation = self._continuation(x, s)
        next_states: list[Tensor] = []
        memories: list[Tensor] = []
        for i, member in enumerate(self.members):
            member_state, member_memory = self._member_start(x, s, continuation, i)
            inputs = w.repeat(self.copies[i], 1)
            next_state, next_memory = member.step(member_state, inputs, member_memory)
            next_states.append(next_state)
            memories.append(next_memory)
        return self._average(x, next_states, memories)

    def _continuation(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the factor [B, 1] of the members' deviations from the mean velocities.

        It is 1 if the state is the prediction, and close to 0 if it is measured.
        """
        innovation = dynamic_states(x, self.dof) - s[:, 1 : 1 + self.dof]
        scaled = innovation / self.innovation_scale.to(x.dtype)
        return s[:, :1] / (1.0 + scaled.square().sum(dim=-1, keepdim=True))

    def _member_start(
        self, x: Tensor, s: Tensor, continuation: Tensor, i: int
    ) -> tuple[Tensor, Tensor]:
        """Return the states and memories [K B, ...] from which member i steps."""
        # a head with a batch of networks steps K copies of each row
        copies = self.copies[i]
        size = self.memory_sizes[i]
        n_rows = x.shape[0]
        begin = self.offsets[i]
        part = s[:, begin : begin + copies * size].reshape(n_rows, copies, size).transpose(0, 1)
        deviation = part[..., : self.dof]
        velocities = dynamic_states(x, self.dof) + continuation * deviation
        states = torch.cat((pose(x).expand(copies, n_rows, 3), velocities), dim=-1)
        memory = part[..., self.dof :].reshape(copies * n_rows, size - self.dof)
        return states.reshape(copies * n_rows, -1), memory

    def _weighted_mean(self, values: Sequence[Tensor]) -> Tensor:
        """Return the weighted mean of values [..., n] of the members."""
        total = torch.zeros_like(values[0])
        if self.has_equal_weights:
            # one division keeps the rounding of a plain mean
            for member_values in values:
                total = total + member_values
            return total / len(values)
        for i, member_values in enumerate(values):
            total = total + self.member_weights[i].to(total.dtype) * member_values
        return total

    def _average(
        self, x: Tensor, states: list[Tensor], memories: list[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the state and memory of the mean from the states and memories of the members.

        Args:
            x: state of the mean before the step [B, 3 + n].
            states: states of each member after the step [K B, 3 + n].
            memories: memories of each member after the step [K B, n_state].
        """
        nu = dynamic_states(x, self.dof)
        n_rows = x.shape[0]
        member_velocities = [
            dynamic_states(state, self.dof).reshape(copies, n_rows, self.dof)
            for state, copies in zip(states, self.copies, strict=True)
        ]
        mean = self._weighted_mean([velocities.mean(dim=0) for velocities in member_velocities])

        parts = [torch.ones_like(mean[:, :1]), mean]
        for i, velocities in enumerate(member_velocities):
            size = self.memory_sizes[i]
            memory = memories[i].reshape(self.copies[i], n_rows, size - self.dof)
            member_memory = torch.cat((velocities - mean, memory), dim=-1)
            parts.append(member_memory.transpose(0, 1).reshape(n_rows, self.copies[i] * size))

        # midpoint rule: mean of old and new velocities, at the heading in the middle of the step
        mid_velocities = 0.5 * (nu + mean)
        end_pose = pose(x) + self.dt * self.kinematics(torch.cat((pose(x), mid_velocities), dim=-1))
        mid_heading = 0.5 * (pose(x) + end_pose)[:, 2:]
        midpoint = torch.cat((pose(x)[:, :2], mid_heading, mid_velocities), dim=-1)
        next_pose = pose(x) + self.dt * self.kinematics(midpoint)
        return torch.cat((next_pose, mean), dim=-1), torch.cat(parts, dim=-1)

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        s = y_history.new_zeros((y_history.shape[0], self.n_state))
        # no training uses this model, and the autograd graph of a long past would need much memory
        with torch.no_grad():
            for k in range(y_history.shape[1]):
                s = self.mark_measured(self.step(y_history[:, k], w_history[:, k], s)[1])
        return s

    def mark_measured(self, s: Tensor) -> Tensor:
        # a measured state that equals the prediction by chance would otherwise pass for it, and the
        # members would start with their deviations
        return torch.cat((torch.zeros_like(s[:, :1]), s[:, 1:]), dim=-1)

    @property
    def has_prediction_flag(self) -> bool:
        return True

    @property
    def has_innovation(self) -> bool:
        return any(member.has_innovation for member in self.members)

    def baseline_acceleration(self, z: Tensor) -> Tensor:
        zero = zero_acceleration(z, self.dof)
        return self._weighted_mean([zero + member.baseline(z) for member in self.members])

    def one_step_accelerations(self, z: Tensor) -> Tensor:
        return self._weighted_mean([member.one_step_accelerations(z) for member in self.members])

    def acceleration(self, x: Tensor, w: Tensor, s: Tensor) -> Tensor:
        """Return the mean rate of change of the dynamic states [B, n] over a step."""
        next_nu = dynamic_states(self.step(x, w, s)[0], self.dof)
        return (next_nu - dynamic_states(x, self.dof)) / self.dt

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        limit = torch.full((1 + self.dof,), MAX_MEMORY, dtype=torch.float64)
        limit[0] = 1.0
        lower = [torch.cat((0.0 * limit[:1], -limit[1:]))]
        upper = [limit]
        deviation = torch.full((self.dof,), MAX_MEMORY, dtype=torch.float64)
        for copies, member in zip(self.copies, self.members, strict=True):
            member_lower, member_upper = member.memory_bounds()
            lower.append(torch.cat((-deviation, member_lower.double())).repeat(copies))
            upper.append(torch.cat((deviation, member_upper.double())).repeat(copies))
        return torch.cat(lower), torch.cat(upper)


@final
class SampledDynamics(Dynamics):
    """A model that runs with many samples of one parameter in parallel.

    Rows [M * D] of a batch are M manoeuvres with D samples each (samples vary fastest); sample d
    runs with theta[d] in place of the parameter.

    Args:
        dynamics: the model.
        name: name of the parameter within `dynamics`.
        theta: samples of the parameter, [D, ...].
    """

    def __init__(self, dynamics: Dynamics, name: str, theta: Tensor) -> None:
        super().__init__(dynamics.dt, dynamics.integrator)
        self.step_module = _StepModule(dynamics)
        self.name = name
        self.theta = theta
        self.n_state = dynamics.n_state

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        n_draws = self.theta.shape[0]
        parameter = f"dynamics.{self.name}"

        def step_of_draw(theta: Tensor, *rows: Tensor) -> tuple[Tensor, Tensor]:
            stepped: tuple[Tensor, Tensor] = torch.func.functional_call(
                self.step_module, {parameter: theta}, rows
            )
            return stepped

        # manoeuvres [M], draws [D]: the draws are the axis that vmap runs over
        arguments = [part.unflatten(0, (len(part) // n_draws, n_draws)) for part in (x, w)]
        arguments.append(s.reshape(x.shape[0] // n_draws, n_draws, s.shape[-1]))
        batched_step = torch.vmap(step_of_draw, in_dims=(0, 1, 1, 1), out_dims=1)
        next_state, memory = batched_step(self.theta, *arguments)
        return next_state.reshape(x.shape), memory.reshape(s.shape)


@final
class _StepModule(nn.Module):
    """The step of a model as the `forward` of a module, which `functional_call` requires."""

    def __init__(self, dynamics: Dynamics) -> None:
        super().__init__()
        self.dynamics = dynamics

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        return self.dynamics.step(x, w, s)
