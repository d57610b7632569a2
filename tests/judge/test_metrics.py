"""Metrics of hand-made predictions against numbers worked out by hand and plain loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_logs import made, random_states

from residnet.baselines.given import StillConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.judge.freerun import Candidate, Errors, FreeRun, Prediction
from residnet.judge.metrics import Judged, find, new_trials
from residnet.judge.protocol import Window
from residnet.physics.signals import SignalsConfig

SIGNALS = SignalsConfig(inputs=("delta",)).build()
SCALES = {"u": 0.5, "v": 0.25, "r": 0.1}


def window(log: int, start: int, stop: int) -> Window:
    return Window(log, start, stop, start, np.zeros(3))


def candidate(name: str) -> Candidate:
    return Candidate(
        name, "head", HybridDynamics(SIGNALS, StillConfig().build(()), ZeroHead(), 0.1, "euler")
    )


def test_by_hand() -> None:
    y = np.zeros((4, 6))
    predicted = np.zeros((4, 6))
    predicted[:, 3] = [0, 0.3, 0.4, 5.0]
    predicted[:, 4] = [0, -0.1, 0.1, 7.0]
    predicted[:, 5] = [0, 0.1, 0.1, 0.1]
    # two turns too many point where the vessel points
    predicted[-1, :3] = [3.0, -4.0, -0.5 - 4.0 * np.pi]
    log = made(y, 0.1, usable=np.array([True, True, True, False]))
    run = FreeRun("T1", "test", [window(0, 0, 4)], {"mine": [Prediction(predicted, False)]})
    errors = Errors.of(run.windows, run.predictions["mine"], [log])
    # u and v over the three usable samples, r over all four
    np.testing.assert_allclose(
        errors.rmse, [[np.sqrt(0.25 / 3), np.sqrt(0.02 / 3), np.sqrt(0.03 / 4)]]
    )
    np.testing.assert_allclose(errors.mae, [[0.7 / 3, 0.2 / 3, 0.3 / 4]])
    assert errors.ends()["position"].tolist() == [5.0]
    assert errors.ends()["heading"].tolist() == pytest.approx([0.5])
    assert errors.samples.tolist() == [3]
    (row,) = [
        r
        for r in Judged(run, [candidate("mine")], [log], SCALES).rows({})
        if r["manoeuvre"] == "all"
    ]
    nrmse = np.array([np.sqrt(0.25 / 3) / 0.5, np.sqrt(0.02 / 3) / 0.25, np.sqrt(0.03 / 4) / 0.1])
    assert [row["nrmse"][c] for c in "uvr"] == pytest.approx(nrmse.tolist())
    assert row["nrmse"]["mean"] == pytest.approx(nrmse.mean())
    labels = [
        row[key] for key in ("model", "kind", "split", "protocol", "windows", "n", "diverged")
    ]
    assert labels == ["mine", "head", "test", "T1", 1, 3, 0]


def made_run(seed: int = 0) -> tuple[FreeRun, list]:
    rng = np.random.default_rng(seed)
    kinds = ["zigzag", "constant", "zigzag", "turning"]
    logs = [
        made(random_states(120, rng), 0.1, usable=rng.random(120) < 0.8, name=f"log{i}", kind=kind)
        for i, kind in enumerate(kinds)
    ]
    windows = [window(i, start, start + 31) for i in range(4) for start in (0, 30, 60)]
    predictions = {
        name: [Prediction(random_states(31, rng), bool(rng.random() < 0.3)) for _ in windows]
        for name in ("a", "b")
    }
    return FreeRun("T3", "test", windows, predictions), logs


def test_rows_equal_a_loop_over_windows() -> None:
    run, logs = made_run()
    table = Judged(run, [candidate("a"), candidate("b")], logs, SCALES).rows(
        {"manoeuvring": ["zigzag", "turning"], "absent": ["3211"]}
    )
    assert {row["manoeuvre"] for row in table} == {
        "all",
        "zigzag",
        "constant",
        "turning",
        "manoeuvring",
    }
    members = {"all": {"zigzag", "constant", "turning"}, "manoeuvring": {"zigzag", "turning"}}
    for row in table:
        wanted = members.get(row["manoeuvre"], {row["manoeuvre"]})
        chosen = [i for i, w in enumerate(run.windows) if logs[w.log].log.manoeuvre in wanted]
        rmse, position, heading, count = [], [], [], 0
        for i in chosen:
            w, p = run.windows[i], run.predictions[row["model"]][i]
            error = p.states - logs[w.log].y[w.start : w.stop]
            good = logs[w.log].usable[w.start : w.stop]
            rmse.append(
                [
                    np.sqrt((error[good, 3] ** 2).mean()),
                    np.sqrt((error[good, 4] ** 2).mean()),
                    np.sqrt((error[:, 5] ** 2).mean()),
                ]
            )
            position.append(np.hypot(*error[-1, :2]))
            heading.append(abs(np.remainder(error[-1, 2] + np.pi, 2.0 * np.pi) - np.pi))
            count += int(good.sum())
        mean = np.mean(rmse, axis=0)
        assert [row["rmse"][c] for c in "uvr"] == pytest.approx(mean.tolist())
        assert row["nrmse"]["mean"] == pytest.approx(float((mean / [0.5, 0.25, 0.1]).mean()))
        assert row["position_error_end"] == pytest.approx(np.mean(position))
        assert row["heading_error_end"] == pytest.approx(np.mean(heading))
        assert (row["windows"], row["n"]) == (len(chosen), count)
        assert row["diverged"] == sum(run.predictions[row["model"]][i].diverged for i in chosen)


def test_intervals_hold_the_mean_and_say_what_was_drawn() -> None:
    run, logs = made_run()
    row = find(Judged(run, [candidate("a")], logs, SCALES).rows({}), model="a")
    # four logs of three windows: whole logs are too few, runs of two and one make eight
    assert row["ci95_blocks"] == {"of": "windows", "count": 8}
    for c in "uvr":
        low, high = row["rmse_ci95"][c]
        assert low < row["rmse"][c] < high
    low, high = row["nrmse_mean_ci95"]
    assert low < row["nrmse"]["mean"] < high
    alone = FreeRun("T3", "test", run.windows[:1], {"a": run.predictions["a"][:1]})
    (single,) = [
        r for r in Judged(alone, [candidate("a")], logs, SCALES).rows({}) if r["manoeuvre"] == "all"
    ]
    assert single["rmse_ci95"] == {"u": None, "v": None, "r": None}
    assert single["nrmse_mean_ci95"] is single["ci95_blocks"] is None


def test_differences_are_paired_by_window_and_kind() -> None:
    run, logs = made_run()
    errors = {
        name: (Errors.of(run.windows, run.predictions[name], logs).rmse / [0.5, 0.25, 0.1]).mean(1)
        for name in "ab"
    }
    compared = replace(candidate("a"), reference="b")
    table = Judged(run, [compared, candidate("b")], logs, SCALES).rows({})
    for row in table:
        chosen = [row["manoeuvre"] in ("all", logs[w.log].log.manoeuvre) for w in run.windows]
        if row["model"] == "b":
            assert row["difference"] is None
            continue
        found = row["difference"]
        assert found["to"] == "b"
        assert found["nrmse_mean"] == pytest.approx(
            float((errors["a"] - errors["b"])[chosen].mean())
        )
        assert found["nrmse_mean"] == pytest.approx(
            row["nrmse"]["mean"]
            - find(table, model="b", manoeuvre=row["manoeuvre"])["nrmse"]["mean"]
        )
        assert found["ratio"] == pytest.approx(
            errors["a"][chosen].mean() / errors["b"][chosen].mean()
        )
        # only all kinds together make blocks enough
        assert (found["ci95"] is None) == (row["manoeuvre"] != "all")
    lost = Judged(run, [replace(compared, reference="absent")], logs, SCALES).rows({})
    assert {row["difference"] for row in lost} == {None}


def test_perfect_predictions_have_no_error() -> None:
    run, logs = made_run()
    exact = FreeRun(
        "T3",
        "test",
        run.windows,
        {"a": [Prediction(logs[w.log].y[w.start : w.stop], False) for w in run.windows]},
    )
    row = find(Judged(exact, [candidate("a")], logs, SCALES).rows({}), model="a")
    assert row["nrmse"]["mean"] == row["position_error_end"] == row["heading_error_end"] == 0.0


def test_find_wants_exactly_one() -> None:
    run, logs = made_run()
    table = Judged(run, [candidate("a"), candidate("b")], logs, SCALES).rows({})
    assert find(table, model="b", split="test", protocol="T3", manoeuvre="zigzag")["windows"] == 6
    with pytest.raises(KeyError, match="0 rows"):
        find(table, model="c")
    with pytest.raises(KeyError, match="2 rows"):
        find(table, split="test")


def test_intervals_hold_for_new_logs_of_the_column_that_looks_surest() -> None:
    random, held, logs, windows = np.random.default_rng(3), [], 4, 3
    numbers = np.repeat(np.arange(logs), windows)
    for _ in range(400):
        # a log has its size in common, half of it for all columns
        sizes = 0.4 * random.normal(size=(2, logs, 1)) + 0.4 * random.normal(size=(2, logs, 6))
        seen, new = np.exp(sizes.repeat(windows, axis=1) + 0.1 * random.normal(size=(2, 12, 6)))
        spans = np.array(new_trials(seen, numbers))
        own = np.log(seen.reshape(logs, windows, 6).mean(1)).std(0)
        surest = int(own.argmin())
        low, high = spans[surest]
        held.append(low <= new.mean(0)[surest] <= high)
        np.testing.assert_allclose(np.sqrt(spans.prod(1)), seen.mean(0))
    assert 0.92 <= np.mean(held) <= 0.99


def test_what_ran_away_or_is_exact_leaves_the_intervals_of_others() -> None:
    values = np.exp(np.random.default_rng(4).normal(size=(12, 4)))
    numbers = np.repeat(np.arange(4), 3)
    plain = new_trials(values[:, :2], numbers)
    values[:, 2], values[5, 3] = 0.0, np.inf
    spans = new_trials(values, numbers)
    assert spans[:2] == plain
    assert spans[2] == [0.0, 0.0]
    assert new_trials(values[:6], numbers[:6]) == [None] * 4
