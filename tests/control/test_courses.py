"""Shortest paths and courses round buoys, against geometry and paths that are flown piece by piece."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from residnet.control.buoys import BuoyConfig, course_round, feasibility, widened
from residnet.control.dubins import dubins_length, shortest_course
from residnet.core.errors import ConfigError

TABLE_6_3 = [
    BuoyConfig(north=50, east=30, round="clockwise", radius=10),
    BuoyConfig(north=100, east=20, round="counter_clockwise", radius=10),
    BuoyConfig(north=50, east=80, round="clockwise", radius=10),
    BuoyConfig(north=80, east=120, round="counter_clockwise", radius=10),
    BuoyConfig(north=20, east=120, round="counter_clockwise", radius=10),
    BuoyConfig(north=0, east=0, round="counter_clockwise", radius=10),
]


def flown(pose: np.ndarray, side: float, length: float, radius: float) -> np.ndarray:
    """The pose after an arc (side +1 or -1) or a line (side 0)."""
    if side == 0:
        return pose + np.array([length * math.cos(pose[2]), length * math.sin(pose[2]), 0.0])
    heading = pose[2] + side * length / radius
    chord = side * radius * np.array([math.sin(heading) - math.sin(pose[2]), math.cos(pose[2]) - math.cos(heading), 0.0])
    return np.array([*(pose + chord)[:2], heading])


def test_no_flown_path_is_shorter_and_some_are_as_short() -> None:
    rng = np.random.default_rng(0)
    equal = set()
    for _ in range(4000):
        sides = [(1, 0, 1), (-1, 0, -1), (1, 0, -1), (-1, 0, 1), (1, -1, 1), (-1, 1, -1)][rng.integers(6)]
        start = rng.normal(0.0, 3.0, 3)
        pose, lengths = start, rng.uniform(0.0, [2.0 * math.pi, 5.0, 2.0 * math.pi]) * 2.0
        for side, length in zip(sides, lengths, strict=True):
            pose = flown(pose, side, length, 2.0)
        shortest = float(dubins_length(start, pose, 2.0))
        assert shortest <= lengths.sum() + 1e-6
        assert shortest >= math.hypot(*(pose - start)[:2]) - 1e-9
        if shortest > lengths.sum() - 1e-6:
            equal.add(sides)
    assert len(equal) >= 5


def test_simple_paths() -> None:
    assert dubins_length(np.zeros(3), np.array([7.0, 0.0, 0.0]), 2.0) == pytest.approx(7.0)
    assert dubins_length(np.zeros(3), np.array([0.0, 4.0, math.pi]), 2.0) == pytest.approx(2.0 * math.pi)
    # there and back are the same path reversed
    back = np.array([0.0, 0.0, math.pi])
    a, b = np.array([1.0, 2.0, 0.7]), np.array([3.0, -1.0, 2.1])
    assert dubins_length(a, b, 1.5) == pytest.approx(float(dubins_length(b + back, a + back, 1.5)))


def test_a_course_through_points_in_line_is_straight() -> None:
    assert shortest_course((0.0, 0.0, 0.0), [(30.0, 0.0), (60.0, 0.0)], 5.0, 2.0) == pytest.approx(55.0, rel=1e-3)


def test_the_pieces_of_a_course_join_and_touch_every_circle_on_its_side() -> None:
    pieces = course_round((0.0, 0.0), TABLE_6_3)
    for piece, after in itertools.pairwise(pieces):
        end = flown(np.array([piece.north, piece.east, piece.heading]), piece.turn, piece.length, piece.radius or 1.0)
        assert end[:2] == pytest.approx([after.north, after.east], abs=1e-9)
        assert math.cos(end[2] - after.heading) == pytest.approx(1.0)
    lines = [piece for piece in pieces if piece.turn == 0]
    assert len(lines) == len(TABLE_6_3)
    for line, buoy in zip(lines, TABLE_6_3, strict=True):
        end = flown(np.array([line.north, line.east, line.heading]), 0, line.length, 1.0)
        north, east = buoy.north - end[0], buoy.east - end[1]
        to_starboard = east * math.cos(line.heading) - north * math.sin(line.heading)
        assert to_starboard == pytest.approx(10.0 if buoy.round == "clockwise" else -10.0)
        assert math.hypot(north, east) == pytest.approx(10.0)


def test_printed_radii_are_too_tight_for_five_degrees_of_rudder() -> None:
    smallest = 3.2 / (3.47 * math.radians(5))
    found = feasibility(TABLE_6_3, smallest)
    assert smallest == pytest.approx(10.57, abs=0.005)
    assert not any(buoy.possible for buoy in found)
    assert all(buoy.possible for buoy in feasibility(widened(TABLE_6_3, smallest), smallest))


def test_circles_that_overlap_have_no_crossing_tangent() -> None:
    near = BuoyConfig(north=50, east=45, round="counter_clockwise", radius=10)
    with pytest.raises(ConfigError, match="buoy 2"):
        course_round((0.0, 0.0), [TABLE_6_3[0], near])
