"""The time loop: batches, memory, what does not hang on positions; the hybrid model against the
matrix exponential.
"""

from __future__ import annotations

import copy
from typing import Any, get_args

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.layout import HEADING, MOTION, POSITION
from residnet.dynamics.ensemble import SampledDynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.time_steps import Integrator
from residnet.engine.rollout import Rollout
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.lstm_config import LstmConfig
from residnet.heads.recurrent_config import GRUEnsembleConfig
from residnet.physics.signals_config import SignalsConfig

A = np.array([[-0.5, 0.0, 0.0], [0.0, -0.6, -0.4], [0.0, 0.2, -0.9]])
B = np.array([[0.003, 0.0], [0.0, 0.0004], [0.0, 0.002]])
C = np.array([0.1, 0.01, -0.02])


def linear(dt: float = 0.1, head: ResidualHead | None = None) -> HybridDynamics:
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    baseline = RegressorBaseline([("u", "v", "r", "tau_x", "tau_n", "1")] * 3, signals.names)
    baseline.theta.data.copy_(torch.from_numpy(np.concatenate((A, B, C[:, None]), axis=1)))
    return HybridDynamics(signals, baseline, head or ZeroHead(), dt, "rk4")


def inputs(batch: int, steps: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=(batch, steps, 2)) * [200, 100])


def starts(batch: int) -> Tensor:
    return torch.from_numpy(
        np.random.default_rng(1).normal(size=(batch, 6)) * [10, 10, 1, 1, 0.3, 0.2]
    )


def lstm_model() -> HybridDynamics:
    torch.manual_seed(0)
    config = LstmConfig(hidden_size=8, skip="none")
    model = linear(head=config.build(("u", "v", "r", "tau_x", "tau_n")))
    with torch.no_grad():
        model.head.scale.std.fill_(0.3)  # type: ignore[operator, union-attr]
    return model.double().eval()


def test_linear_baseline_equals_the_matrix_exponential() -> None:
    """ZeroHead on a linear baseline: velocities by exact zero-order-hold discretisation."""
    block = np.zeros((6, 6))
    dt = 0.05
    block[:3, :3], block[:3, 3:5], block[:3, 5] = A, B, C
    exact = expm(block * dt)
    x0, w = starts(4), inputs(4, 100)
    with torch.no_grad():
        states, applied, _ = Rollout(linear(dt))(x0, w, x0[:, :0])
    assert torch.equal(applied, w)
    nu = x0[:, 3:].numpy()
    for k in range(100):
        nu = (np.concatenate((nu, w[:, k].numpy(), np.ones((4, 1))), axis=1) @ exact.T)[:, :3]
        np.testing.assert_allclose(states[:, k + 1, 3:], nu, atol=2e-8)


def test_a_run_in_two_parts_is_the_whole_run() -> None:
    model = lstm_model()
    x0 = starts(3)
    w = inputs(3, 30)
    s = model.initial_state(3).double()
    with torch.no_grad():
        states, _, last = Rollout(model)(x0, w, s)
        first, _, between = Rollout(model)(x0, w[:, :11], s)
        second, _, end = Rollout(model)(first[:, -1], w[:, 11:], between)
    assert torch.equal(torch.cat((first, second[:, 1:]), dim=1), states)
    assert torch.equal(end, last)


def test_the_head_is_asked_once_per_step_and_held() -> None:
    class Counting(ResidualHead):
        calls = 0

        def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            Counting.calls += 1
            return z[..., :3] * 0.0 + 0.7, s

    model = linear(head=Counting())
    model.baseline.theta.data.zero_()  # type: ignore[union-attr, operator]
    x0 = torch.zeros(1, 6, dtype=torch.float64)
    states, _, _ = Rollout(model)(x0, torch.zeros(1, 10, 2, dtype=torch.float64), x0[:, :0])
    assert Counting.calls == 10
    np.testing.assert_allclose(states[0, :, 3], 0.07 * np.arange(11), atol=1e-12)


def test_warm_up_is_the_memory_that_the_past_leaves() -> None:
    """Along measured states the memory after a warm-up is that of stepping the head."""
    model = lstm_model()
    y, w = torch.randn(3, 9, 6, dtype=torch.float64) * 0.3, inputs(3, 9)
    s = torch.zeros(3, model.n_state, dtype=torch.float64)
    with torch.no_grad():
        for k in range(9):
            _, s = model.step(y[:, k], w[:, k], s)
        torch.testing.assert_close(model.warmup(y, w), s, rtol=1e-9, atol=1e-12)
        assert torch.equal(model.warmup(y[:, :0], w[:, :0]), torch.zeros_like(s))


def test_each_draw_steps_as_the_model_with_its_parameters() -> None:
    model = linear().double()
    theta = 0.3 * torch.randn(4, 3, 6, dtype=torch.float64)
    x, w = starts(12), inputs(12, 1)[:, 0]
    with torch.no_grad():
        after, memory = SampledDynamics(model, "baseline.theta", theta).step(x, w, x[:, :0])
        for row in range(12):
            alone: Any = copy.deepcopy(model)
            alone.baseline.theta.copy_(theta[row % 4])
            one = slice(row, row + 1)
            torch.testing.assert_close(after[one], alone.step(x[one], w[one], x[:1, :0])[0])
    assert memory.shape == (12, 0)


STEP = 0.05
TERMS = {"linear": ["u", "v", "r", "a", "b"], "nonlinear": ["u", "v|v|", "r", "a", "u b"]}


@pytest.mark.parametrize("integrator", get_args(Integrator))
@pytest.mark.parametrize(
    ("terms", "wind", "told"),
    [
        ("linear", False, False),
        ("nonlinear", True, False),
        ("linear", True, True),
        ("nonlinear", False, True),
    ],
)
def test_heading_and_velocities_do_not_hang_on_positions(
    integrator: Integrator, terms: str, wind: bool, told: bool
) -> None:
    torch.manual_seed(3)
    exogenous = ("wind_speed", "wind_dir") if wind else ()
    signals = SignalsConfig(inputs=("a", "b"), exogenous=exogenous).build()
    names = [*TERMS[terms], "wind_u", "wind_v"] if wind else TERMS[terms]
    baseline = RegressorBaseline([names] * 3, signals.names)
    baseline.theta.data.copy_(0.3 * torch.randn(3, len(names)) - 0.6 * torch.eye(3, len(names)))
    kind = GRUEnsembleConfig(members=1, hidden_size=6, step=STEP) if told else LstmConfig()
    head = kind.build(signals.names)
    model = HybridDynamics(signals, baseline, head, STEP, integrator).double().eval()
    assert (model.innovation_filter is not None) == told
    x0 = torch.randn(5, 6, dtype=torch.float64)
    w = torch.randn(5, 20, 4 if wind else 2, dtype=torch.float64)
    slopes = []
    states = []
    for model.has_position in (True, False):
        held = w.clone().requires_grad_(True)
        x, _, _ = Rollout(model)(x0, held, model.initial_state(5).double())
        slopes.append(torch.autograd.grad(x[:, -1, HEADING : MOTION.stop].square().sum(), held)[0])
        states.append(x.detach())
    whole, alone = (x[..., HEADING : MOTION.stop] for x in states)
    assert float(whole.diff(dim=1).abs().max()) > 0.01
    torch.testing.assert_close(alone, whole, rtol=0, atol=1e-13)
    torch.testing.assert_close(*slopes, rtol=0, atol=1e-13)
    assert torch.equal(states[1][..., POSITION], x0[:, None, POSITION].expand(5, 21, 2))
