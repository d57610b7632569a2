"""Guidance laws: from way-points or a planned course to a desired heading.

The crossing of a ferry feeds a reference filter: document 002 section 2.2.2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.control.base import Policy, Reference
from residnet.control.courses.course_plan import Course
from residnet.control.heading.turning import Turning
from residnet.control.motion import (
    Derivatives,
    Lag,
    ReferenceFilterConfig,
    derivatives,
    needed_force,
    reference_row,
)
from residnet.core.columns import accelerations, heading, pose, position, velocities
from residnet.core.config import Config, Metres, MetresPerSecond, RadiansPerSecond, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap
from residnet.physics.force_model import ForceModel

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
            before = self.wheel_over(wrap(change))
            aside = error.abs() + before * torch.sin(x[:, self.psi] - direction).abs()
            reached = reached | (
                (ahead <= before) & (aside <= self.on_leg) & (number < len(self.points) - 1)
            )
        number = (number + reached.long()).clamp(max=self.points.shape[0])
        direction, _, error = self.leg(x, number, s)
        angle, memory = self.sight(error, direction, s[:, 3:])
        heading = wrap(direction + angle).unsqueeze(-1)
        return heading, torch.cat((number.to(x.dtype).unsqueeze(-1), s[:, 1:3], memory), dim=-1)

    def finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return the rows behind their last way-point."""
        return s[:, 0] >= self.points.shape[0]


_MOST = 1.0
"""Tangent of the largest crab angle."""


@final
class DriftEstimate(nn.Module):
    """An estimate of how a steady current sets the vessel across its way.

    It is the integral of E. Borhaug, A. Pavlov and K. Y. Pettersen (Integral LOS control for path
    following of underactuated marine surface vessels in the presence of constant ocean currents,
    CDC 2008; T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section
    12.3).

    heading_d = direction - atan(e / distance + D), dD/dt = gain e / (distance^2 + (e + distance
    D)^2), their D being sigma e_int / distance. At rest e = 0 and D is the tangent of the crab
    angle asin(V_c / U) for a current V_c across the way of a vessel at speed U.

    A current keeps its direction over ground while the way bends. So D is kept as a vector, north
    and east, that only its part across the way steers by and that grows only there: what one leg
    has taught is known on the next.

    Memory s [B, 2]: the vector, at most one long.

    Args:
        distance: look-ahead in m.
        gain: sigma in m/s. With a quarter of the speed both poles of the error lie at U / (2
            distance).
        dt: step in s.

    Raises:
        ConfigError: where one of them is not above zero.
    """

    def __init__(self, distance: float, gain: float, dt: float) -> None:
        super().__init__()
        if distance <= 0 or gain <= 0 or dt <= 0:
            raise ConfigError(
                "integral line of sight: distance, gain and step must be above zero, given"
                f" {distance:g} m, {gain:g} m/s, {dt:g} s"
            )
        self.distance, self.gain, self.dt = distance, gain, dt
        self.most = _MOST

    def across(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] to starboard of a direction [B] in rad."""
        return torch.cos(direction) * s[:, 1] - torch.sin(direction) * s[:, 0]

    def along(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the part [B] along a direction [B] in rad."""
        return torch.cos(direction) * s[:, 0] + torch.sin(direction) * s[:, 1]

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> Tensor:
        """Return the memory after a step.

        Args:
            s: memory [B, 2].
            error: cross-track error [B] in m.
            direction: of the way [B] in rad.
        """
        aim = error + self.distance * self.across(direction, s)
        grown = self.dt * self.gain * error / (self.distance**2 + aim.square())
        s = s + grown.unsqueeze(-1) * torch.stack(
            (-torch.sin(direction), torch.cos(direction)), dim=-1
        )
        return s / (s.square().sum(dim=-1, keepdim=True).sqrt() / self.most).clamp(min=1.0)


class LineOfSight(nn.Module, ABC):
    """The angle between a leg and the course that is steered."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 0

    @abstractmethod
    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B] in rad that is added to the leg's direction, and the memory.

        Args:
            error: cross-track error [B] in m, positive to starboard of the leg.
            direction: of the leg [B] in rad.
            s: memory [B, n_state], zeros at the start.
        """


@final
class LookAhead(LineOfSight):
    """Steering for the point of the leg a distance ahead: -atan(error / distance).

    With an estimate of the drift D across the leg, -atan(error / distance + D), the crab angle that
    a steady current needs. Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion
    Control, section 12.3. Memory: of `DriftEstimate`, where there is one.

    Args:
        distance: along the leg in m.
        drift: None for none.
    """

    def __init__(self, distance: float, drift: DriftEstimate | None = None) -> None:
        super().__init__()
        self.distance, self.drift = distance, drift
        self.n_state = 0 if drift is None else 2

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        slope = error / self.distance
        if self.drift is not None:
            slope = slope + self.drift.across(direction, s)
            s = self.drift(error, direction, s)
        return -torch.atan(slope), s


@final
class Enclosure(LineOfSight):
    """Steering for the forward point where a circle about the vessel meets the leg.

    The angle is -asin(error / radius) (Fossen, section 12.3).

    Further from the leg than the radius there is none; the vessel then steers straight for the leg.

    Args:
        radius: of the circle in m.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return -torch.asin((error / self.radius).clamp(-1.0, 1.0)), s


class LookAheadConfig(Config):
    """Look-ahead-based line of sight.

    Attributes:
        distance: along the leg.
    """

    kind: Literal["lookahead"] = "lookahead"
    distance: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return LookAhead(self.distance)


class EnclosureConfig(Config):
    """Enclosure-based line of sight.

    Attributes:
        radius: of the circle about the vessel.
    """

    kind: Literal["enclosure"] = "enclosure"
    radius: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return Enclosure(self.radius)


class IntegralLookAheadConfig(Config):
    """Look-ahead-based line of sight with integral action against a steady current.

    Attributes:
        distance: along the leg.
        gain: sigma of the integral action, below speed less current; a quarter of the speed returns
            to a leg without overshoot.
    """

    kind: Literal["integral"] = "integral"
    distance: Metres = Field(gt=0)
    gain: MetresPerSecond = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Return the law, for steps of dt seconds."""
        return LookAhead(self.distance, DriftEstimate(self.distance, self.gain, dt))


AnyLineOfSight = Annotated[
    LookAheadConfig | EnclosureConfig | IntegralLookAheadConfig, Field(discriminator="kind")
]


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
        lookahead: distance in m.
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
        heading_error = wrap(x[:, self.psi] - heading)
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


class CrossingConfig(Config):
    """Legs from the first point to the last, where the ferry stops.

    Attributes:
        points: (north, east) in m, where the ferry starts and then where each leg ends.
        circle: radius around the ferry; it meets the leg at the point that is steered for
            (2.16)-(2.18).
        frequency: Omega of the filter, all axes.
        damping: Delta of the filter.
        duration: of the whole crossing with its stop.
    """

    kind: Literal["crossing"] = "crossing"
    points: tuple[tuple[Metres, Metres], ...] = Field(min_length=2)
    circle: Metres = Field(default=6.0, gt=0)
    frequency: RadiansPerSecond = Field(default=0.5, gt=0)
    damping: float = Field(default=0.7, gt=0)
    duration: Seconds = Field(gt=0)

    @model_validator(mode="after")
    def _legs(self) -> CrossingConfig:
        if any(a == b for a, b in zip(self.points, self.points[1:], strict=False)):
            raise ValueError("points: two in a row are the same; a leg needs a direction")
        return self

    def filter(self) -> ReferenceFilterConfig:
        """Return the filter behind the guidance."""
        last = (*self.points[-1], 0.0)
        three = (self.frequency,) * 3
        return ReferenceFilterConfig(
            waypoints=(last,), frequency=three, damping=(self.damping,) * 3
        )


@final
class Crossing(Reference):
    """Reference [B, 18] for `Assisted`: the filtered line-of-sight point and each model's force.

    Memory [B, 13]: the filter's nine, the number of the leg, the point and heading that were
    steered for last.
    """

    def __init__(
        self, config: CrossingConfig, dt: float, models: Sequence[tuple[ForceModel, Lag | None]]
    ) -> None:
        super().__init__()
        self.n_state = 13
        self.config, self.dt, self.models = config, dt, list(models)
        self.filter_config = config.filter()
        self.advance = self.filter_config.build(dt).advance[0]
        self.points = torch.tensor(config.points, dtype=torch.float64)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at rest where the ferry is, on the first leg; NaN for no point yet."""
        rest = torch.zeros_like(x[:, :1])
        return torch.cat((pose(x), rest.expand(-1, 7), torch.full_like(pose(x), torch.nan)), dim=-1)

    def target(self, x: Tensor, desired: Tensor, leg: Tensor) -> tuple[Tensor, Tensor]:
        """Return the point and heading [B, 3] to steer for, and the leg [B] after a change.

        `desired` [B] is the desired heading in rad, x [B, nx] the state.
        """
        last = len(self.points) - 2
        place = position(x)
        near = (self.points[leg + 1] - place).norm(dim=-1) < self.config.circle
        arrived = near & (leg == last)
        leg = torch.where(near & (leg < last), leg + 1, leg)
        start, end = self.points[leg], self.points[leg + 1]
        along = (end - start) / (end - start).norm(dim=-1, keepdim=True)
        offset = place - start
        travelled = (offset * along).sum(-1)
        across = offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]
        reach = (self.config.circle**2 - across.square()).clamp(min=0.0).sqrt()
        point = torch.where(arrived[:, None], end, start + (travelled + reach)[:, None] * along)
        aim = torch.where(arrived[:, None], along, point - place)
        direction = torch.atan2(aim[:, 1], aim[:, 0])
        return torch.cat((point, (desired + wrap(direction - desired))[:, None]), dim=-1), leg

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        old = s[:, 9].long()
        target, leg = self.target(x, heading(s), old)
        # where the point jumps (first step, change of leg, the stop) it has no rate
        rate = (target - s[:, 10:]) / self.dt
        steady = (position(rate).norm(dim=-1) < self.config.circle) & (leg == old)
        rate = torch.where(steady[:, None], rate, torch.zeros_like(rate))
        motion = derivatives(self.filter_config, s[:, :9], target, rate)
        forces = [
            needed_force(model, Derivatives(*(part[i : i + 1] for part in motion)), lag, self.dt)
            for i, (model, lag) in enumerate(self.models)
        ]
        error = torch.stack((pose(s) - target, velocities(s), accelerations(s)), dim=-1)
        after = torch.einsum("aij,baj->bia", self.advance, error)
        memory = torch.cat(
            (after[:, 0] + target, after[:, 1], after[:, 2], leg[:, None].to(s.dtype), target),
            dim=-1,
        )
        return reference_row(motion, torch.cat(forces)), memory
