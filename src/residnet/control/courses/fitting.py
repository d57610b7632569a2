"""The lengths of a route's legs and turns that make it quickest and keep it right.

Sequential quadratic programming with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, minimize

from residnet.control.courses.course_check import left_behind
from residnet.control.courses.outline import Circle
from residnet.control.courses.route import Drawn, Route
from residnet.control.courses.turns import Array

_ROUNDS = 40
_QUICKER = 3
"""Searches for a quicker course, each from what the one before has found."""
_WEIGHT = 0.3
_SETTLED = 1e-3
_BOX = 2.0
"""By which legs and holds may change in a search, in turning radii and the time for one."""
_ASIDE = 1.0
"""By which the first heading may be changed, in rad."""
_APART = 0.03
"""Turning radii by which a buoy is farther off on the rest of the course than in its turn."""
_NEAR = 3.0
"""Turning radii from a circle within which a part of the course is kept an eye on."""
FARTHEST = 0.3
"""How much farther off than its circle a buoy may be passed, in turning radii."""


_Results = tuple[float, Array, Array, Array, Array, Array, np.ndarray]


class Fitted(NamedTuple):
    """A fitted route: z, the time in s, and by how much it misses what is asked, in m."""

    z: Array
    time: float
    missed: float
    worst: int


class _Near(NamedTuple):
    """The point of a part of a route that is nearest to a buoy: distance, sign, derivatives."""

    distance: float
    sign: float
    change: Array


@final
class Fit:
    """A route past circles as a problem of least time.

    Args:
        route: as a function of z.
        circles: in their order.
        at: points of the route [N] at which each is passed.
        free: whether the first heading is free.
        aside: by how much in m the vessel may be displaced from the course; a buoy is farther off
            by as much on the rest of the course than in its turn.
    """

    def __init__(
        self,
        route: Route,
        circles: Sequence[Circle],
        at: NDArray[np.intp],
        free: bool,
        aside: float = 0.0,
    ) -> None:
        self.route, self.circles, self.free, self.aside = route, circles, free, aside
        self.unit = route.turns.radius
        middle = (at[1:] + at[:-1] + 1) // 2
        self.edges = np.concatenate(([0], middle, [-1]))
        self.others: list[tuple[int, int]] = []
        self.apart = [self._apart(circle) for circle in circles]
        self.seen: Array | None = None
        self.last: _Results

    def on(self, route: Route) -> Fit:
        """Return the same problem with other tables of turns."""
        at = np.zeros(len(self.circles), dtype=np.intp)
        other = Fit(route, self.circles, at, self.free, self.aside)
        other.edges = self.edges
        return other

    def _apart(self, circle: Circle) -> float:
        """Return by how much farther a buoy is on the rest of the course, as its start allows."""
        room = abs(circle.place - self.route.start) - circle.radius
        apart = _APART * self.unit + self.aside
        return apart if room < 0 else min(apart, 0.5 * room)

    def window(self, number: int, count: int) -> slice:
        """Return the points of a buoy's turn."""
        low = int(self.edges[number])
        high = count if number == len(self.circles) - 1 else int(self.edges[number + 1]) + 1
        return slice(min(low, count - 2), max(high, min(low, count - 2) + 2))

    def watch(self, z: Array) -> None:
        """Choose which parts of the course must keep clear of buoys that are passed elsewhere."""
        points = self.route(z).points
        self.others = []
        for j, circle in enumerate(self.circles):
            if circle.side == 0:
                continue
            begin = self._left(points, circle)
            for i in range(len(self.circles)):
                part = self.window(i, len(points))
                part = slice(max(part.start, begin), part.stop)
                if i == j or part.stop - part.start < 2:
                    continue
                nearest = np.abs(points[part] - circle.place).min()
                if nearest < circle.radius + _NEAR * self.unit:
                    self.others.append((j, i))

    def _left(self, points: np.ndarray, circle: Circle) -> int:
        """Return the point from which a circle counts: `course_check.left_behind`."""
        if circle.side == 0:
            return 0
        return min(left_behind(np.abs(points - circle.place), circle.radius), len(points) - 2)

    def _nearest(self, drawn: Drawn, circle: Circle, part: slice) -> _Near:
        """Return the point of a part of the course that is nearest to a circle's middle."""
        points = drawn.points[part]
        begin, piece = points[:-1], np.diff(points)
        away = circle.place - begin
        share = np.clip(
            (away * piece.conj()).real / np.maximum(np.abs(piece) ** 2, 1e-12), 0.0, 1.0
        )
        offset = away - share * piece
        near = int(np.abs(offset).argmin())
        distance = float(np.abs(offset[near]))
        moved = drawn.moved[part][near : near + 2]
        shift = (1.0 - share[near]) * moved[0] + share[near] * moved[1]
        outward = offset[near] / max(distance, 1e-9)
        change = -(shift * outward.conjugate()).real
        sign = 1.0 if (piece[near].conjugate() * offset[near]).imag >= 0 else -1.0
        return _Near(distance, sign, change)

    def results(self, z: Array) -> _Results:
        """Return the time, what must not be negative, what must vanish, and their derivatives."""
        if self.seen is not None and np.array_equal(self.seen, z):
            return self.last
        drawn = self.route(z)
        count, goal = len(drawn.points), self.circles[-1]
        far, values, rows = FARTHEST * self.unit, [], []
        own: list[tuple[float, Array]] = []
        for j, circle in enumerate(self.circles):
            part = self.window(j, count)
            if circle.side == 0 and j == len(self.circles) - 1:
                part = slice(count - 2, count)
            if circle.side != 0:
                begin = min(self._left(drawn.points, circle), part.stop - 2)
                part = slice(max(part.start, begin), part.stop)
            near = self._nearest(drawn, circle, part)
            if circle.side == 0:
                values.append(circle.radius - near.distance)
                rows.append(-near.change)
                own.append((near.distance, near.change))
            else:
                sign = near.sign * circle.side
                own.append((sign * near.distance, sign * near.change))
                values += [own[-1][0] - circle.radius, circle.radius + far - own[-1][0]]
                rows += [own[-1][1], -own[-1][1]]
        for j, i in self.others:
            part = self.window(i, count)
            begin = min(self._left(drawn.points, self.circles[j]), part.stop - 2)
            part = slice(max(part.start, begin), part.stop)
            near = self._nearest(drawn, self.circles[j], part)
            # next to its own turn the course comes from there
            apart = 0.0 if abs(i - j) <= 1 else self.apart[j]
            values.append(near.distance - max(own[j][0], self.circles[j].radius) - apart)
            rows.append(near.change - (own[j][1] if own[j][0] > self.circles[j].radius else 0.0))
        even, level = [], []
        if goal.side != 0:
            along = np.exp(1j * drawn.heading)
            left = (goal.place - drawn.points[-1]) * along.conjugate()
            even.append(left.real)
            level.append(-(drawn.moved[-1] * along.conjugate()).real + left.imag * drawn.turned)
        unit, time = self.unit, self.unit / self.route.turns.speed
        size = len(z)
        self.last = (
            drawn.time / time,
            drawn.slower / time,
            np.array(values) / unit,
            np.array(rows).reshape(-1, size) / unit,
            np.array(even) / unit,
            np.array(level).reshape(-1, size) / unit,
            drawn.points,
        )
        self.seen = z.copy()
        return self.last

    def missed(self, z: Array) -> tuple[float, int]:
        """Return by how much a route misses what is asked of it, in m, and at which buoy."""
        _, _, values, _, even, _, _ = self.results(z)
        numbers = [
            *(j for j, circle in enumerate(self.circles) for _ in range(1 + abs(circle.side))),
            *(j for j, _ in self.others),
        ]
        short = np.maximum(-values, 0.0)
        worst = int(short.argmax())
        if len(even) and abs(even[0]) > short[worst]:
            return self.unit * float(abs(even[0])), len(self.circles) - 1
        return self.unit * float(short[worst]), numbers[worst]

    def solve(self, z: Array) -> Fitted:
        """Return the route that is found from a start: the nearest right one, then the quickest.

        Each search keeps near where it begins, since the course shall keep its shape.
        """
        z = self._search(z, 0.0)
        if self.missed(z)[0] <= self.unit:
            for _ in range(_QUICKER):
                before = self.results(z)[0]
                z = self._search(z, _WEIGHT)
                if self.results(z)[0] > (1.0 - _SETTLED) * before:
                    break
        missed, worst = self.missed(z)
        return Fitted(z, self.results(z)[0] * self.unit / self.route.turns.speed, missed, worst)

    def _search(self, begin: Array, weight: float) -> Array:
        """Return the z that is found within a box; `weight` 0 for the nearest right one."""
        self.seen = None
        self.watch(begin)
        least = np.maximum(begin - _BOX, self.route.least())
        most = np.minimum(begin + _BOX, self.route.most())
        aside = _ASIDE if self.free else 0.0
        least[0], most[0] = begin[0] - aside, begin[0] + aside
        begin = np.clip(begin, least, most)

        def aim(z: Array) -> float:
            if weight > 0:
                return weight * self.results(z)[0]
            return 0.5 * float(((z - begin) ** 2).sum())

        def slope(z: Array) -> Array:
            return weight * self.results(z)[1] if weight > 0 else z - begin

        constraints = [
            {
                "type": "ineq",
                "fun": lambda z: self.results(z)[2],
                "jac": lambda z: self.results(z)[3],
            }
        ]
        if self.circles[-1].side != 0:
            constraints.append(
                {
                    "type": "eq",
                    "fun": lambda z: self.results(z)[4],
                    "jac": lambda z: self.results(z)[5],
                }
            )
        # its types know no constraints with Jacobians
        solve: Any = minimize
        result = solve(
            aim,
            begin,
            jac=slope,
            method="SLSQP",
            bounds=Bounds(least, most),
            constraints=constraints,
            options={"maxiter": _ROUNDS, "ftol": 1e-5 * (weight or 1.0)},
        )
        z: Array = np.clip(result.x, least, most)
        if (
            not np.isfinite(z).all()
            or self.missed(begin)[0] <= self.missed(z)[0] - 1e-3 * self.unit
        ):
            z = begin
        self.seen = None
        self.watch(z)
        return z
