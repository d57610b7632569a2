"""The trainer on a small vessel: it learns, stops, and keeps what validated best."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from made_system import LINEAR, SCALES, STEP, free_run_error, model_of, trials
from torch import Tensor

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.errors import DataError, FitError
from residnet.core.samples import Samples
from residnet.data.module import Windows, WindowsDataModule
from residnet.data.prepare import Prepared, samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig
from residnet.training.config import TrainingConfig
from residnet.training.heads import HeadTraining, Validate, train
from residnet.training.score import Score, Shown

ONE_STEP = {"epochs": 2, "window": 1.0, "batch": 8}
HALF_SECOND = {"horizon": 0.5, "epochs": 2, "batch": 8}


@pytest.fixture(scope="module")
def logs() -> Sequence[Prepared]:
    return trials()


def prepared(
    logs: Sequence[Prepared], head: Any = None
) -> tuple[HybridDynamics, Samples, WindowStore]:
    """A linear baseline of the quadratic vessel with a fresh head on it."""
    torch.manual_seed(1)
    model = model_of(
        LINEAR, head=(head or MlpConfig(hidden=(12,))).build(("u", "v", "r", "tau_x", "tau_n"))
    )
    known = samples(logs, model.signals)
    RegressorsConfig(terms=LINEAR).fit(model.baseline, known)
    with torch.no_grad():
        residual = known.with_target(known.target - model.baseline(known.z))
    return model, residual, WindowStore.gather(logs)


def state_of(model: HybridDynamics) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in model.state_dict().items()}


class Scripted:
    """A validation that says what it is told, and remembers which model and weights it saw."""

    def __init__(self, scores: Sequence[float], diverged: Sequence[int] = (0,)) -> None:
        self.scores = itertools.chain(scores, itertools.repeat(scores[-1]))
        self.diverged = itertools.chain(diverged, itertools.repeat(diverged[-1]))
        self.seen: list[dict[str, Tensor]] = []
        self.models: list[HybridDynamics] = []

    def __call__(self, model: HybridDynamics) -> Score:
        self.seen.append(state_of(model))
        self.models.append(model)
        return Score(next(self.diverged), next(self.scores))


def trained(
    logs: Sequence[Prepared],
    folder: Path,
    validate: Validate,
    **config: Any,
) -> tuple[HybridDynamics, dict[str, Any]]:
    model, residual, store = prepared(logs)
    settings = TrainingConfig.model_validate({"steps": 3, "one_step": ONE_STEP, **config})
    notes = train("mlp", model, residual, store, settings, SCALES, validate, 0, folder)
    return model, notes


def same(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


def untrained(
    logs: Sequence[Prepared], head: Any = None, **config: Any
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


def test_the_weights_that_validated_best_are_kept(logs: Sequence[Prepared], tmp_path: Path) -> None:
    validate = Scripted([3.0, 1.0, 2.0, 2.0])
    model, notes = trained(logs, tmp_path, validate, multi_step=[HALF_SECOND])
    assert len(validate.seen) == 4
    assert same(state_of(model), validate.seen[1])
    assert not same(validate.seen[1], validate.seen[3])
    assert (notes["best_validation"], notes["epochs"]) == (1.0, 4)


def test_weights_that_diverge_never_beat_steady_ones(
    logs: Sequence[Prepared], tmp_path: Path
) -> None:
    validate = Scripted([1.0, 3.0, 2.0, 2.5], diverged=[1, 0, 2, 0])
    model, notes = trained(logs, tmp_path, validate, multi_step=[HALF_SECOND])
    assert same(state_of(model), validate.seen[3])
    assert notes["best_validation"] == 2.5
    assert [entry["diverged"] for entry in notes["curve"]] == [1.0, 0.0, 2.0, 0.0]


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
    logs: Sequence[Prepared], tmp_path: Path, stages: list[int], scores: list[float], epochs: int
) -> None:
    later = [{**HALF_SECOND, "epochs": length} for length in stages[1:]]
    validate = Scripted(scores)
    _, notes = trained(
        logs,
        tmp_path,
        validate,
        patience=2,
        one_step={**ONE_STEP, "epochs": stages[0]},
        multi_step=later,
    )
    assert notes["epochs"] == len(validate.seen) == epochs


def test_validates_so_often_and_after_the_last_epoch(
    logs: Sequence[Prepared], tmp_path: Path
) -> None:
    validate = Scripted([1.0])
    _, notes = trained(
        logs, tmp_path, validate, one_step={**ONE_STEP, "epochs": 5}, validate_every=2
    )
    assert ["validation" in entry for entry in notes["curve"]] == [False, True, False, True, True]


def test_no_finite_free_run_is_one_line(logs: Sequence[Prepared], tmp_path: Path) -> None:
    with pytest.raises(FitError, match="mlp: no epoch gave a finite free run") as caught:
        trained(logs, tmp_path, Scripted([math.nan]))
    assert "\n" not in str(caught.value)


def test_learning_rates_fall_along_a_cosine_in_each_stage(
    logs: Sequence[Prepared], monkeypatch: pytest.MonkeyPatch
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


def test_weight_decay_acts_on_matrices_of_the_head_only(logs: Sequence[Prepared]) -> None:
    module, _ = untrained(logs, weight_decay=0.3)
    decayed = {
        id(p): group["weight_decay"]
        for group in module.configure_optimizers().param_groups
        for p in group["params"]
    }
    for name, parameter in module.model.head.named_parameters(prefix="head"):
        assert decayed[id(parameter)] == (0.3 if name.endswith("weight") else 0.0), name
    assert id(module.model.baseline.theta) not in decayed


def test_batches_hold_their_share_of_beginnings(logs: Sequence[Prepared]) -> None:
    module, data = untrained(
        logs, beginnings={"share": 0.25, "initial": 0.3}, multi_step=[HALF_SECOND]
    )
    for epochs, lead in ((0, 0), (2, 3)):
        module.history = [{}] * epochs
        anywhere, begun = zip(*data.train_dataloader(), strict=True)
        assert [len(part.depth) for part in anywhere] == [6, 6, 6]
        assert all(part.depth.tolist() == [lead, lead] for part in begun)
        assert any(bool((part.depth != lead).any()) for part in anywhere)
        again, _ = zip(*data.train_dataloader(), strict=True)
        assert all(torch.equal(one.y, two.y) for one, two in zip(anywhere, again, strict=True)), (
            "seed and epoch decide alone"
        )


def loss_of(module: HeadTraining, windows: Sequence[Windows]) -> float:
    module.on_fit_start()
    module.history = [{}] * module.settings.one_step.epochs
    return float(module.training_step(tuple(windows), 0).detach())


def test_rollouts_start_from_the_measured_past(logs: Sequence[Prepared]) -> None:
    """The loss of one window, from the logs by hand: memory from the past, mean velocities at a
    beginning.
    """
    lstm = LstmConfig(hidden_size=4)
    plain, data = untrained(logs, lstm, history=0.4, multi_step=[{**HALF_SECOND, "batch": 1}])
    log, row = logs[1], 30
    start = len(logs[0]) + row
    begun, _ = untrained(
        logs,
        lstm,
        history=0.4,
        multi_step=[{**HALF_SECOND, "batch": 2}],
        beginnings={"share": 0.5, "initial": 0.3},
    )

    def by_hand(first: int, past: int, x0: Tensor) -> float:
        model = plain.model

        def tensor(values: Any) -> Tensor:
            return torch.from_numpy(values).float()[None]

        with torch.no_grad():
            x, s = (
                x0[None],
                model.warmup(
                    tensor(log.y[first - past : first]), tensor(log.w[first - past : first])
                ),
            )
            total = 0.0
            for k in range(first, first + 5):
                x, s = model.step(x, tensor(log.w[k]), s)
                total += float(((x[0, 3:] - tensor(log.y[k + 1, 3:])[0]) / SCALES).square().mean())
        return total / 5

    here = by_hand(row, 4, torch.from_numpy(log.smooth[row]).float())
    anywhere = data.windows(torch.tensor([start]), 6, 4)
    assert loss_of(plain, [anywhere]) == pytest.approx(here, rel=1e-4)
    at_rest = torch.cat(
        (torch.from_numpy(log.smooth[3, :3]), torch.from_numpy(log.y[:3, 3:].mean(0)))
    ).float()
    there = by_hand(3, 3, at_rest)
    beginning = data.windows(torch.tensor([len(logs[0]) + 3]), 6, 3)
    assert loss_of(begun, [anywhere, beginning]) == pytest.approx((here + there) / 2, rel=1e-4)


def test_short_logs_need_no_room_for_a_stage_without_epochs(tmp_path: Path) -> None:
    """3 s of log hold no one-step window of 5 s; without one-step epochs none is asked for."""
    short = trials(seconds=3.0, window=0.5)
    config = {
        "one_step": {"epochs": 0},
        "multi_step": [{**HALF_SECOND, "epochs": 1}],
        "history": 0.0,
    }
    _, notes = trained(short, tmp_path, Scripted([1.0]), **config)
    assert notes["epochs"] == 1
    with pytest.raises(DataError, match="window of 50 samples"):
        trained(short, tmp_path / "other", Scripted([1.0]), one_step={"epochs": 1})


def test_beginnings_shorter_than_a_step_take_one_sample(
    logs: Sequence[Prepared], tmp_path: Path
) -> None:
    _, notes = trained(
        logs, tmp_path, Scripted([1.0]), multi_step=[HALF_SECOND], beginnings={"initial": STEP / 10}
    )
    assert all(math.isfinite(entry["loss"]) for entry in notes["curve"])


def test_tensorboard_shows_axes_rate_settings_and_a_free_run(
    logs: Sequence[Prepared], tmp_path: Path
) -> None:
    """A validation that knows its axes and a free run leaves them, with the final score."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    t = torch.arange(4.0)

    def validate(model: HybridDynamics) -> Score:
        return Score(0, 1.5, {"u": 1.0, "v": 2.0}, Shown(t, {"u": (t, t + 1)}))

    trained(logs, tmp_path, validate, multi_step=[HALF_SECOND])
    events = EventAccumulator(str(tmp_path / "tensorboard" / "mlp")).Reload()
    tags = events.Tags()
    assert {"loss", "validation", "validation_u", "validation_v", "learning_rate"} <= set(
        tags["scalars"]
    )
    assert [round(one.value, 6) for one in events.Scalars("validation_v")] == [2.0] * 4
    assert events.Scalars("learning_rate")[0].value == pytest.approx(2e-3)
    assert events.Scalars("best_validation")[-1].value == 1.5
    assert tags["images"] == ["free run"]
