"""The LSTM head: one set of weights, stepped and over sequences, against torch.nn.LSTM and a NumPy
cell.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_samples import NAMES, channels, made
from torch import nn

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.heads.lstm import LstmConfig, LstmCore, LstmHead


def built(**config: object) -> LstmHead:
    torch.manual_seed(0)
    head = LstmConfig.model_validate({"kind": "lstm", "hidden_size": 12, **config}).build(NAMES)
    assert isinstance(head, LstmHead)
    head.calibrate(made())
    return head.double().eval()


def windows(batch: int = 3, length: int = 25) -> torch.Tensor:
    return torch.from_numpy(channels(batch * length, seed=9).reshape(batch, length, len(NAMES)))


def stepped(head: LstmHead, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    s = torch.zeros(len(z), head.n_state, dtype=z.dtype)
    out = []
    for k in range(z.shape[1]):
        rho, s = head(z[:, k], s)
        out.append(rho)
    return torch.stack(out, dim=1), s


def test_core_equals_torch_lstm() -> None:
    core, z = LstmCore(4, 10, softsign=False).double(), torch.randn(5, 30, 4, dtype=torch.float64)
    other = nn.LSTM(4, 10, batch_first=True).double()
    with torch.no_grad():
        core.bias.uniform_(-0.5, 0.5)
        weights = dict(other.named_parameters())
        weights["weight_ih_l0"].copy_(core.w_input)
        weights["weight_hh_l0"].copy_(core.w_hidden)
        weights["bias_ih_l0"].copy_(core.bias)
        weights["bias_hh_l0"].zero_()
        out, (h, c) = other(z)
        mine, s = core.sequence(z)
    torch.testing.assert_close(mine, out, rtol=0, atol=1e-12)
    torch.testing.assert_close(s, torch.cat((h[0], c[0]), dim=1), rtol=0, atol=1e-12)


def test_softsign_cell_equals_numpy() -> None:
    """Document 003 eq. (17): softsign in place of tanh, the gates stay logistic."""
    core, z = LstmCore(3, 6, softsign=True).double(), torch.randn(2, 8, 3, dtype=torch.float64)
    wi, wh, b = (
        core.w_input.detach().numpy(),
        core.w_hidden.detach().numpy(),
        core.bias.detach().numpy(),
    )
    h, c = np.zeros((2, 6)), np.zeros((2, 6))

    def softsign(x: np.ndarray) -> np.ndarray:
        return x / (1 + np.abs(x))

    def logistic(x: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-x))

    outputs = []
    for k in range(8):
        i, f, g, o = np.split(z[:, k].numpy() @ wi.T + h @ wh.T + b, 4, axis=1)
        c = logistic(f) * c + logistic(i) * softsign(g)
        h = logistic(o) * softsign(c)
        outputs.append(h)
    with torch.no_grad():
        out, s = core.sequence(z)
    np.testing.assert_allclose(out, np.stack(outputs, axis=1), atol=1e-13)
    np.testing.assert_allclose(s, np.concatenate((h, c), axis=1), atol=1e-13)


def test_parameters_of_the_document_s_network() -> None:
    """4 * 100 * (4 + 100 + 1) + 101 = 42,101 for each of surge, sway, yaw (correction W4)."""
    head = LstmConfig(hidden_size=100, per_axis=True, features=("u", "v", "r", "tau_n")).build(
        NAMES
    )
    assert isinstance(head, LstmHead)
    counts = [sum(p.numel() for p in network.parameters()) for network in head.networks]
    assert counts == [42_101] * 3
    assert head.n_state == 600


def test_axes_of_their_own_are_independent() -> None:
    config = {
        "per_axis": True,
        "axis_features": {"u": ("u", "tau_x"), "v": ("v", "r"), "r": ("r", "tau_n", "v")},
    }
    head, z = built(**config), windows()
    with torch.no_grad():
        before = head.sequence(z)
        changed = z.clone()
        changed[..., 3] += 50.0
        after = head.sequence(changed)
    assert bool((before[..., 0] != after[..., 0]).any())
    assert torch.equal(before[..., 1:], after[..., 1:])


def test_gradients_of_the_sequence_are_those_of_the_steps() -> None:
    for activation in ("tanh", "softsign"):
        head, z = built(activation=activation), windows(2, 10)
        grads = []
        for run in (lambda h, x: h.sequence(x), lambda h, x: stepped(h, x)[0]):
            head.zero_grad()
            run(head, z).square().sum().backward()
            grads.append([p.grad.clone() for p in head.parameters() if p.grad is not None])
        assert len(grads[0]) == len(list(head.parameters()))
        for a, b in zip(*grads, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"axis_features": {"u": ["u"], "v": ["v"], "r": ["r"]}}, "needs per_axis"),
        ({"per_axis": True, "axis_features": {"u": ["u"]}}, "all of u, v, r"),
        ({"memory": [NAMES[-1]]}, "readout"),
    ],
)
def test_wrong_configs(config: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate({"kind": "lstm", **config}, LstmConfig, "here")


def test_a_memory_of_chosen_features_ignores_the_others() -> None:
    head = built(memory=(NAMES[-1],), readout=5)
    z = windows()
    other = z.clone()
    other[:, :, : len(NAMES) - 1] += 0.1
    assert torch.equal(head.warmup(z), head.warmup(other))
    assert not torch.equal(head.sequence(z), head.sequence(other))
