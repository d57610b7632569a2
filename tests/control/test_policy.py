"""The neural heading policy: symmetric, without steady error, exported with its checks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import SteeredPlant, fly
from residnet.export import exporter
from residnet.export.policy import ExportedHeading, ExportedPolicy, for_export
from residnet.physics.vessel import load_vessel

LIMIT = math.radians(5)
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
TURNING = VESSEL.turning(LIMIT, 60.0)


def untrained(seed: int = 0, **settings: Any) -> HeadingPolicy:
    torch.manual_seed(seed)
    policy = HeadingPolicy(VESSEL.state, turning=TURNING, limit=LIMIT, dt=0.05, **settings)
    with torch.no_grad():
        for parameter in policy.network.parameters():
            parameter.copy_(0.1 * torch.randn_like(parameter))
    return policy.requires_grad_(False)


def test_turning_finds_nomotos_constants() -> None:
    assert TURNING.gain == pytest.approx(3.47, rel=1e-6)
    assert TURNING.time == pytest.approx(3.94, rel=1e-4)
    assert TURNING.speed == 3.2


def test_port_mirrors_starboard() -> None:
    policy = untrained().double()
    x = torch.randn(50, len(VESSEL.state), dtype=torch.float64) * 0.3
    x[:, VESSEL.column("u")] = 3.2
    mirrored = x.clone()
    for name in ("psi", "r"):
        mirrored[:, VESSEL.column(name)] *= -1
    sign = torch.tensor([-1.0] * 4 + [1.0] * 5, dtype=torch.float64)
    reference = torch.randn(50, 1, dtype=torch.float64)
    s = policy.initial_state(x) + 0.01 * torch.randn(50, 9, dtype=torch.float64)
    mirrored_s = s * sign
    command, after = policy(x, reference, s)
    other, other_after = policy(mirrored, -reference, mirrored_s)
    assert torch.allclose(command, -other, atol=1e-12)
    assert torch.allclose(after, sign * other_after, atol=1e-12)
    assert command.abs().max() <= LIMIT


@pytest.mark.parametrize("bias", [-2.0, 1.0])
def test_a_constant_push_leaves_no_error_whatever_the_weights(bias: float) -> None:
    flights = fly(
        VESSEL,
        untrained(),
        torch.tensor([0.2]),
        torch.tensor([[0.9, 1.1, math.radians(bias)]]),
        dt=0.05,
        duration=120.0,
    )
    assert abs(float(flights.error[0, -1])) < 1e-6
    assert float(flights.inputs[0, -1, 0]) == pytest.approx(-math.radians(bias) / 0.9, rel=1e-4)


def exported(tmp_path: Path, policy: HeadingPolicy) -> tuple[ExportedPolicy, object]:
    file = tmp_path / "policy.pt"
    made = ExportedHeading("policy", policy, safe="amidships", about={}, metrics=[])
    card = exporter("torchscript").export(made, file)
    assert card["dt"] == 0.05
    return for_export(policy, "amidships"), torch.jit.load(str(file))


def test_exported_policy_gives_the_same_commands(tmp_path: Path) -> None:
    _, module = exported(tmp_path, untrained())
    policy = untrained().float()
    x = torch.zeros(1, len(VESSEL.state))
    x[:, VESSEL.column("u")] = 3.2
    y = torch.tensor([[0.0, 3.2, 0.0]])
    s, memory = policy.initial_state(x), module.initial_state(y)  # type: ignore[attr-defined]
    for k in range(50):
        x[:, VESSEL.column("psi")] = y[:, 0] = 0.004 * k
        x[:, VESSEL.column("r")] = y[:, 2] = 0.08
        command, s = policy(x, torch.tensor([[0.1]]), s)
        theirs, memory, fault = module.step(y, torch.tensor([[0.1]]), memory)  # type: ignore[attr-defined]
        assert torch.allclose(command, theirs, atol=1e-6)
        assert not fault.any()


WRONG = [
    ([math.nan, 3.2, 0.0], 0.1),
    ([0.0, math.inf, 0.0], 0.1),
    ([0.0, 3.2, -math.inf], 0.1),
    ([0.0, -1.0, 0.0], 0.1),
    ([0.0, 3.2, 50.0], 0.1),
    ([1e9, 3.2, 0.0], 0.1),
    ([0.0, 3.2, 0.0], math.nan),
    ([0.0, 3.2, 0.0], 1e9),
]


@pytest.mark.parametrize(("measured", "reference"), WRONG)
@pytest.mark.parametrize("safe", ["hold", "amidships"])
def test_wrong_inputs_bring_the_safe_command_and_a_flag(
    measured: list[float], reference: float, safe: str
) -> None:
    module = for_export(untrained(rate=0.2), safe)  # type: ignore[arg-type]
    good = torch.tensor([[0.0, 3.2, 0.0]])
    s = module.initial_state(good)
    for _ in range(20):
        last, s, _ = module.step(good, torch.tensor([[0.5]]), s)
    command, after, fault = module.step(torch.tensor([measured]), torch.tensor([[reference]]), s)
    assert fault.all()
    expected = last if safe == "hold" else last - last.clamp(-0.2 * 0.05, 0.2 * 0.05)
    assert torch.allclose(command, expected)
    assert torch.equal(after[:, :9], s[:, :9])
    again, _, fault = module.step(good, torch.tensor([[0.5]]), after)
    assert torch.isfinite(again).all()
    assert not fault.any()


def test_a_spoilt_memory_is_given_up() -> None:
    module = for_export(untrained(), "amidships")
    s = torch.full((1, 10), math.nan)
    command, after, fault = module.step(torch.tensor([[0.0, 3.2, 0.0]]), torch.tensor([[0.1]]), s)
    assert fault.all()
    assert torch.isfinite(command).all()
    assert torch.isfinite(after).all()


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e38, -1e30, 1e6, -40.0])
@pytest.mark.parametrize("place", range(10))
def test_a_memory_out_of_range_brings_the_safe_command_and_a_flag(place: int, wrong: float) -> None:
    module = for_export(untrained(rate=0.2), "amidships")
    good, reference = torch.tensor([[0.0, 3.2, 0.05]]), torch.tensor([[0.5]])
    s = module.initial_state(good)
    for _ in range(20):
        last, s, fault = module.step(good, reference, s)
        assert not fault.any()
    spoilt = s.clone()
    spoilt[0, place] = wrong
    command, after, fault = module.step(good, reference, spoilt)
    assert fault.all()
    # towards amidships at the rudder's rate, from where the last command was if that is known
    kept = (
        {True: 0.0, False: max(-LIMIT, min(LIMIT, wrong))}[math.isnan(wrong)]
        if place == 9
        else float(last)
    )
    assert float(command) == pytest.approx(kept - max(-0.01, min(0.01, kept)), abs=1e-7)
    # the memory begins anew, and the next step is as good as ever
    assert torch.allclose(after[:, :9], module.initial_state(good)[:, :9])
    again, _, fault = module.step(good, reference, after)
    assert not fault.any()
    assert torch.isfinite(again).all()


def test_no_flight_leaves_the_memory_s_range() -> None:
    """Flights of all corners under bias, hard turns at a third of the speed and at three times:
    what is remembered is never taken for wrong.
    """
    module = for_export(untrained(rate=0.2), "amidships")
    torch.manual_seed(1)
    rows = 64
    y = torch.zeros(rows, 3)
    y[:, 1] = torch.linspace(0.0, 9.5, rows)
    s = module.initial_state(y)
    top = float(module.high[2])
    for k in range(400):
        y[:, 2] = (0.98 * top * torch.sin(torch.tensor(0.05 * k)) * torch.rand(rows)).clamp(
            -top, top
        )
        y[:, 0] = 3.0 * torch.randn(rows)
        _, s, fault = module.step(y, torch.randn(rows, 1), s)
        assert not fault.any()


def test_commands_keep_the_rudders_rate() -> None:
    module = for_export(untrained(rate=0.1), "hold")
    s = module.initial_state(torch.tensor([[0.0, 3.2, 0.0]]))
    last: Tensor = torch.zeros(1, 1)
    for k in range(40):
        command, s, _ = module.step(
            torch.tensor([[0.0, 3.2, 0.0]]), torch.tensor([[0.5 if k < 20 else -0.5]]), s
        )
        assert float((command - last).abs()) <= 0.1 * 0.05 + 1e-7
        last = command
    assert float(last) < 0
