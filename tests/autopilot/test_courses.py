"""Planned courses against closed forms of Nomoto's model and geometry of their own, and the check
of courses by their points: sides, clearance, and circles in which a course begins.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from residnet.autopilot.base import ClosedLoop
from residnet.autopilot.courses.config import (
    BuoyConfig,
    BuoyCourseConfig,
    PlannedCourse,
    buoy_feasibility,
    enlarge_to_turning_radius,
    overlapping_pairs,
    plan_course,
    smallest_turn,
)
from residnet.autopilot.courses.course_check import (
    PassingRule,
    find_first_violation,
    find_passages,
    first_checked_sample,
)
from residnet.autopilot.courses.turns import TurnMaker, choose_time_step, simulate_steady_turn
from residnet.autopilot.guidance import CourseGuidance, TrackKeeping
from residnet.autopilot.heading.classical import HeadingPD
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.engine.rollout import Rollout
from residnet.physics.vessel import load_vessel

Array = NDArray[np.float64]
Side = Literal["starboard", "port"]
LIMIT = math.radians(5)
TURNING = NomotoModel(gain=3.47, time=3.94, speed=3.2)


def buoy(north: float, east: float, leave_to: Side = "port", radius: float = 10.0) -> BuoyConfig:
    return BuoyConfig(north=north, east=east, leave_to=leave_to, radius=radius)


BUOYS = (buoy(50, 30), buoy(100, 20, "starboard"), buoy(50, 80))
WANTED = BuoyCourseConfig(buoys=BUOYS, acceptance=3.4, lookahead=12.0, planning_dt=0.2)


@pytest.fixture(scope="module")
def vessel() -> SteeredPlant:
    return SteeredPlant(load_vessel("nomoto_oceanos").build())


def plan_of(vessel: SteeredPlant, protocol: PassingRule = "sides", **changes: Any) -> PlannedCourse:
    wanted = WANTED.model_copy(update=changes)
    steady = smallest_turn(wanted, vessel, TURNING, LIMIT)
    return plan_course(wanted, protocol, vessel, TURNING, LIMIT, steady)


def test_the_steady_turn_is_that_of_the_model_and_tells_what_is_possible(
    vessel: SteeredPlant,
) -> None:
    steady = simulate_steady_turn(vessel, LIMIT, 100.0, 0.05)
    assert steady.radius == pytest.approx(3.2 / (3.47 * LIMIT), rel=1e-3)
    # printed radii of 10 m are too tight for five degrees of rudder
    assert not any(one.possible for one in buoy_feasibility(BUOYS, steady.radius))
    wide = buoy_feasibility(enlarge_to_turning_radius(BUOYS, steady.radius), steady.radius)
    assert all(one.possible for one in wide)
    # circles that overlap leave no way between them
    assert overlapping_pairs([BUOYS[0], buoy(50, 45, "starboard"), BUOYS[2]]) == [(1, 2)]
    assert overlapping_pairs(BUOYS) == []


def test_turns_take_the_time_of_full_rudder_and_counter_rudder(vessel: SteeredPlant) -> None:
    """T r_dot + r = K delta, rest to rest: turned K d (t1 - t2), t2 = T ln(2 - exp(-t1 / T))."""
    make = TurnMaker(vessel, TURNING, 0.05)
    holds = np.array([[3.0, 9.0], [5.03, 12.0]])
    rudders = 0.9 * LIMIT * np.array([1, -1])
    made = make(holds, rudders, [make.straight_state] * 2, 4.0)
    for side, turn in (
        (side, turn) for side, row in zip((1, -1), made, strict=True) for turn in row
    ):
        counter = 3.94 * math.log(2.0 - math.exp(-turn.hold_time / 3.94))
        assert turn.duration == pytest.approx(turn.hold_time + counter, abs=1e-3)
        angle = side * 3.47 * 0.9 * LIMIT * (turn.hold_time - counter)
        end, turned = turn.track_at(np.array([turn.duration]))
        assert turned == pytest.approx(angle, abs=1e-4)
        # straight on behind it
        track, heading = turn.leg_at(np.array([0.0, 4.0]))
        assert heading == pytest.approx(angle, abs=1e-4)
        assert track[0] == pytest.approx(end[0], abs=1e-9)
        way = 3.2 * 4.0 * np.array([math.cos(angle), math.sin(angle)])
        assert track[1] - track[0] == pytest.approx(way, abs=2e-3)


def test_a_turn_that_follows_a_turn_begins_with_its_yaw(vessel: SteeredPlant) -> None:
    """Nomoto's heading from a yaw rate r0: r0 T (1 - e) + K d (t - T (1 - e)), e = exp(-t / T)."""
    make = TurnMaker(vessel, TURNING, 0.05)
    begin = make.straight_state.copy()
    begin[vessel.state_column("r")], begin[vessel.state_column("psi")] = -0.1, 2.0
    turn = make(np.array([[6.0]]), np.array([LIMIT]), [begin], 1.0)[0][0]
    faded = 3.94 * (1.0 - math.exp(-6.0 / 3.94))
    expected = -0.1 * faded + 3.47 * LIMIT * (6.0 - faded)
    assert turn.track_at(np.array([6.0]))[1] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "turning"),
    [
        ("nomoto_oceanos", TURNING),
        pytest.param("patrol_p06_linear", NomotoModel(0.3829, 5.154, 7.71), marks=pytest.mark.long),
    ],
)
def test_a_turn_with_the_step_chosen_ends_where_one_with_a_thirtieth_does(
    name: str, turning: NomotoModel
) -> None:
    steered = SteeredPlant(load_vessel(name).build())
    step = choose_time_step(steered, turning, LIMIT)
    assert step > 0.1 * turning.time
    ends = []
    hold = np.array([[1.5 * turning.time]])
    for dt in (step, step / 30.0):
        make = TurnMaker(steered, turning, dt)
        ((turn,),) = make(hold, np.array([LIMIT]), [make.straight_state], 1.0)
        track, heading = turn.leg_at(np.zeros(1))
        ends.append([*track[0] * turning.gain * LIMIT / turning.speed, heading[0]])
    assert ends[0] == pytest.approx(ends[1], abs=2e-3)


# to and fro, with sides that need loops
LOOPS = (buoy(60, 0), buoy(10, 25), buoy(75, 45, "starboard"), buoy(60, -45, "starboard"))
# the shortest outline leads to fits that miss the last of these by six metres
LONG = (
    *(buoy(37.41, 53.58), buoy(63.62, -16.91), buoy(114.34, 56.85)),
    *(buoy(164.22, 42.69, "starboard"), buoy(187.47, 135.26), buoy(167.39, 28.22)),
)


@pytest.mark.parametrize(
    "buoys",
    # of plans with sides, the one of three buoys is fast
    [
        BUOYS,
        pytest.param(LOOPS, marks=pytest.mark.long),
        pytest.param(LONG, marks=pytest.mark.long),
    ],
    ids=["three", "loops", "long"],
)
def test_a_plan_leaves_every_buoy_on_its_side_outside_its_circle(
    vessel: SteeredPlant, buoys: tuple[BuoyConfig, ...]
) -> None:
    """Judged by the points of the plan alone; no part is tighter than the vessel turns."""
    planned = plan_of(vessel, buoys=buoys)
    course = planned.course
    radius = planned.steady.radius
    count = int(course.length / course.step)
    track = course.track[: count + 2]
    passed = -1
    assert np.abs(np.diff(course.direction[:count])).max() <= 1.03 * course.step / radius
    for one in buoys:
        away = np.array([one.north, one.east]) - track
        distance = np.hypot(*away.T)
        assert distance.min() >= radius
        # the course may come back to a buoy as near as in its turn, on the same side
        nearest = np.flatnonzero(distance <= distance.min() + 0.01)
        near = passed = int(nearest[nearest > passed][0])
        step = track[min(near + 1, len(track) - 1)] - track[near - 1]
        on_starboard = step[0] * away[near, 1] - step[1] * away[near, 0] > 0
        assert on_starboard == (one.leave_to == "starboard")
    most = 1.06 if buoys is BUOYS else 1.1
    assert planned.reference_length < course.length <= most * planned.reference_length


@pytest.mark.long
def test_a_given_heading_lengthens_the_shortest_course_past_sides(vessel: SteeredPlant) -> None:
    """Along the first leg it changes nothing; away from it the vessel has to come round, pi R and
    more.
    """
    free = plan_of(vessel)
    along = float(free.course.heading[0])
    radius = free.steady.radius
    onward, away = (plan_of(vessel, heading=heading) for heading in (along, along + math.pi))
    assert onward.reference_length == pytest.approx(free.reference_length, rel=2e-3)
    assert onward.course.length == pytest.approx(free.course.length, rel=0.02)
    assert away.reference_length > free.reference_length + math.pi * radius
    assert free.course.length + radius < away.course.length
    # it comes round within a full turn
    assert away.course.length < 1.05 * (free.course.length + 2.0 * math.pi * radius)


def test_circles_of_acceptance_are_entered_and_a_current_keeps_farther_off(
    vessel: SteeredPlant,
) -> None:
    planned = plan_of(vessel, "enter", heading=0.0)
    assert planned.course.heading[0] == pytest.approx(0.0, abs=1e-6)
    inside = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
    for one in BUOYS:
        assert np.hypot(*(inside - (one.north, one.east)).T).min() <= 3.4
    assert planned.reference_length < planned.course.length <= 1.06 * planned.reference_length
    planned = plan_of(vessel, current=0.3)
    for one in planned.buoys:
        away = planned.course.track - (one.north, one.east)
        assert np.hypot(*away.T).min() >= planned.steady.radius + 0.3 * TURNING.time


def test_what_no_course_can_do_is_refused(vessel: SteeredPlant) -> None:
    with pytest.raises(ConfigError, match="start is within all circles"):
        plan_of(vessel, "enter", buoys=(buoy(0.0, 0.0), buoy(1.5, 0.0)))
    with pytest.raises(ConfigError, match=r"buoy|mark"):
        plan_of(vessel, buoys=(BUOYS[0], buoy(52, 20, "starboard"), BUOYS[2]))


@pytest.mark.long
def test_a_vessel_that_sways_and_rolls_follows_turns_that_join_each_other() -> None:
    patrol = SteeredPlant(load_vessel("patrol_p06_linear").build())
    turning = patrol.estimate_nomoto(LIMIT, 300.0, 0.1)
    places = (buoy(500, 300), buoy(1000, 200, "starboard"), buoy(700, 700))
    wanted = BuoyCourseConfig(
        buoys=tuple(one.model_copy(update={"radius": 100.0}) for one in places),
        acceptance=51.5,
        lookahead=100.0,
        turning_time=200.0,
    )
    steady = smallest_turn(wanted, patrol, turning, LIMIT)
    planned = plan_course(wanted, "enter", patrol, turning, LIMIT, steady)
    assert np.ptp(np.sign(planned.course.rudder)) == 2.0
    law = HeadingPD.from_pole_placement(
        patrol.state, gain=turning.gain, time=turning.time, frequency=0.8, damping=1.0, limit=LIMIT
    )
    follower = TrackKeeping(law, patrol.state, limit=LIMIT, dt=0.1, rate=patrol.rate)
    guidance = CourseGuidance(planned.course, wanted.lookahead, patrol.state)
    x, w = patrol.straight_course(torch.ones(1, dtype=torch.float64))
    x[:, patrol.state_column("psi")] = float(planned.course.heading[0])
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        loop = Rollout(patrol.model(0.1), ClosedLoop(follower, guidance))
        states, _, _ = loop(x, w.unsqueeze(1).expand(-1, 2500, -1), nominal)
    place = torch.zeros(1, 1, dtype=torch.float64)
    aside = []
    for state in states[0, ::5]:
        _, place = guidance(state[None], 0, place)
        aside.append(abs(float(guidance.track_error(state[None], place[:, 0])[1])))
    assert float(place) >= planned.course.length
    # two of a hundred of the hull's length, where one turn joins the next
    assert max(aside) < 0.02 * 51.5


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
    (passage,) = find_passages(track, [buoy(1.0, 1.0)])
    assert passage.buoy_side == passage.buoy_side_at_min_distance == "port"
    assert passage.min_distance == pytest.approx(11.0, abs=0.05)
    assert find_first_violation(track, [buoy(1.0, 1.0)], "sides", 5.0) is None
    fault = find_first_violation(track, [buoy(1.0, 1.0, "starboard")], "sides", 5.0)
    assert "not left to starboard" in str(fault)
    distance = np.hypot(*(track - (1.0, 1.0)).T)
    begin = first_checked_sample(distance, 10.0)
    assert distance[begin] == pytest.approx(np.hypot(1.0, 39.0))
    # a circle that is never left is cut, and one that begins outside counts from the start
    track = line((0.0, 0.0), (0.0, 5.0))
    assert first_checked_sample(np.hypot(*(track - (1.0, 1.0)).T), 10.0) == len(track)
    assert "is cut" in str(find_first_violation(track, [buoy(1.0, 1.0)], "sides", 5.0))
    assert first_checked_sample(np.hypot(*(line((0, 0), (0, 30)) - (0.0, 20.0)).T), 5.0) == 0


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5])
def test_a_circle_that_is_touched_between_samples_is_entered(offset: float) -> None:
    """A turn of 10 m touches a circle of 3 m from outside; samples 0.4 m apart only near it."""
    angle = (np.arange(-40, 41) + offset) * 0.4 / 10.0
    track = 10.0 * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    touched, missed = (buoy(10.0 + 3.0 + off, 0.0, radius=3.0) for off in (0.0, 0.02))
    assert find_first_violation(track, [touched], "enter", 10.0) is None
    assert "not entered" in str(find_first_violation(track, [missed], "enter", 10.0))
    assert find_first_violation(track, [missed], "enter", 10.0, tolerance=0.02) is None


@pytest.mark.parametrize(("nearer", "fault"), [(0.002, True), (-0.002, False)])
def test_a_circle_that_is_cut_by_two_millimetres_is_cut(nearer: float, fault: bool) -> None:
    """Between samples a track is nearer to a buoy, never farther: nothing is let pass for it."""
    track = line((0.0, 0.0), (0.0, 40.0))
    found = find_first_violation(track, [buoy(10.0 - nearer, 20.0)], "sides", 5.0)
    assert (found is not None) == fault


def test_each_buoy_is_judged_in_its_turn_and_its_distance_over_the_whole_course() -> None:
    """The track comes by the first buoy again, nearer and with it on the other side."""
    track = line((0.0, 0.0), (60.0, 0.0), (60.0, 30.0), (0.0, 30.0), (0.0, 10.0), (60.0, 10.0))
    first, second = find_passages(track, [buoy(30.0, east, radius=4.0) for east in (8.0, 25.0)])
    assert (first.buoy_side, second.buoy_side) == ("starboard", "starboard")
    assert (first.buoy_side_at_min_distance, first.sample) == ("port", pytest.approx(120, abs=1))
    assert first.min_distance == pytest.approx(2.0, abs=1e-6)
    assert first.distance == pytest.approx(8.0, abs=1e-6)
