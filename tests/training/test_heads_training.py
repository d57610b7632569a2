"""The trainer: stages, losses, what it keeps, devices and processes."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from kinds import of_kind
from made_system import LINEAR, SCALES, STEP, free_run_error, inputs, model_of, trials
from torch import Tensor, nn

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, FitError, UsageError
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.rollout import Rollout
from residnet.heads.lstm_config import LstmConfig
from residnet.heads.mlp import MlpHead
from residnet.heads.mlp_config import MlpConfig
from residnet.heads.recurrent import GRUEnsembleHead
from residnet.heads.recurrent_config import GRUEnsembleConfig
from residnet.heads.skip import SkipHead
from residnet.preprocessing.data_module import WindowBatch, WindowsDataModule
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.training.config import MachineConfig, TrainingConfig
from residnet.training.heads import (
    HeadTraining,
    TrainingSetup,
    Validate,
    finish_training,
    make_training,
    one_step_loss,
    rollout_loss,
    train,
)
from residnet.training.score import ExampleRun, Score


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [
        ((2,), [(0, 0), (0, 1)]),
        ((2, 1, 3), [(0, 0), (0, 1), (1, 0), (2, 0), (2, 1), (2, 2)]),
        ((0, 2, 1), [(1, 0), (1, 1), (2, 0)]),
    ],
)
def test_stage_of_each_epoch(lengths: tuple[int, ...], expected: list[tuple[int, int]]) -> None:
    stages = [{"horizon": 1.0 + i, "epochs": epochs} for i, epochs in enumerate(lengths[1:])]
    content = {"one_step": {"epochs": lengths[0]}, "multi_step": stages}
    settings = TrainingConfig.model_validate(content)
    assert settings.epochs == len(expected)
    assert [settings.stage(epoch) for epoch in range(settings.epochs)] == expected
    # after the last epoch stands the last stage
    assert settings.stage(50)[0] == expected[-1][0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"one_step": {"epochs": 0}},
            "nothing to train: one_step.epochs is 0 and multi_step is empty",
        ),
        (
            {"one_step": {"window": "2 s", "washout": "2 s"}},
            r"one_step: washout \(2 s\) must be shorter than window \(2 s\)",
        ),
        ({"multi_step": [{"horizon": 0, "epochs": 1}]}, "0.horizon: must be greater than 0"),
        ({"beginnings": {}, "one_step": {"batch": 1}}, "batches of at least 2 windows"),
        ({"beginnings": {"share": 1.0}}, "beginnings.share: must be less than 1"),
    ],
)
def test_wrong_configs(content: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate_config(content, TrainingConfig, "training")
    assert "\n" not in str(caught.value)


A = np.array([[-0.4, 0.1, 0.0], [0.0, -0.9, -0.2], [0.05, 0.1, -0.8]])
B = np.array([[1.0, 0.0], [0.0, 0.1], [0.0, 1.0]])
C = np.array([0.02, -0.01, 0.03])
THETA = torch.from_numpy(np.concatenate((C[:, None], A, B), axis=1))
BATCH = 5
STEPS = 12
RANDOM = np.random.default_rng(0)
Y = torch.from_numpy(RANDOM.normal(size=(BATCH, STEPS, 6)))
W = inputs(BATCH, STEPS, 1)
NU_DOT = torch.from_numpy(RANDOM.normal(size=(BATCH, STEPS, 3)))
COUNTED = torch.from_numpy(RANDOM.random((BATCH, STEPS)) < 0.6)
X0 = torch.from_numpy(RANDOM.normal(size=(BATCH, 6)) * 0.3)
S = torch.zeros(BATCH, 0, dtype=torch.float64)
UNITS = torch.tensor([0.5, 0.2, 0.3], dtype=torch.float64)


def with_mlp() -> HybridDynamics:
    torch.manual_seed(0)
    head = MlpConfig(hidden=(5,), skip="none").build(("u", "v", "r", "tau_x", "tau_n"))
    return model_of(LINEAR, THETA, head).double()


def layers(model: HybridDynamics) -> tuple[nn.Linear, nn.Linear]:
    """The hidden and the last layer of the head."""
    net = of_kind(model.head, MlpHead).network
    return of_kind(net[0], nn.Linear), of_kind(net[2], nn.Linear)


def by_euler() -> np.ndarray:
    """Velocities [B, T, 3] after each step of the linear model, by the explicit Euler rule."""
    nu, out = X0[:, 3:].numpy(), []
    for k in range(STEPS):
        nu = nu + STEP * (nu @ A.T + W[:, k].numpy() @ B.T + C)
        out.append(nu)
    return np.stack(out, axis=1)


def one_step(model: HybridDynamics, nu_dot: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    z = model.compute_channels(Y, W)
    return one_step_loss(model, z, model.baseline_acceleration(z), nu_dot, counted, UNITS)


def euler() -> Rollout:
    linear = model_of(LINEAR, THETA)
    return Rollout(HybridDynamics(linear.signals, linear.baseline, linear.head, STEP, "euler"))


def test_one_step_loss_is_the_mean_square_over_what_counts() -> None:
    model = with_mlp()
    first, last = layers(model)
    total = 0.0
    count = 0
    for b in range(BATCH):
        for k in range(STEPS):
            if COUNTED[b, k]:
                z = np.concatenate((Y[b, k, 3:].numpy(), W[b, k].numpy()))
                hidden = first.weight.detach().numpy() @ z + first.bias.detach().numpy()
                # SiLU, the default activation
                hidden = hidden / (1.0 + np.exp(-hidden))
                rho = last.weight.detach().numpy() @ hidden + last.bias.detach().numpy()
                error = NU_DOT[b, k].numpy() - A @ z[:3] - B @ z[3:] - C - rho
                total = total + float(np.sum((error / UNITS.numpy()) ** 2))
                count = count + 3
    assert 0 < count < 3 * BATCH * STEPS
    assert one_step(model, NU_DOT, COUNTED).item() == pytest.approx(total / count, rel=1e-12)


@pytest.mark.parametrize("robust", [0.0, 0.1])
def test_what_does_not_count_does_not_matter(robust: float) -> None:
    model = with_mlp()
    bad = ~COUNTED
    wild = NU_DOT.clone()
    y = Y.clone()
    wild[bad] = y[bad] = 1e6
    assert one_step(model, wild, COUNTED).item() == one_step(model, NU_DOT, COUNTED).item()
    masked, same = (
        rollout_loss(euler(), X0, W, S, values, COUNTED, UNITS, robust) for values in (y, Y)
    )
    assert masked.item() == same.item()
    nothing = torch.zeros_like(COUNTED)
    for loss, least in (
        (one_step(model, NU_DOT, nothing), 0.0),
        (rollout_loss(Rollout(model), X0, W, S, Y, nothing, UNITS, robust), robust),
    ):
        model.zero_grad()
        loss.backward()
        grown = [float(p.grad.abs().max()) for p in model.head.parameters() if p.grad is not None]
        assert not any(grown)
        assert loss.item() == pytest.approx(least)


def by_rollout(nu: np.ndarray, counted: Tensor, robust: float) -> float:
    """The loss of the Euler rollout against velocities [B, T, 3]."""
    y = torch.cat((Y[:, :, :3], torch.from_numpy(nu)), dim=-1)
    return float(rollout_loss(euler(), X0, W, S, y, counted, UNITS, robust))


def test_rollout_loss_is_the_mean_square_of_small_errors() -> None:
    off = 0.3 * Y[:, :, 3:].numpy()
    error = off / UNITS.numpy()
    assert np.abs(error).max() < 5
    expected = np.mean(error[COUNTED.numpy()] ** 2)
    assert by_rollout(by_euler() + off, COUNTED, 0.0) == pytest.approx(expected, rel=1e-12)


def test_a_rollout_that_runs_away_counts_by_its_error() -> None:
    """Beyond 5 scales the square goes on as its tangent: 10 |e| - 25."""
    error = np.array([2.0, 5.0, 5.5, 400.0, -80.0])
    nu = by_euler() - error[:, None, None] * UNITS.numpy()
    expected = np.mean([4.0, 25.0, 30.0, 3975.0, 775.0])
    assert by_rollout(nu, torch.ones_like(COUNTED), 0.0) == pytest.approx(expected, rel=1e-9)


def test_robust_loss_is_the_mean_of_window_errors() -> None:
    nu = Y[:, :, 3:].numpy()
    robust = 0.05
    error = (by_euler() - nu) / UNITS.numpy()
    expected = np.mean(
        [np.sqrt(np.mean(error[b][COUNTED[b].numpy()] ** 2) + robust**2) for b in range(BATCH)]
    )
    assert by_rollout(nu, COUNTED, robust) == pytest.approx(expected, rel=1e-12)


ONE_STEP = {"epochs": 2, "window": 1.0, "batch": 8}
HALF_SECOND = {"horizon": 0.5, "epochs": 2, "batch": 8}


@pytest.fixture(scope="module")
def logs() -> Sequence[PreparedLog]:
    return trials()


def prepared(
    logs: Sequence[PreparedLog], head: Any = None
) -> tuple[HybridDynamics, Samples, WindowStore]:
    """A linear baseline of the quadratic vessel with a fresh head on it."""
    torch.manual_seed(1)
    head = head or MlpConfig(hidden=(12,), skip="none")
    model = model_of(LINEAR, head=head.build(("u", "v", "r", "tau_x", "tau_n")))
    known = make_samples(logs, model.signals)
    RegressorsConfig(terms=LINEAR).fit_preferred(model.baseline, known)
    with torch.no_grad():
        residual = known.with_target(known.target - model.baseline(known.z))
    return model, residual, WindowStore.from_logs(logs)


def state_of(model: HybridDynamics) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in model.state_dict().items()}


class Scripted:
    """A validation that says what it is told, and remembers which weights it saw."""

    def __init__(self, scores: Sequence[float], diverged: Sequence[int] = (0,)) -> None:
        self.scores = itertools.chain(scores, itertools.repeat(scores[-1]))
        self.diverged = itertools.chain(diverged, itertools.repeat(diverged[-1]))
        self.seen: list[dict[str, Tensor]] = []

    def __call__(self, model: HybridDynamics) -> Score:
        self.seen.append(state_of(model))
        return Score(next(self.diverged), next(self.scores))


def trained(
    logs: Sequence[PreparedLog],
    folder: Path,
    validate: Validate,
    **config: Any,
) -> tuple[HybridDynamics, dict[str, Any]]:
    model, residual, store = prepared(logs)
    settings = TrainingConfig.model_validate({"steps": 3, "one_step": ONE_STEP, **config})
    setup = TrainingSetup(model, residual, store, settings, SCALES, validate, 0)
    notes = train("mlp", setup, folder)
    return model, notes


def same(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


def untrained(
    logs: Sequence[PreparedLog], head: Any = None, **config: Any
) -> tuple[HeadTraining, WindowsDataModule]:
    """The module, float32, without a trainer, and its windows."""
    model, residual, store = prepared(logs, head)
    model.head.calibrate(residual)
    settings = TrainingConfig.model_validate({"steps": 3, "one_step": ONE_STEP, **config})
    module = HeadTraining(model.float(), settings, SCALES.float(), Scripted([1.0]), 0)
    return module, module.data(store)


@pytest.mark.long
def test_training_lowers_the_free_run_error(tmp_path: Path) -> None:
    logs = trials(noise=0.002, window=0.5)
    baseline = free_run_error(prepared(logs)[0])

    def validate(model: HybridDynamics) -> Score:
        return Score(0, free_run_error(copy.deepcopy(model), seed=55))

    stages = {
        "one_step": {"epochs": 6, "window": 1.0, "batch": 32, "learning_rate": 2e-2},
        "multi_step": [
            {"horizon": 2.0, "epochs": 6, "batch": 16, "learning_rate": 2e-2, "final": 0.1}
        ],
    }
    model, notes = trained(logs, tmp_path, validate, steps=20, **stages)
    curve = notes["curve"]
    assert [entry["stage"] for entry in curve] == [0.0] * 6 + [1.0] * 6
    assert curve[5]["loss"] < 0.95 * curve[0]["loss"]
    assert curve[11]["loss"] < curve[6]["loss"]
    assert (
        notes["best_validation"]
        == min(entry["validation"] for entry in curve)
        == pytest.approx(validate(model).error, rel=1e-5)
    )
    assert notes["parameters"] == 12 * (5 + 1) + 3 * (12 + 1)
    assert free_run_error(model) < 0.7 * baseline
    assert not any(parameter.requires_grad for parameter in model.parameters())
    assert (tmp_path / "checkpoints" / "mlp" / "last.ckpt").is_file()


def test_a_skip_connection_is_selected_by_free_runs_and_is_a_candidate(
    logs: Sequence[PreparedLog],
) -> None:
    model, residual, store = prepared(logs, MlpConfig(hidden=(6,)))
    settings = TrainingConfig.model_validate({"steps": 3, "one_step": ONE_STEP})
    seen: list[Tensor] = []

    def validate(validated: HybridDynamics) -> Score:
        """Prefer a linear part of medium size, without a network."""
        linear = of_kind(validated.head, SkipHead).linear.coefficients
        network = of_kind(of_kind(validated.head, SkipHead).network, MlpHead).network
        output = of_kind(network[-1], nn.Linear).weight.detach()
        seen.append(linear.clone())
        return Score(0, abs(float(linear.abs().sum()) - medium) + float(output.abs().sum()))

    trial_head = of_kind(model.head, SkipHead)
    trial_head.calibrate(residual)
    sizes = [
        float(solution.state["coefficients"].abs().sum())
        for solution in trial_head.linear_solutions(residual)
    ]
    # neither the solution of cross-validation nor that without a residual
    medium = sizes[2]
    assert medium not in (sizes[0], 0.0)
    setup = TrainingSetup(model, residual, store, settings, SCALES, validate, 0)
    notes = train("mlp", setup, None)
    head = of_kind(model.head, SkipHead)
    assert float(head.linear.coefficients.abs().sum()) == pytest.approx(medium, rel=1e-5)
    # every epoch is worse than the linear part alone, which is returned
    assert notes["start_validation"] == notes["best_validation"]
    assert len(seen) == len(sizes) + 1 + 2
    z = residual.z.float()
    with torch.no_grad():
        torch.testing.assert_close(head(z, z[:, :0])[0], head.linear(z, z[:, :0])[0])
    remainder = residual.target - head.linear.double()(residual.z, z[:, :0])[0]
    torch.testing.assert_close(
        head.residual_scale().double(), remainder.std(0, correction=0), rtol=1e-4, atol=0
    )


@pytest.mark.parametrize(
    ("scores", "diverged", "best"),
    [
        ([3.0, 1.0, 2.0, 2.0], [0, 0, 0, 0], 1),
        # weights that diverge never beat steady ones
        ([1.0, 3.0, 2.0, 2.5], [1, 0, 2, 0], 3),
    ],
)
def test_the_weights_that_validated_best_are_kept(
    logs: Sequence[PreparedLog], tmp_path: Path, scores: list[float], diverged: list[int], best: int
) -> None:
    validate = Scripted(scores, diverged)
    model, notes = trained(logs, tmp_path, validate, multi_step=[HALF_SECOND])
    assert len(validate.seen) == 4
    assert same(state_of(model), validate.seen[best])
    assert not same(validate.seen[0], validate.seen[best])
    assert (notes["best_validation"], notes["epochs"]) == (scores[best], 4)
    assert [entry["diverged"] for entry in notes["curve"]] == diverged


@pytest.mark.parametrize(
    ("stages", "scores", "epochs"),
    [
        # one stage: stops after two validations in a row without gain
        ([9], [5.0, 4.0, 4.0, 3.0, 3.5, 3.0, 1.0], 6),
        # an earlier stage never stops the run
        ([4, 1], [1.0, 2.0], 5),
        ([2, 5], [5.0, 4.0, 3.0, 2.0, 2.0, 2.0], 6),
    ],
)
def test_stops_by_patience_in_the_last_stage(
    logs: Sequence[PreparedLog], tmp_path: Path, stages: list[int], scores: list[float], epochs: int
) -> None:
    later = [{**HALF_SECOND, "epochs": length} for length in stages[1:]]
    one_step = {**ONE_STEP, "epochs": stages[0]}
    validate = Scripted(scores)
    _, notes = trained(logs, tmp_path, validate, patience=2, one_step=one_step, multi_step=later)
    assert notes["epochs"] == len(validate.seen) == epochs


def test_validates_so_often_and_after_the_last_epoch(
    logs: Sequence[PreparedLog], tmp_path: Path
) -> None:
    validate = Scripted([1.0])
    one_step = {**ONE_STEP, "epochs": 5}
    _, notes = trained(logs, tmp_path, validate, one_step=one_step, validate_every=2)
    assert ["validation" in entry for entry in notes["curve"]] == [False, True, False, True, True]


def test_no_finite_free_run_is_one_line(logs: Sequence[PreparedLog], tmp_path: Path) -> None:
    with pytest.raises(FitError, match="mlp: no epoch gave a finite free run") as caught:
        trained(logs, tmp_path, Scripted([math.nan]))
    assert "\n" not in str(caught.value)


def test_learning_rates_fall_along_a_cosine_in_each_stage(
    logs: Sequence[PreparedLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = [
        {"horizon": 0.5, "epochs": 5, "learning_rate": 0.1, "final": 0.1},
        {"horizon": 0.5, "epochs": 1, "learning_rate": 0.05, "final": 0.5},
    ]
    module, _ = untrained(
        logs, multi_step=stages, one_step={**ONE_STEP, "epochs": 3, "learning_rate": 0.2}
    )
    optimizer = module.configure_optimizers()
    monkeypatch.setattr(
        HeadTraining, "trainer", property(lambda self: SimpleNamespace(optimizers=[optimizer]))
    )
    rates = []
    for epoch in range(9):
        module.history = [{}] * epoch
        module.on_train_epoch_start()
        (rate,) = {group["lr"] for group in optimizer.param_groups}
        rates.append(rate)
    falling = [0.01 + 0.09 * 0.5 * (1 + math.cos(math.pi * k / 4)) for k in range(5)]
    assert rates == pytest.approx([0.2, 0.2, 0.2, *falling, 0.05])


def test_weight_decay_acts_on_matrices_of_the_head_only(logs: Sequence[PreparedLog]) -> None:
    module, _ = untrained(logs, weight_decay=0.3)
    decayed = {
        id(p): group["weight_decay"]
        for group in module.configure_optimizers().param_groups
        for p in group["params"]
    }
    for name, parameter in module.model.head.named_parameters(prefix="head"):
        assert decayed[id(parameter)] == (0.3 if name.endswith("weight") else 0.0), name
    assert id(module.model.baseline.theta) not in decayed


def test_batches_hold_their_share_of_beginnings(logs: Sequence[PreparedLog]) -> None:
    module, data = untrained(
        logs, beginnings={"share": 0.25, "initial": 0.3}, multi_step=[HALF_SECOND]
    )
    for epochs, lead in ((0, 0), (2, 3)):
        module.history = [{}] * epochs
        anywhere, begun = zip(*data.train_dataloader(), strict=True)
        assert [len(part.n_elapsed) for part in anywhere] == [6, 6, 6]
        assert all(part.n_elapsed.tolist() == [lead, lead] for part in begun)
        assert any(bool((part.n_elapsed != lead).any()) for part in anywhere)
        again, _ = zip(*data.train_dataloader(), strict=True)
        assert all(torch.equal(one.y, two.y) for one, two in zip(anywhere, again, strict=True)), (
            "seed and epoch decide alone"
        )


def loss_of(module: HeadTraining, windows: Sequence[WindowBatch]) -> float:
    module.on_fit_start()
    module.history = [{}] * module.settings.one_step.epochs
    return float(module.training_step(tuple(windows), 0).detach())


def test_rollouts_start_from_the_measured_past(logs: Sequence[PreparedLog]) -> None:
    """The loss of one window, from the logs by hand: memory from the past, mean velocities at a
    beginning.
    """
    lstm = LstmConfig(hidden_size=4)
    plain, data = untrained(logs, lstm, history=0.4, multi_step=[{**HALF_SECOND, "batch": 1}])
    log, row = logs[1], 30
    beginnings = {"share": 0.5, "initial": 0.3}
    stages = [{**HALF_SECOND, "batch": 2}]
    begun, _ = untrained(logs, lstm, history=0.4, multi_step=stages, beginnings=beginnings)
    y, w, smooth = (torch.from_numpy(part).float()[None] for part in (log.y, log.w, log.smoothed))

    @torch.no_grad()
    def by_hand(first: int, past: int, x: Tensor) -> float:
        rows = slice(first - past, first)
        total = 0.0
        s = plain.model.warmup(y[:, rows], w[:, rows])
        for k in range(first, first + 5):
            x, s = plain.model.step(x, w[:, k], s)
            total += float(((x[0, 3:] - y[0, k + 1, 3:]) / SCALES).square().mean())
        return total / 5

    here = by_hand(row, 4, smooth[:, row])
    anywhere = data.make_window_batch(torch.tensor([len(logs[0]) + row]), 6, 4)
    assert loss_of(plain, [anywhere]) == pytest.approx(here, rel=1e-4)
    there = by_hand(3, 3, torch.cat((smooth[:, 3, :3], y[:, :3, 3:].mean(1)), dim=-1))
    beginning = data.make_window_batch(torch.tensor([len(logs[0]) + 3]), 6, 3)
    assert loss_of(begun, [anywhere, beginning]) == pytest.approx((here + there) / 2, rel=1e-4)


def test_short_logs_need_no_room_for_a_stage_without_epochs(tmp_path: Path) -> None:
    """3 s of log hold no one-step window of 5 s; without one-step epochs none is asked for."""
    short = trials(seconds=3.0, window=0.5)
    stages = [{**HALF_SECOND, "epochs": 1}]
    config = {"one_step": {"epochs": 0}, "multi_step": stages, "history": 0.0}
    _, notes = trained(short, tmp_path, Scripted([1.0]), **config)
    assert notes["epochs"] == 1
    with pytest.raises(DataError, match="window of 50 samples"):
        trained(short, tmp_path / "other", Scripted([1.0]), one_step={"epochs": 1})


def test_tensorboard_shows_axes_rate_settings_and_a_free_run(
    logs: Sequence[PreparedLog], tmp_path: Path
) -> None:
    """A validation that knows its axes and a free run leaves them, with the final score."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    t = torch.arange(4.0)

    def validate(model: HybridDynamics) -> Score:
        return Score(0, 1.5, {"u": 1.0, "v": 2.0}, ExampleRun(t, {"u": (t, t + 1)}))

    # beginnings shorter than a step take one sample
    beginnings = {"initial": STEP / 10}
    _, notes = trained(logs, tmp_path, validate, multi_step=[HALF_SECOND], beginnings=beginnings)
    assert all(math.isfinite(entry["loss"]) for entry in notes["curve"])
    events = EventAccumulator(str(tmp_path / "tensorboard" / "mlp")).Reload()
    tags = events.Tags()
    shown = {"loss", "validation", "validation_u", "validation_v", "learning_rate"}
    assert shown <= set(tags["scalars"])
    assert [round(one.value, 6) for one in events.Scalars("validation_v")] == [2.0] * 4
    assert events.Scalars("learning_rate")[0].value == pytest.approx(2e-3)
    assert events.Scalars("best_validation")[-1].value == 1.5
    assert tags["images"] == ["free run"]


HEADS = {
    "mlp": MlpConfig(hidden=(6,)),
    "mirrored mlp": MlpConfig(hidden=(6,), mirror=True),
    "lstm": LstmConfig(hidden_size=4, readout=0),
    "lstm with readout": LstmConfig(hidden_size=4, readout=5),
    "lstm of commands": LstmConfig(hidden_size=4, memory=("tau_x",), readout=5),
    "lstm per axis": LstmConfig(
        hidden_size=4, readout=0, activation="softsign", per_axis=True, restoring=True
    ),
}
SETTINGS: dict[str, Any] = {
    "steps": 10,
    "one_step": {"epochs": 1, "window": 1.0, "batch": 9, "washout": 0.2},
    "multi_step": [{"horizon": 0.5, "epochs": 4, "batch": 7}],
    "start_noise": 0.1,
    "beginnings": {"share": 0.3, "initial": 0.3},
}


def validated(model: HybridDynamics) -> Score:
    """A score that needs no free run."""
    return Score(0, float(sum(p.square().sum() for p in model.head.parameters())))


@pytest.mark.parametrize("has_baseline", [True, False])
def test_networks_are_calibrated_on_both_sides_and_with_a_gain(has_baseline: bool) -> None:
    head_config = GRUEnsembleConfig(members=2, hidden_size=4, step=5 * STEP, margin=0.0)
    model, residual, _ = prepared(trials(), head_config)
    head = of_kind(model.head, GRUEnsembleHead)
    if not has_baseline:
        zero = ZeroBaselineConfig().build(model.signals.names)
        model = HybridDynamics(model.signals, zero, head, model.dt, model.integrator)
    settings = {"multi_step": [{"horizon": 0.5, "epochs": 1, "batch": 4}], "mirror": True}
    config = TrainingConfig.model_validate(settings)
    store = WindowStore.from_logs(trials(), torch.float32)
    make_training(TrainingSetup(model, residual, store, config, SCALES, validated, 0))
    # v, r and tau_n change their signs in the mirror
    sideways = [1, 2, 4]
    torch.testing.assert_close(head.features.low[sideways], -head.features.high[sideways])
    assert bool((head.features.mean[sideways].abs() < 1e-12).all())
    gain = head.training_gain
    if has_baseline:
        assert gain is None
    else:
        assert gain is not None
        # an output of 1 changes each velocity by half a standard deviation in a step
        increment = gain * head.residual_scale() * head.training_step
        torch.testing.assert_close(increment.float(), 0.5 * head.features.std[:3].float())
    finish_training(model)
    assert head.training_gain is None


def losses_of(
    head: str, dtype: torch.dtype = torch.float64, folder: Path | None = None, **settings: Any
) -> list[float]:
    """Train; returns the loss of each epoch."""
    model, residual, _ = prepared(trials(), HEADS[head])
    store = WindowStore.from_logs(trials(), dtype)
    precision = "64-true" if dtype == torch.float64 else "32-true"
    config = TrainingConfig.model_validate({**SETTINGS, "precision": precision, **settings})
    setup = TrainingSetup(model.to(dtype), residual, store, config, SCALES, validated, 0)
    notes = train("net", setup, folder)
    return [row["loss"] for row in notes["curve"]]


@pytest.mark.parametrize("name", HEADS)
def test_no_tensor_of_a_training_step_is_made_without_a_device(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the default device `meta`, a tensor made without one cannot meet the others."""
    with torch.device("meta"), pytest.raises((RuntimeError, NotImplementedError)):
        (torch.ones(2, device="cpu") + torch.zeros(2)).sum().item()
    # free runs in C are those of the CPU, and are there where an earlier test compiled the step
    monkeypatch.setattr("residnet.training.heads.compile_rollout", lambda rollout, steps: rollout)
    module, data = untrained(trials(), HEADS[name], **SETTINGS)
    for epochs in (0, 1):
        module.history = [{}] * epochs
        windows = next(iter(data.train_dataloader()))
        with torch.device("meta"):
            module._losses = []
            module.training_step(windows, 0).backward()
            module.on_train_batch_end(None, None, 0)
        assert len(module._losses) == 1


def test_a_device_that_is_not_there_is_one_line() -> None:
    there = torch.cuda.device_count()
    with pytest.raises(UsageError, match=f"PyTorch finds {there}; give device: cpu"):
        MachineConfig(device=f"cuda:{there}").for_lightning()
    expected = "gpu" if there else "cpu"
    assert MachineConfig(device="auto").for_lightning()["accelerator"] == expected


def test_double_precision_trains_to_the_same_losses() -> None:
    single, double = (
        losses_of("mlp", dtype, start_noise=0.0) for dtype in (torch.float32, torch.float64)
    )
    assert double == pytest.approx(single, rel=1e-4)
    # were it single precision too, they would be equal
    assert double != single


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU is at hand")
def test_a_gpu_trains_to_the_same_losses() -> None:
    cpu, gpu = (losses_of("lstm", device=device) for device in ("cpu", "cuda"))
    assert gpu == pytest.approx(cpu, rel=1e-6)


@pytest.mark.long
def test_two_processes_train_as_one(tmp_path: Path) -> None:
    """The losses of the first 50 steps in float64, batches of odd size, two gloo processes."""
    # one step an epoch, so that the curve holds every loss
    one_step = {**SETTINGS["one_step"], "epochs": 25}
    multi_step = [{**SETTINGS["multi_step"][0], "epochs": 25}]
    settings: dict[str, Any] = {"robust": 0.3, "steps": 1, "patience": 100}
    settings |= {"one_step": one_step, "multi_step": multi_step}
    one, two = (
        losses_of("lstm", folder=tmp_path / str(count), processes=count, **settings)
        for count in (1, 2)
    )
    assert len(one) == 50
    assert two == pytest.approx(one, rel=1e-6)
