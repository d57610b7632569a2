"""Plan the quickest course past buoys that a vessel can follow: simulated turns and straight legs.

A course passes circles on prescribed sides, or enters them, in a prescribed order.

A course of arcs and tangents needs a discontinuous yaw rate: a vessel with a yaw time constant T
overshoots the start of such an arc by about U T. Here every turn is a simulated turn of the vessel
(`turns.TurnTable`). The planner searches an outline (`outline.RouteSearch`), then fits leg lengths
and hold times (`fitting.RouteProblem`), and checks the course independently (`course_check`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.autopilot.courses.course_check import BuoyConfig, PassingRule, find_first_violation
from residnet.autopilot.courses.fitting import RouteProblem, RouteSolution
from residnet.autopilot.courses.outline import RINGS, Circle, RouteSearch, TurnRoom
from residnet.autopilot.courses.route import N_LEG_POINTS, Route, RouteOutline, TurnSpec
from residnet.autopilot.courses.turns import (
    N_TURN_POINTS,
    Array,
    TurnMaker,
    TurnTables,
    simulate_following_turns,
    state_after_turn,
)
from residnet.core.errors import ConfigError
from residnet.core.progress import report_progress

_REFINEMENT_SCHEDULE = ((0.1, 0.0), (0.1, 0.5), (0.04, 0.1), (0.02, 0.05), (0.02, 0.03))
"""Rounds of the refinement: grid of turn angles in rad, and trust radius of z.

The motion after each turn depends on z, and z is fitted to it: both converge as the trust radius
decreases.
"""
_STEP_MULTIPLES = (1.0, 5.0)
"""Multiples of the trust radius of a round, tried until the constraints are met."""
_MISS_TOLERANCE = 1e-3
"""Accepted violation of a constraint in turning radii."""
_CONVERGENCE_TOLERANCE = 1e-3
"""Largest change of z at which the refinement has converged."""
_MAX_REFINED_COURSES = 3
"""Largest number of courses whose turns are refined."""
_MAX_TIME_RATIO = 1.1
"""A course is refined only if its duration is below this multiple of the shortest one."""


def refine_turns(
    turns: TurnTables,
    candidates: Sequence[tuple[RouteProblem, RouteSolution]],
    turn_maker: TurnMaker,
) -> Iterator[tuple[RouteProblem, RouteSolution]]:
    """Yield courses whose turns start with the motion left by the previous turn, quickest first.

    Args:
        turns: turn tables of the candidates, with turns from a straight course.
        candidates: fitted courses, quickest first.
        turn_maker: simulates the turns.
    """
    if turns.is_settled:
        yield from candidates
        return
    distinct: dict[tuple[int, ...], tuple[RouteProblem, RouteSolution]] = {}
    for candidate in candidates:
        if candidate[1].time < _MAX_TIME_RATIO * candidates[0][1].time:
            # one course per sequence of turns, since the refinement changes lengths but not the
            # sequence
            distinct.setdefault(candidate[0].route.turn_signs, candidate)
    for problem, solution in list(distinct.values())[:_MAX_REFINED_COURSES]:
        yield _refine_course_turns(turns, problem, solution, turn_maker)


def _refine_course_turns(
    turns: TurnTables, problem: RouteProblem, solution: RouteSolution, turn_maker: TurnMaker
) -> tuple[RouteProblem, RouteSolution]:
    """Alternate between simulating the turns of a course and fitting the course to them."""
    route = problem.route
    rudder = (
        np.array([turns.tables[number].rudder for number in route.table_numbers]) * route.turn_signs
    )
    initial_states = [turn_maker.straight_state] * len(rudder)
    for angle_spacing, trust_radius in _REFINEMENT_SCHEDULE if len(rudder) else ():
        previous_z = solution.z
        values = solution.z * route.units
        spacing = angle_spacing / (turn_maker.nomoto.gain * np.abs(rudder))
        hold_times = np.maximum(values[2::2], 2.0 * spacing + 0.1 * turn_maker.dt)
        # five hold times about the present one: enough for a cubic spline, and few simulations
        hold_grid = hold_times[:, None] + spacing[:, None] * np.arange(-2, 3)
        turn_tables, middle_turns = simulate_following_turns(
            turn_maker, hold_grid, rudder, initial_states, turns.min_radius
        )
        initial_states = [turn_maker.straight_state]
        for turn, leg in zip(middle_turns[:-1], values[3:-1:2], strict=True):
            initial_states.append(state_after_turn(turn, float(leg)))
        if trust_radius == 0.0:
            continue
        problem = problem.with_route(
            Route(route.start, route.turn_signs, tuple(range(len(hold_grid))), turn_tables)
        )
        for step_multiple in _STEP_MULTIPLES:
            solution = problem.solve(
                np.clip(previous_z, *problem.bounds()), step_multiple * trust_radius
            )
            if solution.max_violation <= _MISS_TOLERANCE * turns.min_radius:
                break
        if np.abs(solution.z - previous_z).max() < _CONVERGENCE_TOLERANCE:
            break
    return problem, solution


class _OutlineSearch(NamedTuple):
    """Settings of a search for an outline.

    Attributes:
        room_share: fraction of the straight lengths before and after turns.
        radius_multiple: factor on the turning radius.
        n_rings: number of distances from its circle at which a buoy may be passed.
    """

    room_share: float
    radius_multiple: float
    n_rings: int


_INITIAL_SEARCHES = (
    _OutlineSearch(1.0, 1.0, 1),
    _OutlineSearch(0.5, 1.0, 1),
    _OutlineSearch(0.0, 1.0, 1),
)
"""Searches of the first round: full, half and no straight lengths before and after turns."""
_EXTENDED_SEARCHES = (
    _OutlineSearch(1.0, 1.5, 2),
    _OutlineSearch(1.0, 1.0, 2),
    _OutlineSearch(0.0, 1.0, 2),
    _OutlineSearch(0.5, 2.0, 2),
)
"""Searches after the initial ones have found no course."""
_MAX_EVALUATIONS = 600
"""Number of route evaluations after which a round fits no further outline."""
_DISTANCE_TOLERANCE = 2e-3
"""Tolerance of distances in turning radii."""
_CLEARANCE_STEP = 0.3
"""Additional clearance from a violated circle in the next outline, in turning radii."""
_MAX_CLEARANCE_ROUNDS = 6
"""Largest number of rounds with additional clearance."""
_SIMPLIFY_MISS_TOLERANCE = 0.1
"""Violation in turning radii up to which a fitted outline is simplified and fitted again."""
_REPAIR_STEP = 0.1
"""Trust radius of z for the final correction of a converged course."""
_MIN_TURN_ANGLE = math.radians(1.5)
"""Angle in rad below which a turn of an outline is removed."""
_MIN_LEG_LENGTH = 0.3
"""Length in turning radii below which a leg between turns to the same side may be removed."""


@dataclass(frozen=True)
class Course:
    """A course sampled uniformly along its track.

    Attributes:
        step: distance between samples in m.
        track: north and east [N, 2] in m.
        direction: direction of the track [N] in rad, not wrapped.
        heading: heading of the vessel [N] in rad, not wrapped; it differs from the direction by the
            drift angle.
        rudder: rudder angle of the nominal vessel [N] in rad.
        length: length of the course in m; the samples extend beyond it.
    """

    step: float
    track: Array
    direction: Array
    heading: Array
    rudder: Array
    length: float


@dataclass(frozen=True)
class CourseRequest:
    """Requirements that a course is planned for.

    Attributes:
        start: start position (north, east) in m.
        heading: start heading in rad; None to start on the first leg.
        circles: circles of the buoys in order, including margins.
        buoys: buoys without margins, for the check of the finished course.
        protocol: rule for passing buoys, see `course_check.PassingRule`.
        turns: turn tables of the vessel.
        max_offset: largest deviation of the vessel from the course in m.
    """

    start: tuple[float, float]
    heading: float | None
    circles: tuple[Circle, ...]
    buoys: tuple[BuoyConfig, ...]
    protocol: PassingRule
    turns: TurnTables
    max_offset: float = 0.0


def find_quickest_course(
    request: CourseRequest,
    step: float,
    extension_length: float,
    turn_maker: TurnMaker | None = None,
) -> Course:
    """Plan the quickest course that passes the check.

    The course ends abeam of the last buoy, or in its circle if circles are entered.

    Args:
        request: requirements.
        step: distance between samples of the course in m.
        extension_length: length of the straight extension after the end in m.
        turn_maker: simulates each turn from the motion that the previous turn leaves; None if
            turns leave no motion.

    Raises:
        ConfigError: if no course is found.
    """
    start_distances = [math.dist(request.start, (buoy.north, buoy.east)) for buoy in request.buoys]
    if request.protocol == "enter" and all(
        distance <= buoy.radius
        for distance, buoy in zip(start_distances, request.buoys, strict=True)
    ):
        raise ConfigError(
            "no course to plan: the start is within all circles that are to be entered; move a buoy"
            " or the start"
        )
    rejections: list[RejectedRoute] = []
    course = _find_course(request, step, extension_length, turn_maker, rejections)
    if course is None:
        raise ConfigError(
            _no_course_message(
                request, rejections, _find_excluding_buoys(request, step, turn_maker, rejections)
            )
        )
    return course


class RejectedRoute(NamedTuple):
    """A route that does not pass the check.

    Attributes:
        violation: violation of a circle in m; 0 if the route meets its constraints and only the
            sampled course violates the passing rule.
        buoy_index: index of the buoy.
        description: description of the violation.
    """

    violation: float
    buoy_index: int
    description: str


def _find_course(
    request: CourseRequest,
    step: float,
    extension_length: float,
    turn_maker: TurnMaker | None,
    rejections: list[RejectedRoute],
) -> Course | None:
    """Search the quickest valid course; None if none is found.

    If the courses of an outline violate a circle, the next outline has more clearance from it.

    Args:
        request: requirements.
        step: distance between samples of the course in m.
        extension_length: length of the straight extension after the end in m.
        turn_maker: see `find_quickest_course`.
        rejections: receives the routes that do not pass the check.
    """
    tried_outlines: set[tuple[object, ...]] = set()
    extra_clearance = np.zeros(len(request.circles))
    for round_number, searches in enumerate(
        (_INITIAL_SEARCHES, *(_EXTENDED_SEARCHES,) * _MAX_CLEARANCE_ROUNDS)
    ):
        report_progress("planning", round_number, 1 + _MAX_CLEARANCE_ROUNDS)
        n_previous_rejections = len(rejections)
        candidates = _solve_new_outlines(
            request, searches, extra_clearance, tried_outlines, step, rejections
        )
        route = _first_valid_route(request, candidates, turn_maker, step, rejections)
        if route is not None:
            problem, solution = route
            return _sample_route(problem.route, solution.z, step, extension_length)
        worst = min(rejections[n_previous_rejections:] or rejections, default=None)
        if worst is None:
            return None
        extra_clearance[worst.buoy_index] += _CLEARANCE_STEP * request.turns.min_radius
    return None


def _solve_new_outlines(
    request: CourseRequest,
    searches: Sequence[_OutlineSearch],
    extra_clearance: Array,
    tried_outlines: set[tuple[object, ...]],
    step: float,
    rejections: list[RejectedRoute],
) -> list[tuple[RouteProblem, RouteSolution]]:
    """Return the valid routes of outlines that were not tried before.

    Each search stops at its first outline with a valid route, and all of them at a limit of
    evaluations.

    Args:
        request: requirements.
        searches: searches in order.
        extra_clearance: additional clearance from each circle in m.
        tried_outlines: keys of the outlines that were tried; new outlines are added.
        step: distance between samples of the course in m.
        rejections: receives the routes that do not pass the check.
    """
    candidates: list[tuple[RouteProblem, RouteSolution]] = []
    n_evaluations = 0
    for search in searches:
        if n_evaluations > _MAX_EVALUATIONS:
            break
        sketch = _search_outline(
            request,
            extra_clearance,
            search.room_share,
            search.radius_multiple,
            RINGS[: search.n_rings],
        )
        for outline in () if sketch is None else _simplified_outlines(request, sketch):
            if (outline_key := _outline_key(outline)) in tried_outlines:
                continue
            tried_outlines.add(outline_key)
            solutions = _solve_outline(request, outline)
            candidates += _select_valid_routes(request, solutions, step, rejections)
            n_evaluations += sum(problem.n_evaluations for problem, _ in solutions)
            if candidates:
                break
    return candidates


def _select_valid_routes(
    request: CourseRequest,
    solutions: Sequence[tuple[RouteProblem, RouteSolution]],
    step: float,
    rejections: list[RejectedRoute],
) -> list[tuple[RouteProblem, RouteSolution]]:
    """Return the solutions that pass the check, after one repair if all feasible ones fail it."""
    valid = [
        candidate for candidate in solutions if _passes_check(request, *candidate, step, rejections)
    ]
    max_violation = _DISTANCE_TOLERANCE * request.turns.min_radius
    feasible = [candidate for candidate in solutions if candidate[1].max_violation <= max_violation]
    if valid or not feasible:
        return valid
    # the side on which a buoy is passed before or after its own turn is a soft constraint, which
    # may be violated slightly
    problem, solution = min(feasible, key=lambda candidate: candidate[1].time)
    solution = problem.solve_with_hard_penalty(solution.z)
    return (
        [(problem, solution)] if _passes_check(request, problem, solution, step, rejections) else []
    )


def _first_valid_route(
    request: CourseRequest,
    candidates: list[tuple[RouteProblem, RouteSolution]],
    turn_maker: TurnMaker | None,
    step: float,
    rejections: list[RejectedRoute],
) -> tuple[RouteProblem, RouteSolution] | None:
    """Return the quickest candidate that is valid with the turns of the vessel, or None."""
    max_violation = _DISTANCE_TOLERANCE * request.turns.min_radius
    candidates.sort(key=lambda candidate: candidate[1].time)
    for problem, solution in (
        candidates if turn_maker is None else refine_turns(request.turns, candidates, turn_maker)
    ):
        if _passes_check(request, problem, solution, step, rejections):
            return problem, solution
        if solution.max_violation <= max_violation:
            # all hard constraints are met: a short move with harder penalties may be enough
            repaired = problem.solve_with_hard_penalty(solution.z, _REPAIR_STEP)
            if _passes_check(request, problem, repaired, step, rejections):
                return problem, repaired
    return None


def _find_excluding_buoys(
    request: CourseRequest,
    step: float,
    turn_maker: TurnMaker | None,
    rejections: Sequence[RejectedRoute],
) -> tuple[int, ...]:
    """Return the numbers (from 1) of two or three consecutive buoys that have no course alone.

    Such a partial course starts at the preceding buoy in any direction. The result is empty if all
    partial courses exist.
    """
    count = len(request.circles)
    worst = min(rejections).buoy_index if rejections else 0
    for length in (2, 3):
        if length >= count:
            break
        for first_index in range(max(worst - length + 1, 0), min(worst, count - length) + 1):
            buoy_slice = slice(first_index, first_index + length)
            previous_position = (
                request.circles[first_index - 1].centre if first_index else complex(*request.start)
            )
            partial_request = replace(
                request,
                start=(previous_position.real, previous_position.imag),
                heading=None if first_index else request.heading,
                circles=request.circles[buoy_slice],
                buoys=request.buoys[buoy_slice],
            )
            if _find_course(partial_request, step, step, turn_maker, []) is None:
                return tuple(range(first_index + 1, first_index + length + 1))
    return ()


def _simplified_outlines(request: CourseRequest, sketch: RouteOutline) -> list[RouteOutline]:
    """Return the simplified outline followed by the original one."""
    min_leg_length = _MIN_LEG_LENGTH * request.turns.min_radius
    return [sketch.simplify(min_leg_length, _MIN_TURN_ANGLE), sketch.simplify(0.0, 1e-3)]


def _passes_check(
    request: CourseRequest,
    problem: RouteProblem,
    solution: RouteSolution,
    step: float,
    rejections: list[RejectedRoute],
) -> bool:
    """Return whether a course passes the check, and append it to `rejections` if not."""
    if solution.max_violation > _DISTANCE_TOLERANCE * request.turns.min_radius:
        rejections.append(
            RejectedRoute(
                solution.max_violation, solution.worst_buoy, f"buoy {solution.worst_buoy + 1}"
            )
        )
        return False
    course = _sample_route(problem.route, solution.z, step, step)
    # to the end, between samples
    track = course.track[: math.ceil(course.length / step) + 1]
    radius = request.turns.min_radius
    violation = find_first_violation(
        track, request.buoys, request.protocol, radius, solution.max_violation
    )
    if violation is not None:
        rejections.append(RejectedRoute(0.0, *violation))
    return violation is None


def _no_course_message(
    request: CourseRequest, rejections: Sequence[RejectedRoute], buoy_numbers: Sequence[int]
) -> str:
    """Return the message that no course was found, with the reason and advice."""
    if buoy_numbers:
        *leading_numbers, last_number = (str(number) for number in buoy_numbers)
        return (
            f"no course found: buoys {', '.join(leading_numbers)} and {last_number} exclude each"
            " other for this"
            " vessel's turns, even alone and begun at the one before them; move one, give them"
            " smaller circles, or allow more rudder"
        )
    advice = "move it, give it a smaller circle, or allow more rudder"
    if not rejections:
        return (
            f"no course found past the {len(request.circles)} buoys: circles leave no way between"
            f" them; {advice}"
        )
    miss_distance = min(rejections).violation
    problem_text = min(rejections).description
    if miss_distance > 0:
        problem_text += (
            f": the best course found with this vessel's turns misses its circle by"
            f" {miss_distance:.3g} m"
        )
    return f"no course found: {problem_text}; {advice}"


def _outline_key(sketch: RouteOutline) -> tuple[object, ...]:
    """Return a key that is equal for outlines that lead to the same course."""
    return (
        *(
            (
                turn_spec.turn_sign,
                turn_spec.table,
                turn_spec.passed_buoys,
                round(turn_spec.angle / (2.0 * math.pi)),
            )
            for turn_spec in sketch.turns
        ),
        sketch.passed_on_legs,
    )


def _search_outline(
    request: CourseRequest,
    extra_clearance: Array,
    room_share: float,
    radius_multiple: float,
    ring_offsets: Sequence[float],
) -> RouteOutline | None:
    """Search the shortest outline with modified clearances and turn dimensions.

    Args:
        request: requirements.
        extra_clearance: additional clearance from each circle, or depth inside it, in m.
        room_share: fraction of the straight lengths before and after turns.
        radius_multiple: factor on the turning radius.
        ring_offsets: distances outside its circle at which a buoy may be passed, in turning radii.
    """

    def turn_room(number: int) -> TurnRoom:
        radius, lead_in, lead_out = request.turns.tables[number].fitted_arc
        return TurnRoom(radius_multiple * radius, room_share * lead_in, room_share * lead_out)

    return RouteSearch(
        complex(*request.start),
        request.heading,
        [
            replace(
                circle,
                radius=max(circle.radius + (clearance if circle.turn_sign else -clearance), 0.0),
            )
            for circle, clearance in zip(request.circles, extra_clearance, strict=True)
        ],
        turn_room(0),
        [turn_room(circle.turn_table_index) for circle in request.circles],
        request.turns.min_radius,
        ring_offsets,
    ).find_outline()


def _solve_outline(
    request: CourseRequest, sketch: RouteOutline
) -> list[tuple[RouteProblem, RouteSolution]]:
    """Fit the route of an outline and, if it has removable turns, of the simplified outline."""
    solutions: list[tuple[RouteProblem, RouteSolution]] = []
    radius = request.turns.min_radius
    for attempt in range(3):
        route = Route(
            complex(*request.start),
            tuple(turn_spec.turn_sign for turn_spec in sketch.turns),
            tuple(turn_spec.table for turn_spec in sketch.turns),
            request.turns,
        )
        passing_indices = route.passing_points(
            sketch, np.array([circle.centre for circle in request.circles])
        )
        problem = RouteProblem(
            route, request.circles, passing_indices, request.heading is None, request.max_offset
        )
        z = route.initial_z(sketch)
        solution = problem.solve(z)
        solutions.append((problem, solution))
        if solution.max_violation > _SIMPLIFY_MISS_TOLERANCE * radius:
            break
        simplified_outline = _outline_of_solution(
            request, route, solution.z, problem, sketch
        ).simplify(_MIN_LEG_LENGTH * radius, _MIN_TURN_ANGLE)
        if len(simplified_outline.turns) == len(sketch.turns) or attempt == 2:
            break
        sketch = simplified_outline
    return solutions


def _outline_of_solution(
    request: CourseRequest, route: Route, z: Array, problem: RouteProblem, sketch: RouteOutline
) -> RouteOutline:
    """Convert a fitted route back to an outline."""
    lengths = z * route.units
    points = route(z).points
    legs = lengths[1::2].copy()
    passed_on_legs: list[list[int]] = [[] for _ in legs]
    passed_in_turns: list[list[int]] = [[] for _ in sketch.turns]
    for number, circle in enumerate(request.circles):
        buoy_window = problem.turn_window(number, len(points))
        nearest_index = buoy_window.start + int(
            np.abs(points[buoy_window] - circle.centre).argmin()
        )
        k, index_in_part = divmod(max(nearest_index - 1, 0), N_LEG_POINTS + N_TURN_POINTS)
        (
            passed_on_legs[k]
            if index_in_part < N_LEG_POINTS or k >= len(passed_in_turns)
            else passed_in_turns[k]
        ).append(number)
    turn_specs: list[TurnSpec] = []
    for k, turn_spec in enumerate(sketch.turns):
        table = request.turns.tables[turn_spec.table]
        angle = float(np.interp(lengths[2 + 2 * k], table.hold_times, table.angles))
        _, lead_in, lead_out = table.fitted_arc
        share = min(angle / 0.8, 1.0)
        legs[k] += share * lead_in
        legs[k + 1] += share * lead_out
        turn_specs.append(replace(turn_spec, angle=angle, passed_buoys=tuple(passed_in_turns[k])))
    return RouteOutline(
        float(lengths[0]), tuple(legs), tuple(turn_specs), tuple(map(tuple, passed_on_legs))
    )


def _sample_route(route: Route, z: Array, step: float, extension_length: float) -> Course:
    """Sample a route uniformly, with a straight extension after its end."""
    segments = route.to_segments(z)
    end_point = segments[-1][0][-1]
    end_heading = float(segments[-1][1][-1])
    track = np.concatenate([part[0] for part in segments])
    last_step = np.diff(track)[np.flatnonzero(np.abs(np.diff(track)) > 1e-9)[-1]]
    extension = np.array([end_point, end_point + extension_length * last_step / abs(last_step)])
    segments.append((extension, np.full(2, end_heading), 0.0))
    positions = np.concatenate([part[0] for part in segments])
    heading = np.concatenate([part[1] for part in segments])
    rudder = np.concatenate([np.full(len(part[0]), part[2]) for part in segments])
    # where parts meet, the rudder of the next one holds
    distinct: NDArray[np.bool_] = np.concatenate((np.abs(np.diff(positions)) > 1e-9, [True]))
    positions = positions[distinct]
    heading = heading[distinct]
    rudder = rudder[distinct]
    arc_length = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(positions)))))
    sample_length = step * np.arange(math.floor(arc_length[-1] / step) + 1)
    points = np.stack(
        [
            np.interp(sample_length, arc_length, positions.real),
            np.interp(sample_length, arc_length, positions.imag),
        ],
        axis=-1,
    )
    direction = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    direction += 2.0 * math.pi * round((heading[0] - direction[0]) / (2.0 * math.pi))
    rudder_at_samples = rudder[
        np.minimum(np.searchsorted(arc_length, sample_length, side="right") - 1, len(rudder) - 1)
    ]
    return Course(
        step,
        points,
        direction,
        np.interp(sample_length, arc_length, heading),
        rudder_at_samples,
        float(arc_length[-1]) - extension_length,
    )
