"""Judging courses of the ferry study, and the exported feed-forwards that are simulated on them.

The residual force on a record does not determine how well a feed-forward tracks a course: on drawn
ferries, the model with the smallest position error had the larger residual. Models are therefore
compared by simulations on courses that were not used for identification.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, final

import torch
from torch import Tensor, nn

from residnet.autopilot.motion_config import ReferenceFilterConfig
from residnet.export.feed_forward import GuardedForce, RequiredForce
from residnet.physics.force_model import ForceModel

_N_WAYPOINTS: Final = 6
"""Number of waypoints of a judging course."""
_MIN_LENGTH_SHARE: Final = 0.5
"""Minimum length of a segment, relative to the longest segment of the identification course."""
_MAX_DRAWS: Final = 1000
"""Maximum number of draws of one waypoint."""


@final
class ExportedFeedForward(nn.Module):
    """A feed-forward in its exported form: mirrored, and limited to its training range.

    Args:
        model: the believed force and its correction.
        ranges: training ranges of nu_dot and nu (six rows).
    """

    def __init__(self, model: ForceModel, ranges: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        required_force = RequiredForce(*model.split_corrections(), is_mirrored=True)
        self.guarded_force = GuardedForce(required_force, ranges).eval()

    def thruster_force(self, nu_dot: Tensor, nu: Tensor, psi: Tensor) -> Tensor:
        """Return the force tau [..., 3] at nu_dot and nu [..., 3], at any heading."""
        force: Tensor = self.guarded_force(nu_dot.reshape(-1, 3), nu.reshape(-1, 3))[0]
        return force.reshape(nu.shape)


def draw_judging_courses(
    course: ReferenceFilterConfig, seed: int
) -> dict[str, ReferenceFilterConfig]:
    """Draw courses that resemble the identification course but consist of other manoeuvres.

    Positions lie in the area of the course, and segments are at most as long as its longest one, so
    that speeds are in the training range.

    Args:
        course: the identification course.
        seed: seed of the draw.

    Returns:
        A course with headings `ahead` (along the segment), `astern`, and `mixed` (with the drift
        angles of the identification course).
    """
    points = [(0.0, 0.0), *((north, east) for north, east, _ in course.waypoints)]
    headings = [heading for _, _, heading in course.waypoints]
    steps = [(end[0] - start[0], end[1] - start[1]) for start, end in pairwise(points)]
    lengths = [math.hypot(*step) for step in steps]
    max_length = max(lengths)
    drift_angles = [
        heading - math.atan2(step[1], step[0])
        for heading, step, length in zip(headings, steps, lengths, strict=True)
        if length > 0
    ] or [0.0]
    drift_choices = {"ahead": [0.0], "astern": [math.pi], "mixed": drift_angles}
    generator = torch.Generator().manual_seed(seed)
    return {
        name: course.model_copy(
            update={
                "waypoints": _draw_waypoints(
                    points, (_MIN_LENGTH_SHARE * max_length, max_length), choices, generator
                )
            }
        )
        for name, choices in drift_choices.items()
    }


def _draw_waypoints(
    points: Sequence[tuple[float, float]],
    length_limits: tuple[float, float],
    drift_choices: Sequence[float],
    generator: torch.Generator,
) -> tuple[tuple[float, float, float], ...]:
    """Draw waypoints (north, east, heading) in the bounding box of points, from the origin."""
    lower = [min(values) for values in zip(*points, strict=True)]
    upper = [max(values) for values in zip(*points, strict=True)]
    waypoints: list[tuple[float, float, float]] = []
    position = (0.0, 0.0)
    heading = 0.0
    while len(waypoints) < _N_WAYPOINTS:
        target = position
        for _ in range(_MAX_DRAWS):
            shares = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
            target = (
                lower[0] + shares[0] * (upper[0] - lower[0]),
                lower[1] + shares[1] * (upper[1] - lower[1]),
            )
            length = math.dist(target, position)
            if length_limits[0] <= length <= length_limits[1]:
                break
        choice = int(torch.randint(len(drift_choices), (1,), generator=generator))
        direction = math.atan2(target[1] - position[1], target[0] - position[0])
        # the shorter turn to the new heading
        heading += math.remainder(direction + drift_choices[choice] - heading, 2.0 * math.pi)
        waypoints.append((*target, heading))
        position = target
    return tuple(waypoints)
