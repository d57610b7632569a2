"""A check of courses by their points alone: order, side of the closest approach, clearance.

It uses nothing of what plans them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.core.config import Config, Metres

Array = NDArray[np.float64]
Protocol = Literal["enter", "sides"]
"""Buoys are entered: a circle of acceptance about each; or each is passed on its side, outside its
own circle.
"""


class BuoyConfig(Config):
    """A buoy with the side to pass it on and the circle to keep out of.

    Attributes:
        north: place in m.
        east: place in m.
        leave_to: the side of the vessel that it passes on; rounded to starboard, it is left to
            starboard. Document 004 plots x to the right and y upwards: its "counter-clockwise" is a
            turn from x towards y, to starboard with x north and y east.
        radius: of the circle that the vessel must stay outside of.
    """

    north: Metres
    east: Metres
    leave_to: Literal["starboard", "port"]
    radius: Metres


class Passage(NamedTuple):
    """How a track passes a buoy.

    Attributes:
        sample: sample of the closest approach in the buoy's turn.
        passing_side: that the buoy lies on there.
        distance: there, in m.
        min_distance: smallest distance on the whole track, from `first_counted_sample` on.
        side_at_min_distance: that the buoy lies on at that distance.
    """

    sample: int
    passing_side: str
    distance: float
    min_distance: float
    side_at_min_distance: str


def first_counted_sample(distance: Array, radius: float) -> int:
    """Return the sample from which a buoy counts: 0, or where the circle is left that it begins in.

    It is left once the track is outside and comes nearer again: going away is no approach. It is
    the number of samples where the track never is.

    Args:
        distance: of the samples from the buoy [N] in m.
        radius: of its circle in m.
    """
    if distance[0] >= radius:
        return 0
    is_outside = distance >= radius
    if not is_outside.any():
        return len(distance)
    first_outside = int(is_outside.argmax())
    approaching = np.flatnonzero(np.diff(distance[first_outside:]) < 0)
    return first_outside + int(approaching[0]) if len(approaching) else len(distance) - 1


def find_passages(track: Array, buoys: Sequence[BuoyConfig]) -> list[Passage]:
    """Return how a track [N, 2] passes buoys in their order.

    The moments are in the order of the buoys, and the sum of the distances then is least.
    """
    distance = np.stack([np.hypot(*(track - (b.north, b.east)).T) for b in buoys])
    for distances, buoy in zip(distance, buoys, strict=True):
        first_sample = first_counted_sample(distances, buoy.radius)
        distances[: first_sample if first_sample < len(distances) else 0] = np.inf
    cumulative_distance = distance[0]
    predecessor_tables = []
    sample_index = np.arange(len(track))
    for distances in distance[1:]:
        running_minimum = np.minimum.accumulate(cumulative_distance)
        predecessor_tables.append(
            np.maximum.accumulate(np.where(cumulative_distance <= running_minimum, sample_index, 0))
        )
        cumulative_distance = distances + running_minimum
    samples = [int(cumulative_distance.argmin())]
    for predecessors in reversed(predecessor_tables):
        samples.append(int(predecessors[samples[-1]]))
    passages_found = []
    for distances, buoy, sample in zip(distance, buoys, reversed(samples), strict=True):
        nearest_sample = int(distances.argmin())
        passages_found.append(
            Passage(
                sample,
                _side_of_buoy(track, sample, buoy),
                float(distances[sample]),
                float(distances[nearest_sample]),
                _side_of_buoy(track, nearest_sample, buoy),
            )
        )
    return passages_found


def _side_of_buoy(track: Array, sample: int, buoy: BuoyConfig) -> str:
    """Return the side that a buoy lies on at a sample."""
    step = track[min(sample + 1, len(track) - 1)] - track[max(sample - 1, 0)]
    north, east = buoy.north - track[sample, 0], buoy.east - track[sample, 1]
    return "starboard" if step[0] * east - step[1] * north > 0 else "port"


def find_first_violation(
    track: Array,
    buoys: Sequence[BuoyConfig],
    protocol: Protocol,
    min_turn_radius: float,
    tolerance: float = 0.0,
) -> tuple[int, str] | None:
    """Return the first buoy, from 0, where a track [N, 2] does wrong, and what; None where nowhere.

    A circle may be entered between the samples: nearer by what `_sampling_error` says.

    Args:
        track: north, east in m.
        buoys: in their order.
        min_turn_radius: least radius of its turns in m.
        tolerance: by which circles may be missed, in m.
    """
    step = float(np.hypot(*np.diff(track, axis=0).T).max())
    for number, (passage, buoy) in enumerate(
        zip(find_passages(track, buoys), buoys, strict=True), 1
    ):
        if protocol == "enter":
            if passage.distance > buoy.radius + tolerance + _sampling_error(
                buoy.radius, step, min_turn_radius
            ):
                return number - 1, (
                    f"buoy {number}: passed at {passage.distance:.4g} m, its circle of"
                    f" {buoy.radius:.4g} m is not entered in its turn"
                )
        elif passage.min_distance < buoy.radius - tolerance:
            return number - 1, (
                f"buoy {number}: its circle of {buoy.radius:.4g} m is cut, {passage.min_distance:.4g} m"
            )
        elif {passage.passing_side, passage.side_at_min_distance} != {buoy.leave_to}:
            return (
                number - 1,
                f"buoy {number}: it is not left to {buoy.leave_to} where it is nearest",
            )
    return None


def _sampling_error(distance: float, step: float, min_turn_radius: float) -> float:
    """Return how much nearer than its samples a track may come to a point that it passes.

    A sample lies at most half a step from the closest approach, along an arc that bends away.
    """
    return min(0.5 * step, step**2 / 8 * (1 / min_turn_radius + 1 / distance)) if distance else 0.0
