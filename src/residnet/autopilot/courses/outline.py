"""Find the shortest route past buoys, as straight legs and turns.

The method is dynamic programming over candidate poses at the buoys.

The buoys are passed in order, each on its prescribed side. Between two buoys the course may go
round other circles. Paths between poses are turn, straight line, turn (L. E. Dubins, 1957) and are
computed in batches. Positions are complex numbers, north + i east, in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from residnet.autopilot.courses.route import RouteOutline, TurnSpec
from residnet.autopilot.courses.turns import Array

_ANGLES = 36
"""Number of positions on a circle at which a course may touch it, ten degrees apart."""
RINGS = (0.0, 0.25)
"""Distances outside its circle at which a buoy may be passed, in turning radii."""
_MAX_CANDIDATE_PATHS = 24
"""Number of the shortest paths to a pose that are checked for collisions; others are ignored."""
_CUT_TOLERANCE = 0.05
"""Distance in turning radii by which an outline may cut a circle.

The later optimisation of the route corrects this.
"""
_N_ENTRY_COURSES = 18
"""Number of headings, 20 degrees apart, with which a circle may be entered."""
_FULL_TURN = 2.0 * math.pi
PATH_SIDES = ((1, 1), (-1, -1), (1, -1), (-1, 1))
"""Signs of the first and the last turn of each type of path: +1 starboard, -1 port."""
_FULL_ROOM_ANGLE = 0.6
"""Turn angle in rad from which the full straight lengths before and after a turn are needed."""


class TurnRoom(NamedTuple):
    """Room that a turn needs, in m.

    Attributes:
        radius: radius of the turn.
        lead_in: straight length before the turn.
        lead_out: straight length after the turn.
    """

    radius: float
    lead_in: float
    lead_out: float


class TurnPaths(NamedTuple):
    """Paths of a turn, a straight line and a turn; all fields have the same shape.

    Attributes:
        first_angle: angle of the first turn in rad.
        last_angle: angle of the last turn in rad.
        straight_length: length of the line in m.
        heading: heading of the line in rad.
        length: total length in m; infinite for an impossible path.
    """

    first_angle: Array
    last_angle: Array
    straight_length: Array
    heading: Array
    length: Array


def _turn_angles(turn_sign: int, start_heading: Array, end_heading: Array) -> Array:
    """Return turn angles between headings; a rounding error does not become a full turn."""
    angle = (turn_sign * (end_heading - start_heading)) % _FULL_TURN
    result: Array = np.where(angle > _FULL_TURN - 1e-6, 0.0, angle)
    return result


def find_paths(
    positions: np.ndarray,
    headings: Array,
    target_positions: np.ndarray,
    target_headings: Array,
    turn_room: TurnRoom,
) -> TurnPaths:
    """Compute the four types of paths [4, ...] in `PATH_SIDES` between poses.

    Start and target poses are broadcast against each other. The straight line is at least as long
    as the straight lengths that both turns need.

    Args:
        positions: start positions, complex in m.
        headings: start headings in rad.
        target_positions: end positions, complex in m.
        target_headings: end headings in rad.
        turn_room: turning radius, and straight lengths before and after a turn.
    """
    path_parts = []
    for first_side, last_side in PATH_SIDES:
        first_centre = positions + 1j * first_side * turn_room.radius * np.exp(1j * headings)
        last_centre = target_positions + 1j * last_side * turn_room.radius * np.exp(
            1j * target_headings
        )
        centre_distance = np.abs(last_centre - first_centre)
        bearing = np.angle(last_centre - first_centre)
        if first_side == last_side:
            straight_length = centre_distance
            heading = bearing
        else:
            straight_length = np.sqrt(
                np.maximum(centre_distance**2 - 4.0 * turn_room.radius**2, 0.0)
            )
            heading = bearing + first_side * np.arctan2(2.0 * turn_room.radius, straight_length)
        first_angle = _turn_angles(first_side, headings, heading)
        last_angle = _turn_angles(last_side, heading, target_headings)
        required_length = turn_room.lead_out * np.minimum(
            first_angle / _FULL_ROOM_ANGLE, 1.0
        ) + turn_room.lead_in * np.minimum(last_angle / _FULL_ROOM_ANGLE, 1.0)
        is_possible = np.asarray(straight_length >= required_length - 1e-9)
        if first_side != last_side:
            is_possible = is_possible & (centre_distance >= 2.0 * turn_room.radius)
        length = np.where(
            is_possible, turn_room.radius * (first_angle + last_angle) + straight_length, np.inf
        )
        path_parts.append((first_angle, last_angle, straight_length, heading, length))
    return TurnPaths(*(np.stack(part) for part in zip(*path_parts, strict=True)))


def find_clear_paths(
    positions: np.ndarray,
    headings: Array,
    target_positions: np.ndarray,
    target_headings: Array,
    path_types: NDArray[np.intp],
    candidate_paths: TurnPaths,
    radius: float,
    centres: np.ndarray,
    radii: Array,
) -> NDArray[np.bool_]:
    """Return which of K paths do not intersect any of C circles.

    Args:
        positions: start positions [K].
        headings: start headings [K] in rad.
        target_positions: end positions [K].
        target_headings: end headings [K] in rad.
        path_types: indices in `PATH_SIDES`, [K].
        candidate_paths: the paths, [K] each.
        radius: turning radius in m.
        centres: centres of the circles [C].
        radii: radii of the circles [C] in m.
    """
    turn_signs = np.array(PATH_SIDES)[path_types]
    first_centre = positions + 1j * turn_signs[:, 0] * radius * np.exp(1j * headings)
    last_centre = target_positions + 1j * turn_signs[:, 1] * radius * np.exp(1j * target_headings)
    line_direction = np.exp(1j * candidate_paths.heading)
    line_start = first_centre - 1j * turn_signs[:, 0] * radius * line_direction
    line_end = line_start + candidate_paths.straight_length * line_direction
    distance = np.minimum(
        _distance_from_arcs(
            first_centre,
            turn_signs[:, 0],
            headings,
            candidate_paths.first_angle,
            positions,
            line_start,
            radius,
            centres,
        ),
        _distance_from_arcs(
            last_centre,
            turn_signs[:, 1],
            candidate_paths.heading,
            candidate_paths.last_angle,
            line_end,
            target_positions,
            radius,
            centres,
        ),
    )
    distance = np.minimum(distance, distance_from_lines(line_start, line_end, centres))
    is_clear: NDArray[np.bool_] = np.all(np.asarray(distance >= radii), axis=1)
    return is_clear


def distance_from_lines(
    line_starts: np.ndarray, line_ends: np.ndarray, centres: np.ndarray
) -> Array:
    """Return the distances [K, C] of points from straight lines [K]."""
    line = (line_ends - line_starts)[:, None]
    offsets = centres[None] - line_starts[:, None]
    line_fraction = np.clip(
        (offsets * line.conj()).real / np.maximum(np.abs(line) ** 2, 1e-12), 0.0, 1.0
    )
    distance: Array = np.abs(offsets - line_fraction * line)
    return distance


def _distance_from_arcs(
    centre: np.ndarray,
    turn_signs: NDArray[np.intp],
    heading: Array,
    angle: Array,
    arc_start: np.ndarray,
    arc_end: np.ndarray,
    radius: float,
    points: np.ndarray,
) -> Array:
    """Return the distances [K, C] of points from arcs.

    Args:
        centre: centres of the arcs [K].
        turn_signs: +1 for arcs to starboard, -1 to port, [K].
        heading: headings at the start of the arcs [K] in rad.
        angle: angles of the arcs [K] in rad.
        arc_start: start points of the arcs [K].
        arc_end: end points of the arcs [K].
        radius: radius of all arcs in m.
        points: points [C].
    """
    offsets = points[None] - centre[:, None]
    heading_at_point = np.angle(offsets) + turn_signs[:, None] * (0.5 * math.pi)
    is_on_arc = (turn_signs[:, None] * (heading_at_point - heading[:, None])) % _FULL_TURN <= angle[
        :, None
    ]
    endpoint_distance = np.minimum(
        np.abs(points[None] - arc_start[:, None]), np.abs(points[None] - arc_end[:, None])
    )
    distance: Array = np.where(is_on_arc, np.abs(np.abs(offsets) - radius), endpoint_distance)
    return distance


@dataclass(frozen=True)
class Circle:
    """A circle about a buoy.

    Attributes:
        centre: complex position in m.
        radius: radius in m.
        turn_sign: +1 if the buoy is left to starboard, -1 to port, 0 if the circle is entered.
        turn_table_index: index of the turn table for the turn round the buoy.
    """

    centre: complex
    radius: float
    turn_sign: int
    turn_table_index: int


@final
class _Poses:
    """M candidate poses at a buoy, each with its lowest cost from the start and its predecessor.

    A route that joins an arc about a buoy at one pose can follow the arc to any later pose on it.
    """

    def __init__(self, positions: np.ndarray, headings: Array, buoy: int | None) -> None:
        self.positions = positions
        self.headings = headings
        self.buoy = buoy
        n_poses = len(positions)
        self.cost = np.full(n_poses, np.inf)
        self.predecessor_indices = np.full((n_poses, 3), -1, dtype=np.intp)
        """For each pose: index in `sources`, index of the pose there, and type of the path."""
        self.sources: list[_Poses] = []
        self.arc: slice | None = None
        self.turn_sign = 0
        self.turn_table_index = 0
        self.arc_radius = 0.0
        # for each pose at which the route leaves the arc, the pose at which it joined the arc
        self.arc_entry = np.arange(n_poses)
        self.departure_cost = self.cost

    def set_arc(self, turn_sign: int, turn_table_index: int, arc_radius: float) -> None:
        """Record that the last `_ANGLES` poses are on an arc about the buoy.

        Args:
            turn_sign: +1 for an arc to starboard, -1 to port.
            turn_table_index: index of the turn table for the turn along the arc.
            arc_radius: radius in m.
        """
        self.arc = slice(len(self.positions) - _ANGLES, len(self.positions))
        self.turn_sign = turn_sign
        self.turn_table_index = turn_table_index
        self.arc_radius = arc_radius

    def update_departure_cost(self) -> None:
        """Compute the cost at departure from each pose, including motion along the arc."""
        self.departure_cost = self.cost.copy()
        if self.arc is None:
            return
        step = 2.0 * math.pi / _ANGLES
        pose_index = np.arange(_ANGLES)
        # in a turn to starboard the angle of the position on the circle increases
        steps_on_arc = (self.turn_sign * (pose_index[None, :] - pose_index[:, None])) % _ANGLES
        cost_via_entry = self.cost[self.arc][:, None] + self.arc_radius * step * steps_on_arc
        best_entry = cost_via_entry.argmin(axis=0)
        self.departure_cost[self.arc] = cost_via_entry[best_entry, pose_index]
        self.arc_entry[self.arc] = self.arc.start + best_entry

    def arc_angle(self, pose: int) -> float:
        """Return the arc angle in rad from joining the arc to leaving it at a pose."""
        if self.arc is None or pose < self.arc.start:
            return 0.0
        return (
            (self.turn_sign * (pose - int(self.arc_entry[pose])) % _ANGLES)
            * 2.0
            * math.pi
            / _ANGLES
        )


@final
class RouteSearch:
    """Search for the shortest outline of a course.

    Args:
        start: complex start position in m.
        heading: start heading in rad; None for any.
        circles: circles of the buoys in order.
        turn_room: space needed by a turn between buoys.
        turn_rooms: space needed by the turn round each buoy.
        turning_radius: turning radius in m.
        ring_offsets: distances outside its circle at which a buoy may be passed, in turning radii.
    """

    def __init__(
        self,
        start: complex,
        heading: float | None,
        circles: Sequence[Circle],
        turn_room: TurnRoom,
        turn_rooms: Sequence[TurnRoom],
        turning_radius: float,
        ring_offsets: Sequence[float] = RINGS,
    ) -> None:
        self.start = start
        self.heading = heading
        self.circles = circles
        self.turn_room = turn_room
        self.turn_rooms = turn_rooms
        self.turning_radius = turning_radius
        self.ring_offsets = ring_offsets
        self.passed_circles = [circle for circle in circles if circle.turn_sign != 0]
        self.centres = np.array([circle.centre for circle in self.passed_circles])
        self.radii = (
            np.array([circle.radius for circle in self.passed_circles])
            - _CUT_TOLERANCE * turning_radius
        )

    def find_outline(self) -> RouteOutline | None:
        """Return the shortest outline; None if no outline exists."""
        headings = (
            np.linspace(-math.pi, math.pi, 2 * _ANGLES, endpoint=False)
            if self.heading is None
            else np.array([self.heading])
        )
        start_poses = _Poses(np.full(len(headings), self.start), headings, None)
        start_poses.cost[:] = start_poses.departure_cost[:] = 0.0
        groups = [start_poses]
        for number in range(len(self.circles)):
            target = self._buoy_poses(number)
            reachable_groups = [groups[-1]]
            if self.centres.size:
                for circle_index in self._circles_between(number):
                    for turn_sign in (1, -1):
                        detour = self._poses_around(
                            self.passed_circles[circle_index], turn_sign, None, ()
                        )
                        self._update_costs(reachable_groups, detour, number == 0)
                        if np.isfinite(detour.departure_cost).any():
                            reachable_groups.append(detour)
            self._update_costs(reachable_groups, target, number == 0)
            if not np.isfinite(target.departure_cost).any():
                return None
            groups.append(target)
        return self._trace_outline(groups[-1])

    def _buoy_poses(self, number: int) -> _Poses:
        """Return the candidate poses for passing a buoy or entering its circle."""
        circle = self.circles[number]
        if circle.turn_sign != 0:
            return self._poses_around(circle, circle.turn_sign, number, self.ring_offsets)
        entry_headings = np.linspace(-math.pi, math.pi, _N_ENTRY_COURSES, endpoint=False)
        positions = circle.centre + circle.radius * np.array(
            [0.0, *np.exp(2j * math.pi * np.arange(8) / 8)]
        )
        return _Poses(
            np.repeat(positions, len(entry_headings)),
            np.tile(entry_headings, len(positions)),
            number,
        )

    def _poses_around(
        self, circle: Circle, turn_sign: int, number: int | None, ring_offsets: Sequence[float]
    ) -> _Poses:
        """Return candidate poses on rings about a buoy; the last ones lie on an arc about it."""
        angle = 2.0 * math.pi * np.arange(_ANGLES) / _ANGLES
        turn_room = self.turn_rooms[self.circles.index(circle)]
        arc_radius = max(circle.radius, turn_room.radius)
        radii = [circle.radius + ring_offset * self.turning_radius for ring_offset in ring_offsets]
        positions = np.concatenate([radius * np.exp(1j * angle) for radius in (*radii, arc_radius)])
        headings = np.tile(angle + turn_sign * 0.5 * math.pi, len(radii) + 1)
        poses = _Poses(circle.centre + positions, headings, number)
        poses.set_arc(turn_sign, circle.turn_table_index, arc_radius)
        return poses

    def _circles_between(self, number: int) -> list[int]:
        """Return the circles between a buoy and its predecessor, the nearest first."""
        start = self.start if number == 0 else self.circles[number - 1].centre
        end = self.circles[number].centre
        line_distances = distance_from_lines(np.array([start]), np.array([end]), self.centres)[0]
        search_width = max(self.radii.max(), self.turning_radius) + self.turning_radius
        blocking_circles = [
            k
            for k, circle in enumerate(self.passed_circles)
            if line_distances[k] < self.radii[k] + search_width
            and circle is not self.circles[number]
            and (number == 0 or circle is not self.circles[number - 1])
            and (number > 0 or abs(circle.centre - start) > circle.radius)
        ]
        line_direction = (end - start) / max(abs(end - start), 1e-9)
        return sorted(
            blocking_circles,
            key=lambda k: (
                ((self.passed_circles[k].centre - start) * line_direction.conjugate()).real
            ),
        )

    def _path_ends(self, poses: _Poses, is_departure: bool) -> tuple[np.ndarray, Array]:
        """Return the points at which paths start or end, and their distances from the poses.

        At departure the point lies ahead of the pose, at arrival behind it. The distance is the
        straight length that an arc about a buoy needs before and after it; it is zero for poses
        that are not on an arc.
        """
        lead_lengths = np.zeros(len(poses.positions))
        if poses.arc is not None:
            turn_room = self.turn_room
            lead_lengths[poses.arc] = turn_room.lead_out if is_departure else turn_room.lead_in
        pose_directions = np.exp(1j * poses.headings)
        return poses.positions + (
            lead_lengths if is_departure else -lead_lengths
        ) * pose_directions, lead_lengths

    def _update_costs(self, sources: Sequence[_Poses], target: _Poses, is_first: bool) -> None:
        """Update cost and predecessor of the target poses from the source poses."""
        arrival_points, arrival_lengths = self._path_ends(target, is_departure=False)
        radii = self.radii
        if is_first and len(radii):
            # circles that contain the start are ignored on the first part of the course
            radii = np.where(np.abs(self.centres - self.start) < radii, 0.0, radii)
        is_clear = (
            (np.abs(target.positions[:, None] - self.centres) >= radii).all(axis=1)
            if len(radii)
            else np.ones(len(arrival_points), dtype=bool)
        )
        target.sources = list(sources)
        for source_index, source in enumerate(sources):
            departure_points, departure_lengths = self._path_ends(source, is_departure=True)
            departure_poses = np.flatnonzero(np.isfinite(source.departure_cost))
            arrival_poses = np.flatnonzero(is_clear)
            if len(departure_poses) == 0 or len(arrival_poses) == 0:
                continue
            # straight parts before the first and after the last turn
            path_starts = departure_points[departure_poses] + self.turn_room.lead_in * np.exp(
                1j * source.headings[departure_poses]
            )
            path_ends = arrival_points[arrival_poses] - self.turn_room.lead_out * np.exp(
                1j * target.headings[arrival_poses]
            )
            candidate_paths = find_paths(
                path_starts[:, None],
                source.headings[departure_poses][:, None],
                path_ends[None],
                target.headings[arrival_poses][None],
                self.turn_room,
            )
            cost = (
                candidate_paths.length
                + (source.departure_cost[departure_poses] + departure_lengths[departure_poses])[
                    None, :, None
                ]
                + (
                    arrival_lengths[arrival_poses]
                    + self.turn_room.lead_in
                    + self.turn_room.lead_out
                )[None, None]
            )
            lowest_cost, path_number = self._cheapest_clear_paths(
                cost,
                candidate_paths,
                path_starts,
                source.headings[departure_poses],
                path_ends,
                target.headings[arrival_poses],
                radii,
            )
            is_cheaper = lowest_cost < target.cost[arrival_poses]
            improved_poses = arrival_poses[is_cheaper]
            target.cost[improved_poses] = lowest_cost[is_cheaper]
            path_type, pose = np.divmod(path_number[is_cheaper], len(departure_poses))
            target.predecessor_indices[improved_poses] = np.stack(
                (np.full(len(improved_poses), source_index), departure_poses[pose], path_type),
                axis=-1,
            )
        target.update_departure_cost()

    def _cheapest_clear_paths(
        self,
        cost: Array,
        candidate_paths: TurnPaths,
        path_starts: np.ndarray,
        headings: Array,
        path_ends: np.ndarray,
        target_headings: Array,
        radii: Array,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return the lowest cost [M] of a collision-free path to each pose, and its index.

        Args:
            cost: cost of each path [4, S, M]: types in `PATH_SIDES`, S start and M target poses.
            candidate_paths: the paths, [4, S, M] each.
            path_starts: start positions [S].
            headings: start headings [S] in rad.
            path_ends: end positions [M].
            target_headings: end headings [M] in rad.
            radii: radii of the circles [C] in m.
        """
        flat_cost = cost.reshape(-1, cost.shape[-1])
        lowest_cost = np.full(flat_cost.shape[1], np.inf)
        path_number = np.zeros(flat_cost.shape[1], dtype=np.intp)
        if not len(radii):
            path_number = flat_cost.argmin(axis=0)
            return flat_cost[path_number, np.arange(flat_cost.shape[1])], path_number
        n_sources = len(headings)
        n_candidates = min(_MAX_CANDIDATE_PATHS, len(flat_cost) - 1)
        candidate_rows = np.argpartition(flat_cost, n_candidates, axis=0)[: n_candidates + 1]
        column_grid = np.broadcast_to(np.arange(flat_cost.shape[1]), candidate_rows.shape)
        rows = candidate_rows.ravel()
        columns = column_grid.ravel()
        is_finite = np.isfinite(flat_cost[rows, columns])
        rows = rows[is_finite]
        columns = columns[is_finite]
        path_types, source_poses = np.divmod(rows, n_sources)
        selected_paths = TurnPaths(
            *(value.reshape(-1, flat_cost.shape[1])[rows, columns] for value in candidate_paths)
        )
        is_clear = find_clear_paths(
            path_starts[source_poses],
            headings[source_poses],
            path_ends[columns],
            target_headings[columns],
            path_types,
            selected_paths,
            self.turn_room.radius,
            self.centres,
            radii,
        )
        rows = rows[is_clear]
        columns = columns[is_clear]
        values = flat_cost[rows, columns]
        cost_order = np.argsort(-values, kind="stable")
        lowest_cost[columns[cost_order]] = values[cost_order]
        path_number[columns[cost_order]] = rows[cost_order]
        return lowest_cost, path_number

    def _trace_outline(self, last_poses: _Poses) -> RouteOutline:
        """Trace the outline back from the final pose with the lowest cost."""
        pose = int(last_poses.cost.argmin())
        group = last_poses
        legs: list[float] = [0.0]
        turn_specs: list[TurnSpec] = []
        passed_buoys: list[tuple[int, ...]] = [()]
        is_last_group = True
        while group.sources:
            buoys = () if group.buoy is None else (group.buoy,)
            arc_angle = 0.0 if is_last_group else group.arc_angle(pose)
            entry_pose = pose if is_last_group else int(group.arc_entry[pose])
            is_on_arc = group.arc is not None and pose >= group.arc.start
            if is_on_arc and arc_angle > 0.0:
                legs[0] += self.turn_room.lead_out
                turn_specs.insert(
                    0, TurnSpec(group.turn_sign, arc_angle, group.turn_table_index, buoys)
                )
                legs.insert(0, self.turn_room.lead_in)
                passed_buoys.insert(0, ())
            else:
                passed_buoys[0] = (*buoys, *passed_buoys[0])
                legs[0] += (
                    self.turn_room.lead_in + (0.0 if is_last_group else self.turn_room.lead_out)
                    if is_on_arc
                    else 0.0
                )
            source_number, source_pose, path_type = (
                int(value) for value in group.predecessor_indices[entry_pose]
            )
            source = group.sources[source_number]
            departure_points, _ = self._path_ends(source, is_departure=True)
            arrival_points, _ = self._path_ends(group, is_departure=False)
            path_start = departure_points[source_pose] + self.turn_room.lead_in * np.exp(
                1j * source.headings[source_pose]
            )
            path_end = arrival_points[entry_pose] - self.turn_room.lead_out * np.exp(
                1j * group.headings[entry_pose]
            )
            path = find_paths(
                path_start,
                source.headings[source_pose],
                path_end,
                group.headings[entry_pose],
                self.turn_room,
            )
            first_side, last_side = PATH_SIDES[path_type]
            legs[0] += self.turn_room.lead_out
            turn_specs.insert(0, TurnSpec(last_side, float(path.last_angle[path_type]), 0))
            legs.insert(0, float(path.straight_length[path_type]))
            passed_buoys.insert(0, ())
            turn_specs.insert(0, TurnSpec(first_side, float(path.first_angle[path_type]), 0))
            legs.insert(0, self.turn_room.lead_in)
            passed_buoys.insert(0, ())
            group = source
            pose = source_pose
            is_last_group = False
        return RouteOutline(
            float(group.headings[pose]), tuple(legs), tuple(turn_specs), tuple(passed_buoys)
        )
