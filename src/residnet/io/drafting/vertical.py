"""Vertical motion of underwater vessels whose attitude is a quaternion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.units import to_si
from residnet.io.drafting.channels import CHANNELS_KEY, RawTable
from residnet.io.drafting.questions import DraftNotes
from residnet.io.header_vocabulary import infer_unit, match_depth_channel, parse_name
from residnet.io.readers.quantities import (
    QUATERNION,
    normalize_quaternion,
    quaternion_tilt,
    quaternion_yaw,
)

VERTICAL_CHANNELS = ("z", "w", "q", "p")
"""Channels whose columns complete those of a planar motion to six degrees of freedom."""
_MIN_TILT = 0.1
"""Angle in rad between the vertical and the vertical axis of a vessel, exceeded in 5 % of the
samples, above which velocities along its axes differ from horizontal ones (by at least 0.5 %)."""
_MAX_FLAT_SHARE = 0.02
"""Largest ratio of standard deviations of a vertical and a horizontal coordinate."""
_N_PATH_SPANS = 100
"""Number of spans of a path whose directions are counted."""
_MIN_SECTOR_SHARE = 0.05
"""Smallest share of the path in a sector of directions; less is noise of the positions."""


def _match_vertical_columns(columns: Sequence[str]) -> dict[str, str]:
    """Return channel -> column of the first column of each vertical channel."""
    matches = {match_depth_channel(parse_name(column)): column for column in reversed(columns)}
    return {name: matches[name] for name in VERTICAL_CHANNELS if name in matches}


def refuse_vertical_y(
    path: Path,
    columns: Sequence[str],
    tables: Sequence[Mapping[str, np.ndarray]],
    names: Mapping[str, str],
) -> None:
    """Refuse tracks whose y axis points up, as those of motion-capture systems.

    In all tables y is almost constant beside x and z, and the path in the plane of x and z turns
    through three quadrants, which a path that ascends and descends does not.

    Args:
        path: first table.
        columns: names of the columns of numbers.
        tables: column -> values of each table.
        names: channel -> column of the mapped columns.

    Raises:
        DataError: if the y axis points up.
    """
    z = _match_vertical_columns(columns).get("z")
    if z is None or not {"x", "y"} <= names.keys():
        return
    for table in tables:
        if not {names["x"], names["y"], z} <= table.keys():
            return
        x, y, depth = (table[name] for name in (names["x"], names["y"], z))
        spread = min(np.nanstd(x), np.nanstd(depth))
        if not np.nanstd(y) < _MAX_FLAT_SHARE * spread:
            return
        span = max(1, x.size // _N_PATH_SPANS)
        steps = np.diff(x[::span] + 1j * depth[::span])
        steps = steps[np.isfinite(steps)]
        # sectors of 90 deg about the axes
        sectors = np.round(np.angle(steps) / (0.5 * np.pi)) % 4
        shares = np.array([np.abs(steps[sectors == k]).sum() for k in range(4)])
        if np.count_nonzero(shares > _MIN_SECTOR_SHARE * shares.sum()) < 3:
            return
    raise DataError(
        f"{path}: column '{names['y']}' is almost constant, and '{names['x']}' and '{z}' have the"
        " track: y points up, as in motion capture, but z was expected to; put -z and y for y and z"
        " of position and quaternion, in all files"
    )


def project_on_horizontal(
    columns: Sequence[str],
    tables: Sequence[Mapping[str, np.ndarray]],
    logs: Sequence[RawTable],
    names: Mapping[str, str],
) -> list[RawTable]:
    """Return logs whose u and v are horizontal, along and across the heading, for tests of frames.

    Velocities along the axes of a vessel that rolls and pitches are not those of its track. They
    are projected by the attitude, in the frame of the file: with R = R_z(yaw) R(tilt), the result
    is R(tilt) (u, v, w). Without a column of w, the heave velocity follows from the depth.

    Args:
        columns: names of the columns of numbers.
        tables: column -> values of each table.
        logs: the mapped columns of these tables.
        names: channel -> column of the mapped columns.

    Returns:
        The logs, unchanged where the vessel is upright or the velocities are not along its axes.
    """
    candidates = _match_vertical_columns(columns)
    if "z" not in candidates or len(tables) != len(logs):
        return list(logs)
    return [
        _project_log(table, log, candidates, names) for table, log in zip(tables, logs, strict=True)
    ]


def _extract_tilt(log: RawTable, names: Mapping[str, str]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return roll and pitch [T] in rad from a quaternion or from angles; None without them."""
    if {*QUATERNION} <= log.columns.keys():
        return quaternion_tilt(*normalize_quaternion(*(log.columns[name] for name in QUATERNION)))
    if not {"phi", "theta"} <= log.columns.keys() & names.keys():
        return None
    roll, pitch = (
        log.columns[name]
        * to_si(infer_unit(name, names[name], log.columns[name]).settings["unit"], "rad")
        for name in ("phi", "theta")
    )
    return roll, pitch


def _project_log(
    table: Mapping[str, np.ndarray],
    log: RawTable,
    candidates: Mapping[str, str],
    names: Mapping[str, str],
) -> RawTable:
    """Return a log with horizontal velocities; see `project_on_horizontal`."""
    tilt = _extract_tilt(log, names)
    if tilt is None or not {"u", "v"} <= log.columns.keys():
        return log
    roll, pitch = tilt
    z = table.get(candidates["z"], np.zeros(0))
    if z.size != log.t.size or z.size < 10:
        return log
    cosine = np.cos(roll) * np.cos(pitch)
    if float(np.nanquantile(cosine, 0.05)) > np.cos(_MIN_TILT):
        return log
    u = log.columns["u"]
    v = log.columns["v"]
    rate = np.gradient(z, log.t)
    rate_without_heave = v * np.cos(pitch) * np.sin(roll) - u * np.sin(pitch)
    w = table.get(candidates.get("w", ""), np.zeros(0))
    if w.size == z.size:
        # a velocity of the world frame is the rate of z itself
        body_error = np.nanmean((rate - rate_without_heave - cosine * w) ** 2)
        if np.nanmean((rate - w) ** 2) <= body_error:
            return log
    else:
        w = (rate - rate_without_heave) / cosine
    # R_y(pitch) R_x(roll) (u, v, w), Fossen 2021, equation (2.31) without the yaw
    cross_flow = v * np.sin(roll) + w * np.cos(roll)
    horizontal = {
        "u": u * np.cos(pitch) + cross_flow * np.sin(pitch),
        "v": v * np.cos(roll) - w * np.sin(roll),
    }
    return RawTable(log.t, {**log.columns, **horizontal})


def draft_vertical_motion(
    columns: Sequence[str],
    tables: Sequence[Mapping[str, np.ndarray]],
    logs: Sequence[RawTable],
    channels: Mapping[str, Mapping[str, Any]],
    draft_notes: DraftNotes,
) -> dict[str, dict[str, Any]]:
    """Draft the vertical motion of an underwater vessel whose attitude is a quaternion.

    The columns are the siblings of those of the planar motion, such as `position_z` of
    `position_x`. They are used if the depth follows from velocities and attitude.

    Args:
        columns: names of the columns of numbers.
        tables: column -> values of each table.
        logs: the mapped columns of these tables.
        channels: channel -> entry of the planar motion.
        draft_notes: receives guesses and notes.

    Returns:
        Channel -> entry of depth, heave velocity, pitch rate and roll rate; empty for a surface
        vessel.
    """
    candidates = {
        name: column
        for name, column in _match_vertical_columns(columns).items()
        # a velocity of the world frame is no heave velocity
        if name not in channels and not (name == "w" and "frame" in channels.get("u", {}))
    }
    if (
        "z" not in candidates
        or not {*QUATERNION} <= channels.keys()
        or len(tables) != len(logs)
        or any(set(candidates.values()) - table.keys() for table in tables)
    ):
        return {}
    is_east_north_up = channels["qw"].get("frame") == "enu"
    vertical_sign = -1 if is_east_north_up else 1
    rates: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in ("w", "q", "p")}
    is_submerged = False
    for table, log in zip(tables, logs, strict=True):
        has_velocities = {"u", "v"} <= log.columns.keys()
        if not {*QUATERNION} <= log.columns.keys() or not (
            has_velocities or {"x", "y"} <= log.columns.keys()
        ):
            return {}
        parts = normalize_quaternion(*(log.columns[name] for name in QUATERNION))
        roll, pitch = quaternion_tilt(*parts)
        pitch = vertical_sign * pitch
        values = {name: table[column] for name, column in candidates.items()}
        if any(column.size != log.t.size for column in values.values()) or log.t.size < 10:
            continue
        zeros = np.zeros(log.t.size)
        u = log.columns["u"] if has_velocities else zeros
        v = vertical_sign * log.columns["v"] if has_velocities else zeros
        depth = vertical_sign * values["z"]
        depth_rate = np.gradient(depth, log.t)
        heave = depth_rate + u * np.sin(pitch) - v * np.cos(pitch) * np.sin(roll)
        rates["w"].append((values.get("w", heave), heave / (np.cos(pitch) * np.cos(roll))))
        rates["q"].append((values.get("q", heave), np.gradient(pitch, log.t)))
        rates["p"].append((values.get("p", heave), np.gradient(np.unwrap(roll), log.t)))
        yaw = np.unwrap(quaternion_yaw(*parts))
        motion = {"x": log.columns.get("x", u), "y": log.columns.get("y", v), "psi": yaw}
        motion |= {"z": depth, "phi": roll, "theta": pitch}
        motion |= {"u": u, "v": v} if has_velocities else {}
        if "w" in values:
            motion["w"] = values["w"] * np.sign(np.nansum(values["w"] * heave))
        is_submerged |= DegreesOfFreedom.from_channels(motion).is_six_dof
    if not is_submerged:
        draft_notes.add_note(
            CHANNELS_KEY,
            f"{', '.join(candidates.values())}: known and not used, a surface vessel is assumed"
            " because the depth does not follow from "
            + (
                "the motion"
                if {"u", "v"} <= channels.keys()
                else "the pitch angle along the path; a vessel that heaves needs velocities, for"
                " example columns u, v, w along its axes"
            ),
        )
        return {}
    entries: dict[str, dict[str, Any]] = {}
    for name, column in candidates.items():
        values_of_logs = np.concatenate([table[column] for table in tables])
        scaling = infer_unit(name, column, values_of_logs)
        sign = vertical_sign
        if name != "z":
            measured = np.concatenate([pair[0] for pair in rates[name]])
            expected = np.concatenate([pair[1] for pair in rates[name]])
            is_finite = np.isfinite(measured) & np.isfinite(expected)
            sign = 1 if float(measured[is_finite] @ expected[is_finite]) >= 0.0 else -1
        entries[name] = {"column": column, **scaling.settings, **({"sign": -1} if sign < 0 else {})}
        draft_notes.add_guess(
            (*CHANNELS_KEY, name),
            f"'{column}' completes the six degrees of freedom"
            + ("; positive up in the file" if name == "z" and sign < 0 else "")
            + (f"; {scaling.reason}" if scaling.reason else ""),
        )
    return entries
