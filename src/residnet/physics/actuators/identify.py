"""Actuators identified from tests: throttle map, rate limit and dead time, thrust curves.

Source: document 003 section 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from residnet.core.errors import FitError


class Estimate(NamedTuple):
    """A number with its 95 % interval, in `unit`."""

    value: float
    low: float
    high: float
    unit: str


class ThrottleMap(NamedTuple):
    """The revolutions n = slope * throttle + offset [1/s], bounded by +-n_max.

    n_max is the largest value measured where nothing saturated.
    """

    slope: Estimate
    offset: Estimate
    n_max: Estimate
    saturated: bool

    def __call__(self, throttle: np.ndarray) -> np.ndarray:
        """Return the revolutions [1/s]."""
        return np.clip(
            self.slope.value * throttle + self.offset.value, -self.n_max.value, self.n_max.value
        )


class StepAnswer(NamedTuple):
    """Rate limit [1/s^2] and dead time [s] of a shaft."""

    rate: Estimate
    dead_time: Estimate


class ThrustFit(NamedTuple):
    """The thrust curve of one direction: coefficients, range of revolutions and rms residual.

    The coefficients are c0 [N], c1 [N s], c2 [N s^2]; the residual is in N.
    """

    coefficients: tuple[Estimate, Estimate, Estimate]
    low: float
    high: float
    rms: float

    def __call__(self, n: np.ndarray) -> np.ndarray:
        """Return the thrust [N] per thruster at n [1/s]."""
        c = [estimate.value for estimate in self.coefficients]
        out: np.ndarray = c[0] + n * (c[1] + n * c[2])
        return out


_SATURATION_POINTS = 3
"""Points at the same revolutions from which a bound is believed."""


def fit_throttle(throttle: np.ndarray, n: np.ndarray) -> ThrottleMap:
    """Fit the steady revolutions n [N] in 1/s over the throttle [N]: a line with a bound.

    Slope, offset and bound are found together by least squares.

    Raises:
        FitError: with fewer than five points or fewer than three different throttles on the slope,
            throttle of one direction only, or revolutions that fall with the throttle.
    """
    if throttle.size < 5 or np.unique(throttle).size < 3:
        raise FitError(
            f"throttle test: {throttle.size} points at {np.unique(throttle).size} throttles; at"
            " least 5 points at 3 throttles are needed"
        )
    if throttle.min() >= 0 or throttle.max() <= 0:
        raise FitError(
            "throttle test: only one direction was measured; the map needs throttle ahead and"
            " astern"
        )
    if np.corrcoef(throttle, n)[0, 1] < 0.5:
        raise FitError(
            "throttle test: revolutions do not rise with the throttle; check the columns, their"
            " signs and units"
        )
    reach, top = float(np.abs(throttle).max()), float(np.abs(n).max())
    slope = top / reach
    flat = np.abs(n) > 0.97 * top
    saturated = flat.sum() >= _SATURATION_POINTS and np.ptp(np.abs(throttle[flat])) > 0.05 * reach
    start, scale = [slope, 0.0], [slope, 0.1 * top]
    if saturated:
        free = ~flat
        if np.unique(throttle[free]).size >= 2:
            start[0] = scale[0] = float(np.polyfit(throttle[free], n[free], 1)[0])
        start, scale = [*start, float(np.median(np.abs(n[flat])))], [*scale, top]

    def residual(p: np.ndarray) -> np.ndarray:
        most = p[2] if saturated else np.inf
        return np.asarray(np.clip(p[0] * throttle + p[1], -most, most) - n)

    value, error = _least_squares(residual, start, scale, n.size)
    if not saturated:
        value, error = [*value, top], [*error, 0.0]
    slope_, offset, n_max = (
        Estimate(v, v - e, v + e, "1/s") for v, e in zip(value, error, strict=True)
    )
    return ThrottleMap(slope_, offset, n_max, bool(saturated))


def follow_command(
    t: np.ndarray, command: np.ndarray, rate: float, dead_time: float, start: float
) -> np.ndarray:
    """Return the revolutions [T] that follow a command with dead time and rate limit.

    Args:
        t: times [T] in s.
        command: commanded revolutions [T] in 1/s, held between samples.
        rate: largest change in 1/s^2.
        dead_time: between a command and its first effect, in s.
        start: revolutions at the first sample in 1/s.
    """
    late = t - dead_time
    index = np.searchsorted(t, late, side="right") - 1
    n = np.empty_like(t)
    n[0] = start
    step = rate * np.diff(t)
    for k in range(1, t.size):
        # the command that acted over the interval, with its share where it changed inside
        before, after = command[max(index[k - 1], 0)], command[max(index[k], 0)]
        share = (
            1.0 if before == after else (late[k] - t[max(index[k], 0)]) / (late[k] - late[k - 1])
        )
        first = n[k - 1] + np.clip(
            before - n[k - 1], -step[k - 1] * (1 - share), step[k - 1] * (1 - share)
        )
        n[k] = first + np.clip(after - first, -step[k - 1] * share, step[k - 1] * share)
    return n


def fit_step(runs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> StepAnswer:
    """Fit rate limit and dead time to step responses.

    Args:
        runs: for each response t [T] in s, command [T] and n [T] in 1/s.

    Raises:
        FitError: where a run is too short, its command does not step, or the revolutions do not
            follow.
    """
    for t, command, n in runs:
        if t.size < 20:
            raise FitError(f"step test: {t.size} samples; at least 20 are needed")
        if np.ptp(command) == 0:
            raise FitError("step test: the command never changes; a step is needed")
        if np.ptp(n) < 0.3 * np.ptp(command):
            raise FitError(
                "step test: the revolutions hardly follow the command; check columns and units, and"
                " log until they settle"
            )
    t, command, n = max(runs, key=lambda run: np.ptp(run[1]))
    steep = float(np.percentile(np.abs(np.gradient(n, t)), 95))
    moved = t[np.flatnonzero(np.abs(command - command[0]) > 0.5 * np.ptp(command))[0]]
    rise = np.flatnonzero((np.abs(n - n[0]) > 0.1 * np.ptp(n)) & (t >= moved))
    delay = max(float(t[rise[0]] - moved) - 0.1 * np.ptp(n) / steep, 0.0) if rise.size else 0.0

    def residual(p: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [
                follow_command(t, c, abs(p[0]), max(p[1], 0.0), float(n[:3].mean())) - n
                for t, c, n in runs
            ]
        )

    size = sum(run[0].size for run in runs)
    value, error = _least_squares(
        residual,
        [steep, delay],
        [steep, max(delay, 10 * float(np.median(np.diff(t))))],
        size,
        serial=True,
    )
    rate, dead = abs(value[0]), max(value[1], 0.0)
    return StepAnswer(
        Estimate(rate, rate - error[0], rate + error[0], "1/s^2"),
        Estimate(dead, max(dead - error[1], 0.0), dead + error[1], "s"),
    )


def fit_thrust(n: np.ndarray, pull: np.ndarray, thrusters: int) -> tuple[ThrustFit, ThrustFit]:
    """Fit the thrust per thruster over revolutions, ahead and astern, to a bollard pull.

    Args:
        n: revolutions [N] in 1/s.
        pull: pull [N] in N of all thrusters together.

    Raises:
        FitError: where a direction has fewer than five points or four revolutions, or pulls the
            wrong way.
    """
    return _direction(n[n > 0], pull[n > 0] / thrusters, "ahead"), _direction(
        n[n < 0], pull[n < 0] / thrusters, "astern"
    )


def _direction(n: np.ndarray, thrust: np.ndarray, name: str) -> ThrustFit:
    from scipy.stats import t as student

    levels = np.unique(np.round(n / max(float(np.abs(n).max(initial=0.0)), 1e-9), 2)).size
    if n.size < 5 or levels < 4:
        raise FitError(
            f"bollard pull {name}: {n.size} points at {levels} revolutions; a quadratic with"
            " intervals needs 5 at 4 revolutions in each direction"
        )
    sign = 1.0 if name == "ahead" else -1.0
    if float(np.sum(thrust * np.abs(n))) * sign < 0:
        raise FitError(
            f"bollard pull {name}: the pull has the wrong sign; thrust is positive ahead and"
            " negative astern"
        )
    scale = float(np.abs(n).max())
    columns = np.stack((np.ones_like(n), n / scale, (n / scale) ** 2), axis=1)
    solution, *_ = np.linalg.lstsq(columns, thrust, rcond=None)
    residual = thrust - columns @ solution
    variance = float(residual @ residual) / (n.size - 3)
    spread = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)) * variance) * float(
        student.ppf(0.975, n.size - 3)
    )
    factors = np.array([1.0, scale, scale**2])
    parts = zip(solution / factors, spread / factors, ("N", "N s", "N s^2"), strict=True)
    first, second, third = (
        Estimate(float(v), float(v - e), float(v + e), unit) for v, e, unit in parts
    )
    return ThrustFit(
        (first, second, third), float(n.min()), float(n.max()), float(np.sqrt(variance))
    )


def _least_squares(
    residual: Callable[[np.ndarray], np.ndarray],
    start: list[float],
    scale: list[float],
    size: int,
    *,
    serial: bool = False,
) -> tuple[list[float], list[float]]:
    """Return the parameters and half widths of their 95 % intervals.

    Widened for residuals that follow each other where they are a series.
    """
    from scipy.optimize import least_squares
    from scipy.stats import t as student

    found = least_squares(residual, start, x_scale=np.abs(scale), diff_step=[1e-3] * len(start))
    variance = 2 * float(found.cost) / (size - len(start))
    if serial:
        e = found.fun - found.fun.mean()
        keep = float(np.clip(np.sum(e[1:] * e[:-1]) / max(float(np.sum(e * e)), 1e-300), 0.0, 0.99))
        variance *= (1 + keep) / (1 - keep)
    slopes = np.asarray(found.jac)
    covariance = np.linalg.pinv(slopes.T @ slopes) * variance
    half = np.sqrt(np.diag(covariance)) * float(student.ppf(0.975, size - len(start)))
    return [float(v) for v in found.x], [float(h) for h in half]
