"""Check that a sampled track passes buoys in order, on the correct side and with clearance.

The check uses the sampled track only and shares no code with the planner of courses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from residnet.core.config import Config, Metres

Array = NDArray[np.float64]
PassingRule = Literal["enter", "sides"]
"""Rule for passing buoys: `enter` the circle of acceptance of each buoy, or pass each buoy on its
prescribed side outside its circle (`sides`).
"""


class BuoyConfig(Config):
    """A buoy, its circle and the side of the vessel on which it is left.

    Attributes:
        north: north coordinate in m.
        east: east coordinate in m.
        leave_to: side of the vessel on which the buoy is left; a turn to starboard round the buoy
            leaves it to starboard. Gouletas 2020 plots x to the right and y upwards, so that
            "counter-clockwise" there is a turn from x towards y. With x north and y east this is a
            turn to starboard.
        radius: radius in m of the circle around the buoy, which the vessel must enter by the rule
            `enter` and must not enter by the rule `sides`, see `PassingRule`.
    """

    north: Metres
    east: Metres
    leave_to: Literal["starboard", "port"]
    radius: Metres


class Passage(NamedTuple):
    """How a track passes a buoy.

    Attributes:
        sample: index of the sample at which the track passes the buoy. The passing samples of all
            buoys are in order, and the sum of their distances is minimal.
        buoy_side: side of the vessel on which the buoy lies at this sample.
        distance: distance of the buoy at this sample in m.
        min_distance: smallest distance in m on the track from `first_checked_sample` on, which may
            be smaller than `distance` where the track returns to the buoy.
        buoy_side_at_min_distance: side of the vessel on which the buoy lies at `min_distance`.
    """

    sample: int
    buoy_side: str
    distance: float
    min_distance: float
    buoy_side_at_min_distance: str


def first_checked_sample(distance: Array, radius: float) -> int:
    """Return the first sample at which the circle of a buoy is checked.

    It is 0, unless the track starts inside the circle. Then it is the first sample outside the
    circle at which the distance decreases again. If the distance never decreases again, it is the
    last sample, N - 1; if the track never leaves the circle, it is N.

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

    The passing samples are in the order of the buoys and minimise the sum of the distances. A track
    that never leaves the circle of a buoy is checked from its first sample on.
    """
    distance_table = np.stack([np.hypot(*(track - (b.north, b.east)).T) for b in buoys])
    for buoy_distances, buoy in zip(distance_table, buoys, strict=True):
        first_sample = first_checked_sample(buoy_distances, buoy.radius)
        buoy_distances[: first_sample if first_sample < len(buoy_distances) else 0] = np.inf
    # dynamic programming over buoys: for every sample at which the current buoy may be passed, the
    # smallest sum of distances and the passing sample of the previous buoy
    cumulative_distance = distance_table[0]
    predecessor_tables = []
    sample_index = np.arange(len(track))
    for buoy_distances in distance_table[1:]:
        running_minimum = np.minimum.accumulate(cumulative_distance)
        predecessor_tables.append(
            np.maximum.accumulate(np.where(cumulative_distance <= running_minimum, sample_index, 0))
        )
        cumulative_distance = buoy_distances + running_minimum
    samples = [int(cumulative_distance.argmin())]
    for predecessors in reversed(predecessor_tables):
        samples.append(int(predecessors[samples[-1]]))
    passages = []
    for buoy_distances, buoy, sample in zip(distance_table, buoys, reversed(samples), strict=True):
        nearest_sample = int(buoy_distances.argmin())
        passages.append(
            Passage(
                sample,
                _vessel_side_of_buoy(track, sample, buoy),
                float(buoy_distances[sample]),
                float(buoy_distances[nearest_sample]),
                _vessel_side_of_buoy(track, nearest_sample, buoy),
            )
        )
    return passages


def _vessel_side_of_buoy(track: Array, sample: int, buoy: BuoyConfig) -> str:
    """Return the side of the vessel, `starboard` or `port`, on which it has a buoy at a sample."""
    step = track[min(sample + 1, len(track) - 1)] - track[max(sample - 1, 0)]
    north = buoy.north - track[sample, 0]
    east = buoy.east - track[sample, 1]
    # cross product of the track's direction and the vector to the buoy: positive to starboard
    return "starboard" if step[0] * east - step[1] * north > 0 else "port"


def find_first_violation(
    track: Array,
    buoys: Sequence[BuoyConfig],
    passing_rule: PassingRule,
    min_turn_radius: float,
    tolerance: float = 0.0,
) -> tuple[int, str] | None:
    """Find the first buoy at which a track violates the passing rule.

    Between samples the distance may be smaller than at the samples, see `_sampling_error`.

    Args:
        track: north and east [N, 2] in m.
        buoys: buoys in order.
        passing_rule: rule for passing buoys.
        min_turn_radius: smallest radius of the track in m.
        tolerance: accepted violation of a circle in m.

    Returns:
        The index of the buoy and a description of the violation; None if the track is valid.
    """
    step = float(np.hypot(*np.diff(track, axis=0).T).max())
    for number, (passage, buoy) in enumerate(
        zip(find_passages(track, buoys), buoys, strict=True), 1
    ):
        if passing_rule == "enter":
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
        elif {passage.buoy_side, passage.buoy_side_at_min_distance} != {buoy.leave_to}:
            return (
                number - 1,
                f"buoy {number}: it is not left to {buoy.leave_to} where it is nearest",
            )
    return None


def _sampling_error(radius: float, step: float, min_turn_radius: float) -> float:
    """Bound by how much the closest sample is farther from a buoy than the closest approach, in m.

    The closest sample lies at most step / 2 along the track from the closest approach, so that the
    distance differs by at most step / 2. To second order it grows by s^2 / 2 (1 / radius + 1 / R)
    at an arc length s from the closest approach, for a track that turns away from the buoy with the
    turning radius R; s = step / 2 gives the other bound.

    Args:
        radius: radius in m of the circle that the closest approach touches.
        step: largest distance in m between consecutive samples.
        min_turn_radius: smallest turning radius R of the track in m.
    """
    return min(0.5 * step, step**2 / 8 * (1 / min_turn_radius + 1 / radius)) if radius else 0.0
