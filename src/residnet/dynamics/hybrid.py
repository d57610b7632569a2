"""The hybrid model, nu_dot = baseline + residual (Woo et al. 2018, eq. (19)), and its innovations.

A residual in force space acts through the mass of the head (residual model). A head may receive the
filtered one-step prediction error (innovation) of the measured past, from which it can infer
unmeasured wind: the velocities at each step are compared with the prediction of the previous step.
In a free run the state is the prediction, so that the innovation is zero. One step therefore serves
both cases.
"""

from __future__ import annotations

import math
from typing import cast, final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.columns import dynamic_states, pose, with_depth_rate
from residnet.core.layout import ATTITUDE, DegreesOfFreedom
from residnet.dynamics.base import Dynamics
from residnet.dynamics.time_steps import Integrator
from residnet.heads.base import ResidualHead
from residnet.physics.signals import Signals
from residnet.physics.symmetry import get_dof

_SEGMENT_DURATION = 20.0
"""Duration in s of the segments of a measurement, and of the warm-up that precedes each segment."""
MAX_MEMORY = 100.0
"""Largest velocity or acceleration that a memory may hold, SI."""


@final
class InnovationFilter(nn.Module):
    """A first-order low-pass filter of the innovation as an acceleration in body axes.

    The filter does not rotate its value with the vessel: its time constant is short compared with
    a turn.

    Args:
        time_constant: time constant of the filter in s.
        dt: time step in s.
        dof: the n dynamic states. An angle whose derivative is known has no innovation.

    Attributes:
        size: number of entries of the memory: whether there is a prediction, the predicted dynamic
            states, and the filtered innovation.
    """

    def __init__(self, time_constant: float, dt: float, dof: DegreesOfFreedom) -> None:
        super().__init__()
        self.dof = dof.n_dynamic
        self.size = 1 + 2 * dof.n_dynamic
        self.is_fully_regressed = len(dof.active_velocity_indices) == dof.n_dynamic
        self.mask = nn.Buffer(dof.equation_mask(), persistent=False)
        # exact discretisation of a first-order lag; the division by dt turns a velocity error per
        # step into an acceleration
        self.decay = math.exp(-dt / time_constant)
        self.gain = (1.0 - self.decay) / dt

    def forward(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the filtered innovation, an acceleration in body axes [B, n].

        Args:
            x: states at the start of the step, measured or predicted [B, nx].
            s: memory of the previous step [B, 1 + 2 n].
        """
        has_prediction, prediction, filtered = s.split([1, self.dof, self.dof], dim=-1)
        innovation = (dynamic_states(x, self.dof) - prediction) * has_prediction
        if not self.is_fully_regressed:
            innovation = innovation * self.mask.to(innovation.dtype)
        updated: Tensor = self.decay * filtered + self.gain * innovation
        return updated

    def next_memory(self, next_state: Tensor, filtered: Tensor) -> Tensor:
        """Return the memory [B, 1 + 2 n] after a step.

        Args:
            next_state: predicted states [B, nx].
            filtered: filtered innovation [B, n].
        """
        prediction = dynamic_states(next_state, self.dof)
        return torch.cat((torch.ones_like(next_state[:, :1]), prediction, filtered), dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds of the memory [1 + 2 n]."""
        upper = torch.full((self.size,), MAX_MEMORY, dtype=torch.float64)
        upper[0] = 1.0
        lower = -upper
        lower[0] = 0.0
        return lower, upper


_MEASUREMENT_SHARE = 0.01
"""Share of a typical change of the velocities in a step by which a measurement differs from the
prediction. Prediction errors are larger, and rounding in float32 is smaller.
"""


@final
class MeasurementIndicator(nn.Module):
    """Whether the state at the start of a step is measured or predicted by the previous step.

    In a free run the state equals the prediction. In the measured past it differs by the prediction
    error. The indicator is a smooth function of the difference, so that the step is differentiable.

    Args:
        dt: step in s.
        dof: the n dynamic states.

    Attributes:
        size: entries of the memory: whether there is a prediction, and the prediction.
    """

    def __init__(self, dt: float, dof: DegreesOfFreedom) -> None:
        super().__init__()
        self.dof = dof.n_dynamic
        self.size = 1 + dof.n_dynamic
        self.dt = dt

    def forward(self, x: Tensor, s: Tensor, acceleration_scale: Tensor) -> Tensor:
        """Return the indicator [B, 1]: 1 for a measured state, 0 for a predicted one.

        Args:
            x: states at the start of the step [B, nx].
            s: memory of the previous step [B, 1 + n].
            acceleration_scale: standard deviation of the residual accelerations [n].
        """
        has_prediction, prediction = s.split([1, self.dof], dim=-1)
        tolerance = _MEASUREMENT_SHARE * self.dt * acceleration_scale.to(x.dtype)
        scaled = (dynamic_states(x, self.dof) - prediction) / tolerance
        indicator: Tensor = 1.0 - has_prediction / (1.0 + scaled.square().sum(-1, keepdim=True))
        return indicator

    def next_memory(self, next_state: Tensor, indicator: Tensor) -> Tensor:
        """Return the memory [B, 1 + n] after a step to the predicted states [B, nx]."""
        prediction = dynamic_states(next_state, self.dof)
        return torch.cat((torch.ones_like(next_state[:, :1]), prediction), dim=-1)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds of the memory [1 + n]."""
        upper = torch.full((self.size,), MAX_MEMORY, dtype=torch.float64)
        upper[0] = 1.0
        lower = -upper
        lower[0] = 0.0
        return lower, upper


class HybridDynamics(Dynamics):
    """A hybrid model with the state x [B, 3 + n]: x, y, psi, then the dynamic states u, v, r etc.

    The head is evaluated once per time step, and its residual is constant over the stages of the
    integrator. A head with an innovation time constant receives the filtered innovation as further
    channels, and a head with an encoder whether the state is measured.
    """

    def __init__(
        self,
        signals: Signals,
        baseline: Baseline,
        head: ResidualHead,
        dt: float,
        integrator: Integrator = "rk4",
    ) -> None:
        super().__init__(dt, integrator)
        self.signals = signals
        self.baseline = baseline
        self.head = head
        dof = get_dof(signals.names)
        self.dof = dof.n_dynamic
        self.is_complete = dof.is_complete
        # whether every dynamic state is an active velocity, so that no derivative is prescribed
        self.is_fully_regressed = len(dof.active_velocity_indices) == dof.n_dynamic
        self.has_roll = dof.has_roll
        self.set_attitude_columns(ATTITUDE if dof.is_six_dof else (), len(dof.state_names))
        self.equation_mask = nn.Buffer(dof.equation_mask(), persistent=False)
        self.active_mask = nn.Buffer(dof.active_mask(), persistent=False)
        self.angle_rate_matrix = nn.Buffer(dof.angle_rate_matrix(), persistent=False)
        head.set_step(dt)
        self.innovation_filter: InnovationFilter | MeasurementIndicator | None = None
        if head.has_encoder:
            self.innovation_filter = MeasurementIndicator(dt, dof)
        elif head.innovation_time_constant > 0.0:
            self.innovation_filter = InnovationFilter(head.innovation_time_constant, dt, dof)
        self.head_memory_size = head.n_state
        self.n_state = head.n_state
        if self.innovation_filter is not None:
            self.n_state += self.innovation_filter.size

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, 3 + n].

        Args:
            x: states [B, 3 + n].
            p: result of `signals.prepare` for the inputs of the step.
            rho: residual of the step [B, n].
        """
        baseline_acceleration = self.baseline(self.signals(x, p))
        nu_dot = self.total_acceleration(baseline_acceleration, rho, dynamic_states(x, self.dof))
        return torch.cat((self.kinematics(x), nu_dot), dim=-1)

    def total_acceleration(self, baseline: Tensor, rho: Tensor, nu: Tensor) -> Tensor:
        """Return the derivatives of the dynamic states [..., n].

        The derivative of an inactive velocity is zero; the velocities determine the derivatives of
        angles.

        Args:
            baseline: accelerations of the baseline [..., n].
            rho: residual [..., n].
            nu: dynamic states [..., n].
        """
        nu_dot: Tensor = self.head.combine_accelerations(baseline, rho)
        if self.is_fully_regressed:
            return nu_dot
        nu_dot = nu_dot * self.equation_mask.to(nu_dot.dtype)
        if self.has_roll:
            nu_dot = nu_dot + nu @ self.angle_rate_matrix.to(nu.dtype)
        return with_depth_rate(nu_dot, nu) if self.is_spatial else nu_dot

    def integrate_angles(self, x: Tensor, next_state: Tensor) -> Tensor:
        if not self.has_roll:
            return next_state
        nu = dynamic_states(x, self.dof)
        next_nu = dynamic_states(next_state, self.dof)
        has_equation = self.equation_mask.to(x.dtype) > 0.0
        if not self.is_spatial:
            # as with the pose, new velocities keep an undamped oscillation bounded
            angles = nu + self.dt * (next_nu @ self.angle_rate_matrix.to(x.dtype))
            return torch.cat((pose(next_state), torch.where(has_equation, next_nu, angles)), dim=-1)
        # pose, depth and attitude start from their old values and move with the new velocities
        velocities = torch.where(has_equation, next_nu, nu)
        angle_rates = with_depth_rate(velocities @ self.angle_rate_matrix.to(x.dtype), velocities)
        start = torch.cat((pose(x), velocities), dim=-1)
        derivative = torch.cat((self.kinematics(start), angle_rates), dim=-1)
        return self.add_change(start, self.dt * derivative)

    def zero_inactive_velocities(self, x: Tensor) -> Tensor:
        """Return states [..., 3 + n] whose inactive velocities are zero."""
        if self.is_complete:
            return x
        nu = dynamic_states(x, self.dof) * self.active_mask.to(x.dtype)
        return torch.cat((pose(x), nu), dim=-1)

    def compute_channels(self, x: Tensor, w: Tensor) -> Tensor:
        """Return the channels of baseline and head, z [..., nz].

        Args:
            x: states [..., 3 + n].
            w: inputs at each state [..., m].
        """
        z: Tensor = self.signals(x, self.signals.prepare(w))
        return z

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        x = self.zero_inactive_velocities(x)
        p = self.signals.prepare(w)
        z: Tensor = self.signals(x, p)
        if self.innovation_filter is None:
            rho, head_memory = self.head(z, s)
            return self.advance(x, z, p, rho), head_memory
        innovation = self.compare_with_prediction(x, s)
        head_memory = s[:, : self.head_memory_size]
        rho, head_memory = self.head(torch.cat((z, innovation), dim=-1), head_memory)
        next_state = self.advance(x, z, p, rho)
        filter_memory = self.innovation_filter.next_memory(next_state, innovation)
        return next_state, torch.cat((head_memory, filter_memory), dim=-1)

    def compare_with_prediction(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the channels that compare the states with the prediction of the previous step.

        Args:
            x: states at the start of the step [B, 3 + n].
            s: memory [B, n_state].

        Returns:
            The filtered innovation [B, n], or whether the states are measured [B, 1].
        """
        memory = s[:, self.head_memory_size :]
        if isinstance(self.innovation_filter, MeasurementIndicator):
            return cast(Tensor, self.innovation_filter(x, memory, self.head.residual_scale()))
        return cast(Tensor, self.innovation_filter(x, memory))  # type: ignore[misc]

    def advance(self, x: Tensor, z: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state [B, 3 + n] one step later.

        Args:
            x: states [B, 3 + n].
            z: channels at these states [B, nz], which the first stage reuses.
            p: result of `signals.prepare` for the inputs of the step.
            rho: residual of the step [B, n].
        """
        nu_dot = self.total_acceleration(self.baseline(z), rho, dynamic_states(x, self.dof))
        derivative = torch.cat((self.kinematics(x), nu_dot), dim=-1)
        return self.integrate_from_derivative(derivative, x, p, rho)

    def baseline_acceleration(self, z: Tensor) -> Tensor:
        """Return the accelerations of the baseline [..., n] at channels z [..., nz]."""
        nu_dot: Tensor = self.baseline(z)
        return nu_dot

    def one_step_accelerations(self, z: Tensor) -> Tensor:
        """Return nu_dot [B, T, n] along measured channels [B, T, nz] (teacher forcing).

        The head starts with an empty memory.
        """
        return self.teacher_forced_accelerations(z, self.baseline_acceleration(z))

    def teacher_forced_accelerations(self, z: Tensor, baseline: Tensor) -> Tensor:
        """Return `one_step_accelerations` for known baseline accelerations [B, T, n]."""
        if self.innovation_filter is not None:
            return self._accelerations_with_innovation(z, baseline, self.innovation_filter)
        rho = self.head.teacher_forced_residuals(z)
        return self.total_acceleration(baseline, rho, z[..., : self.dof])

    def _accelerations_with_innovation(
        self,
        z: Tensor,
        baseline: Tensor,
        innovation_filter: InnovationFilter | MeasurementIndicator,
    ) -> Tensor:
        """Return nu_dot [B, T, n] of a head that receives the innovation.

        Long measurements are split into segments that run in parallel. Each begins one segment
        earlier as a warm-up, so that its memory has converged.

        Args:
            z: channels [B, T, nz].
            baseline: accelerations of the baseline [B, T, n].
        """
        n_rows = z.shape[0]
        n_steps = z.shape[1]
        n_copies = self.head.batch_ensemble_size
        n = self.dof
        length = max(round(_SEGMENT_DURATION / self.dt), 1)

        # sample indices of the segments [segments, 2 length], each with its past
        starts = torch.arange(-length, n_steps, length)
        starts = starts[:-1, None] if len(starts) > 1 else starts[:, None]
        index = starts + torch.arange(2 * length)
        is_inside = ((index >= 0) & (index < n_steps)).to(z.dtype)
        is_inside = is_inside.repeat(n_copies * n_rows, 1)
        index = index.clamp(0, n_steps - 1)
        z, baseline = (
            part[:, index].repeat(n_copies, 1, 1, 1).flatten(0, 1) for part in (z, baseline)
        )

        # one Euler step predicts the velocities, instead of the integrator; positions do not matter
        zero_pose = z.new_zeros((*z.shape[:-1], 3))
        x = torch.cat((zero_pose, z[..., :n]), dim=-1)
        s = z.new_zeros((len(z), self.n_state))
        accelerations = []
        for k in range(2 * length):
            innovation = self.compare_with_prediction(x[:, k], s)
            head_input = torch.cat((z[:, k], innovation), dim=-1)
            rho, head_memory = self.head(head_input, s[:, : self.head_memory_size])
            nu_dot = self.total_acceleration(baseline[:, k], rho, z[:, k, :n])
            next_state = torch.cat((x[:, k, :3], x[:, k, 3:] + self.dt * nu_dot), dim=-1)
            filter_memory = innovation_filter.next_memory(next_state, innovation)
            # before the first and after the last sample the memory is reset to zero
            s = torch.cat((head_memory, filter_memory), dim=-1) * is_inside[:, k, None]
            accelerations.append(nu_dot)
        recorded = torch.stack(accelerations[length:], dim=1).reshape(n_copies, n_rows, -1, n)
        return recorded.mean(0)[:, :n_steps]

    def acceleration(self, x: Tensor, w: Tensor, s: Tensor) -> Tensor:
        """Return nu_dot [B, n] at states x [B, 3 + n], inputs w [B, m] and memory s."""
        z = self.compute_channels(x, w)
        if self.innovation_filter is None:
            rho, _ = self.head(z, s)
        else:
            innovation = self.compare_with_prediction(x, s)
            head_input = torch.cat((z, innovation), dim=-1)
            rho, _ = self.head(head_input, s[:, : self.head_memory_size])
        return self.total_acceleration(self.baseline(z), rho, dynamic_states(x, self.dof))

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory [B, n_state] after a measured past.

        Args:
            y_history: measured states [B, T, 3 + n], oldest first; T may be 0.
            w_history: inputs held over the step that follows each of them [B, T, m].
        """
        if self.innovation_filter is None:
            s: Tensor = self.head.warmup(self.compute_channels(y_history, w_history))
            return s
        s = y_history.new_zeros((y_history.shape[0], self.n_state))
        for k in range(y_history.shape[1]):
            s = self.step(y_history[:, k], w_history[:, k], s)[1]
        return s

    def mark_measured(self, s: Tensor) -> Tensor:
        """Return the memory [B, n_state] after a step that is followed by a measured state."""
        return s

    @property
    def has_prediction_flag(self) -> bool:
        """Whether the first entry of the memory says that the next state is predicted."""
        return False

    @property
    def has_innovation(self) -> bool:
        """Whether the memory holds the innovation of the measured past."""
        return self.innovation_filter is not None

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds of the memory [n_state]."""
        lower, upper = self.head.memory_bounds()
        if self.innovation_filter is None:
            return lower, upper
        filter_lower, filter_upper = self.innovation_filter.memory_bounds()
        return torch.cat((lower.double(), filter_lower)), torch.cat((upper.double(), filter_upper))


@final
class MeasuredPast(Dynamics):
    """A model along measured states, which its inputs contain: only the memory changes.

    Args:
        model: the model whose memory is computed.
    """

    def __init__(self, model: HybridDynamics) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state = model.n_state
        self.dof = model.dof

    @property
    def head(self) -> ResidualHead:
        """Residual model, whose memory the measured states update."""
        return self.model.head

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state x [B, nx] unchanged and the memory after a measured state.

        Args:
            x: any states [B, nx].
            w: measured states, then inputs [B, nx + m].
            s: memory [B, n_state].
        """
        measured, inputs = w.split([x.shape[-1], w.shape[-1] - x.shape[-1]], dim=-1)
        return x, self.model.step(measured, inputs, s)[1]
