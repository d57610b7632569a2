"""Training under stated conditions: it lowers the cost, repeats itself, and keeps a good start."""

from __future__ import annotations

import math

import pytest
import torch

from residnet.autopilot.heading.conditions import (
    ClosedLoopTrajectories,
    ConditionsConfig,
    SteadinessLimits,
)
from residnet.autopilot.heading.controllers import ObserverPolicySpec, PtosConfig
from residnet.autopilot.heading.policies import ObserverPolicy
from residnet.autopilot.heading.steering_variation import HEADING
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.training.config import PolicyTraining
from residnet.autopilot.training.fit import PolicyFit, train_policy
from residnet.physics.vessel import load_vessel

VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
CONDITIONS = ConditionsConfig(dt=0.1, duration=6.0, hold=0.0, delay=(0.0, 0.3))
# steeper than the delay allows: it swings, and training has something to gain
STEEP = PtosConfig(
    lag=0.0, steepness=250.0, share=0.9, damping=0.6, heading_rate=5.0, yaw_rate_rate=10.0,
    push_rate=1.0, cross_rate=0.1,
)  # fmt: skip


def policy(units: int) -> ObserverPolicy:
    return ObserverPolicySpec(
        state=VESSEL.state, gain=3.47, time=3.94, speed=3.2, limit=math.radians(5), rate=None,
        dt=0.1, trained_at=0.1, law=STEEP, units=units,
    ).build()  # fmt: skip


@pytest.mark.long
def test_training_lowers_the_cost_of_flights_that_it_does_not_see() -> None:
    settings = PolicyTraining(
        epochs=2, steps=4, batch=32, learning_rate=0.05, dt=0.1, hold=0.0, validation=32, quiet=0.0,
        steady=None,
    )  # fmt: skip
    found = []
    for _ in range(2):
        torch.manual_seed(0)
        made = policy(4)
        notes = train_policy("policy", made, VESSEL, settings, CONDITIONS, 3, None)
        found.append((notes["best_validation"], made.constants.tolist()))
    assert notes["best_validation"] < 0.97 * notes["start_validation"]
    assert made.constant_values()["steepness"] < 250.0
    assert found[0] == found[1]


def fitted(settings: PolicyTraining) -> PolicyFit:
    return PolicyFit(policy(2), VESSEL, settings, CONDITIONS, 0, None)


def test_the_last_epochs_take_the_step_of_the_conditions() -> None:
    fit = fitted(PolicyTraining(dt=0.2, hold=0.0, validation=4, epochs=10, fine=0.3))
    steps = []
    for epoch in range(10):
        fit.history = [{}] * epoch
        fit.on_train_epoch_start()
        steps.append(fit.policy.dt)
    assert steps == [0.2] * 7 + [0.1] * 3
    # the vessel and its loops are not trained: they have no place in a checkpoint
    assert all(name.startswith("policy.") for name in fit.state_dict())


def test_epochs_far_from_the_start_ease_the_charge() -> None:
    settings = PolicyTraining(dt=0.1, hold=0.0, validation=4, nominal=0.05, spread=0.15)
    fit = fitted(settings.model_copy(update={"epochs": 10, "stricter": 1.5}))
    fit.start_score = 6.0
    fit.best_state = {"any": torch.zeros(1)}
    # the first two epochs fly less than the full conditions; the third swings only
    costs = [(9.0, 1_000_000), (9.0, 1_000_000), (5.9, 3), (7.0, 1_000_000), (6.1, 1_000_000)]
    fit.history = [
        {"epoch": float(k), "validation": cost, "diverged": float(refused)}
        for k, (cost, refused) in enumerate(costs)
    ]
    assert fit._count_diverged_epochs(fit.history) == 1
    assert fit._penalty_weight() == pytest.approx(1.5 * 0.2)
    assert fit._count_diverged_epochs([{"epoch": 9.0}, {"epoch": 9.0, "validation": math.nan}]) == 1


def test_epochs_that_swing_come_after_those_that_do_not() -> None:
    settings = PolicyTraining(dt=0.1, hold=0.0, validation=4, steady=SteadinessLimits(flights=4))
    fit = fitted(settings)
    # five of twenty-four flights are beyond the limits: they count twice
    fit.best_state = {"any": torch.zeros(1)}
    fit.best_score = 6.0
    fit.best_diverged = 5
    for refused, cost, better in ((0, 9.0, True), (5, 5.9, True), (0, math.nan, False),
                                  (10, 5.2, False), (10, 4.9, True), (1, 6.9, True)):  # fmt: skip
        fit.diverged = refused
        assert fit._is_improvement(cost) is better
    fit.best_diverged = 0
    fit.diverged = 1
    assert not fit._is_improvement(0.1)


def test_swing_and_nominal_overshoot_cost_beyond_what_is_free() -> None:
    fit = fitted(PolicyTraining(dt=0.1, hold=0.0, validation=4, calm=0.5, exact=2.0))
    changes = CONDITIONS.sample_steps(16, 0.1, torch.Generator().manual_seed(0))
    time = 0.1 * torch.arange(changes.push.shape[1])
    wave = torch.sin(2.0 * math.pi * time)
    over = torch.full((16,), math.radians(0.1))

    def cost(amplitude: float, swinging: int) -> float:
        command = torch.zeros(16, len(time))
        command[:swinging] = math.radians(amplitude) * wave
        about = (changes.dt, ("psi",), HEADING, changes.step_index, changes.n_counted)
        states = torch.zeros(16, len(time) + 1, 1)
        flown = ClosedLoopTrajectories(states, command, changes.target, *about)
        return float(fit._limit_cycle_penalty(flown, over, 8))

    # 0.2 s are the overshoot; half of what an epoch may swing is free; of eight quiet flights the
    # two that swing most count
    assert cost(0.0, 0) == pytest.approx(0.2, rel=1e-5)
    assert cost(0.19, 8) == pytest.approx(0.2, rel=1e-5)
    assert cost(1.0, 8) == pytest.approx(0.2 + 0.5 * (0.5 - 0.2**2 / 2.0), rel=0.02)
    assert cost(1.0, 2) == pytest.approx(cost(1.0, 8))
    assert cost(1.0, 1) == pytest.approx(0.2 + 0.5 * (cost(1.0, 8) - 0.2), rel=1e-4)


def test_overshoot_beyond_the_limit_of_one_in_twenty_costs() -> None:
    limits = SteadinessLimits(flights=4, overshoot_p95=math.radians(0.5))
    settings = PolicyTraining(dt=0.1, hold=0.0, validation=4, excess=2.0, steady=limits)
    overshoot = torch.deg2rad(torch.tensor([0.0, 0.4, 0.7, 1.5]))
    assert float(fitted(settings)._overshoot_penalty(overshoot)) == pytest.approx(
        2.0 * (0.2 + 1.0) / 4.0
    )
    assert fitted(settings.model_copy(update={"steady": None}))._overshoot_penalty(overshoot) == 0.0


def test_the_conditions_and_the_guide_follow_the_progress() -> None:
    assert PolicyTraining().share(0.0) == 1.0
    with pytest.raises(ValueError, match=r"nominal \(0.1\) must not be larger than spread \(0\)"):
        PolicyTraining(nominal=0.1)
    settings = PolicyTraining(nominal=0.05, spread=0.15)
    assert [settings.share(p) for p in (0.0, 0.05, 0.15, 1.0)] == [0.0, 0.0, 1.0, 1.0]
    assert settings.share(0.1) == pytest.approx(0.5)
    assert settings.error_weight(0.0) == settings.guide
    assert settings.error_weight(0.3) == pytest.approx(0.5 * settings.guide)
    assert settings.error_weight(0.6) == 0.0
