"""The lengths of a route's legs and turns that make it quickest and keep it right.

What is asked of it has exact derivatives; sequential linear programs find the lengths.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

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
FARTHEST = 0.3
"""How much farther off than its circle a buoy may be passed, in turning radii."""


class Linear(NamedTuple):
    """A route at z as a linear problem, in turning radii and the time that one takes.

    Attributes:
        cost: the time, to make small.
        slope: derivatives [nz] of it.
        values: what must not be negative [m].
        rows: derivatives [m, nz] of these.
        price: of one that they are negative by [m].
        numbers: of the buoys that they are for [m].
        hard: how many of them, the first ones, a right course needs.
    """

    cost: float
    slope: Array
    values: Array
    rows: Array
    price: Array
    numbers: list[int]
    hard: int

    def merit(self) -> float:
        """Return the cost, and what is missed at its price."""
        return self.cost + float((self.price * np.maximum(-self.values, 0.0)).sum())

    def step(self, low: Array, high: Array) -> tuple[Array, float]:
        """Return the best step within bounds where all is linear, and the merit it promises."""
        # what cannot become negative within the bounds is left out
        kept = self.values < np.abs(self.rows) @ np.maximum(-low, high)
        rows, values = self.rows[kept], self.values[kept]
        size, count = len(low), len(values)
        # its types know no sparse arrays
        solve: Any = linprog
        found = solve(
            np.concatenate((self.slope, self.price[kept])),
            sparse.hstack((sparse.csr_array(-rows), -sparse.eye_array(count))) if count else None,
            values if count else None,
            bounds=np.concatenate(
                (np.stack((low, high), axis=-1), np.tile([0.0, np.inf], (count, 1)))
            ),
            method="highs",
        )
        if found.x is None:
            return np.zeros(size), 0.0
        return found.x[:size], self.merit() - self.cost - float(found.fun)


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
        self.price, self.effort = _PRICE, 0
        self.seen: tuple[Array, Linear] | None = None
        self.near: tuple[Array, float] | None = None

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

    def linear(self, z: Array) -> Linear:
        """Return the problem as it is linear at z."""
        if self.seen is not None and np.array_equal(self.seen[0], z):
            return self.seen[1]
        drawn = self.route(z)
        self.effort += 1
        goal, number = self.circles[-1], len(self.circles)
        asked: list[tuple[int, float, Array]] = []
        near = self._nearest(drawn, self._parts(drawn.points))
        # on the wrong side, distances are negative
        entered, side = self.sides == 0, self.sides[:, None]
        own = np.where(entered, near.distance[:number], self.sides * near.abeam[:number])
        change = np.where(side == 0, near.change[:number], side * near.swing[:number])
        for j, circle in enumerate(self.circles):
            if circle.side == 0:
                asked.append((j, circle.radius - own[j], -change[j]))
            else:
                beyond = circle.radius + FARTHEST * self.unit - own[j]
                asked += [(j, own[j] - circle.radius, change[j]), (j, beyond, -change[j])]
        for k, (j, _, _) in enumerate(self.others, start=number):
            asked.append((j, near.distance[k] - self.circles[j].radius, near.change[k]))
        if goal.side != 0:
            # the end lies neither before nor behind the last buoy
            along = np.exp(1j * drawn.heading)
            left = (goal.place - drawn.points[-1]) * along.conjugate()
            moved = drawn.moved(np.array([len(drawn.points) - 1]))[0]
            level = -(moved * along.conjugate()).real + left.imag * drawn.turned
            asked += [(number - 1, left.real, level), (number - 1, -left.real, -level)]
        hard = len(asked)
        for k, (j, i, _) in enumerate(self.others, start=number):
            if i != j:
                # where it lies on its side too, a buoy may be as near
                apart = self.apart[j] if near.abeam[k] * self.circles[j].side < 0 else 0.0
                asked.append((j, near.distance[k] - own[j] - apart, near.change[k] - change[j]))
        time = self.unit / self.route.turns.speed
        found = Linear(
            drawn.time / time,
            drawn.slower / time,
            np.array([value for _, value, _ in asked]) / self.unit,
            np.array([row for _, _, row in asked]).reshape(-1, len(z)) / self.unit,
            np.where(np.arange(len(asked)) < hard, _DEAR, self.price),
            [j for j, _, _ in asked],
            hard,
        )
        self.seen = z.copy(), found
        return found

    def bounds(self) -> tuple[Array, Array]:
        """Return the smallest and the largest z."""
        least, most = self.route.least(), self.route.most()
        if self.near is None:
            return least, most
        z, reach = self.near
        return np.maximum(least, z - reach), np.minimum(most, z + reach)

    def look(self, z: Array) -> None:
        """Look anew which parts of the course come near which buoys."""
        self.seen = None
        self.watch(z)

    def missed(self, z: Array) -> tuple[float, int]:
        """Return by how much a route misses what is asked of it, in m, and at which buoy."""
        here = self.linear(z)
        short = np.maximum(-here.values[: here.hard], 0.0)
        worst = int(short.argmax())
        return self.unit * float(short[worst]), here.numbers[worst]

    def alone(self, z: Array, reach: float | None = None) -> Fitted:
        """Return the route that is found where buoys are hardly approached out of their turns."""
        self.price = _DEAR
        return self.solve(z, reach)

    def solve(self, z: Array, reach: float | None = None) -> Fitted:
        """Return the route that is found from a start, not farther from it than a reach of z."""
        self.near = None if reach is None else (z, reach)
        z = self._descended(np.clip(z, *self.bounds()))
        missed, worst = self.missed(z)
        return Fitted(z, self.linear(z).cost * self.unit / self.route.turns.speed, missed, worst)

    def _descended(self, z: Array) -> Array:
        """Return the z of least merit near a start.

        A step solves the problem as it is linear there, within a reach that follows how well this
        holds. What is asked may be missed by a step, so that there always is one. Where the problem
        bends too much for a step, it is corrected once for what that step has missed.
        """
        reach, (least, most) = _REACH[1], self.bounds()
        self.look(z)
        here = self.linear(z)

        def tried(step: Array) -> tuple[Array, Linear, float]:
            after = np.clip(z + step, least, most)
            there = self.linear(after)
            return after, there, here.merit() - there.merit()

        for number in range(1, _ROUNDS + 1):
            if number % _LOOKED == 0:
                self.look(z)
                here = self.linear(z)
            low, high = np.maximum(least - z, -reach), np.minimum(most - z, reach)
            if not self.free:
                low[0] = high[0] = 0.0
            step, promised = here.step(low, high)
            if promised < _SETTLED:
                break
            after, there, gained = tried(step)
            if gained < _HELD[0] * promised:
                bent = here._replace(values=there.values - here.rows @ (after - z))
                other = tried(bent.step(low, high)[0])
                if other[2] > gained:
                    after, there, gained = other
            size = float(np.abs(after - z).max())
            if gained > _HELD[0] * promised:
                z, here = after, there
            if gained < _HELD[1] * promised:
                reach = 0.4 * min(reach, size)
            elif gained > _HELD[2] * promised:
                reach = min(2.0 * reach, _REACH[2])
            if reach < _REACH[0]:
                break
        self.look(z)
        return z
