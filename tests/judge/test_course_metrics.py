"""How buoys were passed, on tracks of plain geometry."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from residnet.judge.autopilots import CourseFlight, passes


def straight(*corners: tuple[float, float]) -> CourseFlight:
    """Straight from corner to corner in steps of 0.1 m, one step a second."""
    parts = [
        np.linspace(a, b, round(10 * float(np.hypot(*np.subtract(b, a)))), endpoint=False)
        for a, b in itertools.pairwise(corners)
    ]
    track = np.concatenate((*parts, [corners[-1]]))
    rest = np.zeros(len(track))
    return CourseFlight(track, rest, rest, rest, rest, 1.0, True)


def test_a_buoy_to_starboard_and_one_to_port_at_their_distances() -> None:
    flight = straight((0.0, 0.0), (100.0, 0.0))
    first, second = passes(flight, [(30.0, 5.0), (80.0, -4.0)], [5.0, 5.0])
    assert (first.side, second.side) == ("starboard", "port")
    assert (first.distance, second.distance) == pytest.approx((5.0, 4.0), abs=1e-9)
    assert (first.time, second.time) == pytest.approx((300.0, 800.0), abs=2.0)


def test_each_buoy_is_judged_in_its_turn_and_its_distance_over_the_whole_course() -> None:
    """The track comes by the first buoy again, nearer and with it on the other side: the side is
    that of its turn.
    """
    flight = straight((0.0, 0.0), (60.0, 0.0), (60.0, 30.0), (0.0, 30.0), (0.0, 6.0), (60.0, 6.0))
    first, second = passes(flight, [(30.0, 8.0), (30.0, 25.0)], [4.0, 4.0])
    assert first.side == "starboard"
    assert first.distance == pytest.approx(2.0, abs=1e-6)
    assert second.side == "starboard"


def test_a_start_inside_the_last_circle_is_left_first() -> None:
    flight = straight((0.0, 0.0), (50.0, 0.0), (50.0, 50.0), (0.0, 12.0))
    last = passes(flight, [(50.0, 20.0), (0.0, 0.0)], [10.0, 10.0])[1]
    # going away from where it began is no approach
    assert last.distance == pytest.approx(12.0, abs=0.11)
    assert last.time == pytest.approx(len(flight.track) - 1, abs=1.0)
