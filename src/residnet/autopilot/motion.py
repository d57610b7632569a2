"""Motion control in three degrees of freedom: reference filter, PID, and feed-forward.

Source: Jervan 2020, sections 2.2 and 2.2.1, eq. (2.15). Symbols, bandwidth and headings that the
source does not define are interpreted as in docs/documents/corrections.md (J7, J9, J13).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol, final

import torch
from torch import Tensor, nn

from residnet.autopilot.base import Policy, Reference
from residnet.core import columns
from residnet.core.columns import dynamic_states, motion_accelerations, pose
from residnet.core.errors import ConfigError
from residnet.core.frames import to_body, wrap_angle
from residnet.physics.plant import Hull

if TYPE_CHECKING:
    from residnet.autopilot.motion_config import ActuatorLag, MotionPIDConfig, ReferenceFilterConfig


@final
class ReferenceFilter(Reference):
    """The filter (s + W)(s^2 + 2 D W s + W^2) on each of north, east and heading.

    It is integrated by RK4 with a constant way-point within a step.

    The reference [B, 9] is the filter state at the start of a step: eta_d (north, east [m],
    heading [rad], not wrapped), then nu_d and nu_d_dot in body axes along the desired heading. The
    memory [B, 9] holds eta_d and its first and second derivative. The filter starts with zero
    velocity at the vessel's pose. It has one config for all rows or one per row, with the same
    interval.
    """

    def __init__(self, configs: Sequence[ReferenceFilterConfig], dt: float) -> None:
        super().__init__()
        self.n_state = 9
        intervals = {config.interval for config in configs}
        # way-points must change between steps, because the filter has a constant target in a step
        steps = max(intervals) / dt
        if len(intervals) > 1 or abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
            interval_text = ", ".join(f"{interval:g} s" for interval in sorted(intervals))
            raise ConfigError(
                f"reference filter: interval ({interval_text}) must be the same for all and a"
                " whole number"
                f" of steps of {dt:g} s"
            )
        self.steps_per_waypoint = round(steps)
        self.n_waypoints = max(len(config.waypoints) for config in configs)
        points = [
            (
                *config.waypoints,
                # rows with fewer way-points hold their last one
                *[config.waypoints[-1]] * (self.n_waypoints - len(config.waypoints)),
            )
            for config in configs
        ]
        self.register_buffer(
            "waypoints", torch.tensor(points, dtype=torch.float64), persistent=False
        )
        self.waypoints: Tensor
        self.register_buffer(
            "advance",
            torch.stack([self._step_matrix(config, dt) for config in configs]),
            persistent=False,
        )
        self.advance: Tensor

    @staticmethod
    def _step_matrix(config: ReferenceFilterConfig, dt: float) -> Tensor:
        """Return the matrix [3, 3, 3] of an RK4 step for (error, rate, acceleration) of each axis.

        It is exact for a linear filter.
        """
        matrices = []
        for w, d in zip(config.frequency, config.damping, strict=True):
            a = (
                torch.tensor(
                    [[0, 1, 0], [0, 0, 1], [-(w**3), -(2 * d + 1) * w**2, -(2 * d + 1) * w]],
                    dtype=torch.float64,
                )
                * dt
            )
            eye = torch.eye(3, dtype=torch.float64)
            # Horner form of I + A + A^2/2 + A^3/6 + A^4/24, the RK4 step of a linear system
            matrices.append(eye + a @ (eye + a @ (eye + a @ (eye + a / 4.0) / 3.0) / 2.0))
        return torch.stack(matrices)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory [B, 9]: the vessel's pose with zero derivatives."""
        return torch.cat((pose(x), torch.zeros_like(x[:, :1]).expand(-1, 6)), dim=-1)

    def waypoint_at(self, k: int) -> Tensor:
        """Return the waypoint [B or 1, 3] at step k."""
        return self.waypoints[:, min(k // self.steps_per_waypoint, self.n_waypoints - 1)]

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        desired_pose = pose(s)
        pose_rate = dynamic_states(s)
        pose_acceleration = motion_accelerations(s)
        nu, nu_dot = to_body_derivatives(desired_pose[:, 2], pose_rate, pose_acceleration)
        target = self.waypoint_at(k).to(s.dtype)
        error = torch.stack(
            (desired_pose - target, pose_rate, pose_acceleration), dim=-1
        ).unsqueeze(-1)
        next_error = (self.advance.to(s.dtype) @ error).squeeze(-1)
        memory = torch.cat(
            (next_error[:, :, 0] + target, next_error[:, :, 1], next_error[:, :, 2]), dim=-1
        )
        return torch.cat((desired_pose, nu, nu_dot), dim=-1), memory


def to_body_derivatives(
    psi: Tensor, pose_rate: Tensor, pose_acceleration: Tensor
) -> tuple[Tensor, Tensor]:
    """Return nu and nu_dot [..., 3] in body axes from the derivatives [..., 3] of a pose in NED.

    A vector that is constant in NED rotates at -r in body axes (see J7 in
    docs/documents/corrections.md).
    """
    u, v = to_body(pose_rate[..., 0], pose_rate[..., 1], psi)
    surge_acceleration, sway_acceleration = to_body(
        pose_acceleration[..., 0], pose_acceleration[..., 1], psi
    )
    r = pose_rate[..., 2]
    return (
        torch.stack((u, v, r), dim=-1),
        torch.stack(
            (surge_acceleration + r * v, sway_acceleration - r * u, pose_acceleration[..., 2]),
            dim=-1,
        ),
    )


class FeedForward(nn.Module, ABC):
    """The forces that a model of the vessel needs for the desired motion."""

    @abstractmethod
    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return tau [B, 3] for the desired nu_dot [B, 3] and nu [B, 3] in body axes."""


@final
class NoFeedForward(FeedForward):
    """No feed-forward: feedback alone."""

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        return torch.zeros_like(nu)


@final
class HullFeedForward(FeedForward):
    """F0(nu_dot_d, nu_d) = M nu_dot_d + C(nu_d) nu_d + D(nu_d) nu_d of the believed hull (2.10)."""

    def __init__(self, hull: Hull) -> None:
        super().__init__()
        self.hull = hull

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        return self.hull.required_force(nu_dot, nu)


@final
class MotionPID(Policy):
    """The law tau = F(nu_dot_d, nu_d) + Kp e + Ki I + Kd (nu_d - nu).

    e = R^T(psi) (eta_d - eta) with its heading wrapped (2.9)-(2.14).

    Reference [B, 9]: eta_d, nu_d, nu_dot_d, see `ReferenceFilter`. The memory [B, 3] is I, the sum
    of e dt over the previous steps. There is one config for all rows, or one for each row of the
    batch.
    """

    def __init__(
        self, configs: Sequence[MotionPIDConfig], dt: float, feed_forward: FeedForward
    ) -> None:
        super().__init__()
        self.n_state = 3
        self.dt = dt
        self.feed_forward = feed_forward
        gains = [
            [config.proportional for config in configs],
            [config.integral for config in configs],
            [config.derivative for config in configs],
        ]
        self.register_buffer("gains", torch.tensor(gains, dtype=torch.float64), persistent=False)
        self.gains: Tensor

    def body_error(self, x: Tensor, reference: Tensor) -> Tensor:
        """Return e [B, 3] in body axes: m, m, rad."""
        difference = pose(reference) - pose(x)
        forward_error, lateral_error = to_body(difference[:, 0], difference[:, 1], x[:, 2])
        return torch.stack((forward_error, lateral_error, wrap_angle(difference[:, 2])), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command tau [B, 3] in N, N, N m, and the integral with this step's error."""
        error = self.body_error(x, reference)
        nu_d = dynamic_states(reference)
        gains = self.gains.to(x.dtype)
        feedback = gains[0] * error + gains[1] * s + gains[2] * (nu_d - dynamic_states(x))
        return self.feed_forward(reference[:, 6:9], nu_d) + feedback, s + self.dt * error


@final
class AllocatedPolicy(Policy):
    """A controller whose demands are converted to the commands of a vessel.

    For example, forces are allocated to revolutions and angles of azimuth thrusters.

    Args:
        policy: the controller; its output is the demand.
        allocate: maps the demand of the controller [B, d] to commands [B, c].
    """

    def __init__(self, policy: Policy, allocate: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.policy = policy
        self.allocate = allocate
        self.n_state = policy.n_state

    def initial_state(self, x: Tensor) -> Tensor:
        return self.policy.initial_state(x)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        demand, s = self.policy(x, reference, s)
        return self.allocate(demand), s


_DIFFERENCE_STEP = 0.05
"""Step in s of the differences that give the derivatives of the force; the motion at these points
is known analytically, so that there is no noise.
"""
_RECOVERY_RATIO = 0.7
"""Rate at which an error of the force is corrected, relative to the frequency of the lag; peaks of
the command increase with it.
"""


class PoseDerivatives(NamedTuple):
    """A desired pose in earth axes with its time derivatives, [..., 3] each.

    Attributes:
        pose: north and east in m, heading in rad.
        rate: first derivative.
        acceleration: second derivative.
        jerk: third derivative.
        snap: fourth derivative.
    """

    pose: Tensor
    rate: Tensor
    acceleration: Tensor
    jerk: Tensor
    snap: Tensor

    def extrapolate(self, h: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return heading [...], nu_d and nu_dot_d [..., 3] after h seconds by Taylor series."""
        pose = self.pose + h * (
            self.rate + h / 2 * (self.acceleration + h / 3 * (self.jerk + h / 4 * self.snap))
        )
        rate = self.rate + h * (self.acceleration + h / 2 * (self.jerk + h / 3 * self.snap))
        acceleration = self.acceleration + h * (self.jerk + h / 2 * self.snap)
        psi = pose[..., 2]
        return psi, *to_body_derivatives(psi, rate, acceleration)


def filter_derivatives(
    config: ReferenceFilterConfig, memory: Tensor, target: Tensor, target_rate: Tensor
) -> PoseDerivatives:
    """Return the desired pose and its derivatives up to the snap, from the filter's memory.

    The third-order filter (2.15) has memory [..., 9] and a target [..., 3] with the rate
    `target_rate`. Its differential equation gives the jerk, and its derivative the snap.
    """
    w = torch.tensor(config.frequency, dtype=memory.dtype)
    d = 2.0 * torch.tensor(config.damping, dtype=memory.dtype) + 1.0
    pose = columns.pose(memory)
    rate = columns.dynamic_states(memory)
    acceleration = columns.motion_accelerations(memory)
    jerk = w**3 * (target - pose) - d * w**2 * rate - d * w * acceleration
    snap = w**3 * (target_rate - rate) - d * w**2 * acceleration - d * w * jerk
    return PoseDerivatives(pose, rate, acceleration, jerk, snap)


class FeedForwardForce(Protocol):
    """A model that computes the thruster force of a motion."""

    def thruster_force(self, nu_dot: Tensor, nu: Tensor, psi: Tensor) -> Tensor:
        """Return the force tau [..., 3] at nu_dot, nu [..., 3] and heading psi [...] rad."""


def required_force(
    model: FeedForwardForce, motion: PoseDerivatives, lag: ActuatorLag | None, hold_time: float
) -> Tensor:
    """Return the required force, with first and second derivative, when a command acts, [..., 9].

    Args:
        model: model of the vessel.
        motion: desired motion with its derivatives.
        lag: lag of the actuators; None for the present force without derivatives.
        hold_time: time in s for which a command is constant; its mean delay is half of it.
    """

    def force_at(h: float) -> Tensor:
        psi, nu, nu_dot = motion.extrapolate(h)
        return model.thruster_force(nu_dot, nu, psi)

    if lag is None:
        force_now = force_at(0.0)
        return torch.cat(
            (force_now, torch.zeros_like(force_now), torch.zeros_like(force_now)), dim=-1
        )
    # a command that is held for hold_time acts on average half of it later
    lead_time = lag.delay + 0.5 * hold_time
    force_before = force_at(lead_time - _DIFFERENCE_STEP)
    force_now = force_at(lead_time)
    force_after = force_at(lead_time + _DIFFERENCE_STEP)
    return torch.cat(
        (
            force_now,
            (force_after - force_before) / (2 * _DIFFERENCE_STEP),
            (force_after - 2 * force_now + force_before) / _DIFFERENCE_STEP**2,
        ),
        dim=-1,
    )


@final
class LagCompensatedPID(Policy):
    """PID with feed-forward of the required force, which compensates the lag of the actuators.

    The reference [B, 18] is eta_d, nu_d, nu_dot_d, then `required_force`. The memory [B, 15] is
    the integral of the PID, then of each axis the predicted force of the actuators, its rate, and
    the integral and double integral of the difference from the required force.

    The command is tau_p + 2 zeta / omega tau_p' + (tau'' + k1 e' + k2 e + k3 I + k4 II) / omega^2,
    with the error e of the force. At a jump of the desired jerk the required force has a corner
    that the actuators cannot follow. The resulting velocity error would take the PID a minute to
    correct; the integrals I and II of e correct it within seconds.

    Args:
        feedback: the PID, without feed-forward.
        lags: lag of the actuators in the model of each row; None for no compensation.
        dt: time step in s.
    """

    def __init__(self, feedback: MotionPID, lags: Sequence[ActuatorLag | None], dt: float) -> None:
        super().__init__()
        self.feedback = feedback
        self.n_state = feedback.n_state + 12
        self.dt = dt
        self.has_lag = any(lag is not None for lag in lags)
        # rows without lag get any stable lag, since `forward` discards its result for them
        lag_table = [[1.0, lag.frequency, lag.damping] if lag else [0.0, 2.0, 1.0] for lag in lags]
        lag_matrices = [
            [[0.0, 1.0, 0.0], [-(w**2), -2 * z * w, w**2], [0.0, 0.0, 0.0]] for _, w, z in lag_table
        ]
        # exact discretisation of the lag for a command that is constant over a step
        step_matrix = torch.linalg.matrix_exp(torch.tensor(lag_matrices, dtype=torch.float64) * dt)
        self.register_buffer("lag", torch.tensor(lag_table, dtype=torch.float64), persistent=False)
        self.register_buffer("step", step_matrix, persistent=False)
        self.lag: Tensor
        self.step: Tensor

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        n = self.feedback.n_state
        correction, integral = self.feedback(x, reference[:, :9], s[:, :n])
        target_force = reference[:, 9:12]
        if not self.has_lag:
            return target_force + correction, torch.cat((integral, s[:, n:]), dim=-1)
        force, rate, integral_error, double_integral = s[:, n:].unflatten(-1, (4, 3)).unbind(1)
        error = target_force - force
        is_lagged, frequency, damping = self.lag.split(1, dim=1)
        k1, k2, k3, k4 = (
            # coefficients of (s + a)^4: four equal poles of the error dynamics
            factor * (_RECOVERY_RATIO * frequency) ** power
            for factor, power in ((4.0, 1), (6.0, 2), (4.0, 3), (1.0, 4))
        )
        required_acceleration = (
            reference[:, 15:18]
            + k1 * (reference[:, 12:15] - rate)
            + k2 * error
            + k3 * integral_error
            + k4 * double_integral
        )
        # inverse of the lag: the command with which the force has the required acceleration
        lead_command = (
            force + (2 * damping / frequency) * rate + required_acceleration / frequency**2
        )
        state = self.step @ torch.stack((force, rate, lead_command), dim=1)
        memory = torch.cat(
            (
                integral,
                state[:, 0],
                state[:, 1],
                integral_error + self.dt * error,
                double_integral + self.dt * integral_error,
            ),
            dim=-1,
        )
        return torch.where(is_lagged > 0.0, lead_command, target_force) + correction, memory


def stack_reference(motion: PoseDerivatives, force: Tensor) -> Tensor:
    """Stack desired motion and `required_force` [..., 9] to the reference [..., 18]."""
    _, nu, nu_dot = motion.extrapolate(0.0)
    return torch.cat((motion.pose, nu, nu_dot, force), dim=-1)


def sample_filtered_course(config: ReferenceFilterConfig, dt: float) -> PoseDerivatives:
    """Compute the filtered reference [T, 3] of a complete course from zero velocity at the origin.

    The result equals the filter of `config`, stepped in time.

    The filter is linear and its target is constant in an interval, so that powers of its step
    matrix give all samples of an interval directly.
    """
    reference_filter = config.build(dt)
    matrix = reference_filter.advance[0]
    steps_per_waypoint = reference_filter.steps_per_waypoint
    powers = torch.eye(3, dtype=torch.float64).expand(1, 3, 3, 3)
    step_power = matrix
    # doubling: powers 0..n-1 times matrix^n give powers n..2n-1, in log2 multiplications
    while len(powers) <= steps_per_waypoint:
        powers = torch.cat((powers, powers @ step_power))
        step_power = step_power @ step_power
    memory = torch.zeros(9, dtype=torch.float64)
    memory_parts = []
    targets = []
    for target in reference_filter.waypoints[0]:
        error = torch.stack(
            (
                columns.pose(memory) - target,
                columns.dynamic_states(memory),
                columns.motion_accelerations(memory),
            ),
            dim=-1,
        )
        error_path = torch.einsum("taij,aj->tia", powers[: steps_per_waypoint + 1], error)
        error_path[:, 0] += target
        states = error_path.reshape(steps_per_waypoint + 1, 9)
        memory_parts.append(states[:steps_per_waypoint])
        targets.append(target.expand(steps_per_waypoint, 3))
        memory = states[steps_per_waypoint]
    target = torch.cat(targets)
    return filter_derivatives(config, torch.cat(memory_parts), target, torch.zeros_like(target))
