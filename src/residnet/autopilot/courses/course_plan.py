"""Courses that a vessel can follow: its own turns and the straight legs between.

They keep out of circles on given sides or reach into them, in the order given, and are checked.

A course of arcs and tangents needs a yaw rate that jumps. A vessel with a yaw time constant T
runs U T past the point where such an arc begins; here every turn is one that the vessel makes
(`turns.TurnTable`). An outline is found first (`outline.Outlines`), then how long the rudder
is held and how long legs are (`fitting.Fit`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from residnet.autopilot.courses.course_check import BuoyConfig, Protocol, find_first_violation
from residnet.autopilot.courses.fitting import RouteProblem, RouteSolution
from residnet.autopilot.courses.outline import RINGS, Circle, RouteSearch, TurnRoom
from residnet.autopilot.courses.turns import (
    LEG,
    POINTS,
    Array,
    Route,
    RouteOutline,
    TurnMaker,
    TurnSpec,
    TurnTables,
    simulate_following_turns,
    state_after_turn,
)
from residnet.core.errors import ConfigError
from residnet.core.progress import report_progress

_REFINEMENT_SCHEDULE = ((0.1, 0.0), (0.1, 0.5), (0.04, 0.1), (0.02, 0.05), (0.02, 0.03))
"""Turned angles in rad between the turns that are made anew, and by how much z may then change.

Motions behind turns follow from z, and z is chosen for them: both settle as z changes less.
"""
_STEP_MULTIPLES = (1.0, 5.0)
"""Multiples of that change that are tried until what is asked is held."""
_MISS_TOLERANCE = 1e-3
"""Turning radii that may be missed."""
_CONVERGENCE_TOLERANCE = 1e-3
"""Largest change of z with which turns made anew fit each other."""
_MAX_REFINED_COURSES = 3
"""Courses whose turns are made anew, at most."""
_MAX_TIME_RATIO = 1.1
"""Multiple of the quickest course's time from which on another is not made anew."""


def refine_turns(
    turns: TurnTables,
    candidates: Sequence[tuple[RouteProblem, RouteSolution]],
    turn_maker: TurnMaker,
) -> Iterator[tuple[RouteProblem, RouteSolution]]:
    """Yield courses with turns that follow each other as the vessel makes them, quickest first.

    Args:
        turns: that the courses were found with, each from straight ahead.
        candidates: the courses, quickest first.
    """
    if turns.is_settled:
        yield from candidates
        return
    distinct: dict[tuple[int, ...], tuple[RouteProblem, RouteSolution]] = {}
    for candidate in candidates:
        if candidate[1].time < _MAX_TIME_RATIO * candidates[0][1].time:
            distinct.setdefault(candidate[0].route.turn_signs, candidate)
    for problem, solution in list(distinct.values())[:_MAX_REFINED_COURSES]:
        yield _refine_course_turns(turns, problem, solution, turn_maker)


def _refine_course_turns(
    turns: TurnTables, problem: RouteProblem, solution: RouteSolution, turn_maker: TurnMaker
) -> tuple[RouteProblem, RouteSolution]:
    """Return a course whose turns are made anew, and that is fitted to them, round for round."""
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


_INITIAL_SEARCHES = ((1.0, 1.0, 1), (0.5, 1.0, 1), (0.0, 1.0, 1))
_EXTENDED_SEARCHES = ((1.0, 1.5, 2), (1.0, 1.0, 2), (0.0, 1.0, 2), (0.5, 2.0, 2))
"""What outlines are looked for with: share of the room before and behind turns, multiple of their
radius, and how many distances buoys may be passed at.
"""
_MAX_EVALUATIONS = 600
"""Times that a route is drawn for fits, beyond which no other outline of a round is fitted."""
_DISTANCE_TOLERANCE = 2e-3
"""Of distances, as a share of the vessel's turning radius."""
_CLEARANCE_STEP = 0.3
"""Turning radii by which the next outline keeps farther off a circle that was missed."""
_MAX_CLEARANCE_ROUNDS = 6
"""How often it does."""
_SIMPLIFY_MISS_TOLERANCE = 0.1
"""Turning radii by which a fit may miss its circles and still be simplified."""
_REPAIR_STEP = 0.1
"""Change of z within which a course is mended whose turns fit each other."""
_MIN_TURN_ANGLE = math.radians(1.5)
_MIN_LEG_LENGTH = 0.3
"""Turning radii of a leg between two turns to one side that are tried as one."""


@dataclass(frozen=True)
class Course:
    """A course by the distance along it, in even steps.

    Attributes:
        step: in m.
        track: north, east [N, 2] in m.
        direction: of the track [N] in rad, not wrapped.
        heading: of the vessel [N] in rad, not wrapped; it differs from the direction by the drift
            angle.
        rudder: that the nominal vessel needs [N] in rad.
        length: where it ends, in m; the points go on beyond it.
    """

    step: float
    track: Array
    direction: Array
    heading: Array
    rudder: Array
    length: float


@dataclass(frozen=True)
class CourseRequest:
    """What a course is planned for.

    Attributes:
        start: (north, east) in m.
        heading: at the start in rad; None to start on the first leg.
        circles: of the buoys in their order, as the plan keeps to them.
        buoys: what the finished course has to do at each, without margins.
        protocol: see there.
        turns: that the vessel makes.
        max_offset: by how much in m the vessel may be displaced from the course.
    """

    start: tuple[float, float]
    heading: float | None
    circles: tuple[Circle, ...]
    buoys: tuple[BuoyConfig, ...]
    protocol: Protocol
    turns: TurnTables
    max_offset: float = 0.0


def find_quickest_course(
    request: CourseRequest,
    step: float,
    extension_length: float,
    turn_maker: TurnMaker | None = None,
) -> Course:
    """Return the quickest course found that passes the check.

    It ends abeam of the last buoy, or in its circle where that is entered.

    Args:
        step: between the points of the course in m.
        extension_length: how far the points go on behind the end, in m.
        turn_maker: makes each turn of the course found anew, from the motion that the one before it
            leaves; None where turns leave none.

    Raises:
        ConfigError: where none is found.
    """
    start_distances = [math.dist(request.start, (buoy.north, buoy.east)) for buoy in request.buoys]
    if request.protocol == "enter" and all(
        distance <= buoy.radius
        for distance, buoy in zip(start_distances, request.buoys, strict=True)
    ):
        raise ConfigError(
            "no course to plan: it begins within every circle that it is to enter; move a buoy or"
            " the start"
        )
    reasons: list[tuple[float, int, str]] = []
    course = _find_course(request, step, extension_length, turn_maker, reasons)
    if course is None:
        raise ConfigError(
            _no_course_message(
                request, reasons, _find_excluding_buoys(request, step, turn_maker, reasons)
            )
        )
    return course


def _find_course(
    request: CourseRequest,
    step: float,
    extension_length: float,
    turn_maker: TurnMaker | None,
    reasons: list[tuple[float, int, str]],
) -> Course | None:
    """Return the quickest course found that passes the check; None, and reasons, where none is.

    Where the courses of an outline miss a circle, the next outline keeps farther off it.
    """
    tried_outlines: set[tuple[object, ...]] = set()
    radius = request.turns.min_radius
    extra_clearance = np.zeros(len(request.circles))

    def first_valid_course(candidates: list[tuple[RouteProblem, RouteSolution]]) -> Course | None:
        candidates.sort(key=lambda one: one[1].time)
        for problem, solution in (
            candidates
            if turn_maker is None
            else refine_turns(request.turns, candidates, turn_maker)
        ):
            if _passes_check(request, problem, solution, step, reasons):
                return _sample_route(problem.route, solution.z, step, extension_length)
            if solution.max_violation <= _DISTANCE_TOLERANCE * radius:
                solution = problem.solve_with_hard_penalty(solution.z, _REPAIR_STEP)
                if _passes_check(request, problem, solution, step, reasons):
                    return _sample_route(problem.route, solution.z, step, extension_length)
        return None

    for round_number, searches in enumerate(
        (_INITIAL_SEARCHES, *(_EXTENDED_SEARCHES,) * _MAX_CLEARANCE_ROUNDS)
    ):
        report_progress("planning", round_number, 1 + _MAX_CLEARANCE_ROUNDS)
        candidates: list[tuple[RouteProblem, RouteSolution]] = []
        n_previous_reasons = len(reasons)
        n_evaluations = 0
        for room_share, radius_multiple, rings in searches:
            if n_evaluations > _MAX_EVALUATIONS:
                break
            sketch = _search_outline(
                request, extra_clearance, room_share, radius_multiple, RINGS[:rings]
            )
            for outline in () if sketch is None else _simplified_outlines(request, sketch):
                if (outline_key := _outline_key(outline)) in tried_outlines:
                    continue
                tried_outlines.add(outline_key)
                solutions = _solve_outline(request, outline)
                valid = [
                    candidate
                    for candidate in solutions
                    if _passes_check(request, *candidate, step, reasons)
                ]
                feasible = [
                    candidate
                    for candidate in solutions
                    if candidate[1].max_violation <= _DISTANCE_TOLERANCE * radius
                ]
                if feasible and not valid:
                    # what is passed out of its turn may be on the wrong side there
                    problem, solution = min(feasible, key=lambda one: one[1].time)
                    solution = problem.solve_with_hard_penalty(solution.z)
                    valid = (
                        [(problem, solution)]
                        if _passes_check(request, problem, solution, step, reasons)
                        else []
                    )
                candidates += valid
                n_evaluations += sum(problem.n_evaluations for problem, _ in solutions)
                if candidates:
                    break
        if (course := first_valid_course(candidates)) is not None:
            return course
        worst = min(reasons[n_previous_reasons:] or reasons, default=None)
        if worst is None:
            return None
        extra_clearance[worst[1]] += _CLEARANCE_STEP * radius
    return None


def _find_excluding_buoys(
    request: CourseRequest,
    step: float,
    turn_maker: TurnMaker | None,
    reasons: Sequence[tuple[float, int, str]],
) -> tuple[int, ...]:
    """Return the numbers of two or three buoys in a row that are refused by themselves, from 1.

    They are begun at the buoy before them, in any direction. Empty where each row has a course.
    """
    count = len(request.circles)
    worst = min(reasons)[1] if reasons else 0
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
    """Return an outline with turns joined that can be, and as it is."""
    min_leg_length = _MIN_LEG_LENGTH * request.turns.min_radius
    return [sketch.simplify(min_leg_length, _MIN_TURN_ANGLE), sketch.simplify(0.0, 1e-3)]


def _passes_check(
    request: CourseRequest,
    problem: RouteProblem,
    solution: RouteSolution,
    step: float,
    reasons: list[tuple[float, int, str]],
) -> bool:
    """Return whether a course passes the check; where it does not, the reason is added.

    A reason is what is missed in m, the number of the buoy from 0, and the words for it.
    """
    if solution.max_violation > _DISTANCE_TOLERANCE * request.turns.min_radius:
        reasons.append(
            (solution.max_violation, solution.worst_buoy, f"buoy {solution.worst_buoy + 1}")
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
        reasons.append((0.0, *violation))
    return violation is None


def _no_course_message(
    request: CourseRequest, reasons: Sequence[tuple[float, int, str]], buoy_numbers: Sequence[int]
) -> str:
    if buoy_numbers:
        *leading_numbers, last_number = (str(number) for number in buoy_numbers)
        return (
            f"no course found: buoys {', '.join(leading_numbers)} and {last_number} exclude each other for this"
            " vessel's turns, even alone and begun at the one before them; move one, give them"
            " smaller circles, or allow more rudder"
        )
    advice = "move it, give it a smaller circle, or allow more rudder"
    if not reasons:
        return (
            f"no course found past the {len(request.circles)} buoys: circles leave no way between"
            f" them; {advice}"
        )
    miss_distance, _, problem_text = min(reasons)
    if miss_distance > 0:
        problem_text += f": the best course found with this vessel's turns misses its circle by {miss_distance:.3g} m"
    return f"no course found: {problem_text}; {advice}"


def _outline_key(sketch: RouteOutline) -> tuple[object, ...]:
    """Return what makes two outlines lead to the same course."""
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
    """Return the shortest outline for turns that need a share of their room.

    It keeps farther off circles, or reaches farther into them, by `extra_clearance` in m.
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
        [turn_room(circle.table) for circle in request.circles],
        request.turns.min_radius,
        ring_offsets,
    ).find_outline()


def _solve_outline(
    request: CourseRequest, sketch: RouteOutline
) -> list[tuple[RouteProblem, RouteSolution]]:
    """Return the fitted route of an outline, and the one of what is left of it when simplified."""
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
    """Return the outline of a fitted route."""
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
        k, index_in_part = divmod(max(nearest_index - 1, 0), LEG + POINTS)
        (
            passed_on_legs[k]
            if index_in_part < LEG or k >= len(passed_in_turns)
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
    """Return a route in even steps, with a straight line behind its end."""
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
