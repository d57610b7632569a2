"""Guidance along a planned course: where the vessel is along it, and what heading, yaw rate and rudder it asks for there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor

from residnet.control.base import Reference
from residnet.control.course_plan import Course
from residnet.core.errors import ConfigError

_LEAST = 0.3
"""Of 1 - curvature x cross-track error: beyond, the centre of the turn is near and the nearest point no longer known."""


@final
class CourseGuidance(Reference):
    """Reference [B, 3] of `following.FOLLOWED` for a planned course.

    Line of sight on a curved path: heading_d = heading of the course - atan(e / look-ahead), e the cross-track error, positive to starboard,
    where the vessel makes way along the course's own tangent. Yaw rate and rudder are those of the course at the present speed, so that
    turns begin before the arc does. The place along the course moves by one Newton step of the nearest point each time, never back.
    Memory [B, 1]: place along the course in m.

    Args:
        course: to follow.
        lookahead: distance in m.
        state: names of the vessel's state.
    """

    def __init__(self, course: Course, lookahead: float, state: Sequence[str]) -> None:
        super().__init__()
        if lookahead <= 0:
            raise ConfigError(f"look-ahead must be above zero, given {lookahead:g} m")
        curvatures = (np.gradient(course.direction, course.step), np.gradient(course.heading, course.step))
        columns = (*course.track.T, course.direction, course.heading, course.rudder, *curvatures)
        self.register_buffer("table", torch.from_numpy(np.stack(columns, axis=-1)), persistent=False)
        self.table: Tensor
        self.spacing, self.length, self.lookahead = course.step, course.length, lookahead
        self.x, self.y, self.psi = state.index("x"), state.index("y"), state.index("psi")
        self.u, self.v = state.index("u"), state.index("v")
        self.least = _LEAST
        self.n_state = 1
        self.may_finish = True

    def at(self, place: Tensor) -> Tensor:
        """North, east, direction, heading, rudder, and the curvatures of direction and heading [B, 7] at places [B] in m."""
        along = (place / self.spacing).clamp(0.0, float(self.table.shape[0]) - 1.001)
        before = along.floor()
        share = (along - before).unsqueeze(-1)
        number = before.long()
        return (1.0 - share) * self.table[number].to(place.dtype) + share * self.table[number + 1].to(place.dtype)

    def error(self, x: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Distance ahead [B] of a place along the course, and cross-track error [B], in m."""
        known = self.at(place)
        north, east = x[:, self.x] - known[:, 0], x[:, self.y] - known[:, 1]
        c, s = torch.cos(known[:, 2]), torch.sin(known[:, 2])
        return c * north + s * east, c * east - s * north

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        """Reference [B, 3] and memory."""
        place = s[:, 0]
        ahead, aside = self.error(x, place)
        closeness = (1.0 - self.at(place)[:, 5] * aside).clamp(min=self.least)
        place = place + (ahead / closeness).clamp(0.0, self.lookahead)
        known = self.at(place)
        _, aside = self.error(x, place)
        speed = torch.sqrt(x[:, self.u].square() + x[:, self.v].square())
        closeness = (1.0 - known[:, 5] * aside).clamp(min=self.least)
        back = torch.atan(aside / self.lookahead)
        drift = known[:, 2] - known[:, 3]
        away = torch.remainder(x[:, self.psi] + drift - known[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        progress = speed * torch.cos(away).clamp(min=0.0) / closeness
        returning = speed * torch.sin(away) * self.lookahead / (self.lookahead**2 + aside.square())
        reference = torch.stack((known[:, 3] - back, known[:, 6] * progress - returning, known[:, 4]), dim=-1)
        return reference, place.unsqueeze(-1)

    def finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Rows behind the end of the course."""
        return s[:, 0] >= self.length
