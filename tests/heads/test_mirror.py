"""Mirrored heads: rho(M z) = M rho(z), to the last bits, over a sequence, stepped and scripted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import sampled
from torch import Tensor

from residnet.core.errors import ConfigError
from residnet.core.samples import Samples
from residnet.heads.base import ResidualHead
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig, MlpHead

CHANNELS = {
    "rudder": (("u", "v", "r", "n", "delta"), [0, 1, 2, 3, 4], [1, -1, -1, 1, -1]),
    "wind": (
        ("u", "v", "r", "n", "delta", "wind_u", "wind_v", "wind_mag"),
        [0, 1, 2, 3, 4, 5, 6, 7],
        [1, -1, -1, 1, -1, 1, -1, 1],
    ),
    "thrusters": (
        ("u", "v", "r", "n_port", "n_stbd", "tau_x", "tau_y", "tau_n"),
        [0, 1, 2, 4, 3, 5, 6, 7],
        [1, -1, -1, 1, 1, 1, -1, -1],
    ),
}
TURNED = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "mlp": (MlpConfig, {"hidden": (9, 7)}),
    "lstm": (LstmConfig, {"hidden_size": 6}),
    "lstm_readout": (LstmConfig, {"hidden_size": 5, "readout": 4, "memory": ("v", "r")}),
    "lstm_per_axis": (LstmConfig, {"hidden_size": 4, "per_axis": True, "activation": "softsign"}),
}


@pytest.fixture(params=CHANNELS)
def scene(request: pytest.FixtureRequest) -> tuple[tuple[str, ...], list[int], list[int]]:
    return CHANNELS[request.param]


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def samples(names: tuple[str, ...], count: int = 300) -> Samples:
    """All around starboard turns, so that a head without symmetry would lean to one side."""
    random = np.random.default_rng(2)
    z = torch.from_numpy(random.normal(size=(count, len(names))) + 0.7)
    target = torch.from_numpy(random.normal(size=(count, 3)) * [0.1, 0.05, 0.2])
    return sampled(z, target, names, t=torch.arange(count) * 0.1)


def built(kind: str, names: tuple[str, ...], **change: Any) -> ResidualHead:
    torch.manual_seed(4)
    config, settings = KINDS[kind]
    head: ResidualHead = config(**{"mirror": True, **settings, **change}).build(names)
    head.calibrate(samples(names))
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return head.double().eval()


def windows(names: tuple[str, ...], batch: int = 3, length: int = 20) -> Tensor:
    # beyond the training range too: the guard must be symmetric
    return torch.from_numpy(2.0 * np.random.default_rng(3).normal(size=(batch, length, len(names))))


def mirror(z: Tensor, index: list[int], sign: list[int]) -> Tensor:
    return z[..., index] * torch.tensor(sign, dtype=z.dtype)


def stepped(head: Any, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    out = []
    for k in range(z.shape[1]):
        rho, s = head(z[:, k], s)
        out.append(rho)
    return torch.stack(out, dim=1), s


def test_the_residual_in_the_mirror_is_the_mirror_of_the_residual(
    kind: str, scene: tuple[tuple[str, ...], list[int], list[int]]
) -> None:
    names, index, sign = scene
    head, z = built(kind, names), windows(names)
    empty = torch.zeros(len(z), head.n_state, dtype=z.dtype)
    with torch.no_grad():
        here, there = head.sequence(z), head.sequence(mirror(z, index, sign))
        torch.testing.assert_close(there, here * TURNED, rtol=0, atol=1e-15)
        step_here, _ = stepped(head, z, empty)
        step_there, _ = stepped(head, mirror(z, index, sign), empty)
        torch.testing.assert_close(step_there, step_here * TURNED, rtol=0, atol=1e-15)
        torch.testing.assert_close(step_here, here, rtol=0, atol=1e-12)
    assert float(here.abs().amax((0, 1)).min()) > 1e-3, (
        "a head that answers zero is symmetric by nature"
    )


def test_scales_are_those_of_both_sides() -> None:
    names, index, sign = CHANNELS["rudder"]
    head, known = built("mlp", names), samples(names)
    mlp = head.inner
    assert isinstance(mlp, MlpHead)
    inner = mlp.features
    both = torch.cat((known.z, mirror(known.z, index, sign)))
    torch.testing.assert_close(inner.mean, both.mean(0))
    torch.testing.assert_close(inner.std, both.std(0, correction=0))
    assert inner.mean[1] == pytest.approx(0.0, abs=1e-12)
    torch.testing.assert_close(inner.low[[1, 2, 4]], -inner.high[[1, 2, 4]])
    target = torch.cat((known.target, known.target * TURNED))
    torch.testing.assert_close(head.residual_std(), target.std(0, correction=0))


@pytest.mark.parametrize("config", [MlpConfig(mirror=True), LstmConfig(mirror=True)])
def test_unknown_channels_are_a_configuration_error(config: Any) -> None:
    for name in ("trim", "n_port"):
        with pytest.raises(ConfigError, match=f"mirror.*{name}.*leave `mirror` out"):
            config.build(("u", "v", "r", name))
