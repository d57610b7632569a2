"""Trained policies on disk: the same commands again, and no code that runs when they are read."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from residnet.control.heading.stored import (
    HeadingPolicySpec,
    PredictorSpec,
    load_heading_policy,
)
from residnet.core.errors import UsageError
from residnet.dynamics.store import load_model, read_spec, read_weights, save_model

STATE = ("x", "y", "psi", "u", "v", "r", "delta")
SPEC = HeadingPolicySpec(
    state=STATE,
    gain=0.1,
    time=8.0,
    speed=7.0,
    limit=0.6,
    rate=None,
    dt=0.5,
    hidden=(6,),
    observer=8.0,
)


def test_a_policy_gives_the_same_commands_again(tmp_path: Path) -> None:
    torch.manual_seed(3)
    policy = SPEC.build()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    save_model(tmp_path / "mlp", SPEC, policy)
    again = load_heading_policy(tmp_path / "mlp")
    assert not any(parameter.requires_grad for parameter in again.parameters())
    policy = policy.double()
    x = torch.randn(5, len(STATE), dtype=torch.float64)
    x[:, 3] = 7.0
    reference = torch.randn(5, 1, dtype=torch.float64)
    given = policy(x, reference, policy.initial_state(x))
    for before, after in zip(given, again(x, reference, again.initial_state(x)), strict=True):
        assert torch.equal(before, after)


def test_a_predictor_keeps_double_precision(tmp_path: Path) -> None:
    spec = PredictorSpec(state=STATE, candidates=3, hidden=(4,), linear=False)
    network = spec.build()
    network.calibrate(
        torch.randn(9, len(STATE), dtype=torch.float64), torch.randn(9, 2, 3, dtype=torch.float64)
    )
    save_model(tmp_path / "net", spec, network)
    again = read_spec(tmp_path / "net", PredictorSpec).build()
    read_weights(tmp_path / "net", again)
    x = torch.randn(2, len(STATE), dtype=torch.float64)
    assert torch.equal(network.changes(x), again.changes(x))


def test_a_policy_is_no_vessel_model(tmp_path: Path) -> None:
    save_model(tmp_path / "mlp", SPEC, SPEC.build())
    with pytest.raises(UsageError, match=r"holds 'residnet.heading_policy/1', expected"):
        load_model(tmp_path / "mlp")


def test_a_damaged_policy_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path / "mlp", SPEC, SPEC.build())
    file = tmp_path / "mlp" / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(UsageError, match="SHA-256"):
        load_heading_policy(tmp_path / "mlp")
    with pytest.raises(UsageError, match="did you mean 'mlp'"):
        load_heading_policy(tmp_path / "mpl")
