"""Line-of-sight guidance: geometry of a leg, circle of acceptance, arrival; and wheel-over against
turns that are integrated by SciPy.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from residnet.control.guidance import (
    EnclosureConfig,
    IntegralLookAheadConfig,
    LookAhead,
    LookAheadConfig,
    WaypointGuidance,
    WheelOver,
)
from residnet.control.heading.turning import Turning
from residnet.core.errors import ConfigError

STATE = ("x", "y", "psi", "u", "v", "r")


def at(*places: tuple[float, float]) -> torch.Tensor:
    x = torch.zeros(len(places), 6, dtype=torch.float64)
    x[:, :2] = torch.tensor(places, dtype=torch.float64)
    return x


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_it_steers_for_a_point_ahead_on_the_leg(turn: float) -> None:
    """A leg of any direction; 3 m to starboard of it with 4 m look-ahead: atan(3/4) to port of the
    leg's direction.
    """
    end = (100 * math.cos(turn), 100 * math.sin(turn))
    guidance = WaypointGuidance([end], 5.0, LookAheadConfig(distance=4.0).build(0.1), STATE)
    s = guidance.initial_state(at((0.0, 0.0)))
    for aside in (3.0, 0.0, -3.0):
        x = at(
            (
                20 * math.cos(turn) - aside * math.sin(turn),
                20 * math.sin(turn) + aside * math.cos(turn),
            )
        )
        heading, s = guidance(x, 0, s)
        expected = turn - math.atan(aside / 4)
        assert math.remainder(float(heading) - expected, 2 * math.pi) == pytest.approx(
            0.0, abs=1e-12
        )
        _, ahead, error = guidance.leg(x, s[:, 0].long(), s)
        assert float(ahead) == pytest.approx(80.0)
        assert float(error) == pytest.approx(aside, abs=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_it_steers_for_where_a_circle_about_the_vessel_meets_the_leg(turn: float) -> None:
    """The point is found here from the quadratic equation of a circle and a line, its root further
    along the leg.
    """
    radius, leg = 5.0, 100 * np.array([math.cos(turn), math.sin(turn)])
    guidance = WaypointGuidance([tuple(leg)], 2.0, EnclosureConfig(radius=radius).build(0.1), STATE)
    s = guidance.initial_state(at((0.0, 0.0)))
    for place in ([20.0, 3.0], [21.0, 0.0], [22.0, -3.0], [23.0, 4.9], [24.0, -4.9]):
        vessel = np.array(
            [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        ) @ np.array(place)
        share = max(np.roots([leg @ leg, -2 * leg @ vessel, vessel @ vessel - radius**2]).real)
        north, east = share * leg - vessel
        heading, s = guidance(at((vessel[0], vessel[1])), 0, s)
        assert math.remainder(
            float(heading) - math.atan2(east, north), 2 * math.pi
        ) == pytest.approx(0.0, abs=1e-9)
    # out of reach: straight for the leg
    for aside in (8.0, -8.0):
        heading, s = guidance(
            at(
                (
                    30 * math.cos(turn) - aside * math.sin(turn),
                    30 * math.sin(turn) + aside * math.cos(turn),
                )
            ),
            0,
            s,
        )
        assert math.remainder(
            float(heading) - turn + math.copysign(math.pi / 2, aside), 2 * math.pi
        ) == pytest.approx(0.0, abs=1e-9)


def test_legs_change_in_the_circle_and_behind_the_point() -> None:
    guidance = WaypointGuidance(
        [(10.0, 0.0), (10.0, 20.0)], 2.0, LookAheadConfig(distance=5.0).build(0.1), STATE
    )
    x = at((7.9, 0.0), (8.1, 0.0), (10.1, 9.0))
    s = guidance.initial_state(at((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)))
    heading, s = guidance(x, 0, s)
    assert s[:, 0].tolist() == [0, 1, 1], "before the circle, inside, and past the point beside it"
    # now along the second leg, to the east, with the vessel 1.9 m to the south of it
    assert float(heading[1]) == pytest.approx(math.pi / 2 - math.atan(1.9 / 5))
    assert guidance.finished(x, 0, s).tolist() == [False, False, False]
    _, s = guidance(at((7.9, 0.0), (10.0, 18.5), (10.0, 25.0)), 1, s)
    assert guidance.finished(x, 1, s).tolist() == [False, True, True]
    # arrived once, arrived for good
    _, s = guidance(at((7.9, 0.0), (0.0, 0.0), (0.0, 0.0)), 2, s)
    assert guidance.finished(x, 2, s).tolist() == [False, True, True]


def test_nonsense_is_refused() -> None:
    for points, acceptance in (([], 1.0), ([(1.0, 1.0)], 0.0)):
        with pytest.raises(ConfigError, match="way-points"):
            WaypointGuidance(points, acceptance, LookAheadConfig(distance=1.0).build(0.1), STATE)
    for config, key in (
        (LookAheadConfig, "distance"),
        (EnclosureConfig, "radius"),
        (IntegralLookAheadConfig, "gain"),
    ):
        with pytest.raises(ValidationError, match="greater than 0"):
            config.model_validate({"distance": 1.0, "gain": 1.0, key: 0.0})


TURNING, LIMIT = Turning(3.47, 3.94, 3.2), math.radians(5)


def turned(change: float) -> np.ndarray:
    """Poses [N, 3] of the turn by full rudder and counter-rudder that ends without yaw at this
    heading.
    """

    def rate(_: float, z: np.ndarray, rudder: float) -> list[float]:
        return [
            TURNING.speed * math.cos(z[2]),
            TURNING.speed * math.sin(z[2]),
            z[3],
            (TURNING.gain * rudder - z[3]) / TURNING.time,
        ]

    def stopped(_: float, z: np.ndarray, *rudder: float) -> float:
        return float(z[3])

    stopped.terminal = True  # type: ignore[attr-defined]
    stopped.direction = -1  # type: ignore[attr-defined]

    def flown(held: float) -> np.ndarray:
        over = solve_ivp(
            rate, (0.0, held), np.zeros(4), args=(LIMIT,), rtol=1e-8, atol=1e-8, max_step=0.1
        )
        back = solve_ivp(
            rate,
            (0.0, 20.0),
            over.y[:, -1],
            args=(-LIMIT,),
            rtol=1e-8,
            atol=1e-8,
            max_step=0.1,
            events=stopped,
        )
        return np.concatenate((over.y.T, back.y.T))

    return flown(brentq(lambda held: flown(held)[-1, 2] - change, 0.1, 20.0, xtol=1e-5))


@pytest.mark.parametrize("degrees", [10.0, 42.0])
def test_a_gentle_turn_begins_where_it_ends_on_the_next_leg(degrees: float) -> None:
    angle = math.radians(degrees)
    end = turned(angle)[-1]
    corner = end[0] - end[1] / math.tan(angle)
    over = WheelOver(TURNING, LIMIT, 10.0)
    assert over(torch.tensor([angle, -angle], dtype=torch.float64)).tolist() == pytest.approx(
        [corner, corner], rel=5e-3
    )


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_sharp_turn_still_reaches_into_the_circle(share: float) -> None:
    angle = math.radians(140.0)
    distance = float(
        WheelOver(TURNING, LIMIT, 3.4, share=share)(torch.tensor([angle], dtype=torch.float64))
    )
    track = turned(angle)[:, :2]
    assert np.hypot(track[:, 0] - distance, track[:, 1]).min() == pytest.approx(
        share * 3.4, rel=0.02
    )


def test_straight_on_needs_none_and_a_slow_rudder_needs_half_its_way_more() -> None:
    angles = torch.tensor([0.0, 1.0], dtype=torch.float64)
    quick, slow = (
        WheelOver(TURNING, LIMIT, 3.4, rate=rate)(angles) for rate in (None, LIMIT / 2.0)
    )
    assert float(quick[0]) == 0.0
    assert (slow - quick).tolist() == pytest.approx([3.2, 3.2])


def test_legs_change_at_the_wheel_over_on_the_leg_but_in_the_circle_beside_it() -> None:
    over = WheelOver(TURNING, LIMIT, 3.4)
    guidance = WaypointGuidance([(100.0, 0.0), (100.0, 100.0)], 3.4, LookAhead(10.0), STATE, over)
    before = float(over(torch.tensor([0.5 * math.pi], dtype=torch.float64)))
    assert before > 3.4
    x = torch.zeros(6, 6, dtype=torch.float64)
    # short of it, there, there but aside of the leg, in the circle; and the last way-point has no
    # wheel-over
    x[:, 0] = torch.tensor(
        [99.9 - before, 100.1 - before, 100.1 - before, 97.0, 100.0, 100.1 - before]
    )
    x[:, 1] = torch.tensor([0.0, 0.0, 3.0, 0.0, 96.5, 0.0])
    # there, on the leg, but at a crab angle
    x[5, 2] = 0.15
    s = torch.zeros(6, 3, dtype=torch.float64)
    s[4, 0] = 1.0
    compiled = torch.jit.script(guidance)(x, 0, s)[1]
    _, s = guidance(x, 0, s)
    assert torch.equal(compiled, s)
    assert s[:, 0].tolist() == [0.0, 1.0, 0.0, 1.0, 1.0, 0.0]
