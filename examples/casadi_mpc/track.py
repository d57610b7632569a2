"""A course of straight legs with rounded corners: its places, its bends, errors from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SPACING = 0.1
"""Distance in m between the points that a course is kept as."""


class Track:
    """Straight legs between way-points, with arcs in the corners, drawn point by point.

    The curvature is smoothed over some metres, since no vessel begins to turn at once.

    Args:
        waypoints: north and east in m, at least two; the course begins at the first.
        radius: of the arcs in m.
        easing: length in m over which the curvature changes.
    """

    def __init__(
        self, waypoints: Sequence[Sequence[float]], radius: float, easing: float = 0.0
    ) -> None:
        points = np.asarray(waypoints, dtype=float)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 2:
            raise ValueError(
                f"waypoints: expected at least two of [north, east], given {waypoints}"
            )
        legs = np.diff(points, axis=0)
        lengths = np.hypot(*legs.T)
        if not (lengths > 0).all():
            raise ValueError("waypoints: two that follow each other are the same")
        directions = np.arctan2(legs[:, 1], legs[:, 0])
        turns = np.remainder(np.diff(directions) + np.pi, 2 * np.pi) - np.pi
        cut = radius * np.tan(np.abs(turns) / 2)
        room = lengths - np.r_[0.0, cut] - np.r_[cut, 0.0]
        if (room < 0).any():
            leg = int(np.argmin(room))
            raise ValueError(
                f"waypoints: leg {leg + 1} of {lengths[leg]:.1f} m is {-room[leg]:.1f} m too short"
                f" for arcs of {radius:g} m; take a smaller radius"
            )
        bends = [np.zeros(0)]
        for number, straight in enumerate(room):
            bends.append(np.zeros(max(1, round(straight / SPACING))))
            if number < len(turns):
                count = max(1, round(radius * abs(turns[number]) / SPACING))
                bends.append(np.full(count, turns[number] / (count * SPACING)))
        curvature = np.concatenate(bends)
        width = 2 * int(0.5 * easing / SPACING) + 1
        self.curvature = np.convolve(curvature, np.full(width, 1.0 / width), mode="same")
        self.direction = directions[0] + np.r_[0.0, np.cumsum(SPACING * self.curvature)[:-1]]
        middle = self.direction + 0.5 * SPACING * self.curvature
        north = points[0, 0] + SPACING * np.r_[0.0, np.cumsum(np.cos(middle))[:-1]]
        east = points[0, 1] + SPACING * np.r_[0.0, np.cumsum(np.sin(middle))[:-1]]
        self.points = np.stack((north, east), axis=1)
        self.length = SPACING * (len(north) - 1)

    def place(self, x: float, y: float, near: float, reach: float = 10.0) -> float:
        """Return the place in m along the course nearest to a point, not far from another place."""
        first = int(np.clip((near - reach) / SPACING, 0, len(self.points) - 2))
        last = int(np.clip((near + reach) / SPACING, first + 2, len(self.points)))
        ahead = self.points[first:last] - (x, y)
        number = first + int(np.argmin((ahead**2).sum(axis=1)))
        way = self.direction[number]
        rest = np.cos(way) * (x - self.points[number, 0]) + np.sin(way) * (
            y - self.points[number, 1]
        )
        return float(np.clip(number * SPACING + rest, 0.0, self.length))

    def at(self, place: np.ndarray | float) -> np.ndarray:
        """Return north, east, direction and curvature [..., 4] at places along the course.

        Behind its end the course goes on straight.
        """
        along = np.asarray(place, dtype=float)
        grid = SPACING * np.arange(len(self.points))
        columns = (*self.points.T, self.direction, self.curvature)
        out = np.stack([np.interp(along, grid, column) for column in columns], axis=-1)
        beyond = np.maximum(along - self.length, 0.0)
        out[..., 0] += beyond * np.cos(self.direction[-1])
        out[..., 1] += beyond * np.sin(self.direction[-1])
        out[..., 3] *= beyond == 0.0
        return out

    def aside(self, x: float, y: float, place: float) -> float:
        """Return the cross-track error in m at a place, positive to starboard."""
        north, east, way, _ = self.at(place)
        return float(np.cos(way) * (y - east) - np.sin(way) * (x - north))
