"""Line-of-sight guidance along straight legs between way-points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.control.base import Reference
from residnet.control.guidance.line_of_sight import LineOfSight
from residnet.control.heading.turning import Turning
from residnet.core.errors import ConfigError

_ANGLES = 181
"""Changes of course in the table, one for each degree."""
_SAMPLES = 100
"""Points of the track of a turn."""
_DISTANCES = 400
"""Distances that are tried for each turn."""


@final
class WheelOver(nn.Module):
    """Distance before a way-point at which the leg changes, by the change of course there.

    A vessel T r_dot + r = K delta that puts its rudder over to the limit, and then back until the
    yaw stops on the next leg, has turned about the corner of both legs from the distance where its
    track begins to where it ends. In sharp corners that track would stay out of the way-point's
    circle of acceptance; there the distance is the largest from which it still reaches into the
    circle.

    Args:
        turning: K, T and speed.
        limit: of the rudder in rad.
        acceptance: radius of the circle in m.
        share: of that radius that the track keeps within.
        rate: of the rudder in rad/s; None where it stands at its command at once. While it moves,
            half of the way is lost.
    """

    def __init__(
        self,
        turning: Turning,
        limit: float,
        acceptance: float,
        *,
        share: float = 0.6,
        rate: float | None = None,
    ) -> None:
        super().__init__()
        angles, reach, tracks = _turns(turning, limit)
        within = share * acceptance
        radius = turning.speed / (turning.gain * limit)
        # an arc without lag, then the lag
        farthest = math.sqrt(within * (2.0 * radius + within)) + turning.speed * turning.time
        distance = np.linspace(0.0, farthest, _DISTANCES)
        missed = np.stack(
            [np.hypot(distance[:, None] - track[:, 0], track[:, 1]).min(axis=1) for track in tracks]
        )
        found = np.where((distance <= reach[:, None]) & (missed <= within), distance, 0.0).max(
            axis=1
        )
        even = np.linspace(0.0, math.pi, _ANGLES)
        moving = 0.0 if rate is None else 0.5 * turning.speed * limit / rate
        self.register_buffer(
            "table", torch.from_numpy(np.interp(even, angles, found) + moving), persistent=False
        )
        self.table: Tensor

    def forward(self, change: Tensor) -> Tensor:
        """Return the distance [B] in m for changes of course [B] in rad, within +-pi."""
        table = self.table.to(change.dtype)
        along = change.abs() * (float(table.shape[0] - 1) / math.pi)
        before = along.floor().clamp(max=float(table.shape[0] - 2))
        number, share = before.long(), along - before
        return (1.0 - share) * table[number] + share * table[number + 1]


def _turns(turning: Turning, limit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heading changes [N], distances to the corner [N] and tracks [N, M, 2] of turns.

    The heading changes go from 0 to past pi in rad; a distance is from a turn's beginning to where
    the lines before and after it meet, in m; tracks are ahead and aside, in m.
    """
    full, time = turning.gain * limit, turning.time
    held = np.concatenate(
        ([0.0], np.geomspace(1e-3 * time, math.pi / full + 2.0 * time, 4 * _ANGLES))
    )[:, None]
    first = full * (1.0 - np.exp(-held / time))
    share = np.linspace(0.0, 1.0, _SAMPLES)[None, :]
    # over, then back until the yaw has stopped
    over = held * share
    back = time * np.log1p(first / full) * share[:, 1:]
    turned = full * held - time * first
    rate = (first + full) * np.exp(-back / time) - full
    heading = np.concatenate(
        (
            full * (over - time * (1.0 - np.exp(-over / time))),
            turned + time * (first - rate) - full * back,
        ),
        axis=1,
    )
    moments = np.concatenate((over, held + back), axis=1)
    step = turning.speed * np.diff(moments, axis=1)
    middle = 0.5 * (heading[:, 1:] + heading[:, :-1])
    parts = np.stack((step * np.cos(middle), step * np.sin(middle)), axis=-1)
    track = np.concatenate((np.zeros((len(parts), 1, 2)), parts.cumsum(axis=1)), axis=1)
    angle = heading[:, -1]
    sine = np.sin(angle)
    meet = np.where(
        sine > 1e-9,
        track[:, -1, 0] - track[:, -1, 1] * np.cos(angle) / np.maximum(sine, 1e-9),
        math.inf,
    )
    return angle, np.where(angle == 0.0, 0.0, meet), track


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
