"""Composition of a channel map from columns, after angles and positions are derived from others."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.frames import unwrap_angle
from residnet.core.layout import DegreesOfFreedom
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import to_si
from residnet.io.drafting.channels import QUATERNION_HEADING, ChannelMapper
from residnet.io.drafting.drift_angle import derive_drift_velocities, restore_drift_angle
from residnet.io.drafting.motion_columns import is_vertical_axis_up
from residnet.io.drafting.motion_regression import POSE_FRAMES, ROS_POSE_FRAMES, PoseFrame, RawTable
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.vertical import project_on_horizontal
from residnet.io.header_vocabulary import match_state_channel, parse_name
from residnet.io.readers.quantities import (
    COSINE_SUFFIX,
    QUATERNION,
    SINE_SUFFIX,
    complete_quaternion,
    normalize_quaternion,
    project_fixes,
    quaternion_tilt,
    quaternion_yaw,
)

_FIX_OF_AXIS = {"x": "latitude", "y": "longitude"}
_ROS_POSE_PATTERNS = {
    **{"x": r"position\W*x", "y": r"position\W*y"},
    **{"qw": r"orientation\W*w", "psi": r"orientation\W*yaw"},
}
"""Ends of column names of geometry_msgs/Pose, and of its yaw in PlotJuggler."""
_ENU_PATTERN = re.compile(r"(?:^|[\W_])enu(?:$|[\W_])", re.IGNORECASE)
_NED_PATTERN = re.compile(r"(?:^|[\W_])(?:ned|frd)(?:$|[\W_])", re.IGNORECASE)


def _choose_candidate_frames(
    names: Mapping[str, str], texts: Iterable[str]
) -> tuple[PoseFrame, ...]:
    """Return possible frames of position and heading from their names, the most probable first.

    A ROS pose has a heading from east (REP 103), unless a text contains NED. The axes of positions
    with ENU in their names are those of a ROS pose.

    Args:
        names: channel -> column.
        texts: names of all columns, and cells.
    """
    is_ros_pose = all(
        re.search(rf"(?:^|[\W_]){pattern}$", names[name].strip(), re.IGNORECASE)
        for name, pattern in _ROS_POSE_PATTERNS.items()
        if name in names
    )
    is_ros_pose |= any(_ENU_PATTERN.search(names[name]) for name in ("x", "y") if name in names)
    has_heading = {"qw", "psi"} & set(names)
    return (
        POSE_FRAMES
        if not has_heading or not is_ros_pose or any(map(_NED_PATTERN.search, texts))
        else ROS_POSE_FRAMES
    )


def draft_channel_map(
    names: Mapping[str, str],
    logs: Sequence[RawTable],
    draft_notes: DraftNotes,
    texts: Iterable[str] = (),
) -> dict[str, dict[str, Any]]:
    """Draft a channel map.

    Args:
        names: channel -> column.
        logs: tables with the columns under the names of their channels.
        draft_notes: receives guesses and notes.
        texts: names of all columns, and cells, which may contain the name of a frame.

    Returns:
        Channel -> entry.
    """
    quaternion_columns = {name: column for name, column in names.items() if name in QUATERNION}
    candidate_frames = _choose_candidate_frames(names, texts)
    depths = np.concatenate([raw.columns.get("z", np.zeros(0)) for raw in logs])
    if quaternion_columns and is_vertical_axis_up(depths):
        candidate_frames = ROS_POSE_FRAMES
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
        channel_columns["psi"] = QUATERNION_HEADING
        # with a depth, roll and pitch determine the vertical motion
        tilt_names = ("phi", "theta") if "z" in names else ()
        derived_angles |= dict.fromkeys(tilt_names, QUATERNION)
        channel_columns |= {name: f"{name} of the quaternion [rad]" for name in tilt_names}
    logs = [_add_derived_angles(raw, derived_angles) for raw in logs]
    channel_columns, logs, degrees_per_count = _project_fixes(channel_columns, logs, draft_notes)
    channel_columns, logs, drift = derive_drift_velocities(
        channel_columns, logs, draft_notes, degrees_per_count, candidate_frames
    )
    entries = ChannelMapper(
        channel_columns,
        [project_on_horizontal(raw, channel_columns) for raw in logs],
        draft_notes,
        degrees_per_count,
        candidate_frames,
    ).draft_entries()
    entries = restore_drift_angle(entries, drift, draft_notes)
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
    entries = _drop_surface_heave(entries, logs, draft_notes)
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
            if "qw" not in parts:
                columns[name] = np.arctan2(*part_values[::-1])
                continue
            quaternion = normalize_quaternion(*complete_quaternion(part_values))
            roll, pitch = quaternion_tilt(*quaternion)
            angles = {"phi": unwrap_angle(roll), "theta": pitch, "psi": quaternion_yaw(*quaternion)}
            columns[name] = angles[name]
    return RawTable(table.t, columns)


def _drop_surface_heave(
    entries: Mapping[str, dict[str, Any]], logs: Sequence[RawTable], draft_notes: DraftNotes
) -> dict[str, dict[str, Any]]:
    """Return entries without derived roll and pitch, and without heave unless a vessel dives.

    Args:
        entries: channel -> entry; with a depth, roll and pitch are derived from a quaternion.
        logs: tables.
        draft_notes: receives the note of the columns that are left out.
    """
    if "z" not in entries:
        return dict(entries)
    vertical_sign = entries["z"].get("sign", 1)
    is_earth_fixed = "frame" in entries.get("u", {})
    names = ("x", "y", "z", "psi", "phi", "theta", *(() if is_earth_fixed else ("u", "v", "w")))
    is_submerged = False
    for table in logs:
        channels = {
            name: entries[name].get("sign", 1)
            * to_si(entries[name]["unit"], CHANNEL_UNITS[name])
            * table.columns[name]
            for name in names
            if name in entries and name in table.columns
        }
        if "theta" in channels:
            channels["theta"] = vertical_sign * channels["theta"]
            is_submerged |= DegreesOfFreedom.from_channels(channels).is_six_dof
    heave_columns = {
        name: entry["column"]
        for name, entry in entries.items()
        # a roll rate is a channel of surface vessels too
        if name in ("z", "w", "q", "p")
        and match_state_channel(parse_name(entry["column"])) != name
        and not is_submerged
    }
    if heave_columns:
        text = (
            f"{', '.join(heave_columns.values())}: known and not used, a surface vessel is assumed"
            " because the depth does not follow from the motion"
        )
        draft_notes.add_note(CHANNELS_KEY, text)
    left_out = {"phi", "theta", *heave_columns, *(["w"] if is_earth_fixed else [])}
    for name in left_out & entries.keys():
        draft_notes.discard_key((*CHANNELS_KEY, name))
    return {name: entry for name, entry in entries.items() if name not in left_out}


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
        name: np.concatenate([np.zeros(0), *(raw.columns[name] for raw in fix_tables)])
        for name in fix_channels
    }
    max_latitude = float(np.nanmax(np.abs(fix_values["latitude"]), initial=0.0))
    # autopilots log latitude and longitude as integers in 1e-7 deg
    are_integers = not any((np.nan_to_num(part) % 1.0).any() for part in fix_values.values())
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
