"""Shortest paths and courses round buoys, against geometry and paths flown piece by piece."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from residnet.control.courses.config import (
    BuoyConfig,
    dubins_length,
    feasibility,
    overlapping,
    taut_course,
    widened,
)
from residnet.core.errors import ConfigError

TABLE_6_3 = [
    BuoyConfig(north=50, east=30, leave_to="port", radius=10),
    BuoyConfig(north=100, east=20, leave_to="starboard", radius=10),
    BuoyConfig(north=50, east=80, leave_to="port", radius=10),
    BuoyConfig(north=80, east=120, leave_to="starboard", radius=10),
    BuoyConfig(north=20, east=120, leave_to="starboard", radius=10),
    BuoyConfig(north=0, east=0, leave_to="starboard", radius=10),
]


def flown(pose: np.ndarray, side: float, length: float, radius: float) -> np.ndarray:
    """The pose after an arc (side +1 or -1) or a line (side 0)."""
    if side == 0:
        return pose + np.array([length * math.cos(pose[2]), length * math.sin(pose[2]), 0.0])
    heading = pose[2] + side * length / radius
    chord = (
        side
        * radius
        * np.array(
            [math.sin(heading) - math.sin(pose[2]), math.cos(pose[2]) - math.cos(heading), 0.0]
        )
    )
    return np.array([*(pose + chord)[:2], heading])


def test_no_flown_path_is_shorter_and_some_are_as_short() -> None:
    rng = np.random.default_rng(0)
    equal = set()
    for _ in range(4000):
        sides = [(1, 0, 1), (-1, 0, -1), (1, 0, -1), (-1, 0, 1), (1, -1, 1), (-1, 1, -1)][
            rng.integers(6)
        ]
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
    assert dubins_length(np.zeros(3), np.array([0.0, 4.0, math.pi]), 2.0) == pytest.approx(
        2.0 * math.pi
    )
    # there and back are the same path reversed
    back = np.array([0.0, 0.0, math.pi])
    a, b = np.array([1.0, 2.0, 0.7]), np.array([3.0, -1.0, 2.1])
    assert dubins_length(a, b, 1.5) == pytest.approx(float(dubins_length(b + back, a + back, 1.5)))


def test_the_pieces_of_a_course_join_and_leave_every_buoy_on_its_side_outside_its_circle() -> None:
    pieces = taut_course((0.0, 0.0), TABLE_6_3)
    track = []
    for piece, after in itertools.zip_longest(pieces, pieces[1:]):
        pose = np.array([piece.north, piece.east, piece.heading])
        assert piece.turn == 0 or piece.length < 1.2 * math.pi * piece.radius
        track += [
            flown(pose, piece.turn, share * piece.length, piece.radius or 1.0)
            for share in np.linspace(0.0, 1.0, 400)
        ]
        if after is not None:
            assert track[-1][:2] == pytest.approx([after.north, after.east], abs=1e-9)
            assert math.cos(track[-1][2] - after.heading) == pytest.approx(1.0)
    poses = np.array(track)
    passed = -1
    assert len(pieces) == 2 * len(TABLE_6_3) - 1
    for buoy in TABLE_6_3[:-1]:
        line = np.array([buoy.north, buoy.east]) - poses[:, :2]
        distance = np.hypot(*line.T)
        assert distance.min() >= 10.0 - 1e-6
        near = passed + 1 + int(distance[passed + 1 :].argmin())
        to_starboard = line[near, 1] * math.cos(poses[near, 2]) - line[near, 0] * math.sin(
            poses[near, 2]
        )
        assert (to_starboard > 0) == (buoy.leave_to == "starboard")
        assert near > passed
        passed = near


def test_a_buoy_in_the_bend_is_rounded_on_its_circle() -> None:
    bend = [
        BuoyConfig(north=100, east=0, leave_to="starboard", radius=10),
        BuoyConfig(north=100, east=100, leave_to="starboard", radius=10),
    ]
    pieces = taut_course((0.0, -10.0), bend)
    assert [piece.turn for piece in pieces] == [0, 1, 0]
    assert sum(piece.length for piece in pieces) == pytest.approx(
        100.0 + 0.5 * math.pi * 10.0 + 100.0
    )


def test_printed_radii_are_too_tight_for_five_degrees_of_rudder() -> None:
    smallest = 3.2 / (3.47 * math.radians(5))
    found = feasibility(TABLE_6_3, smallest)
    assert smallest == pytest.approx(10.57, abs=0.005)
    assert not any(buoy["possible"] for buoy in found)
    assert all(buoy["possible"] for buoy in feasibility(widened(TABLE_6_3, smallest), smallest))


def test_circles_that_overlap_have_no_crossing_tangent() -> None:
    near = BuoyConfig(north=50, east=45, leave_to="starboard", radius=10)
    with pytest.raises(ConfigError, match="buoy 2"):
        taut_course((0.0, 0.0), [TABLE_6_3[0], near])
    assert overlapping([TABLE_6_3[0], near, TABLE_6_3[2]]) == [(1, 2)]
    assert overlapping(TABLE_6_3) == []
