"""Tables that hold the attitude as a quaternion in place of a heading."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.data.drafting.channels import CHANNELS
from residnet.data.drafting.physics import FRAMES, POSE_FRAMES, Frame, Raw
from residnet.data.drafting.questions import Marks
from residnet.data.readers.frames import unit_quaternion, yaw_of
from residnet.data.readers.quantities import QUATERNION

_COLUMN = re.compile(
    r"(?P<stem>(?:.*[\W_])?(?:q|quat|quaternions?|orient|orientation|att|attitude|rot|rotation))"
    r"[\W_]*(?P<part>[xyzwijk0-3])\W*",
    re.IGNORECASE,
)
_PARTS = {**dict(zip("xyzw", QUATERNION, strict=True)), "i": "qx", "j": "qy", "k": "qz"}
_COUNTED = (("qw", "qx", "qy", "qz"), QUATERNION)
"""What counted parts may be: most write the scalar part first, some last."""
_POSE = {"x": r"position\W*x", "y": r"position\W*y", "qw": r"orientation\W*w"}
"""How the columns of a message geometry_msgs/Pose end."""
_NED = re.compile(r"(?:^|[\W_])(?:ned|frd)(?:$|[\W_])", re.IGNORECASE)
_HEADING = "heading of the quaternion [rad]"


def quaternions(columns: Sequence[str]) -> list[dict[str, str]]:
    """Return for each quaternion channel -> column, by what the columns are called.

    Parts that are counted 0 to 3 stand twice, with the scalar part first and last.
    """
    found: dict[str, dict[str, str]] = {}
    for column in columns:
        # units in brackets do not belong to the name
        match = _COLUMN.fullmatch(re.sub(r"\s*\[\D*\]$|\s*\(\D*\)$", "", column.strip()))
        if match is not None:
            part = match["part"].lower()
            channels = [_PARTS[part]] if part in _PARTS else [row[int(part)] for row in _COUNTED]
            for number, channel in enumerate(channels):
                kind = f"{match['stem']} {number if part.isdigit() else 'named'}"
                found.setdefault(kind, {}).setdefault(channel, column)
    return [parts for parts in found.values() if set(parts) == set(QUATERNION)]


def from_quaternion(
    names: Mapping[str, str], parts: Mapping[str, str], logs: Sequence[Raw]
) -> tuple[dict[str, str], list[Raw]]:
    """Return channel -> column and the logs, with a heading in rad from qx, qy, qz, qw.

    Args:
        names: channel -> column, without the heading.
        parts: channel -> column of the quaternion.
        logs: their columns by channel, those of the quaternion among them.
    """
    turned = []
    for raw in logs:
        if set(QUATERNION) <= set(raw.columns):
            yaw = yaw_of(*unit_quaternion(*(raw.columns[name] for name in QUATERNION)))
            others = {name: raw.columns[name] for name in raw.columns if name not in QUATERNION}
            raw = Raw(raw.t, {**others, "psi": yaw})
        turned.append(raw)
    rest = {name: column for name, column in names.items() if name not in parts}
    return {**rest, "psi": _HEADING}, turned


def frames_of(
    names: Mapping[str, str], parts: Mapping[str, str], texts: Iterable[str]
) -> tuple[Frame, ...]:
    """Return the frames that a position and a quaternion may have, by what they are called.

    A pose of ROS counts from east, as REP 103 asks, unless something is called NED.

    Args:
        names: channel -> column.
        parts: channel -> column of the quaternion.
        texts: names of columns and the texts of the tables, those of frames among them.
    """
    held = {**names, **parts}
    posed = all(
        re.search(rf"(?:^|[\W_]){ending}$", held[name].strip(), re.IGNORECASE)
        for name, ending in _POSE.items()
        if name in held
    )
    if "qw" not in held or not posed or any(_NED.search(text) for text in texts):
        return FRAMES
    return POSE_FRAMES


def levelled(
    attitudes: Sequence[dict[str, str]], columns: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, str]:
    """Return the first of quaternions, in the order of its parts that leaves a vessel level.

    Args:
        attitudes: channel -> column of each, as `quaternions` gave them.
        columns: column -> values of each table.
    """
    if not attitudes:
        return {}
    alike = [parts for parts in attitudes if set(parts.values()) == set(attitudes[0].values())]

    def tilt(parts: Mapping[str, str]) -> float:
        whole = [table for table in columns if set(parts.values()) <= set(table)]
        tilts = [table[parts[name]] for table in whole for name in ("qx", "qy")]
        return float(np.nanmean(np.concatenate(tilts) ** 2)) if tilts else 0.0

    return min(alike, key=tilt)


def is_unit(logs: Sequence[Raw]) -> bool:
    """Return whether four columns are a quaternion: their squares add up to one."""
    norms = [
        np.sqrt(sum(raw.columns[name] ** 2 for name in QUATERNION))
        for raw in logs
        if set(QUATERNION) <= set(raw.columns)
    ]
    known = np.concatenate([norm[np.isfinite(norm) & (norm > 0)] for norm in norms] or [np.ones(0)])
    return known.size > 0 and bool(abs(float(np.median(known)) - 1.0) < 0.02)


def as_quaternion(
    entries: Mapping[str, dict[str, Any]], parts: Mapping[str, str], marks: Marks, placed: bool
) -> dict[str, dict[str, Any]]:
    """Return the entries of a channel map with the quaternion's in place of psi.

    Args:
        entries: channel -> entry.
        parts: channel -> column of the quaternion.
        marks: is told what is not sure.
        placed: there is a position, which tells the frame.
    """
    out = {name: entry for name, entry in entries.items() if name != "psi"}
    frame = {"frame": entries["psi"]["frame"]} if "frame" in entries["psi"] else {}
    out |= {name: {"column": parts[name], "unit": "-"} for name in QUATERNION}
    out["qw"] |= frame
    marks.move((*CHANNELS, "psi"), (*CHANNELS, "qw"))
    turned = "anticlockwise from east" if frame else "clockwise from north"
    if placed:
        text = f"position and heading fit together best where the heading counts {turned}"
    else:
        text = f"no position tells the frame; the heading is taken to count {turned}"
    marks.guess((*CHANNELS, "qw"), text)
    if re.search(r"\d\W*$", parts["qw"]):
        text = f"'{parts['qw']}' is taken as the scalar part, which leaves the vessel level"
        marks.guess((*CHANNELS, "qw"), text)
    return out
