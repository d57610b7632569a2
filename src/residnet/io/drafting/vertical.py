"""Vertical motion of underwater vessels whose attitude is a quaternion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import to_si
from residnet.io.drafting.motion_regression import RawTable, ScaleFit
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.header_vocabulary import (
    Scaling,
    infer_unit,
    match_depth_channel,
    parse_header_unit,
    parse_name,
)
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
_MIN_PITCH_COSINE = 0.1
"""Smallest cosine of a pitch angle in the rate of the heading, which is singular at 90 deg."""
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
    """Refuse tracks whose y axis points up, a convention of motion-capture systems.

    In all tables y is almost constant in comparison with x and z, and the path in the plane of x
    and z turns through three quadrants, which a path that ascends and descends does not.

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
        smallest_std = min(np.nanstd(x), np.nanstd(depth))
        if not np.nanstd(y) < _MAX_FLAT_SHARE * smallest_std:
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

    Velocities along the axes of a vessel that rolls and pitches are not horizontal. They are
    projected by the attitude, in the frame of the file: with R = R_z(yaw) R(tilt), the result
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
    return _convert_angle("phi", log, names), _convert_angle("theta", log, names)


def _convert_angle(name: str, log: RawTable, names: Mapping[str, str]) -> np.ndarray:
    """Return roll or pitch [T] in rad; without a unit it has the unit of the heading.

    Small angles in deg have the size of angles in rad, whereas a heading has a large range.
    """
    reference = name
    if parse_header_unit(names[name], "rad") is None and {"psi"} <= names.keys() & log.columns:
        reference = "psi"
    unit = infer_unit(reference, names[reference], log.columns[reference]).settings["unit"]
    return np.asarray(log.columns[name] * to_si(unit, "rad"))


def _project_log(
    table: Mapping[str, np.ndarray],
    log: RawTable,
    candidates: Mapping[str, str],
    names: Mapping[str, str],
) -> RawTable:
    """Return a log with horizontal velocities; see `project_on_horizontal`."""
    tilt = _extract_tilt(log, names)
    if tilt is None:
        return log
    roll, pitch = tilt
    z = table.get(candidates["z"], np.zeros(0))
    if z.size != log.t.size or z.size < 10:
        return log
    cosine = np.cos(roll) * np.cos(pitch)
    if float(np.nanquantile(cosine, 0.05)) > np.cos(_MIN_TILT):
        return log
    horizontal = {}
    if "r" in log.columns:
        # rate of the heading, Fossen 2021, equation (2.40)
        pitch_rate = table.get(candidates.get("q", ""), np.zeros(0))
        pitch_rate = pitch_rate if pitch_rate.size == z.size else np.zeros(z.size)
        yaw_rate = pitch_rate * np.sin(roll) + log.columns["r"] * np.cos(roll)
        horizontal["r"] = yaw_rate / np.maximum(np.cos(pitch), _MIN_PITCH_COSINE)
    if "u" not in log.columns:
        return RawTable(log.t, {**log.columns, **horizontal}) if horizontal else log
    u = log.columns["u"]
    v = log.columns.get("v", np.zeros(z.size))
    rate = np.gradient(z, log.t)
    rate_without_heave = v * np.cos(pitch) * np.sin(roll) - u * np.sin(pitch)
    w = table.get(candidates.get("w", ""), np.zeros(0))
    if w.size == z.size:
        # a velocity of the world frame is the rate of z itself
        body_error = np.nanmean((rate - rate_without_heave - cosine * w) ** 2)
        if np.nanmean((rate - w) ** 2) <= body_error:
            return RawTable(log.t, {**log.columns, **horizontal}) if horizontal else log
    else:
        # the unit of u may be unknown; a vessel that dives by pitch has little heave
        is_finite = np.isfinite(rate) & np.isfinite(rate_without_heave)
        fit = _regress(rate_without_heave[is_finite], rate[is_finite])
        unit = fit.matching_unit("m/s") if fit.is_significant else None
        w = (rate / to_si(unit or "m/s") - rate_without_heave) / cosine
    # R_y(pitch) R_x(roll) (u, v, w), Fossen 2021, equation (2.31) without the yaw
    cross_flow = v * np.sin(roll) + w * np.cos(roll)
    horizontal["u"] = u * np.cos(pitch) + cross_flow * np.sin(pitch)
    if "v" in log.columns:
        horizontal["v"] = v * np.cos(roll) - w * np.sin(roll)
    return RawTable(log.t, {**log.columns, **horizontal})


def draft_vertical_motion(
    columns: Sequence[str],
    tables: Sequence[Mapping[str, np.ndarray]],
    logs: Sequence[RawTable],
    channels: Mapping[str, Mapping[str, Any]],
    draft_notes: DraftNotes,
) -> dict[str, dict[str, Any]]:
    """Draft the vertical motion of an underwater vessel whose attitude is a quaternion.

    The columns are the siblings of the columns of the planar motion, such as `position_z` of
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
        values = {name: table[column] for name, column in candidates.items()}
        if any(column.size != log.t.size for column in values.values()) or log.t.size < 10:
            continue
        motion = _estimate_vertical_motion(log, values["z"], channels, vertical_sign)
        for name, pairs in rates.items():
            pairs.append((values.get(name, motion[name]), motion[name]))
        if "w" in values:
            scaling, sign = _settle_rate(
                "w", candidates["w"], rates["w"][-1:], channels, vertical_sign
            )
            motion["w"] = sign * values["w"] * to_si(scaling.settings["unit"], "m/s")
        else:
            del motion["w"]
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
        if name == "z":
            depths = np.concatenate([table[column] for table in tables])
            scaling = infer_unit(name, column, depths)
            sign = vertical_sign
        else:
            # along the axes of a body in east-north-up a roll has the same direction
            usual_sign = vertical_sign if name != "p" else 1
            scaling, sign = _settle_rate(name, column, rates[name], channels, usual_sign)
        entries[name] = {"column": column, **scaling.settings, **({"sign": -1} if sign < 0 else {})}
        draft_notes.add_guess(
            (*CHANNELS_KEY, name),
            f"'{column}' completes the six degrees of freedom"
            + ("; positive up in the file" if name == "z" and sign < 0 else "")
            + (f"; {scaling.reason}" if scaling.reason else ""),
        )
    return entries


def _estimate_vertical_motion(
    log: RawTable,
    vertical_position: np.ndarray,
    channels: Mapping[str, Mapping[str, Any]],
    vertical_sign: int,
) -> dict[str, np.ndarray]:
    """Return the pose, and the velocities w, q and p that follow from it, in NED and SI.

    Args:
        log: mapped columns of a table, with a quaternion.
        vertical_position: column of the vertical position [T].
        channels: channel -> entry of the planar motion, for the units of u and v.
        vertical_sign: -1 if the axes of the file are east-north-up, 1 for north-east-down.
    """
    parts = normalize_quaternion(*(log.columns[name] for name in QUATERNION))
    roll, pitch = quaternion_tilt(*parts)
    pitch = vertical_sign * pitch
    depth = vertical_sign * vertical_position
    zeros = np.zeros(log.t.size)
    velocities = {}
    if {"u", "v"} <= log.columns.keys():
        units = [str(channels.get(name, {}).get("unit", "m/s")) for name in ("u", "v")]
        velocities["u"] = log.columns["u"] * to_si(units[0], "m/s")
        velocities["v"] = vertical_sign * log.columns["v"] * to_si(units[1], "m/s")
    u = velocities.get("u", zeros)
    v = velocities.get("v", zeros)
    heave = np.gradient(depth, log.t) + u * np.sin(pitch) - v * np.cos(pitch) * np.sin(roll)
    pose = {
        "x": log.columns.get("x", u),
        "y": log.columns.get("y", v),
        "z": depth,
        "psi": np.unwrap(quaternion_yaw(*parts)),
        "phi": roll,
        "theta": pitch,
    }
    rates = {
        "w": heave / (np.cos(pitch) * np.cos(roll)),
        "q": np.gradient(pitch, log.t),
        "p": np.gradient(np.unwrap(roll), log.t),
    }
    return {**pose, **velocities, **rates}


def _settle_rate(
    name: str,
    column: str,
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    channels: Mapping[str, Mapping[str, Any]],
    usual_sign: int,
) -> tuple[Scaling, int]:
    """Return unit and sign of a column with a vertical velocity or a rate.

    Args:
        name: channel.
        column: name of the column.
        pairs: measured and expected values [T] of each table, the latter in SI.
        channels: channel -> entry of the planar motion, whose units count if the values do not
            determine the unit.
        usual_sign: sign if the values do not determine it.
    """
    measured = np.concatenate([pair[0] for pair in pairs])
    expected = np.concatenate([pair[1] for pair in pairs])
    scaling = infer_unit(name, column, measured)
    is_finite = np.isfinite(measured) & np.isfinite(expected)
    fit = _regress(measured[is_finite], expected[is_finite])
    if not fit.is_significant:
        sibling = channels.get("u" if name == "w" else "r", {})
        if scaling.reason and "unit" in sibling:
            reason = f"the header has no unit; assumed that of '{sibling['column']}'"
            scaling = Scaling({"unit": sibling["unit"]}, reason)
        return scaling, usual_sign
    unit = fit.matching_unit(CHANNEL_UNITS[name])
    if scaling.reason and unit is not None:
        reason = f"the header has no unit; depth and attitude give {unit}"
        scaling = Scaling({"unit": unit}, reason)
    return scaling, 1 if fit.factor > 0.0 else -1


def _regress(measured: np.ndarray, expected: np.ndarray) -> ScaleFit:
    """Regress expected values [T] on a column [T]; both are noisy (geometric mean regression)."""
    covariance = float(measured @ expected)
    measured_energy = float(measured @ measured)
    expected_energy = float(expected @ expected)
    if min(measured_energy, expected_energy) <= 0.0:
        return ScaleFit(0.0, 0.0)
    factor = float(np.sign(covariance) * np.sqrt(expected_energy / measured_energy))
    return ScaleFit(factor, abs(covariance) / np.sqrt(measured_energy * expected_energy))
