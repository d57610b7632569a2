"""Manoeuvring indices of logs: turning circle, zigzag and stopping trial, with the IMO limits.

Crossings and peaks are interpolated between samples. The definitions are those of IMO resolution
MSC.137(76), Standards for Ship Manoeuvrability, and ITTC procedure 7.5-02-06-01. Values are in SI
and rad, distances also in hull lengths. The limits apply to ships of 100 m and more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy

from residnet.core.errors import DataError
from residnet.core.log import Log

INDEX_UNITS: dict[str, str] = {
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

LENGTH_INDICES = {
    "advance", "transfer", "tactical_diameter", "steady_diameter", "initial_turning_distance",
    "overshoot_width", "track_reach", "head_reach", "lateral_deviation",
}  # fmt: skip
"""Indices that are distances, which are also expressed in hull lengths."""

_QUARTER_TURN = math.pi / 2


class SmoothTrack:
    """The motion of a log as cubic splines over time.

    Samples with a missing channel are omitted.

    Raises:
        DataError: if fewer than four samples have all of x, y, psi, u, v, r.
    """

    def __init__(self, log: Log) -> None:
        motion = log.stack(("x", "y", "psi", "u", "v", "r"))
        is_complete = np.isfinite(motion).all(axis=1)
        if is_complete.sum() < 4:
            raise DataError(
                f"log {log.name}: {int(is_complete.sum())} samples have all of x, y, psi, u, v and"
                " r; indices need at least 4"
            )
        self.t: np.ndarray = log.t[is_complete] - log.t[0]
        x, y, self.heading, self.u, self.v, self.r = motion[is_complete].T
        self.speed = np.hypot(self.u, self.v)
        self._roll = log["phi"][is_complete] if "phi" in log.channels else np.zeros(0)
        # chords between samples: the error of second order is negligible at the sampling of logs
        cumulative_distance = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
        self.psi, self.x, self.y, self.distance_travelled = (
            scipy.interpolate.CubicSpline(self.t, values)
            for values in (self.heading, x, y, cumulative_distance)
        )

    @property
    def end_time(self) -> float:
        """Time of the last sample in s."""
        return float(self.t[-1])

    def approach_speed(self, start: float) -> float:
        """Return the speed at the last sample up to the order at `start`."""
        # the last sample before the order, since the speed drops in the turn
        return float(self.speed[max(int(np.searchsorted(self.t, start + 1e-9)) - 1, 0)])

    def max_roll_angle(self, start: float) -> dict[str, float]:
        """Return the largest roll angle to either side after `start`; empty without roll."""
        roll_magnitude = np.abs(self._roll[self.t >= start]) if self._roll.size else self._roll
        finite_roll = roll_magnitude[np.isfinite(roll_magnitude)]
        return {"largest_roll_angle": float(finite_roll.max())} if finite_roll.size else {}

    def first_heading_crossing(
        self, level: float, start_time: float, sign: float = 1.0
    ) -> float | None:
        """Return the first time after `start_time` at which sign * heading rises to sign * `level`.

        The result is None if the heading does not reach the level.
        """
        return first_crossing(lambda t: sign * (self.psi(t) - level), self.t, start_time)

    def heading_peak(
        self, interval_start: float, interval_end: float, sign: float
    ) -> tuple[float, float]:
        """Return the time and the value of the maximum of sign * heading in an interval."""
        # the largest sample first, then the root of the derivative on both sides of it
        sample_times = self.t[(self.t > interval_start) & (self.t < interval_end)]
        times = np.concatenate(([interval_start], sample_times, [interval_end]))
        peak_index = int(np.argmax(sign * self.psi(times)))
        lower_time = times[max(peak_index - 1, 0)]
        upper_time = times[min(peak_index + 1, times.size - 1)]
        derivative = self.psi.derivative()
        if (
            # without a change of sign of the derivative the sample itself is the maximum
            peak_index in (0, times.size - 1)
            or sign * derivative(lower_time) <= 0
            or sign * derivative(upper_time) >= 0
        ):
            return float(times[peak_index]), float(sign * self.psi(times[peak_index]))
        time = float(
            scipy.optimize.brentq(
                lambda at: float(derivative(at)), lower_time, upper_time, xtol=1e-12
            )
        )
        return time, float(sign * self.psi(time))

    def relative_position(self, time: float, start_time: float) -> tuple[float, float]:
        """Return the displacement since `start_time`, in m ahead and to starboard.

        Ahead is the direction of the heading at `start_time`. Both times are in s.
        """
        north = float(self.x(time) - self.x(start_time))
        east = float(self.y(time) - self.y(start_time))
        start_heading = float(self.psi(start_time))
        cos_psi = math.cos(start_heading)
        sin_psi = math.sin(start_heading)
        return north * cos_psi + east * sin_psi, east * cos_psi - north * sin_psi


def first_crossing(
    function: Callable[[Any], Any], t: np.ndarray, start_time: float
) -> float | None:
    """Return the first time after `start_time` at which a function rises through zero.

    The sign changes are searched between samples at t [T]. The result is None without a change.
    """
    times = np.concatenate(([start_time], t[t > start_time]))
    values = function(times)
    rising_indices = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
    if rising_indices.size == 0:
        return None
    i = int(rising_indices[0])
    # brentq needs values of opposite signs
    if values[i + 1] == 0:
        return float(times[i + 1])
    return float(scipy.optimize.brentq(function, times[i], times[i + 1], xtol=1e-12))


def add_values_in_lengths(indices: dict[str, Any], length: float | None) -> dict[str, Any]:
    """Return the indices, with distances also in hull lengths as `<index>_lengths`."""
    if length is None:
        return indices
    return indices | {
        f"{name}_lengths": value / length
        for name, value in indices.items()
        if name in LENGTH_INDICES
    }


def turning_circle_indices(
    log: Log, start: float, turn_sign: float, final_heading_change: float, length: float | None
) -> dict[str, Any]:
    """Return the indices of a turning circle.

    Advance is the distance along the heading at `start`; transfer and tactical diameter are the
    distances across it, positive towards the turn. The steady turn is the last half turn up to
    `final_heading_change`, which must be at least a full turn; otherwise the indices of the steady
    turn are omitted. The drift angle is positive with the bow inside the turn.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the helm order in s.
        turn_sign: +1 to starboard, -1 to port.
        final_heading_change: magnitude of the change of heading at the end of the trial in rad.
        length: length of the hull in m; None if unknown.
    """
    track = SmoothTrack(log)
    if track.end_time <= start:
        return {}
    initial_heading = float(track.psi(start))
    indices: dict[str, Any] = {
        "approach_speed": track.approach_speed(start),
        **track.max_roll_angle(start),
    }
    quarter_time, half_time = (
        track.first_heading_crossing(initial_heading + turn_sign * angle, start, turn_sign)
        for angle in (_QUARTER_TURN, 2 * _QUARTER_TURN)
    )
    if quarter_time is not None:
        advance, transfer = track.relative_position(quarter_time, start)
        indices |= {
            "advance": advance,
            "transfer": turn_sign * transfer,
            "time_90": quarter_time - start,
        }
    if half_time is not None:
        indices |= {
            "tactical_diameter": turn_sign * track.relative_position(half_time, start)[1],
            "time_180": half_time - start,
        }
    steady_start, steady_end = (
        track.first_heading_crossing(initial_heading + turn_sign * angle, start, turn_sign)
        # the last half turn: by then the speed has become steady
        for angle in (final_heading_change - math.pi, final_heading_change)
    )
    if final_heading_change < 2 * math.pi - 1e-9 or steady_start is None:
        return add_values_in_lengths(indices, length)
    is_steady = (track.t >= steady_start) & (
        track.t <= (track.end_time if steady_end is None else steady_end)
    )
    if is_steady.any():
        speed = float(track.speed[is_steady].mean())
        rate = float(np.abs(track.r[is_steady].mean()))
        # v is towards the outside of the turn, so that the sign makes the angle positive
        drift = np.arctan2(-turn_sign * track.v[is_steady], track.u[is_steady])
        indices |= {
            # U = r R in a steady turn of radius R
            "steady_diameter": 2 * speed / rate,
            "steady_speed": speed,
            "steady_yaw_rate": rate,
            "steady_drift_angle": float(drift.mean()),
        }
        if indices["approach_speed"] > 0:
            indices["steady_speed_ratio"] = speed / indices["approach_speed"]
    return add_values_in_lengths(indices, length)


def zigzag_indices(
    log: Log, start: float, turn_sign: float, heading: float, length: float | None
) -> dict[str, Any]:
    """Return the indices of a zigzag.

    The overshoot is the angle by which the heading exceeds its bound after a reversal. The time to
    check yaw is the time from the first reversal to the maximum of the heading. The overshoot width
    is the further lateral distance from the initial course after the first reversal. The reach is
    the time from the first execute until the heading returns to the initial course. The period is
    the mean time between reversals to the same side. The initial course is the heading at the first
    sample.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the first execute in s.
        turn_sign: sign of the first execute, +1 to starboard, -1 to port.
        heading: change of heading at which the steering is reversed, rad.
        length: length of the hull in m; None if unknown.
    """
    track = SmoothTrack(log)
    if track.end_time <= start:
        return {}
    initial_course = float(track.heading[0])
    reversals: list[float] = []
    overshoots: list[tuple[float, float]] = []
    current_time = start
    current_sign = turn_sign
    while (
        reversal := track.first_heading_crossing(
            initial_course + current_sign * heading, current_time, current_sign
        )
    ) is not None:
        reversals.append(reversal)
        # the offset excludes the crossing at the reversal itself
        return_time = track.first_heading_crossing(
            initial_course + current_sign * heading, reversal + 1e-9, -current_sign
        )
        if return_time is not None:
            time, value = track.heading_peak(reversal, return_time, current_sign)
            overshoots.append((time, value - current_sign * initial_course - heading))
        current_time = reversal
        current_sign = -current_sign
    indices: dict[str, Any] = {
        "approach_speed": track.approach_speed(start),
        "largest_yaw_rate": float(np.abs(track.r[track.t >= start]).max()),
        **track.max_roll_angle(start),
    }
    if reversals:
        distance_to_reversal = track.distance_travelled(reversals[0]) - track.distance_travelled(
            start
        )
        indices |= {
            "initial_turning_time": reversals[0] - start,
            "initial_turning_distance": float(distance_to_reversal),
        }
        return_time = track.first_heading_crossing(initial_course, reversals[0], -turn_sign)
        if return_time is not None:
            indices["reach"] = return_time - start
    names = ("first_overshoot", "second_overshoot")
    indices |= {name: value for name, (_, value) in zip(names, overshoots, strict=False)}
    if overshoots:
        indices["time_to_check_yaw"] = overshoots[0][0] - reversals[0]
    if len(reversals) > 1:
        sample_times = np.linspace(reversals[0], reversals[1], 500)
        lateral_offset = np.array(
            [turn_sign * track.relative_position(time, start)[1] for time in sample_times]
        )
        indices["overshoot_width"] = float(lateral_offset.max() - lateral_offset[0])
    if len(reversals) > 2:
        # every second reversal is to the same side
        indices["period"] = float(np.mean(np.array(reversals[2:]) - np.array(reversals[:-2])))
    return add_values_in_lengths(indices, length)


def stopping_indices(log: Log, start: float, length: float | None) -> dict[str, Any]:
    """Return the indices of a stopping trial: distances along the track, ahead and across.

    Args:
        log: t, x, y, psi, u, v, r.
        start: time of the order astern in s; the trial ends when the surge velocity is zero.
        length: length of the hull in m; None if unknown.
    """
    track = SmoothTrack(log)
    surge = scipy.interpolate.CubicSpline(track.t, track.u)
    indices: dict[str, Any] = {"approach_speed": track.approach_speed(start)}
    stop_time = first_crossing(lambda t: -surge(t), track.t, start)
    if stop_time is None:
        return indices
    head_reach, lateral_offset = track.relative_position(stop_time, start)
    indices |= {
        "track_reach": float(track.distance_travelled(stop_time) - track.distance_travelled(start)),
        "head_reach": head_reach,
        "lateral_deviation": abs(lateral_offset),
    }
    return add_values_in_lengths(indices | {"stopping_time": stop_time - start}, length)


def turning_limits(length: float) -> dict[str, float]:
    """Return the IMO limits of advance and tactical diameter in m (section 5.3.1)."""
    return {"advance": 4.5 * length, "tactical_diameter": 5.0 * length}


def zigzag_limits(nominal: float, length: float, speed: float) -> dict[str, float]:
    """Return the IMO limits of the 10/10 or the 20/20 zigzag (sections 5.3.2 and 5.3.3).

    They are overshoots in rad and, for the 10/10 zigzag, the distance of the initial turn in m. The
    overshoots of the 10/10 zigzag increase with length / speed between 10 s and 30 s.

    Args:
        nominal: 10 or 20, the angle in deg.
        length: length of the ship in m.
        speed: approach speed in m/s.
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
    """Return the IMO limit of a full-astern stop, the track reach in m (section 5.3.4)."""
    return {"track_reach": 15.0 * length}


_MOVING_RATE_SHARE = 0.1
"""Share of the largest rudder rate above which the rudder counts as moving."""
_SIDE_ANGLE_SHARE = 0.5
"""Share of the commanded angle above which the rudder counts as on one side."""


class SteeredZigzag(NamedTuple):
    """Parameters of a recorded zigzag, with which a model can repeat it in closed loop.

    Attributes:
        start: time of the first execute in s after the first sample.
        first_sign: sign of the first execute, +1 to starboard, -1 to port.
        angle: rudder angle, mean over both sides, rad.
        heading: change of heading at the reversal orders, mean over the reversals, rad.
        departure_heading: change of heading when the rudder begins to move back, rad; larger than
            `heading` by the turn during the delay of the order.
        departure_rate: yaw rate at that time, mean over the reversals, rad/s.
    """

    start: float
    first_sign: float
    angle: float
    heading: float
    departure_heading: float
    departure_rate: float


def identify_zigzag(log: Log, rudder: str) -> SteeredZigzag:
    """Identify the parameters of a zigzag from heading and rudder angle.

    The time of an order is the last sample before the rudder moves faster than a tenth of its
    largest rate. The departure of the rudder from one side is interpolated between samples, because
    the heading can change by half a degree within a coarse sample.

    Args:
        log: log with psi and a rudder angle.
        rudder: name of the channel of the rudder angle.

    Raises:
        DataError: if the rudder does not change sides with the heading at least twice.
    """
    delta = log[rudder]
    psi = log["psi"] - log["psi"][0]
    lower, upper = (float(level) for level in np.quantile(delta, (0.05, 0.95)))
    mid_angle = 0.5 * (lower + upper)
    angle = 0.5 * (upper - lower)
    rate = np.abs(np.gradient(delta, log.t))
    is_moving = rate > _MOVING_RATE_SHARE * rate.max()
    # side of the rudder: -1 port, +1 starboard, 0 in between
    rudder_side = np.where(
        np.abs(delta - mid_angle) > _SIDE_ANGLE_SHARE * angle, np.sign(delta - mid_angle), 0.0
    )
    # a reversal lies between the last sample on one side and the first sample on the other side
    side_samples = np.flatnonzero(rudder_side)
    has_changed = rudder_side[side_samples[1:]] != rudder_side[side_samples[:-1]]
    side_changes = zip(
        side_samples[:-1][has_changed].tolist(), side_samples[1:][has_changed].tolist(), strict=True
    )
    # the first motion of the rudder is the first execute; it can also change the side, since the
    # rudder need not be amidships before
    first_moving = int(np.argmax(is_moving))
    first_execute_end = int(np.argmax(~is_moving & (np.arange(delta.size) > first_moving)))
    reversals = [(last, first) for last, first in side_changes if first > first_execute_end]
    if angle == 0.0 or len(reversals) < 2:
        raise DataError(
            f"log {log.name}: the rudder is reversed {len(reversals)} times; a zigzag needs at"
            " least 2"
        )
    first_sign = float(np.sign(delta[first_execute_end] - delta[first_moving]))
    turn_signs = first_sign * (-1.0) ** np.arange(len(reversals))
    order_samples = [int(np.flatnonzero(~is_moving[:first])[-1]) for _, first in reversals]
    departure_times = [
        _extrapolate_departure_time(
            log.t[last : first + 1],
            rudder_side[first] * (delta[last : first + 1] - mid_angle) / angle,
        )
        for last, first in reversals
    ]
    heading = float(np.mean(turn_signs * psi[order_samples]))
    if heading <= 0.0:
        raise DataError(
            f"log {log.name}: the heading does not follow the rudder at the reversals; check the"
            f" sign of {rudder}"
        )
    departure_heading, departure_rate = (
        float(np.mean(turn_signs * np.interp(departure_times, log.t, values)))
        for values in (psi, np.gradient(psi, log.t))
    )
    start = float(log.t[max(first_moving - 1, 0)] - log.t[0])
    return SteeredZigzag(start, first_sign, angle, heading, departure_heading, departure_rate)


def _extrapolate_departure_time(t: np.ndarray, rudder_fraction: np.ndarray) -> float:
    """Return the time in s at which a rudder began to move from one side to the other.

    The rudder is assumed to move at a constant rate.

    Args:
        t: times [T] in s of the samples of one reversal.
        rudder_fraction: rudder angle as a fraction of the commanded angle, from -1 on the old side
            to 1 on the new side [T].
    """
    # interpolation needs ascending values, without the noise of the rudder angle
    ascending_fraction = np.maximum.accumulate(rudder_fraction)
    # the times at the fractions -1/2 and 1/2 give the rate, which extrapolates back to -1
    start_crossing, end_crossing = np.interp(
        (-_SIDE_ANGLE_SHARE, _SIDE_ANGLE_SHARE), ascending_fraction, t
    )
    time_per_crossing = end_crossing - start_crossing
    return float(
        start_crossing - (1.0 - _SIDE_ANGLE_SHARE) / (2.0 * _SIDE_ANGLE_SHARE) * time_per_crossing
    )
