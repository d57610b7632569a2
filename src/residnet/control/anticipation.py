"""Feed-forward through lagging actuators: the force that a model needs a little later, led by what the actuators lag behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.pid import MotionPID
from residnet.control.reference_filter import ReferenceFilterConfig
from residnet.core.config import Config, RadiansPerSecond, Seconds
from residnet.core.frames import to_body
from residnet.physics.force_model import ForceModel

_STEP = 0.05
"""Seconds between the points that the force's derivatives are taken from; the reference itself is known analytically there."""


class Lag(Config):
    """tau'' + 2 zeta omega tau' + omega^2 tau = omega^2 tau_c(t - delay): how forces follow commands (document 002 eq. (4.3))."""

    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)
    delay: Seconds = Field(default=0.0, ge=0)


class Derivatives(NamedTuple):
    """A desired pose and its derivatives in earth axes (north [m], east [m], heading [rad]), each [..., 3]."""

    pose: Tensor
    rate: Tensor
    acceleration: Tensor
    jerk: Tensor
    snap: Tensor

    def later(self, h: float) -> tuple[Tensor, Tensor, Tensor]:
        """Heading [...], nu_d and nu_dot_d [..., 3] in body axes h seconds later, along the Taylor series."""
        pose = self.pose + h * (self.rate + h / 2 * (self.acceleration + h / 3 * (self.jerk + h / 4 * self.snap)))
        rate = self.rate + h * (self.acceleration + h / 2 * (self.jerk + h / 3 * self.snap))
        change = self.acceleration + h * (self.jerk + h / 2 * self.snap)
        psi, r = pose[..., 2], rate[..., 2]
        u, v = to_body(rate[..., 0], rate[..., 1], psi)
        along, across = to_body(change[..., 0], change[..., 1], psi)
        # a vector fixed in the earth turns by -r in the body (ERRATA J7)
        return psi, torch.stack((u, v, r), dim=-1), torch.stack((along + r * v, across - r * u, change[..., 2]), dim=-1)


def derivatives(config: ReferenceFilterConfig, memory: Tensor, target: Tensor, target_rate: Tensor) -> Derivatives:
    """Jerk and snap of the third-order filter (2.15) at its memory [..., 9] under a target [..., 3] that moves by `target_rate`."""
    w = torch.tensor(config.frequency, dtype=memory.dtype)
    d = 2.0 * torch.tensor(config.damping, dtype=memory.dtype) + 1.0
    pose, rate, change = memory[..., :3], memory[..., 3:6], memory[..., 6:]
    jerk = w**3 * (target - pose) - d * w**2 * rate - d * w * change
    snap = w**3 * (target_rate - rate) - d * w**2 * change - d * w * jerk
    return Derivatives(pose, rate, change, jerk, snap)


def led_force(model: ForceModel, motion: Derivatives, lag: Lag | None, ahead: float) -> Tensor:
    """tau_c [..., 3] that makes lagging actuators give what the model needs for the motion.

    Args:
        model: of the vessel.
        motion: desired.
        lag: of the actuators; None commands the force itself.
        ahead: how much earlier a command must come than its effect beside the lag's own delay, in s: half a step for one that is held.
    """

    def force(h: float) -> Tensor:
        psi, nu, nu_dot = motion.later(h)
        return model.at_heading(nu_dot, nu, psi)

    if lag is None:
        return force(0.0)
    at = lag.delay + ahead
    before, now, after = force(at - _STEP), force(at), force(at + _STEP)
    first, second = (after - before) / (2 * _STEP), (after - 2 * now + before) / _STEP**2
    return now + (2 * lag.damping / lag.frequency) * first + second / lag.frequency**2


@final
class Assisted(Policy):
    """PID on a reference that brings its feed-forward along: [B, 12] = eta_d, nu_d, nu_dot_d, tau_FF (2.14)."""

    def __init__(self, feedback: MotionPID) -> None:
        super().__init__()
        self.feedback = feedback
        self.n_state = feedback.n_state

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Command tau [B, 3] and the integral [B, 3]."""
        tau, s = self.feedback(x, reference[:, :9], s)
        return tau + reference[:, 9:], s


def reference_row(motion: Derivatives, forces: Sequence[Tensor] | Tensor) -> Tensor:
    """[..., 12] for `Assisted` from the desired motion and the feed-forward [..., 3]."""
    force = forces if isinstance(forces, Tensor) else torch.cat(list(forces))
    _, nu, nu_dot = motion.later(0.0)
    return torch.cat((motion.pose, nu, nu_dot, force), dim=-1)


def course(config: ReferenceFilterConfig, dt: float) -> Derivatives:
    """The desired motion [T, 3] of a whole course from rest at the origin: what the filter of `config` gives step by step.

    The filter is linear and its target constant over an interval, so that powers of its step matrix give each interval at once.
    """
    filtered = config.build(dt)
    matrix, every = filtered.advance[0], filtered.every
    powers = torch.eye(3, dtype=torch.float64).expand(1, 3, 3, 3)
    step = matrix
    while len(powers) <= every:
        powers = torch.cat((powers, powers @ step))
        step = step @ step
    memory, parts, targets = torch.zeros(9, dtype=torch.float64), [], []
    for target in filtered.waypoints[0]:
        error = torch.stack((memory[:3] - target, memory[3:6], memory[6:]), dim=-1)
        path = torch.einsum("taij,aj->tia", powers[: every + 1], error)
        path[:, 0] += target
        states = path.reshape(every + 1, 9)
        parts.append(states[:every])
        targets.append(target.expand(every, 3))
        memory = states[every]
    target = torch.cat(targets)
    return derivatives(config, torch.cat(parts), target, torch.zeros_like(target))
