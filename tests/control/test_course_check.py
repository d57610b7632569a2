"""The check of courses by their points: sides, clearance, and circles in which a course begins."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from residnet.control.courses.course_check import BuoyConfig, first_fault, left_behind, passages

Array = NDArray[np.float64]


def line(*corners: tuple[float, float]) -> Array:
    """Points a quarter of a metre apart through corners."""
    parts = []
    for one, two in itertools.pairwise(corners):
        number = round(4 * float(np.hypot(two[0] - one[0], two[1] - one[1])))
        parts.append(np.linspace(one, two, number, endpoint=False))
    return np.concatenate(parts)


def test_going_away_from_where_a_course_begins_is_no_approach() -> None:
    """It begins within the circle, leaves it with the buoy on the wrong side, and comes back."""
    track = line((0.0, 0.0), (0.0, 40.0), (12.0, 40.0), (12.0, -20.0))
    buoy = BuoyConfig(north=1.0, east=1.0, radius=10.0, leave_to="port")
    (passage,) = passages(track, [buoy])
    assert passage.side == passage.side_there == "port"
    assert passage.least == pytest.approx(11.0, abs=0.05)
    assert first_fault(track, [buoy], "sides", 5.0) is None
    other = buoy.model_copy(update={"leave_to": "starboard"})
    assert "not left to starboard" in str(first_fault(track, [other], "sides", 5.0))
    distance = np.hypot(*(track - (1.0, 1.0)).T)
    begin = left_behind(distance, 10.0)
    assert distance[begin] == pytest.approx(np.hypot(1.0, 39.0))


def test_a_circle_that_is_never_left_is_cut() -> None:
    track = line((0.0, 0.0), (0.0, 5.0))
    buoy = BuoyConfig(north=1.0, east=1.0, radius=10.0, leave_to="port")
    assert left_behind(np.hypot(*(track - (1.0, 1.0)).T), 10.0) == len(track)
    assert "is cut" in str(first_fault(track, [buoy], "sides", 5.0))


def test_one_that_begins_outside_counts_from_the_start() -> None:
    track = line((0.0, 0.0), (0.0, 30.0))
    assert left_behind(np.hypot(*(track - (0.0, 20.0)).T), 5.0) == 0


@pytest.mark.parametrize("offset", np.linspace(0.0, 1.0, 5))
def test_a_circle_that_is_touched_between_samples_is_entered(offset: float) -> None:
    """A turn of 10 m touches a circle of 3 m from outside; samples 0.4 m apart only near it."""
    turn, radius, step = 10.0, 3.0, 0.4
    angle = (np.arange(-40, 41) + offset) * step / turn
    track = turn * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    touched = BuoyConfig(north=turn + radius, east=0.0, radius=radius, leave_to="port")
    assert first_fault(track, [touched], "enter", turn) is None
    missed = touched.model_copy(update={"north": turn + radius + 0.02})
    assert "not entered" in str(first_fault(track, [missed], "enter", turn))
    assert first_fault(track, [missed], "enter", turn, missed=0.02) is None


def test_a_circle_that_is_cut_by_two_millimetres_is_cut() -> None:
    """Between samples a track is nearer to a buoy, never farther: nothing is let pass for it."""
    track = line((0.0, 0.0), (0.0, 40.0))
    for nearer, fault in ((0.002, True), (-0.002, False)):
        buoy = BuoyConfig(north=10.0 - nearer, east=20.0, radius=10.0, leave_to="port")
        assert (first_fault(track, [buoy], "sides", 5.0) is not None) == fault


def test_each_buoy_is_judged_in_its_turn_and_its_distance_over_the_whole_course() -> None:
    """The track comes by the first buoy again, nearer and with it on the other side."""
    track = line((0.0, 0.0), (60.0, 0.0), (60.0, 30.0), (0.0, 30.0), (0.0, 10.0), (60.0, 10.0))
    first, second = passages(
        track,
        [BuoyConfig(north=30.0, east=east, leave_to="port", radius=4.0) for east in (8.0, 25.0)],
    )
    assert (first.side, second.side) == ("starboard", "starboard")
    assert (first.side_there, first.at) == ("port", pytest.approx(120, abs=1))
    assert first.least == pytest.approx(2.0, abs=1e-6)
    assert first.distance == pytest.approx(8.0, abs=1e-6)
