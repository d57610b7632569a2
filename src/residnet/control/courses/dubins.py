"""Shortest paths of bounded curvature between poses."""

from __future__ import annotations

import math

import numpy as np

_TURN = 2.0 * math.pi


def _arc(side: float, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the angle turned from one heading to another, side +1 to starboard and -1 to port."""
    # a full turn that is none but for rounding
    turned = (side * (end - begin)) % _TURN
    return np.where(turned > _TURN - 1e-9, 0.0, turned)


def _centre(pose: np.ndarray, side: float, radius: float) -> np.ndarray:
    return pose[..., :2] + side * radius * np.stack(
        (-np.sin(pose[..., 2]), np.cos(pose[..., 2])), axis=-1
    )


def dubins_length(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Return the length [...] in m of the shortest path between poses of bounded curvature.

    The path is two arcs and their common tangent, or three arcs (L. E. Dubins 1957). Poses [..., 3]
    = (north, east, heading) broadcast; turns have a radius of at least `radius`.
    """
    start, end = np.broadcast_arrays(np.asarray(start, dtype=float), np.asarray(end, dtype=float))
    h0, h1 = start[..., 2], end[..., 2]
    best = np.full(h0.shape, np.inf)
    for side in (1.0, -1.0):
        centre = _centre(start, side, radius)
        line = _centre(end, side, radius) - centre
        distance, bearing = (
            np.hypot(line[..., 0], line[..., 1]),
            np.arctan2(line[..., 1], line[..., 0]),
        )
        best = np.minimum(
            best, radius * (_arc(side, h0, bearing) + _arc(side, bearing, h1)) + distance
        )
        # three arcs, the middle one about either point that is two radii from both centres
        lean = np.arccos(np.clip(distance / (4.0 * radius), 0.0, 1.0))
        for hand in (1.0, -1.0):
            out = bearing + hand * lean
            back = bearing + math.pi - hand * lean
            first, second = out + side * 0.5 * math.pi, back + side * 0.5 * math.pi
            turned = _arc(side, h0, first) + _arc(-side, first, second) + _arc(side, second, h1)
            best = np.where(distance <= 4.0 * radius, np.minimum(best, radius * turned), best)
        line = _centre(end, -side, radius) - centre
        distance, bearing = (
            np.hypot(line[..., 0], line[..., 1]),
            np.arctan2(line[..., 1], line[..., 0]),
        )
        straight = np.sqrt(np.maximum(distance**2 - 4.0 * radius**2, 0.0))
        heading = bearing + side * np.arctan2(2.0 * radius, straight)
        total = radius * (_arc(side, h0, heading) + _arc(-side, heading, h1)) + straight
        best = np.where(distance >= 2.0 * radius, np.minimum(best, total), best)
    return best
