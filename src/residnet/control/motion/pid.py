"""Position and heading control in surge, sway and yaw: PID in the body frame with feed-forward.

Source: document 002 section 2.2.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.control.base import Policy
from residnet.core.columns import pose, velocities
from residnet.core.config import Config
from residnet.core.frames import to_body, wrap
from residnet.physics.actuators import ForceActuators
from residnet.physics.plant import Hull

Gain = Annotated[float, Field(ge=0)]
Gains = tuple[Gain, Gain, Gain]


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
        return self.hull.required(nu_dot, nu)


class MotionPIDConfig(Config):
    """Gains on surge, sway and yaw; all zero leaves the feed-forward alone.

    Attributes:
        proportional: in N/m, N/m, N m/rad.
        integral: in N/(m s), N/(m s), N m/(rad s).
        derivative: in N s/m, N s/m, N m s/rad.
    """

    kind: Literal["motion_pid"] = "motion_pid"
    proportional: Gains
    integral: Gains = (0.0, 0.0, 0.0)
    derivative: Gains = (0.0, 0.0, 0.0)

    def build(self, dt: float, feed_forward: FeedForward | None = None) -> MotionPID:
        """Return the controller for a loop with steps of dt seconds."""
        return MotionPID([self], dt, NoFeedForward() if feed_forward is None else feed_forward)


@final
class MotionPID(Policy):
    """The law tau = F(nu_dot_d, nu_d) + Kp e + Ki I + Kd (nu_d - nu).

    e = R^T(psi) (eta_d - eta) with its heading wrapped (2.9)-(2.14).

    Reference [B, 9]: eta_d, nu_d, nu_dot_d, as `ReferenceFilter` gives it. The memory [B, 3] is I,
    the sum of e dt of the steps before. There is one config for all rows, or one for each row of
    the batch.
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

    def error(self, x: Tensor, reference: Tensor) -> Tensor:
        """Return e [B, 3] in body axes: m, m, rad."""
        difference = pose(reference) - pose(x)
        along, across = to_body(difference[:, 0], difference[:, 1], x[:, 2])
        return torch.stack((along, across, wrap(difference[:, 2])), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the command tau [B, 3] in N, N, N m, and the integral with this step's error."""
        error = self.error(x, reference)
        nu_d = velocities(reference)
        gains = self.gains.to(x.dtype)
        feedback = gains[0] * error + gains[1] * s + gains[2] * (nu_d - velocities(x))
        return self.feed_forward(reference[:, 6:9], nu_d) + feedback, s + self.dt * error


@final
class Allocated(Policy):
    """A controller of forces for a vessel whose actuators can make them.

    Its tau is allocated to their commands, such as revolutions and angles of azimuth thrusters.
    """

    def __init__(self, policy: Policy, thrusters: ForceActuators) -> None:
        super().__init__()
        self.policy = policy
        self.thrusters = thrusters
        self.n_state = policy.n_state

    def initial_state(self, x: Tensor) -> Tensor:
        return self.policy.initial_state(x)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        tau, s = self.policy(x, reference, s)
        return self.thrusters.allocate(tau), s
