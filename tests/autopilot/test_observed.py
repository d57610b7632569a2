"""Observer, predictor and the recurrent residual of observed heading policies."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from residnet.autopilot.heading.conditions import ClosedLoopSimulation, ConditionsConfig
from residnet.autopilot.heading.controllers import (
    ControlTask,
    NetworkPolicySpec,
    ObservedLqrConfig,
    ObserverPolicySpec,
    PtosConfig,
)
from residnet.autopilot.heading.policies import ObserverPolicy
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
STATE = ("psi", "u", "r")
RATES: dict[str, Any] = {
    "heading_rate": 2.0,
    "yaw_rate_rate": 5.0,
    "push_rate": 1.0,
    "cross_rate": 0.3,
}
PTOS = PtosConfig(lag=0.3, steepness=37.0, share=0.65, damping=0.88, **RATES)
LQR = ObservedLqrConfig(lag=0.3, heading_weight=4.0, rate_weight=1.0, **RATES)


def policy(
    units: int = 0, rate: float | None = None, law: PtosConfig | ObservedLqrConfig = PTOS
) -> ObserverPolicy:
    torch.manual_seed(4)
    spec = ObserverPolicySpec(
        state=STATE, gain=3.47, time=3.94, speed=3.2, limit=5 * DEG, rate=rate, dt=0.02,
        trained_at=0.04, law=law, units=units,
    )  # fmt: skip
    return spec.build().double().requires_grad_(False)


def measured(rows: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    drawn = torch.randn(2, rows, 1, generator=torch.Generator().manual_seed(seed)).double()
    return torch.cat((drawn[0], torch.full_like(drawn[0], 3.2), 0.2 * drawn[1]), dim=1), drawn[0]


def trained(units: int, rate: float | None = None) -> ObserverPolicy:
    """A policy whose network gives something."""
    made = policy(units, rate)
    with torch.no_grad():
        made.network.out.weight.normal_(generator=torch.Generator().manual_seed(1))
    return made


def test_the_predictor_is_the_model_run_forward_with_the_pending_commands() -> None:
    made = policy()
    observer = made.observer
    assert observer.n_pending == 15
    heading, r, push = (torch.full((3, 1), v).double() for v in (0.2, 0.1, 0.01))
    pending = 0.05 * torch.randn(3, 15, dtype=torch.float64)
    ratio = torch.tensor([[0.5], [1.0], [1.4]]).double()
    ahead, r_ahead = observer._predict_pending(heading, r, push, pending, ratio)
    for k in range(15):
        heading, r = observer.predict_step(heading, r, push, pending[:, k : k + 1], ratio)
    assert torch.allclose(ahead, heading, atol=1e-12)
    assert torch.allclose(r_ahead, r, atol=1e-12)


def network() -> Any:
    """A network without a law, which gives nothing yet."""
    torch.manual_seed(2)
    spec = NetworkPolicySpec(
        state=STATE, gain=3.47, time=3.94, speed=3.2, limit=5 * DEG, rate=10 * DEG, dt=0.02,
        trained_at=0.04, units=6,
    )  # fmt: skip
    return spec.build().double().requires_grad_(False)


@pytest.mark.parametrize("kind", ["at once", "rated", "network"])
def test_port_and_starboard_are_alike(kind: str) -> None:
    x, reference = measured(20)
    if kind == "network":
        made = network()
        assert float(made(x, reference, made.initial_state(x))[0].abs().max()) == 0.0, "amidships"
        made.network.out.weight.normal_(generator=torch.Generator().manual_seed(1))
    else:
        made = trained(8, 10 * DEG if kind == "rated" else None)
    mirrored = x * torch.tensor([-1.0, 1.0, -1.0])
    s, t = made.initial_state(x), made.initial_state(mirrored)
    for _ in range(30):
        one, s = made(x, reference, s)
        other, t = made(mirrored, -reference, t)
    assert torch.allclose(one, -other, atol=1e-9)
    assert 0.0 < float(one.abs().max()) <= 5 * DEG


def test_an_untrained_network_and_one_set_to_zero_are_the_law_itself() -> None:
    x, reference = measured(20)
    policies = [policy(), policy(16), trained(16).without_network(), trained(16)]
    states = [one.initial_state(x) for one in policies]
    for _ in range(20):
        moved = [one(x, reference, s) for one, s in zip(policies, states, strict=True)]
        (law, untrained, off, other), states = map(list, zip(*moved, strict=True))
        assert torch.equal(law, untrained)
        assert torch.equal(law, off)
    assert float((other - law).abs().max()) > 0


def test_a_jump_of_the_reference_and_full_turns_leave_the_estimate_alone() -> None:
    made = policy()
    x, reference = measured(5)
    turned = x + torch.tensor([4.0 * math.pi, 0.0, 0.0], dtype=torch.float64)
    s, t = made.initial_state(x), made.initial_state(turned)
    for k in range(40):
        jump = 1.0 if k > 20 else 0.0
        one, s = made(x, reference + jump, s)
        other, t = made(turned, reference + jump - 2.0 * math.pi, t)
    assert torch.allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("law", [PTOS, LQR])
def test_a_constant_push_is_taken_away(law: PtosConfig | ObservedLqrConfig) -> None:
    vessel = SteeredPlant(load_vessel("nomoto_oceanos").build())
    steering = ControlTask(vessel, NomotoModel(3.47, 3.94, 3.2), 5 * DEG, 0.05)
    pushed = ConditionsConfig(
        bias=DEG, push=0.0, noise_psi=0.0, noise_r=0.0, dt=0.05, duration=30.0, hold=0.0
    )
    changes = pushed.sample_steps(8, 0.05, torch.Generator().manual_seed(2))
    flown = ClosedLoopSimulation(vessel, law.build(steering), 0.05).simulate(changes)
    assert float(flown.error[:, -1].abs().max()) < 0.02 * DEG


def test_the_memory_does_not_depend_on_the_step_to_first_order() -> None:
    coarse = trained(8)
    fine = trained(8)
    cell = fine.network
    features = torch.randn(10, 11).double()
    memory = torch.zeros(10, 8, dtype=torch.float64)
    for _ in range(20):
        _, memory = cell(features, memory, 0.02)
    other = torch.zeros(10, 8, dtype=torch.float64)
    for _ in range(10):
        _, other = coarse.network(features, other, 0.04)
    assert float((memory - other).abs().max()) < 0.06 < float(memory.abs().max())


def test_missing_constants_are_named() -> None:
    with pytest.raises(ConfigError, match="without steepness, share, damping"):
        PtosConfig(**RATES).complete_parameters()
