"""The losses against sums written out in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kinds import of_kind
from made_system import LINEAR, STEP, inputs, model_of
from torch import Tensor, nn

from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.heads.mlp import MlpConfig, MlpHead
from residnet.training.heads import one_step_loss, rollout_loss

A = np.array([[-0.4, 0.1, 0.0], [0.0, -0.9, -0.2], [0.05, 0.1, -0.8]])
B = np.array([[1.0, 0.0], [0.0, 0.1], [0.0, 1.0]])
C = np.array([0.02, -0.01, 0.03])
THETA = torch.from_numpy(np.concatenate((C[:, None], A, B), axis=1))
BATCH, STEPS = 5, 12
RANDOM = np.random.default_rng(0)
Y = torch.from_numpy(RANDOM.normal(size=(BATCH, STEPS, 6)))
W = inputs(BATCH, STEPS, 1)
NU_DOT = torch.from_numpy(RANDOM.normal(size=(BATCH, STEPS, 3)))
COUNTED = torch.from_numpy(RANDOM.random((BATCH, STEPS)) < 0.6)
X0 = torch.from_numpy(RANDOM.normal(size=(BATCH, 6)) * 0.3)
S = torch.zeros(BATCH, 0, dtype=torch.float64)
SCALES = torch.tensor([0.5, 0.2, 0.3], dtype=torch.float64)


def with_mlp() -> HybridDynamics:
    torch.manual_seed(0)
    return model_of(
        LINEAR, THETA, MlpConfig(hidden=(5,)).build(("u", "v", "r", "tau_x", "tau_n"))
    ).double()


def layers(model: HybridDynamics) -> tuple[nn.Linear, nn.Linear]:
    """The hidden and the last layer of the head."""
    net = of_kind(model.head, MlpHead).net
    return of_kind(net[0], nn.Linear), of_kind(net[2], nn.Linear)


def by_euler() -> np.ndarray:
    """Velocities [B, T, 3] after each step of the linear model, by the explicit Euler rule."""
    nu, out = X0[:, 3:].numpy(), []
    for k in range(STEPS):
        nu = nu + STEP * (nu @ A.T + W[:, k].numpy() @ B.T + C)
        out.append(nu)
    return np.stack(out, axis=1)


def one_step(model: HybridDynamics, nu_dot: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    z = model.channels(Y, W)
    return one_step_loss(model, z, model.known(z), nu_dot, counted, SCALES)


def euler() -> Rollout:
    linear = model_of(LINEAR, THETA)
    return Rollout(HybridDynamics(linear.signals, linear.baseline, linear.head, STEP, "euler"))


def test_one_step_loss_is_the_mean_square_over_what_counts() -> None:
    model = with_mlp()
    first, last = layers(model)
    total, count = 0.0, 0
    for b in range(BATCH):
        for k in range(STEPS):
            if COUNTED[b, k]:
                z = np.concatenate((Y[b, k, 3:].numpy(), W[b, k].numpy()))
                hidden = np.tanh(first.weight.detach().numpy() @ z + first.bias.detach().numpy())
                rho = last.weight.detach().numpy() @ hidden + last.bias.detach().numpy()
                error = NU_DOT[b, k].numpy() - A @ z[:3] - B @ z[3:] - C - rho
                total, count = total + float(np.sum((error / SCALES.numpy()) ** 2)), count + 3
    assert 0 < count < 3 * BATCH * STEPS
    assert one_step(model, NU_DOT, COUNTED).item() == pytest.approx(total / count, rel=1e-12)


def test_what_does_not_count_does_not_matter() -> None:
    model, bad = with_mlp(), ~COUNTED
    wild = NU_DOT.clone()
    wild[bad] = 1e6
    assert one_step(model, wild, COUNTED).item() == one_step(model, NU_DOT, COUNTED).item()
    y = Y.clone()
    y[bad] = 1e6
    for robust in (0.0, 0.1):
        masked, same = (
            rollout_loss(euler(), X0, W, S, values, COUNTED, SCALES, robust) for values in (y, Y)
        )
        assert masked.item() == same.item()


def test_rollout_loss_is_the_mean_square_of_small_errors() -> None:
    y = torch.cat((Y[:, :, :3], torch.from_numpy(by_euler()) + 0.3 * Y[:, :, 3:]), dim=-1)
    error = (0.3 * Y[:, :, 3:] / SCALES).numpy()
    assert np.abs(error).max() < 5
    expected = np.mean(error[COUNTED.numpy()] ** 2)
    assert rollout_loss(euler(), X0, W, S, y, COUNTED, SCALES, 0.0).item() == pytest.approx(
        expected, rel=1e-12
    )


def test_a_rollout_that_runs_away_counts_by_its_error() -> None:
    """Beyond 5 scales the square goes on as its tangent: 10 |e| - 25."""
    error = np.array([2.0, 5.0, 5.5, 400.0, -80.0])
    y = torch.cat(
        (
            Y[:, :, :3],
            torch.from_numpy(by_euler()) - torch.from_numpy(error)[:, None, None] * SCALES,
        ),
        dim=-1,
    )
    expected = np.mean([4.0, 25.0, 30.0, 3975.0, 775.0])
    everything = torch.ones_like(COUNTED)
    assert rollout_loss(euler(), X0, W, S, y, everything, SCALES, 0.0).item() == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("robust", [0.05, 2.0])
def test_robust_loss_is_the_mean_of_window_errors(robust: float) -> None:
    error = ((torch.from_numpy(by_euler()) - Y[:, :, 3:]) / SCALES).numpy()
    expected = np.mean(
        [np.sqrt(np.mean(error[b][COUNTED[b].numpy()] ** 2) + robust**2) for b in range(BATCH)]
    )
    assert rollout_loss(euler(), X0, W, S, Y, COUNTED, SCALES, robust).item() == pytest.approx(
        expected, rel=1e-12
    )


@pytest.mark.parametrize("robust", [0.0, 0.1])
def test_nothing_to_count_gives_no_gradient(robust: float) -> None:
    nothing = torch.zeros_like(COUNTED)
    model = with_mlp()
    losses = [
        one_step(model, NU_DOT, nothing),
        rollout_loss(Rollout(model), X0, W, S, Y, nothing, SCALES, robust),
    ]
    for loss in losses:
        model.zero_grad()
        loss.backward()
        assert all(
            float(p.grad.abs().max()) == 0 for p in model.head.parameters() if p.grad is not None
        )
        assert loss.item() == pytest.approx(robust if loss is losses[1] else 0.0)


def test_gradients_reach_through_the_rollout() -> None:
    model = with_mlp()

    def loss() -> Tensor:
        return rollout_loss(Rollout(model), X0, W, S, Y, COUNTED, SCALES, 0.1)

    loss().backward()
    bias = layers(model)[1].bias
    assert bias.grad is not None
    for i in range(3):
        values = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                bias[i] += step
                values.append(loss().item())
                bias[i] -= step
        assert bias.grad[i].item() == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-6)
