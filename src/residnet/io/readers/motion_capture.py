"""Exports of the motion-capture system OptiTrack Motive (csv with rigid bodies).

The names of the columns stand in several rows: the kind of object, its name, its number, the
quantity and the axis. Axes and units depend on settings of the export. The table that is read has
one row of names, positions in m and quaternions in north-east-down.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from residnet.core.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

VerticalAxis = Literal["y", "z"]
BowAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
_MAX_HEADER_LINES = 12
"""Number of lines in which an export has the names of its columns."""
_RIGID_BODY_TYPES = ("Rigid Body", "RigidBody")
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
"""Length unit of an export in lower case -> its length in m."""
_QUATERNION_AXES = ("X", "Y", "Z", "W")
_POSITION_AXES = ("X", "Y", "Z")
_MAX_FLAT_SHARE = 0.02
"""Largest ratio of the vertical and the horizontal standard deviation of a surface vessel."""
_MIN_MOVING_SPEED = 0.2
"""Smallest speed, relative to its 90 % quantile, at which the track has a direction."""


class MotiveHeader(NamedTuple):
    """Header of an export of Motive.

    Attributes:
        n_lines: number of lines above the values.
        metres: length of a unit of position in m.
        rotation: `Quaternion`, or the order of Euler angles such as `XYZ`.
        columns: column of the time (key `t`), and of each quantity of a rigid body, with keys such
            as `hover Position X`.
        bodies: names of the rigid bodies.
    """

    n_lines: int
    metres: float
    rotation: str
    columns: dict[str, int]
    bodies: tuple[str, ...]


class MotiveAxes(NamedTuple):
    """Axes of an export of Motive.

    Attributes:
        up: axis that points up.
        bow: axis of the rigid body that points forward.
    """

    up: VerticalAxis
    bow: BowAxis


def parse_motive_header(path: Path, lines: Sequence[str]) -> MotiveHeader | None:
    """Parse the header of an export of Motive; None for other files.

    Args:
        path: file, for messages.
        lines: first lines of the file.

    Raises:
        DataError: if the export has no rigid body, or an unknown unit.
    """
    if not lines or not lines[0].startswith("Format Version,"):
        return None
    rows = list(csv.reader(lines[:_MAX_HEADER_LINES]))
    axis_row = next((i for i, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if axis_row is None or axis_row < 3:
        return None
    settings = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    types = next((row for row in rows[:axis_row] if {*_RIGID_BODY_TYPES} & {*row}), [])
    if not types:
        raise DataError(
            f"{path}: the export of Motive has no rigid body; export with 'Rigid Bodies' selected"
        )
    names = rows[rows.index(types) + 1]
    columns = {"t": 1}
    cells = zip(types, names, rows[axis_row - 1], rows[axis_row], strict=False)
    for k, (kind, name, quantity, axis) in enumerate(cells):
        if kind in _RIGID_BODY_TYPES and quantity in ("Rotation", "Position"):
            columns.setdefault(f"{name} {quantity} {axis}", k)
    is_rigid_body = [kind in _RIGID_BODY_TYPES for kind in types]
    bodies = tuple(
        dict.fromkeys(name for name, is_body in zip(names, is_rigid_body, strict=False) if is_body)
    )
    unit = settings.get("Length Units", "Meters")
    if unit.lower() not in _METRES:
        raise DataError(
            f"{path}: line 1 has the length unit '{unit}', expected"
            f" {', '.join(name.capitalize() for name in _METRES)}; export again in meters"
        )
    rotation = settings.get("Rotation Type", "Quaternion")
    header = MotiveHeader(axis_row + 1, _METRES[unit.lower()], rotation, columns, bodies)
    for body in bodies:
        missing = [key for key in _required_keys(header, body) if key not in columns]
        if missing:
            raise DataError(
                f"{path}: rigid body '{body}' has no column '{missing[0].removeprefix(body)[1:]}';"
                " export position and rotation of rigid bodies"
            )
    return header


def _required_keys(header: MotiveHeader, body: str) -> list[str]:
    axes = _QUATERNION_AXES if header.rotation == "Quaternion" else _POSITION_AXES
    rotations = [f"{body} Rotation {axis}" for axis in axes]
    return [*rotations, *(f"{body} Position {axis}" for axis in _POSITION_AXES)]


class _Pose(NamedTuple):
    """Position [T, 3] in m and quaternion [T, 4] (x, y, z, w) of a rigid body."""

    position: np.ndarray
    quaternion: np.ndarray


def _load_poses(
    path: Path, header: MotiveHeader, rows: int | None
) -> tuple[np.ndarray, dict[str, _Pose]]:
    """Return the times [T] in s and the pose of each rigid body in the axes of the file.

    Raises:
        DataError: if a cell is no number, or the file has no rows.
    """
    import pandas as pd
    from scipy.spatial.transform import Rotation

    try:
        table = pd.read_csv(
            path,
            skiprows=header.n_lines,
            nrows=rows,
            header=None,
            usecols=sorted({*header.columns.values()}),
            encoding="utf-8-sig",
            dtype=np.float64,
        )
    except (ValueError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise DataError(
            f"{path}: below line {header.n_lines} a row of numbers for each frame was expected"
            f" ({reason}); export the take again"
        ) from error
    if table.empty:
        raise DataError(f"{path}: has a header and no rows; leave the file out")

    def columns_of(keys: Sequence[str]) -> np.ndarray:
        values: np.ndarray = table[[header.columns[key] for key in keys]].to_numpy()
        return values

    poses = {}
    for body in header.bodies:
        keys = _required_keys(header, body)
        position = header.metres * columns_of(keys[-3:])
        angles = columns_of(keys[:-3])
        if header.rotation == "Quaternion":
            quaternion = angles
        else:
            is_tracked = np.isfinite(angles).all(axis=1)
            quaternion = np.full((len(table), 4), np.nan)
            # Motive rotates about the axes of the body, in this order
            order = header.rotation.upper()
            ordered = angles[is_tracked][:, ["XYZ".index(axis) for axis in order]]
            rotations = Rotation.from_euler(order, ordered, degrees=True)
            quaternion[is_tracked] = rotations.as_quat()
        poses[body] = _Pose(position, quaternion)
    return columns_of(["t"])[:, 0], poses


def _to_north_east_down(vectors: np.ndarray, up: VerticalAxis) -> np.ndarray:
    """Rotate vectors [T, 3] of the file: x to north, the axis up to the opposite of down."""
    x, y, z = vectors.T
    return np.stack((x, z, -y) if up == "y" else (x, -y, -z), axis=1)


def _bow_angle(axes: MotiveAxes) -> float:
    """Return the angle in rad, clockwise from the body's x axis, of the axis that points forward.

    Starboard of x is z with y up, and -y with z up.
    """
    starboard = "z" if axes.up == "y" else "-y"
    port = starboard[1:] if starboard.startswith("-") else f"-{starboard}"
    quarters = {"x": 0, starboard: 1, "-x": 2, port: 3}
    return 0.5 * np.pi * quarters[axes.bow]


def list_bow_axes(up: VerticalAxis) -> tuple[BowAxis, ...]:
    """Return the horizontal axes of a rigid body."""
    return ("x", "-x", "z", "-z") if up == "y" else ("x", "-x", "y", "-y")


def read_motive(path: Path, axes: MotiveAxes, rows: int | None = None) -> pd.DataFrame:
    """Read an export of Motive as a table with one row of names.

    Args:
        path: csv file of a take.
        axes: axes of the export.
        rows: largest number of rows to read; None for all.

    Returns:
        Columns `t [s]`, and for each rigid body `north [m]`, `east [m]`, `height [m]` (`depth [m]`
        for a vessel that dives), `q_x`, `q_y`, `q_z`, `q_w` in north-east-down with x forward. With
        several bodies each column begins with the body's name.

    Raises:
        DataError: if the file is no export of Motive, or cannot be read.
    """
    import pandas as pd

    header = _read_header(path)
    t, poses = _load_poses(path, header, rows)
    # half the angle of the rotation from the body's x axis to its bow
    half_angle = 0.5 * _bow_angle(axes)
    columns = {"t [s]": t}
    for body, pose in poses.items():
        prefix = f"{body} " if len(poses) > 1 else ""
        position = _to_north_east_down(pose.position, axes.up)
        qx, qy, qz = _to_north_east_down(pose.quaternion[:, :3], axes.up).T
        qw = pose.quaternion[:, 3]
        cosine = np.cos(half_angle)
        sine = np.sin(half_angle)
        spread = np.nanstd(position, axis=0)
        is_flat = spread[2] < _MAX_FLAT_SHARE * float(np.hypot(*spread[:2]))
        vertical = {"height [m]": -position[:, 2]} if is_flat else {"depth [m]": position[:, 2]}
        values = {
            "north [m]": position[:, 0],
            "east [m]": position[:, 1],
            **vertical,
            # the product of the quaternion and that of a rotation about the vertical body axis
            "q_x": qx * cosine + qy * sine,
            "q_y": qy * cosine - qx * sine,
            "q_z": qz * cosine + qw * sine,
            "q_w": qw * cosine - qz * sine,
        }
        columns |= {f"{prefix}{name}": column for name, column in values.items()}
    table = pd.DataFrame(columns)
    # lines above the values minus one header, to number rows in messages
    table.attrs["n_lines_above"] = header.n_lines - 1
    return table


def _read_header(path: Path) -> MotiveHeader:
    """Return the header of an export.

    Raises:
        DataError: if the file is no export of Motive.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        header = parse_motive_header(path, list(islice(stream, _MAX_HEADER_LINES)))
    if header is None:
        raise DataError(
            f"{path}: is no export of OptiTrack Motive ('Format Version,...' in line 1, 'Frame,"
            "Time (Seconds)' above the numbers); remove `motive_up` from the reader"
        )
    return header


def detect_motive_axes(path: Path, rows: int) -> MotiveAxes:
    """Choose the axes of an export by the motion.

    A vessel turns about its vertical axis, and moves in the direction of its bow.

    Args:
        path: csv file of a take.
        rows: largest number of rows to read.
    """
    _, poses = _load_poses(path, _read_header(path), rows)
    pose = max(poses.values(), key=lambda body: float(np.nanstd(body.position, axis=0).sum()))
    rotation = np.nanmean(pose.quaternion[:, :3] ** 2, axis=0)
    spread = np.nanstd(pose.position, axis=0)
    # without turns the axis of the smallest displacement is vertical
    is_turning = max(rotation[1:]) > 4.0 * min(rotation[1:])
    is_y_up = rotation[1] > rotation[2] if is_turning else spread[1] < spread[2]
    up: VerticalAxis = "y" if is_y_up else "z"
    position = _to_north_east_down(pose.position, up)
    _, _, qz = _to_north_east_down(pose.quaternion[:, :3], up).T
    heading = 2.0 * np.arctan2(qz, pose.quaternion[:, 3])
    stride = max(1, len(heading) // 500)
    steps = np.diff(position[::stride, 0] + 1j * position[::stride, 1])
    angles = heading[::stride][:-1]
    is_valid = np.isfinite(steps) & np.isfinite(angles)
    steps = steps[is_valid] * np.exp(-1j * angles[is_valid])
    size = np.abs(steps)
    if not size.size or not size.any():
        return MotiveAxes(up, "x")
    moving = steps[size > _MIN_MOVING_SPEED * np.quantile(size, 0.9)]
    course = float(np.angle((moving / np.abs(moving)).mean()))
    differences = {
        axis: abs(np.angle(np.exp(1j * (course - _bow_angle(MotiveAxes(up, axis))))))
        for axis in list_bow_axes(up)
    }
    return MotiveAxes(up, min(differences, key=lambda axis: differences[axis]))
