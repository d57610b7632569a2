"""Feed-forward through lagging actuators.

The force that a model needs a little later is led by what the actuators lag behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.motion.pid import MotionPID
from residnet.control.motion.reference_filter import ReferenceFilterConfig
from residnet.core import columns
from residnet.core.config import Config, RadiansPerSecond, Seconds
from residnet.core.frames import to_body
from residnet.physics.force_model import ForceModel

_STEP = 0.05
"""Seconds between the points that the force's derivatives are taken from; the reference itself is
known analytically there.
"""
_MEND = 0.7
"""How fast a miss of the needed force is made up for, in units of the lag's own frequency: the
command's peaks grow with it.
"""


class Lag(Config):
    """The lag of forces behind commands: tau'' + 2 zeta omega tau' + omega^2 tau = omega^2 tau_c.

    tau_c is taken at t - delay (document 002 eq. (4.3)).

    Attributes:
        frequency: omega in rad/s.
        damping: zeta, dimensionless.
        delay: in s.
    """

    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)
    delay: Seconds = Field(default=0.0, ge=0)


class Derivatives(NamedTuple):
    """A desired pose in earth axes (north, east [m], heading [rad]) with derivatives, [..., 3]."""

    pose: Tensor
    rate: Tensor
    acceleration: Tensor
    jerk: Tensor
    snap: Tensor

    def later(self, h: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return heading [...], nu_d and nu_dot_d [..., 3] in body axes h seconds later.

        They follow the Taylor series.
        """
        pose = self.pose + h * (
            self.rate + h / 2 * (self.acceleration + h / 3 * (self.jerk + h / 4 * self.snap))
        )
        rate = self.rate + h * (self.acceleration + h / 2 * (self.jerk + h / 3 * self.snap))
        change = self.acceleration + h * (self.jerk + h / 2 * self.snap)
        psi, r = pose[..., 2], rate[..., 2]
        u, v = to_body(rate[..., 0], rate[..., 1], psi)
        along, across = to_body(change[..., 0], change[..., 1], psi)
        # a vector fixed in the earth turns by -r in the body (correction J7)
        return (
            psi,
            torch.stack((u, v, r), dim=-1),
            torch.stack((along + r * v, across - r * u, change[..., 2]), dim=-1),
        )


def derivatives(
    config: ReferenceFilterConfig, memory: Tensor, target: Tensor, target_rate: Tensor
) -> Derivatives:
    """Return the desired pose and its derivatives up to the snap, from the filter's memory.

    The third-order filter (2.15) has memory [..., 9] and a target [..., 3] that moves by
    `target_rate`.
    """
    w = torch.tensor(config.frequency, dtype=memory.dtype)
    d = 2.0 * torch.tensor(config.damping, dtype=memory.dtype) + 1.0
    pose, rate, change = (
        columns.pose(memory),
        columns.velocities(memory),
        columns.accelerations(memory),
    )
    jerk = w**3 * (target - pose) - d * w**2 * rate - d * w * change
    snap = w**3 * (target_rate - rate) - d * w**2 * change - d * w * jerk
    return Derivatives(pose, rate, change, jerk, snap)


def needed_force(model: ForceModel, motion: Derivatives, lag: Lag | None, held: float) -> Tensor:
    """Return the force that a model needs when a command given now takes effect, [..., 9].

    Its first and second derivative stand behind it.

    Args:
        model: of the vessel.
        motion: desired.
        lag: of the actuators; None commands the force itself, now and without derivatives.
        held: seconds that a command is held; on average it comes late by half of them.
    """

    def force(h: float) -> Tensor:
        psi, nu, nu_dot = motion.later(h)
        return model.at_heading(nu_dot, nu, psi)

    if lag is None:
        now = force(0.0)
        return torch.cat((now, torch.zeros_like(now), torch.zeros_like(now)), dim=-1)
    at = lag.delay + 0.5 * held
    before, now, after = force(at - _STEP), force(at), force(at + _STEP)
    return torch.cat(
        (now, (after - before) / (2 * _STEP), (after - 2 * now + before) / _STEP**2), dim=-1
    )


@final
class Assisted(Policy):
    """PID on a reference that brings along what a model needs, led by the lag of the actuators.

    Reference [B, 18]: eta_d, nu_d, nu_dot_d, then `needed_force`. Memory [B, 15]: the integral of
    the PID, then of each axis the predicted force of the actuators, its rate, and the integral and
    double integral of what it misses of the needed force.

    The command is tau_p + 2 zeta / omega tau_p' + (tau'' + k1 e' + k2 e + k3 I + k4 II) / omega^2,
    e the miss: where the desired jerk jumps, the needed force has a corner that no command follows,
    and the vessel would be left with a wrong velocity that the PID takes a minute to mend; the
    integrals make up for it within seconds.

    Args:
        feedback: the PID, without feed-forward.
        lags: of each row's actuators as its model has it; None commands the needed force itself.
        dt: step in s.
    """

    def __init__(self, feedback: MotionPID, lags: Sequence[Lag | None], dt: float) -> None:
        super().__init__()
        self.feedback = feedback
        self.n_state = feedback.n_state + 12
        self.dt = dt
        self.leads = any(lag is not None for lag in lags)
        known = [lag or Lag(frequency=2.0, damping=1.0) for lag in lags]
        told = [
            [float(lag is not None), one.frequency, one.damping]
            for lag, one in zip(lags, known, strict=True)
        ]
        rows = [
            [[0.0, 1.0, 0.0], [-(w**2), -2 * z * w, w**2], [0.0, 0.0, 0.0]]
            for w, z in ((lag.frequency, lag.damping) for lag in known)
        ]
        step = torch.linalg.matrix_exp(torch.tensor(rows, dtype=torch.float64) * dt)
        self.register_buffer("lag", torch.tensor(told, dtype=torch.float64), persistent=False)
        self.register_buffer("step", step, persistent=False)
        self.lag: Tensor
        self.step: Tensor

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        n = self.feedback.n_state
        correction, integral = self.feedback(x, reference[:, :9], s[:, :n])
        needed = reference[:, 9:12]
        if not self.leads:
            return needed + correction, torch.cat((integral, s[:, n:]), dim=-1)
        force, rate, missed, twice = s[:, n:].unflatten(-1, (4, 3)).unbind(1)
        error = needed - force
        led, frequency, damping = self.lag.split(1, dim=1)
        k1, k2, k3, k4 = (
            factor * (_MEND * frequency) ** power
            for factor, power in ((4.0, 1), (6.0, 2), (4.0, 3), (1.0, 4))
        )
        drive = (
            reference[:, 15:18]
            + k1 * (reference[:, 12:15] - rate)
            + k2 * error
            + k3 * missed
            + k4 * twice
        )
        lead = force + (2 * damping / frequency) * rate + drive / frequency**2
        state = self.step @ torch.stack((force, rate, lead), dim=1)
        memory = torch.cat(
            (
                integral,
                state[:, 0],
                state[:, 1],
                missed + self.dt * error,
                twice + self.dt * missed,
            ),
            dim=-1,
        )
        return torch.where(led > 0.0, lead, needed) + correction, memory


def reference_row(motion: Derivatives, needed: Tensor) -> Tensor:
    """Return [..., 18] for `Assisted` from the desired motion and `needed_force` [..., 9]."""
    _, nu, nu_dot = motion.later(0.0)
    return torch.cat((motion.pose, nu, nu_dot, needed), dim=-1)


def course(config: ReferenceFilterConfig, dt: float) -> Derivatives:
    """Return the desired motion [T, 3] of a whole course from rest at the origin.

    It is what the filter of `config` gives step by step.

    The filter is linear and its target constant over an interval, so that powers of its step matrix
    give each interval at once.
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
        error = torch.stack(
            (
                columns.pose(memory) - target,
                columns.velocities(memory),
                columns.accelerations(memory),
            ),
            dim=-1,
        )
        path = torch.einsum("taij,aj->tia", powers[: every + 1], error)
        path[:, 0] += target
        states = path.reshape(every + 1, 9)
        parts.append(states[:every])
        targets.append(target.expand(every, 3))
        memory = states[every]
    target = torch.cat(targets)
    return derivatives(config, torch.cat(parts), target, torch.zeros_like(target))
