"""Latitude and longitude on a local tangent plane, by PROJ."""

from __future__ import annotations

import numpy as np

from residnet.data.readers.files import missing_package


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
