"""Flights without noise that decide which epochs of a training are taken."""

from __future__ import annotations

import math

import torch

from residnet.control.heading.conditions import (
    ConditionedRun,
    ConditionsConfig,
    SteadinessLimits,
    SteadyTest,
    nominal,
    too_many,
)
from residnet.control.heading.controllers import PdConfig, PtosConfig, Steering
from residnet.control.heading.vessels import SteeredPlant
from residnet.physics.vessel import load_vessel

VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
CONDITIONS = ConditionsConfig(dt=0.1, duration=8.0, delay=(0.3, 0.4))
STEERING = Steering(VESSEL, VESSEL.turning(math.radians(5), 100.0), math.radians(5), 0.1)
STEEP = PtosConfig(
    steepness=250.0, share=0.9, damping=0.6, heading_rate=5.0, yaw_rate_rate=10.0, push_rate=1.0,
    cross_rate=0.1,
)  # fmt: skip


def refused(controller: PdConfig | PtosConfig, limits: SteadinessLimits) -> int:
    run = ConditionedRun(VESSEL, controller.build(STEERING), 0.1)
    return SteadyTest(limits, CONDITIONS, 1).refused(run)


def test_flights_that_swing_are_counted() -> None:
    limits = SteadinessLimits(flights=8)
    # late commands are too late for a steep law; the nominal vessel of sixteen flights has none
    assert refused(STEEP, limits) >= 8
    assert refused(PdConfig(kp=1.4, damping_time=1.4), limits) == 0


def test_overshoot_of_the_nominal_vessel_is_counted() -> None:
    limits = SteadinessLimits(flights=2, overshoot=math.radians(0.3))
    hasty = PdConfig(kp=1.5, damping_time=1.1)
    assert refused(hasty, limits) > refused(hasty, limits.model_copy(update={"overshoot": 1.0}))


def test_nominal_rows_have_no_delay_bias_or_weather() -> None:
    config = ConditionsConfig(wind=(2.0, 8.0), current=0.5, delay=(0.2, 0.4))
    drawn = config.draw(6, config.dt, torch.Generator().manual_seed(0))
    changed = nominal(drawn, 2, 3)
    assert torch.equal(changed.variation[2:5], torch.tensor([[1.0, 1.0, 0.0]]).expand(3, 3))
    assert not changed.delay[2:5].any()
    assert not any(values[2:5].any() for values in changed.weather.values())
    for rows in (slice(0, 2), slice(5, 6)):
        assert torch.equal(changed.variation[rows], drawn.variation[rows])
        assert torch.equal(changed.delay[rows], drawn.delay[rows])


def test_one_flight_in_twenty_may_overshoot_by_more() -> None:
    overshoot = torch.zeros(60)
    overshoot[:3] = 1.0
    assert too_many(overshoot, 0.5) == 0
    overshoot[3:5] = 0.6
    assert too_many(overshoot, 0.5) == 2
    assert too_many(overshoot, 2.0) == 0
    overshoot[5] = math.nan
    assert too_many(overshoot, 0.5) == 3
