"""Motion from positions and headings, and regressions of columns on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from residnet.core.frames import rotate, unwrap_angle
from residnet.core.units import si_unit, to_si, unit_names
from residnet.preprocessing.derivatives import fit_local_polynomials
from residnet.preprocessing.motion import remove_pauses

_MIN_WINDOW_SECONDS = 1.0
"""Shortest window in s in which positions are differentiated."""
_MAX_UNIT_RATIO = 1.35
"""Largest ratio between an estimated factor and that of its unit."""
MIN_STANDARD_ERRORS = 4.0
"""Smallest estimate, in standard errors, from which a sign is determined."""
MIN_CORRELATION = 0.6
"""Smallest significant correlation."""


class PoseFrame(NamedTuple):
    """Frame of columns called x, y, psi.

    Attributes:
        is_swapped: whether x is east and y is north.
        is_from_east: whether psi is counter-clockwise from east.
        is_reversed: whether psi has the opposite direction.
    """

    is_swapped: bool
    is_from_east: bool
    is_reversed: bool = False


POSE_FRAMES = (PoseFrame(False, False), PoseFrame(True, False), PoseFrame(False, True))
"""Distinguishable frames; both changes together give a mirror image with equal consistency."""
ROS_POSE_FRAMES = (PoseFrame(True, True), PoseFrame(True, False))
"""Frames of a ROS pose, first that of REP 103: x east, y north, heading from east."""


@dataclass(frozen=True)
class RawTable:
    """Columns of one log before any conversion.

    Attributes:
        t: times [T] in s.
        columns: channel -> values [T] in the unit of the file.
    """

    t: np.ndarray
    columns: Mapping[str, np.ndarray]


class ScaleFit(NamedTuple):
    """Regression of a quantity in SI on a column.

    Attributes:
        factor: factor from the column to SI; negative for the opposite direction.
        correlation: absolute value of the correlation.
    """

    factor: float
    correlation: float

    @property
    def is_significant(self) -> bool:
        """Whether the correlation is large enough to determine factor and sign."""
        return (
            self.correlation >= MIN_CORRELATION and np.isfinite(self.factor) and self.factor != 0.0
        )

    def matching_unit(self, expected: str) -> str | None:
        """Return the unit with nearly this factor, or None.

        Args:
            expected: SI unit of the dimension.
        """
        excluded_units = ("rad/min", "m/min")
        candidate_units = [
            n for n in unit_names() if si_unit(n) == expected and n not in excluded_units
        ]
        closest_unit = min(
            candidate_units, key=lambda name: abs(np.log(abs(self.factor) / to_si(name)))
        )
        ratio = abs(self.factor) / to_si(closest_unit)
        return closest_unit if 1.0 / _MAX_UNIT_RATIO < ratio < _MAX_UNIT_RATIO else None


class Motion(NamedTuple):
    """Motion of one log from its positions and headings, on a uniform grid.

    Attributes:
        t: times [T] in s.
        surge_velocity: velocity along the heading [T] in m/s.
        sway_velocity: velocity to starboard [T] in m/s.
        yaw_rate: derivative of the heading [T] in rad/s.
    """

    t: np.ndarray
    surge_velocity: np.ndarray
    sway_velocity: np.ndarray
    yaw_rate: np.ndarray


def convert_heading(table: RawTable, unit: str, frame: PoseFrame) -> np.ndarray:
    """Return the heading of a table clockwise from north [T] in rad, unwrapped."""
    psi = table.columns["psi"] * to_si(unit, "rad") * (-1.0 if frame.is_reversed else 1.0)
    return unwrap_angle(np.pi / 2 - psi if frame.is_from_east else psi)


def estimate_motion(table: RawTable, unit: str, frame: PoseFrame) -> Motion | None:
    """Estimate the motion from position and heading by local polynomials.

    Args:
        table: table with the columns x, y, psi.
        unit: assumed unit of psi.
        frame: assumed frame.

    Returns:
        The motion; None if positions or headings are too few.
    """
    psi = convert_heading(table, unit, frame)
    north, east = ("y", "x") if frame.is_swapped else ("x", "y")
    has_position = (
        np.isfinite(table.columns[north]) & np.isfinite(table.columns[east]) & np.isfinite(table.t)
    )
    has_heading = np.isfinite(psi) & np.isfinite(table.t)
    if min(int(has_position.sum()), int(has_heading.sum())) < 30:
        return None
    position_times = table.t[has_position]
    time_step = float(np.median(np.diff(position_times)))
    if time_step <= 0.0 or (position_times[-1] - position_times[0]) / time_step > 1e6:
        return None
    grid_times = np.arange(position_times[0], position_times[-1], time_step)
    window = max(5, 2 * round(0.5 * _MIN_WINDOW_SECONDS / time_step) + 1)
    if grid_times.size < 3 * window:
        return None
    speed_north = differentiate_on_grid(
        grid_times, position_times, table.columns[north][has_position]
    )
    speed_east = differentiate_on_grid(
        grid_times, position_times, table.columns[east][has_position]
    )
    heading = np.interp(grid_times, table.t[has_heading], psi[has_heading])
    surge_velocity, sway_velocity = rotate(speed_north, speed_east, -heading)
    return Motion(
        grid_times,
        surge_velocity,
        sway_velocity,
        differentiate_on_grid(grid_times, table.t[has_heading], psi[has_heading]),
    )


def differentiate_on_grid(grid_times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the derivative [G] of values [T] at times [T], by local polynomials on a grid [G]."""
    step = float(grid_times[1] - grid_times[0])
    window = max(5, 2 * round(0.5 * _MIN_WINDOW_SECONDS / step) + 1)
    return fit_local_polynomials(np.interp(grid_times, t, values)[:, None], window, 2, step)[1][
        :, 0
    ]


def forward_alignment(motions: Sequence[Motion | None]) -> float:
    """Return the mean alignment of velocity and heading, weighted by the squared speed.

    It is 1 for motion ahead, 0 for random directions, and -1 for motion astern.
    """
    estimated_motions = [motion for motion in motions if motion is not None]
    forward_sum = sum(
        float((m.surge_velocity * np.hypot(m.surge_velocity, m.sway_velocity)).sum())
        for m in estimated_motions
    )
    total_sum = sum(
        float((m.surge_velocity**2 + m.sway_velocity**2).sum()) for m in estimated_motions
    )
    return forward_sum / total_sum if total_sum > 0.0 else 0.0


def fit_to_motion(
    logs: Sequence[RawTable], motions: Sequence[Motion | None], channel: str
) -> ScaleFit:
    """Regress a velocity of the motion on a column, over all logs with this column.

    Args:
        logs: tables.
        motions: motions of the same tables.
        channel: `u`, `v` or `r`.
    """
    component_index = {"u": 1, "v": 2, "r": 3}[channel]
    products = [np.zeros((2, 2))]
    for table, motion in zip(logs, motions, strict=True):
        values = table.columns.get(channel)
        if motion is None or values is None:
            continue
        is_finite = np.isfinite(values) & np.isfinite(table.t)
        if is_finite.sum() < 30:
            continue
        column = np.interp(motion.t, table.t[is_finite], values[is_finite])
        pair = np.stack((column, motion[component_index]))
        # exclude jumps of positions and headings
        size = np.abs(pair[1])
        pair = pair[:, size <= 5.0 * float(np.quantile(size, 0.95)) + 1e-12]
        # v and r are centred, so that a bias has no effect; u is not, because a steady speed
        # determines its factor
        if channel != "u":
            pair = pair - pair.mean(axis=1, keepdims=True)
        products.append(pair @ pair.T)
    (column_energy, covariance), (_, motion_energy) = np.sum(products, axis=0)
    if min(column_energy, motion_energy) <= 0.0:
        return ScaleFit(0.0, 0.0)
    # the sign of r may differ between logs, if a gyro was turned over
    covariances = [product[0, 1] for product in products]
    explained = np.abs(covariances).sum() if channel == "r" else abs(covariance)
    # both quantities are noisy: geometric mean of the factors of both regressions
    factor = float(np.sign(covariance) * np.sqrt(motion_energy / column_energy))
    return ScaleFit(factor, float(explained / np.sqrt(column_energy * motion_energy)))


def fit_rate_to_angle(
    logs: Sequence[RawTable],
    angle: str,
    unit: str,
    rate: str,
    frame: PoseFrame = POSE_FRAMES[0],
) -> ScaleFit:
    """Regress the derivative of an angle on the column of its rate.

    Args:
        logs: tables; those without one of the columns are not used.
        angle: channel of the angle, `psi` or `phi`.
        unit: unit of the angle.
        rate: channel of the rate.
        frame: frame of the angle.
    """
    complete_logs = [table for table in logs if {angle, rate} <= table.columns.keys()]
    angles = [
        RawTable(table.t, dict.fromkeys(("x", "y", "psi"), table.columns[angle]))
        for table in complete_logs
    ]
    return fit_to_motion(
        [RawTable(table.t, {"r": table.columns[rate]}) for table in complete_logs],
        [estimate_motion(table, unit, frame) for table in angles],
        "r",
    )


def estimate_rudder_gain(
    logs: Sequence[RawTable],
    channel: str,
    rates: Mapping[int, np.ndarray],
    angle_column: str | None = None,
) -> tuple[float, float]:
    """Estimate the effect of a rudder on the yaw rate, or of planes on the pitch rate.

    The change of the rate over two seconds is regressed on the mean rudder angle, on the initial
    rate, and for planes on the pitch angle, which gives the restoring moment.

    Args:
        logs: tables.
        channel: column of the rudder or the planes.
        rates: index of a table -> yaw or pitch rate [T] in rad/s.
        angle_column: column of the pitch angle; None for rudders.

    Returns:
        The coefficient of the rudder angle and its standard error.
    """
    rows = []
    rate_changes = []
    for number, table in enumerate(logs):
        if channel not in table.columns or number not in rates:
            continue
        tilt = np.zeros(table.t.size) if angle_column is None else table.columns[angle_column]
        samples = np.stack((table.t, table.columns[channel], rates[number], tilt))
        samples = samples[:, np.isfinite(samples).all(axis=0)]
        if samples.shape[1] < 50:
            continue
        t = remove_pauses(samples[0])
        _, rudder_angle, rate, tilt = samples
        horizon = max(2.0, 3.0 * float(np.median(np.diff(t))))
        start_times = np.arange(t[0], t[-1] - horizon, horizon / 4)
        if start_times.size < 10:
            continue
        initial_rate = np.interp(start_times, t, rate)
        final_rate = np.interp(start_times + horizon, t, rate)
        times_of_mean = start_times + horizon * np.array([[0.0], [0.25], [0.5], [0.75]])
        mean_rudder_angle = np.interp(times_of_mean, t, rudder_angle).mean(axis=0)
        initial_tilt = np.interp(start_times, t, tilt)
        ones = np.ones(start_times.size)
        rows.append(np.stack((mean_rudder_angle, initial_rate, ones, initial_tilt), axis=1))
        rate_changes.append(final_rate - initial_rate)
    if not rows:
        return 0.0, 1.0
    regressors = np.concatenate(rows)
    response = np.concatenate(rate_changes)
    scale = np.maximum(np.abs(regressors).max(axis=0), 1e-12)
    solution, *_ = np.linalg.lstsq(regressors / scale, response, rcond=1e-9)
    residual = response - (regressors / scale) @ solution
    # rows overlap by three quarters, so that a quarter of them is independent
    variance = 4.0 * float(residual @ residual) / max(response.size - 3, 1)
    standard_error = float(
        np.sqrt(variance * np.linalg.pinv((regressors / scale).T @ (regressors / scale))[0, 0])
    )
    return float(solution[0]), standard_error
