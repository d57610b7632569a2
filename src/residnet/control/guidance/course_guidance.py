"""Guidance along a planned course: place, heading, yaw rate and rudder that the plan has there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor

from residnet.control.base import Policy, Reference
from residnet.control.courses.course_plan import Course
from residnet.control.guidance.line_of_sight import DriftEstimate
from residnet.core.errors import ConfigError

_LEAST = 0.3
"""Of 1 - curvature x cross-track error: beyond, the centre of the turn is near and the nearest
point no longer known.
"""


@final
class CourseGuidance(Reference):
    """Reference [B, 3] for a planned course: heading, yaw rate and rudder in rad, rad/s, rad.

    Line of sight on a curved path: heading_d = heading of the course - atan(e / look-ahead), e the
    cross-track error, positive to starboard, where the vessel makes way along the course's own
    tangent. Yaw rate and rudder are those of the course at the present speed, so that turns begin
    before the arc does. The place along the course moves by one Newton step of the nearest point
    each time, never back.

    With an estimate of the drift D, heading_d = heading of the course - atan(e / look-ahead + D
    across), and the yaw rate takes the speed over ground from D; D turns with respect to
    the course in its bends. Memory [B, 1 or 3]: place along the course in m, and D.

    Args:
        course: to follow.
        lookahead: distance in m.
        state: names of the vessel's state.
        drift: integral action against a steady current, at the same look-ahead; None for none.
    """

    def __init__(
        self,
        course: Course,
        lookahead: float,
        state: Sequence[str],
        drift: DriftEstimate | None = None,
    ) -> None:
        super().__init__()
        if lookahead <= 0:
            raise ConfigError(f"look-ahead must be above zero, given {lookahead:g} m")
        curvatures = (
            np.gradient(course.direction, course.step),
            np.gradient(course.heading, course.step),
        )
        columns = (*course.track.T, course.direction, course.heading, course.rudder, *curvatures)
        self.register_buffer(
            "table", torch.from_numpy(np.stack(columns, axis=-1)), persistent=False
        )
        self.table: Tensor
        self.spacing, self.length, self.lookahead = course.step, course.length, lookahead
        self.farthest = course.step * (len(course.track) - 1)
        self.x, self.y, self.psi = state.index("x"), state.index("y"), state.index("psi")
        self.u, self.v = state.index("u"), state.index("v")
        self.least = _LEAST
        self.drift = drift
        self.n_state = 1 if drift is None else 3
        self.may_finish = True

    def at(self, place: Tensor) -> Tensor:
        """Return the plan [B, 7] at places [B] in m along the course.

        The columns are north, east, direction, heading, rudder, and the curvatures of direction and
        heading.
        """
        along = (place / self.spacing).clamp(0.0, float(self.table.shape[0]) - 1.001)
        before = along.floor()
        share = (along - before).unsqueeze(-1)
        number = before.long()
        return (1.0 - share) * self.table[number].to(place.dtype) + share * self.table[
            number + 1
        ].to(place.dtype)

    def error(self, x: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance ahead [B] of a place on the course and its cross-track error in m."""
        planned = self.at(place)
        north, east = x[:, self.x] - planned[:, 0], x[:, self.y] - planned[:, 1]
        c, s = torch.cos(planned[:, 2]), torch.sin(planned[:, 2])
        return c * north + s * east, c * east - s * north

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        place = s[:, 0]
        ahead, aside = self.error(x, place)
        closeness = (1.0 - self.at(place)[:, 5] * aside).clamp(min=self.least)
        place = (place + (ahead / closeness).clamp(0.0, self.lookahead)).clamp(max=self.farthest)
        planned = self.at(place)
        _, aside = self.error(x, place)
        direction, heading = planned[:, 2], planned[:, 3]
        slope, memory = aside / self.lookahead, s[:, 1:]
        across, along = torch.zeros_like(aside), torch.zeros_like(aside)
        if self.drift is not None:
            across, along = (
                self.drift.across(direction, memory),
                self.drift.along(direction, memory),
            )
            memory = self.drift(aside, direction, memory)
        slope = slope + across
        speed = torch.sqrt(x[:, self.u].square() + x[:, self.v].square())
        stream = speed / torch.sqrt(1.0 + across.square())
        heading_error = torch.remainder(x[:, self.psi] - heading + math.pi, 2.0 * math.pi) - math.pi
        closeness = (1.0 - planned[:, 5] * aside).clamp(min=self.least)
        progress = (speed * torch.cos(heading_error) + stream * along).clamp(min=0.0) / closeness
        sliding = (
            speed * torch.sin(heading_error) + stream * across
        ) / self.lookahead - along * planned[:, 5] * progress
        rate = planned[:, 6] * progress - sliding / (1.0 + slope.square())
        reference = torch.stack((heading - torch.atan(slope), rate, planned[:, 4]), dim=-1)
        return reference, torch.cat((place.unsqueeze(-1), memory), dim=-1)

    def finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return the rows behind the end of the course."""
        return s[:, 0] >= self.length


@final
class TrackKeeping(Policy):
    """The law delta = delta_d + law(psi - psi_d, r - r_d), saturated.

    Any heading controller follows turns with it as it holds a course.

    T r_dot + r = K delta has the same form for the differences from a motion that fulfils it, so
    that a law for steps of the heading corrects them and lags behind nothing. A law with an
    observer gets the rudder angle less delta_d.

    Reference [B, 3] as of `CourseGuidance`. Memory [B, 1 + n_state of the law]: the rudder angle
    [rad] as the steering gear follows, then the law's.

    Args:
        law: heading controller.
        state: names of the vessel's state.
        limit: of the rudder in rad.
        dt: step in s.
        rate: of the rudder in rad/s; None where it stands at its command at once.
    """

    def __init__(
        self,
        law: Policy,
        state: Sequence[str],
        *,
        limit: float,
        dt: float,
        rate: float | None = None,
    ) -> None:
        super().__init__()
        self.law = law
        self.limit = limit
        self.travel = 2.0 * limit if rate is None else min(rate * dt, 2.0 * limit)
        self.n_state = 1 + law.n_state
        self.psi, self.r = state.index("psi"), state.index("r")

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the rudder amidships, then the law's memory."""
        return torch.cat((torch.zeros_like(x[:, :1]), self.law.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: reference [B, 3] as of `CourseGuidance`.
            s: memory [B, 1 + n_state of the law].
        """
        needed = reference[:, 2:3]
        relative = x.clone()
        relative[:, self.psi] = x[:, self.psi] - reference[:, 0]
        relative[:, self.r] = x[:, self.r] - reference[:, 1]
        correction, memory = self.law(relative, torch.zeros_like(needed), s[:, 1:])
        command = (needed + correction).clamp(-self.limit, self.limit)
        rudder = s[:, 0:1] + (command - s[:, 0:1]).clamp(-self.travel, self.travel)
        memory = self.law.told(memory, rudder - needed)
        return command, torch.cat((rudder, memory), dim=-1)
