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

from residnet.control.heading.steering import SteeredVessel
from residnet.control.heading.turning import Turning
from residnet.dynamics.rollout import Rollout

Array = NDArray[np.float64]
_COUNTER = 1.5
"""Time constants within which counter-rudder stops a turn; T ln 2 by Nomoto's model."""


@dataclass(frozen=True)
class Turn:
    """A turn from the origin, heading north at first, and the leg behind it.

    The rudder is amidships on the leg.

    Attributes:
        rudder: angle held in rad, positive to starboard; then the same to the other side.
        hold: for how long, in s.
        times: samples of the turn [N] in s; the last is where the counter-rudder ends and the leg
            begins.
        track: north, east [N, 2] in m.
        heading: [N] in rad, not wrapped.
        leg: states of the vessel [nx] by the time in s since the leg began.
        columns: of north, east and heading in those.
    """

    rudder: float
    hold: float
    times: Array
    track: Array
    heading: Array
    leg: PPoly
    columns: tuple[int, int, int]

    def along(self, times: Array) -> tuple[Array, Array]:
        """Return the track [M, 2] and heading [M] of the leg at times [M] in s since it began."""
        states = self.leg(times)
        return states[:, list(self.columns[:2])], states[:, self.columns[2]]


@final
class TurnMaker:
    """Simulated turns of the nominal vessel: rudder held, counter-rudder, rudder amidships.

    The three follow from simulations that begin where they do, so that what comes of a turn changes
    smoothly with its time.

    Args:
        vessel: that turns.
        turning: its K and T.
        dt: step of the simulations in s.
    """

    def __init__(self, vessel: SteeredVessel, turning: Turning, dt: float) -> None:
        self.vessel, self.turning, self.dt = vessel, turning, dt
        self.columns = (vessel.column("x"), vessel.column("y"), vessel.column("psi"))
        self.loop = Rollout(vessel.model(dt))
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
        held = self._phase(x, rudder, float(holds.max()))
        rows = np.repeat(np.arange(n), k)
        countered = self._phase(
            _of_rows(held, holds.ravel(), rows), -rudder[rows], _COUNTER * self.turning.time
        )
        stops = self._stops(countered, np.sign(rudder)[rows])
        rows = np.arange(n * k)
        leg_motion = self._phase(_of_rows(countered, stops, rows), np.zeros(n * k), leg)
        turns = []
        for row, (hold, stop) in enumerate(zip(holds.ravel(), stops, strict=True)):
            first, then = (
                np.linspace(0.0, hold, len(held.x)),
                np.linspace(0.0, stop, len(countered.x)),
            )
            states = np.concatenate((held(first)[:-1, row // k], countered(then)[:, row]))
            times = np.concatenate((first[:-1], hold + then))
            after = PPoly(leg_motion.c[:, :, row], leg_motion.x)
            turns.append(
                Turn(
                    float(rudder[row // k]),
                    hold,
                    times,
                    states[:, list(self.columns[:2])],
                    states[:, self.columns[2]],
                    after,
                    self.columns,
                )
            )
        return [turns[k * i : k * i + k] for i in range(n)]

    def _phase(self, x: Array, rudder: Array, duration: float) -> CubicSpline:
        """Return the states [B, nx] by the time from x [B, nx] on, under rudder angles [B]."""
        steps = max(math.ceil(duration / self.dt), 3)
        w = self.inputs.unsqueeze(1).repeat(len(x), steps, 1)
        w[:, :, 0] = torch.from_numpy(rudder).unsqueeze(-1)
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(x), -1)
        with torch.no_grad():
            states, _, _ = self.loop(torch.from_numpy(x), w, nominal)
        return CubicSpline(self.dt * np.arange(steps + 1), states.transpose(0, 1).numpy())

    def _stops(self, countered: CubicSpline, side: Array) -> Array:
        """Return the times [B] at which the yaw towards a side has stopped.

        The end where it does not.
        """
        yaw = countered(countered.x)[:, :, self.vessel.column("r")] * side
        after, rows = np.argmax(yaw <= 0.0, axis=0), np.arange(len(side))
        before = np.maximum(after - 1, 0)
        share = yaw[before, rows] / np.maximum(yaw[before, rows] - yaw[after, rows], 1e-12)
        stops = countered.x[before] + np.where(after > 0, share, 0.0) * self.dt
        distance: Array = np.where(yaw[-1] > 0, countered.x[-1], stops)
        return distance


def _of_rows(states: CubicSpline, times: Array, rows: NDArray[np.intp]) -> Array:
    """Return the states [M, nx] of rows [M] at times [M]."""
    found: Array = states(times)[np.arange(len(times)), rows]
    return found


@dataclass(frozen=True)
class SteadyTurn:
    """At a held rudder: radius of the track [m], speed [m/s] and yaw rate [rad/s]."""

    radius: float
    speed: float
    yaw_rate: float


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
    passed = (steps - begin) * dt
    return SteadyTurn(moved / turned, moved / passed, turned / passed)
