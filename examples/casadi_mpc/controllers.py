"""Controllers of an identified model: predictive control, and PID with feed-forward."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import casadi
import numpy as np
from model import Identified
from track import Track

INTERVALS = 20
"""Control intervals within the horizon."""
_ACROSS = 0.1
_ALONG = 1.0
"""Errors in m that cost as much as each other, across and along the course."""
_SPEED = 0.2
"""Error of the speed, as a share of what is asked, that costs as much."""
_CHANGE = 0.5
"""Change of an input within an interval, as a share of its range, that costs as much."""
_LEAVING = 1e3
"""Cost of leaving the training range by its own width: dear, but never without a solution."""
_LITTLE = 1e-6
"""Curvature of that cost, so that the programme has one solution."""
_ROUNDS = 2
_FIRST = 10
"""Gauss-Newton steps of a move and of the first one, at most."""
_SETTLED = 1e-3
"""Change of all inputs, as a share of their range, that ends them."""


class Predictive:
    """Model predictive control along a course, the model's training range as constraints.

    The inputs of 20 intervals, each held over several steps of the model, are found by Gauss-Newton
    steps: the model is run ahead with its exact derivatives by these inputs, as generated C, and a
    quadratic programme gives better ones. Inputs never leave the training range, and change no
    faster than the actuators. Velocities leave it where nothing else is possible, for example at
    the start. The difference between the last prediction and what was measured is taken to persist,
    so that a model that is a little wrong leaves no lasting error.

    Args:
        model: identified.
        track: to follow.
        speed: in m/s.
        interval: seconds that a control is held, a multiple of the model's step.
        rates: how fast each input can change per second.
    """

    def __init__(
        self, model: Identified, track: Track, speed: float, interval: float, rates: np.ndarray
    ) -> None:
        self.model = model
        self.track = track
        self.speed = speed
        self.every = max(1, round(interval / model.dt))
        self.interval = self.every * model.dt
        self.bias = np.zeros(3)
        self.memory = np.zeros(model.memory)
        self.expected: np.ndarray | None = None
        self.plan: np.ndarray | None = None
        self.ahead = self._ahead()
        n = INTERVALS
        span = self.model.high - self.model.low
        self.low = self.model.low
        self.span = span
        # of what is asked: the change within each interval [2 n, 2 n]
        self.changes = np.eye(2 * n) - np.eye(2 * n, k=-2)
        self.fastest = np.tile(rates * self.interval, n)
        rows = 6 * n + 2 * n
        columns = 3 * n
        dense = casadi.Sparsity.dense
        shape = {"h": dense(columns, columns), "a": dense(rows, columns)}
        self.solver = casadi.conic("moves", "daqp", shape, {"error_on_fail": False})

    def _ahead(self) -> casadi.Function:
        """Return the model run ahead: of start, inputs [2, n] and bias, states and slopes.

        States [6, n] stand at the ends of intervals, slopes [6 n, 2 n] are theirs by the inputs.
        """
        n = INTERVALS
        step = self.model.step
        dt = self.model.dt
        x, s = casadi.MX.sym("x", 6), casadi.MX.sym("s", self.model.memory)
        inputs = casadi.MX.sym("inputs", 2, n)
        bias = casadi.MX.sym("bias", 3)
        slope = step.forward(1)
        states = []
        slopes = []
        start = [x, s]
        by_x = casadi.MX(6, 0)
        by_s = casadi.MX(self.model.memory, 0)
        for k in range(n):
            w = inputs[:, k]
            by_x = casadi.horzcat(by_x, casadi.MX(6, 2))
            by_s = casadi.horzcat(by_s, casadi.MX(self.model.memory, 2))
            by_w = casadi.horzcat(casadi.MX(2, 2 * k), casadi.MX.eye(2))
            # one column of slopes after the other, about the same step
            each = slope.map(f"slope_{k}", "serial", 2 * k + 2, [0, 1, 2, 3, 4, 5], [])
            for _ in range(self.every):
                found = step(x, w, s)
                by_x, by_s, _ = each(x, w, s, *found, by_x, by_w, by_s)
                x, s = casadi.vertcat(found[0][:3], found[0][3:] + dt * bias), found[1]
            states.append(x)
            slopes.append(casadi.horzcat(by_x, casadi.MX(6, 2 * (n - k - 1))))
        found = [casadi.horzcat(*states), casadi.densify(casadi.vertcat(*slopes))]
        return compiled(casadi.Function("ahead", [*start, inputs, bias], found))

    def observe(self, measured: np.ndarray, used: np.ndarray) -> None:
        """Take a step's measurement [6] and the inputs [2] that were in force before it."""
        if self.expected is not None:
            missed = (measured[3:] - self.expected[3:]) / self.model.dt
            self.bias += 0.1 * (missed - self.bias)
        after, memory, _ = self.model.step(measured, used, self.memory)
        self.expected = np.asarray(after).ravel()
        self.memory = np.asarray(memory).ravel()

    def __call__(self, measured: np.ndarray, place: float, used: np.ndarray) -> np.ndarray:
        """Return the inputs [2] of the next interval.

        Args:
            measured: state [6].
            place: of the vessel along the course in m.
            used: inputs as they are measured now [2].
        """
        n = INTERVALS
        # where a vessel starts with its actuators outside of the range, the first move is into it
        used = np.clip(used, self.low[3:], self.model.high[3:])
        on = place + self.speed * self.interval * np.arange(1, n + 1)
        wanted = self.track.at(on)[:, :3]
        rounds = _FIRST if self.plan is None else _ROUNDS
        if self.plan is None:
            # thrusters at rest answer to no small change, and so show no way to go
            plan = np.tile(self.model.steady(self.speed, 0.0)[1], n)
        else:
            # the next solution begins where the last one has arrived by now
            plan = np.r_[self.plan[2:], self.plan[-2:]]
        for _ in range(rounds):
            ahead = self.ahead(measured, self.memory, plan.reshape(n, 2).T, self.bias)
            states, slopes = (np.asarray(part) for part in ahead)
            moves = self._moves(plan, states.T, slopes, wanted, used)
            if not np.isfinite(moves).all():
                self.plan = None
                return used
            plan = plan + moves
            if np.abs(moves / np.tile(self.span[3:], n)).max() < _SETTLED:
                break
        self.plan = plan
        return np.clip(plan[:2], self.low[3:], self.model.high[3:])

    def _moves(
        self,
        plan: np.ndarray,
        states: np.ndarray,
        slopes: np.ndarray,
        wanted: np.ndarray,
        used: np.ndarray,
    ) -> np.ndarray:
        """Return by how much the inputs [2 n] of a plan are to change.

        Args:
            plan: inputs [2 n].
            states: that they lead to [n, 6].
            slopes: of these by the inputs [6 n, 2 n].
            wanted: place and direction of the course [n, 3].
            used: inputs now [2].
        """
        n = INTERVALS
        span = self.span
        high = self.model.high
        by = slopes.reshape(n, 6, 2 * n)
        north, east = (states[:, :2] - wanted[:, :2]).T
        sin, cos = np.sin(wanted[:, 2]), np.cos(wanted[:, 2])
        scale = np.tile(_CHANGE * span[3:], n)
        change = self.changes @ plan - np.r_[used, np.zeros(2 * n - 2)]
        misses = np.r_[
            (cos * east - sin * north) / _ACROSS,
            (cos * north + sin * east) / _ALONG,
            (states[:, 3] - self.speed) / (_SPEED * self.speed),
            change / scale,
        ]
        slope = np.concatenate(
            (
                (cos[:, None] * by[:, 1] - sin[:, None] * by[:, 0]) / _ACROSS,
                (cos[:, None] * by[:, 0] + sin[:, None] * by[:, 1]) / _ALONG,
                by[:, 3] / (_SPEED * self.speed),
                self.changes / scale[:, None],
            )
        )
        cost = np.zeros((3 * n, 3 * n))
        cost[: 2 * n, : 2 * n] = 2.0 * slope.T @ slope
        cost[2 * n :, 2 * n :] = _LITTLE * np.eye(n)
        steep = np.r_[2.0 * slope.T @ misses, np.full(n, _LEAVING)]
        inside = (states[:, 3:] / span[:3]).ravel()
        moving = (by[:, 3:] / span[:3, None]).reshape(3 * n, 2 * n)
        leaving = np.repeat(np.eye(n), 3, axis=0)
        within = np.block(
            [
                [moving, leaving],
                [moving, -leaving],
                [self.changes, np.zeros((2 * n, n))],
            ]
        )
        free = np.full(3 * n, np.inf)
        least = np.tile(self.low[:3] / span[:3], n) - inside
        most = np.tile(high[:3] / span[:3], n) - inside
        found = self.solver(
            h=cost,
            g=steep,
            a=within,
            lba=np.r_[least, -free, -self.fastest - change],
            uba=np.r_[free, most, self.fastest - change],
            lbx=np.r_[np.tile(self.low[3:], n) - plan, np.zeros(n)],
            ubx=np.r_[np.tile(high[3:], n) - plan, np.full(n, np.inf)],
        )
        return np.asarray(found["x"]).ravel()[: 2 * n]


def compiled(function: casadi.Function) -> casadi.Function:
    """Return a function as compiled C; as it is where there is no C compiler."""
    tool = shutil.which("cc")
    if tool is None:
        return function
    # what is loaded stays, though its file goes
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        writer = casadi.CodeGenerator("ahead.c")
        writer.add(function)
        writer.generate(f"{folder}/")
        library = folder / "ahead.so"
        call = [tool, "-O1", "-w", "-fPIC", "-shared", str(folder / "ahead.c"), "-o", str(library)]
        subprocess.run([*call, "-lm"], check=True)
        return casadi.external(function.name(), str(library))


class Gains(NamedTuple):
    """What is tuned of the PID.

    Attributes:
        frequency: of the closed loop in yaw, rad/s.
        lookahead: of the line of sight in m.
        lead: seconds that the feed-forward looks ahead.
    """

    frequency: float
    lookahead: float
    lead: float


class FeedForwardPID:
    """PID on heading and speed with line of sight, and the model's steady turn as feed-forward.

    The inputs of the turn that the course has a little ahead come from the model. Accelerations
    that the PID asks for are made by the inverse of the model's own sensitivity to its inputs.

    Args:
        model: identified.
        track: to follow.
        speed: in m/s.
        gains: of the loop.
    """

    def __init__(self, model: Identified, track: Track, speed: float, gains: Gains) -> None:
        self.model = model
        self.track = track
        self.speed = speed
        self.gains = gains
        sharpest = 1.2 * float(np.abs(track.curvature).max()) + 1e-3
        self.bends = np.linspace(-sharpest, sharpest, 21)
        turns = [model.steady(speed, speed * bend) for bend in self.bends]
        self.drift = np.array([math.atan2(nu[1], nu[0]) for nu, _ in turns])
        self.table = np.array([w for _, w in turns])
        nu, w = model.steady(speed, 0.0)
        motion, inputs = model.slopes(nu, w)
        self.mix = np.linalg.pinv(inputs[[0, 2]])
        self.damping = max(0.0, 2.0 * gains.frequency + float(motion[2, 2]))
        self.sums = np.zeros(2)

    def __call__(self, measured: np.ndarray, place: float) -> np.ndarray:
        """Return the inputs [2] of the next step of the model."""
        gains = self.gains
        dt = self.model.dt
        x, y, psi, u, v, r = measured
        aside = self.track.aside(x, y, place)
        way = float(self.track.at(place)[2])
        bend = float(self.track.at(place + gains.lead * self.speed)[3])
        forward = np.array([np.interp(bend, self.bends, column) for column in self.table.T])
        drift = float(np.interp(bend, self.bends, self.drift))
        slope = aside / gains.lookahead
        over_ground = math.hypot(u, v)
        closing = over_ground * math.sin(psi + math.atan2(v, max(u, 1e-3)) - way)
        wish = way - drift - math.atan(slope)
        turning = self.speed * bend - closing / gains.lookahead / (1.0 + slope**2)
        off = math.remainder(wish - psi, 2.0 * math.pi)
        slow = self.speed - u
        frequency = gains.frequency
        asked = np.array(
            [
                frequency * slow + 0.1 * frequency**2 * self.sums[0],
                frequency**2 * off
                + self.damping * (turning - r)
                + 0.05 * frequency**3 * self.sums[1],
            ]
        )
        wanted = forward + self.mix @ asked
        given = np.clip(wanted, self.model.low[3:], self.model.high[3:])
        if np.array_equal(given, wanted):
            self.sums += dt * np.array([slow, off])
        return given
