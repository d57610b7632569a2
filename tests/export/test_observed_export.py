"""Exported observed policies: closed loop with delay and noise, and measurements that fail."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from residnet.control.observed.config import PtosConfig
from residnet.control.observed.policy import FIXED, ObservedPolicy
from residnet.control.observed.stored import NetworkPolicySpec, ObservedPolicySpec
from residnet.export.autopilot import export_autopilot
from residnet.export.c.policy import export_autopilot_as_c

DEG = math.pi / 180
DT, GAIN, TIME, SPEED = 0.02, 3.47, 3.94, 3.2
LAW = PtosConfig(
    lag=0.3, steepness=37.0, share=0.65, damping=0.88, heading_rate=2.0, yaw_rate_rate=5.0,
    push_rate=1.0, cross_rate=0.3,
)  # fmt: skip


def policy(rate: float | None) -> ObservedPolicy:
    torch.manual_seed(0)
    made = ObservedPolicySpec(
        state=("psi", "u", "r"), gain=GAIN, time=TIME, speed=SPEED, limit=5 * DEG, rate=rate,
        dt=DT, trained_at=0.04, law=LAW, units=4,
    ).build().requires_grad_(False)  # fmt: skip
    made.network.out.weight.normal_(std=0.02)
    return made


@pytest.fixture(scope="module", params=[None, 10 * DEG])
def module(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    file: Path = tmp_path_factory.mktemp("observed") / "policy.pt"
    export_autopilot("p", policy(request.param), file, safe="amidships", about={}, metrics=[])
    return torch.jit.load(str(file))


def flown(
    module: Any, seconds: float, *, delay: int = 10, gap: tuple[float, float] = (0.0, 0.0)
) -> tuple[list[float], list[float], list[bool]]:
    """Headings, commands and flags of a loop with delay, noise and half a degree of bias."""
    random = torch.Generator().manual_seed(2)
    psi = r = 0.0
    late = [0.0] * delay
    decay = math.exp(-DT / TIME)
    s = module.initial_state(torch.tensor([[0.0, SPEED, 0.0]]))
    headings, commands, flags = [], [], []
    for k in range(round(seconds / DT)):
        noise = (0.1 * DEG * torch.randn(2, generator=random)).tolist()
        y = torch.tensor([[psi + noise[0], SPEED, r + noise[1]]])
        if gap[0] <= k * DT < gap[1]:
            y[0, 0] = torch.nan
        command, s, fault = module.step(y, torch.tensor([[30 * DEG]]), s)
        late.append(float(command))
        steady = GAIN * (late.pop(0) + 0.5 * DEG)
        psi += steady * DT + (r - steady) * TIME * (1 - decay)
        r = steady + (r - steady) * decay
        headings.append(psi)
        commands.append(float(command))
        flags.append(bool(fault[0]))
    return headings, commands, flags


@pytest.mark.long
def test_it_settles_with_delay_noise_and_bias(module: Any) -> None:
    headings, commands, flags = flown(module, 16.0)
    assert not any(flags)
    late = torch.tensor(headings[-300:]) - 30 * DEG
    assert float(late.abs().max()) < 1.0 * DEG
    assert max(map(abs, commands)) <= 5 * DEG * 1.0001


@pytest.mark.long
def test_it_flags_a_gap_and_takes_up_the_course_after_it(module: Any) -> None:
    """The vessel turns on for two seconds without measurements; afterwards the push is no worse
    than before and the heading comes back.
    """
    headings, commands, flags = flown(module, 24.0, gap=(1.5, 3.5))
    gap = [1.5 <= k * DT < 3.5 for k in range(len(flags))]
    assert flags == gap
    assert all(math.isfinite(value) for value in commands)
    assert abs(headings[-1] - 30 * DEG) < 1.0 * DEG


def test_it_is_written_as_c(tmp_path: Path) -> None:
    """With its queue of pending commands and the memory of its network."""
    card = {"dt": DT, "parity": {"steps": 1000}}
    file = tmp_path / "pilot.c"
    export_autopilot_as_c("pilot", policy(10 * DEG), file, safe="amidships", card=card)
    stored = json.loads((tmp_path / "pilot.card.json").read_text())
    assert stored["parity"]["share_of_limit"] <= 1e-4
    assert "PILOT_SIZE_S" in (tmp_path / "pilot.h").read_text()


def test_a_network_without_a_law_is_written_as_c(tmp_path: Path) -> None:
    torch.manual_seed(0)
    made = NetworkPolicySpec(
        state=("psi", "u", "r"), gain=GAIN, time=TIME, speed=SPEED, limit=5 * DEG, rate=10 * DEG,
        dt=DT, trained_at=0.04, units=4,
    ).build().requires_grad_(False)  # fmt: skip
    made.network.out.weight.normal_(std=0.5)
    card = {"dt": DT, "parity": {"steps": 1000}}
    export_autopilot_as_c("pilot", made, tmp_path / "pilot.c", safe="amidships", card=card)
    stored = json.loads((tmp_path / "pilot.card.json").read_text())
    assert stored["parity"]["share_of_limit"] <= 1e-4


def test_a_lost_estimate_begins_anew_and_keeps_the_push() -> None:
    made = policy(None).double()
    x = torch.tensor([[0.0, SPEED, 0.0]], dtype=torch.float64)
    s = made.initial_state(x)
    s[:, FIXED.index("push")] = 0.01
    turned = torch.tensor([[2.0, SPEED, 0.1]], dtype=torch.float64)
    _, after = made(turned, torch.full((1, 1), 2.0, dtype=torch.float64), s)
    assert float(after[0, FIXED.index("push")]) == pytest.approx(0.01)
    assert float(after[0, FIXED.index("heading")]) == pytest.approx(2.0, abs=0.01)
