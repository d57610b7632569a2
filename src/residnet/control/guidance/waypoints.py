"""Line-of-sight guidance along straight legs between way-points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Reference
from residnet.control.guidance.line_of_sight import LineOfSight
from residnet.control.guidance.wheel_over import WheelOver
from residnet.core.errors import ConfigError

_ON_LEG = 0.4
"""Share of the circle of acceptance that a vessel may be set off its leg by, at the wheel-over and
on from there, for the turn to count on.
"""


@final
class WaypointGuidance(Reference):
    """Reference heading [B, 1] along straight legs between way-points.

    It is the leg's direction and the angle by which a law of the line of sight steers back to it.

    The leg changes when the vessel enters the circle of acceptance of its way-point, or has passed
    it; with a wheel-over, before that, where the vessel runs along its leg: its cross-track error,
    and what its heading aside of the leg would add on the way, are small against the circle. A crab
    angle is such a heading, by as much as the current will set the vessel. Behind the last
    way-point it has arrived. Memory [B, 3 + that of the law]: number of the way-point that is
    steered for, and where the vessel began, which is the beginning of the first leg.

    Args:
        points: way-points (north, east) in m, in their order.
        acceptance: radius of the circle in m.
        sight: law of the line of sight.
        state: names of the vessel's state.
        wheel_over: how far before a way-point the leg changes; None for in its circle.
    """

    def __init__(
        self,
        points: Sequence[tuple[float, float]],
        acceptance: float,
        sight: LineOfSight,
        state: Sequence[str],
        wheel_over: WheelOver | None = None,
    ) -> None:
        super().__init__()
        if not points or acceptance <= 0:
            raise ConfigError(
                "way-points: give at least one, and a circle of acceptance above zero; given"
                f" {len(points)}, {acceptance:g} m"
            )
        self.register_buffer("points", torch.tensor(points, dtype=torch.float64), persistent=False)
        self.points: Tensor
        self.acceptance, self.sight, self.wheel_over = acceptance, sight, wheel_over
        self.on_leg = _ON_LEG * acceptance
        self.x, self.y, self.psi = state.index("x"), state.index("y"), state.index("psi")
        self.n_state = 3 + sight.n_state
        self.may_finish = True

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start of the first leg, which begins where the vessel is."""
        rest = torch.zeros(x.shape[0], self.n_state - 3, dtype=x.dtype, device=x.device)
        return torch.cat(
            (
                torch.zeros_like(x[:, :1]),
                x[:, self.x : self.x + 1],
                x[:, self.y : self.y + 1],
                rest,
            ),
            dim=-1,
        )

    def leg(self, x: Tensor, number: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return a leg's direction [B] in rad, distance left [B] and cross-track error [B] in m.

        The distance is along the leg; the cross-track error is positive to starboard of it.
        """
        points = self.points.to(x.dtype)
        target = points[number.clamp(max=len(points) - 1)]
        before = torch.where(
            (number == 0).unsqueeze(-1), s[:, 1:3], points[(number - 1).clamp(0, len(points) - 1)]
        )
        along = target - before
        direction = torch.atan2(along[:, 1], along[:, 0])
        north, east = target[:, 0] - x[:, self.x], target[:, 1] - x[:, self.y]
        ahead = north * torch.cos(direction) + east * torch.sin(direction)
        return direction, ahead, north * torch.sin(direction) - east * torch.cos(direction)

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reference heading [B, 1] in rad and the memory."""
        number = s[:, 0].long()
        direction, ahead, error = self.leg(x, number, s)
        reached = (ahead <= 0) | (ahead * ahead + error * error <= self.acceptance**2)
        if self.wheel_over is not None:
            change = self.leg(x, number + 1, s)[0] - direction
            before = self.wheel_over(torch.remainder(change + math.pi, 2.0 * math.pi) - math.pi)
            aside = error.abs() + before * torch.sin(x[:, self.psi] - direction).abs()
            reached = reached | (
                (ahead <= before) & (aside <= self.on_leg) & (number < len(self.points) - 1)
            )
        number = (number + reached.long()).clamp(max=self.points.shape[0])
        direction, _, error = self.leg(x, number, s)
        angle, memory = self.sight(error, direction, s[:, 3:])
        heading = (
            torch.remainder(direction + angle + math.pi, 2.0 * math.pi).unsqueeze(-1) - math.pi
        )
        return heading, torch.cat((number.to(x.dtype).unsqueeze(-1), s[:, 1:3], memory), dim=-1)

    def finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return the rows behind their last way-point."""
        return s[:, 0] >= self.points.shape[0]
