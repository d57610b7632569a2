"""Entries of a channel map: units, signs and frames from headers, values and physics.

A vessel moves approximately in the direction of its heading, and its yaw rate is the derivative of
the heading. Columns are regressed on these quantities to determine their factors and signs.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from residnet.core.frames import rotate, unwrap_angle
from residnet.core.layout import DegreesOfFreedom
from residnet.core.names import BOW_WIND_CHANNELS, CHANNEL_UNITS, port_starboard_pairs
from residnet.core.units import si_unit, to_si, unit_names
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.velocities import (
    BODY_AXES,
    EXCHANGED_EARTH_AXES,
    HeadingOffset,
    MeaningChoice,
    MeasuredVelocities,
    choose_drift_angle,
    choose_meaning,
    estimate_drift_free_offset,
    make_measured_velocities,
    measure_contradiction,
    require_compatible,
    resolve_drift_angle,
)
from residnet.io.header_vocabulary import (
    Scaling,
    guess_scaling,
    guess_unit_from_size,
    infer_unit,
    match_axis_velocity,
    match_depth_channel,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.quantities import (
    COSINE_SUFFIX,
    PLANAR_QUATERNION,
    QUATERNION,
    SINE_SUFFIX,
    SPEED_CHANNELS,
    complete_quaternion,
    normalize_quaternion,
    project_fixes,
    quaternion_yaw,
)
from residnet.preprocessing.channel_values import NEGLIGIBLE_MOTION_SHARE
from residnet.preprocessing.derivatives import fit_local_polynomials
from residnet.preprocessing.motion import remove_pauses

_MIN_WINDOW_SECONDS = 1.0
"""Shortest window in s in which positions are differentiated."""
_MAX_UNIT_RATIO = 1.35
"""Largest ratio between an estimated factor and that of its unit."""
MIN_STANDARD_ERRORS = 4.0
"""Smallest estimate, in standard errors, from which a sign is determined."""
_MIN_CORRELATION = 0.6
"""Smallest significant correlation."""


class PoseFrame(NamedTuple):
    """Frame of columns called x, y, psi.

    Attributes:
        is_swapped: whether x is east and y is north.
        is_from_east: whether psi is counter-clockwise from east.
    """

    is_swapped: bool
    is_from_east: bool


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
        """Whether the correlation is significant."""
        return (
            self.correlation >= _MIN_CORRELATION and np.isfinite(self.factor) and self.factor != 0.0
        )

    def matching_unit(self, expected: str) -> str | None:
        """Return the unit with nearly this factor, or None.

        Args:
            expected: SI unit of the dimension.
        """
        excluded_units = ("rad/min", "m/min", "cm/s")
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
    psi = table.columns["psi"] * to_si(unit, "rad")
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
    speed_north = _differentiate(grid_times, position_times, table.columns[north][has_position])
    speed_east = _differentiate(grid_times, position_times, table.columns[east][has_position])
    heading = np.interp(grid_times, table.t[has_heading], psi[has_heading])
    surge_velocity, sway_velocity = rotate(speed_north, speed_east, -heading)
    return Motion(
        grid_times,
        surge_velocity,
        sway_velocity,
        _differentiate(grid_times, table.t[has_heading], psi[has_heading]),
    )


def _differentiate(grid_times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
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
    covariance_sum = correlation_sum = column_sum = motion_sum = 0.0
    for table, log_motion in zip(logs, motions, strict=True):
        values = table.columns.get(channel)
        if log_motion is None or values is None:
            continue
        is_finite = np.isfinite(values) & np.isfinite(table.t)
        if is_finite.sum() < 30:
            continue
        column_values = np.interp(log_motion.t, table.t[is_finite], values[is_finite])
        motion_values = log_motion[component_index]
        # exclude jumps of positions and headings
        is_plausible = (
            np.abs(motion_values) <= 5.0 * float(np.quantile(np.abs(motion_values), 0.95)) + 1e-12
        )
        # v and r are centred, so that a bias has no effect; u is not, because a steady speed
        # determines its factor
        column_mean = 0.0 if channel == "u" else float(column_values[is_plausible].mean())
        motion_mean = 0.0 if channel == "u" else float(motion_values[is_plausible].mean())
        column_centred = column_values[is_plausible] - column_mean
        motion_centred = motion_values[is_plausible] - motion_mean
        covariance_sum += float(column_centred @ motion_centred)
        # the sign of r may differ between logs, if a gyro was turned over
        correlation_sum += (
            abs(float(column_centred @ motion_centred))
            if channel == "r"
            else float(column_centred @ motion_centred)
        )
        column_sum += float(column_centred @ column_centred)
        motion_sum += float(motion_centred @ motion_centred)
    if min(column_sum, motion_sum) <= 0.0:
        return ScaleFit(0.0, 0.0)
    # both quantities are noisy: geometric mean of the factors of both regressions
    correlation = correlation_sum / np.sqrt(column_sum * motion_sum)
    return ScaleFit(
        float(np.sign(covariance_sum) * np.sqrt(motion_sum / column_sum)), abs(float(correlation))
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
    for log_index, table in enumerate(logs):
        values = table.columns.get(channel)
        rate_values = rates.get(log_index)
        if values is None or rate_values is None:
            continue
        restoring_angle = (
            np.zeros(table.t.size) if angle_column is None else table.columns[angle_column]
        )
        is_finite = (
            np.isfinite(values)
            & np.isfinite(rate_values)
            & np.isfinite(table.t)
            & np.isfinite(restoring_angle)
        )
        if is_finite.sum() < 50:
            continue
        t = remove_pauses(table.t[is_finite])
        rudder_angles = values[is_finite]
        rates_finite = rate_values[is_finite]
        horizon = max(2.0, 3.0 * float(np.median(np.diff(t))))
        start_times = np.arange(t[0], t[-1] - horizon, horizon / 4)
        if start_times.size < 10:
            continue
        initial_rate = np.interp(start_times, t, rates_finite)
        final_rate = np.interp(start_times + horizon, t, rates_finite)
        mean_rudder_angle = np.mean(
            [
                np.interp(start_times + share * horizon, t, rudder_angles)
                for share in (0.0, 0.25, 0.5, 0.75)
            ],
            0,
        )
        tilt_angle = np.interp(start_times, t, restoring_angle[is_finite])
        rows.append(
            np.stack(
                (mean_rudder_angle, initial_rate, np.ones(start_times.size), tilt_angle), axis=1
            )
        )
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


READER_KEY = ("data", "reader")
CHANNELS_KEY = (*READER_KEY, "channels")
_OVERRULING_CORRELATION = 0.9
"""Smallest correlation for which an estimated factor overrules the header."""
_MIN_BODY_CONSISTENCY = 0.85
"""Smallest consistency with position and heading of u and v that are certainly in body axes."""
_MAX_WIND_SPREAD_RATIO = 0.8
"""Largest ratio of true-wind standard deviations for a reference other than that of the name.

In 120 simulated logs with turns the reference was right in all. With turns of less than one radian
the reference of the name was used in a third of the logs.
"""
_MIN_WIND_SAMPLES = 50
"""Smallest number of samples of a wind for a decision."""
_DEPTH_CHANNELS = ("w", "q", "z", "theta")
"""Channels of underwater vessels, in addition to those of roll."""
STATE_NAMES = (
    *("x", "y", "psi", "u", "v", "r", "phi", "p", *_DEPTH_CHANNELS, "wind_speed", "wind_dir"),
    *BOW_WIND_CHANNELS,
)
_FIX_OF_AXIS = {"x": "latitude", "y": "longitude"}
MAGNETIC_PATTERN = re.compile(
    r"magn|compass|kompass|\bhdm\b|\(m\)|\bmag(?![a-z])|_mag(?![a-z])", re.I
)
_QUATERNION_PATTERN = re.compile(
    r"(?P<stem>(?:.*[\W_])?(?:q|quat|quaternions?|orient|orientation|att|attitude|rot|rotation))"
    r"[\W_]*(?P<part>[xyzwijk0-3])\W*",
    re.IGNORECASE,
)
_QUATERNION_CHANNELS = {
    **dict(zip("xyzw", QUATERNION, strict=True)),
    "i": "qx",
    "j": "qy",
    "k": "qz",
}
_QUATERNION_ORDERS = (("qw", "qx", "qy", "qz"), QUATERNION)
"""Orders of numbered parts: the scalar part is usually first, sometimes last."""
_ROS_POSE_PATTERNS = {
    **{"x": r"position\W*x", "y": r"position\W*y"},
    **{"qw": r"orientation\W*w", "psi": r"orientation\W*yaw"},
}
"""Ends of column names of geometry_msgs/Pose, and of its yaw in PlotJuggler."""
_NED_PATTERN = re.compile(r"(?:^|[\W_])(?:ned|frd)(?:$|[\W_])", re.IGNORECASE)


def find_quaternions(columns: Sequence[str]) -> list[dict[str, str]]:
    """Find quaternions by the names of their columns.

    Returns:
        For each quaternion: channel (qx, qy, qz, qw) -> column. A quaternion with numbered parts
        occurs twice, with the scalar part first and last. Without complete ones, those of planar
        motion with the parts qz and qw.
    """
    parts_by_stem: dict[str, dict[str, str]] = {}
    for column in columns:
        # remove units in brackets from the name
        match = _QUATERNION_PATTERN.fullmatch(
            re.sub(r"\s*\[\D*\]$|\s*\(\D*\)$", "", column.strip())
        )
        if match is not None:
            part = match["part"].lower()
            channels = (
                [_QUATERNION_CHANNELS[part]]
                if part in _QUATERNION_CHANNELS
                else [order[int(part)] for order in _QUATERNION_ORDERS]
            )
            for number, channel in enumerate(channels):
                group_key = f"{match['stem']} {number if part.isdigit() else 'named'}"
                parts_by_stem.setdefault(group_key, {}).setdefault(channel, column)
    complete = [parts for parts in parts_by_stem.values() if set(parts) == {*QUATERNION}]
    planar = [parts for parts in parts_by_stem.values() if set(parts) == {*PLANAR_QUATERNION}]
    return complete or planar


def find_depth_channels(columns: Sequence[str], known_channels: Collection[str]) -> dict[str, str]:
    """Return the channels w, q, z, theta -> columns if the table is that of an underwater vessel.

    Such a table has depth, pitch and roll, or motion in the vertical plane only.

    Args:
        columns: names of the columns.
        known_channels: channels that are mapped already.
    """
    depth_channels = {column: match_depth_channel(parse_name(column)) for column in columns}
    column_by_channel = {name: column for column, name in reversed(depth_channels.items()) if name}
    roll_rate = {"p": column_by_channel["p"]} if "p" in column_by_channel else {}
    column_by_channel = {
        name: column_by_channel[name] for name in _DEPTH_CHANNELS if name in column_by_channel
    }
    has_full_attitude = "phi" in known_channels and {"z", "theta"} <= column_by_channel.keys()
    if has_full_attitude and "p" not in known_channels:
        column_by_channel |= roll_rate
    return (
        column_by_channel
        if has_full_attitude
        or DegreesOfFreedom.vertical_plane_dof({*known_channels, *column_by_channel})
        else {}
    )


_MIN_SUBMERGED_SHARE = 0.9
"""Share of negative samples above which a vertical position of a diving vessel points up."""
_MIN_SUBMERGED_DEPTH = 0.1
"""Smallest depth in m of its median, so that a vessel at the surface does not count as diving."""


def is_vertical_axis_up(
    columns: Sequence[str],
    known_channels: Collection[str],
    tables: Sequence[Mapping[str, np.ndarray]],
) -> bool:
    """Return whether an underwater vessel's vertical position is negative, and so points up.

    Args:
        columns: names of the columns of numbers.
        known_channels: channels that are mapped already; only a quaternion depends on the axis.
        tables: column -> values of each table.
    """
    if "qw" not in known_channels:
        return False
    column = next((name for name in columns if match_depth_channel(parse_name(name)) == "z"), None)
    values = np.concatenate([table.get(column or "", np.zeros(0)) for table in tables])
    values = values[np.isfinite(values)]
    return bool(
        values.size
        and float((values < 0.0).mean()) > _MIN_SUBMERGED_SHARE
        and float(np.median(values)) < -_MIN_SUBMERGED_DEPTH
    )


def choose_quaternion_order(
    attitudes: Sequence[dict[str, str]], tables: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, str]:
    """Choose the order of the parts of the first quaternion that gives the smallest tilt.

    Args:
        attitudes: result of `find_quaternions`.
        tables: column -> values of each table.

    Returns:
        Channel -> column; empty if the columns are no unit quaternion.
    """
    if not attitudes:
        return {}
    columns = set(attitudes[0].values())
    complete_tables = [table for table in tables if columns <= set(table)]
    candidates = [parts for parts in attitudes if set(parts.values()) == columns]

    def concatenate_columns(names: Iterable[str]) -> np.ndarray:
        return np.array(
            [np.concatenate([table[name] for table in complete_tables]) for name in names]
        )

    if not complete_tables:
        return {}
    norm = np.sqrt((concatenate_columns(columns) ** 2).sum(axis=0))
    norm = norm[np.isfinite(norm) & (norm > 0)]
    if not norm.size or abs(float(np.median(norm)) - 1.0) >= 0.02:
        return {}
    return min(
        candidates,
        key=lambda parts: np.nanmean(
            concatenate_columns([parts.get("qx", parts["qz"]), parts.get("qy", parts["qz"])]) ** 2
        ),
    )


def _choose_candidate_frames(
    names: Mapping[str, str], texts: Iterable[str]
) -> tuple[PoseFrame, ...]:
    """Return possible frames of position and heading from their names, the most probable first.

    A ROS pose has a heading from east (REP 103), unless a text contains NED.

    Args:
        names: channel -> column.
        texts: names of all columns, and cells.
    """
    is_ros_pose = all(
        re.search(rf"(?:^|[\W_]){pattern}$", names[name].strip(), re.IGNORECASE)
        for name, pattern in _ROS_POSE_PATTERNS.items()
        if name in names
    )
    has_heading = {"qw", "psi"} & set(names)
    return (
        POSE_FRAMES
        if not has_heading or not is_ros_pose or any(map(_NED_PATTERN.search, texts))
        else ROS_POSE_FRAMES
    )


_SIN_COS_PATTERN = re.compile(
    r"(?P<stem>.*?)[\W_]*(?P<part>cosine|cos|sine|sin|(?<![^\W_])[csxy])"
    r"|(?P<head>cos|sin)[\W_]*(?P<tail>.+?)\W*",
    re.IGNORECASE,
)


def find_sin_cos_pairs(
    columns: Sequence[str], tables: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, tuple[str, str]]:
    """Find pairs of columns with the cosine and the sine of an angle, whose squares sum to one.

    Args:
        columns: names, such as `psi_cos` and `psi_sin`, or `alpha_x` and `alpha_y`.
        tables: column -> values of each table.

    Returns:
        Common part of the names -> columns of cosine and sine.
    """
    parts_by_stem: dict[str, dict[str, str]] = {}
    for column in columns:
        name = column.strip()
        match = _SIN_COS_PATTERN.fullmatch(name) or _SIN_COS_PATTERN.fullmatch(
            re.sub(r"\s*[\[(].*", "", name)
        )
        if match is not None:
            part = (match["part"] or match["head"])[0].lower()
            suffix = COSINE_SUFFIX if part in "cx" else SINE_SUFFIX
            parts_by_stem.setdefault(match["stem"] or match["tail"] or "", {}).setdefault(
                suffix, column
            )
    pairs = {}
    for stem, parts in parts_by_stem.items():
        pair = (parts.get(COSINE_SUFFIX, ""), parts.get(SINE_SUFFIX, ""))
        pairs_in_tables = [
            [table[name] for name in pair] for table in tables if {*pair} <= table.keys()
        ]
        radius = np.concatenate(
            [np.hypot(*pair_values) for pair_values in pairs_in_tables] or [np.zeros(0)]
        )
        radius = radius[np.isfinite(radius)]
        if stem and radius.size and np.quantile(np.abs(radius - 1.0), 0.9) < 0.02:
            pairs[stem] = pair
    return pairs


def draft_channel_map(
    names: Mapping[str, str],
    logs: Sequence[RawTable],
    draft_notes: DraftNotes,
    texts: Iterable[str] = (),
    *,
    is_up_positive: bool = False,
) -> dict[str, dict[str, Any]]:
    """Draft a channel map.

    Args:
        names: channel -> column.
        logs: tables with the columns under the names of their channels.
        draft_notes: receives guesses and notes.
        texts: names of all columns, and cells, which may contain the name of a frame.
        is_up_positive: whether the vertical axis of the frame points up, see `is_vertical_axis_up`.

    Returns:
        Channel -> entry.
    """
    quaternion_columns = {name: column for name, column in names.items() if name in QUATERNION}
    candidate_frames = ROS_POSE_FRAMES if is_up_positive else _choose_candidate_frames(names, texts)
    channel_columns = {name: column for name, column in names.items() if name not in QUATERNION}
    # replace sines and cosines, and quaternions, by their angles while frames are determined
    angle_columns = {}
    derived_angles: dict[str, tuple[str, ...]] = {}
    for name in [
        item.removesuffix(COSINE_SUFFIX) for item in names if item.endswith(COSINE_SUFFIX)
    ]:
        derived_angles[name] = (name + COSINE_SUFFIX, name + SINE_SUFFIX)
        pair = (channel_columns.pop(name + COSINE_SUFFIX), channel_columns.pop(name + SINE_SUFFIX))
        channel_columns[name] = f"angle of {' and '.join(pair)} [rad]"
        angle_columns[channel_columns[name]] = pair
    if quaternion_columns:
        derived_angles["psi"] = tuple(name for name in QUATERNION if name in quaternion_columns)
        channel_columns["psi"] = "heading of the quaternion [rad]"
    logs = [_add_derived_angles(raw, derived_angles) for raw in logs]
    channel_columns, logs, degrees_per_count = _project_fixes(channel_columns, logs, draft_notes)
    channel_columns, logs, drift = _derive_drift_velocities(
        channel_columns, logs, draft_notes, degrees_per_count, candidate_frames
    )
    entries = ChannelMapper(
        channel_columns, logs, draft_notes, degrees_per_count, candidate_frames
    ).draft_entries()
    entries = _restore_drift_angle(entries, drift, draft_notes)
    if degrees_per_count:
        entries = {_FIX_OF_AXIS.get(name, name): entry for name, entry in entries.items()}
    # convert the entries of these angles to entries of their columns
    for name in [item for item, entry in entries.items() if entry["column"] in angle_columns]:
        entry = entries.pop(name)
        cosine, sine = angle_columns[entry["column"]]
        if entry.pop("frame", ""):
            # an angle from east exchanges cosine and sine
            cosine, sine = sine, cosine
        sign_settings = {"sign": entry["sign"]} if "sign" in entry else {}
        entries[name + COSINE_SUFFIX] = {"column": cosine, "unit": "-"}
        entries[name + SINE_SUFFIX] = {"column": sine, "unit": "-", **sign_settings}
        draft_notes.move_key((*CHANNELS_KEY, name), (*CHANNELS_KEY, name + COSINE_SUFFIX))
    if not quaternion_columns:
        return entries
    psi = entries.pop("psi")
    entries |= {
        name: {"column": quaternion_columns[name], "unit": "-"}
        for name in QUATERNION
        if name in quaternion_columns
    }
    entries["qw"] |= {"frame": psi["frame"]} if "frame" in psi else {}
    draft_notes.move_key((*CHANNELS_KEY, "psi"), (*CHANNELS_KEY, "qw"))
    direction = "counter-clockwise from east" if "frame" in psi else "clockwise from north"
    text = f"no position determines the frame; the heading is assumed {direction}"
    if {"x", "y"} <= set(channel_columns):
        text = f"position and heading are most consistent with a heading {direction}"
    draft_notes.add_guess((*CHANNELS_KEY, "qw"), text)
    if re.search(r"\d\W*$", quaternion_columns["qw"]):
        text = (
            f"'{quaternion_columns['qw']}' is assumed the scalar part: it gives the smallest tilt"
        )
        draft_notes.add_guess((*CHANNELS_KEY, "qw"), text)
    return entries


class _DriftAngle(NamedTuple):
    """Columns of speed and drift angle, and their interpretation.

    Attributes:
        speed_column: column of the speed.
        angle_column: column of the drift angle.
        unit: unit of the drift angle.
        sign: 1 if the drift angle is positive with the flow from port, -1 otherwise.
        is_speed: whether the first column is the speed; otherwise it is the surge velocity.
    """

    speed_column: str
    angle_column: str
    unit: str
    sign: int
    is_speed: bool


def _derive_drift_velocities(
    names: Mapping[str, str],
    logs: Sequence[RawTable],
    draft_notes: DraftNotes,
    degrees_per_count: float,
    candidate_frames: Sequence[PoseFrame],
) -> tuple[dict[str, str], list[RawTable], _DriftAngle | None]:
    """Replace speed and drift angle by surge and sway velocity, in the unit of the speed.

    Args:
        names: channel -> column, perhaps with `speed` and `drift_angle`.
        logs: tables.
        draft_notes: receives guesses, notes and the question for the meaning of the speed.
        degrees_per_count: unit of the columns x and y, see `ChannelMapper`.
        candidate_frames: possible frames, see `ChannelMapper`.

    Returns:
        Channel -> column with `u` and `v`, tables with these columns, and the drift angle; None if
        there is none, or it is not used.
    """
    if not names.keys() >= {*SPEED_CHANNELS}:
        return dict(names), list(logs), None
    other_names = {name: column for name, column in names.items() if name not in SPEED_CHANNELS}
    measured: list[MeasuredVelocities] = []
    if {"x", "y", "psi"} <= other_names.keys():
        reference = ChannelMapper(
            other_names, logs, DraftNotes(), degrees_per_count, candidate_frames
        )
        reference.choose_frame()
        measured = reference.measure_velocities((*SPEED_CHANNELS,), logs)
    tables = [table for table in logs if table.columns.keys() >= {*SPEED_CHANNELS}]
    drift = _interpret_drift_angle(names, tables, measured, draft_notes)
    if drift is None:
        return other_names, list(logs), None
    derived = []
    for table in logs:
        columns = dict(table.columns)
        if columns.keys() >= {*SPEED_CHANNELS}:
            speed = columns.pop("speed")
            angle = drift.sign * columns.pop("drift_angle") * to_si(drift.unit, "rad")
            u, v = resolve_drift_angle(speed, angle)
            columns |= {"u": u, "v": v} if drift.is_speed else {"u": speed}
        derived.append(RawTable(table.t, columns))
    if not drift.is_speed:
        text = f"'{drift.angle_column}' is not read: '{drift.speed_column}' is the surge velocity"
        draft_notes.add_note(CHANNELS_KEY, text)
        return {**other_names, "u": drift.speed_column}, derived, None
    return {**other_names, **dict.fromkeys(("u", "v"), drift.speed_column)}, derived, drift


def _interpret_drift_angle(
    names: Mapping[str, str],
    tables: Sequence[RawTable],
    measured: Sequence[MeasuredVelocities],
    draft_notes: DraftNotes,
) -> _DriftAngle | None:
    """Choose unit and direction of a drift angle, and the meaning of the speed next to it.

    Position and heading determine them. Without these the direction is that in which the stern
    swings out in turns.

    Args:
        names: channel -> column, with `speed` and `drift_angle`.
        tables: tables with both columns.
        measured: motion of the tables with position and heading, and both columns.
        draft_notes: receives guesses, notes and the question for the meaning of the speed.

    Returns:
        The interpretation; None if the columns contradict position and heading.
    """
    speed_column = names["speed"]
    angle_column = names["drift_angle"]
    key = (*CHANNELS_KEY, "drift_angle")
    header_unit = parse_header_unit(angle_column, "rad")
    # the symbol u is that of the surge velocity, U and V are those of the speed
    can_be_surge = speed_column.strip().startswith("u")
    is_speed = True
    if measured:
        units = [header_unit] if header_unit else ["deg", "rad"]
        choice = choose_drift_angle(measured, units, can_be_surge=can_be_surge)
        if not choice.is_consistent:
            text = (
                f"'{speed_column}' and '{angle_column}' are left out: as speed and drift angle they"
                f" differ from position and heading by {100.0 * choice.unexplained_share:.0f} %"
            )
            draft_notes.add_note(CHANNELS_KEY, text)
            return None
        unit = choice.unit
        sign = choice.sign
        is_speed = choice.is_speed
        unit_reason = f"the header has no unit; position and heading are most consistent in {unit}"
        can_be_surge &= choice.is_ambiguous
    else:
        angles = np.concatenate([table.columns["drift_angle"] for table in tables])
        unit, unit_reason = guess_unit_from_size("drift_angle", angles)
        unit = header_unit or unit
        sign = _find_drift_direction(tables, angle_column, draft_notes)
    if header_unit is None:
        draft_notes.add_guess(key, unit_reason)
    if can_be_surge:
        options = ("speed", "surge velocity")
        reason = f"'{speed_column}' next to the drift angle '{angle_column}' is assumed the speed"
        question = f"meaning of '{speed_column}' next to the drift angle '{angle_column}'"
        answer = draft_notes.ask_question(
            (*CHANNELS_KEY, "speed"), question, options[0], reason, options
        )
        is_speed = answer == options[0]
    return _DriftAngle(speed_column, angle_column, unit, sign, is_speed)


def _find_drift_direction(
    tables: Sequence[RawTable], angle_column: str, draft_notes: DraftNotes
) -> int:
    """Return the direction of a drift angle without position: 1 if positive by SNAME, else -1.

    In a turn to starboard the stern swings out to port, so that the flow comes from port forward of
    the pivot point and the drift angle of SNAME has the sign of the yaw rate.

    Args:
        tables: tables with the columns `drift_angle` and perhaps `r`.
        angle_column: column of the drift angle, for the guess.
        draft_notes: receives the guess.
    """
    key = (*CHANNELS_KEY, "drift_angle")
    product = angle_energy = rate_energy = 0.0
    for table in tables:
        if "r" not in table.columns:
            continue
        is_finite = np.isfinite(table.columns["drift_angle"]) & np.isfinite(table.columns["r"])
        angle = table.columns["drift_angle"][is_finite]
        rate = table.columns["r"][is_finite]
        product += float(angle @ rate)
        angle_energy += float(angle @ angle)
        rate_energy += float(rate @ rate)
    energy = np.sqrt(angle_energy * rate_energy)
    correlation = product / energy if energy > 0.0 else 0.0
    if abs(correlation) < _MIN_CORRELATION:
        text = f"'{angle_column}' is assumed positive with the flow from port: v = -U sin(beta)"
        draft_notes.add_guess(key, text)
        return 1
    direction = "port" if correlation > 0.0 else "starboard"
    text = (
        f"'{angle_column}' is positive with the flow from {direction}: so the stern swings out in"
        f" turns (correlation with the yaw rate {correlation:.2f})"
    )
    draft_notes.add_guess(key, text)
    return 1 if correlation > 0.0 else -1


def _restore_drift_angle(
    entries: dict[str, dict[str, Any]], drift: _DriftAngle | None, draft_notes: DraftNotes
) -> dict[str, dict[str, Any]]:
    """Replace the entries of derived velocities by those of speed and drift angle.

    Args:
        entries: channel -> entry, with u and v of the drift angle unless these were left out.
        drift: columns and interpretation of the drift angle; None changes nothing.
        draft_notes: notes on u become notes on the speed; those on the derived v are discarded.
    """
    if drift is None:
        return entries
    others = {name: entry for name, entry in entries.items() if name not in ("u", "v")}
    if len(others) > len(entries) - 2 or "frame" in entries["u"]:
        text = (
            f"'{drift.speed_column}' and '{drift.angle_column}' are left out: u and v follow from"
            " position and heading"
        )
        draft_notes.add_note(CHANNELS_KEY, text)
        return others
    speed_sign = entries["u"].get("sign", 1)
    angle_sign = drift.sign * speed_sign * entries["v"].get("sign", 1)
    draft_notes.move_key((*CHANNELS_KEY, "u"), (*CHANNELS_KEY, "speed"))
    # v has the unit of the speed, so that a guess of its unit is no guess on the drift angle
    draft_notes.discard_key((*CHANNELS_KEY, "v"))
    text = (
        f"u = U cos(beta) and v = -U sin(beta) follow from the speed U '{drift.speed_column}' and"
        f" the drift angle beta '{drift.angle_column}'"
    )
    draft_notes.add_note((*CHANNELS_KEY, "speed"), text)
    signs = [{"sign": -1} if sign < 0 else {} for sign in (speed_sign, angle_sign)]
    velocities = {
        "speed": {"column": drift.speed_column, "unit": entries["u"]["unit"], **signs[0]},
        "drift_angle": {"column": drift.angle_column, "unit": drift.unit, **signs[1]},
    }
    return {**others, **velocities}


def _add_derived_angles(table: RawTable, derived_angles: Mapping[str, tuple[str, ...]]) -> RawTable:
    """Return a table with additional angles in rad from cosines and sines or quaternions.

    Args:
        table: the table.
        derived_angles: angle -> columns of cosine and sine, or of the parts of a quaternion.
    """
    columns = dict(table.columns)
    for name, parts in derived_angles.items():
        if columns.keys() >= {*parts}:
            part_values = [columns[part] for part in parts]
            is_quaternion = "qw" in parts
            columns[name] = (
                quaternion_yaw(*normalize_quaternion(*complete_quaternion(part_values)))
                if is_quaternion
                else np.arctan2(*part_values[::-1])
            )
    return RawTable(table.t, columns)


def _project_fixes(
    names: Mapping[str, str], logs: Sequence[RawTable], draft_notes: DraftNotes
) -> tuple[dict[str, str], list[RawTable], float]:
    """Project latitude and longitude of all logs to x and y in m from the first fix of each log.

    Args:
        names: channel -> column.
        logs: tables.
        draft_notes: receives guesses and notes.

    Returns:
        Channel -> column with x and y for latitude and longitude; the tables; the unit of the
        columns in deg (1, or 1e-7 for integers), or 0 without latitude and longitude.
    """
    fix_channels = set(_FIX_OF_AXIS.values())
    other_names = {name: column for name, column in names.items() if name not in fix_channels}
    if set(_FIX_OF_AXIS) <= set(names) and len(other_names) < len(names):
        columns = ", ".join(names[name] for name in sorted(fix_channels & set(names)))
        draft_notes.add_note(CHANNELS_KEY, f"x and y exist too; left out: {columns}")
        return other_names, list(logs), 0.0
    if not fix_channels <= set(names) or set(_FIX_OF_AXIS) & set(names):
        return dict(names), list(logs), 0.0
    fix_tables = [raw for raw in logs if fix_channels <= set(raw.columns)]
    fix_values = {
        fix_name: np.concatenate([raw.columns[fix_name] for raw in fix_tables] or [np.zeros(0)])
        for fix_name in fix_channels
    }
    finite_values = {name: values[np.isfinite(values)] for name, values in fix_values.items()}
    max_latitude = float(np.abs(finite_values["latitude"]).max(initial=0.0))
    # autopilots log latitude and longitude as integers in 1e-7 deg
    are_integers = all(
        bool((values == np.round(values)).all()) for values in finite_values.values()
    )
    degrees_per_count = 1e-7 if 1e6 < max_latitude <= 90e7 and are_integers else 1.0
    if not fix_tables or max_latitude * degrees_per_count > 90.0:
        columns = ", ".join(names[name] for name in _FIX_OF_AXIS.values())
        draft_notes.add_note(CHANNELS_KEY, f"{columns} are no decimal degrees; left out")
        return other_names, list(logs), 0.0
    if degrees_per_count < 1.0:
        for name in _FIX_OF_AXIS.values():
            text = "integers of this size are assumed 1e-7 deg"
            draft_notes.add_guess((*CHANNELS_KEY, name), text)
    projected = []
    for raw in logs:
        if fix_channels <= set(raw.columns):
            phi, lam = (
                np.radians(degrees_per_count * raw.columns[name]) for name in _FIX_OF_AXIS.values()
            )
            north, east, origin, _ = project_fixes(phi, lam)
            if origin is not None:
                raw = RawTable(raw.t, {**raw.columns, "x": north, "y": east})
        projected.append(raw)
    return (
        {**{name: names[fix] for name, fix in _FIX_OF_AXIS.items()}, **other_names},
        projected,
        degrees_per_count,
    )


@final
class ChannelMapper:
    """Builder of the entries of a channel map from names, headers, values and physics."""

    def __init__(
        self,
        names: Mapping[str, str],
        logs: Sequence[RawTable],
        draft_notes: DraftNotes,
        degrees_per_count: float,
        candidate_frames: Sequence[PoseFrame] = POSE_FRAMES,
    ) -> None:
        """Create a builder.

        Args:
            names: channel -> column.
            logs: tables.
            draft_notes: receives guesses and notes.
            degrees_per_count: unit of the columns x and y in deg; 0 if they are lengths.
            candidate_frames: frames to test, the most probable first.
        """
        self._degrees_per_count = float(degrees_per_count)
        self._candidate_frames = tuple(candidate_frames)
        self._names = dict(names)
        self._logs = list(logs)
        self._draft_notes = draft_notes
        self._pose_frame = self._candidate_frames[0]
        self._motions: list[Motion | None] = [None] * len(logs)
        self._psi_unit = "rad"
        self._sign_flipped: set[str] = set()
        self._is_swapped = False
        self._is_earth_fixed = False
        self._heading_offset: HeadingOffset | None = None

    def draft_entries(self) -> dict[str, dict[str, Any]]:
        """Return channel -> entry."""
        if {"x", "y", "psi"} <= set(self._names):
            self._choose_velocity_meaning()
            self.choose_frame()
            for name in [
                velocity_name for velocity_name in ("u", "v", "r") if velocity_name in self._names
            ]:
                self._drop_inconsistent_velocity(name)
            self._require_compatible_velocities()
        elif "psi" in self._names:
            self._psi_unit = self._infer_unit("psi")
        self._choose_wind_reference()
        entries = {name: self._make_entry(name) for name in self._names}
        for force, velocity in (("tau_y", "v"), ("tau_n", "r")):
            # forces have the axes of the velocities beside them
            is_reversed = entries.get(velocity, {}).get("sign") == -1
            if is_reversed and force in entries and "sign" not in entries[force]:
                entries[force]["sign"] = -1
                text = f"assumed in the axes of {velocity}, which is positive to port in the file"
                self._draft_notes.add_guess((*CHANNELS_KEY, force), text)
        return entries

    def _drop_inconsistent_velocity(self, name: str) -> None:
        """Leave out a velocity that is constant, or uncorrelated and larger than the motion."""
        motions = [motion for motion in self._motions if motion is not None]
        if not motions:
            return
        component_index = {"u": 1, "v": 2, "r": 3}[name]
        motion_values = np.concatenate([motion[component_index] for motion in motions])
        factor = to_si(self._infer_unit(name, should_note=False), CHANNEL_UNITS[name])
        column_values = factor * self._concatenate_values(name)
        # compare u and v with the speed, because one of them may be nearly zero
        reference_speed = (
            motion_values
            if name == "r"
            else np.hypot(*np.concatenate([m[1:3] for m in motions], axis=1))
        )
        problem = ""
        if float(np.nanstd(column_values)) < NEGLIGIBLE_MOTION_SHARE * float(np.std(motion_values)):
            problem = "does not move, but position and heading do"
        elif (
            float(np.nanmedian(np.abs(column_values))) > float(reference_speed.max())
            and not fit_to_motion(self._logs, self._motions, name).is_significant
        ):
            problem = "exceeds all velocities from position and heading, and is uncorrelated"
        if problem:
            column = self._names.pop(name)
            text = f"'{column}' {problem}; left out: {name} is derived from them"
            self._draft_notes.add_note(CHANNELS_KEY, text)

    @property
    def _is_ros_pose(self) -> bool:
        """Whether position and heading have the names of a ROS pose."""
        return self._candidate_frames == ROS_POSE_FRAMES

    def _concatenate_values(self, name: str) -> np.ndarray:
        parts = [raw.columns[name] for raw in self._logs if name in raw.columns]
        return np.concatenate(parts) if parts else np.zeros(0)

    def choose_frame(self) -> None:
        """Choose unit and frame of the heading that are most consistent with the motion."""
        score = self._search_heading_frame()
        x, y = parse_name(self._names["x"]), parse_name(self._names["y"])
        is_named_north_east = (
            x.has_all("north") and y.has_all("east") and not (x.text == "x" or y.text == "y")
        )
        is_named_north_east = is_named_north_east or self._degrees_per_count > 0.0
        if not is_named_north_east and not self._is_ros_pose and self._is_mirrored():
            self._set_pose_frame(
                PoseFrame(not self._pose_frame.is_swapped, not self._pose_frame.is_from_east)
            )
            text = "the mirrored motion is as consistent, but more thrust on port turns it to port"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), text)
        self._name_position_axes(score, is_named_north_east)
        if self._pose_frame.is_from_east:
            text = "the motion is consistent with the heading only if the heading is from east"
            if self._is_ros_pose:
                text = "the heading is assumed from east, as in a pose of ROS (REP 103)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), text)
        if score < 0.5:
            text = f"position, heading and velocities are inconsistent ({score:.2f} of 1)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), f"{text}: check units and axes")
        # swapped columns have been exchanged by name
        self._is_swapped = self._pose_frame.is_swapped
        self._pose_frame = PoseFrame(False, self._pose_frame.is_from_east)

    def _search_heading_frame(self) -> float:
        """Set the most consistent unit and frame of the heading; returns their score, at most 1."""
        header_unit = parse_header_unit(self._names["psi"], "rad")
        unit_from_size, _ = guess_unit_from_size("psi", self._concatenate_values("psi"))
        # an unwrapped heading in rad may be large, so that its size decides only without motion
        alternative_unit = "rad" if unit_from_size == "deg" else "deg"
        candidate_units = [header_unit] if header_unit else [unit_from_size, alternative_unit]
        if (
            not header_unit
            and np.nanmax(np.abs(self._concatenate_values("psi")), initial=0.0) > 720.0
        ):
            candidate_units.append("cdeg")
        best_candidate = (-np.inf, "rad", self._candidate_frames[0])
        for unit in candidate_units:
            for frame in (
                f for f in self._candidate_frames if not (self._degrees_per_count and f.is_swapped)
            ):
                motions = [estimate_motion(table, unit, frame) for table in self._logs]
                score = self._score_consistency(motions)
                # a later candidate must be clearly better: the first ones are the usual ones
                if score > best_candidate[0] + 0.02:
                    best_candidate = (score, unit, frame)
                    self._motions = motions
        score, self._psi_unit, self._pose_frame = best_candidate
        if header_unit is None:
            reason = f"position and heading are most consistent in {self._psi_unit}"
            self._draft_notes.add_guess((*CHANNELS_KEY, "psi"), f"the header has no unit; {reason}")
        return score

    def _set_pose_frame(self, frame: PoseFrame) -> None:
        """Set the frame of position and heading, and estimate the motion in it."""
        self._pose_frame = frame
        self._motions = [estimate_motion(table, self._psi_unit, frame) for table in self._logs]

    def _name_position_axes(self, score: float, is_named_north_east: bool) -> None:
        """Assign the position columns to north and east by the frame, and note the guess.

        Args:
            score: consistency of position and heading, 1 at most.
            is_named_north_east: whether the names of the columns define their axes.
        """
        if self._pose_frame.is_swapped and not is_named_north_east:
            self._names["x"], self._names["y"] = self._names["y"], self._names["x"]
            text = "the motion is consistent with the heading only if the column called y is north"
            if self._is_ros_pose and self._pose_frame.is_from_east:
                text = "x is assumed east and y north, as in a pose of ROS (REP 103)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "x"), text)
        elif self._pose_frame.is_swapped:
            # columns named north and east are not exchanged: the heading is from east instead
            self._set_pose_frame(PoseFrame(False, True))
        elif not is_named_north_east and not self._pose_frame.is_from_east:
            text = f"x is assumed north and y east: consistent with the heading ({score:.2f} of 1)"
            self._draft_notes.add_guess((*CHANNELS_KEY, "x"), text)

    def _is_mirrored(self) -> bool:
        """Return whether more thrust on the port side turns the vessel to port."""
        for port, stbd in port_starboard_pairs(self._names).items():
            if re.match(r"(cmd_)?(delta|azimuth)", port):
                continue
            thruster_differences = [
                (RawTable(table.t, {"port": table.columns[port] - table.columns[stbd]}), motion)
                for table, motion in zip(self._logs, self._motions, strict=True)
                if motion is not None and {port, stbd} <= table.columns.keys()
            ]
            rates = {
                k: np.interp(table.t, m.t, m.yaw_rate)
                for k, (table, m) in enumerate(thruster_differences)
            }
            gain, standard_error = estimate_rudder_gain(
                [table for table, _ in thruster_differences], "port", rates
            )
            return gain < -MIN_STANDARD_ERRORS * standard_error
        return False

    def _choose_velocity_meaning(self) -> None:
        """Choose whether u and v are in body axes, in earth axes, or a speed.

        Frame and heading are determined without the velocities. Velocities in earth axes are
        rotated to body axes for the further tests; a speed is left out.
        """
        names = [name for name in ("u", "v") if name in self._names]
        if not names:
            return
        choice = MeaningChoice(BODY_AXES, BODY_AXES, np.inf, "")
        as_named = self._try_heading_frame(self._names)
        # a vessel that sways as much as it surges has a frame with its velocities only
        is_consistent = as_named._score_consistency(as_named._motions) > _MIN_BODY_CONSISTENCY
        # in a far too large unit the heading is constant, and earth axes look like body axes
        unit_from_size, _ = guess_unit_from_size("psi", self._concatenate_values("psi"))
        header_unit = parse_header_unit(self._names["psi"], "rad")
        is_consistent &= (header_unit or unit_from_size) == as_named._psi_unit
        reference = as_named
        if len(names) < 2 or not is_consistent:
            other_names = {n: column for n, column in self._names.items() if n not in names}
            reference = self._try_heading_frame(other_names)
            if logs := reference.measure_velocities(names, self._logs):
                choice = choose_meaning(logs)
        meaning = choice.meaning
        if choice.is_ambiguous:
            options = (choice.meaning.description, choice.runner_up.description)
            columns = " and ".join(f"'{self._names[name]}'" for name in names)
            question = f"meaning of {columns} (the margin {choice.margin:.0f} decides nothing)"
            answer = self._draft_notes.ask_question(
                (*CHANNELS_KEY, names[-1]), question, options[0], choice.text, options
            )
            meaning = choice.meaning if answer == options[0] else choice.runner_up
        if meaning == BODY_AXES:
            for name in names:
                if match_axis_velocity(parse_name(self._names[name])) is not None:
                    text = "assumed in body axes, consistent with position and heading"
                    self._draft_notes.add_guess((*CHANNELS_KEY, name), text)
            return
        if "speed" in meaning.components:
            name = ("u", "v")[meaning.components.index("speed")]
            column = self._names.pop(name)
            text = f"'{column}' is left out, {name} is derived from positions: {choice.text}"
            self._draft_notes.add_note(CHANNELS_KEY, text)
            return
        if meaning == EXCHANGED_EARTH_AXES:
            self._names["u"], self._names["v"] = self._names["v"], self._names["u"]
        # names such as vx say nothing about axes; u and v say something else
        is_named_by_axes = all(match_axis_velocity(parse_name(self._names[n])) for n in names)
        add = self._draft_notes.add_note if is_named_by_axes else self._draft_notes.add_guess
        add((*CHANNELS_KEY, "u"), choice.text)
        self._is_earth_fixed = True
        self._logs = [
            reference._rotate_to_body(table, meaning == EXCHANGED_EARTH_AXES)
            for table in self._logs
        ]

    def _try_heading_frame(self, names: Mapping[str, str]) -> ChannelMapper:
        """Return a mapper of some of the channels with its frame, without notes."""
        mapper = ChannelMapper(
            names, self._logs, DraftNotes(), self._degrees_per_count, self._candidate_frames
        )
        mapper.choose_frame()
        return mapper

    def measure_velocities(
        self, names: Sequence[str], logs: Sequence[RawTable]
    ) -> list[MeasuredVelocities]:
        """Return the motion of the logs with columns of velocities, on uniform grids.

        Args:
            names: channels of the columns, u or v or both.
            logs: tables with these columns.
        """
        measured = []
        north, east = ("y", "x") if self._is_swapped else ("x", "y")
        for table, motion in zip(logs, self._motions, strict=True):
            if motion is None or not {*names} <= table.columns.keys():
                continue
            heading = convert_heading(table, self._psi_unit, self._pose_frame)

            def resample(values: np.ndarray, t: np.ndarray, grid: np.ndarray) -> np.ndarray:
                is_finite = np.isfinite(values) & np.isfinite(t)
                if is_finite.sum() < 2:
                    return np.full(grid.size, np.nan)
                return np.asarray(np.interp(grid, t[is_finite], values[is_finite]))

            position = [resample(table.columns[n], table.t, motion.t) for n in (north, east)]
            measured.append(
                make_measured_velocities(
                    motion.t,
                    (motion.surge_velocity, motion.sway_velocity),
                    np.stack(position, axis=1),
                    resample(heading, table.t, motion.t),
                    {name: resample(table.columns[name], table.t, motion.t) for name in names},
                )
            )
        return measured

    def _rotate_to_body(self, table: RawTable, is_exchanged: bool) -> RawTable:
        """Return a table with u and v in body axes, from north and east."""
        if not {"u", "v", "psi"} <= table.columns.keys():
            return table
        heading = convert_heading(table, self._psi_unit, self._pose_frame)
        north, east = (table.columns[name] for name in ("v", "u")[:: 1 if is_exchanged else -1])
        u, v = rotate(north, east, -heading)
        return RawTable(table.t, {**table.columns, "u": u, "v": v})

    def _require_compatible_velocities(self) -> None:
        """Stop where integrated velocities contradict the positions."""
        if not {"u", "v"} <= self._names.keys():
            self._heading_offset = estimate_drift_free_offset(
                self.measure_velocities((), self._logs)
            )
            return
        tables = []
        for table in self._logs:
            columns = dict(table.columns)
            for name, fit in ((n, fit_to_motion(self._logs, self._motions, n)) for n in ("u", "v")):
                unit = parse_header_unit(self._names[name], "m/s") or fit.matching_unit("m/s")
                factor = to_si(unit) if unit else 1.0
                sign = -1.0 if fit.is_significant and fit.factor < 0.0 else 1.0
                if name in columns:
                    columns[name] = sign * factor * columns[name]
            tables.append(RawTable(table.t, columns))
        logs = self.measure_velocities(("u", "v"), tables)
        contradiction = measure_contradiction(logs)
        if contradiction is not None:
            require_compatible(contradiction, [self._names[name] for name in ("u", "v")])
            self._heading_offset = contradiction.heading_offset

    def _score_consistency(self, motions: Sequence[Motion | None]) -> float:
        """Return the consistency of position, heading and velocities, at most 1."""
        velocity_fits = [
            fit_to_motion(self._logs, motions, name) for name in ("u", "v") if name in self._names
        ]
        if len(velocity_fits) == 2:
            # the sign counts for the surge velocity only
            return (
                sum(fit.correlation * (fit.factor > 0 or i) for i, fit in enumerate(velocity_fits))
                / 2
            )
        return forward_alignment(motions)

    def _choose_wind_reference(self) -> None:
        """Choose the reference of the wind direction: north or bow, true or apparent wind.

        A wind with speed or direction only is left out.
        """
        for name_pair in (BOW_WIND_CHANNELS[1:], ("wind_speed", "wind_dir")):
            if len(present := {*name_pair} & {*self._names}) == 1:
                column = self._names.pop(present.pop())
                text = f"'{column}' is left out: a wind needs speed and direction"
                self._draft_notes.add_note(CHANNELS_KEY, text)
        if "wind_dir" in self._names and BOW_WIND_CHANNELS[2] in self._names:
            columns = ", ".join(self._names.pop(name) for name in BOW_WIND_CHANNELS[1:])
            self._draft_notes.add_note(
                CHANNELS_KEY, f"the true wind exists too; left out: {columns}"
            )
        current_names = (
            BOW_WIND_CHANNELS[1:]
            if BOW_WIND_CHANNELS[2] in self._names
            else ("wind_speed", "wind_dir")
        )
        if current_names[1] not in self._names:
            return
        hypotheses = ["felt", "felt to port", "bow", "bow to port"]
        if current_names[1] == "wind_dir":
            is_true_wind = parse_name(self._names["wind_dir"]).has_all("true")
            hypotheses = ["north", *hypotheses[2 * is_true_wind :]]
        spreads = self._wind_spreads(*current_names)
        best_hypothesis = min(hypotheses, key=lambda hypothesis: spreads.get(hypothesis, np.inf))
        if spreads.get(best_hypothesis, np.inf) > _MAX_WIND_SPREAD_RATIO * spreads.get(
            hypotheses[0], 0.0
        ):
            best_hypothesis = hypotheses[0]
        if best_hypothesis == "north":
            text = "assumed the direction from which the true wind blows, clockwise from north"
            self._draft_notes.add_guess((*CHANNELS_KEY, "wind_dir"), text)
            return
        is_apparent = best_hypothesis.startswith("felt")
        side_text = " to port" if best_hypothesis.endswith("port") else ""
        new_names = BOW_WIND_CHANNELS[1:] if is_apparent else ("wind_speed", BOW_WIND_CHANNELS[0])
        names = dict(zip(current_names, new_names, strict=True))
        self._names = {names.get(name, name): column for name, column in self._names.items()}
        self._logs = [
            RawTable(
                table.t, {names.get(name, name): values for name, values in table.columns.items()}
            )
            for table in self._logs
        ]
        self._sign_flipped |= {new_names[1]} if side_text else set()
        wind = "apparent" if is_apparent else "true"
        ratio = spreads.get(best_hypothesis, 1.0) / max(spreads.get("north", 1.0), 1e-9)
        text = (
            f"assumed the direction of the {wind} wind from the bow{side_text}: so the true wind is"
            f" steadiest ({ratio:.2f} of its standard deviation with a direction from north)"
        )
        self._draft_notes.add_guess((*CHANNELS_KEY, new_names[1]), text)

    def _wind_spreads(self, speed: str, angle: str) -> dict[str, float]:
        """Return the standard deviation of the true wind in m/s for each possible reference.

        The references are north, bow (clockwise), bow to port, and the last two for the apparent
        wind (`felt`), which includes the velocity of the vessel.

        Args:
            speed: channel of the wind speed.
            angle: channel of the wind direction.
        """
        factors = [
            to_si(self._infer_unit(n, should_note=False), CHANNEL_UNITS[n]) for n in (speed, angle)
        ]
        variances: dict[str, list[float]] = {}
        for table, motion in zip(self._logs, self._motions, strict=True):
            psi = self._log_heading(table)
            if psi is None or not {speed, angle} <= table.columns.keys():
                continue
            wind_speed, wind_angle = (
                table.columns[n] * f for n, f in zip((speed, angle), factors, strict=True)
            )
            vessel_velocity = self._vessel_velocity(table, motion)
            bow_direction = np.exp(1j * psi)
            winds = {"north": wind_speed * np.exp(1j * wind_angle)}
            for suffix, sign in (("", 1.0), (" to port", -1.0)):
                winds[f"bow{suffix}"] = wind_speed * np.exp(1j * sign * wind_angle) * bow_direction
                if vessel_velocity is not None:
                    winds[f"felt{suffix}"] = winds[f"bow{suffix}"] - vessel_velocity * bow_direction
            is_finite = np.isfinite(np.stack([*winds.values()])).all(axis=0)
            if is_finite.sum() >= _MIN_WIND_SAMPLES:
                for name, wind in winds.items():
                    variances.setdefault(name, []).append(float(np.var(wind[is_finite])))
        return {name: float(np.sqrt(np.mean(parts))) for name, parts in variances.items()}

    def _vessel_velocity(self, table: RawTable, motion: Motion | None) -> np.ndarray | None:
        """Return u + iv [T] in m/s from the log or from its motion, or None."""
        if {"u", "v"} <= self._names.keys() & table.columns.keys():
            u, v = (
                table.columns[n] * to_si(self._infer_unit(n, should_note=False), "m/s")
                for n in ("u", "v")
            )
        elif motion is not None:
            u, v = (np.interp(table.t, motion.t, part) for part in motion[1:3])
        else:
            return None
        return np.asarray(u + 1j * v)

    def _log_heading(self, table: RawTable) -> np.ndarray | None:
        """Return the heading [T] of a log in rad, or the integral of its yaw rate, or None."""
        if {"psi"} <= self._names.keys() & table.columns.keys():
            return convert_heading(table, self._psi_unit, self._pose_frame)
        if {"r"} <= self._names.keys() & table.columns.keys():
            rate = table.columns["r"] * to_si(self._infer_unit("r", should_note=False), "rad/s")
            time_steps = np.diff(table.t, prepend=table.t[:1])
            return np.asarray(np.cumsum(np.nan_to_num(rate * time_steps)))
        return None

    def _infer_unit(self, name: str, *, should_note: bool = True) -> str:
        """Return the unit of a channel from its header or its values, noting a guess."""
        values = self._concatenate_values(name)
        scaling = infer_unit(name, self._names[name], values)
        if (
            name in ("phi", "theta")
            and scaling.reason
            and "psi" in self._names
            and np.nanmax(np.abs(values * to_si(self._psi_unit, "rad")), initial=0.0) < np.pi
        ):
            # small angles in deg have the size of angles in rad
            reason = f"the header has no unit; assumed that of the heading, {self._psi_unit}"
            scaling = Scaling({"unit": self._psi_unit}, reason)
        if should_note and scaling.reason:
            self._draft_notes.add_guess((*CHANNELS_KEY, name), scaling.reason)
        return str(scaling.settings["unit"])

    def _make_entry(self, name: str) -> dict[str, Any]:
        """Return column, unit and frame of a channel for the channel map of a reader."""
        column = self._names[name]
        entry: dict[str, Any] = {"column": column}
        if self._degrees_per_count and name in ("x", "y"):
            return (
                entry
                | {"unit": "deg"}
                | ({"scale": self._degrees_per_count} if self._degrees_per_count < 1.0 else {})
            )
        if name == "psi":
            if MAGNETIC_PATTERN.search(column):
                entry |= self._correct_magnetic_heading(column)
            entry["unit"] = self._psi_unit
            return entry | ({"frame": "enu"} if self._pose_frame.is_from_east else {})
        if name in ("u", "v", "r") and {"x", "y", "psi"} <= set(self._names):
            fit = fit_to_motion(self._logs, self._motions, name)
            frame = {"frame": "ned"} if self._is_earth_fixed and name in ("u", "v") else {}
            return entry | self._settle_rate(name, fit, "position and heading") | frame
        if name == "r" and "psi" in self._names:
            return entry | self._settle_rate(
                name, self._fit_rate_to_angle("psi", self._psi_unit, name), "headings"
            )
        if name in ("w", "p", "q") and (vertical_fit := self._fit_vertical_motion(name)):
            return entry | self._settle_rate(name, vertical_fit, "positions and attitude")
        if name == "p" and "phi" in self._names:
            unit = self._infer_unit("phi", should_note=False)
            return entry | self._settle_rate(
                name, self._fit_rate_to_angle("phi", unit, name), "roll angles"
            )
        if name not in STATE_NAMES and (
            scaling := guess_scaling(name, column, self._concatenate_values(name))
        ):
            self._draft_notes.add_guess((*CHANNELS_KEY, name), scaling.reason)
            return entry | scaling.settings
        sign = -1 if name in self._sign_flipped else self._conventional_sign(name)
        return entry | {"unit": self._infer_unit(name)} | ({"sign": sign} if sign < 0 else {})

    def _correct_magnetic_heading(self, column: str) -> dict[str, Any]:
        """Return the offset of a magnetic heading from the motion, noting how it was estimated."""
        key = (*CHANNELS_KEY, "psi")
        offset = self._heading_offset
        if self._pose_frame.is_from_east or offset is None or not offset.is_determined:
            text = (
                f"'{column}' is magnetic by its name, and is assumed true: set `offset` to"
                " minus the magnetic declination"
            )
            self._draft_notes.add_guess(key, text)
            return {}
        factor = to_si(self._psi_unit, "rad")
        text = (
            f"'{column}' is magnetic by its name; the motion gives an offset of"
            f" {np.degrees(offset.angle):.1f} deg, standard error"
            f" {np.degrees(offset.standard_error):.1f} deg, {offset.source}: compare it with minus"
            " the magnetic declination"
        )
        self._draft_notes.add_guess(key, text)
        return {"offset": float(f"{offset.angle / factor:.3g}")}

    def _conventional_sign(self, name: str) -> int:
        """Return -1 for v and r of tables with a ROS pose (positive to port, REP 103), else 1."""
        if not self._is_ros_pose or name not in ("v", "r"):
            return 1
        text = "assumed positive to port, as for a pose of ROS (REP 103)"
        self._draft_notes.add_guess((*CHANNELS_KEY, name), text)
        return -1

    def _fit_rate_to_angle(self, angle: str, unit: str, name: str) -> ScaleFit:
        """Regress the derivative of an angle on the column of its rate.

        Args:
            angle: channel of the angle, `psi` or `phi`.
            unit: unit of the angle.
            name: channel of the rate.
        """
        tables_with_both = [table for table in self._logs if {angle, name} <= set(table.columns)]
        angles = [
            RawTable(table.t, dict.fromkeys(("x", "y", "psi"), table.columns[angle]))
            for table in tables_with_both
        ]
        frame = self._pose_frame if angle == "psi" else POSE_FRAMES[0]
        motions = [estimate_motion(table, unit, frame) for table in angles]
        return fit_to_motion(
            [RawTable(table.t, {"r": table.columns[name]}) for table in tables_with_both],
            motions,
            "r",
        )

    def _fit_vertical_motion(self, name: str) -> ScaleFit | None:
        """Regress the heave velocity, roll rate or pitch rate on a column.

        The velocities along the axes of a vessel follow from those of its position by R^T, and its
        angular velocity from the derivatives of its angles (Fossen 2021, equations 2.31 and 2.41).

        Args:
            name: `w`, `p` or `q`.

        Returns:
            The regression; None without position, depth and all angles.
        """
        if not {"x", "y", "z", "psi", "phi", "theta"} <= self._names.keys():
            return None
        factors = {
            key: to_si(self._infer_unit(key, should_note=False), CHANNEL_UNITS[key])
            for key in ("z", "phi", "theta")
        }
        tables = []
        motions = []
        for table, motion in zip(self._logs, self._motions, strict=True):
            if motion is None or not {*factors, name} <= table.columns.keys():
                continue
            is_finite = np.isfinite([table.t, *(table.columns[key] for key in factors)]).all(axis=0)
            if is_finite.sum() < 30:
                continue
            t = table.t[is_finite]
            depth, roll, pitch = (factors[key] * table.columns[key][is_finite] for key in factors)
            depth_rate, roll_rate, pitch_rate = (
                _differentiate(motion.t, t, values) for values in (depth, roll, pitch)
            )
            roll, pitch = (np.interp(motion.t, t, angle) for angle in (roll, pitch))
            expected = {
                "w": np.cos(roll)
                * (np.sin(pitch) * motion.surge_velocity + np.cos(pitch) * depth_rate)
                - np.sin(roll) * motion.sway_velocity,
                "p": roll_rate - np.sin(pitch) * motion.yaw_rate,
                "q": np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * motion.yaw_rate,
            }
            tables.append(RawTable(table.t, {"r": table.columns[name]}))
            motions.append(motion._replace(yaw_rate=expected[name]))
        return fit_to_motion(tables, motions, "r") if tables else None

    def _settle_rate(self, name: str, fit: ScaleFit, reference: str) -> dict[str, Any]:
        """Return unit and sign of a velocity from its header and a regression.

        Args:
            name: channel of the velocity.
            fit: regression of the derivative of the reference on the column.
            reference: name of the reference, for messages.
        """
        key = (*CHANNELS_KEY, name)
        column = self._names[name]
        expected_unit = CHANNEL_UNITS[name]
        header_unit = parse_header_unit(column, expected_unit)
        measured_unit = fit.matching_unit(expected_unit) if fit.is_significant else None
        unit = header_unit or measured_unit or self._infer_unit(name)
        if header_unit is None and measured_unit is not None:
            text = f"the header has no unit; {reference} give {measured_unit}"
            self._draft_notes.add_guess(key, f"{text} (correlation {fit.correlation:.2f})")
        elif header_unit and measured_unit and fit.correlation >= _OVERRULING_CORRELATION:
            ratio = abs(fit.factor) / to_si(header_unit, expected_unit)
            if to_si(measured_unit) != to_si(header_unit, expected_unit) and not 0.6 < ratio < 1.6:
                text = (
                    f"the header has {header_unit}, {reference} give {measured_unit} (factor"
                    f" {ratio:.3g})"
                )
                question = f"unit of '{column}'"
                unit = self._draft_notes.ask_question(
                    key, question, measured_unit, text, (measured_unit, header_unit)
                )
        entry: dict[str, Any] = {"unit": unit}
        if fit.is_significant and fit.factor < 0.0:
            entry["sign"] = -1
            directions = {"u": "astern", "w": "up", "q": "bow down"}
            direction = directions.get(name, "to port")
            text = f"positive {direction} by {reference} (correlation {fit.correlation:.2f})"
            self._draft_notes.add_guess(key, text)
        elif not fit.is_significant and self._conventional_sign(name) < 0:
            entry["sign"] = -1
        if not fit.is_significant and header_unit is None:
            self._draft_notes.add_guess(key, f"{reference} do not confirm the unit {unit}")
        return entry
