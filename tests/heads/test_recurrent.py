"""Networks side by side: each by itself, in its own step, and in steps of another length."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from residnet.baselines.given import StillConfig
from residnet.data.windows import WindowStore
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.heads.recurrent import RecurrentConfig, RecurrentHead
from residnet.physics.signals import SignalsConfig

NAMES = ("u", "v", "r", "n", "delta")


def head_of(**config: object) -> RecurrentHead:
    torch.manual_seed(0)
    head = RecurrentConfig.model_validate({"hidden_size": 5, "step": 0.5, **config}).build(NAMES)
    assert isinstance(head, RecurrentHead)
    return head.double()


def test_a_step_is_that_of_pytorch_and_no_network_sees_another() -> None:
    """torch.nn.GRUCell with the same weights, network by network."""
    head = head_of(members=3)
    z, s = torch.randn(6, 5, dtype=torch.float64), torch.rand(6, 5, dtype=torch.float64)
    found, after = head(z, s)
    seen = torch.cat((z, torch.zeros(6, 3)), dim=1)
    for k in range(3):
        cell = nn.GRUCell(8, 5, dtype=torch.float64)
        # torch orders reset, update, new; ours is update, reset, new
        order = torch.cat((torch.arange(5, 10), torch.arange(5), torch.arange(10, 15)))
        with torch.no_grad():
            cell.weight_ih.copy_(head.w_input[k].T[order])
            cell.weight_hh.copy_(head.w_hidden[k].T[order])
            cell.bias_ih.copy_(head.bias[k, 0][order])
            cell.bias_hh.copy_(torch.cat((torch.zeros(10), head.bias_hidden[k, 0])))
            rows = slice(2 * k, 2 * k + 2)
            h = cell(seen[rows], s[rows])
            rho = h @ head.w_out[k] + seen[rows] @ head.w_skip[k] + head.bias_out[k]
        torch.testing.assert_close(after[rows], h)
        torch.testing.assert_close(found[rows], rho)


def test_short_steps_keep_what_a_long_one_does() -> None:
    """The share of the memory that is kept over five short steps is that of a long one."""
    head = head_of()
    with torch.no_grad():
        # gates and new memory that depend on nothing but the biases
        for weight in (head.w_input, head.w_hidden):
            weight.zero_()
    z, s = torch.randn(1, 5, dtype=torch.float64), torch.rand(1, 5, dtype=torch.float64)
    long = head(z, s)[1]
    head.set_step(0.1)
    for _ in range(5):
        s = head(z, s)[1]
    torch.testing.assert_close(s, long)


def mean_of(head: RecurrentHead) -> MeanOfTrajectories:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    baseline = StillConfig().build(signals.names)
    model = HybridDynamics(signals, baseline, head, 0.1, "semi_implicit_euler")
    return MeanOfTrajectories([model], (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def states(rows: int, steps: int) -> Tensor:
    y = 0.1 * torch.randn(rows, steps, 6, dtype=torch.float64)
    return y


def test_the_mean_is_that_of_networks_that_run_by_themselves() -> None:
    mean = mean_of(head_of(members=3)).double()
    y, w = states(2, 8), torch.randn(2, 30, 2, dtype=torch.float64)
    with torch.no_grad():
        found = Rollout(mean)(y[:, -1], w[:, 8:], mean.warmup(y[:, :-1], w[:, :7]))[0]
        single = mean.members[0]
        part = single.warmup(y[:, :-1].repeat(3, 1, 1), w[:, :7].repeat(3, 1, 1))
        each = Rollout(single)(y[:, -1].repeat(3, 1), w[:, 8:].repeat(3, 1, 1), part)[0]
    wanted = each[..., 3:].unflatten(0, (3, 2)).mean(0)
    torch.testing.assert_close(found[..., 3:], wanted, rtol=0, atol=2e-4)


def test_a_measurement_starts_all_members_from_it() -> None:
    """Whatever they had predicted, a state far from it is where each member goes on."""
    mean = mean_of(head_of(members=2)).double()
    w = torch.zeros(1, 2, dtype=torch.float64)
    s = mean.initial_state(1).double()
    x = torch.zeros(1, 6, dtype=torch.float64)
    mean.requires_grad_(False)
    for _ in range(40):
        x, s = mean.step(x, w, s)
    apart = s[:, 4:].reshape(2, -1)[:, :3]
    assert float((apart[0] - apart[1]).abs().max()) > 1e-3
    away = x + torch.tensor([0, 0, 0, 0.3, -0.2, 0.1], dtype=torch.float64)
    _, after = mean.step(away, w, s)
    alone = mean.members[0].step(away.repeat(2, 1), w.repeat(2, 1), s[:, 4:].reshape(2, -1)[:, 3:])
    wanted = alone[0][:, 3:] - alone[0][:, 3:].mean(0)
    # a measurement 150 small velocities away leaves a 20,000th of what lay between the members
    torch.testing.assert_close(after[:, 4:].reshape(2, -1)[:, :3], wanted, rtol=0, atol=1e-5)


def test_a_coarse_store_holds_all_samples_and_the_means_of_inputs() -> None:
    count, steps = 23, 4
    label = torch.arange(count, dtype=torch.float64)
    rows = label[:, None]
    turning = torch.remainder(0.3 * rows + torch.pi, 2 * torch.pi) - torch.pi
    w = torch.cat((rows, turning), dim=1)
    yes = torch.ones(count, dtype=torch.bool)
    stretch = torch.cat((torch.arange(12), torch.arange(11)))
    left = torch.cat((12 - torch.arange(12), 11 - torch.arange(11)))
    store = WindowStore(
        rows.repeat(1, 6), rows.repeat(1, 6), rows.repeat(1, 3), w, w, yes, yes, left, stretch,
        (label >= 12).long(),
    )  # fmt: skip
    coarse = store.coarse(steps, [1])
    assert sorted(coarse.y[:, 0].tolist()) == label.tolist()
    starts = coarse.starts(3)
    taken = coarse.take(coarse.y, starts, 3)[..., 0]
    torch.testing.assert_close(taken.diff(dim=1), torch.full((len(starts), 2), 4.0).double())
    # a window of three long steps keeps to its stretch
    assert all((row < 12).all() or (row >= 12).all() for row in taken)
    means = coarse.take(coarse.w, starts, 2)
    torch.testing.assert_close(means[..., 0], taken[:, :2] + 1.5)
    expected = 0.3 * (taken[:, :2] + 1.5)
    torch.testing.assert_close(means[..., 1].cos(), expected.cos())


@pytest.mark.parametrize("steps", [7, 40])
def test_accelerations_along_measurements_are_those_of_steps(steps: int) -> None:
    mean = mean_of(head_of(members=2)).double()
    single = mean.members[0]
    z = 0.2 * torch.randn(1, steps, 5, dtype=torch.float64)
    with torch.no_grad():
        found = single.one_step(z)
        x = torch.cat((torch.zeros(1, steps, 3), z[..., :3]), dim=-1).repeat(2, 1, 1)
        s, out = torch.zeros(2, single.n_state, dtype=torch.float64), []
        for k in range(steps):
            out.append(single.acceleration(x[:, k], z[:, k, 3:].repeat(2, 1), s).mean(0))
            s = single.step(x[:, k], z[:, k, 3:].repeat(2, 1), s)[1]
    torch.testing.assert_close(found[0], torch.stack(out))


def test_what_the_recipe_trains_is_compiled() -> None:
    """A head that TorchScript refuses would be trained and run several times slower, unsaid."""
    mean = mean_of(head_of(members=2, restoring=True))
    for model in (mean, mean.members[0]):
        assert isinstance(torch.jit.script(Rollout(model)), torch.jit.ScriptModule)
