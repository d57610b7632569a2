"""Training a heading policy: through the vessel, by imitation, and resumed to the same weights."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from residnet.control.heading.controllers import PdConfig, Steering
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import SteeredPlant, fly
from residnet.physics.vessel import load_vessel
from residnet.training.policies.autopilot import train_autopilot
from residnet.training.policies.autopilot_config import AutopilotTraining, SpreadConfig

DEG = math.pi / 180
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
TURNING = VESSEL.turning(5 * DEG, 60.0)
SETTINGS = AutopilotTraining(epochs=2, steps=3, batch=32, dt=0.2, horizon=6.0)


def fresh() -> HeadingPolicy:
    torch.manual_seed(0)
    return HeadingPolicy(VESSEL.state, turning=TURNING, limit=5 * DEG, dt=0.2, hidden=(8,))


def settling(policy: HeadingPolicy) -> float:
    policy.dt = 0.05
    flights = fly(
        VESSEL,
        policy,
        torch.tensor([30 * DEG]),
        torch.tensor([[1.0, 1.0, 0.0]]),
        dt=0.05,
        duration=15.0,
    )
    return float(flights.absolute_error()[0] + 100.0 * flights.overshoot()[0])


def test_training_steers_better(tmp_path: Path) -> None:
    policy = fresh()
    with torch.no_grad():
        policy.law.copy_(torch.tensor([80.0, 0.4, 2.0, 1.0]).log())
    before = settling(policy)
    notes = train_autopilot(
        "p",
        policy,
        VESSEL,
        SETTINGS.model_copy(update={"epochs": 4, "learning_rate": 0.05}),
        SpreadConfig(),
        settling,
        0,
        tmp_path,
    )
    assert settling(policy) < before - 0.02
    assert settling(policy) == pytest.approx(notes["best_validation"])
    assert (tmp_path / "tensorboard" / "p").is_dir()


def test_resumed_training_ends_with_the_same_weights(tmp_path: Path) -> None:
    whole, parts = fresh(), fresh()
    train_autopilot("p", whole, VESSEL, SETTINGS, SpreadConfig(), settling, 0, tmp_path / "whole")

    def stopped(policy: HeadingPolicy) -> float:
        if len(scores) == 1:
            raise RuntimeError("killed")
        scores.append(settling(policy))
        return scores[-1]

    scores: list[float] = []
    with pytest.raises(RuntimeError, match="killed"):
        train_autopilot(
            "p", parts, VESSEL, SETTINGS, SpreadConfig(), stopped, 0, tmp_path / "parts"
        )
    again = fresh()
    train_autopilot("p", again, VESSEL, SETTINGS, SpreadConfig(), settling, 0, tmp_path / "parts")
    for mine, theirs in zip(whole.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(mine, theirs)


def test_a_pupil_comes_near_its_teacher(tmp_path: Path) -> None:
    teacher = PdConfig(kp=3.0, damping_time=2.5).build(Steering(VESSEL, TURNING, 5 * DEG, 0.2))
    policy = fresh()

    def difference(policy: HeadingPolicy) -> float:
        policy.dt = 0.05
        both = [
            fly(
                VESSEL,
                p,
                torch.tensor([30 * DEG]),
                torch.tensor([[1.0, 1.0, 0.0]]),
                dt=0.05,
                duration=12.0,
            )
            for p in (policy, teacher)
        ]
        return float((both[0].inputs - both[1].inputs).square().mean().sqrt()) / DEG

    before = difference(policy)
    # at the step that it is flown with: the policy's own estimator and brake know the step
    settings = SETTINGS.model_copy(
        update={"epochs": 5, "steps": 10, "learning_rate": 0.03, "dt": 0.05}
    )
    train_autopilot(
        "p",
        policy,
        VESSEL,
        settings,
        SpreadConfig(effect=(1.0, 1.0), time=(1.0, 1.0), bias=0.0),
        difference,
        0,
        tmp_path,
        teacher,
    )
    assert difference(policy) < 0.5 * before


def test_training_that_only_harms_leaves_the_start(tmp_path: Path) -> None:
    policy = fresh()
    start = {name: value.clone() for name, value in policy.state_dict().items()}
    before = settling(policy)
    wild = SETTINGS.model_copy(update={"epochs": 1, "learning_rate": 0.3})
    notes = train_autopilot("p", policy, VESSEL, wild, SpreadConfig(), settling, 0, tmp_path)
    assert notes["curve"][0]["validation"] > before == pytest.approx(notes["best_validation"])
    for name, value in policy.state_dict().items():
        assert torch.equal(value.float(), start[name].float())


def test_a_gradient_that_is_no_number_is_left_out(tmp_path: Path) -> None:
    """A flight whose gradient overflows must not spoil the weights."""
    policy = fresh()
    spoilt = [True]

    def once(gradient: torch.Tensor) -> torch.Tensor:
        return gradient * math.nan if spoilt and spoilt.pop() else gradient

    policy.law.register_hook(once)
    notes = train_autopilot("p", policy, VESSEL, SETTINGS, SpreadConfig(), settling, 0, tmp_path)
    assert not spoilt
    assert all(math.isfinite(entry["validation"]) for entry in notes["curve"])
    assert notes["curve"][0]["validation"] != notes["curve"][1]["validation"]
