"""Networks: cells against PyTorch and NumPy, members that run by themselves, mirrored heads
(rho(M z) = M rho(z), to the last bits), and the hyperbolic tangent of large batches.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, channels, made, sampled
from torch import Tensor, nn

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.core.samples import Samples
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics, MeasuredPast
from residnet.engine import free_runs
from residnet.engine.rollout import TRAINING_STEPS, Rollout, trace_step
from residnet.heads.base import ResidualHead
from residnet.heads.lstm import LSTMCell, LstmHead
from residnet.heads.lstm_config import LstmConfig
from residnet.heads.mirror import Tanh, fast_tanh
from residnet.heads.mlp_config import MlpConfig
from residnet.heads.recurrent import GRUEnsembleHead
from residnet.heads.recurrent_config import GRUEnsembleConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.windows import WindowStore


def built(**config: object) -> LstmHead:
    torch.manual_seed(0)
    head = LstmConfig.model_validate(
        {"kind": "lstm", "hidden_size": 12, "readout": 0, "skip": "none", **config}
    ).build(NAMES)
    assert isinstance(head, LstmHead)
    head.calibrate(made())
    return head.double().eval()


def windows(batch: int = 3, length: int = 25) -> Tensor:
    return torch.from_numpy(channels(batch * length, seed=9).reshape(batch, length, len(NAMES)))


def stepped(head: Any, z: Tensor) -> Tensor:
    s = torch.zeros(len(z), head.n_state, dtype=z.dtype)
    out = []
    for k in range(z.shape[1]):
        rho, s = head(z[:, k], s)
        out.append(rho)
    return torch.stack(out, dim=1)


def test_an_lstm_equals_that_of_torch() -> None:
    core = LSTMCell(4, 10, uses_softsign=False).double()
    z = torch.randn(5, 30, 4, dtype=torch.float64)
    other = nn.LSTM(4, 10, batch_first=True).double()
    with torch.no_grad():
        core.bias.uniform_(-0.5, 0.5)
        weights = dict(other.named_parameters())
        weights["weight_ih_l0"].copy_(core.input_weight)
        weights["weight_hh_l0"].copy_(core.hidden_weight)
        weights["bias_ih_l0"].copy_(core.bias)
        weights["bias_hh_l0"].zero_()
        out, (h, c) = other(z)
        mine, s = core.run_sequence(z)
    torch.testing.assert_close(mine, out, rtol=0, atol=1e-12)
    torch.testing.assert_close(s, torch.cat((h[0], c[0]), dim=1), rtol=0, atol=1e-12)


def softsign(x: np.ndarray) -> np.ndarray:
    return x / (1 + np.abs(x))


def logistic(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_a_softsign_cell_equals_numpy() -> None:
    """Document 003 eq. (17): softsign in place of tanh, the gates stay logistic."""
    core = LSTMCell(3, 6, uses_softsign=True).double()
    z = torch.randn(2, 8, 3, dtype=torch.float64)
    wi, wh, b = (
        part.detach().numpy() for part in (core.input_weight, core.hidden_weight, core.bias)
    )
    h, c = np.zeros((2, 6)), np.zeros((2, 6))
    outputs = []
    for k in range(8):
        i, f, g, o = np.split(z[:, k].numpy() @ wi.T + h @ wh.T + b, 4, axis=1)
        c = logistic(f) * c + logistic(i) * softsign(g)
        h = logistic(o) * softsign(c)
        outputs.append(h)
    with torch.no_grad():
        out, s = core.run_sequence(z)
    np.testing.assert_allclose(out, np.stack(outputs, axis=1), atol=1e-13)
    np.testing.assert_allclose(s, np.concatenate((h, c), axis=1), atol=1e-13)


def test_the_documents_network_has_axes_of_their_own() -> None:
    """4 * 100 * (4 + 100 + 1) + 101 = 42,101 for each of surge, sway, yaw (correction W4)."""
    config = LstmConfig(
        hidden_size=100, readout=0, per_axis=True, features=("u", "v", "r", "tau_n"), skip="none"
    )
    head: Any = config.build(NAMES)
    counts = [sum(p.numel() for p in network.parameters()) for network in head.networks]
    assert counts == [42_101] * 3
    assert head.n_state == 600
    seen = {"u": ("u", "tau_x"), "v": ("v", "r"), "r": ("r", "tau_n", "v")}
    own, z = built(per_axis=True, axis_features=seen), windows()
    changed = z.clone()
    changed[..., 3] += 50.0
    before = own.teacher_forced_residuals(z)
    after = own.teacher_forced_residuals(changed)
    assert bool((before[..., 0] != after[..., 0]).any())
    assert torch.equal(before[..., 1:], after[..., 1:])


@pytest.mark.parametrize("activation", ["tanh", "softsign"])
def test_gradients_of_the_sequence_are_those_of_the_steps(activation: str) -> None:
    head = built(activation=activation)
    z = windows(2, 10)
    weights = list(head.parameters())
    found, wanted = (
        torch.autograd.grad(out.square().sum(), weights)
        for out in (head.teacher_forced_residuals(z), stepped(head, z))
    )
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-12)


def test_a_memory_of_chosen_features_ignores_the_others() -> None:
    head = built(memory=(NAMES[-1],), readout=5)
    z = windows()
    other = z.clone()
    other[:, :, : len(NAMES) - 1] += 0.1
    assert torch.equal(head.warmup(z), head.warmup(other))
    assert not torch.equal(head.teacher_forced_residuals(z), head.teacher_forced_residuals(other))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"axis_features": {"u": ["u"], "v": ["v"], "r": ["r"]}}, "needs per_axis"),
        ({"per_axis": True, "axis_features": {"u": ["u"]}}, "all of u, v, r"),
        ({"memory": [NAMES[-1]], "readout": 0}, "readout"),
    ],
)
def test_wrong_configs(config: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate_config({"kind": "lstm", **config}, LstmConfig, "here")


RUDDER = ("u", "v", "r", "n", "delta")


def networks(**config: object) -> GRUEnsembleHead:
    torch.manual_seed(0)
    head = GRUEnsembleConfig.model_validate({"hidden_size": 5, "step": 0.5, **config}).build(RUDDER)
    assert isinstance(head, GRUEnsembleHead)
    return head.double()


def mean_of(**config: object) -> MeanOfTrajectories:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    baseline = ZeroBaselineConfig().build(signals.names)
    model = HybridDynamics(signals, baseline, networks(**config), 0.1, "semi_implicit_euler")
    return MeanOfTrajectories([model], (-1.0,) * 3, (1.0,) * 3).double()


def test_a_step_is_that_of_pytorch_and_no_network_sees_another() -> None:
    """torch.nn.GRUCell with the same weights, network by network."""
    head = networks(members=3)
    z, s = torch.randn(6, 5, dtype=torch.float64), torch.rand(6, 5, dtype=torch.float64)
    found, after = head(z, s)
    seen = torch.cat((z, torch.zeros(6, 3)), dim=1)
    # torch orders reset, update, new; ours is update, reset, new
    order = torch.cat((torch.arange(5, 10), torch.arange(5), torch.arange(10, 15)))
    for k in range(3):
        cell = nn.GRUCell(8, 5, dtype=torch.float64)
        rows = slice(2 * k, 2 * k + 2)
        with torch.no_grad():
            cell.weight_ih.copy_(head.input_weight[k].T[order])
            cell.weight_hh.copy_(head.hidden_weight[k].T[order])
            cell.bias_ih.copy_(head.bias[k, 0][order])
            cell.bias_hh.copy_(torch.cat((torch.zeros(10), head.bias_hidden[k, 0])))
            h = cell(seen[rows], s[rows])
            rho = h @ head.output_weight[k] + seen[rows] @ head.skip_weight[k] + head.bias_out[k]
        torch.testing.assert_close(after[rows], h)
        torch.testing.assert_close(found[rows], rho)


def test_an_lstm_step_is_that_of_pytorch() -> None:
    head = networks(members=2, cell="lstm", encoder="measurements")
    z = torch.randn(6, 5, dtype=torch.float64)
    s = torch.rand(6, 10, dtype=torch.float64)
    _, next_memory = head(z, s)
    # torch orders input, forget, candidate, output; ours is forget, input, output, candidate
    order = torch.cat([torch.arange(5) + 5 * k for k in (1, 0, 3, 2)])
    for k in range(2):
        cell = nn.LSTMCell(5, 5, dtype=torch.float64)
        rows = slice(3 * k, 3 * k + 3)
        with torch.no_grad():
            cell.weight_ih.copy_(head.input_weight[k].T[order])
            cell.weight_hh.copy_(head.hidden_weight[k].T[order])
            cell.bias_ih.copy_(head.bias[k, 0][order])
            cell.bias_hh.zero_()
            cell.bias_hh[10:15] = head.bias_hidden[k, 0]
            expected = torch.cat(cell(z[rows], tuple(s[rows].split(5, dim=1))), dim=1)
        torch.testing.assert_close(next_memory[rows], expected)


def test_a_training_gain_changes_weights_and_not_outputs() -> None:
    head = networks(members=2)
    z = torch.randn(6, 5, dtype=torch.float64)
    s = torch.rand(6, 5, dtype=torch.float64)
    weights = [head.output_weight, head.skip_weight, head.bias_out]
    with torch.no_grad():
        head.bias_out.add_(0.1)
        expected = head(z, s)[0]
        initial_weights = [weight.clone() for weight in weights]
        for gain in ([2.0, 5.0, 1.0], [4.0, 1.0, 8.0]):
            head.set_training_gain(torch.tensor(gain))
            torch.testing.assert_close(head(z, s)[0], expected)
            torch.testing.assert_close(
                head.output_weight * torch.tensor(gain, dtype=torch.float64), initial_weights[0]
            )
        head.set_training_gain(None)
        torch.testing.assert_close(head(z, s)[0], expected)
        torch.testing.assert_close(weights, initial_weights)


def test_gradients_are_clipped_for_each_network() -> None:
    head = networks(members=3)
    rho, _ = head(torch.randn(6, 5, dtype=torch.float64), torch.rand(6, 5, dtype=torch.float64))
    weights = torch.tensor([1e-3, 1.0, 1e3], dtype=torch.float64).repeat_interleave(2)
    (rho.square().sum(1) * weights).sum().backward()
    expected = []
    for k in range(3):
        gradients = [p.grad[k].flatten() for p in head.parameters() if p.grad is not None]
        gradient = torch.cat(gradients)
        # the loss is the mean over the networks, so that a norm of 0.9 is 0.3 here
        expected.append(gradient * min(0.3 / float(gradient.norm()), 1.0))
    head.clip_member_gradients(0.9)
    for k in range(3):
        gradients = [p.grad[k].flatten() for p in head.parameters() if p.grad is not None]
        torch.testing.assert_close(torch.cat(gradients), expected[k])
    assert float(expected[0].norm()) < 0.3


@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_the_encoder_reads_measured_states_and_the_decoder_predicted_ones(cell: str) -> None:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    baseline = ZeroBaselineConfig().build(signals.names)
    head = networks(cell=cell, encoder="measurements")
    model = HybridDynamics(signals, baseline, head, 0.1, "semi_implicit_euler").double()
    y = torch.randn(2, 8, 6, dtype=torch.float64)
    w = torch.randn(2, 30, 2, dtype=torch.float64)
    encoder = [parameter for name, parameter in head.named_parameters() if "encoder" in name]
    decoder = [head.input_weight, head.hidden_weight, head.bias]

    # the memory after measured states depends on the encoder only
    memory = model.warmup(y, w[:, :8])
    gradients = torch.autograd.grad(memory[:, : head.n_state].sum(), encoder, retain_graph=True)
    assert all(gradient.abs().max() > 0.0 for gradient in gradients)
    for gradient in torch.autograd.grad(memory[:, : head.n_state].sum(), decoder):
        assert float(gradient.abs().max()) < 1e-4 * float(gradients[0].abs().max())

    # from the second step of a free run on, the encoder has no influence
    with torch.no_grad():
        memory = model.warmup(y, w[:, :8])
        x, s = model.step(y[:, -1] + 0.1, w[:, 8], memory)
        states = Rollout(model)(x, w[:, 9:], s)[0]
        for parameter in encoder:
            parameter.add_(1.0)
        torch.testing.assert_close(Rollout(model)(x, w[:, 9:], s)[0], states, rtol=0, atol=1e-12)
        head.is_decoding_only = True
        torch.testing.assert_close(Rollout(model)(x, w[:, 9:], s)[0], states, rtol=0, atol=1e-12)


@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_short_steps_keep_what_a_long_one_does(cell: str) -> None:
    """The share of the memory that is kept over five short steps is that of a long one."""
    head = networks(cell=cell)
    with torch.no_grad():
        # gates and new memory that depend on nothing but the biases
        for weight in (head.input_weight, head.hidden_weight):
            weight.zero_()
    z = torch.randn(1, 5, dtype=torch.float64)
    s = torch.rand(1, head.n_state, dtype=torch.float64)
    long = head(z, s)[1]
    head.set_step(0.1)
    for _ in range(5):
        s = head(z, s)[1]
    torch.testing.assert_close(s, long)


@pytest.mark.parametrize("config", [{}, {"cell": "lstm"}, {"encoder": "measurements"}])
def test_the_mean_is_that_of_networks_that_run_by_themselves(config: dict[str, str]) -> None:
    mean = mean_of(members=3, **config)
    y = 0.1 * torch.randn(2, 8, 6, dtype=torch.float64)
    w = torch.randn(2, 30, 2, dtype=torch.float64)
    with torch.no_grad():
        found = Rollout(mean)(y[:, -1], w[:, 8:], mean.warmup(y[:, :-1], w[:, :7]))[0]
        single = mean.members[0]
        part = single.warmup(y[:, :-1].repeat(3, 1, 1), w[:, :7].repeat(3, 1, 1))
        each = Rollout(single)(y[:, -1].repeat(3, 1), w[:, 8:].repeat(3, 1, 1), part)[0]
    wanted = each[..., 3:].unflatten(0, (3, 2)).mean(0)
    torch.testing.assert_close(found[..., 3:], wanted, rtol=0, atol=2e-4)


@pytest.mark.parametrize("is_past", [False, True])
@pytest.mark.parametrize("config", [{}, {"cell": "lstm"}, {"encoder": "measurements"}])
def test_a_compiled_ensemble_has_the_free_runs_and_gradients_of_torch(
    config: dict[str, str], is_past: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along predicted states, and along measured ones, which the encoder reads."""
    monkeypatch.setattr(free_runs, "_COMPILED", {})
    signals = SignalsConfig(inputs=("n", "delta")).build()
    baseline = ZeroBaselineConfig().build(signals.names)
    head = networks(members=3, hidden_size=9, **config)
    head.is_decoding_only = not is_past
    model = HybridDynamics(signals, baseline, head, 0.5, "heun").double()
    rollout = Rollout(MeasuredPast(model) if is_past else model)
    x0 = 0.1 * torch.randn(12, 6, dtype=torch.float64)
    w = torch.randn(12, 20, 8 if is_past else 2, dtype=torch.float64)
    memory = 0.1 * torch.rand(12, rollout.model.n_state, dtype=torch.float64)
    compiled = free_runs.compile_rollout(rollout, TRAINING_STEPS)
    trained = [p for p in head.parameters() if p.requires_grad]
    for _ in range(2):
        memory.requires_grad_(True)
        gradients = []
        states = []
        for run in (rollout, compiled):
            result = run(x0, w, memory)
            states.append(result[0])
            loss = result[0].square().mean() + result[2].square().mean()
            gradients.append(torch.autograd.grad(loss, [*trained, memory], allow_unused=True))
        torch.testing.assert_close(states[1], states[0], rtol=0, atol=1e-12)
        if is_past:
            zero = torch.zeros_like(memory)
            expected_memory = model.warmup(w[:, :, :6], w[:, :, 6:])
            torch.testing.assert_close(compiled(x0, w, zero)[2], expected_memory)
        for expected, computed in zip(*gradients, strict=True):
            if expected is not None:
                torch.testing.assert_close(computed, expected, rtol=1e-9, atol=1e-14)
        # the program runs with the parameters of the moment
        with torch.no_grad():
            for parameter in trained:
                parameter.add_(0.05 * torch.randn_like(parameter))
    assert [bool(program) for program in free_runs._COMPILED.values()] == [True]


def test_a_measurement_starts_all_members_from_it() -> None:
    """Whatever they had predicted, a state far from it is where each member goes on."""
    mean = mean_of(members=2).requires_grad_(False)
    w, x = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 6, dtype=torch.float64)
    s = mean.initial_state(1).double()
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
    count = 23
    steps = 4
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
    coarse = store.coarsen(steps, [1])
    assert sorted(coarse.y[:, 0].tolist()) == label.tolist()
    starts = coarse.find_starts(3)
    taken = coarse.take_windows(coarse.y, starts, 3)[..., 0]
    torch.testing.assert_close(taken.diff(dim=1), torch.full((len(starts), 2), 4.0).double())
    # a window of three long steps keeps to its stretch
    assert all((row < 12).all() or (row >= 12).all() for row in taken)
    means = coarse.take_windows(coarse.w, starts, 2)
    torch.testing.assert_close(means[..., 0], taken[:, :2] + 1.5)
    expected = 0.3 * (taken[:, :2] + 1.5)
    torch.testing.assert_close(means[..., 1].cos(), expected.cos())


@pytest.mark.parametrize("steps", [7, 40])
def test_accelerations_along_measurements_are_those_of_steps(steps: int) -> None:
    single: Any = mean_of(members=2).members[0]
    z = 0.2 * torch.randn(1, steps, 5, dtype=torch.float64)
    with torch.no_grad():
        found = single.one_step_accelerations(z)
        x = torch.cat((torch.zeros(1, steps, 3), z[..., :3]), dim=-1).repeat(2, 1, 1)
        s, out = torch.zeros(2, single.n_state, dtype=torch.float64), []
        for k in range(steps):
            out.append(single.acceleration(x[:, k], z[:, k, 3:].repeat(2, 1), s).mean(0))
            s = single.step(x[:, k], z[:, k, 3:].repeat(2, 1), s)[1]
    torch.testing.assert_close(found[0], torch.stack(out))


def test_what_the_recipe_trains_is_recorded() -> None:
    """A head that torch cannot record would be trained and run several times slower, unsaid."""
    mean = mean_of(members=2, restoring=True)
    for model in (mean, mean.members[0]):
        x, w = torch.zeros(2, 6), torch.zeros(2, 2)
        model = copy.deepcopy(model).float()
        assert trace_step(model, x, w, model.initial_state(2)) != model.step


# channels, where each is found in the mirror, and with which sign
SCENES = {
    "wind": (
        (*RUDDER, "wind_u", "wind_v", "wind_mag"),
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
MIRRORED: dict[str, Any] = {
    "mlp": MlpConfig(mirror=True, hidden=(9, 7), skip="none"),
    "lstm": LstmConfig(mirror=True, hidden_size=6, readout=0),
    "readout": LstmConfig(mirror=True, hidden_size=5, readout=4, memory=("v", "r")),
    "per axis": LstmConfig(
        mirror=True, hidden_size=4, readout=0, per_axis=True, activation="softsign"
    ),
}


def one_sided(names: tuple[str, ...], count: int = 300) -> Samples:
    """All around starboard turns, so that a head without symmetry would lean to one side."""
    random = np.random.default_rng(2)
    z = random.normal(size=(count, len(names))) + 0.7
    return sampled(z, random.normal(size=(count, 3)) * [0.1, 0.05, 0.2], names)


def mirrored(kind: str, names: tuple[str, ...]) -> ResidualHead:
    torch.manual_seed(4)
    head: ResidualHead = MIRRORED[kind].build(names)
    head.calibrate(one_sided(names))
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return head.double().eval()


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("kind", MIRRORED)
def test_the_residual_in_the_mirror_is_the_mirror_of_the_residual(kind: str, scene: str) -> None:
    names, index, sign = SCENES[scene]
    head = mirrored(kind, names)
    # beyond the training range too: the guard must be symmetric
    z = torch.from_numpy(2.0 * np.random.default_rng(3).normal(size=(3, 20, len(names))))
    other = z[..., index] * torch.tensor(sign, dtype=z.dtype)
    with torch.no_grad():
        here = head.teacher_forced_residuals(z)
        there = head.teacher_forced_residuals(other)
        torch.testing.assert_close(there, here * TURNED, rtol=0, atol=1e-15)
        step_here = stepped(head, z)
        step_there = stepped(head, other)
        torch.testing.assert_close(step_there, step_here * TURNED, rtol=0, atol=1e-15)
        torch.testing.assert_close(step_here, here, rtol=0, atol=1e-12)
    smallest = float(here.abs().amax((0, 1)).min())
    assert smallest > 1e-3, "a head that answers zero is symmetric by nature"


def test_scales_are_those_of_both_sides() -> None:
    head = mirrored("mlp", RUDDER)
    known = one_sided(RUDDER)
    inner: Any = head.inner_head.features  # type: ignore[union-attr]
    sign = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    both = torch.cat((known.z, known.z * sign))
    torch.testing.assert_close(inner.mean, both.mean(0))
    torch.testing.assert_close(inner.std, both.std(0, correction=0))
    torch.testing.assert_close(inner.low[[1, 2, 4]], -inner.high[[1, 2, 4]])
    target = torch.cat((known.target, known.target * TURNED))
    torch.testing.assert_close(head.residual_scale(), target.std(0, correction=0))


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
@pytest.mark.parametrize("name", ["trim", "n_port"])
def test_a_mirror_of_unknown_channels_is_a_configuration_error(kind: str, name: str) -> None:
    with pytest.raises(ConfigError, match=f"mirror.*{name}.*remove `mirror`"):
        MIRRORED[kind].build(("u", "v", "r", name))


@pytest.mark.parametrize(("dtype", "within"), [(torch.float32, 3e-7), (torch.float64, 1e-15)])
def test_the_quick_hyperbolic_tangent_agrees_with_torch(dtype: torch.dtype, within: float) -> None:
    x = torch.linspace(-30.0, 30.0, 10_001, dtype=dtype).reshape(73, 137)
    ends = torch.tensor([torch.inf, -torch.inf, torch.nan], dtype=dtype)[:, None].expand(3, 8_192)
    with torch.no_grad():
        quick = fast_tanh(x)
        torch.testing.assert_close(quick, torch.tanh(x), rtol=0.0, atol=within)
        # few numbers and traces take torch's own
        assert torch.equal(fast_tanh(x[:2]), torch.tanh(x[:2]))
        assert not torch.equal(quick, torch.tanh(x))
        assert torch.equal(torch.jit.script(Tanh())(x), quick)
        traced = torch.export.export(Tanh(), (x,))
        assert torch.equal(traced.module()(x), torch.tanh(x))
        found = fast_tanh(ends.contiguous())
        torch.testing.assert_close(found, torch.tanh(ends), rtol=0, atol=0, equal_nan=True)
    x.requires_grad_()
    slopes = [torch.autograd.grad(f(x).sum(), x)[0] for f in (fast_tanh, torch.tanh)]
    torch.testing.assert_close(*slopes, rtol=0.0, atol=2.0 * within)
