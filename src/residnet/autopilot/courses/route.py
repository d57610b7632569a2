"""Routes of turns and straight lines past buoys: outline, geometry and derivatives."""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from residnet.autopilot.courses.turns import N_TURN_POINTS, Array, TurnTables

N_LEG_POINTS = 12
"""Number of points of a leg, without its start."""
_OVERSAMPLING = 8
"""Factor by which the final route has more points per turn than the route in the search."""


@dataclass(frozen=True)
class TurnSpec:
    """A turn of a route outline, whose hold time is not yet fitted.

    Attributes:
        turn_sign: +1 to starboard, -1 to port.
        angle: turn angle in rad, positive.
        table: number of the turn table.
        passed_buoys: numbers of the buoys that are passed during the turn.
    """

    turn_sign: int
    angle: float
    table: int
    passed_buoys: tuple[int, ...] = ()


@dataclass(frozen=True)
class RouteOutline:
    """Legs and turns of a route before the fit of their lengths and hold times.

    Attributes:
        heading: heading of the first leg in rad.
        legs: lengths of the n + 1 legs in m.
        turns: the n turns between the legs.
        passed_on_legs: for each leg, the numbers of the buoys that are passed on it.
    """

    heading: float
    legs: tuple[float, ...]
    turns: tuple[TurnSpec, ...]
    passed_on_legs: tuple[tuple[int, ...], ...]

    def simplify(self, min_leg: float, min_angle: float) -> RouteOutline:
        """Merge turns to the same side that a short leg separates, and remove small turns.

        Args:
            min_leg: length in m below which the leg between two turns is removed.
            min_angle: angle in rad below which a turn is removed.
        """
        sketch = self
        k = 0
        while k < len(sketch.turns):
            turn = sketch.turns[k]
            if turn.angle < min_angle:
                sketch = sketch._remove_turn(k)
                k = max(k - 1, 0)
                continue
            next_turn = sketch.turns[k + 1] if k + 1 < len(sketch.turns) else None
            if next_turn and next_turn.turn_sign == turn.turn_sign and sketch.legs[k + 1] < min_leg:
                sketch = sketch._merge_turns(k)
                continue
            k += 1
        return sketch

    def _remove_turn(self, k: int) -> RouteOutline:
        """Return the outline without turn k; the legs before and after it become one leg."""
        legs = (*self.legs[:k], self.legs[k] + self.legs[k + 1], *self.legs[k + 2 :])
        merged_passed = (
            *self.passed_on_legs[k],
            *self.turns[k].passed_buoys,
            *self.passed_on_legs[k + 1],
        )
        passed_on_legs = (*self.passed_on_legs[:k], merged_passed, *self.passed_on_legs[k + 2 :])
        return RouteOutline(
            self.heading, legs, (*self.turns[:k], *self.turns[k + 1 :]), passed_on_legs
        )

    def _merge_turns(self, k: int) -> RouteOutline:
        """Return the outline with one turn instead of turns k and k + 1 with their leg."""
        first = self.turns[k]
        second = self.turns[k + 1]
        wider_turn = max(first, second, key=lambda bend: bend.angle)
        merged_turn = replace(
            wider_turn,
            angle=first.angle + second.angle,
            passed_buoys=(*first.passed_buoys, *self.passed_on_legs[k + 1], *second.passed_buoys),
        )
        half_leg = 0.5 * self.legs[k + 1]
        legs = (
            *self.legs[:k],
            self.legs[k] + half_leg,
            self.legs[k + 2] + half_leg,
            *self.legs[k + 3 :],
        )
        passed_on_legs = (*self.passed_on_legs[: k + 1], *self.passed_on_legs[k + 2 :])
        return RouteOutline(
            self.heading, legs, (*self.turns[:k], merged_turn, *self.turns[k + 2 :]), passed_on_legs
        )


@dataclass(frozen=True)
class RouteGeometry:
    """Points and duration of a route, with their derivatives by the route variables z.

    A point depends on the variable of its own part of the route and on the variables of all earlier
    parts. An earlier variable translates the point and rotates it about the end of its part.

    Attributes:
        points: complex positions [S] in m.
        time: duration in s.
        heading: heading of the last leg in rad.
        time_gradient: derivatives [nz] of the duration.
        heading_gradient: derivatives [nz] of the last heading.
        own_point_derivatives: derivatives [S] of the points by the variable of their own part.
        part_index: number of that variable in z, [S].
        first_point_after: first point after the part of each variable, [nz].
        shift_derivatives: translation of later points by each variable, complex [nz].
        rotation_derivatives: rotation of later points by each variable [nz] in rad.
        rotation_pivot: centre of that rotation, complex [nz] in m.
        units: unit of each variable [nz].
    """

    points: np.ndarray
    time: float
    heading: float
    time_gradient: Array
    heading_gradient: Array
    own_point_derivatives: np.ndarray
    part_index: NDArray[np.intp]
    first_point_after: NDArray[np.intp]
    shift_derivatives: np.ndarray
    rotation_derivatives: Array
    rotation_pivot: np.ndarray
    units: Array

    def point_jacobian(self, point_numbers: NDArray[np.intp]) -> np.ndarray:
        """Return the derivatives [P, nz] of the points with numbers [P] by z."""
        offsets = self.points[point_numbers][:, None] - self.rotation_pivot
        rows = np.where(
            point_numbers[:, None] >= self.first_point_after,
            self.shift_derivatives + 1j * self.rotation_derivatives * offsets,
            0.0,
        )
        own_parts = self.part_index[point_numbers]
        movable = np.flatnonzero(own_parts > 0)
        rows[movable, own_parts[movable]] = self.own_point_derivatives[point_numbers[movable]]
        result: np.ndarray = rows * self.units
        return result


def _mirror_to_side(points: np.ndarray, turn_signs: Array) -> np.ndarray:
    """Mirror starboard turns [n, K] where the sign [n] is -1 (port)."""
    result: np.ndarray = points.real + 1j * turn_signs[:, None] * points.imag
    return result


@final
@dataclass
class Route:
    """A route as a differentiable function of its variables z.

    z is (first heading, leg, hold time, leg, hold time, ..., leg), with headings in rad, legs in m
    and hold times in s, each divided by its unit.

    Attributes:
        start: complex start position in m.
        turn_signs: +1 (starboard) or -1 (port) for each of the n turns.
        table_numbers: number of the turn table for each turn.
        turns: the turn tables.
        units: units [2 n + 2] of z.
    """

    start: complex
    turn_signs: tuple[int, ...]
    table_numbers: tuple[int, ...]
    turns: TurnTables
    units: Array = field(init=False)

    def __post_init__(self) -> None:
        self.units = np.ones(2 + 2 * len(self.turn_signs))
        # variables of order one, so that one trust radius applies to all of them
        self.units[1::2] = self.turns.min_radius
        self.units[2::2] = self.turns.min_radius / self.turns.speed

    def initial_z(self, sketch: RouteOutline) -> Array:
        """Convert an outline to z, with legs shortened by the space that the turns need."""
        z = np.zeros(len(self.units))
        z[0] = sketch.heading
        legs = np.array(sketch.legs)
        for k, turn in enumerate(sketch.turns):
            table = self.turns.tables[turn.table]
            _, lead_in, lead_out = table.fitted_arc
            z[2 + 2 * k] = table.hold_time(turn.angle)
            # small turns need less straight length; 0.8 rad is where the full length is needed
            room_share = min(turn.angle / 0.8, 1.0)
            legs[k] -= room_share * lead_in
            legs[k + 1] -= room_share * lead_out
        z[1::2] = np.maximum(legs, 0.0)
        result: Array = z / self.units
        return result

    def lower_bounds(self) -> Array:
        """Return the smallest z."""
        lower = np.zeros(len(self.units))
        lower[0] = -np.inf
        lower[2::2] = [self.turns.tables[number].hold_times[0] for number in self.table_numbers]
        result: Array = lower / self.units
        return result

    def upper_bounds(self) -> Array:
        """Return the largest z."""
        upper = np.full(len(self.units), np.inf)
        upper[2::2] = [self.turns.tables[number].max_hold_time for number in self.table_numbers]
        result: Array = upper / self.units
        return result

    def passing_points(self, sketch: RouteOutline, buoys: np.ndarray) -> NDArray[np.intp]:
        """Return the point indices [N] at which an outline passes its N buoys, in order."""
        z = self.initial_z(sketch)
        points = self(z).points
        passing_indices = np.zeros(len(buoys), dtype=np.intp)
        previous_index = 0
        point_ranges: list[tuple[int, int, Sequence[int]]] = []
        first_point = 0
        for k, on_leg in enumerate(sketch.passed_on_legs):
            point_ranges.append((first_point, first_point + N_LEG_POINTS, on_leg))
            first_point += N_LEG_POINTS
            if k < len(sketch.turns):
                point_ranges.append(
                    (first_point, first_point + N_TURN_POINTS, sketch.turns[k].passed_buoys)
                )
                first_point += N_TURN_POINTS
        for range_start, range_stop, passed_buoys in point_ranges:
            for buoy in passed_buoys:
                search_start = min(max(range_start, previous_index), range_stop)
                nearest_index = search_start + int(
                    np.abs(points[search_start : range_stop + 1] - buoys[buoy]).argmin()
                )
                passing_indices[buoy] = previous_index = nearest_index
        return passing_indices

    def __call__(self, z: Array) -> RouteGeometry:
        """Compute points and duration of the route z with their derivatives."""
        z = z * self.units
        n_variables = len(z)
        n_turns = len(self.turn_signs)
        speed = self.turns.speed
        signs = np.array(self.turn_signs, dtype=float)
        first_heading = float(z[0])
        first_length = float(z[1])
        shares = np.linspace(0.0, 1.0, N_LEG_POINTS + 1)[1:]
        turn_parts, turn_derivatives = self.turns.turns_at(self.table_numbers, z[2::2])
        leg_parts, leg_derivatives = self.turns.legs_after(
            self.table_numbers, z[3::2, None] * shares
        )
        turn_parts, turn_derivatives, leg_parts, leg_derivatives = (
            part._replace(points=_mirror_to_side(part.points, signs))
            for part in (turn_parts, turn_derivatives, leg_parts, leg_derivatives)
        )
        turn_angles = signs * turn_parts.headings
        leg_angles = signs * leg_parts.headings
        headings = first_heading + np.concatenate(([0.0], np.cumsum(turn_angles + leg_angles)))
        leg_directions = np.exp(1j * headings)
        exit_directions = np.exp(1j * (headings[:-1] + turn_angles))
        track = leg_directions[:-1, None] * turn_parts.points
        leg = exit_directions[:, None] * leg_parts.points
        first_corner = self.start + first_length * leg_directions[0]
        leg_ends = first_corner + np.cumsum(track[:, -1:] + leg[:, -1:])
        turn_ends = np.concatenate(([first_corner], leg_ends))[:-1] + track[:, -1]
        turn_starts = np.concatenate(([first_corner], leg_ends))[:-1]
        track_points = np.concatenate(
            (turn_starts[:, None] + track, turn_ends[:, None] + leg), axis=1
        )
        points = np.concatenate(
            (
                [self.start],
                self.start + first_length * leg_directions[0] * shares,
                track_points.ravel(),
            )
        )
        own_point_derivatives = np.concatenate(
            (
                leg_directions[:-1, None] * turn_derivatives.points,
                shares * exit_directions[:, None] * leg_derivatives.points,
            ),
            axis=1,
        )
        shift_derivatives = np.zeros(n_variables, complex)
        rotation_derivatives = np.zeros(n_variables)
        # each variable moves all later parts of the route as a rigid body
        rotation_pivot = np.full(n_variables, self.start)
        rotation_derivatives[0] = 1.0
        shift_derivatives[1] = leg_directions[0]
        rotation_pivot[1] = first_corner
        rotation_derivatives[2::2] = signs * turn_derivatives.headings
        rotation_derivatives[3::2] = signs * leg_derivatives.headings
        shift_derivatives[2::2] = leg_directions[:-1] * turn_derivatives.points[:, -1]
        shift_derivatives[3::2] = exit_directions * leg_derivatives.points[:, -1]
        rotation_pivot[2::2] = turn_ends
        rotation_pivot[3::2] = leg_ends
        lengths = np.array([1, N_LEG_POINTS, *(N_TURN_POINTS, N_LEG_POINTS) * n_turns])
        time_gradient = np.zeros(n_variables)
        time_gradient[1::2] = 1.0 / speed
        time_gradient[2::2] = turn_derivatives.times
        return RouteGeometry(
            points,
            float(z[1::2].sum()) / speed + float(turn_parts.times.sum()),
            float(headings[-1]),
            time_gradient * self.units,
            rotation_derivatives * self.units,
            np.concatenate(([0.0], leg_directions[0] * shares, own_point_derivatives.ravel())),
            np.repeat(np.arange(n_variables), lengths),
            np.concatenate(([0], np.cumsum(lengths)[1:])),
            shift_derivatives,
            rotation_derivatives,
            rotation_pivot,
            self.units,
        )

    def to_segments(self, z: Array) -> list[tuple[np.ndarray, Array, float]]:
        """Return each part of a route: complex points [K] in m, headings [K], rudder angle, rad."""
        z = z * self.units
        heading_offset = float(z[0])
        position = self.start
        direction = cmath.exp(1j * heading_offset)
        segments = [
            (
                np.array([position, position + float(z[1]) * direction]),
                np.full(2, heading_offset),
                0.0,
            )
        ]
        position += float(z[1]) * direction
        for k, (turn_sign, number) in enumerate(
            zip(self.turn_signs, self.table_numbers, strict=True)
        ):
            hold_time = float(z[2 + 2 * k])
            leg_length = float(z[3 + 2 * k])
            table = self.turns.tables[number]
            track, heading, duration = table(hold_time)
            share = min(hold_time / duration, 1.0) if duration > 0 else 1.0
            switch_index = min(
                max(round(share * _OVERSAMPLING * N_TURN_POINTS), 1), _OVERSAMPLING * N_TURN_POINTS
            )
            track = np.concatenate(([0.0], track if turn_sign > 0 else track.conj()))
            heading = np.concatenate(([0.0], turn_sign * heading))
            uniform_grid = np.linspace(0.0, 1.0, N_TURN_POINTS + 1)
            track_spline = CubicSpline(
                uniform_grid, np.stack((track.real, track.imag, heading.real), axis=-1)
            )
            fine_track = track_spline(np.linspace(0.0, 1.0, _OVERSAMPLING * N_TURN_POINTS + 1))
            points = position + direction * (fine_track[:, 0] + 1j * fine_track[:, 1])
            heading = fine_track[:, 2]
            segments.append(
                (
                    points[: switch_index + 1],
                    heading_offset + heading[: switch_index + 1],
                    turn_sign * table.rudder,
                )
            )
            segments.append(
                (
                    points[switch_index:],
                    heading_offset + heading[switch_index:],
                    -turn_sign * table.rudder,
                )
            )
            heading_offset += float(heading[-1])
            direction = cmath.exp(1j * heading_offset)
            position = complex(points[-1])
            leg_part, _ = table.leg_at(leg_length * np.linspace(0.0, 1.0, 100)[:, None] ** 2)
            leg_points = leg_part.points[:, 0] if turn_sign > 0 else leg_part.points[:, 0].conj()
            segments.append(
                (
                    position + direction * leg_points,
                    heading_offset + turn_sign * leg_part.headings,
                    0.0,
                )
            )
            heading_offset += turn_sign * float(leg_part.headings[-1])
            direction = cmath.exp(1j * heading_offset)
            position = complex(segments[-1][0][-1])
        return segments
