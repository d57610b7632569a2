"""Check a course from its sampled track alone: order of buoys, passing side and clearance.

The check is independent of the planner.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.core.config import Config, Metres

Array = NDArray[np.float64]
Protocol = Literal["enter", "sides"]
"""Rule for passing buoys: `enter` the circle of acceptance of each buoy, or pass each buoy on its
prescribed side outside its circle (`sides`).
"""


class BuoyConfig(Config):
    """A buoy with the side to pass it on and the circle to keep out of.

    Attributes:
        north: north coordinate in m.
        east: east coordinate in m.
        leave_to: side of the vessel on which the buoy is left; a turn to starboard round the buoy
            leaves it to starboard. Document 004 plots x to the right and y upwards: its
            "counter-clockwise" is a turn from x towards y, to starboard with x north and y east.
        radius: radius in m of the circle that the vessel must not enter.
    """

    north: Metres
    east: Metres
    leave_to: Literal["starboard", "port"]
    radius: Metres


class Passage(NamedTuple):
    """How a track passes a buoy.

    Attributes:
        sample: index of the closest approach while the buoy is the next one.
        passing_side: side of the buoy at this sample.
        distance: distance at this sample in m.
        min_distance: smallest distance in m on the track from `first_counted_sample` on.
        side_at_min_distance: side of the buoy at the smallest distance.
    """

    sample: int
    passing_side: str
    distance: float
    min_distance: float
    side_at_min_distance: str


def first_counted_sample(distance: Array, radius: float) -> int:
    """Return the first sample at which the circle of a buoy is checked.

    It is 0, unless the track starts inside the circle. Then it is the first sample outside the
    circle at which the distance decreases again, or N if there is no such sample.

    Args:
        distance: distances of the samples from the buoy [N] in m.
        radius: radius of the circle in m.
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
    """Find how a track [N, 2] passes the buoys in order.

    The passing samples are in the order of the buoys and minimise the sum of the distances.
    """
    distance = np.stack([np.hypot(*(track - (b.north, b.east)).T) for b in buoys])
    for distances, buoy in zip(distance, buoys, strict=True):
        first_sample = first_counted_sample(distances, buoy.radius)
        distances[: first_sample if first_sample < len(distances) else 0] = np.inf
    # dynamic programming over buoys: the best passing sample so far, for each last sample
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
    """Return the side of the vessel on which a buoy lies at a sample."""
    step = track[min(sample + 1, len(track) - 1)] - track[max(sample - 1, 0)]
    north = buoy.north - track[sample, 0]
    east = buoy.east - track[sample, 1]
    # sign of the cross product of track direction and bearing
    return "starboard" if step[0] * east - step[1] * north > 0 else "port"


def find_first_violation(
    track: Array,
    buoys: Sequence[BuoyConfig],
    protocol: Protocol,
    min_turn_radius: float,
    tolerance: float = 0.0,
) -> tuple[int, str] | None:
    """Find the first buoy at which a track violates the protocol.

    Between samples the distance may be smaller than at the samples, see `_sampling_error`.

    Args:
        track: north and east [N, 2] in m.
        buoys: buoys in order.
        protocol: rule for passing buoys.
        min_turn_radius: smallest radius of the track in m.
        tolerance: accepted violation of a circle in m.

    Returns:
        The number of the buoy (from 0) and a description; None if the track is valid.
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
                    f" {buoy.radius:.4g} m is not entered"
                )
        elif passage.min_distance < buoy.radius - tolerance:
            return number - 1, (
                f"buoy {number}: its circle of {buoy.radius:.4g} m is cut,"
                f" {passage.min_distance:.4g} m"
            )
        elif {passage.passing_side, passage.side_at_min_distance} != {buoy.leave_to}:
            return (
                number - 1,
                f"buoy {number}: it is not left to {buoy.leave_to} where it is nearest",
            )
    return None


def _sampling_error(distance: float, step: float, min_turn_radius: float) -> float:
    """Return the largest difference in m between the closest sample and the closest approach.

    The closest sample lies at most half a step from the closest approach on a curved track.
    """
    return min(0.5 * step, step**2 / 8 * (1 / min_turn_radius + 1 / distance)) if distance else 0.0
