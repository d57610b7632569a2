"""The time loop: batches, stopping rows, gradients, memory; the hybrid model against the matrix
exponential.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor, nn

from residnet.baselines.regressors import RegressorBaseline
from residnet.dynamics.base import Integrator
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, Source
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.lstm import LstmConfig
from residnet.physics.signals import SignalsConfig

A = np.array([[-0.5, 0.0, 0.0], [0.0, -0.6, -0.4], [0.0, 0.2, -0.9]])
B = np.array([[0.003, 0.0], [0.0, 0.0004], [0.0, 0.002]])
C = np.array([0.1, 0.01, -0.02])


def linear(
    dt: float = 0.1, head: ResidualHead | None = None, integrator: Integrator = "rk4"
) -> HybridDynamics:
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    baseline = RegressorBaseline([("u", "v", "r", "tau_x", "tau_n", "1")] * 3, signals.names)
    baseline.theta.data.copy_(torch.from_numpy(np.concatenate((A, B, C[:, None]), axis=1)))
    return HybridDynamics(signals, baseline, head or ZeroHead(), dt, integrator)


def inputs(batch: int, steps: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).normal(size=(batch, steps, 2)) * [200, 100])


def starts(batch: int) -> Tensor:
    return torch.from_numpy(
        np.random.default_rng(1).normal(size=(batch, 6)) * [10, 10, 1, 1, 0.3, 0.2]
    )


def lstm_model() -> HybridDynamics:
    torch.manual_seed(0)
    model = linear(head=LstmConfig(hidden_size=8).build(("u", "v", "r", "tau_x", "tau_n")))
    with torch.no_grad():
        model.head.scale.spread.fill_(0.3)  # type: ignore[operator, union-attr]
    return model.double().eval()


def test_linear_baseline_equals_the_matrix_exponential() -> None:
    """ZeroHead on a linear baseline: velocities by exact zero-order-hold discretisation."""
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:5], block[:3, 5] = A, B, C
    dt = 0.05
    exact = expm(block * dt)
    x0, w = starts(4), inputs(4, 100)
    with torch.no_grad():
        states, applied, _ = Rollout(linear(dt))(x0, w, x0[:, :0])
    assert torch.equal(applied, w)
    nu = x0[:, 3:].numpy()
    for k in range(100):
        nu = (np.concatenate((nu, w[:, k].numpy(), np.ones((4, 1))), axis=1) @ exact.T)[:, :3]
        np.testing.assert_allclose(states[:, k + 1, 3:], nu, atol=2e-8)


def test_heading_and_position_follow_the_velocities() -> None:
    """Constant velocities: a circle of radius U / r."""
    model = linear()
    model.baseline.theta.data.zero_()  # type: ignore[union-attr, operator]
    x0 = torch.tensor([[1.0, 2.0, 0.5, 2.0, 0.0, 0.1]], dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(model)(x0, torch.zeros(1, 300, 2, dtype=torch.float64), x0[:, :0])
    t = 0.1 * np.arange(301)
    psi = 0.5 + 0.1 * t
    np.testing.assert_allclose(states[0, :, 2], psi, atol=1e-12)
    np.testing.assert_allclose(states[0, :, 0], 1 + 20 * (np.sin(psi) - np.sin(0.5)), atol=1e-8)
    np.testing.assert_allclose(states[0, :, 1], 2 - 20 * (np.cos(psi) - np.cos(0.5)), atol=1e-8)


def test_batch_equals_row_by_row() -> None:
    model, x0, w = lstm_model(), starts(5), inputs(5, 40)
    s = torch.from_numpy(np.random.default_rng(2).normal(size=(5, model.n_state)) * 0.2)
    with torch.no_grad():
        whole = Rollout(model)(x0, w, s)
        for i in range(5):
            for part, row in zip(
                whole, Rollout(model)(x0[i : i + 1], w[i : i + 1], s[i : i + 1]), strict=True
            ):
                torch.testing.assert_close(part[i : i + 1], row, rtol=1e-11, atol=1e-12)


def test_a_run_in_two_parts_is_the_whole_run() -> None:
    model, x0, w = lstm_model(), starts(3), inputs(3, 30)
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


class StopAt(Source):
    """Inputs as they are given; rows stop once they are `distance` [B] north of the origin."""

    def __init__(self, distance: Tensor) -> None:
        super().__init__()
        self.may_stop = True
        self.distance = distance

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        return w, memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        return x[:, 0] >= self.distance


def test_rows_stop_on_their_own() -> None:
    model = linear()
    x0 = torch.zeros(3, 6, dtype=torch.float64)
    x0[:, 3] = 1.0
    w = torch.zeros(3, 60, 2, dtype=torch.float64)
    w[:, :, 0] = 100.0
    with torch.no_grad():
        free, _, _ = Rollout(model)(x0, w, x0[:, :0])
        states, _, _ = Rollout(model, StopAt(torch.tensor([1.0, 3.0, 1e9], dtype=torch.float64)))(
            x0, w, x0[:, :0]
        )
    for i, distance in enumerate((1.0, 3.0, 1e9)):
        over = torch.nonzero(free[i, :, 0] >= distance)
        last = int(over[0]) if over.numel() else 60
        assert torch.equal(states[i, : last + 1], free[i, : last + 1])
        assert torch.equal(states[i, last:], free[i, last].expand(61 - last, -1))
    assert not torch.equal(states[0, -1], states[1, -1])


@pytest.mark.parametrize("integrator", ["rk4", "heun", "euler", "semi_implicit_euler"])
def test_gradients_flow_through_a_run(integrator: Integrator) -> None:
    model = linear(integrator=integrator)
    x0, w = starts(2), inputs(2, 6)

    def end(x: Tensor, u: Tensor) -> Tensor:
        return Rollout(model)(x, u, x[:, :0])[0][:, -1]

    assert torch.autograd.gradcheck(end, (x0.requires_grad_(), w.requires_grad_()))


def test_gradients_reach_every_weight_and_the_initial_memory() -> None:
    model, x0, w = lstm_model(), starts(2), inputs(2, 15)
    s = torch.zeros(2, model.n_state, dtype=torch.float64, requires_grad=True)
    states, _, _ = Rollout(model)(x0, w, s)
    states[:, -1, 3:].square().sum().backward()
    for name, parameter in [*model.head.named_parameters(), ("s", s)]:
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert float(parameter.grad.abs().max()) > 0, name
    # and they are right: finite differences of one weight
    weight = model.head.networks[0].core.w_hidden  # type: ignore[union-attr, index]
    assert isinstance(weight, nn.Parameter)
    slope, step = float(weight.grad[0, 0]), 1e-6  # type: ignore[index]
    losses = []
    with torch.no_grad():
        for sign in (1, -1):
            weight[0, 0] += sign * step
            losses.append(float(Rollout(model)(x0, w, s)[0][:, -1, 3:].square().sum()))
            weight[0, 0] -= sign * step
    assert slope == pytest.approx((losses[0] - losses[1]) / (2 * step), rel=1e-5)


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
