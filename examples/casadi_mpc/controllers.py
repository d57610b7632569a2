"""Controllers of an identified model: predictive control by IPOPT, and PID with feed-forward."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import casadi
import numpy as np
from model import Identified
from track import Track

INTERVALS = 20
"""Control intervals within the horizon."""
_ACROSS, _ALONG = 0.1, 1.0
"""Errors in m that cost as much as each other, across and along the course."""
_SPEED = 0.2
"""Error of the speed, as a share of what is asked, that costs as much."""
_CHANGE = 0.5
"""Change of an input within an interval, as a share of its range, that costs as much."""
_LEAVING = 1e3
"""Cost of leaving the training range by its own width: dear, but never without a solution."""


class Predictive:
    """Model predictive control along a course, the model's training range as constraints.

    Multiple shooting over 20 intervals; each holds its inputs over several steps of the model.
    Inputs never leave the training range, and change no faster than the actuators. Velocities leave
    it where nothing else is possible, for example at the start. The difference between the last
    prediction and what was measured is taken to persist, so that a model that is a little wrong
    leaves no lasting error.

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
        self.model, self.track, self.speed = model, track, speed
        self.every = max(1, round(interval / model.dt))
        self.interval = self.every * model.dt
        self.size = 6 + model.memory
        self.bias = np.zeros(3)
        self.memory = np.zeros(model.memory)
        self.expected: np.ndarray | None = None
        self.plan: np.ndarray | None = None
        self.duals: tuple[Any, Any] | None = None
        self._build(rates)

    def _build(self, rates: np.ndarray) -> None:
        """Set up the problem once; each solution has other parameters only."""
        sym = casadi.MX.sym
        x, w, bias = sym("x", self.size), sym("w", 2), sym("bias", 3)
        after = x
        for _ in range(self.every):
            state, memory, _ = self.model.step(after[:6], w, after[6:])
            after = casadi.vertcat(state[:3], state[3:] + self.model.dt * bias, memory)
        advance = casadi.Function("advance", [x, w, bias], [after])
        self.advance = advance
        n, span = INTERVALS, self.model.high - self.model.low
        states, inputs = sym("states", self.size, n), sym("inputs", 2, n)
        leaving = sym("leaving", n)
        start, last, shift = sym("start", self.size), sym("last", 2), sym("shift", 3)
        wanted = sym("wanted", 3, n)
        cost, equal, within = 0, [], []
        before, held = start, last
        for k in range(n):
            now, w = states[:, k], inputs[:, k]
            equal.append(advance(before, w, shift) - now)
            way = wanted[2, k]
            north, east = now[0] - wanted[0, k], now[1] - wanted[1, k]
            across = casadi.cos(way) * east - casadi.sin(way) * north
            along = casadi.cos(way) * north + casadi.sin(way) * east
            slow = (now[3] - self.speed) / (_SPEED * self.speed)
            change = (w - held) / (_CHANGE * span[3:])
            cost += (across / _ACROSS) ** 2 + (along / _ALONG) ** 2 + slow**2
            cost += casadi.sumsqr(change) + _LEAVING * leaving[k]
            within.append((now[3:6] - self.model.low[:3]) / span[:3] + leaving[k])
            within.append((self.model.high[:3] - now[3:6]) / span[:3] + leaving[k])
            within.append(1.0 - (w - held) / (rates * self.interval))
            within.append(1.0 + (w - held) / (rates * self.interval))
            before, held = now, w
        unknown = casadi.vertcat(casadi.vec(states), casadi.vec(inputs), leaving)
        given = casadi.vertcat(start, last, shift, casadi.vec(wanted))
        constraints = casadi.vertcat(*equal, *within)
        rows = n * self.size
        self.lower = np.zeros(constraints.shape[0])
        self.upper = np.r_[np.zeros(rows), np.full(constraints.shape[0] - rows, np.inf)]
        free = np.full(rows, np.inf)
        self.least = np.r_[-free, np.tile(self.model.low[3:], n), np.zeros(n)]
        self.most = np.r_[free, np.tile(self.model.high[3:], n), np.full(n, np.inf)]
        problem = {"x": unknown, "p": given, "f": cost, "g": constraints}
        settings = {
            "expand": True,
            "print_time": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": 25,
            "ipopt.tol": 1e-3,
            "ipopt.acceptable_tol": 1e-2,
            "ipopt.acceptable_iter": 3,
            "ipopt.mu_strategy": "monotone",
            "ipopt.mu_init": 1e-2,
            "ipopt.mu_target": 1e-4,
            "ipopt.warm_start_init_point": "yes",
        }
        self.solver = casadi.nlpsol("predictive", "ipopt", problem, settings)

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
        ahead = place + self.speed * self.interval * np.arange(1, n + 1)
        wanted = self.track.at(ahead)[:, :3]
        start = np.r_[measured, self.memory]
        if self.plan is None:
            states = np.tile(start, (n, 1))
            states[:, :3], states[:, 3] = wanted, max(measured[3], 0.3 * self.speed)
            self.plan = np.r_[states.ravel(), np.tile(used, n), np.zeros(n)]
        given = np.r_[start, used, self.bias, wanted.ravel()]
        extra: dict[str, Any] = {}
        if self.duals is not None:
            extra = {"lam_x0": self.duals[0], "lam_g0": self.duals[1]}
        found = self.solver(
            x0=self.plan, p=given, lbx=self.least, ubx=self.most, lbg=self.lower, ubg=self.upper,
            **extra,
        )  # fmt: skip
        plan = np.asarray(found["x"]).ravel()
        if not np.isfinite(plan).all():
            self.plan = self.duals = None
            return used
        self.duals = (found["lam_x"], found["lam_g"])
        cut = n * self.size
        states, inputs = plan[:cut].reshape(n, -1), plan[cut : cut + 2 * n].reshape(n, 2)
        # the next solution begins where this one has arrived by then
        later = np.r_[states[1:], states[-1:]]
        self.plan = np.r_[later.ravel(), np.r_[inputs[1:], inputs[-1:]].ravel(), plan[-n:]]
        return np.clip(inputs[0], self.model.low[3:], self.model.high[3:])


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
        self.model, self.track, self.speed, self.gains = model, track, speed, gains
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
        gains, dt = self.gains, self.model.dt
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
