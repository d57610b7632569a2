"""Frames: latitude and longitude on a plane, quaternions to headings, levers, body axes."""

from __future__ import annotations

import numpy as np

from residnet.data.readers.base import missing_package


def tangent_plane(
    latitude: np.ndarray, longitude: np.ndarray, latitude_0: float, longitude_0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return north and east [T] in m of points of the WGS 84 ellipsoid.

    They lie on the plane that touches the ellipsoid at the origin.

    Topocentric coordinates (EPSG method 9837); heights are taken as zero, which shifts a point at
    100 m height and 1 km distance by 16 mm.

    Args:
        latitude: [T] rad.
        longitude: [T] rad.
        latitude_0: of the origin, rad.
        longitude_0: of the origin, rad.

    Raises:
        UsageError: where pyproj is not installed.
    """
    try:
        from pyproj import Transformer
    except ImportError as error:
        raise missing_package("geo", "pyproj", "a position in latitude and longitude") from error
    origin = (
        f"+lat_0={float(np.degrees(latitude_0))!r} +lon_0={float(np.degrees(longitude_0))!r} +h_0=0"
    )
    plane = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
        f" {origin}"
    )
    known = np.isfinite(latitude) & np.isfinite(longitude)
    north, east = np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    east[known], north[known], _ = plane.transform(
        longitude[known], latitude[known], np.zeros(int(known.sum())), radians=True
    )
    return north, east


def fixes_on_plane(
    latitude: np.ndarray, longitude: np.ndarray, origin: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[float, float] | None, int]:
    """Return north and east [T] in m, the origin, and how many fixes were none.

    Receivers without a fix report latitude 0, longitude 0. There is no origin where there is no
    fix, or one beyond a pole.

    Args:
        latitude: [T] rad.
        longitude: [T] rad.
        origin: of the plane, rad; None takes the first fix.
    """
    none = (latitude == 0.0) & (longitude == 0.0)
    known = np.isfinite(latitude) & np.isfinite(longitude) & ~none
    if not known.any() or float(np.abs(latitude[known]).max()) > np.pi / 2:
        return latitude, longitude, None, int(none.sum())
    first = int(np.argmax(known))
    at = origin or (float(latitude[first]), float(longitude[first]))
    phi, lam = (np.where(known, angle, np.nan) for angle in (latitude, longitude))
    north, east = tangent_plane(phi, lam, *at)
    return north, east, at, int(none.sum())


def unit_quaternion(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return quaternions [T] of length one, x, y, z, w; NaN where they are empty."""
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    known = np.isfinite(norm) & (norm > 0.5)
    length = np.where(known, norm, 1.0)
    return tuple(np.where(known, part / length, np.nan) for part in (x, y, z, w))


def yaw_of(x: np.ndarray, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the rotation [T] about the vertical axis in rad of quaternions of length one."""
    yaw: np.ndarray = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def at_centre(
    north: np.ndarray, east: np.ndarray, psi: np.ndarray, x: float, y: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position [T] of the vessel's centre from that of an antenna at (x, y) in the body.

    m and rad.
    """
    c, s = np.cos(psi), np.sin(psi)
    return north - c * x + s * y, east - s * x - c * y


def body_velocity(
    north: np.ndarray, east: np.ndarray, psi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the components along body x and y of an earth-fixed velocity, all [T].

    Source: document 003 eq. (4), transposed.
    """
    c, s = np.cos(psi), np.sin(psi)
    return c * north + s * east, c * east - s * north
