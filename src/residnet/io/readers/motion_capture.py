"""Exports of motion-capture systems: OptiTrack Motive (csv), Qualisys (6D tsv), Vicon (csv).

The names of the columns stand in several rows, for example the name of a rigid body, the quantity
and the axis. Axes and units depend on settings of the export. The table that is read has one row
of names, positions in m and quaternions in north-east-down.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import suggest_name

if TYPE_CHECKING:
    import pandas as pd
    from scipy.spatial.transform import Rotation

VerticalAxis = Literal["y", "z"]
BowAxis = Literal["x", "-x", "y", "-y", "z", "-z"]
_MAX_HEADER_LINES = 20
"""Number of lines in which an export has the names of its columns."""
_RIGID_BODY_TYPES = ("Rigid Body", "RigidBody")
_METRES = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
"""Length unit of an export in lower case -> its length in m."""
_METRES_BY_SYMBOL = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_QUATERNION_AXES = ("X", "Y", "Z", "W")
_POSITION_AXES = ("X", "Y", "Z")
_MATRIX_AXES = tuple(f"[{i}]" for i in range(9))
"""Entries of a rotation matrix of Qualisys, column by column."""
_MATRIX = "Matrix"
_ROTATION_VECTOR = "Vector"
_MAX_DETERMINANT_ERROR = 0.05
"""Largest difference of the determinant of a rotation matrix from 1; a lost body has zeros."""
_MAX_FLAT_SHARE = 0.02
"""Largest ratio of the vertical and the horizontal standard deviation of a surface vessel."""
_MIN_MOVING_SPEED = 0.2
"""Smallest speed, relative to its 90 % quantile, at which the track has a direction."""


class MocapHeader(NamedTuple):
    """Header of an export of a motion-capture system.

    Attributes:
        system: name of the system, for messages.
        n_lines: number of lines above the values.
        metres: length of a unit of position in m.
        seconds: duration of a unit of time in s.
        radians: unit of Euler angles and rotation vectors in rad.
        rotation: `Quaternion`, the order of Euler angles such as `XYZ`, `Matrix` or `Vector`.
        columns: column of the time (key `t`), and of each quantity of a rigid body, with keys such
            as `hover Position X`.
        bodies: names of the rigid bodies.
        delimiter: separator of cells.
    """

    system: str
    n_lines: int
    metres: float
    seconds: float
    radians: float
    rotation: str
    columns: dict[str, int]
    bodies: tuple[str, ...]
    delimiter: str


class MocapAxes(NamedTuple):
    """Axes of an export of a motion-capture system.

    Attributes:
        up: axis that points up.
        bow: axis of the rigid body that points forward.
    """

    up: VerticalAxis
    bow: BowAxis


def parse_mocap_header(path: Path, lines: Sequence[str]) -> MocapHeader | None:
    """Parse the header of an export of a motion-capture system; None for other files.

    Args:
        path: file, for messages.
        lines: first lines of the file.

    Raises:
        DataError: if the export has no rigid body, or an unknown unit.
    """
    if not lines:
        return None
    if lines[0].startswith("Format Version,"):
        return _parse_motive_header(path, lines)
    if lines[0].startswith("NO_OF_FRAMES"):
        return _parse_qualisys_header(path, lines)
    return _parse_vicon_header(path, lines)


def _parse_motive_header(path: Path, lines: Sequence[str]) -> MocapHeader | None:
    """Parse the header of OptiTrack Motive, a table of rigid bodies; None without its axis row."""
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
    metres = _METRES[unit.lower()]
    rotation = settings.get("Rotation Type", "Quaternion")
    header = MocapHeader(
        "OptiTrack Motive",
        axis_row + 1,
        metres,
        1.0,
        float(np.radians(1.0)),
        rotation,
        columns,
        bodies,
        ",",
    )
    for body in bodies:
        missing = [key for key in _required_keys(header, body) if key not in columns]
        if missing:
            raise DataError(
                f"{path}: rigid body '{body}' has no column '{missing[0].removeprefix(body)[1:]}';"
                " export position and rotation of rigid bodies"
            )
    return header


def _parse_qualisys_header(path: Path, lines: Sequence[str]) -> MocapHeader:
    """Parse the header of an export of Qualisys Track Manager.

    Below lines of settings is a line of names: frame and time, then for each body X, Y, Z, roll,
    pitch, yaw, residual, and the rotation matrix column by column. Lengths are in mm.
    """
    rows = [line.rstrip("\r\n").split("\t") for line in lines[:_MAX_HEADER_LINES]]
    settings = {row[0]: row[1:] for row in rows if row[0].isupper() and len(row) > 1}
    names_row = next((i for i, row in enumerate(rows) if any("Rot[0]" in c for c in row)), None)
    if names_row is None:
        contents = " ".join(settings.get("DATA_INCLUDED", ["unknown data"]))
        raise DataError(
            f"{path}: the export of Qualisys has {contents} and no rotation of a rigid body"
            " (columns X, Y, Z, ..., Rot[0] to Rot[8]); export '6D' data as tsv"
        )
    names = [cell.strip() for cell in rows[names_row]]
    columns: dict[str, int] = {}
    starts = [k for k, name in enumerate(names) if name == "X" or name.endswith(" X")]
    listed = [name for name in settings.get("BODY_NAMES", []) if name.strip()]
    bodies = [
        names[k].removesuffix("X").strip() or listed[i] if i < len(listed) else f"body {i + 1}"
        for i, k in enumerate(starts)
    ]
    for body, start in zip(bodies, starts, strict=True):
        columns |= {f"{body} Position {axis}": start + i for i, axis in enumerate(_POSITION_AXES)}
        # X, Y, Z, roll, pitch, yaw and the residual are before the matrix
        columns |= {f"{body} Rotation {axis}": start + 7 + i for i, axis in enumerate(_MATRIX_AXES)}
    rate = " ".join(settings.get("FREQUENCY", []))
    seconds = 1.0
    if "Time" in names:
        columns["t"] = names.index("Time")
    elif "Frame" in names and rate.replace(".", "", 1).isdigit() and float(rate) > 0.0:
        columns["t"] = names.index("Frame")
        seconds = 1.0 / float(rate)
    else:
        raise DataError(
            f"{path}: the export of Qualisys has no column Time or Frame; export with 'Include"
            " frame numbers and time'"
        )
    return MocapHeader(
        "Qualisys", names_row + 1, 1e-3, seconds, 1.0, _MATRIX, columns, tuple(bodies), "\t"
    )


def _parse_vicon_header(path: Path, lines: Sequence[str]) -> MocapHeader | None:
    """Parse the header of an export of Vicon Nexus or Tracker; None for other files.

    Its rows are the kind of the objects, the rate in Hz, the objects, `Frame, Sub Frame, RX, RY,
    RZ, TX, TY, TZ` and the units.
    """
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines[:_MAX_HEADER_LINES])]
    names_row = next((i for i, row in enumerate(rows) if row[:2] == ["Frame", "Sub Frame"]), 0)
    if names_row < 2 or "RX" not in rows[names_row] or names_row + 1 >= len(rows):
        return None
    names = rows[names_row]
    objects = rows[names_row - 1]
    units = rows[names_row + 1]
    rates = [cell for row in rows[:names_row] for cell in row if _is_positive_number(cell)]
    if not rates:
        raise DataError(
            f"{path}: the export of Vicon has no line with its rate in Hz above 'Frame,Sub Frame';"
            " export again"
        )
    columns = {"t": 0}
    bodies: list[str] = []
    for start, name in enumerate(names):
        if name == "RX" and names[start : start + 6] == ["RX", "RY", "RZ", "TX", "TY", "TZ"]:
            label = objects[start] if start < len(objects) else ""
            body = label.removeprefix("Global Angle").strip() or f"body {len(bodies) + 1}"
            bodies.append(body)
            columns |= {f"{body} Rotation {a}": start + i for i, a in enumerate(_POSITION_AXES)}
            columns |= {f"{body} Position {a}": start + 3 + i for i, a in enumerate(_POSITION_AXES)}
    first = columns.get(f"{bodies[0]} Rotation X", 0) if bodies else 0
    angle_unit, length_unit = (units[k] if k < len(units) else "" for k in (first, first + 3))
    if angle_unit not in ("deg", "rad") or length_unit not in _METRES_BY_SYMBOL:
        raise DataError(
            f"{path}: line {names_row + 2} has the units '{angle_unit}' and '{length_unit}',"
            " expected deg or rad, and mm, cm or m; export again with units"
        )
    return MocapHeader(
        "Vicon",
        names_row + 2,
        _METRES_BY_SYMBOL[length_unit],
        1.0 / float(rates[-1]),
        float(np.radians(1.0)) if angle_unit == "deg" else 1.0,
        _ROTATION_VECTOR,
        columns,
        tuple(bodies),
        ",",
    )


def _is_positive_number(cell: str) -> bool:
    return cell.replace(".", "", 1).isdigit() and float(cell) > 0.0


def _required_keys(header: MocapHeader, body: str) -> list[str]:
    axes = {"Quaternion": _QUATERNION_AXES, _MATRIX: _MATRIX_AXES}.get(
        header.rotation, _POSITION_AXES
    )
    rotations = [f"{body} Rotation {axis}" for axis in axes]
    return [*rotations, *(f"{body} Position {axis}" for axis in _POSITION_AXES)]


class _Pose(NamedTuple):
    """Position [T, 3] in m and quaternion [T, 4] (x, y, z, w) of a rigid body."""

    position: np.ndarray
    quaternion: np.ndarray


def _load_poses(
    path: Path, header: MocapHeader, rows: int | None
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
            sep=header.delimiter,
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
        is_tracked = np.isfinite(angles).all(axis=1) & np.isfinite(position).all(axis=1)
        quaternion = np.full((len(table), 4), np.nan)
        if header.rotation == "Quaternion":
            quaternion = angles
        elif header.rotation == _MATRIX:
            matrices = np.nan_to_num(angles).reshape(-1, 3, 3).transpose(0, 2, 1)
            is_tracked &= np.abs(np.linalg.det(matrices) - 1.0) < _MAX_DETERMINANT_ERROR
            if is_tracked.any():
                quaternion[is_tracked] = Rotation.from_matrix(matrices[is_tracked]).as_quat()
        else:
            is_tracked &= (angles != 0.0).any(axis=1) | (position != 0.0).any(axis=1)
            tracked_angles = header.radians * angles[is_tracked]
            quaternion[is_tracked] = _convert_angles(tracked_angles, header.rotation).as_quat()
        if header.rotation != "Quaternion":
            # lost bodies have zeros or empty cells
            position = np.where(is_tracked[:, None], position, np.nan)
        poses[body] = _Pose(position, quaternion)
    return header.seconds * columns_of(["t"])[:, 0], poses


def _convert_angles(angles: np.ndarray, notation: str) -> Rotation:
    """Return the rotations of Euler angles or rotation vectors [T, 3] in rad.

    Vicon exports rotation vectors or Euler angles with the same names. A vessel turns about one
    axis, so that the notation with the smaller rotations about the other axes is right.
    """
    from scipy.spatial.transform import Rotation

    if notation != _ROTATION_VECTOR:
        # Motive rotates about the axes of the body, in this order
        order = notation.upper()
        return Rotation.from_euler(order, angles[:, ["XYZ".index(axis) for axis in order]])
    candidates = [Rotation.from_rotvec(angles), Rotation.from_euler("XYZ", angles)]
    tilts = [
        np.sort(np.mean(np.square(candidate.as_quat()[:, :3]), axis=0))[:2].sum()
        for candidate in candidates
    ]
    return candidates[int(tilts[1] < tilts[0])]


def _to_north_east_down(vectors: np.ndarray, up: VerticalAxis) -> np.ndarray:
    """Rotate vectors [T, 3] of the file: x to north, the axis up to the opposite of down."""
    x, y, z = vectors.T
    return np.stack((x, z, -y) if up == "y" else (x, -y, -z), axis=1)


def _bow_angle(axes: MocapAxes) -> float:
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


def read_mocap(
    path: Path, axes: MocapAxes, body: str | None = None, rows: int | None = None
) -> pd.DataFrame:
    """Read an export of a motion-capture system as a table with one row of names.

    Args:
        path: file of a take.
        axes: axes of the export.
        body: name of the rigid body to read; None for all.
        rows: largest number of rows to read; None for all.

    Returns:
        Columns `t [s]`, and for each rigid body `north [m]`, `east [m]`, `height [m]` (`depth [m]`
        for a vessel that dives), `q_x`, `q_y`, `q_z`, `q_w` in north-east-down with x forward. With
        several bodies each column begins with the body's name.

    Raises:
        UsageError: if the export has no such rigid body.
        DataError: if the file is no export of a motion-capture system, or cannot be read.
    """
    import pandas as pd

    header = _read_header(path)
    if body is not None:
        if body not in header.bodies:
            raise UsageError(f"{path}: no rigid body '{body}'{suggest_name(body, header.bodies)}")
        header = header._replace(bodies=(body,))
    t, poses = _load_poses(path, header, rows)
    # half the angle of the rotation from the body's x axis to its bow
    half_angle = 0.5 * _bow_angle(axes)
    columns = {"t [s]": t}
    for name, pose in poses.items():
        prefix = f"{name} " if len(poses) > 1 else ""
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
        columns |= {f"{prefix}{key}": column for key, column in values.items()}
    table = pd.DataFrame(columns)
    # lines above the values minus one header, to number rows in messages
    table.attrs["n_lines_above"] = header.n_lines - 1
    return table


def _read_header(path: Path) -> MocapHeader:
    """Return the header of an export.

    Raises:
        DataError: if the file is no export of a motion-capture system.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        header = parse_mocap_header(path, list(islice(stream, _MAX_HEADER_LINES)))
    if header is None:
        raise DataError(
            f"{path}: is no export of OptiTrack Motive, Qualisys (6D) or Vicon ('Format"
            " Version,...', 'NO_OF_FRAMES' in line 1, or 'Frame,Sub Frame' above the numbers);"
            " remove `mocap_up` from the reader"
        )
    return header


def detect_mocap_axes(path: Path, rows: int, body: str | None = None) -> MocapAxes:
    """Choose the axes of an export by the motion.

    A vessel turns about its vertical axis, and moves in the direction of its bow.

    Args:
        path: file of a take.
        rows: largest number of rows to read.
        body: name of the rigid body; None takes the one that moves most.
    """
    _, poses = _load_poses(path, _read_header(path), rows)
    pose = poses[body or _find_moving_body(poses)]
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
        return MocapAxes(up, "x")
    moving = steps[size > _MIN_MOVING_SPEED * np.quantile(size, 0.9)]
    course = float(np.angle((moving / np.abs(moving)).mean()))
    differences = {
        axis: abs(np.angle(np.exp(1j * (course - _bow_angle(MocapAxes(up, axis))))))
        for axis in list_bow_axes(up)
    }
    return MocapAxes(up, min(differences, key=lambda axis: differences[axis]))


def _find_moving_body(poses: Mapping[str, _Pose]) -> str:
    """Return the name of the rigid body that moves most."""
    return max(poses, key=lambda name: float(np.nanstd(poses[name].position, axis=0).sum()))


def list_mocap_bodies(path: Path) -> list[str]:
    """Return the rigid bodies of an export, the one that moves most first.

    The list is empty for other files.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        header = parse_mocap_header(path, list(islice(stream, _MAX_HEADER_LINES)))
    if header is None:
        return []
    if len(header.bodies) < 2:
        return list(header.bodies)
    moving = _find_moving_body(_load_poses(path, header, None)[1])
    return [moving, *(name for name in header.bodies if name != moving)]
