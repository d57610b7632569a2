"""Turns as a vessel makes them: rudder held, counter-rudder until the yaw stops, amidships.

They begin with any motion. Tables hold those from straight ahead to straight ahead by how long the
rudder is held, and routes join them by straight legs. Positions in tables are complex, north + i
east in m.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from residnet.control.heading.turning import Turning
from residnet.control.heading.vessels import SteeredVessel
from residnet.dynamics.rollout import Rollout

Array = NDArray[np.float64]
_COUNTER = 1.5
"""Time constants within which counter-rudder stops a turn; T ln 2 by Nomoto's model."""
_STEPS = (0.25, 6)
"""Longest step of simulated turns in time constants, and how often it is halved at most."""
_ALIKE = 1e-3
"""Turning radii, and rad, by which a turn may differ from one simulated with half the step."""


@dataclass(frozen=True)
class Turn:
    """A turn from the origin, heading north at first, and the leg behind it.

    The rudder is amidships on the leg.

    Attributes:
        rudder: angle held in rad, positive to starboard; then the same to the other side.
        hold: for how long, in s.
        lasts: until the counter-rudder ends and the leg begins, in s.
        held, countered, leg: states of the vessel [nx] by the time in s since the rudder was laid,
            since the counter-rudder was, and since the leg began.
        columns: of north, east and heading in those.
    """

    rudder: float
    hold: float
    lasts: float
    held: PPoly
    countered: PPoly
    leg: PPoly
    columns: tuple[int, int, int]

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return the track [M, 2] and heading [M] of the turn at times [M] in s."""
        first = (times <= self.hold)[:, None]
        after = self.countered(np.maximum(times - self.hold, 0.0))
        return self._moved(np.where(first, self.held(np.minimum(times, self.hold)), after))

    def along(self, times: Array) -> tuple[Array, Array]:
        """Return the track [M, 2] and heading [M] of the leg at times [M] in s since it began."""
        return self._moved(self.leg(times))

    def _moved(self, states: Array) -> tuple[Array, Array]:
        return states[:, list(self.columns[:2])], states[:, self.columns[2]]


@final
class TurnMaker:
    """Simulated turns of the nominal vessel: rudder held, counter-rudder, rudder amidships.

    The three follow from simulations that begin where they do, so that what comes of a turn changes
    smoothly with its time.

    Args:
        dt: step of the simulations in s, shorter while a steering gear moves the rudder.
    """

    def __init__(self, vessel: SteeredVessel, turning: Turning, dt: float) -> None:
        self.vessel, self.turning, self.dt = vessel, turning, dt
        self.columns = (vessel.column("x"), vessel.column("y"), vessel.column("psi"))
        self.loops: dict[float, Rollout] = {}
        x, self.inputs = vessel.start(torch.ones(1, dtype=torch.float64))
        self.straight: Array = x[0].numpy()

    def __call__(
        self, holds: Array, rudder: Array, begin: Sequence[Array], leg: float
    ) -> list[list[Turn]]:
        """Return the turns of n rudder angles, each held for K times.

        Args:
            holds: [n, K] in s.
            rudder: [n] in rad, positive to starboard.
            begin: state [nx] that each begins with; its place and heading do not matter.
            leg: how much of the leg behind is simulated, in s.
        """
        n, k = holds.shape
        x = np.stack(begin)
        x[:, list(self.columns)] = 0.0
        largest = float(np.abs(rudder).max())
        held = self._phase(x, rudder, float(holds.max()), 2.0 * largest)
        rows = np.repeat(np.arange(n), k)
        countered = self._phase(
            _of_rows(held, holds.ravel(), rows),
            -rudder[rows],
            _COUNTER * self.turning.time,
            2.0 * largest,
        )
        stops = self._stops(countered, np.sign(rudder)[rows])
        every = np.arange(n * k)
        behind = self._phase(_of_rows(countered, stops, every), np.zeros(n * k), leg, largest)
        turns = [
            Turn(
                float(rudder[row]),
                float(hold),
                float(hold + stop),
                _of_row(held, int(row)),
                _of_row(countered, number),
                _of_row(behind, number),
                self.columns,
            )
            for number, (row, hold, stop) in enumerate(zip(rows, holds.ravel(), stops, strict=True))
        ]
        return [turns[k * i : k * i + k] for i in range(n)]

    def _phase(self, x: Array, rudder: Array, duration: float, swing: float) -> CubicSpline:
        """Return the states [B, nx] by the time from x [B, nx] on, under rudder angles [B].

        `swing` is what the rudder moves by at most, in rad.
        """
        w = self.inputs.unsqueeze(1).repeat(len(x), 1, 1)
        w[:, 0, 0] = torch.from_numpy(rudder)
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(x), -1)
        at, parts = [np.zeros(1)], [torch.from_numpy(x).unsqueeze(1)]
        found, rest = [], max(duration, 3.0 * self.dt)
        if self.vessel.rate is not None:
            moving = swing / self.vessel.rate
            # the rudder moves between steps, and lags behind by half of one
            fine = min(self.dt, 4.0 * _ALIKE / (self.turning.gain * swing))
            count = math.ceil(min(1.1 * moving, rest) / fine)
            found, rest = [(fine, count)], rest - count * fine
        for dt, count in [*found, (self.dt, math.ceil(rest / self.dt))] if rest > 0 else found:
            if dt not in self.loops:
                self.loops[dt] = Rollout(self.vessel.model(dt))
            with torch.no_grad():
                states, _, _ = self.loops[dt](parts[-1][:, -1], w.expand(-1, count, -1), nominal)
            parts.append(states[:, 1:])
            at.append(at[-1][-1] + dt * np.arange(1, count + 1))
        return CubicSpline(np.concatenate(at), torch.cat(parts, dim=1).transpose(0, 1).numpy())

    def _stops(self, countered: CubicSpline, side: Array) -> Array:
        """Return the times [B] at which the yaw towards a side has stopped.

        The end where it does not.
        """
        column, stops = self.vessel.column("r"), []
        for row, begun in enumerate(side * countered.c[-1, 0, :, column]):
            yaw = PPoly(countered.c[:, :, row, column], countered.x)
            roots = yaw.roots(extrapolate=False) if begun > 0 else np.zeros(1)
            stops.append(float(roots[0]) if len(roots) else float(countered.x[-1]))
        return np.array(stops)


def _of_rows(states: CubicSpline, times: Array, rows: NDArray[np.intp]) -> Array:
    """Return the states [M, nx] of rows [M] at times [M]."""
    interval = np.clip(np.searchsorted(states.x, times, side="right") - 1, 0, len(states.x) - 2)
    passed = (times - states.x[interval])[:, None]
    found: Array = np.asarray(np.polyval(states.c[:, interval, rows], passed), dtype=np.float64)
    return found


def _of_row(states: CubicSpline, row: int) -> PPoly:
    """Return the states [nx] of one row by the time."""
    return PPoly(states.c[:, :, row], states.x)


def turning_step(vessel: SteeredVessel, turning: Turning, rudder: float) -> float:
    """Return the longest step in s that simulates turns at a rudder angle [rad] as half of it does.

    Turns and the legs behind them are compared, at rudder angles held for several times.
    """
    holds = turning.time * np.array([[0.5, 1.5, 3.0]])
    radius = turning.speed / (turning.gain * rudder)
    dt, before = _STEPS[0] * turning.time, None
    for _ in range(_STEPS[1]):
        make = TurnMaker(vessel, turning, dt)
        (turns,) = make(holds, np.array([rudder]), [make.straight], turning.time)
        ends = []
        for turn in turns:
            track, heading = turn.along(np.array([0.0, turning.time]))
            ends.append(np.concatenate((track / radius, heading[:, None]), axis=1))
        after = np.stack(ends)
        if before is not None and np.abs(after - before).max() < _ALIKE:
            return 2.0 * dt
        before, dt = after, 0.5 * dt
    return 2.0 * dt


@dataclass(frozen=True)
class SteadyTurn:
    """At a held rudder: radius of the track [m], speed [m/s] and yaw rate [rad/s].

    `step` is what it was simulated with, in s.
    """

    radius: float
    speed: float
    yaw_rate: float
    step: float


def steady_turn(vessel: SteeredVessel, rudder: float, duration: float, dt: float) -> SteadyTurn:
    """Return the steady turn after `duration` s of a held rudder angle in rad.

    At the rudder's limit it is the smallest turn that the vessel makes.
    """
    x, w = vessel.start(torch.ones(1, dtype=torch.float64))
    w[:, 0] = rudder
    variation = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    steps = math.ceil(duration / dt)
    with torch.no_grad():
        states, _, _ = Rollout(vessel.model(dt))(x, w.unsqueeze(1).expand(-1, steps, -1), variation)
    psi = states[0, :, vessel.column("psi")]
    track = states[0, :, [vessel.column("x"), vessel.column("y")]]
    # over the last tenth
    begin = steps - max(steps // 10, 1)
    moved = float((track[begin + 1 :] - track[begin:-1]).norm(dim=-1).sum())
    turned = float((psi[-1] - psi[begin]).abs())
    # arcs are longer than their chords
    half = 0.5 * turned / (steps - begin)
    moved *= half / math.sin(half)
    passed = (steps - begin) * dt
    return SteadyTurn(moved / turned, moved / passed, turned / passed, dt)


POINTS = 28
"""Points of a turn beside its beginning."""
_MOST = math.radians(500.0)
"""The largest angle of a turn in a table."""
_HOLDS = 56
"""Angles of turns in a table, nine degrees apart."""
_NOTHING = 2e-3
"""Below it what a turn leaves does not count: shares of speed and radius, and rad."""
_SETTLED = 4.0
"""Time constants after which the vessel runs straight behind a turn."""


class Part(NamedTuple):
    """Turns, or the legs behind them: points [n, K] complex, last headings [n], and times [n].

    Also their derivatives.
    """

    points: np.ndarray
    headings: Array
    times: Array


@final
class TurnTable:
    """Turns to starboard at one rudder angle, as smooth functions of the time it is held.

    Args:
        holds: [K] in s, from 0 on.
        points: [K, POINTS] complex positions in m in the frame of the beginning; the last one is
            where the straight leg behind the turn begins.
        headings: [K, POINTS] of the vessel in rad; the last one is the direction of that leg.
        times: [K] that the turns take, in s.
        rudder: the angle that is held, in rad.
        leg: north, east and heading of the leg behind by its length, in the frame of its beginning;
            None for a straight one.
    """

    def __init__(
        self,
        holds: Array,
        points: np.ndarray,
        headings: Array,
        times: Array,
        rudder: float,
        leg: CubicSpline | None = None,
    ) -> None:
        rows = np.concatenate((points.real, points.imag, headings, times[:, None]), axis=1)
        self.rudder, self.longest = rudder, float(holds[-1])
        self.leg, self.bent = leg, None if leg is None else leg.derivative()
        self.spline = CubicSpline(holds, rows)
        self.slope = self.spline.derivative()
        self.angles, self.holds, self.ends = headings[:, -1], holds, points[:, -1]

    def __call__(self, hold: float) -> tuple[np.ndarray, Array, float]:
        """Return the points [POINTS], headings [POINTS] and the time of a turn."""
        row = self.spline(hold)
        return row[:POINTS] + 1j * row[POINTS : 2 * POINTS], row[2 * POINTS : -1], float(row[-1])

    def along(self, lengths: Array) -> tuple[Part, Part]:
        """Return the leg behind at lengths [..., K] in m, and what it changes by with each."""
        none = np.zeros(lengths.shape[:-1])
        if self.leg is None or self.bent is None:
            straight = lengths.astype(complex)
            return Part(straight, none, none), Part(np.ones_like(straight), none, none)
        known = np.minimum(lengths, self.leg.x[-1])
        rows, bent = self.leg(known), self.bent(known)
        onward = np.exp(1j * rows[..., 2])
        inside = lengths <= self.leg.x[-1]
        places = rows[..., 0] + 1j * rows[..., 1] + (lengths - known) * onward
        moved = np.where(inside, bent[..., 0] + 1j * bent[..., 1], onward)
        turned = np.where(inside, bent[..., 2], 0.0)
        return Part(places, rows[..., -1, 2], none), Part(moved, turned[..., -1], none)

    def hold(self, angle: float) -> float:
        """Return the time in s that a turn of an angle in rad is held for."""
        return float(np.interp(angle, self.angles, self.holds))

    @cached_property
    def fitted(self) -> tuple[float, float, float]:
        """The radius of an arc, and the straight parts in m before and behind it.

        Together they lead where the turns lead, by least squares over their angles.
        """
        inside = (self.angles > math.radians(20.0)) & (self.angles < math.radians(300.0))
        turned, end = np.exp(1j * self.angles[inside]), self.ends[inside]
        columns = np.stack((1j * (1.0 - turned), np.ones_like(turned), turned), axis=1)
        found = np.linalg.lstsq(
            np.concatenate((columns.real, columns.imag)),
            np.concatenate((end.real, end.imag)),
            rcond=None,
        )[0]
        return float(found[0]), max(float(found[1]), 0.0), max(float(found[2]), 0.0)


@dataclass(frozen=True)
class Turns:
    """The tables of a vessel by rudder angle.

    Attributes:
        tables: of turns, that of the largest rudder angle first.
        speed: on straight legs, in m/s.
        radius: the smallest of a turn, in m.
        settled: whether turns leave no motion that the turns behind them begin with.
    """

    tables: tuple[TurnTable, ...]
    speed: float
    radius: float
    settled: bool = True

    def at(self, numbers: Sequence[int], holds: Array) -> tuple[Part, Part]:
        """Return turns of tables [n] held for [n] in s, to starboard, and their derivatives."""
        rows, slopes = np.zeros((2, len(holds), 3 * POINTS + 1))
        for number, which in _groups(numbers):
            rows[which] = self.tables[number].spline(holds[which])
            slopes[which] = self.tables[number].slope(holds[which])
        made, change = (
            Part(part[:, :POINTS] + 1j * part[:, POINTS : 2 * POINTS], part[:, -2], part[:, -1])
            for part in (rows, slopes)
        )
        return made, change

    def legs(self, numbers: Sequence[int], lengths: Array) -> tuple[Part, Part]:
        """Return the legs behind such turns at lengths [n, K] in m, and their derivatives."""
        count = len(lengths)
        both = [
            Part(np.zeros(lengths.shape, complex), np.zeros(count), np.zeros(count))
            for _ in range(2)
        ]
        for number, which in _groups(numbers):
            for whole, found in zip(both, self.tables[number].along(lengths[which]), strict=True):
                for into, values in zip(whole, found, strict=True):
                    into[which] = values
        return both[0], both[1]


def _groups(numbers: Sequence[int]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return each table's number and the turns that are of it."""
    every = np.array(numbers, dtype=np.intp)
    return [(int(number), np.flatnonzero(every == number)) for number in np.unique(every)]


def arcs(radii: Array, speed: float) -> Turns:
    """Return the turns of a vessel that yaws at once: arcs of the radii [n] in m."""
    angles = np.linspace(0.0, _MOST, _HOLDS)
    headings = angles[:, None] * np.linspace(0.0, 1.0, POINTS + 1)[1:]
    tables = [
        TurnTable(
            angles * radius / speed,
            1j * radius * (1.0 - np.exp(1j * headings)),
            headings,
            angles * radius / speed,
            0.0,
        )
        for radius in radii
    ]
    return Turns(tuple(tables), speed, float(radii[0]))


def simulated_turns(make: TurnMaker, rudder: Array, radius: float) -> Turns:
    """Return the turns of a vessel at rudder angles [n] in rad, each from straight ahead.

    Behind a turn the sway dies out. The leg is put where it ends up, and the last part of the turn
    is bent towards it.

    Args:
        rudder: angles, the largest first.
        radius: the vessel's smallest turning radius in m.
    """
    turning = make.turning
    holds = np.stack([_holds(np.linspace(0.0, 1.0, _HOLDS), angle, turning) for angle in rudder])
    tail = _SETTLED * turning.time
    made = make(holds[:, 1:], rudder, [make.straight] * len(rudder), tail)
    share = np.linspace(0.0, 1.0, POINTS + 1)[1:]
    tables, left = [], 0.0
    for angle, held, group in zip(rudder, holds, made, strict=True):
        points, headings, times = _sampled(group)
        for k, turn in enumerate(group):
            track, course = turn.along(np.linspace(0.0, tail, 60))
            moved = float(np.hypot(*np.diff(track, axis=0).T).sum())
            end = complex(*track[-1]) - moved * np.exp(1j * course[-1])
            slower = abs(moved / (turning.speed * tail) - 1.0)
            aside = abs(end - points[k, -1]) / radius
            left = max(left, slower, aside, abs(float(course[-1]) - headings[k, -1]))
            points[k] += share**3 * (end - points[k, -1])
            headings[k] += share**3 * (course[-1] - headings[k, -1])
        none = np.zeros((1, POINTS))
        tables.append(
            TurnTable(
                held,
                np.concatenate((none, points)),
                np.concatenate((none, headings)),
                np.concatenate(([0.0], times)),
                float(angle),
            )
        )
    return Turns(tuple(tables), turning.speed, radius, left < _NOTHING)


def following_turns(
    make: TurnMaker, holds: Array, rudder: Array, begin: Sequence[Array], radius: float
) -> tuple[Turns, list[Turn]]:
    """Return tables of n turns, each from a motion of its own, and the middle one of each.

    Args:
        holds: [n, K] in s, K odd.
        rudder: [n] in rad, positive to starboard.
        begin: state of the vessel [nx] that each begins with.
        radius: the vessel's smallest turning radius in m.
    """
    tail = 2.0 * _SETTLED * make.turning.time
    made = make(holds, rudder, begin, tail)
    tables, middles = [], []
    for angle, held, group in zip(rudder, holds, made, strict=True):
        points, headings, times = _sampled(group)
        middle = group[len(group) // 2]
        track, course = middle.along(np.linspace(0.0, tail, 80))
        places = (track - track[0]) @ (1.0, 1j) * np.exp(-1j * course[0])
        leg = np.stack((places.real, places.imag, course - course[0]), axis=-1)
        if angle < 0:
            points, headings = points.conj(), -headings
            leg[:, 1:] *= -1.0
        moved = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(places)))))
        tables.append(
            TurnTable(held, points, headings, times, abs(float(angle)), CubicSpline(moved, leg))
        )
        middles.append(middle)
    return Turns(tuple(tables), make.turning.speed, radius), middles


def state_behind(turn: Turn, length: float) -> Array:
    """Return the state of the vessel [nx] after a length in m of the leg behind a turn."""
    times = np.linspace(0.0, float(turn.leg.x[-1]), 80)
    track, _ = turn.along(times)
    moved = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(track, axis=0).T))))
    state: Array = turn.leg(float(np.interp(length, moved, times)))
    return state


def _sampled(group: Sequence[Turn]) -> tuple[np.ndarray, Array, Array]:
    """Return points [K, POINTS], headings [K, POINTS] and times [K] of turns, even in time."""
    share = np.linspace(0.0, 1.0, POINTS + 1)[1:]
    points, headings = np.zeros((len(group), POINTS), dtype=complex), np.zeros((len(group), POINTS))
    for k, turn in enumerate(group):
        track, headings[k] = turn.at(share * turn.lasts)
        points[k] = track @ (1.0, 1j)
    return points, headings, np.array([turn.lasts for turn in group])


def _holds(share: Array, rudder: float, turning: Turning) -> Array:
    """Return the times in s for which the rudder is held, up to the largest angle of a turn.

    By Nomoto's model angles are K d (t1 - t2), t2 = T ln(2 - exp(-t1 / T)).
    """
    longest = _MOST / (turning.gain * rudder) + math.log(2.0) * turning.time
    return share**1.3 * longest


LEG = 12
"""Points of a leg beside its beginning."""
_FINE = 8
"""Times as many points as a turn is searched with describe it in the end."""


@dataclass(frozen=True)
class Bend:
    """A turn of a route before its time is known.

    Attributes:
        side: +1 to starboard, -1 to port.
        angle: in rad.
        table: number of the table of turns.
        passed: buoys that are passed in it.
    """

    side: int
    angle: float
    table: int
    passed: tuple[int, ...] = ()


@dataclass(frozen=True)
class Sketch:
    """A route in outline.

    Attributes:
        heading: of the first leg in rad.
        legs: [n + 1] lengths in m.
        bends: [n] between the legs.
        passed: for each leg, the buoys that are passed on it.
    """

    heading: float
    legs: tuple[float, ...]
    bends: tuple[Bend, ...]
    passed: tuple[tuple[int, ...], ...]

    def simplified(self, short: float, small: float) -> Sketch:
        """Return the outline with bends joined that turn to one side with a short leg between.

        Bends below `small` rad are left out.
        """
        sketch, k = self, 0
        while k < len(sketch.bends):
            bend = sketch.bends[k]
            if bend.angle < small:
                sketch = sketch._without(k)
                k = max(k - 1, 0)
                continue
            following = sketch.bends[k + 1] if k + 1 < len(sketch.bends) else None
            if following and following.side == bend.side and sketch.legs[k + 1] < short:
                sketch = sketch._joined(k)
                continue
            k += 1
        return sketch

    def _without(self, k: int) -> Sketch:
        """Return the outline without a bend: both legs beside it are one."""
        legs = (*self.legs[:k], self.legs[k] + self.legs[k + 1], *self.legs[k + 2 :])
        here = (*self.passed[k], *self.bends[k].passed, *self.passed[k + 1])
        passed = (*self.passed[:k], here, *self.passed[k + 2 :])
        return Sketch(self.heading, legs, (*self.bends[:k], *self.bends[k + 1 :]), passed)

    def _joined(self, k: int) -> Sketch:
        """Return the outline with a bend and the next as one."""
        one, two = self.bends[k], self.bends[k + 1]
        wider = max(one, two, key=lambda bend: bend.angle)
        bend = replace(
            wider,
            angle=one.angle + two.angle,
            passed=(*one.passed, *self.passed[k + 1], *two.passed),
        )
        half = 0.5 * self.legs[k + 1]
        legs = (*self.legs[:k], self.legs[k] + half, self.legs[k + 2] + half, *self.legs[k + 3 :])
        passed = (*self.passed[: k + 1], *self.passed[k + 2 :])
        return Sketch(self.heading, legs, (*self.bends[:k], bend, *self.bends[k + 2 :]), passed)


@dataclass(frozen=True)
class Drawn:
    """A route's points, its length of time, and what they change by.

    A point moves with a length of its own part of the route, and with those of all parts before
    it: these shift it and turn it about where they end.

    Attributes:
        points: [S] complex in m, from the start on.
        time: in s.
        heading: of the last leg in rad.
        slower: derivatives [nz] of the time.
        turned: derivatives [nz] of the last heading.
        inner: derivatives [S] of the points by the length of their own part.
        own: number in z of that length [S].
        after: first point [nz] behind the part of each length.
        shift, turn, pivot: what each length does to the points behind its part [nz].
        units: of z [nz].
    """

    points: np.ndarray
    time: float
    heading: float
    slower: Array
    turned: Array
    inner: np.ndarray
    own: NDArray[np.intp]
    after: NDArray[np.intp]
    shift: np.ndarray
    turn: Array
    pivot: np.ndarray
    units: Array

    def moved(self, at: NDArray[np.intp]) -> np.ndarray:
        """Return the derivatives [P, nz] of points with the numbers [P]."""
        away = self.points[at][:, None] - self.pivot
        rows = np.where(at[:, None] >= self.after, self.shift + 1j * self.turn * away, 0.0)
        own = self.own[at]
        inside = np.flatnonzero(own > 0)
        rows[inside, own[inside]] = self.inner[at[inside]]
        result: np.ndarray = rows * self.units
        return result


def _mirrored(points: np.ndarray, sides: Array) -> np.ndarray:
    """Return turns [n, K] to starboard as turns to their sides [n]: to port they are mirrored."""
    result: np.ndarray = points.real + 1j * sides[:, None] * points.imag
    return result


@final
@dataclass
class Route:
    """A route as a function of z = (first heading, leg, hold, leg, hold, ..., leg).

    Headings are in rad, legs in m and holds in s, each divided by its unit.

    Attributes:
        start: complex, in m.
        sides: [n] of the turns.
        numbers: [n] of their tables.
        turns: the tables.
        units: [2 n + 2] of z.
    """

    start: complex
    sides: tuple[int, ...]
    numbers: tuple[int, ...]
    turns: Turns
    units: Array = field(init=False)

    def __post_init__(self) -> None:
        self.units = np.ones(2 + 2 * len(self.sides))
        self.units[1::2] = self.turns.radius
        self.units[2::2] = self.turns.radius / self.turns.speed

    def begin(self, sketch: Sketch) -> Array:
        """Return the z that an outline stands for; turns need room before and behind them."""
        z = np.zeros(len(self.units))
        z[0], legs = sketch.heading, np.array(sketch.legs)
        for k, bend in enumerate(sketch.bends):
            table = self.turns.tables[bend.table]
            _, before, behind = table.fitted
            z[2 + 2 * k] = table.hold(bend.angle)
            part = min(bend.angle / 0.8, 1.0)
            legs[k] -= part * before
            legs[k + 1] -= part * behind
        z[1::2] = np.maximum(legs, 0.0)
        result: Array = z / self.units
        return result

    def least(self) -> Array:
        """Return the smallest z."""
        least = np.zeros(len(self.units))
        least[0] = -np.inf
        least[2::2] = [self.turns.tables[number].holds[0] for number in self.numbers]
        result: Array = least / self.units
        return result

    def most(self) -> Array:
        """Return the largest z."""
        most = np.full(len(self.units), np.inf)
        most[2::2] = [self.turns.tables[number].longest for number in self.numbers]
        result: Array = most / self.units
        return result

    def place_of(self, sketch: Sketch, buoys: np.ndarray) -> NDArray[np.intp]:
        """Return the points [N] at which an outline passes its buoys, in their order."""
        z = self.begin(sketch)
        points = self(z).points
        at, last = np.zeros(len(buoys), dtype=np.intp), 0
        parts: list[tuple[int, int, Sequence[int]]] = []
        place = 0
        for k, on_leg in enumerate(sketch.passed):
            parts.append((place, place + LEG, on_leg))
            place += LEG
            if k < len(sketch.bends):
                parts.append((place, place + POINTS, sketch.bends[k].passed))
                place += POINTS
        for low, high, passed in parts:
            for buoy in passed:
                begin = min(max(low, last), high)
                near = begin + int(np.abs(points[begin : high + 1] - buoys[buoy]).argmin())
                at[buoy] = last = near
        return at

    def __call__(self, z: Array) -> Drawn:
        """Return the points of z, the time, and what they change by."""
        z = z * self.units
        size, number, speed = len(z), len(self.sides), self.turns.speed
        sides, begin, first = np.array(self.sides, dtype=float), float(z[0]), float(z[1])
        shares = np.linspace(0.0, 1.0, LEG + 1)[1:]
        made, change = self.turns.at(self.numbers, z[2::2])
        behind, onward = self.turns.legs(self.numbers, z[3::2, None] * shares)
        made, change, behind, onward = (
            part._replace(points=_mirrored(part.points, sides))
            for part in (made, change, behind, onward)
        )
        bent, swung = sides * made.headings, sides * behind.headings
        levels = begin + np.concatenate(([0.0], np.cumsum(bent + swung)))
        along, beyond = np.exp(1j * levels), np.exp(1j * (levels[:-1] + bent))
        track = along[:-1, None] * made.points
        leg = beyond[:, None] * behind.points
        at = self.start + first * along[0]
        ends = at + np.cumsum(track[:, -1:] + leg[:, -1:])
        corners = np.concatenate(([at], ends))[:-1] + track[:, -1]
        starts = np.concatenate(([at], ends))[:-1]
        parts = np.concatenate((starts[:, None] + track, corners[:, None] + leg), axis=1)
        points = np.concatenate(
            ([self.start], self.start + first * along[0] * shares, parts.ravel())
        )
        inner = np.concatenate(
            (along[:-1, None] * change.points, shares * beyond[:, None] * onward.points), axis=1
        )
        shift, turn, pivot = np.zeros(size, complex), np.zeros(size), np.full(size, self.start)
        turn[0], shift[1], pivot[1] = 1.0, along[0], at
        turn[2::2], turn[3::2] = sides * change.headings, sides * onward.headings
        shift[2::2] = along[:-1] * change.points[:, -1]
        shift[3::2] = beyond * onward.points[:, -1]
        pivot[2::2], pivot[3::2] = corners, ends
        lengths = np.array([1, LEG, *(POINTS, LEG) * number])
        slower = np.zeros(size)
        slower[1::2], slower[2::2] = 1.0 / speed, change.times
        return Drawn(
            points,
            float(z[1::2].sum()) / speed + float(made.times.sum()),
            float(levels[-1]),
            slower * self.units,
            turn * self.units,
            np.concatenate(([0.0], along[0] * shares, inner.ravel())),
            np.repeat(np.arange(size), lengths),
            np.concatenate(([0], np.cumsum(lengths)[1:])),
            shift,
            turn,
            pivot,
            self.units,
        )

    def sailed(self, z: Array) -> list[tuple[np.ndarray, Array, float]]:
        """Return the parts of a route: points [K] complex, vessel's headings [K], and rudder."""
        z = z * self.units
        level, at = float(z[0]), self.start
        along = cmath.exp(1j * level)
        parts = [(np.array([at, at + float(z[1]) * along]), np.full(2, level), 0.0)]
        at += float(z[1]) * along
        for k, (side, number) in enumerate(zip(self.sides, self.numbers, strict=True)):
            hold, leg, table = float(z[2 + 2 * k]), float(z[3 + 2 * k]), self.turns.tables[number]
            track, heading, lasted = table(hold)
            share = min(hold / lasted, 1.0) if lasted > 0 else 1.0
            over = min(max(round(share * _FINE * POINTS), 1), _FINE * POINTS)
            track, heading = (
                np.concatenate(([0.0], track if side > 0 else track.conj())),
                np.concatenate(([0.0], side * heading)),
            )
            even = np.linspace(0.0, 1.0, POINTS + 1)
            smooth = CubicSpline(even, np.stack((track.real, track.imag, heading.real), axis=-1))
            fine = smooth(np.linspace(0.0, 1.0, _FINE * POINTS + 1))
            points, heading = at + along * (fine[:, 0] + 1j * fine[:, 1]), fine[:, 2]
            parts.append((points[: over + 1], level + heading[: over + 1], side * table.rudder))
            parts.append((points[over:], level + heading[over:], -side * table.rudder))
            level += float(heading[-1])
            along, at = cmath.exp(1j * level), complex(points[-1])
            behind, _ = table.along(leg * np.linspace(0.0, 1.0, 100)[:, None] ** 2)
            places = behind.points[:, 0] if side > 0 else behind.points[:, 0].conj()
            parts.append((at + along * places, level + side * behind.headings, 0.0))
            level += side * float(behind.headings[-1])
            along, at = cmath.exp(1j * level), complex(parts[-1][0][-1])
        return parts
