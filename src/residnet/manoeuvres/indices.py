"""Manoeuvring indices from logged motion: turning circle, zigzag, stopping; and IMO's limits.

Crossings and peaks are found between samples. Definitions as in IMO resolution MSC.137(76) and
ITTC procedure 7.5-02-06-01. All SI and rad; lengths also in hull lengths. The limits are those of
the resolution, Standards for Ship Manoeuvrability, for ships of 100 m and more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy

from residnet.core.errors import DataError
from residnet.core.log import Log

UNITS: dict[str, str] = {
    "approach_speed": "m/s",
    "advance": "m", "transfer": "m", "tactical_diameter": "m", "time_90": "s", "time_180": "s",
    "steady_diameter": "m", "steady_speed": "m/s", "steady_speed_ratio": "-",
    "steady_drift_angle": "rad", "steady_yaw_rate": "rad/s",
    "pull_out_yaw_rate": "rad/s",
    "initial_turning_time": "s", "initial_turning_distance": "m",
    "first_overshoot": "rad", "second_overshoot": "rad", "time_to_check_yaw": "s",
    "overshoot_width": "m",
    "reach": "s", "period": "s", "largest_yaw_rate": "rad/s", "largest_roll_angle": "rad",
    "track_reach": "m", "head_reach": "m", "lateral_deviation": "m", "stopping_time": "s",
    "steers": "-", "yaw_rates": "rad/s", "loop_height": "rad/s",
    "largest_cross_track_error": "m", "rms_cross_track_error": "m", "course_time": "s",
    "rmse_u": "m/s", "rmse_v": "m/s", "rmse_r": "rad/s", "position_error_end": "m",
    "heading_error_end": "rad",
    "mean_position_error": "m", "mean_heading_error": "rad",
}  # fmt: skip
"""Unit of each index."""

IN_LENGTHS = {
    "advance", "transfer", "tactical_diameter", "steady_diameter", "initial_turning_distance",
    "overshoot_width", "track_reach", "head_reach", "lateral_deviation",
}  # fmt: skip

_TURN = math.pi / 2


class Track:
    """The motion of a log as smooth functions of its time.

    Samples at which a channel is empty are left out.

    Raises:
        DataError: where fewer than four samples hold all of x, y, psi, u, v, r.
    """

    def __init__(self, log: Log) -> None:
        motion = log.stack(("x", "y", "psi", "u", "v", "r"))
        whole = np.isfinite(motion).all(axis=1)
        if whole.sum() < 4:
            raise DataError(
                f"log {log.name}: {int(whole.sum())} samples hold x, y, psi, u, v and r together;"
                " indices need at least 4"
            )
        self.t: np.ndarray = log.t[whole] - log.t[0]
        x, y, self.heading, self.u, self.v, self.r = motion[whole].T
        self.speed = np.hypot(self.u, self.v)
        self._roll = log["phi"][whole] if "phi" in log.channels else np.zeros(0)
        path = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
        self.psi, self.x, self.y, self.travelled = (
            scipy.interpolate.CubicSpline(self.t, values) for values in (self.heading, x, y, path)
        )

    @property
    def end(self) -> float:
        """The last time in s."""
        return float(self.t[-1])

    def approach(self, start: float) -> float:
        """Return the speed at the last sample before or at the order at `start`."""
        return float(self.speed[max(int(np.searchsorted(self.t, start + 1e-9)) - 1, 0)])

    def heel(self, start: float) -> dict[str, float]:
        """Return the largest roll angle from `start` on to either side; empty without one."""
        rolled = np.abs(self._roll[self.t >= start]) if self._roll.size else self._roll
        known = rolled[np.isfinite(rolled)]
        return {"largest_roll_angle": float(known.max())} if known.size else {}

    def crossing(self, level: float, after: float, sign: float = 1.0) -> float | None:
        """Return the first time after `after` at which sign * heading rises to sign * `level`.

        None where it does not.
        """
        return first_crossing(lambda t: sign * (self.psi(t) - level), self.t, after)

    def peak(self, begin: float, end: float, sign: float) -> tuple[float, float]:
        """Return the time and value of the largest sign * heading within begin .. end."""
        inside = self.t[(self.t > begin) & (self.t < end)]
        times = np.concatenate(([begin], inside, [end]))
        best = int(np.argmax(sign * self.psi(times)))
        low, high = times[max(best - 1, 0)], times[min(best + 1, times.size - 1)]
        rate = self.psi.derivative()
        if best in (0, times.size - 1) or sign * rate(low) <= 0 or sign * rate(high) >= 0:
            return float(times[best]), float(sign * self.psi(times[best]))
        time = float(scipy.optimize.brentq(lambda at: float(rate(at)), low, high, xtol=1e-12))
        return time, float(sign * self.psi(time))

    def relative_position(self, time: float, origin: float) -> tuple[float, float]:
        """Return the place at `time` in m ahead and to starboard of the vessel's place at `origin`.

        Ahead is along the heading that the vessel had at `origin`; both times are in s.
        """
        north, east = float(self.x(time) - self.x(origin)), float(self.y(time) - self.y(origin))
        c, s = math.cos(float(self.psi(origin))), math.sin(float(self.psi(origin)))
        return north * c + east * s, east * c - north * s


def first_crossing(function: Callable[[Any], Any], t: np.ndarray, after: float) -> float | None:
    """Return the first time after `after` at which a function rises through zero.

    The time lies between samples at t [T]; None where the function does not rise through zero.
    """
    times = np.concatenate(([after], t[t > after]))
    values = function(times)
    rising = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
    if rising.size == 0:
        return None
    i = int(rising[0])
    if values[i + 1] == 0:
        return float(times[i + 1])
    return float(scipy.optimize.brentq(function, times[i], times[i + 1], xtol=1e-12))


def in_lengths(indices: dict[str, Any], length: float | None) -> dict[str, Any]:
    """Return the indices with their distances in hull lengths as well, `<index>_lengths`."""
    if length is None:
        return indices
    return indices | {
        f"{name}_lengths": value / length for name, value in indices.items() if name in IN_LENGTHS
    }


def turning(
    log: Log, start: float, side: float, until: float, length: float | None
) -> dict[str, Any]:
    """Return the indices of a turning circle.

    Advance is along, transfer and tactical diameter are across the heading at `start`, towards the
    turn. The steady turn is the last half turn before the heading has changed by `until`, where
    that is a full turn or more; its drift angle is positive with the bow inside the turn.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the helm order in s.
        side: +1 to starboard, -1 to port.
        until: heading change that ends the steady turn, rad.
        length: of the hull in m.
    """
    track = Track(log)
    if track.end <= start:
        return {}
    origin = float(track.psi(start))
    indices: dict[str, Any] = {"approach_speed": track.approach(start), **track.heel(start)}
    quarter, half = (
        track.crossing(origin + side * angle, start, side) for angle in (_TURN, 2 * _TURN)
    )
    if quarter is not None:
        ahead, across = track.relative_position(quarter, start)
        indices |= {"advance": ahead, "transfer": side * across, "time_90": quarter - start}
    if half is not None:
        indices |= {
            "tactical_diameter": side * track.relative_position(half, start)[1],
            "time_180": half - start,
        }
    begin, end = (
        track.crossing(origin + side * angle, start, side) for angle in (until - math.pi, until)
    )
    if until < 2 * math.pi - 1e-9 or begin is None:
        return in_lengths(indices, length)
    inside = (track.t >= begin) & (track.t <= (track.end if end is None else end))
    if inside.any():
        speed, rate = float(track.speed[inside].mean()), float(np.abs(track.r[inside].mean()))
        drift = np.arctan2(-side * track.v[inside], track.u[inside])
        indices |= {
            "steady_diameter": 2 * speed / rate,
            "steady_speed": speed,
            "steady_yaw_rate": rate,
            "steady_drift_angle": float(drift.mean()),
        }
        if indices["approach_speed"] > 0:
            indices["steady_speed_ratio"] = speed / indices["approach_speed"]
    return in_lengths(indices, length)


def zigzag(
    log: Log, start: float, side: float, heading: float, length: float | None
) -> dict[str, Any]:
    """Return the indices of a zigzag.

    An overshoot is how far the heading goes beyond its bound after a reversal. The time to check
    yaw is from the first reversal to the peak of the heading; the overshoot width is how far the
    track moves on across the initial course after that reversal; the reach is the time from the
    first execute until the heading is back on the initial course; the period is that of a whole
    cycle, from reversal to reversal of the same side, mean over the log. The initial course is the
    heading that the log begins with.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the first execute in s.
        side: of the first execute, +1 starboard, -1 port.
        heading: change of heading at which the steering is reversed, rad.
        length: of the hull in m.
    """
    track = Track(log)
    if track.end <= start:
        return {}
    origin = float(track.heading[0])
    reversals: list[float] = []
    overshoots: list[tuple[float, float]] = []
    now, towards = start, side
    while (reversal := track.crossing(origin + towards * heading, now, towards)) is not None:
        reversals.append(reversal)
        back = track.crossing(origin + towards * heading, reversal + 1e-9, -towards)
        if back is not None:
            time, value = track.peak(reversal, back, towards)
            overshoots.append((time, value - towards * origin - heading))
        now, towards = reversal, -towards
    indices: dict[str, Any] = {
        "approach_speed": track.approach(start),
        "largest_yaw_rate": float(np.abs(track.r[track.t >= start]).max()),
        **track.heel(start),
    }
    if reversals:
        turned = track.travelled(reversals[0]) - track.travelled(start)
        indices |= {
            "initial_turning_time": reversals[0] - start,
            "initial_turning_distance": float(turned),
        }
        back = track.crossing(origin, reversals[0], -side)
        indices |= {} if back is None else {"reach": back - start}
    names = ("first_overshoot", "second_overshoot")
    indices |= {name: value for name, (_, value) in zip(names, overshoots, strict=False)}
    if overshoots:
        indices["time_to_check_yaw"] = overshoots[0][0] - reversals[0]
    if len(reversals) > 1:
        times = np.linspace(reversals[0], reversals[1], 500)
        aside = np.array([side * track.relative_position(time, start)[1] for time in times])
        indices["overshoot_width"] = float(aside.max() - aside[0])
    if len(reversals) > 2:
        indices["period"] = float(np.mean(np.array(reversals[2:]) - np.array(reversals[:-2])))
    return in_lengths(indices, length)


def stopping(log: Log, start: float, length: float | None) -> dict[str, Any]:
    """Return the indices of a stopping trial: distances along the track, ahead and across.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the order astern in s; the trial ends where the surge velocity is zero.
        length: of the hull in m.
    """
    track = Track(log)
    surge = scipy.interpolate.CubicSpline(track.t, track.u)
    indices: dict[str, Any] = {"approach_speed": track.approach(start)}
    stop = first_crossing(lambda t: -surge(t), track.t, start)
    if stop is None:
        return indices
    ahead, across = track.relative_position(stop, start)
    indices |= {
        "track_reach": float(track.travelled(stop) - track.travelled(start)),
        "head_reach": ahead,
        "lateral_deviation": abs(across),
    }
    return in_lengths(indices | {"stopping_time": stop - start}, length)


def turning_limits(length: float) -> dict[str, float]:
    """Return IMO's largest advance and tactical diameter in m, at full rudder (section 5.3.1)."""
    return {"advance": 4.5 * length, "tactical_diameter": 5.0 * length}


def zigzag_limits(nominal: float, length: float, speed: float) -> dict[str, float]:
    """Return IMO's limits of the 10/10 or the 20/20 zigzag (sections 5.3.2 and 5.3.3).

    These are overshoots in rad, of the 10/10 growing with length [m] over speed [m/s] between 10 s
    and 30 s, and its distance of the initial turn in m.
    """
    if nominal == 20.0:
        return {"first_overshoot": math.radians(25.0)}
    ratio = min(max(length / speed, 10.0), 30.0) if speed > 0 else 30.0
    return {
        "first_overshoot": math.radians(5.0 + 0.5 * ratio),
        "second_overshoot": math.radians(17.5 + 0.75 * ratio),
        "initial_turning_distance": 2.5 * length,
    }


def stopping_limits(length: float) -> dict[str, float]:
    """Return IMO's limit of a full-astern stop: track reach in m (section 5.3.4)."""
    return {"track_reach": 15.0 * length}


_MOVING, _OVER = 0.1, 0.5
"""Share of the largest rudder rate from which the rudder moves, and share of the angle held from
which it is on a side."""


class SteeredZigzag(NamedTuple):
    """A zigzag as it was steered, so that a model can repeat it in closed loop.

    Attributes:
        start: time of the first execute in s, from the log's first sample.
        side: of the first execute, +1 starboard, -1 port.
        angle: rudder angle held, mean over both sides, rad.
        heading: change of heading at which the rudder was ordered back, mean over the reversals,
            rad.
        leaves: change of heading at which the rudder left its side, rad; beyond `heading` by what
            the vessel turned while the order took effect.
        turning: rate of turn when it left, mean over the reversals, rad/s.
    """

    start: float
    side: float
    angle: float
    heading: float
    leaves: float
    turning: float


def steered_zigzag(log: Log, rudder: str) -> SteeredZigzag:
    """Return the zigzag of a log that holds t, psi and a rudder angle.

    An order is given at the last sample before the rudder moves, at a tenth of its largest rate.
    When the rudder left its side is known to a fraction of a sample, by its rate on the way across:
    a sample of a coarse grid can be worth half a degree of heading.

    Raises:
        DataError: where the rudder does not change sides with the heading at least twice.
    """
    delta, psi = log[rudder], log["psi"] - log["psi"][0]
    low, high = (float(level) for level in np.quantile(delta, (0.05, 0.95)))
    middle, angle = 0.5 * (low + high), 0.5 * (high - low)
    rate = np.abs(np.gradient(delta, log.t))
    moving = rate > _MOVING * rate.max()
    # -1, 0 or +1: the side that the rudder is held on, 0 between them
    held = np.where(np.abs(delta - middle) > _OVER * angle, np.sign(delta - middle), 0.0)
    over = np.flatnonzero(held)
    changed = held[over[1:]] != held[over[:-1]]
    # the rudder may rest beside the middle before the first order
    begun = int(np.argmax(moving))
    arrived = int(np.argmax(~moving & (np.arange(delta.size) > begun)))
    pairs = zip(over[:-1][changed].tolist(), over[1:][changed].tolist(), strict=True)
    reversals = [(a, b) for a, b in pairs if b > arrived]
    if angle == 0.0 or len(reversals) < 2:
        raise DataError(
            f"log {log.name}: the rudder is reversed {len(reversals)} times; a zigzag needs at"
            " least 2"
        )
    side = float(np.sign(delta[arrived] - delta[begun]))
    towards = side * (-1.0) ** np.arange(len(reversals))
    orders = [int(np.flatnonzero(~moving[:b])[-1]) for _, b in reversals]
    crossed = []
    for a, b in reversals:
        travel = np.maximum.accumulate(held[b] * (delta[a : b + 1] - middle) / angle)
        # the rudder crosses from -1/2 to +1/2, at a rate that takes it back to where it left -1
        below, above = np.interp((-_OVER, _OVER), travel, log.t[a : b + 1])
        crossed.append(float(below - (1.0 - _OVER) / (2.0 * _OVER) * (above - below)))
    heading = float(np.mean(towards * psi[orders]))
    if heading <= 0.0:
        raise DataError(
            f"log {log.name}: the heading does not follow the rudder at the reversals; check the"
            f" sign of {rudder}"
        )
    leaves, turning = (
        float(np.mean(towards * np.interp(crossed, log.t, values)))
        for values in (psi, np.gradient(psi, log.t))
    )
    start = float(log.t[max(begun - 1, 0)] - log.t[0])
    return SteeredZigzag(start, side, angle, heading, leaves, turning)
