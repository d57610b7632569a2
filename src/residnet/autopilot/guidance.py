"""Guidance laws that compute a desired heading from way-points or a planned course.

The guidance of a ferry crossing feeds a reference filter (Jervan 2020, section 2.2.2).
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

from residnet.autopilot.base import Policy, Reference
from residnet.autopilot.courses.course_plan import Course
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.motion import (
    FeedForwardForce,
    PoseDerivatives,
    filter_derivatives,
    required_force,
    stack_reference,
)
from residnet.autopilot.motion_config import ActuatorLag, ReferenceFilterConfig
from residnet.core.columns import dynamic_states, heading, motion_accelerations, pose, position
from residnet.core.config import Config, Metres, MetresPerSecond, RadiansPerSecond, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle

_ANGLES = 181
"""Number of course changes in the table, one per degree."""
_SAMPLES = 100
"""Number of points of the track of a turn."""
_DISTANCES = 400
"""Number of candidate wheel-over distances for each turn."""


@final
class WheelOver(nn.Module):
    """Wheel-over distance before a way-point as a function of the course change.

    The turn of a vessel T r_dot + r = K delta is full rudder followed by full counter-rudder until
    the yaw rate is zero on the next leg. The wheel-over distance is the distance from the start of
    this turn to the corner of both legs. For sharp corners the track would not enter the circle of
    acceptance; the distance is then the largest one whose track enters it.

    Args:
        nomoto: K, T and speed of the vessel.
        limit: rudder limit in rad.
        acceptance: radius of the circle of acceptance in m.
        share: fraction of that radius that the track must enter.
        rate: rudder rate in rad/s; None for a rudder without a rate limit. The distance includes
            half of the way travelled while the rudder moves.
    """

    def __init__(
        self,
        nomoto: NomotoModel,
        limit: float,
        acceptance: float,
        *,
        share: float = 0.6,
        rate: float | None = None,
    ) -> None:
        super().__init__()
        angles, corner_distances, tracks = _switching_turns(nomoto, limit)
        max_miss = share * acceptance
        radius = nomoto.speed / (nomoto.gain * limit)
        # upper bound: an arc without lag that passes the corner at `max_miss`, plus the distance
        # travelled during the lag
        max_distance = math.sqrt(max_miss * (2.0 * radius + max_miss)) + nomoto.speed * nomoto.time
        distance = np.linspace(0.0, max_distance, _DISTANCES)
        # the root of the smallest square: roots of all squares take four times as long
        miss_distance = np.sqrt(
            [
                (np.square(distance[:, None] - track[:, 0]) + np.square(track[:, 1])).min(axis=1)
                for track in tracks
            ]
        )
        best_distance = np.where(
            (distance <= corner_distances[:, None]) & (miss_distance <= max_miss), distance, 0.0
        ).max(axis=1)
        course_changes = np.linspace(0.0, math.pi, _ANGLES)
        # the rudder needs limit / rate from amidships, on average at half of its angle
        rudder_distance = 0.0 if rate is None else 0.5 * nomoto.speed * limit / rate
        self.register_buffer(
            "table",
            torch.from_numpy(np.interp(course_changes, angles, best_distance) + rudder_distance),
            persistent=False,
        )
        self.table: Tensor

    def forward(self, change: Tensor) -> Tensor:
        """Return wheel-over distances [B] in m for course changes [B] in rad, within +-pi."""
        table = self.table.to(change.dtype)
        table_position = change.abs() * (float(table.shape[0] - 1) / math.pi)
        lower_index = table_position.floor().clamp(max=float(table.shape[0] - 2))
        row = lower_index.long()
        fraction = table_position - lower_index
        return (1.0 - fraction) * table[row] + fraction * table[row + 1]


def _switching_turns(
    nomoto: NomotoModel, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate turns of Nomoto's model with full rudder and counter-rudder.

    Returns:
        Heading changes [N] from 0 to more than pi in rad, distances [N] in m from the start to the
        intersection of initial and final track, and tracks [N, M, 2] (ahead and abeam) in m.
    """
    max_yaw_rate = nomoto.gain * limit
    time_constant = nomoto.time
    hold_times = np.concatenate(
        (
            [0.0],
            np.geomspace(
                1e-3 * time_constant, math.pi / max_yaw_rate + 2.0 * time_constant, 4 * _ANGLES
            ),
        )
    )[:, None]
    yaw_rate_at_reversal = max_yaw_rate * (1.0 - np.exp(-hold_times / time_constant))
    share = np.linspace(0.0, 1.0, _SAMPLES)[None, :]
    # closed-form solution: full rudder for the hold time, then counter-rudder for
    # T log(1 + r / r_max), after which the yaw rate is zero
    hold_phase = hold_times * share
    reversal_phase = time_constant * np.log1p(yaw_rate_at_reversal / max_yaw_rate) * share[:, 1:]
    heading_at_reversal = max_yaw_rate * hold_times - time_constant * yaw_rate_at_reversal
    rate = (yaw_rate_at_reversal + max_yaw_rate) * np.exp(
        -reversal_phase / time_constant
    ) - max_yaw_rate
    heading = np.concatenate(
        (
            max_yaw_rate
            * (hold_phase - time_constant * (1.0 - np.exp(-hold_phase / time_constant))),
            heading_at_reversal
            + time_constant * (yaw_rate_at_reversal - rate)
            - max_yaw_rate * reversal_phase,
        ),
        axis=1,
    )
    phase_times = np.concatenate((hold_phase, hold_times + reversal_phase), axis=1)
    step = nomoto.speed * np.diff(phase_times, axis=1)
    mean_heading = 0.5 * (heading[:, 1:] + heading[:, :-1])
    increments = np.stack((step * np.cos(mean_heading), step * np.sin(mean_heading)), axis=-1)
    track = np.concatenate((np.zeros((len(increments), 1, 2)), increments.cumsum(axis=1)), axis=1)
    final_heading = heading[:, -1]
    sine = np.sin(final_heading)
    # intersection of initial and final track; there is none for parallel tracks
    corner_distance = np.where(
        sine > 1e-9,
        track[:, -1, 0] - track[:, -1, 1] * np.cos(final_heading) / np.maximum(sine, 1e-9),
        math.inf,
    )
    return final_heading, np.where(final_heading == 0.0, 0.0, corner_distance), track


_MAX_LEG_OFFSET = 0.4
"""Largest cross-track error at and after the wheel-over, as a fraction of the radius of
acceptance; with a larger error the leg changes in the circle.
"""


@final
class WaypointGuidance(Reference):
    """Desired heading [B, 1] on straight legs between way-points by line-of-sight guidance.

    The desired heading is the direction of the leg plus the line-of-sight angle. The leg changes
    when the vessel enters the circle of acceptance of the way-point or has passed it. With a
    wheel-over distance the leg changes earlier, provided that the present and the predicted
    cross-track error are small compared with the radius of acceptance. The vessel has arrived when
    it has passed the last way-point.

    Memory [B, 3 + n]: number of the active way-point, start position of the first leg, and the n
    entries of the line-of-sight law.

    Args:
        points: way-points (north, east) in m, in order.
        acceptance: radius of the circle of acceptance in m.
        line_of_sight: line-of-sight law.
        state: names of the state.
        wheel_over: wheel-over distance; None to change legs in the circle of acceptance.
    """

    def __init__(
        self,
        points: Sequence[tuple[float, float]],
        acceptance: float,
        line_of_sight: LineOfSight,
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
        self.acceptance = acceptance
        self.line_of_sight = line_of_sight
        self.wheel_over = wheel_over
        self.max_leg_offset = _MAX_LEG_OFFSET * acceptance
        self.x = state.index("x")
        self.y = state.index("y")
        self.psi = state.index("psi")
        self.n_state = 3 + line_of_sight.n_state
        self.may_finish = True

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory; the first leg starts at the position of the vessel."""
        law_memory = torch.zeros(x.shape[0], self.n_state - 3, dtype=x.dtype, device=x.device)
        return torch.cat(
            (
                torch.zeros_like(x[:, :1]),
                x[:, self.x : self.x + 1],
                x[:, self.y : self.y + 1],
                law_memory,
            ),
            dim=-1,
        )

    def leg_geometry(
        self, x: Tensor, leg_number: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute direction, remaining distance and cross-track error with respect to a leg.

        Returns:
            Direction [B] in rad, remaining along-track distance [B] in m, and cross-track error [B]
            in m, positive to starboard of the leg.
        """
        points = self.points.to(x.dtype)
        target = points[leg_number.clamp(max=len(points) - 1)]
        leg_start = torch.where(
            (leg_number == 0).unsqueeze(-1),
            s[:, 1:3],
            points[(leg_number - 1).clamp(0, len(points) - 1)],
        )
        leg_vector = target - leg_start
        direction = torch.atan2(leg_vector[:, 1], leg_vector[:, 0])
        north = target[:, 0] - x[:, self.x]
        east = target[:, 1] - x[:, self.y]
        remaining_distance = north * torch.cos(direction) + east * torch.sin(direction)
        return (
            direction,
            remaining_distance,
            north * torch.sin(direction) - east * torch.cos(direction),
        )

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        leg_number = s[:, 0].long()
        direction, remaining_distance, error = self.leg_geometry(x, leg_number, s)
        has_reached = (remaining_distance <= 0) | (
            remaining_distance * remaining_distance + error * error <= self.acceptance**2
        )
        if self.wheel_over is not None:
            change = self.leg_geometry(x, leg_number + 1, s)[0] - direction
            switch_distance = self.wheel_over(wrap_angle(change))
            # predicted cross-track error at the end of the wheel-over distance with the present
            # heading
            offset_at_corner = (
                error.abs() + switch_distance * torch.sin(x[:, self.psi] - direction).abs()
            )
            has_reached = has_reached | (
                (remaining_distance <= switch_distance)
                & (offset_at_corner <= self.max_leg_offset)
                & (leg_number < len(self.points) - 1)
            )
        leg_number = (leg_number + has_reached.long()).clamp(max=self.points.shape[0])
        direction, _, error = self.leg_geometry(x, leg_number, s)
        angle, memory = self.line_of_sight(error, direction, s[:, 3:])
        heading = wrap_angle(direction + angle).unsqueeze(-1)
        return heading, torch.cat((leg_number.to(x.dtype).unsqueeze(-1), s[:, 1:3], memory), dim=-1)

    def is_finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return which rows have passed their last way-point."""
        return s[:, 0] >= self.points.shape[0]


_MAX_DRIFT_TANGENT = 1.0
"""Tangent of the largest crab angle."""


@final
class DriftEstimate(nn.Module):
    """Integral action of line-of-sight guidance: an estimate of the drift in a steady current.

    heading_d = direction - atan(e / distance + D), with
    dD/dt = gain e / (distance^2 + (e + distance D)^2). D is sigma e_int / distance in the notation
    of the source. In the steady state e = 0, and D is the tangent of the crab angle asin(V_c / U)
    for a cross-current V_c and a speed U.

    The direction of a current is constant over ground while the path turns. D is therefore stored
    as a north-east vector. Only its component across the path enters the heading and is updated, so
    that the estimate carries over from one leg to the next.

    Source: E. Borhaug, A. Pavlov and K. Y. Pettersen, Integral LOS control for path following of
    underactuated marine surface vessels in the presence of constant ocean currents, CDC 2008;
    T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section 12.3.

    Memory s [B, 2]: the vector D, with a norm of at most one.

    Args:
        distance: look-ahead distance in m.
        gain: sigma in m/s. For a quarter of the speed both poles of the error are at
            U / (2 distance).
        dt: time step in s.

    Raises:
        ConfigError: if an argument is not positive.
    """

    def __init__(self, distance: float, gain: float, dt: float) -> None:
        super().__init__()
        if distance <= 0 or gain <= 0 or dt <= 0:
            raise ConfigError(
                "integral line of sight: distance, gain and step must be above zero, given"
                f" {distance:g} m, {gain:g} m/s, {dt:g} s"
            )
        self.distance = distance
        self.gain = gain
        self.dt = dt
        self.max_drift = _MAX_DRIFT_TANGENT

    def cross_component(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the component [B] of D to starboard of a direction [B] in rad."""
        return torch.cos(direction) * s[:, 1] - torch.sin(direction) * s[:, 0]

    def along_component(self, direction: Tensor, s: Tensor) -> Tensor:
        """Return the component [B] of D along a direction [B] in rad."""
        return torch.cos(direction) * s[:, 0] + torch.sin(direction) * s[:, 1]

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> Tensor:
        """Update the drift estimate by one time step.

        Args:
            error: cross-track error [B] in m.
            direction: direction of the path [B] in rad.
            s: memory [B, 2].
        """
        steering_error = error + self.distance * self.cross_component(direction, s)
        # the denominator reduces the integration at large errors (anti-windup), as in the source
        drift_increment = self.dt * self.gain * error / (self.distance**2 + steering_error.square())
        s = s + drift_increment.unsqueeze(-1) * torch.stack(
            (-torch.sin(direction), torch.cos(direction)), dim=-1
        )
        # the limit excludes currents that the vessel cannot counteract
        return s / (s.square().sum(dim=-1, keepdim=True).sqrt() / self.max_drift).clamp(min=1.0)


class LineOfSight(nn.Module, ABC):
    """A line-of-sight law: the angle between the leg and the desired course."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 0

    @abstractmethod
    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angle [B] in rad that is added to the leg's direction, and the memory.

        Args:
            error: cross-track error [B] in m, positive to starboard of the leg.
            direction: direction of the leg [B] in rad.
            s: memory [B, n_state], zeros at the start.
        """


@final
class LookAheadLineOfSight(LineOfSight):
    """Look-ahead line of sight with the angle -atan(error / distance).

    With a drift estimate D across the leg the angle is -atan(error / distance + D), which contains
    the crab angle for a steady current. Source: T. I. Fossen, Handbook of Marine Craft
    Hydrodynamics and Motion Control, section 12.3. The memory is the memory of the drift estimate.

    Args:
        distance: look-ahead distance along the leg in m.
        drift: drift estimate; None for no integral action.
    """

    def __init__(self, distance: float, drift: DriftEstimate | None = None) -> None:
        super().__init__()
        self.distance = distance
        self.drift = drift
        self.n_state = 0 if drift is None else 2

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        slope = error / self.distance
        if self.drift is not None:
            slope = slope + self.drift.cross_component(direction, s)
            s = self.drift(error, direction, s)
        return -torch.atan(slope), s


@final
class EnclosureLineOfSight(LineOfSight):
    """Enclosure-based line of sight with the angle -asin(error / radius).

    The target is the forward intersection of the leg with a circle about the vessel (Fossen,
    section 12.3). If the circle does not intersect the leg, the vessel steers at a right angle
    towards the leg.

    Args:
        radius: radius of the circle in m.
    """

    def __init__(self, radius: float) -> None:
        super().__init__()
        self.radius = radius

    def forward(self, error: Tensor, direction: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return -torch.asin((error / self.radius).clamp(-1.0, 1.0)), s


class LookAheadConfig(Config):
    """Look-ahead-based line of sight.

    Attributes:
        distance: look-ahead distance along the leg in m.
    """

    kind: Literal["lookahead"] = "lookahead"
    distance: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Build the law for a time step of dt seconds."""
        return LookAheadLineOfSight(self.distance)


class EnclosureConfig(Config):
    """Enclosure-based line of sight.

    Attributes:
        radius: radius in m of the circle about the vessel.
    """

    kind: Literal["enclosure"] = "enclosure"
    radius: Metres = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Build the law for a time step of dt seconds."""
        return EnclosureLineOfSight(self.radius)


class IntegralLookAheadConfig(Config):
    """Look-ahead-based line of sight with integral action against a steady current.

    Attributes:
        distance: look-ahead distance along the leg in m.
        gain: integral gain sigma in m/s, smaller than speed minus current; a quarter of the speed
            gives a response without overshoot.
    """

    kind: Literal["integral"] = "integral"
    distance: Metres = Field(gt=0)
    gain: MetresPerSecond = Field(gt=0)

    def build(self, dt: float) -> LineOfSight:
        """Build the law for a time step of dt seconds."""
        return LookAheadLineOfSight(self.distance, DriftEstimate(self.distance, self.gain, dt))


AnyLineOfSight = Annotated[
    LookAheadConfig | EnclosureConfig | IntegralLookAheadConfig, Field(discriminator="kind")
]


_MIN_CURVATURE_FACTOR = 0.3
"""Lower limit of 1 - curvature x cross-track error; the nearest point on the path is not well
defined near the centre of curvature.
"""


@final
class CourseGuidance(Reference):
    """Path-following reference [B, 3] on a planned course: heading, yaw rate and rudder angle.

    Line of sight on a curved path: heading_d = heading of the course - atan(e / lookahead), with
    the cross-track error e, positive to starboard. Yaw rate and rudder angle of the planned course
    at the present speed are feed-forward terms. The path variable is advanced by one Newton
    iteration of the nearest point per step and never decreases.

    With a drift estimate D, heading_d = heading of the course - atan(e / lookahead + D across), and
    the feed-forward yaw rate uses the speed over ground from D.

    Memory [B, 1 or 3]: path variable in m, and D.

    Args:
        course: planned course.
        lookahead: look-ahead distance in m.
        state: names of the state.
        drift: integral action against a steady current, with the same look-ahead distance; None for
            none.
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
        self.table_step = course.step
        self.length = course.length
        self.lookahead = lookahead
        self.max_arc_length = course.step * (len(course.track) - 1)
        self.x = state.index("x")
        self.y = state.index("y")
        self.psi = state.index("psi")
        self.u, self.v = state.index("u"), state.index("v")
        self.min_curvature_factor = _MIN_CURVATURE_FACTOR
        self.drift = drift
        self.n_state = 1 if drift is None else 3
        self.may_finish = True

    def plan_at(self, arc_length: Tensor) -> Tensor:
        """Interpolate the plan [B, 7] at path variables [B] in m.

        The columns are north, east, direction, heading, rudder angle, and the derivatives of
        direction and heading by the path variable.
        """
        table_position = (arc_length / self.table_step).clamp(
            0.0, float(self.table.shape[0]) - 1.001
        )
        lower_index = table_position.floor()
        fraction = (table_position - lower_index).unsqueeze(-1)
        row = lower_index.long()
        return (1.0 - fraction) * self.table[row].to(arc_length.dtype) + fraction * self.table[
            row + 1
        ].to(arc_length.dtype)

    def track_error(self, x: Tensor, arc_length: Tensor) -> tuple[Tensor, Tensor]:
        """Return along-track and cross-track error [B] in m from a point of the course."""
        planned = self.plan_at(arc_length)
        north = x[:, self.x] - planned[:, 0]
        east = x[:, self.y] - planned[:, 1]
        c, s = torch.cos(planned[:, 2]), torch.sin(planned[:, 2])
        return c * north + s * east, c * east - s * north

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        arc_length = s[:, 0]
        along_track_error, cross_track_error = self.track_error(x, arc_length)
        curvature_factor = (1.0 - self.plan_at(arc_length)[:, 5] * cross_track_error).clamp(
            min=self.min_curvature_factor
        )
        arc_length = (
            arc_length + (along_track_error / curvature_factor).clamp(0.0, self.lookahead)
        ).clamp(max=self.max_arc_length)
        planned = self.plan_at(arc_length)
        _, cross_track_error = self.track_error(x, arc_length)
        direction = planned[:, 2]
        heading = planned[:, 3]
        slope = cross_track_error / self.lookahead
        memory = s[:, 1:]
        cross_drift = torch.zeros_like(cross_track_error)
        along_drift = torch.zeros_like(cross_track_error)
        if self.drift is not None:
            cross_drift = self.drift.cross_component(direction, memory)
            along_drift = self.drift.along_component(direction, memory)
            memory = self.drift(cross_track_error, direction, memory)
        slope = slope + cross_drift
        speed = torch.sqrt(x[:, self.u].square() + x[:, self.v].square())
        drift_speed = speed / torch.sqrt(1.0 + cross_drift.square())
        heading_error = wrap_angle(x[:, self.psi] - heading)
        curvature_factor = (1.0 - planned[:, 5] * cross_track_error).clamp(
            min=self.min_curvature_factor
        )
        progress = (speed * torch.cos(heading_error) + drift_speed * along_drift).clamp(
            min=0.0
        ) / curvature_factor
        slope_rate = (
            speed * torch.sin(heading_error) + drift_speed * cross_drift
        ) / self.lookahead - along_drift * planned[:, 5] * progress
        yaw_rate = planned[:, 6] * progress - slope_rate / (1.0 + slope.square())
        reference = torch.stack((heading - torch.atan(slope), yaw_rate, planned[:, 4]), dim=-1)
        return reference, torch.cat((arc_length.unsqueeze(-1), memory), dim=-1)

    def is_finished(self, x: Tensor, k: int, s: Tensor) -> Tensor:
        """Return which rows have passed the end of the course."""
        return s[:, 0] >= self.length


@final
class TrackKeeping(Policy):
    """Trajectory tracking with a heading controller: delta = delta_d + law(psi - psi_d, r - r_d).

    Nomoto's model T r_dot + r = K delta is linear: deviations from a feasible trajectory obey the
    same equation. A heading controller applied to the deviations therefore tracks turns without
    lag. A law with an observer receives the rudder angle minus delta_d.

    The reference [B, 3] is defined by `CourseGuidance`. Memory [B, 1 + n_state of the law]: rudder
    angle in rad, then the memory of the law.

    Args:
        law: heading controller.
        state: names of the state.
        limit: rudder limit in rad.
        dt: time step in s.
        rate: rudder rate in rad/s; None for a rudder without a rate limit.
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
        self.max_rudder_step = 2.0 * limit if rate is None else min(rate * dt, 2.0 * limit)
        self.n_state = 1 + law.n_state
        self.psi = state.index("psi")
        self.r = state.index("r")

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory: rudder amidships, then the memory of the law."""
        return torch.cat((torch.zeros_like(x[:, :1]), self.law.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: reference [B, 3], see `CourseGuidance`.
            s: memory [B, 1 + n_state of the law].
        """
        planned_rudder = reference[:, 2:3]
        relative_state = x.clone()
        relative_state[:, self.psi] = x[:, self.psi] - reference[:, 0]
        relative_state[:, self.r] = x[:, self.r] - reference[:, 1]
        correction, memory = self.law(relative_state, torch.zeros_like(planned_rudder), s[:, 1:])
        command = (planned_rudder + correction).clamp(-self.limit, self.limit)
        rudder = s[:, 0:1] + (command - s[:, 0:1]).clamp(
            -self.max_rudder_step, self.max_rudder_step
        )
        memory = self.law.replace_rudder_in_memory(memory, rudder - planned_rudder)
        return command, torch.cat((rudder, memory), dim=-1)


class CrossingConfig(Config):
    """A ferry crossing on straight legs that ends with a stop at the last point.

    Attributes:
        points: start and end of each leg, (north, east) in m.
        circle: radius of the line-of-sight circle about the ferry in m (eq. (2.16) to (2.18)).
        frequency: natural frequency Omega of the reference filter, all axes.
        damping: damping ratio Delta of the reference filter.
        duration: duration of the crossing and the stop in s.
    """

    kind: Literal["crossing"] = "crossing"
    points: tuple[tuple[Metres, Metres], ...] = Field(min_length=2)
    circle: Metres = Field(default=6.0, gt=0)
    frequency: RadiansPerSecond = Field(default=0.5, gt=0)
    damping: float = Field(default=0.7, gt=0)
    duration: Seconds = Field(gt=0)

    @model_validator(mode="after")
    def _check_legs(self) -> CrossingConfig:
        if any(a == b for a, b in zip(self.points, self.points[1:], strict=False)):
            raise ValueError("points: two in a row are the same; a leg needs a direction")
        return self

    def filter_config(self) -> ReferenceFilterConfig:
        """Return the config of the filter that makes smooth references from the waypoints."""
        final_waypoint = (*self.points[-1], 0.0)
        frequencies = (self.frequency,) * 3
        return ReferenceFilterConfig(
            waypoints=(final_waypoint,), frequency=frequencies, damping=(self.damping,) * 3
        )


@final
class Crossing(Reference):
    """Reference [B, 18] for `LagCompensatedPID` on straight legs, from a filtered target point.

    The reference holds pose, velocities and accelerations (9), and the thruster force that they
    require according to a model, with its first and second derivative (9).

    Memory [B, 13]: nine entries of the filter, number of the leg, last target point and heading.

    Args:
        config: legs, line-of-sight circle and reference filter.
        dt: time step in s.
        models: feed-forward model and actuator lag of each vessel of the batch; None for no lag.
    """

    def __init__(
        self,
        config: CrossingConfig,
        dt: float,
        models: Sequence[tuple[FeedForwardForce, ActuatorLag | None]],
    ) -> None:
        super().__init__()
        self.n_state = 13
        self.config = config
        self.dt = dt
        self.models = list(models)
        self.filter_config = config.filter_config()
        # transition matrix of (error, rate, acceleration) over a step, by axis
        self.step_matrix = self.filter_config.build(dt).advance[0]
        self.points = torch.tensor(config.points, dtype=torch.float64)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the initial memory: zero velocity, first leg, NaN for the target point."""
        zero_column = torch.zeros_like(x[:, :1])
        return torch.cat(
            (pose(x), zero_column.expand(-1, 7), torch.full_like(pose(x), torch.nan)), dim=-1
        )

    def steering_target(
        self, x: Tensor, desired_heading: Tensor, leg: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return target point and heading [B, 3], and the active leg [B].

        Args:
            x: state [B, nx].
            desired_heading: last desired heading [B] in rad.
            leg: number of the active leg [B].
        """
        last_leg = len(self.points) - 2
        current_position = position(x)
        is_near_end = (self.points[leg + 1] - current_position).norm(dim=-1) < self.config.circle
        has_arrived = is_near_end & (leg == last_leg)
        leg = torch.where(is_near_end & (leg < last_leg), leg + 1, leg)
        start = self.points[leg]
        end = self.points[leg + 1]
        leg_direction = (end - start) / (end - start).norm(dim=-1, keepdim=True)
        offset = current_position - start
        distance_along_leg = (offset * leg_direction).sum(-1)
        cross_track_error = offset[:, 0] * leg_direction[:, 1] - offset[:, 1] * leg_direction[:, 0]
        forward_reach = (self.config.circle**2 - cross_track_error.square()).clamp(min=0.0).sqrt()
        target_point = torch.where(
            has_arrived[:, None],
            end,
            start + (distance_along_leg + forward_reach)[:, None] * leg_direction,
        )
        aim_vector = torch.where(
            has_arrived[:, None], leg_direction, target_point - current_position
        )
        direction = torch.atan2(aim_vector[:, 1], aim_vector[:, 0])
        return torch.cat(
            (target_point, (desired_heading + wrap_angle(direction - desired_heading))[:, None]),
            dim=-1,
        ), leg

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        previous_leg = s[:, 9].long()
        target, leg = self.steering_target(x, heading(s), previous_leg)
        # where the point jumps (first step, change of leg, the stop) it has no rate
        rate = (target - s[:, 10:]) / self.dt
        is_continuous = (position(rate).norm(dim=-1) < self.config.circle) & (leg == previous_leg)
        rate = torch.where(is_continuous[:, None], rate, torch.zeros_like(rate))
        desired_motion = filter_derivatives(self.filter_config, s[:, :9], target, rate)
        forces = [
            required_force(
                model, PoseDerivatives(*(part[i : i + 1] for part in desired_motion)), lag, self.dt
            )
            for i, (model, lag) in enumerate(self.models)
        ]
        error = torch.stack((pose(s) - target, dynamic_states(s), motion_accelerations(s)), dim=-1)
        next_error = torch.einsum("aij,baj->bia", self.step_matrix, error)
        memory = torch.cat(
            (
                next_error[:, 0] + target,
                next_error[:, 1],
                next_error[:, 2],
                leg[:, None].to(s.dtype),
                target,
            ),
            dim=-1,
        )
        return stack_reference(desired_motion, torch.cat(forces)), memory
