"""Fit the leg lengths and hold times of a route for the shortest time past its buoys.

The constraints have exact derivatives. The solver is sequential linear programming with a trust
region and an exact penalty function (R. Fletcher, Practical Methods of Optimization, 1987,
chapter 12).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

from residnet.autopilot.courses.course_check import first_checked_sample
from residnet.autopilot.courses.outline import Circle
from residnet.autopilot.courses.route import N_LEG_POINTS, Route, RouteGeometry
from residnet.autopilot.courses.turns import N_TURN_POINTS, Array

_MAX_ITERATIONS = 45
"""Largest number of iterations of a fit; converged fits need far fewer."""
_ACTIVE_SET_INTERVAL = 8
"""Number of iterations after which the set of constraints is selected again."""
_MIN_PREDICTED_GAIN = 2e-2
"""Predicted decrease of the merit function below which the solver stops."""
_MIN_TRUST_RADIUS = 5e-4
"""Trust radius, the largest change of a variable in a step, below which the solver stops."""
_INITIAL_TRUST_RADIUS = 0.3
"""Trust radius of the first iteration."""
_MAX_TRUST_RADIUS = 1.0
"""Largest trust radius."""
_ACCEPTED_GAIN_RATIO = 0.05
"""Ratio of actual to predicted decrease of the merit function above which a step is accepted."""
_SHRINKING_GAIN_RATIO = 0.3
"""Ratio below which the trust radius shrinks."""
_GROWING_GAIN_RATIO = 0.7
"""Ratio above which the trust radius grows."""
_HARD_PENALTY = 40.0
"""Penalty of a violated constraint: increase of the course length per violation, both in turning
radii.
"""
_SOFT_PENALTY = 4.0
"""Penalty of the constraint that other parts of the course keep a larger distance from a buoy."""
_PASSING_MARGIN = 0.03
"""Difference in turning radii between the distance of a buoy from other parts of the course and
its distance from its own turn.
"""
_ABEAM_SINE = 0.3
"""Sine of the bearing from ahead or astern below which a buoy counts as on neither side."""
_OTHER_PART_RANGE = 2.0
"""Distance from a circle in turning radii within which other parts of the course are constraints.
"""
_OWN_PART_RANGE = 0.7
"""The same distance for the turn around the buoy of the circle."""
_PARTS_PER_TURN = 4
"""Number of pieces of a turn that have separate constraints."""
MAX_PASSING_DISTANCE = 0.3
"""Largest distance of a passing outside the circle of a buoy, in turning radii."""


class LinearizedProblem(NamedTuple):
    """The route problem linearised at z, in units of the turning radius and its travel time.

    Attributes:
        cost: duration of the route.
        cost_gradient: derivatives [nz] of the cost.
        constraints: constraint values [m]; feasible if not negative.
        constraint_jacobian: derivatives [m, nz] of the constraints.
        penalties: penalty per unit of violation [m].
        buoy_numbers: index of the buoy of each constraint [m].
        n_hard: number of hard constraints, which come first; a valid course meets all of them.
    """

    cost: float
    cost_gradient: Array
    constraints: Array
    constraint_jacobian: Array
    penalties: Array
    buoy_numbers: list[int]
    n_hard: int

    def merit_value(self) -> float:
        """Return the merit function: the cost plus the penalties of violated constraints."""
        return self.cost + float((self.penalties * np.maximum(-self.constraints, 0.0)).sum())

    def solve_linear_program(self, lower: Array, upper: Array) -> tuple[Array, float]:
        """Solve the linear program within bounds; returns the step and the predicted decrease."""
        # constraints that remain positive for any step within the bounds are omitted
        is_active = self.constraints < np.abs(self.constraint_jacobian) @ np.maximum(-lower, upper)
        jacobian_rows = self.constraint_jacobian[is_active]
        constraint_values = self.constraints[is_active]
        n_variables = len(lower)
        count = len(constraint_values)
        # Any, since the type stubs of linprog do not include sparse arrays
        solve_program: Any = linprog
        solution = solve_program(
            np.concatenate((self.cost_gradient, self.penalties[is_active])),
            sparse.hstack((sparse.csr_array(-jacobian_rows), -sparse.eye_array(count)))
            if count
            else None,
            constraint_values if count else None,
            bounds=np.concatenate(
                (np.stack((lower, upper), axis=-1), np.tile([0.0, np.inf], (count, 1)))
            ),
            method="highs",
        )
        if solution.x is None:
            return np.zeros(n_variables), 0.0
        return solution.x[:n_variables], self.merit_value() - self.cost - float(solution.fun)


class RouteSolution(NamedTuple):
    """A fitted route.

    Attributes:
        z: variables of the route.
        time: duration in s.
        max_violation: largest violation of a hard constraint in m.
        worst_buoy: index of the buoy of this constraint.
    """

    z: Array
    time: float
    max_violation: float
    worst_buoy: int


class _TrialStep(NamedTuple):
    """A step of the sequential linear program, before it is accepted or rejected.

    Attributes:
        z: route after the step.
        linearized: problem linearised at `z`.
        gain: decrease of the merit function.
        predicted_gain: decrease of the merit function in the linear program.
    """

    z: Array
    linearized: LinearizedProblem
    gain: float
    predicted_gain: float


class _Constraint(NamedTuple):
    """A constraint of the route at z.

    Attributes:
        buoy: index of the buoy.
        value: value in m; feasible if not negative.
        gradient: derivatives [nz] of the value.
    """

    buoy: int
    value: float
    gradient: Array


class _OtherPart(NamedTuple):
    """A part of the course that must keep its distance from a circle.

    Attributes:
        circle: index of the circle.
        turn: index of the buoy whose turn contains the part.
        points: range of points of the part.
    """

    circle: int
    turn: int
    points: slice


class _NearestPoints(NamedTuple):
    """Points of closest approach of M parts of a route to one buoy each.

    Attributes:
        distance: distance [M] from the buoy in m.
        distance_jacobian: derivatives [M, nz] of the distances.
        abeam_offset: signed distance [M], positive if the buoy is to starboard. It passes through
            zero when the buoy is ahead or astern of the end of a part.
        abeam_jacobian: derivatives [M, nz] of the signed distance.
    """

    distance: Array
    distance_jacobian: Array
    abeam_offset: Array
    abeam_jacobian: Array


@final
class RouteProblem:
    """Minimum-time problem of a route past N circles.

    Args:
        route: route as a function of its variables z.
        circles: circles in the order of passing.
        passing_indices: points of the route [N] at which the circles are passed.
        is_heading_free: whether the first heading is a free variable.
        max_offset: largest deviation of the vessel from the course in m. Other parts of the course
            keep this much more distance from a buoy than its own turn.
    """

    def __init__(
        self,
        route: Route,
        circles: Sequence[Circle],
        passing_indices: NDArray[np.intp],
        is_heading_free: bool,
        max_offset: float = 0.0,
    ) -> None:
        self.route = route
        self.circles = circles
        self.is_heading_free = is_heading_free
        self.max_offset = max_offset
        self.buoy_positions = np.array([circle.centre for circle in circles])
        self.passing_sides = np.array([circle.turn_sign for circle in circles])
        self.length_unit = route.turns.min_radius
        # each buoy is assigned the points up to the middle between its passing and the next one
        window_boundaries = (passing_indices[1:] + passing_indices[:-1] + 1) // 2
        self.window_edges = np.concatenate(([0], window_boundaries, [-1]))
        self.other_parts: list[_OtherPart] = []
        self.passing_margins = [self._passing_margin(circle) for circle in circles]
        self.soft_penalty = _SOFT_PENALTY
        self.n_evaluations = 0
        self.cached_linearization: tuple[Array, LinearizedProblem] | None = None
        self.trust_region: tuple[Array, float] | None = None

    def with_route(self, route: Route) -> RouteProblem:
        """Return the same problem for a route with other turn tables."""
        passing_indices = np.zeros(len(self.circles), dtype=np.intp)
        problem = RouteProblem(
            route, self.circles, passing_indices, self.is_heading_free, self.max_offset
        )
        problem.window_edges = self.window_edges
        problem.soft_penalty = self.soft_penalty
        return problem

    def _passing_margin(self, circle: Circle) -> float:
        """Return the additional distance in m of other parts of the course from a circle."""
        start_distance = abs(circle.centre - self.route.start) - circle.radius
        margin = _PASSING_MARGIN * self.length_unit + self.max_offset
        return margin if start_distance < 0 else min(margin, 0.5 * start_distance)

    def turn_window(self, number: int, count: int) -> slice:
        """Return the range of points of the turn at a buoy."""
        first = int(self.window_edges[number])
        stop = count if number == len(self.circles) - 1 else int(self.window_edges[number + 1]) + 1
        return slice(min(first, count - 2), max(stop, min(first, count - 2) + 2))

    def select_constraints(self, z: Array) -> None:
        """Select the pairs of route pieces and buoys that become constraints."""
        geometry = self.route(z)
        points = geometry.points
        self.other_parts = []
        # turns are divided into pieces: the nearest point of a whole turn would jump between its
        # beginning and its end, and the constraint would not be differentiable
        count = len(points)
        part_boundaries = {0, count - 1, *range(N_LEG_POINTS, count, N_LEG_POINTS + N_TURN_POINTS)}
        for k in range(_PARTS_PER_TURN):
            part_boundaries |= set(
                range(
                    N_LEG_POINTS + k * N_TURN_POINTS // _PARTS_PER_TURN,
                    count,
                    N_LEG_POINTS + N_TURN_POINTS,
                )
            )
        turn_windows = [self.turn_window(number, count) for number in range(len(self.circles))]
        turn_parts = []
        for i, turn_window in enumerate(turn_windows):
            boundaries_inside = sorted(
                {turn_window.start, turn_window.stop - 1, *part_boundaries}
                & set(range(turn_window.start, turn_window.stop))
            )
            turn_parts += [
                (i, slice(first, second + 1))
                for first, second in itertools.pairwise(boundaries_inside)
            ]
        is_on_passing_side = (
            self.passing_sides
            * self._nearest_points(geometry, self._constrained_parts(points)).abeam_offset
            > 0
        )
        for j, circle in enumerate(self.circles):
            if circle.turn_sign == 0:
                continue
            first_counted = self._first_counted_point(points, circle)
            distance = np.abs(points - circle.centre)
            self.other_parts += [
                _OtherPart(j, i, turn_part)
                for i, turn_part in turn_parts
                # a route on the wrong side of its buoy must be free to cross the circle
                if (i != j or is_on_passing_side[j])
                and turn_part.stop - max(turn_part.start, first_counted) > 1
                and distance[max(turn_part.start, first_counted) : turn_part.stop].min()
                < circle.radius
                + (_OWN_PART_RANGE if i == j else _OTHER_PART_RANGE) * self.length_unit
            ]

    def _first_counted_point(self, points: np.ndarray, circle: Circle) -> int:
        """Return the first point that is checked for a circle, see `first_checked_sample`."""
        if circle.turn_sign == 0 or abs(circle.centre - points[0]) >= circle.radius:
            return 0
        return min(
            first_checked_sample(np.abs(points - circle.centre), circle.radius), len(points) - 2
        )

    def _constrained_parts(self, points: np.ndarray) -> list[tuple[int, slice]]:
        """Return pairs of circle number and range of points; the buoys' own turns come first."""
        count = len(points)
        last = len(self.circles) - 1
        first_counted = [self._first_counted_point(points, circle) for circle in self.circles]
        constrained_parts: list[tuple[int, slice]] = []
        for j, circle in enumerate(self.circles):
            part = self.turn_window(j, count)
            constrained_parts.append(
                (j, slice(count - 2, count) if j == last and circle.turn_sign == 0 else part)
            )
        constrained_parts += [(part.circle, part.points) for part in self.other_parts]
        return [
            (j, slice(max(part.start, min(first_counted[j], part.stop - 2)), part.stop))
            for j, part in constrained_parts
        ]

    def _nearest_points(
        self, geometry: RouteGeometry, constrained_parts: Sequence[tuple[int, slice]]
    ) -> _NearestPoints:
        """Compute the closest approach of parts of the course to the centres of circles."""
        edge_vectors = np.diff(geometry.points)
        offsets_to_buoys = self.buoy_positions[:, None] - geometry.points[:-1]
        edge_fraction = (offsets_to_buoys * edge_vectors.conj()).real / np.maximum(
            np.abs(edge_vectors) ** 2, 1e-12
        )
        edge_fraction = np.clip(edge_fraction, 0.0, 1.0)
        offsets = offsets_to_buoys - edge_fraction * edge_vectors
        distances = np.abs(offsets)
        buoy_index = np.array([j for j, _ in constrained_parts])
        edge_index = np.array(
            [
                index_range.start + distances[j, index_range.start : index_range.stop - 1].argmin()
                for j, index_range in constrained_parts
            ]
        )
        fraction_at_edge = edge_fraction[buoy_index, edge_index][:, None]
        distance = distances[buoy_index, edge_index]
        offsets = offsets[buoy_index, edge_index]
        start_jacobian = geometry.point_jacobian(edge_index)
        end_jacobian = geometry.point_jacobian(edge_index + 1)
        point_jacobian = (1.0 - fraction_at_edge) * start_jacobian + fraction_at_edge * end_jacobian
        unit_offset = offsets / np.maximum(distance, 1e-9)
        distance_jacobian = -(point_jacobian * unit_offset.conj()[:, None]).real
        edge_length = np.maximum(np.abs(edge_vectors[edge_index]), 1e-9)
        edge_direction = (edge_vectors[edge_index] / edge_length).conj()
        abeam_offset = (edge_direction * offsets).imag / _ABEAM_SINE
        rotation_jacobian = (
            edge_direction[:, None] * (end_jacobian - start_jacobian)
        ).imag / edge_length[:, None]
        abeam_jacobian = (
            -(
                (edge_direction[:, None] * point_jacobian).imag
                + (edge_direction * offsets).real[:, None] * rotation_jacobian
            )
            / _ABEAM_SINE
        )
        # near the ends of a part the sign changes smoothly with the bearing instead of jumping
        is_ahead_or_astern = np.abs(abeam_offset) < distance
        sign = np.where(abeam_offset >= 0, 1.0, -1.0)
        return _NearestPoints(
            distance,
            distance_jacobian,
            np.where(is_ahead_or_astern, abeam_offset, sign * distance),
            np.where(
                is_ahead_or_astern[:, None], abeam_jacobian, sign[:, None] * distance_jacobian
            ),
        )

    def linearize(self, z: Array) -> LinearizedProblem:
        """Linearise cost and constraints at z."""
        if self.cached_linearization is not None and np.array_equal(
            self.cached_linearization[0], z
        ):
            return self.cached_linearization[1]
        # distances of the buoys from the course, and their derivatives
        geometry = self.route(z)
        self.n_evaluations += 1
        last_circle = self.circles[-1]
        n_circles = len(self.circles)
        constraints: list[_Constraint] = []
        nearest_points = self._nearest_points(geometry, self._constrained_parts(geometry.points))
        # on the wrong side, distances are negative
        is_entered = self.passing_sides == 0
        side_column = self.passing_sides[:, None]
        passing_distance = np.where(
            is_entered,
            nearest_points.distance[:n_circles],
            self.passing_sides * nearest_points.abeam_offset[:n_circles],
        )
        passing_jacobian = np.where(
            side_column == 0,
            nearest_points.distance_jacobian[:n_circles],
            side_column * nearest_points.abeam_jacobian[:n_circles],
        )
        # a value above zero violates a constraint: circles are entered, or passed on their side
        # and not too far outside
        for j, circle in enumerate(self.circles):
            if circle.turn_sign == 0:
                constraints.append(
                    _Constraint(j, circle.radius - passing_distance[j], -passing_jacobian[j])
                )
            else:
                excess_distance = (
                    circle.radius + MAX_PASSING_DISTANCE * self.length_unit - passing_distance[j]
                )
                constraints += [
                    _Constraint(j, passing_distance[j] - circle.radius, passing_jacobian[j]),
                    _Constraint(j, excess_distance, -passing_jacobian[j]),
                ]
        # other parts of the course do not cross a circle
        for k, part in enumerate(self.other_parts, start=n_circles):
            constraints.append(
                _Constraint(
                    part.circle,
                    nearest_points.distance[k] - self.circles[part.circle].radius,
                    nearest_points.distance_jacobian[k],
                )
            )
        if last_circle.turn_sign != 0:
            # the end lies neither before nor behind the last buoy
            final_direction = np.exp(1j * geometry.heading)
            goal_offset = (last_circle.centre - geometry.points[-1]) * final_direction.conjugate()
            endpoint_jacobian = geometry.point_jacobian(np.array([len(geometry.points) - 1]))[0]
            alongside_jacobian = (
                -(endpoint_jacobian * final_direction.conjugate()).real
                + goal_offset.imag * geometry.heading_gradient
            )
            constraints += [
                _Constraint(n_circles - 1, goal_offset.real, alongside_jacobian),
                _Constraint(n_circles - 1, -goal_offset.real, -alongside_jacobian),
            ]
        # soft constraints: the passing is the part of the course that is nearest to a buoy
        n_hard = len(constraints)
        for k, part in enumerate(self.other_parts, start=n_circles):
            j = part.circle
            if part.turn != j:
                # where it lies on its side too, a buoy may be as near
                margin = (
                    self.passing_margins[j]
                    if nearest_points.abeam_offset[k] * self.circles[j].turn_sign < 0
                    else 0.0
                )
                constraints.append(
                    _Constraint(
                        j,
                        nearest_points.distance[k] - passing_distance[j] - margin,
                        nearest_points.distance_jacobian[k] - passing_jacobian[j],
                    )
                )
        time_unit = self.length_unit / self.route.turns.speed
        linearized = LinearizedProblem(
            geometry.time / time_unit,
            geometry.time_gradient / time_unit,
            np.array([constraint.value for constraint in constraints]) / self.length_unit,
            np.array([constraint.gradient for constraint in constraints]).reshape(-1, len(z))
            / self.length_unit,
            np.where(np.arange(len(constraints)) < n_hard, _HARD_PENALTY, self.soft_penalty),
            [constraint.buoy for constraint in constraints],
            n_hard,
        )
        self.cached_linearization = z.copy(), linearized
        return linearized

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of z."""
        lower = self.route.lower_bounds()
        upper = self.route.upper_bounds()
        if self.trust_region is None:
            return lower, upper
        z, trust_radius = self.trust_region
        return np.maximum(lower, z - trust_radius), np.minimum(upper, z + trust_radius)

    def refresh_constraints(self, z: Array) -> None:
        """Select the constraints again after a change of the route."""
        self.cached_linearization = None
        self.select_constraints(z)

    def max_violation(self, z: Array) -> tuple[float, int]:
        """Return the largest violation of a hard constraint in m, and the number of its buoy."""
        linearized = self.linearize(z)
        violations = np.maximum(-linearized.constraints[: linearized.n_hard], 0.0)
        worst_constraint = int(violations.argmax())
        return self.length_unit * float(violations[worst_constraint]), linearized.buoy_numbers[
            worst_constraint
        ]

    def solve_with_hard_penalty(self, z: Array, trust_radius: float | None = None) -> RouteSolution:
        """Solve with the soft constraints weighted like the hard ones."""
        self.soft_penalty = _HARD_PENALTY
        return self.solve(z, trust_radius)

    def solve(self, z: Array, trust_radius: float | None = None) -> RouteSolution:
        """Solve from the initial route z, within a trust radius around it if one is given."""
        self.trust_region = None if trust_radius is None else (z, trust_radius)
        z = self._minimize_merit(np.clip(z, *self.bounds()))
        violation, worst_buoy = self.max_violation(z)
        return RouteSolution(
            z,
            self.linearize(z).cost * self.length_unit / self.route.turns.speed,
            violation,
            worst_buoy,
        )

    def _minimize_merit(self, z: Array) -> Array:
        """Minimise the merit function locally from z by sequential linear programming.

        Each iteration solves the linearised problem within a trust region, whose radius depends on
        the ratio of actual to predicted decrease. Constraints are relaxed by penalties, so that
        every linear program is feasible. A rejected step is followed by one second-order
        correction.
        """
        trust_radius = _INITIAL_TRUST_RADIUS
        self.refresh_constraints(z)
        linearized = self.linearize(z)
        for iteration in range(1, _MAX_ITERATIONS + 1):
            if iteration % _ACTIVE_SET_INTERVAL == 0:
                self.refresh_constraints(z)
                linearized = self.linearize(z)
            trial = self._make_trial_step(z, linearized, trust_radius)
            if trial.predicted_gain < _MIN_PREDICTED_GAIN:
                break
            step_size = float(np.abs(trial.z - z).max())
            if trial.gain > _ACCEPTED_GAIN_RATIO * trial.predicted_gain:
                z = trial.z
                linearized = trial.linearized
            # the linearisation was too optimistic: shrink; it was accurate: grow
            if trial.gain < _SHRINKING_GAIN_RATIO * trial.predicted_gain:
                trust_radius = 0.4 * min(trust_radius, step_size)
            elif trial.gain > _GROWING_GAIN_RATIO * trial.predicted_gain:
                trust_radius = min(2.0 * trust_radius, _MAX_TRUST_RADIUS)
            if trust_radius < _MIN_TRUST_RADIUS:
                break
        self.refresh_constraints(z)
        return z

    def _make_trial_step(
        self, z: Array, linearized: LinearizedProblem, trust_radius: float
    ) -> _TrialStep:
        """Solve the linear program around z, with one second-order correction if it gains little.

        Args:
            z: present route.
            linearized: problem linearised at z.
            trust_radius: largest change of an entry of z.
        """
        lower, upper = self.bounds()
        step_lower = np.maximum(lower - z, -trust_radius)
        step_upper = np.minimum(upper - z, trust_radius)
        if not self.is_heading_free:
            step_lower[0] = step_upper[0] = 0.0

        def evaluate_step(step: Array) -> _TrialStep:
            trial_z = np.clip(z + step, lower, upper)
            trial = self.linearize(trial_z)
            gain = linearized.merit_value() - trial.merit_value()
            return _TrialStep(trial_z, trial, gain, predicted_gain)

        step, predicted_gain = linearized.solve_linear_program(step_lower, step_upper)
        if predicted_gain < _MIN_PREDICTED_GAIN:
            return _TrialStep(z, linearized, 0.0, predicted_gain)
        trial = evaluate_step(step)
        if trial.gain < _ACCEPTED_GAIN_RATIO * predicted_gain:
            # the constraints at the trial point contain the curvature that the first program lacks
            corrected = linearized._replace(
                constraints=trial.linearized.constraints
                - linearized.constraint_jacobian @ (trial.z - z)
            )
            corrected_trial = evaluate_step(
                corrected.solve_linear_program(step_lower, step_upper)[0]
            )
            if corrected_trial.gain > trial.gain:
                return corrected_trial
        return trial
