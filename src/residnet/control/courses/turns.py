"""Turns as a vessel makes them: rudder held, counter-rudder until the yaw stops, amidships.

They begin with any motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

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
_HALVED = 40
"""Times that the interval is halved in which the yaw stops."""
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
        vessel: that turns.
        turning: its K and T.
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

    def _steps(self, swing: float, duration: float) -> list[tuple[float, int]]:
        """Return the lengths of steps in s, and how many of each, after a rudder is laid."""
        found, rest = [], max(duration, 3.0 * self.dt)
        if self.vessel.rate is not None:
            moving = swing / self.vessel.rate
            # the rudder moves between steps, and lags behind by half of one
            fine = min(self.dt, 4.0 * _ALIKE / (self.turning.gain * swing))
            count = math.ceil(min(1.1 * moving, rest) / fine)
            found, rest = [(fine, count)], rest - count * fine
        return [*found, (self.dt, math.ceil(rest / self.dt))] if rest > 0 else found

    def _phase(self, x: Array, rudder: Array, duration: float, swing: float) -> CubicSpline:
        """Return the states [B, nx] by the time from x [B, nx] on, under rudder angles [B].

        `swing` is what the rudder moves by at most, in rad.
        """
        w = self.inputs.unsqueeze(1).repeat(len(x), 1, 1)
        w[:, 0, 0] = torch.from_numpy(rudder)
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(x), -1)
        at, parts = [np.zeros(1)], [torch.from_numpy(x).unsqueeze(1)]
        for dt, count in self._steps(swing, duration):
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
        column, rows = self.vessel.column("r"), np.arange(len(side))
        yaw = countered(countered.x)[:, :, column] * side
        after = np.argmax(yaw <= 0.0, axis=0)
        before = np.maximum(after - 1, 0)
        cubic = countered.c[:, before, rows, column] * side
        low, high = np.zeros(len(side)), np.diff(countered.x)[before]
        for _ in range(_HALVED):
            middle = 0.5 * (low + high)
            turning = np.polyval(cubic, middle) > 0
            low, high = np.where(turning, middle, low), np.where(turning, high, middle)
        stops = countered.x[before] + np.where(after > 0, low, 0.0)
        time: Array = np.where((yaw > 0).all(axis=0), countered.x[-1], stops)
        return time


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
