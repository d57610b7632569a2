"""Estimates of heading, yaw rate and push, and where they will be once pending commands arrive."""

from __future__ import annotations

from typing import NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.control.heading.turning import Turning
from residnet.core.frames import wrap

CONSTANTS = ("heading_rate", "yaw_rate_rate", "push_rate", "cross_rate")
"""Of the observer: how fast heading, yaw rate and push follow what is measured in 1/s, and how
fast the yaw rate follows the heading's innovation in 1/s^2."""

_LOST = 0.35
"""Difference in rad between measured and expected heading beyond which the estimate is lost."""


class Estimate(NamedTuple):
    """What is known of the vessel at a step, each [B, 1], SI.

    Attributes:
        heading, r: now.
        push: rudder angle that what pushes the bow stands for.
        heading_ahead, r_ahead: once the pending commands have arrived.
        surprise_heading, surprise_r: measured less expected.
    """

    heading: Tensor
    r: Tensor
    push: Tensor
    heading_ahead: Tensor
    r_ahead: Tensor
    surprise_heading: Tensor
    surprise_r: Tensor


@final
class HeadingObserver(nn.Module):
    """A Luenberger observer of T r_dot + r = K (delta + push), with a predictor.

    The rudder is taken to act `lag` seconds after its command; the predictor adds what the commands
    of these seconds will do, in closed form. K grows and T falls with the speed. Where heading or
    yaw rate are far from what was expected, the estimate begins anew at what is measured.

    Args:
        turning: K, T and speed of the vessel about straight ahead.
        limit: largest push in rad.
        lag: time in s between a command and its rudder; 0 for no predictor.
        dt: step in s.
    """

    def __init__(self, turning: Turning, limit: float, lag: float, dt: float) -> None:
        super().__init__()
        self.gain, self.time = turning.gain, turning.time
        self.limit, self.lag, self.lost = limit, lag, _LOST
        self.dt, self.pending = dt, round(lag / dt)
        self.register_buffer("left", torch.zeros(0), persistent=False)
        self.left: Tensor
        self.at(dt)

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt, self.pending = dt, round(self.lag / dt)
        # time in s that is left of the lag when each pending command has acted, the oldest first
        left = dt * torch.arange(self.pending - 1, -1, -1, dtype=torch.float64)
        self.left = left.to(self.left.dtype)

    def forward(
        self,
        psi: Tensor,
        r: Tensor,
        heading: Tensor,
        yaw_rate: Tensor,
        push: Tensor,
        pending: Tensor,
        ratio: Tensor,
        constants: list[Tensor],
    ) -> Estimate:
        """Return the estimate with a measurement taken in.

        Args:
            psi, r: measured heading and yaw rate [B, 1].
            heading, yaw_rate, push: expected before the measurement, [B, 1].
            pending: rudder angles [B, pending] that have still to act, the oldest first.
            ratio: speed [B, 1] over that of K and T.
            constants: `CONSTANTS`, [1] or [B, 1] each.
        """
        surprise_heading, surprise_r = wrap(psi - heading), r - yaw_rate
        # no vessel does this within a step: measurements were missing, and the estimate is taken
        # up anew where they come back, with the push as it was
        full = 3.0 * self.gain * ratio * self.limit
        lost = (surprise_heading.abs() > self.lost) | (surprise_r.abs() > full)
        heading, yaw_rate = torch.where(lost, psi, heading), torch.where(lost, r, yaw_rate)
        nothing = torch.zeros_like(surprise_r)
        surprise_heading = torch.where(lost, nothing, surprise_heading)
        surprise_r = torch.where(lost, nothing, surprise_r)
        shares = [1.0 - torch.exp(-self.dt * rate) for rate in constants[:2]]
        turn = shares[1] * surprise_r + self.dt * constants[3] * surprise_heading
        heading, yaw_rate = heading + shares[0] * surprise_heading, yaw_rate + turn
        per_push = self.time / (self.gain * ratio.square())
        push = (push + constants[2] * per_push * turn).clamp(-self.limit, self.limit)
        ahead, r_ahead = heading, yaw_rate
        if self.pending > 0:
            ahead, r_ahead = self._ahead(heading, yaw_rate, push, pending, ratio)
        return Estimate(heading, yaw_rate, push, ahead, r_ahead, surprise_heading, surprise_r)

    def _ahead(
        self, heading: Tensor, r: Tensor, push: Tensor, pending: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return heading and yaw rate [B, 1] when the pending rudder angles have acted."""
        constant = self.time / ratio
        step = 1.0 - torch.exp(-self.dt / constant)
        later = torch.exp(-self.left / constant)
        acting = self.gain * ratio * (pending + push)
        lag = self.dt * self.pending
        kept = torch.exp(-lag / constant)
        r_ahead = kept * r + (acting * step * later).sum(1, keepdim=True)
        turned = (acting * (self.dt - constant * step * later)).sum(1, keepdim=True)
        return heading + constant * (1.0 - kept) * r + turned, r_ahead

    def expected(
        self, heading: Tensor, r: Tensor, push: Tensor, rudder: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return heading [-pi, pi) and yaw rate [B, 1] a step later under a rudder angle."""
        constant = self.time / ratio
        steady = self.gain * ratio * (rudder + push)
        change = (1.0 - torch.exp(-self.dt / constant)) * (steady - r)
        return wrap(heading + self.dt * steady - constant * change), r + change
