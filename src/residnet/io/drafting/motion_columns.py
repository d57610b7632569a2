"""Columns of attitude and depth by their names: quaternions, cosines and sines, vertical plane."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from residnet.core.layout import DegreesOfFreedom
from residnet.core.names import BOW_WIND_CHANNELS
from residnet.io.header_vocabulary import match_depth_channel, parse_name
from residnet.io.readers.quantities import COSINE_SUFFIX, PLANAR_QUATERNION, QUATERNION, SINE_SUFFIX

_DEPTH_CHANNELS = ("w", "q", "z", "theta")
"""Channels of underwater vessels, in addition to those of roll."""
MOTION_AND_WIND_CHANNELS = (
    *("x", "y", "psi", "u", "v", "r", "phi", "p", *_DEPTH_CHANNELS, "wind_speed", "wind_dir"),
    *BOW_WIND_CHANNELS,
)
"""Channels of the motion and the wind, in the order of a channel map."""
MAGNETIC_PATTERN = re.compile(
    r"magn|compass|kompass|\bhdm\b|\(m\)|\bmag(?![a-z])|_mag(?![a-z])", re.I
)
"""Words in the name of a column of magnetic headings."""
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


def find_quaternions(columns: Sequence[str]) -> list[dict[str, str]]:
    """Find quaternions by the names of their columns.

    Returns:
        For each quaternion: channel (qx, qy, qz, qw) -> column. A quaternion with numbered parts
        occurs twice, with the scalar part first and last. Without complete ones, quaternions of
        planar motion with the parts qz and qw.
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
    """Return the channels w, q, z, theta -> columns of the table of an underwater vessel.

    Such a table has depth, pitch and roll or a quaternion, or motion in the vertical plane only;
    for other tables the result is empty.

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
    if {*QUATERNION} <= {*known_channels}:
        # the quaternion has the pitch
        column_by_channel.pop("theta", None)
    has_full_attitude = "z" in column_by_channel and (
        {*QUATERNION} <= {*known_channels}
        or ("phi" in known_channels and "theta" in column_by_channel)
    )
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


def is_vertical_axis_up(depths: np.ndarray) -> bool:
    """Return whether the vertical axis of depths [T] points up: those of a diver are negative."""
    depths = depths[np.isfinite(depths)]
    return bool(
        depths.size
        and float((depths < 0.0).mean()) > _MIN_SUBMERGED_SHARE
        and float(np.median(depths)) < -_MIN_SUBMERGED_DEPTH
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
