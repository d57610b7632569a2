"""Heading laws: rudder from heading error and yaw rate, each with positive constants."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, final

import torch
from torch import Tensor, nn


def centred(
    error: Tensor, r: Tensor, acting: Tensor, force: Tensor, decay: Tensor, swing: float
) -> tuple[Tensor, Tensor]:
    """Return the error and yaw rate [B, 1] that will be left once the rudder is centred.

    The rudder acts with a share of its limit until it has gone to where it does nothing.

    Args:
        error: heading error [B, 1] in rad.
        r: yaw rate [B, 1] in rad/s.
        acting: rudder [B, 1] as a share of its limit.
        force: yaw acceleration [B, 1] of full rudder in rad/s^2.
        decay: 1/T [B, 1] in 1/s.
        swing: time in s that the rudder takes from amidships to its limit.
    """
    wait = acting.abs() * swing
    later = r + wait * (0.5 * force * acting - decay * r)
    return error - wait * (r + wait * (force * acting / 3.0 - 0.5 * decay * r)), later


def braking(
    r: Tensor, force: Tensor, decay: Tensor, stiffness: Tensor, stiff: Tensor, swing: float
) -> Tensor:
    """Return the heading [B, 1] that passes while r_dot = -force - decay r stops the yaw rate.

    It is r / nu near zero, with the same slope there.

    The rudder starts from amidships and comes back there: that takes half of its swing more, or a
    pulse that does not reach the limit. nu is chosen such that e'' + (decay + stiffness / nu) e' +
    stiffness e = 0 has the relative damping `stiff`.

    Args:
        r: yaw rate [B, 1] in rad/s.
        force: yaw acceleration that is counted on, in rad/s^2.
        decay: 1/T in 1/s.
        stiffness: yaw acceleration per heading error near the reference in 1/s^2.
        stiff: relative damping there.
        swing: time in s that the rudder takes from amidships to its limit.
    """
    line = ((2.0 * stiff * torch.sqrt(stiffness) - decay) / stiffness).clamp(min=1e-3)
    lead = (line - 0.5 * swing).clamp(min=1e-3)
    end = force * lead / (1.0 - decay * lead).clamp(min=0.1)
    if swing > 0.0:
        end = torch.where(line < 1.5 * swing, (line / 1.5).square() * force / swing, end)
    size = r.abs()
    beyond = torch.maximum(size, end)
    curve = (
        _distance(beyond, force, decay, swing) - _distance(end, force, decay, swing) + end * line
    )
    return r.sign() * torch.where(size < end, size * line, curve)


def _distance(r: Tensor, force: Tensor, decay: Tensor, swing: float) -> Tensor:
    """Return the heading [B, 1] in which a yaw rate r > 0 is stopped.

    It is the integral of r dr / (force + decay r), and what the rudder's swing adds.
    """
    braking_angle = (r - force / decay * torch.log1p(decay * r / force)) / decay
    if swing == 0.0:
        return braking_angle
    pulse = r * torch.sqrt(r * swing / force) - 0.5 * r.square() / force
    return braking_angle + torch.where(r < force * swing, pulse, 0.5 * swing * r)


class HeadingLaw(nn.Module, ABC):
    """The rudder, as a share of its limit, from heading error and yaw rate.

    Attributes:
        constants: names of the law's constants, all positive.
    """

    constants: ClassVar[tuple[str, ...]]

    @abstractmethod
    def forward(
        self,
        error: Tensor,
        r: Tensor,
        acting: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        """Return the wanted share [B, 1] of the rudder's limit; it may exceed one.

        Args:
            error: heading error [B, 1] in rad.
            r: yaw rate [B, 1] in rad/s.
            acting: rudder angle and push [B, 1] as a share of the limit.
            force: yaw acceleration [B, 1] of full rudder in rad/s^2.
            decay: 1/T [B, 1] in 1/s.
            constants: the law's own, [1] or [B, 1] each.
        """


@final
class RegulatorLaw(HeadingLaw):
    """The linear-quadratic regulator kp e - kd r of T r_dot + r = K delta.

    Its weights are those of `LqrConfig`: kp = sqrt(heading_weight), (1 + K kd)^2 = 1 + K^2 T^2
    rate_weight + 2 K T kp.
    """

    constants: ClassVar[tuple[str, ...]] = ("heading_weight", "rate_weight")

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(
        self,
        error: Tensor,
        r: Tensor,
        acting: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        heading, rate = regulator_gains(
            constants[0], constants[1], force / (decay * self.limit), 1.0 / decay
        )
        return (heading * error - rate * r) / self.limit


def regulator_gains(
    heading_weight: Tensor, rate_weight: Tensor, gain: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    """Return kp [-] and kd [s] of the regulator's weights; K [1/s], T [s], shapes broadcast."""
    kp = heading_weight.sqrt()
    square = 1.0 + (gain * time).square() * rate_weight + 2.0 * gain * time * kp
    return kp, (square.sqrt() - 1.0) / gain


@final
class StoppingLaw(HeadingLaw):
    """The proximate time-optimal law: full rudder until only the way to stop is left.

    steepness (e - g(r)) with g the heading in which counter-rudder stops the yaw rate, a straight
    line near the reference (M. L. Workman, Adaptive proximate time-optimal servomechanisms, 1987).
    `share` of the rudder's braking is counted on; `damping` is the relative damping near the
    reference.
    """

    constants: ClassVar[tuple[str, ...]] = ("steepness", "share", "damping")

    def __init__(self, swing: float) -> None:
        super().__init__()
        self.swing = swing

    def forward(
        self,
        error: Tensor,
        r: Tensor,
        acting: Tensor,
        force: Tensor,
        decay: Tensor,
        constants: list[Tensor],
    ) -> Tensor:
        """Return steepness times the heading that is left once the yaw rate is stopped, [B, 1]."""
        steep, share, stiff = constants[0], constants[1], constants[2]
        ahead, left = error, r
        if self.swing > 0.0:
            # the rudder answers its own angle with a gain above one, within its rate: a gradient
            # through that would grow from step to step and say nothing of the flight
            ahead, left = centred(error, r, acting.detach(), force, decay, self.swing)
        stopping = braking(left, share * force, decay, steep * force, stiff, self.swing)
        return steep * (ahead - stopping)
