"""The monitor: planted changes are named, clean logs raise no alarm, breaks begin anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from residnet.core.errors import DataError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec
from residnet.identification.changes import Change, ChangedDynamics
from residnet.identification.monitoring import (
    MonitorConfig,
    Piece,
    Verdict,
    Watch,
    Watcher,
)
from residnet.identification.recursive_refit import recursive_refit
from residnet.testing.checks import STEP, example_model, example_spec

SECONDS, WINDOW = 60, 100
NOISE = np.array([0.0, 0.0, 0.002, 0.02, 0.02, 0.003])
NONE = Change("none", "", "", 1.0)


@pytest.fixture(scope="module")
def known() -> tuple[ModelSpec, HybridDynamics]:
    spec = example_spec(None)
    return spec, example_model(spec).to(torch.float64)


def logs(
    model: HybridDynamics, change: Change, count: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """States and inputs of runs of a changed vessel under random revolutions, with noise."""
    random = np.random.default_rng(seed)
    steps = round(SECONDS / STEP)
    held = random.uniform(-10, 25, size=(count, steps // 50 + 1, 2)).repeat(50, axis=1)[:, :steps]
    x0 = np.zeros((count, 6))
    x0[:, 2] = random.uniform(-3, 3, size=count)
    x0[:, 3] = 1.0
    with torch.no_grad():
        states, _, _ = Rollout(ChangedDynamics(model, [change], count, 2))(
            torch.from_numpy(x0), torch.from_numpy(held), torch.zeros(count, 0)
        )
    y = states.numpy() + NOISE * random.normal(size=states.shape)
    if change.sensor == "gyro_scale":
        y[:, :, 5] *= 1.0 + change.size
    return [(y[i], held[i]) for i in range(count)]


def windows(log: tuple[np.ndarray, np.ndarray]) -> list[Piece]:
    y, w = log
    empty_y, empty_w = y[:0], w[:0]
    return [
        Piece(y[k : k + WINDOW + 1], w[k : k + WINDOW], empty_y, empty_w)
        for k in range(0, len(w) - WINDOW + 1, WINDOW)
    ]


@pytest.fixture(scope="module")
def watch(known: tuple[ModelSpec, HybridDynamics]) -> Watch:
    spec, model = known
    clean = [windows(log) for log in logs(model, NONE, 30, 0)]
    return Watch(spec, model, clean, MonitorConfig())


@pytest.mark.parametrize(
    "change",
    [
        Change("mass", "", "", 0.15, heavier=1.0),
        Change("gain n_stbd", "", "", -0.1, gain=1),
        Change("damping yaw", "", "", -0.2, damping="r"),
        Change("gyro scale", "", "", 0.05, sensor="gyro_scale"),
    ],
    ids=lambda change: change.name,
)
def test_a_planted_change_is_found_and_named(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch, change: Change
) -> None:
    for seed in range(1):
        watcher = Watcher(watch)
        verdict = None
        for log in logs(known[1], change, 5, 50 + seed):
            watcher.restart()
            for sums in watch.sums(windows(log)):
                verdict = watcher.take(sums)
        assert verdict is not None
        assert verdict.alarm
        first = verdict.suspects[0]
        assert first.change.name == change.name
        assert first.size == pytest.approx(change.size, rel=0.3, abs=3 * first.error)


def test_clean_logs_raise_no_alarm(known: tuple[ModelSpec, HybridDynamics], watch: Watch) -> None:
    watcher, alarms = Watcher(watch), 0
    for log in logs(known[1], NONE, 15, 99):
        watcher.restart()
        alarms += any(watcher.take(sums).alarm for sums in watch.sums(windows(log)))
    assert alarms == 0


def test_an_alarm_ends_where_scores_have_fallen_clearly_below_the_threshold(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    sums = watch.sums(windows(logs(known[1], NONE, 1, 7)[0]))[:1]
    plain = watch.judge([0], sums)
    above = iter([-0.1, 0.2, -0.3, -0.9, -1.1, -0.5, 0.1])

    def judge(*_: object) -> Verdict:
        score = watch.threshold + next(above)
        suspects = [replace(plain.suspects[0], score=score), *plain.suspects[1:]]
        return replace(plain, alarm=score > watch.threshold, suspects=suspects)

    monkeypatch.setattr(watch, "judge", judge)
    watcher = Watcher(watch)
    alarms = [watcher.take(sums[0]).alarm for _ in range(7)]
    assert alarms == [False, True, True, True, False, False, True]


def test_sample_by_sample_it_says_what_windows_say(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch
) -> None:
    y, w = logs(known[1], NONE, 1, 7)[0]
    whole, single = Watcher(watch), Watcher(watch)
    wanted = [whole.take(sums) for sums in watch.sums(windows((y, w)))]
    given = np.concatenate((w, w[-1:]))
    found = [verdict for k in range(len(y)) if (verdict := single.step(y[k], given[k])) is not None]
    assert len(found) == len(wanted)
    assert found[-1].suspects[0].score == pytest.approx(wanted[-1].suspects[0].score)
    # a lost sample begins anew
    assert single.step(np.full(6, np.nan), w[0]) is None
    assert all(single.step(y[k], given[k]) is None for k in range(WINDOW))


def test_a_refit_finds_the_size_of_a_planted_change_and_leaves_the_old_model_alone(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch
) -> None:
    weaker = Change("gain n_stbd", "", "", -0.1, gain=1)
    fresh = logs(known[1], weaker, 3, 50)
    before = known[1].baseline.state_dict()["theta"].clone()
    found = recursive_refit(watch, [windows(log) for log in fresh])
    assert torch.equal(known[1].baseline.state_dict()["theta"], before)
    (moved,) = found.moved
    assert moved.change.name == "gain n_stbd"
    assert moved.size == pytest.approx(-0.1, abs=2 * moved.error)
    assert moved.error < 0.005
    assert len(moved.after) == len(fresh)
    assert found.before.alarm
    assert not found.verdict.alarm
    # on a log that the refit has not seen, the new model runs as the changed vessel does
    (y, w), *_ = logs(known[1], weaker, 1, 91)
    start, inputs = torch.from_numpy(y[:1]), torch.from_numpy(w[None])
    errors = [
        float(
            np.abs(Rollout(model)(start, inputs, torch.zeros(1, 0))[0][0].numpy() - y)[:, 3].max()
        )
        for model in (known[1], found.model)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_a_refit_leaves_errors_of_sensors_and_unchanged_vessels_alone(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch
) -> None:
    gyro = Change("gyro scale", "", "", 0.05, sensor="gyro_scale")
    for change, words in ((gyro, "mend the sensor"), (NONE, "no cause exceeds")):
        found = recursive_refit(watch, [windows(log) for log in logs(known[1], change, 3, 50)])
        assert not found.moved
        assert found.model is watch.model
        assert words in found.ended


def test_too_few_clean_logs_are_refused(known: tuple[ModelSpec, HybridDynamics]) -> None:
    spec, model = known
    with pytest.raises(DataError, match="needs at least 5"):
        Watch(spec, model, [windows(log) for log in logs(model, NONE, 2, 0)], MonitorConfig())


def test_windows_that_run_away_tell_nothing(
    known: tuple[ModelSpec, HybridDynamics], watch: Watch
) -> None:
    """A start that no vessel has ends a free run far off; the verdict stays that of the others."""
    y, w = logs(known[1], NONE, 1, 7)[0]
    wild = y.copy()
    wild[:, 5] = 1e9
    alone = watch.sums(windows((wild, w)))
    assert all(np.isfinite(one.score).all() and not one.score.any() for one in alone)
    assert not np.isnan(
        watch.judge([0], [alone[0] + watch.sums(windows((y, w)))[0]]).suspects[0].score
    )
