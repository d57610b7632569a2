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

from residnet.control.courses.course_check import BuoyConfig, Protocol, first_fault
from residnet.control.courses.fitting import Fit, Fitted
from residnet.control.courses.outline import RINGS, Circle, Outlines, Room
from residnet.control.courses.turns import (
    LEG,
    POINTS,
    Array,
    Bend,
    Route,
    Sketch,
    TurnMaker,
    Turns,
    following_turns,
    state_behind,
)
from residnet.core.errors import ConfigError
from residnet.core.progress import report

_ROUNDS = ((0.1, 0.0), (0.1, 0.5), (0.04, 0.1), (0.02, 0.05), (0.02, 0.03))
"""Turned angles in rad between the turns that are made anew, and by how much z may then change.

Motions behind turns follow from z, and z is chosen for them: both settle as z changes less.
"""
_WIDER = (1.0, 5.0)
"""Multiples of that change that are tried until what is asked is held."""
_HELD = 1e-3
"""Turning radii that may be missed."""
_UNCHANGED = 1e-3
"""Largest change of z with which turns made anew fit each other."""
_MOST = 3
"""Courses whose turns are made anew, at most."""
_SLOWER = 1.1
"""Multiple of the quickest course's time from which on another is not made anew."""


def joined(
    turns: Turns, found: Sequence[tuple[Fit, Fitted]], make: TurnMaker
) -> Iterator[tuple[Fit, Fitted]]:
    """Yield courses with turns that follow each other as the vessel makes them, quickest first.

    Args:
        turns: that the courses were found with, each from straight ahead.
        found: the courses, quickest first.
    """
    if turns.settled:
        yield from found
        return
    distinct: dict[tuple[int, ...], tuple[Fit, Fitted]] = {}
    for one in found:
        if one[1].time < _SLOWER * found[0][1].time:
            distinct.setdefault(one[0].route.sides, one)
    for fit, fitted in list(distinct.values())[:_MOST]:
        yield _joined(turns, fit, fitted, make)


def _joined(turns: Turns, fit: Fit, fitted: Fitted, make: TurnMaker) -> tuple[Fit, Fitted]:
    """Return a course whose turns are made anew, and that is fitted to them, round for round."""
    route = fit.route
    rudder = np.array([turns.tables[number].rudder for number in route.numbers]) * route.sides
    begin = [make.straight] * len(rudder)
    for width, reach in _ROUNDS if len(rudder) else ():
        before, values = fitted.z, fitted.z * route.units
        spacing = width / (make.turning.gain * np.abs(rudder))
        middle = np.maximum(values[2::2], 2.0 * spacing + 0.1 * make.dt)
        holds = middle[:, None] + spacing[:, None] * np.arange(-2, 3)
        made, middles = following_turns(make, holds, rudder, begin, turns.radius)
        begin = [make.straight]
        for turn, leg in zip(middles[:-1], values[3:-1:2], strict=True):
            begin.append(state_behind(turn, float(leg)))
        if reach == 0.0:
            continue
        fit = fit.on(Route(route.start, route.sides, tuple(range(len(holds))), made))
        for wider in _WIDER:
            fitted = fit.solve(np.clip(before, *fit.bounds()), wider * reach)
            if fitted.missed <= _HELD * turns.radius:
                break
        if np.abs(fitted.z - before).max() < _UNCHANGED:
            break
    return fit, fitted


_TRIES = ((1.0, 1.0, 1), (0.5, 1.0, 1), (0.0, 1.0, 1))
_MORE = ((1.0, 1.5, 2), (1.0, 1.0, 2), (0.0, 1.0, 2), (0.5, 2.0, 2))
"""What outlines are looked for with: share of the room before and behind turns, multiple of their
radius, and how many distances buoys may be passed at.
"""
_EFFORT = 600
"""Times that a route is drawn for fits, beyond which no other outline of a round is fitted."""
_TOLERANCE = 2e-3
"""Of distances, as a share of the vessel's turning radius."""
_APART = 0.3
"""Turning radii by which the next outline keeps farther off a circle that was missed."""
_ROUNDS_APART = 6
"""How often it does."""
_FAR = 0.1
"""Turning radii by which a fit may miss its circles and still be simplified."""
_MENDED = 0.1
"""Change of z within which a course is mended whose turns fit each other."""
_SMALL = math.radians(1.5)
_SHORT = 0.3
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
        aside: by how much in m the vessel may be displaced from the course.
    """

    start: tuple[float, float]
    heading: float | None
    circles: tuple[Circle, ...]
    buoys: tuple[BuoyConfig, ...]
    protocol: Protocol
    turns: Turns
    aside: float = 0.0


def plan(
    request: CourseRequest, step: float, beyond: float, make: TurnMaker | None = None
) -> Course:
    """Return the quickest course found that passes the check.

    It ends abeam of the last buoy, or in its circle where that is entered.

    Args:
        step: between the points of the course in m.
        beyond: how far the points go on behind the end, in m.
        make: makes each turn of the course found anew, from the motion that the one before it
            leaves; None where turns leave none.

    Raises:
        ConfigError: where none is found.
    """
    away = [math.dist(request.start, (buoy.north, buoy.east)) for buoy in request.buoys]
    if request.protocol == "enter" and all(
        far <= buoy.radius for far, buoy in zip(away, request.buoys, strict=True)
    ):
        raise ConfigError(
            "no course to plan: it begins within every circle that it is to enter; move a buoy or"
            " the start"
        )
    reasons: list[tuple[float, int, str]] = []
    course = _planned(request, step, beyond, make, reasons)
    if course is None:
        raise ConfigError(_refusal(request, reasons, _excluding(request, step, make, reasons)))
    return course


def _planned(
    request: CourseRequest,
    step: float,
    beyond: float,
    make: TurnMaker | None,
    reasons: list[tuple[float, int, str]],
) -> Course | None:
    """Return the quickest course found that passes the check; None, and reasons, where none is.

    Where the courses of an outline miss a circle, the next outline keeps farther off it.
    """
    known: set[tuple[object, ...]] = set()
    radius = request.turns.radius
    apart = np.zeros(len(request.circles))

    def settled(found: list[tuple[Fit, Fitted]]) -> Course | None:
        found.sort(key=lambda one: one[1].time)
        for fit, fitted in found if make is None else joined(request.turns, found, make):
            if _right(request, fit, fitted, step, reasons):
                return _sampled(fit.route, fitted.z, step, beyond)
            if fitted.missed <= _TOLERANCE * radius:
                fitted = fit.alone(fitted.z, _MENDED)
                if _right(request, fit, fitted, step, reasons):
                    return _sampled(fit.route, fitted.z, step, beyond)
        return None

    for number, tries in enumerate((_TRIES, *(_MORE,) * _ROUNDS_APART)):
        report("planning", number, 1 + _ROUNDS_APART)
        found: list[tuple[Fit, Fitted]] = []
        before, effort = len(reasons), 0
        for room, wide, rings in tries:
            if effort > _EFFORT:
                break
            sketch = _outline(request, apart, room, wide, RINGS[:rings])
            for outline in () if sketch is None else _simplified(request, sketch):
                if (shape := _shape(outline)) in known:
                    continue
                known.add(shape)
                fits = _fitted(request, outline)
                right = [one for one in fits if _right(request, *one, step, reasons)]
                close = [one for one in fits if one[1].missed <= _TOLERANCE * radius]
                if close and not right:
                    # what is passed out of its turn may be on the wrong side there
                    fit, fitted = min(close, key=lambda one: one[1].time)
                    fitted = fit.alone(fitted.z)
                    right = [(fit, fitted)] if _right(request, fit, fitted, step, reasons) else []
                found += right
                effort += sum(fit.effort for fit, _ in fits)
                if found:
                    break
        if (course := settled(found)) is not None:
            return course
        worst = min(reasons[before:] or reasons, default=None)
        if worst is None:
            return None
        apart[worst[1]] += _APART * radius
    return None


def _excluding(
    request: CourseRequest,
    step: float,
    make: TurnMaker | None,
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
        for first in range(max(worst - length + 1, 0), min(worst, count - length) + 1):
            row = slice(first, first + length)
            before = request.circles[first - 1].place if first else complex(*request.start)
            part = replace(
                request,
                start=(before.real, before.imag),
                heading=None if first else request.heading,
                circles=request.circles[row],
                buoys=request.buoys[row],
            )
            if _planned(part, step, step, make, []) is None:
                return tuple(range(first + 1, first + length + 1))
    return ()


def _simplified(request: CourseRequest, sketch: Sketch) -> list[Sketch]:
    """Return an outline with turns joined that can be, and as it is."""
    short = _SHORT * request.turns.radius
    return [sketch.simplified(short, _SMALL), sketch.simplified(0.0, 1e-3)]


def _right(
    request: CourseRequest,
    fit: Fit,
    fitted: Fitted,
    step: float,
    reasons: list[tuple[float, int, str]],
) -> bool:
    """Return whether a course passes the check; where it does not, the reason is added.

    A reason is what is missed in m, the number of the buoy from 0, and the words for it.
    """
    if fitted.missed > _TOLERANCE * request.turns.radius:
        reasons.append((fitted.missed, fitted.worst, f"buoy {fitted.worst + 1}"))
        return False
    course = _sampled(fit.route, fitted.z, step, step)
    # to the end, between samples
    track = course.track[: math.ceil(course.length / step) + 1]
    radius = request.turns.radius
    wrong = first_fault(track, request.buoys, request.protocol, radius, fitted.missed)
    if wrong is not None:
        reasons.append((0.0, *wrong))
    return wrong is None


def _refusal(
    request: CourseRequest, reasons: Sequence[tuple[float, int, str]], rows: Sequence[int]
) -> str:
    if rows:
        *first, last = (str(number) for number in rows)
        return (
            f"no course found: buoys {', '.join(first)} and {last} exclude each other for this"
            " vessel's turns, even alone and begun at the one before them; move one, give them"
            " smaller circles, or allow more rudder"
        )
    advice = "move it, give it a smaller circle, or allow more rudder"
    if not reasons:
        return (
            f"no course found past the {len(request.circles)} buoys: circles leave no way between"
            f" them; {advice}"
        )
    missed, _, what = min(reasons)
    if missed > 0:
        what += (
            f": the best course found with this vessel's turns misses its circle by {missed:.3g} m"
        )
    return f"no course found: {what}; {advice}"


def _shape(sketch: Sketch) -> tuple[object, ...]:
    """Return what makes two outlines lead to the same course."""
    return (
        *(
            (bend.side, bend.table, bend.passed, round(bend.angle / (2.0 * math.pi)))
            for bend in sketch.bends
        ),
        sketch.passed,
    )


def _outline(
    request: CourseRequest, apart: Array, share: float, wide: float, rings: Sequence[float]
) -> Sketch | None:
    """Return the shortest outline for turns that need a share of their room.

    It keeps farther off circles, or reaches farther into them, by `apart` in m.
    """

    def room(number: int) -> Room:
        radius, before, behind = request.turns.tables[number].fitted
        return Room(wide * radius, share * before, share * behind)

    return Outlines(
        complex(*request.start),
        request.heading,
        [
            replace(circle, radius=max(circle.radius + (more if circle.side else -more), 0.0))
            for circle, more in zip(request.circles, apart, strict=True)
        ],
        room(0),
        [room(circle.table) for circle in request.circles],
        request.turns.radius,
        rings,
    ).find()


def _fitted(request: CourseRequest, sketch: Sketch) -> list[tuple[Fit, Fitted]]:
    """Return the fitted route of an outline, and the one of what is left of it when simplified."""
    found: list[tuple[Fit, Fitted]] = []
    radius = request.turns.radius
    for attempt in range(3):
        route = Route(
            complex(*request.start),
            tuple(bend.side for bend in sketch.bends),
            tuple(bend.table for bend in sketch.bends),
            request.turns,
        )
        at = route.place_of(sketch, np.array([circle.place for circle in request.circles]))
        fit = Fit(route, request.circles, at, request.heading is None, request.aside)
        z = route.begin(sketch)
        best = fit.solve(z)
        found.append((fit, best))
        if best.missed > _FAR * radius:
            break
        after = _drawn(request, route, best.z, fit, sketch).simplified(_SHORT * radius, _SMALL)
        if len(after.bends) == len(sketch.bends) or attempt == 2:
            break
        sketch = after
    return found


def _drawn(request: CourseRequest, route: Route, z: Array, fit: Fit, sketch: Sketch) -> Sketch:
    """Return the outline of a fitted route."""
    values, points = z * route.units, route(z).points
    legs = values[1::2].copy()
    passed: list[list[int]] = [[] for _ in legs]
    bent: list[list[int]] = [[] for _ in sketch.bends]
    for number, circle in enumerate(request.circles):
        part = fit.window(number, len(points))
        at = part.start + int(np.abs(points[part] - circle.place).argmin())
        k, inside = divmod(max(at - 1, 0), LEG + POINTS)
        (passed[k] if inside < LEG or k >= len(bent) else bent[k]).append(number)
    bends: list[Bend] = []
    for k, bend in enumerate(sketch.bends):
        table = request.turns.tables[bend.table]
        angle = float(np.interp(values[2 + 2 * k], table.holds, table.angles))
        _, before, behind = table.fitted
        share = min(angle / 0.8, 1.0)
        legs[k] += share * before
        legs[k + 1] += share * behind
        bends.append(replace(bend, angle=angle, passed=tuple(bent[k])))
    return Sketch(float(values[0]), tuple(legs), tuple(bends), tuple(map(tuple, passed)))


def _sampled(route: Route, z: Array, step: float, beyond: float) -> Course:
    """Return a route in even steps, with a straight line behind its end."""
    parts = route.sailed(z)
    end, level = parts[-1][0][-1], float(parts[-1][1][-1])
    track = np.concatenate([part[0] for part in parts])
    last = np.diff(track)[np.flatnonzero(np.abs(np.diff(track)) > 1e-9)[-1]]
    behind = np.array([end, end + beyond * last / abs(last)])
    parts.append((behind, np.full(2, level), 0.0))
    places, heading, rudder = (
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([np.full(len(part[0]), part[2]) for part in parts]),
    )
    # where parts meet, the rudder of the next one holds
    distinct: NDArray[np.bool_] = np.concatenate((np.abs(np.diff(places)) > 1e-9, [True]))
    places, heading, rudder = places[distinct], heading[distinct], rudder[distinct]
    along = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(places)))))
    at = step * np.arange(math.floor(along[-1] / step) + 1)
    points = np.stack(
        [np.interp(at, along, places.real), np.interp(at, along, places.imag)], axis=-1
    )
    direction = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    direction += 2.0 * math.pi * round((heading[0] - direction[0]) / (2.0 * math.pi))
    held = rudder[np.minimum(np.searchsorted(along, at, side="right") - 1, len(rudder) - 1)]
    return Course(
        step, points, direction, np.interp(at, along, heading), held, float(along[-1]) - beyond
    )
