"""Training under stated conditions: it lowers the cost, repeats itself, and keeps a good start."""

from __future__ import annotations

import math

import pytest
import torch

from residnet.control.conditions.config import ConditionsConfig
from residnet.control.heading.steering import SteeredPlant
from residnet.control.observed.config import PtosConfig
from residnet.control.observed.policy import ObservedPolicy
from residnet.control.observed.stored import ObservedPolicySpec
from residnet.physics.vessel import load_vessel
from residnet.training.policies.conditions_config import ConditionsTraining
from residnet.training.policies.conditions_fit import train_under_conditions

VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
CONDITIONS = ConditionsConfig(dt=0.1, duration=6.0, hold=0.0, delay=(0.0, 0.3))
# steeper than the delay allows: it swings, and training has something to gain
STEEP = PtosConfig(
    lag=0.0, steepness=250.0, share=0.9, damping=0.6, heading_rate=5.0, yaw_rate_rate=10.0,
    push_rate=1.0, cross_rate=0.1,
)  # fmt: skip


def trained(units: int, rate: float) -> tuple[ObservedPolicy, dict[str, object]]:
    torch.manual_seed(0)
    policy = ObservedPolicySpec(
        state=VESSEL.state, gain=3.47, time=3.94, speed=3.2, limit=math.radians(5), rate=None,
        dt=0.1, trained_at=0.1, law=STEEP, units=units,
    ).build()  # fmt: skip
    settings = ConditionsTraining(
        epochs=2,
        steps=4,
        batch=32,
        learning_rate=rate,
        dt=0.1,
        hold=0.0,
        validation=32,
        quiet=0.0,
        steady=None,
    )
    notes = train_under_conditions("policy", policy, VESSEL, settings, CONDITIONS, 3, None)
    return policy, notes


@pytest.mark.whole_runs
def test_training_lowers_the_cost_of_flights_that_it_does_not_see() -> None:
    policy, notes = trained(4, 0.05)
    assert notes["best_validation"] < 0.97 * notes["start_validation"]  # type: ignore[operator]
    assert policy.values()["steepness"] < 250.0
    again, other = trained(4, 0.05)
    assert other["best_validation"] == notes["best_validation"]
    assert torch.equal(again.constants, policy.constants)


@pytest.mark.whole_runs
def test_a_start_that_training_only_spoils_is_kept() -> None:
    policy, notes = trained(4, 30.0)
    assert notes["best_validation"] == notes["start_validation"]
    assert float(policy.network.out.weight.abs().max()) == 0.0


def test_the_conditions_and_the_guide_follow_the_progress() -> None:
    settings = ConditionsTraining()
    assert [settings.share(p) for p in (0.0, 0.05, 0.15, 1.0)] == [0.0, 0.0, 1.0, 1.0]
    assert settings.share(0.1) == pytest.approx(0.5)
    assert settings.guiding(0.0) == settings.guide
    assert settings.guiding(0.3) == pytest.approx(0.5 * settings.guide)
    assert settings.guiding(0.6) == 0.0
