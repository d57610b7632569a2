"""The lengths of a route's legs and turns that make it quickest and keep it right.

What is asked of it, with exact derivatives; `descent` solves it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog, minimize

from residnet.control.courses.course_check import left_behind
from residnet.control.courses.outline import Circle
from residnet.control.courses.turns import LEG, POINTS, Array, Drawn, Route

_ROUNDS = 45
"""Most steps of a fit; those that settle take far fewer."""
_LOOKED = 8
"""Steps after which the problem looks anew what it has to keep to."""
_SETTLED = 2e-2
"""Gain that a step promises below which none is made."""
_REACH = (5e-4, 0.3, 1.0)
"""Least, first and largest reach of a step."""
_HELD = (0.05, 0.3, 0.7)
"""Shares of the promised gain: from which a step is made, shortened below, lengthened above."""

_BENT = (0.5, 25)
"""Largest reach of all steps of quadratic programs, and how many there are at most."""


class Linear(NamedTuple):
    """A problem at z, and how it changes with it.

    Attributes:
        cost: to make small.
        slope: derivatives [nz] of it.
        values: what must not be negative [m].
        rows: derivatives [m, nz] of these.
        price: of one that they are negative by [m].
        even: what must vanish [e].
        level: derivatives [e, nz] of these.
        dear: price of one that they differ from zero by.
        fixed: which of z stay [nz].
    """

    cost: float
    slope: Array
    values: Array
    rows: Array
    price: Array
    even: Array
    level: Array
    dear: float
    fixed: NDArray[np.bool_]

    def merit(self) -> float:
        """Return the cost, and what is missed at its price."""
        missed = float((self.price * np.maximum(-self.values, 0.0)).sum())
        return self.cost + missed + self.dear * float(np.abs(self.even).sum())


class Problem(Protocol):
    """A smooth cost over z [nz] with bounds, equations, and values that must not be negative."""

    def least(self) -> Array:
        """Return the smallest z [nz]."""

    def most(self) -> Array:
        """Return the largest z [nz]."""

    def linear(self, z: Array) -> Linear:
        """Return the problem as it is linear at z."""

    def look(self, z: Array) -> None:
        """Look anew what must not be negative near z."""


def descend(problem: Problem, z: Array) -> Array:
    """Return the z of least merit near a start.

    A step solves the problem as it is linear there, within a reach that follows how well this
    holds. What is asked may be missed by a step, so that there always is one. Where the problem
    bends too much for a step, it is corrected once for what that step has missed.
    """
    reach, least, most = _REACH[1], problem.least(), problem.most()
    problem.look(z)
    here = problem.linear(z)
    for number in range(1, _ROUNDS + 1):
        if number % _LOOKED == 0:
            problem.look(z)
            here = problem.linear(z)
        low, high = np.maximum(least - z, -reach), np.minimum(most - z, reach)
        low[here.fixed] = high[here.fixed] = 0.0
        step, promised = _step(here, low, high)
        if promised < _SETTLED:
            break
        after, there, gained = _tried(problem, here, z, step)
        if gained < _HELD[0] * promised:
            bent = here._replace(
                values=there.values - here.rows @ (after - z),
                even=there.even - here.level @ (after - z),
            )
            corrected, _ = _step(bent, low, high)
            other, elsewhere, more = _tried(problem, here, z, corrected)
            if more > gained:
                after, there, gained = other, elsewhere, more
        size = float(np.abs(after - z).max())
        if gained > _HELD[0] * promised:
            z, here = after, there
        if gained < _HELD[1] * promised:
            reach = 0.4 * min(reach, size)
        elif gained > _HELD[2] * promised:
            reach = min(2.0 * reach, _REACH[2])
        if reach < _REACH[0]:
            break
    problem.look(z)
    return z


def polished(problem: Problem, z: Array) -> Array:
    """Return the z of least cost near an end of `descend`, or that end where none is found.

    Linear programs creep where less is asked than z has parts, because the cost bends there.
    Quadratic ones (SLSQP) see the bend. What is far from being missed is left out.
    """
    first = problem.linear(z)
    low = np.maximum(problem.least(), z - _BENT[0])
    high = np.minimum(problem.most(), z + _BENT[0])
    low[first.fixed] = high[first.fixed] = z[first.fixed]
    kept = first.values < np.abs(first.rows).max(axis=1, initial=0.0) * _BENT[0]
    conditions: list[Any] = [
        {
            "type": "ineq",
            "fun": lambda x: problem.linear(x).values[kept],
            "jac": lambda x: problem.linear(x).rows[kept],
        }
    ]
    if len(first.even):
        conditions.append(
            {
                "type": "eq",
                "fun": lambda x: problem.linear(x).even,
                "jac": lambda x: problem.linear(x).level,
            }
        )
    # its types know no conditions with derivatives
    solve: Any = minimize
    found = solve(
        lambda x: (problem.linear(x).cost, problem.linear(x).slope),
        z,
        jac=True,
        method="SLSQP",
        bounds=np.stack((low, high), axis=-1),
        constraints=conditions,
        options={"maxiter": _BENT[1], "ftol": 1e-4},
    )
    after = np.clip(found.x, low, high)
    better = problem.linear(after).merit() < first.merit()
    problem.look(after if better else z)
    return after if better else z


def _tried(problem: Problem, here: Linear, z: Array, step: Array) -> tuple[Array, Linear, float]:
    """Return where a step leads to, the problem there, and the merit gained."""
    after = np.clip(z + step, problem.least(), problem.most())
    there = problem.linear(after)
    return after, there, here.merit() - there.merit()


def _step(here: Linear, low: Array, high: Array) -> tuple[Array, float]:
    """Return the best step within bounds where all is linear, and the merit that it promises."""
    # what cannot become negative within the bounds is left out
    kept = here.values < np.abs(here.rows) @ np.maximum(-low, high)
    rows, values = here.rows[kept], here.values[kept]
    size, count, both = len(low), len(values), len(here.even)
    upper = sparse.hstack(
        (sparse.csr_array(-rows), -sparse.eye_array(count), sparse.csr_array((count, 2 * both)))
    )
    one = sparse.eye_array(both)
    equal = sparse.hstack(
        (sparse.csr_array(here.level), sparse.csr_array((both, count)), one, -one)
    )
    missed = np.tile([0.0, np.inf], (count + 2 * both, 1))
    # its types know no sparse arrays
    solve: Any = linprog
    found = solve(
        np.concatenate((here.slope, here.price[kept], np.full(2 * both, here.dear))),
        upper if count else None,
        values if count else None,
        equal if both else None,
        -here.even if both else None,
        np.concatenate((np.stack((low, high), axis=-1), missed)),
        method="highs",
    )
    if found.x is None:
        return np.zeros(size), 0.0
    return found.x[:size], here.merit() - here.cost - float(found.fun)


_DEAR = 40.0
"""Turning radii that a course may be longer by to miss what is asked by one less."""
_PRICE = 4.0
"""The same where a buoy's own turn is not to be the only one that comes as near."""
_APART = 0.03
"""Turning radii by which a buoy is farther off on the rest of the course than in its turn."""
_ABEAM = 0.3
"""Sine of the angle from ahead or astern below which a buoy is not yet on a side."""
_NEAR, _BESIDE = 2.0, 0.7
"""Turning radii from a circle within which other parts of the course, and the buoy's own turn, are
kept an eye on.
"""
_SHARES = 4
"""Pieces of a turn that keep to circles each for itself."""
_CLOSE = 0.02
"""Turning radii that a route may miss by to be improved further."""
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
    """The nearest points of M parts of a route to a buoy each.

    Attributes:
        distance: [M] in m.
        change: derivatives [M, nz] of the distances.
        abeam: [M] the same, positive to starboard and negative to port. It goes through zero
            where the buoy comes to lie ahead or astern of the end of a part.
        swing: derivatives [M, nz] of that.
    """

    distance: Array
    change: Array
    abeam: Array
    swing: Array


@final
class Fit:
    """A route past circles as a problem of least time.

    Args:
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
        self.places = np.array([circle.place for circle in circles])
        self.sides = np.array([circle.side for circle in circles])
        self.unit = route.turns.radius
        middle = (at[1:] + at[:-1] + 1) // 2
        self.edges = np.concatenate(([0], middle, [-1]))
        self.others: list[tuple[int, int, slice]] = []
        self.apart = [self._apart(circle) for circle in circles]
        self.hard, self.price, self.effort = 0, _PRICE, 0
        self.seen: Array | None = None
        self.near: tuple[Array, float] | None = None
        self.last: _Results

    def on(self, route: Route) -> Fit:
        """Return the same problem with other tables of turns."""
        at = np.zeros(len(self.circles), dtype=np.intp)
        other = Fit(route, self.circles, at, self.free, self.aside)
        other.edges, other.price = self.edges, self.price
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
        """Choose which pieces of the course must keep clear of which buoys."""
        drawn = self.route(z)
        points, self.others = drawn.points, []
        # of a whole turn about a buoy, the nearest point jumps from its beginning to its end
        count = len(points)
        cuts = {0, count - 1, *range(LEG, count, LEG + POINTS)}
        for k in range(_SHARES):
            cuts |= set(range(LEG + k * POINTS // _SHARES, count, LEG + POINTS))
        turns = [self.window(number, count) for number in range(len(self.circles))]
        pieces = []
        for i, turn in enumerate(turns):
            inside = sorted({turn.start, turn.stop - 1, *cuts} & set(range(turn.start, turn.stop)))
            pieces += [(i, slice(one, two + 1)) for one, two in itertools.pairwise(inside)]
        right = self.sides * self._nearest(drawn, self._parts(points)).abeam > 0
        for j, circle in enumerate(self.circles):
            if circle.side == 0:
                continue
            begin, distance = self._left(points, circle), np.abs(points - circle.place)
            self.others += [
                (j, i, part)
                for i, part in pieces
                # from the wrong side the way to the right one leads through the circle
                if (i != j or right[j])
                and part.stop - max(part.start, begin) > 1
                and distance[max(part.start, begin) : part.stop].min()
                < circle.radius + (_BESIDE if i == j else _NEAR) * self.unit
            ]

    def _left(self, points: np.ndarray, circle: Circle) -> int:
        """Return the point from which a circle counts: `course_check.left_behind`."""
        if circle.side == 0 or abs(circle.place - points[0]) >= circle.radius:
            return 0
        return min(left_behind(np.abs(points - circle.place), circle.radius), len(points) - 2)

    def _parts(self, points: np.ndarray) -> list[tuple[int, slice]]:
        """Return the circles and the parts of the course that keep to them: own turns first."""
        count, last = len(points), len(self.circles) - 1
        left = [self._left(points, circle) for circle in self.circles]
        found: list[tuple[int, slice]] = []
        for j, circle in enumerate(self.circles):
            part = self.window(j, count)
            found.append((j, slice(count - 2, count) if j == last and circle.side == 0 else part))
        found += [(j, part) for j, _, part in self.others]
        return [
            (j, slice(max(part.start, min(left[j], part.stop - 2)), part.stop)) for j, part in found
        ]

    def _nearest(self, drawn: Drawn, parts: Sequence[tuple[int, slice]]) -> _Near:
        """Return the points of parts of the course that are nearest to the middle of circles."""
        piece = np.diff(drawn.points)
        away = self.places[:, None] - drawn.points[:-1]
        share = (away * piece.conj()).real / np.maximum(np.abs(piece) ** 2, 1e-12)
        share = np.clip(share, 0.0, 1.0)
        offset = away - share * piece
        distances = np.abs(offset)
        which = np.array([j for j, _ in parts])
        at = np.array(
            [part.start + distances[j, part.start : part.stop - 1].argmin() for j, part in parts]
        )
        near, distance, offset = share[which, at][:, None], distances[which, at], offset[which, at]
        begin, end = drawn.moved(at), drawn.moved(at + 1)
        shift = (1.0 - near) * begin + near * end
        outward = offset / np.maximum(distance, 1e-9)
        change = -(shift * outward.conj()[:, None]).real
        size = np.maximum(np.abs(piece[at]), 1e-9)
        back = (piece[at] / size).conj()
        across = (back * offset).imag / _ABEAM
        rotated = (back[:, None] * (end - begin)).imag / size[:, None]
        swing = -((back[:, None] * shift).imag + (back * offset).real[:, None] * rotated) / _ABEAM
        ahead = np.abs(across) < distance
        sign = np.where(across >= 0, 1.0, -1.0)
        return _Near(
            distance,
            change,
            np.where(ahead, across, sign * distance),
            np.where(ahead[:, None], swing, sign[:, None] * change),
        )

    def results(self, z: Array) -> _Results:
        """Return the time, what must not be negative, what must vanish, and their derivatives."""
        if self.seen is not None and np.array_equal(self.seen, z):
            return self.last
        drawn = self.route(z)
        self.effort += 1
        goal, number = self.circles[-1], len(self.circles)
        far, values, rows = FARTHEST * self.unit, [], []
        near = self._nearest(drawn, self._parts(drawn.points))
        # on the wrong side, distances are negative
        entered, side = self.sides == 0, self.sides[:, None]
        own = np.where(entered, near.distance[:number], self.sides * near.abeam[:number])
        change = np.where(side == 0, near.change[:number], side * near.swing[:number])
        for j, circle in enumerate(self.circles):
            if circle.side == 0:
                values.append(circle.radius - own[j])
                rows.append(-change[j])
            else:
                values += [own[j] - circle.radius, circle.radius + far - own[j]]
                rows += [change[j], -change[j]]
        for k, (j, _, _) in enumerate(self.others, start=number):
            values.append(near.distance[k] - self.circles[j].radius)
            rows.append(near.change[k])
        self.hard = len(values)
        for k, (j, i, _) in enumerate(self.others, start=number):
            if i != j:
                # where it lies on its side too, a buoy may be as near
                apart = self.apart[j] if near.abeam[k] * self.circles[j].side < 0 else 0.0
                values.append(near.distance[k] - own[j] - apart)
                rows.append(near.change[k] - change[j])
        even, level = [], []
        if goal.side != 0:
            along = np.exp(1j * drawn.heading)
            left = (goal.place - drawn.points[-1]) * along.conjugate()
            moved = drawn.moved(np.array([len(drawn.points) - 1]))[0]
            even.append(left.real)
            level.append(-(moved * along.conjugate()).real + left.imag * drawn.turned)
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

    def least(self) -> Array:
        """Return the smallest z."""
        least = self.route.least()
        return least if self.near is None else np.maximum(least, self.near[0] - self.near[1])

    def most(self) -> Array:
        """Return the largest z."""
        most = self.route.most()
        return most if self.near is None else np.minimum(most, self.near[0] + self.near[1])

    def linear(self, z: Array) -> Linear:
        """Return the problem as it is linear at z."""
        time, slower, values, rows, even, level, _ = self.results(z)
        price = np.full(len(values), self.price)
        price[: self.hard] = _DEAR
        fixed = np.zeros(len(z), dtype=bool)
        fixed[0] = not self.free
        return Linear(time, slower, values, rows, price, even, level, _DEAR, fixed)

    def look(self, z: Array) -> None:
        """Look anew which parts of the course come near which buoys."""
        self.seen = None
        self.watch(z)

    def missed(self, z: Array) -> tuple[float, int]:
        """Return by how much a route misses what is asked of it, in m, and at which buoy."""
        _, _, values, _, even, _, _ = self.results(z)
        numbers = [
            *(j for j, circle in enumerate(self.circles) for _ in range(1 + abs(circle.side))),
            *(j for j, _, _ in self.others),
        ]
        short = np.maximum(-values[: self.hard], 0.0)
        worst = int(short.argmax())
        if len(even) and abs(even[0]) > short[worst]:
            return self.unit * float(abs(even[0])), len(self.circles) - 1
        return self.unit * float(short[worst]), numbers[worst]

    def alone(self, z: Array, reach: float | None = None) -> Fitted:
        """Return the route that is found where buoys are hardly approached out of their turns."""
        self.price = _DEAR
        return self.solve(z, reach)

    def solve(self, z: Array, reach: float | None = None) -> Fitted:
        """Return the route that is found from a start, not farther from it than a reach of z."""
        self.near = None if reach is None else (z, reach)
        z = descend(self, np.clip(z, self.least(), self.most()))
        if self.missed(z)[0] <= _CLOSE * self.unit:
            z = polished(self, z)
        missed, worst = self.missed(z)
        return Fitted(z, self.results(z)[0] * self.unit / self.route.turns.speed, missed, worst)
