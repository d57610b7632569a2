"""The monitor: planted changes are named, clean logs raise no alarm, scores scatter as claimed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from residnet.core.errors import DataError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import Rollout, trace_rollout
from residnet.identification.change_scores import (
    GroupScores,
    ScoreDistribution,
    compute_robust_score_sums,
    estimate_score_inflation,
    fit_score_distribution,
)
from residnet.identification.changes import PerturbedDynamics, SystemChange
from residnet.identification.monitoring import (
    ChangeDetector,
    MeasuredWindow,
    MonitorConfig,
    MonitorVerdict,
    OnlineChangeDetector,
)
from residnet.identification.recursive_refit import refit_recursively
from residnet.testing.checks import EXAMPLE_TIME_STEP, make_example_model, make_example_spec

SECONDS = 60
WINDOW = 100
NOISE = np.array([0.0, 0.0, 0.002, 0.02, 0.02, 0.003])
NONE = SystemChange("none", "", "", 1.0)


@pytest.fixture(scope="module")
def known() -> tuple[ModelSpec, HybridDynamics]:
    spec = make_example_spec(None)
    return spec, make_example_model(spec).to(torch.float64)


def logs(
    model: HybridDynamics, change: SystemChange, count: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """States and inputs of runs of a changed vessel under random revolutions, with noise."""
    random = np.random.default_rng(seed)
    steps = round(SECONDS / EXAMPLE_TIME_STEP)
    held = random.uniform(-10, 25, size=(count, steps // 50 + 1, 2)).repeat(50, axis=1)[:, :steps]
    x0 = np.zeros((count, 6))
    x0[:, 2] = random.uniform(-3, 3, size=count)
    x0[:, 3] = 1.0
    # an unchanged vessel can be compiled; rows of a changed one depend on their block
    rollout = (
        compile_rollout(Rollout(model), steps)
        if change.sensor or change is NONE
        else trace_rollout(Rollout(PerturbedDynamics(model, [change], count, 2)), steps)
    )
    with torch.no_grad():
        states, _, _ = rollout(torch.from_numpy(x0), torch.from_numpy(held), torch.zeros(count, 0))
    y = states.numpy() + NOISE * random.normal(size=states.shape)
    if change.sensor == "gyro_scale":
        y[:, :, 5] *= 1.0 + change.size
    return [(y[i], held[i]) for i in range(count)]


def windows(log: tuple[np.ndarray, np.ndarray]) -> list[MeasuredWindow]:
    y, w = log
    starts = range(0, len(w) - WINDOW + 1, WINDOW)
    return [MeasuredWindow(y[k : k + WINDOW + 1], w[k : k + WINDOW], y[:0], w[:0]) for k in starts]


@pytest.fixture(scope="module")
def watch(known: tuple[ModelSpec, HybridDynamics]) -> ChangeDetector:
    spec, model = known
    clean = [windows(log) for log in logs(model, NONE, 20, 0)]
    with pytest.raises(DataError, match="needs at least 5"):
        ChangeDetector(spec, model, clean[:2], MonitorConfig())
    return ChangeDetector(spec, model, clean, MonitorConfig())


@pytest.mark.parametrize(
    "change",
    [
        SystemChange("mass", "", "", 0.15, inertia_share=1.0),
        # a refit below finds this one, too
        pytest.param(
            SystemChange("gain n_stbd", "", "", -0.1, gain_input=1), marks=pytest.mark.long
        ),
        pytest.param(
            SystemChange("damping yaw", "", "", -0.2, damping="r"), marks=pytest.mark.long
        ),
        SystemChange("gyro scale", "", "", 0.05, sensor="gyro_scale"),
    ],
    ids=lambda change: change.name,
)
def test_a_planted_change_is_found_and_named(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector, change: SystemChange
) -> None:
    watcher = OnlineChangeDetector(watch)
    for log in logs(known[1], change, 4, 50):
        watcher.start_new_log()
        *_, verdict = map(watcher.update_with_sums, watch.compute_sums(windows(log)))
    assert verdict.is_alarm
    first = verdict.hypotheses[0]
    assert first.change.name == change.name
    assert first.estimated_size == pytest.approx(change.size, rel=0.3, abs=3 * first.standard_error)


def test_clean_logs_raise_no_alarm(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector
) -> None:
    watcher = OnlineChangeDetector(watch)
    for log in logs(known[1], NONE, 6, 99):
        watcher.start_new_log()
        assert not any(
            watcher.update_with_sums(sums).is_alarm for sums in watch.compute_sums(windows(log))
        )


def test_an_alarm_ends_where_scores_have_fallen_clearly_below_the_threshold(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    sums = watch.compute_sums(windows(logs(known[1], NONE, 1, 7)[0]))[:1]
    plain = watch.evaluate([0], sums)
    above = iter([-0.1, 0.2, -0.3, -0.9, -1.1, -0.5, 0.1])

    def judge(*_: object) -> MonitorVerdict:
        score = watch.threshold + next(above)
        suspects = [replace(plain.hypotheses[0], test_statistic=score), *plain.hypotheses[1:]]
        return replace(plain, is_alarm=score > watch.threshold, hypotheses=suspects)

    monkeypatch.setattr(watch, "evaluate", judge)
    watcher = OnlineChangeDetector(watch)
    alarms = [watcher.update_with_sums(sums[0]).is_alarm for _ in range(7)]
    assert alarms == [False, True, True, True, False, False, True]


def test_sample_by_sample_it_says_what_windows_say(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector
) -> None:
    y, w = logs(known[1], NONE, 1, 7)[0]
    whole = OnlineChangeDetector(watch)
    single = OnlineChangeDetector(watch)
    wanted = [whole.update_with_sums(sums) for sums in watch.compute_sums(windows((y, w)))]
    given = np.concatenate((w, w[-1:]))
    found = [
        verdict for k in range(len(y)) if (verdict := single.update(y[k], given[k])) is not None
    ]
    assert len(found) == len(wanted)
    assert found[-1].hypotheses[0].test_statistic == pytest.approx(
        wanted[-1].hypotheses[0].test_statistic
    )
    # a lost sample begins anew
    assert single.update(np.full(6, np.nan), w[0]) is None
    assert all(single.update(y[k], given[k]) is None for k in range(WINDOW))


# 6 s; test_a_refit_leaves_errors_of_sensors_and_unchanged_vessels_alone also refits
@pytest.mark.long
def test_a_refit_finds_the_size_of_a_planted_change_and_leaves_the_old_model_alone(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector
) -> None:
    weaker = SystemChange("gain n_stbd", "", "", -0.1, gain_input=1)
    fresh = logs(known[1], weaker, 3, 50)
    before = known[1].baseline.state_dict()["theta"].clone()
    found = refit_recursively(watch, [windows(log) for log in fresh])
    assert torch.equal(known[1].baseline.state_dict()["theta"], before)
    (moved,) = found.identified_changes
    assert moved.change.name == "gain n_stbd"
    assert moved.estimated_size == pytest.approx(-0.1, abs=2 * moved.standard_error)
    assert moved.standard_error < 0.005
    assert len(moved.size_by_log) == len(fresh)
    assert found.verdict_before.is_alarm
    assert not found.verdict_after.is_alarm
    # on a log that the refit has not seen, the new model runs as the changed vessel does
    (y, w), *_ = logs(known[1], weaker, 1, 91)
    begun = torch.from_numpy(y[:1]), torch.from_numpy(w[None]), torch.zeros(1, 0)
    old, new = (
        np.abs(Rollout(model)(*begun)[0][0].detach().numpy() - y)[:, 3].max()
        for model in (known[1], found.model)
    )
    assert new < 0.5 * old


def test_a_refit_leaves_errors_of_sensors_and_unchanged_vessels_alone(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector
) -> None:
    gyro = SystemChange("gyro scale", "", "", 0.05, sensor="gyro_scale")
    for change, words in ((gyro, "correct the sensor"), (NONE, "no cause exceeds")):
        found = refit_recursively(watch, [windows(log) for log in logs(known[1], change, 3, 50)])
        assert not found.identified_changes
        assert found.model is watch.model
        assert words in found.stopping_reason


def test_windows_that_run_away_tell_nothing(
    known: tuple[ModelSpec, HybridDynamics], watch: ChangeDetector
) -> None:
    """A start that no vessel has ends a free run far off; the verdict stays that of the others."""
    y, w = logs(known[1], NONE, 1, 7)[0]
    wild = y.copy()
    wild[:, 5] = 1e9
    alone = watch.compute_sums(windows((wild, w)))
    assert all(np.isfinite(one.score).all() and not one.score.any() for one in alone)
    both = alone[0] + watch.compute_sums(windows((y, w)))[0]
    assert not np.isnan(watch.evaluate([0], [both]).hypotheses[0].test_statistic)


CAUSES = 3
ALIKE = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
"""Information about causes of which two look much the same."""


UNCHANGED = np.zeros(CAUSES)


def groups(
    random: np.random.Generator,
    logs: int,
    each: int,
    change: np.ndarray,
    apart: float,
    shared: float = 0.0,
) -> GroupScores:
    """Groups whose information varies a hundredfold, logs and groups of sizes of their own."""
    log = np.arange(logs).repeat(each)
    information = ALIKE * 10.0 ** random.uniform(0, 2, (logs * each, 1, 1))
    size = change + (shared * random.normal(size=(logs, CAUSES)))[log]
    size = size + apart * random.normal(size=(len(log), CAUSES))
    noise = np.linalg.cholesky(information) @ random.normal(size=(len(log), CAUSES, 1))
    return GroupScores(log, (information @ size[..., None] + noise)[..., 0], information)


def scores(scatter: ScoreDistribution, count: int, made: Callable[[], GroupScores]) -> float:
    """How far the scores of all causes scatter over drawn groups."""
    found = []
    for _ in range(count):
        size, error, _ = scatter.estimate_sizes(made())
        found.append(size / error)
    return float(np.std(found))


def joined(*parts: GroupScores) -> GroupScores:
    each = zip(*(vars(part).values() for part in parts), strict=True)
    return GroupScores(*(np.concatenate(one) for one in each))


def test_much_information_about_a_wrong_model_is_no_alarm() -> None:
    random = np.random.default_rng(0)
    scatter = fit_score_distribution(groups(random, 60, 1, UNCHANGED, 0.5))
    assert 0.75 < scores(scatter, 200, lambda: groups(random, 5, 1, UNCHANGED, 0.5)) < 1.2
    # without what logs differ in, five vigorous logs would seem to know better
    assert (scatter.size_variance > 0.05).all()


def test_groups_of_one_log_share_what_is_their_own() -> None:
    random = np.random.default_rng(1)
    scatter = fit_score_distribution(groups(random, 40, 5, UNCHANGED, 0.1, shared=0.5))
    assert (scatter.shared_size_variance > 0.5 * scatter.size_variance).all()
    spread = scores(scatter, 300, lambda: groups(random, 1, 5, UNCHANGED, 0.1, shared=0.5))
    assert 0.8 < spread < 1.25
    free = fit_score_distribution(groups(random, 40, 5, UNCHANGED, 0.5))
    assert (free.shared_size_variance < 0.3 * free.size_variance).all()
    # where no clean log tells, a single log counts once
    alone = fit_score_distribution(groups(random, 40, 1, UNCHANGED, 0.5))
    np.testing.assert_array_equal(alone.shared_size_variance, alone.size_variance)


def test_what_lasts_for_a_stretch_makes_its_scores_lie_wider() -> None:
    """Logs left out tell it: pairs of groups of a long log share less than those of a stretch."""
    random = np.random.default_rng(3)

    def sailed(logs: int, legs: int) -> GroupScores:
        parts = [groups(random, 1, 5, UNCHANGED, 0.05, shared=0.5) for _ in range(logs * legs)]
        return replace(joined(*parts), log_index=np.arange(logs).repeat(5 * legs))

    held = joined(*(sailed(2, 4) for _ in range(5)))
    fold = np.arange(5).repeat(40)
    scatter = fit_score_distribution(held)
    spread = scores(scatter, 300, lambda: sailed(1, 1))
    assert spread > 1.3
    assert 0.75 < spread / estimate_score_inflation(held, fold, 5) < 1.25
    free = joined(*(groups(random, 8, 1, UNCHANGED, 0.5) for _ in range(5)))
    assert estimate_score_inflation(free, np.arange(5).repeat(8), 5) < 1.2


def test_one_log_at_odds_with_the_others_does_not_speak_for_all() -> None:
    random = np.random.default_rng(5)
    scatter = fit_score_distribution(groups(random, 60, 1, UNCHANGED, 0.1))
    changed = []
    strange = []
    for _ in range(50):
        known = groups(random, 5, 1, UNCHANGED, 0.1)
        # a manoeuvre that no clean log held asks for ten standard deviations alone
        known.score[-1] += 10.0 * np.sqrt(scatter.variance(known.diagonal_information))[-1]
        size, error, _ = scatter.estimate_sizes(known)
        strange.append(np.abs(size / error).max())
        size, error, _ = scatter.estimate_sizes(
            groups(random, 5, 1, np.array([0.0, 0.0, 2.0]), 0.1)
        )
        changed.append(size[2] / error[2])
        assert abs(size[2] - 2.0) < 5 * error[2]
    assert np.median(strange) < 4.0
    assert np.median(changed) > 6.0


def test_a_cause_is_no_likelier_because_clean_logs_were_surer_of_it() -> None:
    random = np.random.default_rng(4)
    scatter = fit_score_distribution(groups(random, 60, 1, UNCHANGED, 0.3))
    # clean logs leave open what the mean size of the right cause is, and so its score is smaller
    vague = replace(scatter, mean_size_variance=np.array([1.0, 0.0, 0.0]))
    first = 0
    for _ in range(50):
        found = groups(random, 5, 1, np.array([1.5, 0.0, 0.0]), 0.3)
        size, error, explains = vague.estimate_sizes(found)
        assert abs(size[0]) / error[0] < abs(size[1]) / error[1]
        first += int(np.argmax(explains) == 0)
    assert first > 40


WINDOWS = 6
CHANGES = 3
VALUES = 40
BELIEF = np.diag([1.0, 1.0, 1.0])


def told(error: np.ndarray, effects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sums = compute_robust_score_sums([(error, effects)], [np.eye(VALUES)], BELIEF)
    return sums.score, sums.information


def test_a_window_that_no_change_explains_counts_by_what_it_leaves() -> None:
    random = np.random.default_rng(0)
    effects = 3.0 * random.normal(size=(WINDOWS, CHANGES, VALUES))
    noise = 0.5 * random.normal(size=(WINDOWS, VALUES))
    _, usual = told(noise, effects)
    # a large change is explained, whatever its size: windows count as before
    _, changed = told(noise + 2.0 * effects[:, 1], effects)
    np.testing.assert_allclose(changed, usual)
    # one window goes its own way, ten times beyond what clean logs scatter
    strange = noise.copy()
    strange[2] += 10.0 * random.normal(size=VALUES)
    score, information = told(strange, effects)
    left = usual - information
    own = effects[2] @ effects[2].T
    np.testing.assert_allclose(left / own, np.mean(left / own), rtol=1e-6)
    assert 0.97 < np.mean(left / own) < 1.0
    # by itself it would have moved the scores of all others
    others = told(np.delete(noise, 2, 0), np.delete(effects, 2, 0))[0]
    whole = np.einsum("bqn,bn->q", effects, strange)
    assert np.abs(score - others).max() < 0.1 * np.abs(whole - others).max()
