"""Errors of free runs by hand and by loops, and their intervals against all resamples."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from made_logs import made, random_states
from scipy import stats

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.layout import DegreesOfFreedom
from residnet.dynamics.hybrid import HybridDynamics
from residnet.evaluation.freerun import Candidate, FreeRun, FreeRunErrors, Prediction
from residnet.evaluation.intervals import (
    WindowErrors,
    bootstrap_intervals,
    bootstrap_tail_probability,
    estimate_spread_between_logs,
    make_resampling_blocks,
    paired_difference,
    prediction_intervals,
)
from residnet.evaluation.limits_records import OutsideRange
from residnet.evaluation.metrics import ProtocolEvaluation
from residnet.evaluation.metrics_file import build_metrics_file, build_metrics_table, find_row
from residnet.evaluation.protocol import Window, WindowProtocol
from residnet.evaluation.records import BlockCount, ModelKind, PairedDifference
from residnet.evaluation.selection import block_error_shares, make_selection_blocks
from residnet.heads.base import ZeroHead
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PreparedLog

SIGNALS = SignalsConfig(inputs=("delta",)).build()
SCALES = {"u": 0.5, "v": 0.25, "r": 0.1}
RANGES = {"u": (0.5, 2.0), "v": (-1.0, 1.0), "r": (-1.0, 1.0), "n": (0.0, 8.0)}


def window(log: int, start: int, stop: int) -> Window:
    return Window(log, start, stop, start, np.zeros(3))


def candidate(name: str, reference: str | None = None, kind: ModelKind = "head") -> Candidate:
    model = HybridDynamics(SIGNALS, ZeroBaselineConfig().build(()), ZeroHead(), 0.1, "euler")
    return Candidate(name, kind, model, reference=reference, training_ranges=RANGES)


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
    table = ProtocolEvaluation(run, [candidate("a"), candidate("b")], logs, SCALES).build_rows(
        {"manoeuvring": ["zigzag", "turning"], "absent": ["3211"]}
    )
    shown = {"all", "zigzag", "constant", "turning", "manoeuvring"}
    assert {row.manoeuvre for row in table} == shown
    members = {"all": {"zigzag", "constant", "turning"}, "manoeuvring": {"zigzag", "turning"}}
    for row in table:
        wanted = members.get(row.manoeuvre, {row.manoeuvre})
        chosen = [i for i, w in enumerate(run.windows) if logs[w.log_index].log.manoeuvre in wanted]
        rmse = []
        mae = []
        position = []
        heading = []
        count = 0
        for i in chosen:
            w, p = run.windows[i], run.predictions[row.model][i]
            error = p.states - logs[w.log_index].y[w.start : w.stop]
            good = logs[w.log_index].usable[w.start : w.stop]
            parts = (error[good, 3], error[good, 4], error[:, 5])
            rmse.append([np.sqrt((part**2).mean()) for part in parts])
            mae.append([np.abs(part).mean() for part in parts])
            position.append(np.hypot(*error[-1, :2]))
            heading.append(abs(np.remainder(error[-1, 2] + np.pi, 2.0 * np.pi) - np.pi))
            count += int(good.sum())
        mean = np.mean(rmse, axis=0)
        assert [row.rmse[c] for c in "uvr"] == pytest.approx(mean.tolist())
        assert [row.mae[c] for c in "uvr"] == pytest.approx(np.mean(mae, axis=0).tolist())
        assert (row.kind, row.split, row.protocol) == ("head", "test", "T3")
        assert row.nrmse["mean"] == pytest.approx(float((mean / [0.5, 0.25, 0.1]).mean()))
        assert row.position_error_end == pytest.approx(np.mean(position))
        assert row.heading_error_end == pytest.approx(np.mean(heading))
        assert (row.windows, row.n) == (len(chosen), count)
        assert row.diverged == sum(run.predictions[row.model][i].has_diverged for i in chosen)


def test_intervals_hold_the_mean_and_say_what_was_drawn() -> None:
    run, logs = made_run()
    row = find_row(
        ProtocolEvaluation(run, [candidate("a")], logs, SCALES).build_rows({}), model="a"
    )
    # four logs of three windows: whole logs are too few, runs of two and one make eight
    assert row.ci95_blocks == BlockCount(of="windows", count=8)
    assert row.rmse_ci95 is not None
    assert row.nrmse_mean_ci95 is not None
    spans = [(row.rmse_ci95[c], row.rmse[c]) for c in "uvr"]
    for interval, mean in (*spans, (row.nrmse_mean_ci95, row.nrmse["mean"])):
        assert interval is not None
        assert interval[0] < mean < interval[1]
    alone = FreeRun("T3", "test", run.windows[:1], {"a": run.predictions["a"][:1]})
    single = find_row(
        ProtocolEvaluation(alone, [candidate("a")], logs, SCALES).build_rows({}), model="a"
    )
    assert single.rmse_ci95 == {"u": None, "v": None, "r": None}
    assert single.nrmse_mean_ci95 is single.ci95_blocks is None


def test_differences_are_paired_by_window_and_kind() -> None:
    run, logs = made_run()
    errors = {
        name: (
            FreeRunErrors.from_predictions(run.windows, run.predictions[name], logs).rmse
            / [0.5, 0.25, 0.1]
        ).mean(1)
        for name in "ab"
    }
    compared = candidate("a", "b")
    for row in ProtocolEvaluation(run, [compared, candidate("b")], logs, SCALES).build_rows({}):
        chosen = [row.manoeuvre in ("all", logs[w.log_index].log.manoeuvre) for w in run.windows]
        if row.model == "b":
            assert row.difference is None
            continue
        found = row.difference
        one = errors["a"][chosen]
        other = errors["b"][chosen]
        assert found.to == "b"
        assert found.nrmse_mean == pytest.approx(float((one - other).mean()))
        assert found.ratio == pytest.approx(one.mean() / other.mean())
        # only all kinds together make blocks enough
        assert (found.ci95 is None) == (row.manoeuvre != "all")
    lost = ProtocolEvaluation(
        run, [replace(compared, reference="absent")], logs, SCALES
    ).build_rows({})
    assert {row.difference for row in lost} == {None}


def test_a_table_has_one_column_per_number_and_the_file_marks_the_selected_model() -> None:
    run, logs = made_run()
    rows = ProtocolEvaluation(run, [candidate("a"), candidate("b")], logs, SCALES).build_rows({})
    table = build_metrics_table(rows)
    assert table["model"].tolist() == [row.model for row in rows]
    assert table["rmse_r"].tolist() == [row.rmse["r"] for row in rows]
    assert table["nrmse_mean"].tolist() == [row.nrmse["mean"] for row in rows]
    assert table["note"][0] == f"{rows[0].diverged}/12 diverged"
    assert "selected" not in table
    assert table.notna().to_numpy().all()
    assert find_row(rows, model="b", split="test", protocol="T3", manoeuvre="zigzag").windows == 6
    for candidates, model, told in ((rows, "c", "0 rows"), ([*rows, *rows], "b", "2 rows")):
        with pytest.raises(KeyError, match=told):
            find_row(candidates, model=model)
    metrics = build_metrics_file("run", {"u": "m/s"}, {"u": 1.0}, "b", "c", "c", rows)
    assert metrics.schema_name == "residnet.metrics/1"
    assert (metrics.selected, metrics.selected_ensemble) == ("b", "c")
    marked = build_metrics_table(metrics.rows)["selected"].tolist()
    assert marked == [row.model == "b" for row in rows]
    assert rows[0].selected is None


def straight(
    speed: float, drift: float = 0.0, turned: float = 0.0, count: int = 21, step: float = 0.1
) -> np.ndarray:
    """States of a straight run north whose measured position gains `drift` m/s eastwards and whose
    heading gains `turned` rad, unseen by u, v, r.
    """
    t = step * np.arange(count)
    return np.stack((speed * t, drift * t, turned * t / t[-1], 0 * t + speed, 0 * t, 0 * t), axis=1)


def test_consistency_by_hand() -> None:
    logs = [made(straight(1.0, drift=0.3, turned=0.02), 0.1), made(straight(2.0, drift=0.4), 0.1)]
    windows = [window(0, 0, 21), window(1, 0, 21)]
    found = ProtocolEvaluation(
        FreeRun("T2", "test", windows), [], logs, SCALES
    ).evaluate_kinematics(0.1)
    # after 2 s the position is off by 0.6 m and 0.8 m, the heading by 0.02 rad and nothing
    assert found.windows == 2
    assert found.position_mean == pytest.approx(0.7)
    assert found.position_rms == pytest.approx(np.sqrt((0.36 + 0.64) / 2))
    assert found.heading_mean == pytest.approx(0.01)
    assert found.heading_rms == pytest.approx(0.02 / np.sqrt(2))


def nine(wind: list[float] | None = None) -> tuple[FreeRun, list[PreparedLog]]:
    """Nine logs of one window each at speeds 1 .. 9 m/s; `a` is off by 0.01, 0.02, .. m/s in u, `b`
    by twice that.
    """
    logs = [made(straight(k + 1.0), 0.1, w=np.zeros((21, 1)), name=f"log{k}") for k in range(9)]
    for speed, one in zip(wind or (), logs, strict=False):
        one.log.channels["wind_speed"] = np.full(21, speed)
    windows = [window(k, 0, 21) for k in range(9)]

    def off(factor: float) -> list[Prediction]:
        return [
            Prediction(p.y + factor * 0.01 * (k + 1) * np.eye(6)[3], False)
            for k, p in enumerate(logs)
        ]

    return FreeRun("T2", "test", windows, {"a": off(1), "b": off(2)}), logs


def test_bands_are_thirds_of_the_windows() -> None:
    run, logs = nine(wind=[3.0, 1.0, 2.0] * 3)
    found = ProtocolEvaluation(
        run, [candidate("a", "b"), candidate("b")], logs, SCALES
    ).evaluate_by_class()
    speeds = ((1, 3), (4, 6), (7, 9))
    winds = ((1, 1), (2, 2), (3, 3))
    assert [(band.by, band.low, band.high, band.windows) for band in found] == [
        (by, low, high, 3)
        for by, ends in (("speed", speeds), ("wind", winds))
        for low, high in ends
    ]
    # u alone is off: nrmse of a window is a third of its error over the scale
    levels = [
        np.mean(ks) * 0.01 / 0.5 / 3
        for ks in ((1, 2, 3), (4, 5, 6), (7, 8, 9), (2, 5, 8), (3, 6, 9), (1, 4, 7))
    ]
    assert [band.models["a"].nrmse_mean for band in found] == pytest.approx(levels)
    for band, level in zip(found, levels, strict=True):
        paired = band.models["a"].difference
        assert paired.to == "b"
        assert paired.nrmse_mean == pytest.approx(-level)
        assert paired.ratio == pytest.approx(0.5)
        assert band.models["b"].difference is None


def test_bands_without_windows_enough_or_without_wind_are_left_out() -> None:
    run, logs = nine()
    few = FreeRun("T2", "test", run.windows[:8], {"a": run.predictions["a"][:8]})
    # 8 windows: thirds of 3, 2 and 3
    found = ProtocolEvaluation(few, [candidate("a")], logs, SCALES).evaluate_by_class()
    assert [(band.by, band.low) for band in found] == [("speed", 1.0), ("speed", 6.0)]
    # one speed: no breakdown at all
    still = [made(straight(1.0), 0.1) for _ in range(9)]
    assert ProtocolEvaluation(run, [candidate("a")], still, SCALES).evaluate_by_class() == []


def test_worst_windows_are_named() -> None:
    run, logs = nine()
    found = ProtocolEvaluation(run, [candidate("a")], logs, SCALES).build_limits(0.1).worst["a"]
    assert [entry.log for entry in found] == ["log8", "log7", "log6"]
    # u alone is off, by 0.09, 0.08 and 0.07 m/s
    worst = [0.01 * k / 0.5 / 3 for k in (9, 8, 7)]
    assert [entry.nrmse for entry in found] == pytest.approx(worst)
    assert found[0].t == pytest.approx(3.0)
    assert found[0].rmse["u"] == pytest.approx(0.09)
    assert found[0].manoeuvre == "zigzag"


STEP = 0.5
CANDIDATES = [
    candidate("constant_velocity", kind="constant_velocity"),
    candidate("baseline", kind="baseline"),
    candidate("mlp"),
]


@pytest.fixture(scope="module")
def logs() -> list[PreparedLog]:
    """Logs of 41 s, each at a speed of its own."""
    speeds = [0.6 + 0.3 * number for number in range(6)]
    return [
        made(straight(speed, count=82, step=STEP), STEP, w=np.full((82, 1), 5.0))
        for speed in speeds
    ]


@pytest.fixture
def run(logs: list[PreparedLog]) -> FreeRun:
    """The error of zero is 0.1 throughout; the model's grows with time and passes it at 12 s."""
    protocol = WindowProtocol(length=20.0, first=0.0, history=0.0)
    windows = [
        w for i, prepared in enumerate(logs) for w in protocol.make_windows(prepared, i, STEP)
    ]
    out = FreeRun("T20", "test", windows)
    for name in ("constant_velocity", "baseline", "mlp"):
        out.predictions[name] = []
        for window in windows:
            states = logs[window.log_index].y[window.start : window.stop].copy()
            age = STEP * np.arange(len(states))
            error = {
                "constant_velocity": 0.1 + 0 * age,
                "baseline": 0.09 + 0 * age,
                "mlp": 0.1 * age / 12.0,
            }
            # a little of its own for each log, so that there is a spread
            states[:, 3] += (1.0 + 0.01 * window.log_index) * error[name]
            out.predictions[name].append(Prediction(states, False))
    return out


def test_errors_of_the_pose_are_told_after_the_times_that_matter(
    run: FreeRun, logs: list[PreparedLog]
) -> None:
    """Windows of 20 s; the model's position is put 3 m and its heading 200 deg off after 10 s."""
    for prediction in run.predictions["mlp"]:
        prediction.states[20, :2] += np.array([3.0, 4.0])
        prediction.states[20, 2] += np.radians(200.0)
    entries = ProtocolEvaluation(run, CANDIDATES, logs, SCALES).evaluate_horizons(STEP)
    assert [entry.seconds for entry in entries] == [10.0, 20.0]
    first = entries[0]
    assert (first.windows, first.logs) == (12, 6)
    assert first.slowest == pytest.approx(0.6)
    assert first.sailed == pytest.approx(1.35 * 10.5)
    own = first.models["mlp"]
    assert own.position == pytest.approx(5.0)
    # a turn too many is no error
    assert own.heading is not None
    assert np.degrees(own.heading) == pytest.approx(160.0)
    interval = own.intervals["position"]
    assert interval is not None
    low, high = interval
    assert low <= 5.0 <= high
    # velocities were made from the positions
    assert first.floor.position == pytest.approx(0.0, abs=1e-9)
    assert first.models["constant_velocity"].position == pytest.approx(0.0, abs=1e-9)
    # the paired differences are 5 m in every window
    assert first.change_from_constant_velocity["mlp"]["position"] == pytest.approx((5.0, 5.0))
    assert "constant_velocity" not in first.change_from_constant_velocity


def test_no_interval_of_a_heading_passes_half_a_turn(run: FreeRun, logs: list[PreparedLog]) -> None:
    for window, prediction in zip(run.windows, run.predictions["mlp"], strict=True):
        prediction.states[20, 2] += 0.5 * (window.log_index + 1)
    entries = ProtocolEvaluation(run, CANDIDATES, logs, SCALES).evaluate_horizons(STEP)
    interval = entries[0].models["mlp"].intervals["heading"]
    assert interval is not None
    assert interval[1] == pytest.approx(np.pi)


def test_every_model_is_compared_with_zero_and_the_first_baseline(
    run: FreeRun, logs: list[PreparedLog]
) -> None:
    judged = ProtocolEvaluation(run, CANDIDATES, logs, SCALES)
    found = judged.compare_with_references()
    assert set(found["mlp"]) == {"constant_velocity", "baseline"}
    assert set(found["baseline"]) == {"constant_velocity"}
    apart = found["baseline"]["constant_velocity"].nrmse_mean
    # u alone is off, by 0.09 and 0.1 m/s, and the more the later the log
    expected = np.array([(1.0 + 0.01 * w.log_index) * -0.01 / 0.5 / 3 for w in run.windows])
    assert judged.nrmse_by_window["constant_velocity"][0] == pytest.approx(0.1 / 0.5 / 3)
    assert apart == pytest.approx(expected.mean())


def test_samples_outside_the_training_range_are_counted(
    run: FreeRun, logs: list[PreparedLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    # one of six logs is faster than 2 m/s
    found = ProtocolEvaluation(run, CANDIDATES, logs, SCALES).share_outside_training_range()
    assert found.share == pytest.approx(1 / 6)
    assert found.channels == {"u": pytest.approx(1 / 6)}
    # nor does a channel that drives nothing, as the depth
    monkeypatch.setattr(DegreesOfFreedom, "unmodelled_states", property(lambda _: ("u",)))
    assert ProtocolEvaluation(run, CANDIDATES, logs, SCALES).share_outside_training_range() == (
        OutsideRange(share=0.0, channels={})
    )


@pytest.mark.parametrize(("count", "of", "blocks"), [(6, "logs", 6), (2, "stretches", 8)])
def test_shares_of_blocks_sum_to_the_mean_error(
    run: FreeRun, logs: list[PreparedLog], count: int, of: str, blocks: int
) -> None:
    few = [i for i, window in enumerate(run.windows) if window.log_index < count]
    part = FreeRun("T20", "test", [run.windows[i] for i in few])
    part.predictions["mlp"] = [run.predictions["mlp"][i] for i in few]
    found, labels = make_selection_blocks(part)
    assert (found.block_kind, len(found.weights)) == (of, blocks)
    assert found.weights.sum() == pytest.approx(1.0)
    own = block_error_shares(part, "mlp", logs, SCALES, labels, blocks)
    expected = ProtocolEvaluation(part, [CANDIDATES[2]], logs, SCALES).nrmse_by_window["mlp"].mean()
    assert own.sum() == pytest.approx(expected)


def test_a_block_is_a_log_from_five_logs_on() -> None:
    numbers = np.array([7, 7, 2, 3, 3, 3, 9, 4])
    found = make_resampling_blocks(numbers)
    assert found is not None
    assert (found.block_kind, found.n_blocks) == ("logs", 5)
    same = found.block_indices[:, None] == found.block_indices[None, :]
    assert (same == (numbers[:, None] == numbers[None, :])).all()


def test_few_logs_are_cut_into_runs_that_stay_within_a_log() -> None:
    # 12 + 5 + 1 windows: runs of 3 make 4 + 2 + 1 = 7 blocks, runs of 2 make 6 + 3 + 1 = 10
    logs = [0] * 12 + [1] * 5 + [2]
    found = make_resampling_blocks(logs)
    assert found is not None
    assert (found.block_kind, found.n_blocks) == ("windows", 10)
    for block in range(found.n_blocks):
        members = np.flatnonzero(found.block_indices == block)
        assert len({logs[i] for i in members}) == 1
        assert (np.diff(members) == 1).all()
        assert 1 <= len(members) <= 2


@pytest.mark.parametrize("logs", [[0] * 40, [0, 0, 0, 1, 1, 1, 1, 1, 1], [0, 1, 2, 3]])
def test_too_little_gives_no_interval(logs: list[int]) -> None:
    assert make_resampling_blocks(logs) is None
    assert bootstrap_intervals(np.ones((len(logs), 2)), None) == [None, None]
    found = paired_difference(np.arange(len(logs)) + 2.0, np.ones(len(logs)), "base", None)
    assert found.ci95 is None
    assert found.excludes_zero is False
    assert found.nrmse_mean == pytest.approx(np.mean(np.arange(len(logs)) + 1.0))


def test_equals_the_enumeration_of_all_resamples() -> None:
    logs = [0, 0, 0, 1, 2, 2, 3, 3, 3, 3, 4, 5]
    values = np.random.default_rng(3).normal(1.0, 0.5, len(logs))
    sums = np.array([values[np.array(logs) == k].sum() for k in range(6)])
    sizes = np.array([logs.count(k) for k in range(6)])
    picks = np.array(list(itertools.product(range(6), repeat=6)))
    means = sums[picks].sum(1) / sizes[picks].sum(1)
    (interval,) = bootstrap_intervals(values[:, None], make_resampling_blocks(logs))
    assert interval is not None
    expected = np.quantile(
        means, [bootstrap_tail_probability(6), 1 - bootstrap_tail_probability(6)]
    )
    assert interval == pytest.approx(
        tuple(expected.tolist()), abs=0.06 * (expected[1] - expected[0])
    )


def test_levels_widen_as_student_s_t() -> None:
    assert bootstrap_tail_probability(10**6) == pytest.approx(0.025, rel=1e-4)
    # t of 4 and 7 degrees of freedom from tables
    for count, t in ((5, 2.7764), (8, 2.3646)):
        assert bootstrap_tail_probability(count) == pytest.approx(
            stats.norm.sf(t * np.sqrt(count / (count - 1))), 1e-3
        )


def test_pairing_finds_what_the_errors_of_each_model_hide() -> None:
    # windows differ a hundred times more than models do
    hard = np.random.default_rng(5).uniform(0.1, 1.0, 24)
    drawn = make_resampling_blocks(np.arange(24) // 3)
    found, other = (
        paired_difference(*two, "base", drawn) for two in ((hard - 0.01, hard), (hard, hard))
    )
    assert found.excludes_zero is True
    assert found.ci95 == pytest.approx((-0.01, -0.01))
    assert found.ratio == pytest.approx(1.0 - 0.01 / hard.mean())
    first, second = bootstrap_intervals(np.stack((hard - 0.01, hard), axis=1), drawn)
    assert first is not None
    assert second is not None
    assert first[1] > second[0]
    assert other == PairedDifference(
        to="base", nrmse_mean=0.0, ci95=(0.0, 0.0), excludes_zero=False, ratio=1.0, worse=False
    )
    above = paired_difference(hard + 0.01, hard, "base", drawn)
    assert above.excludes_zero is True


@pytest.mark.parametrize(("factor", "worse"), [(1.04, False), (1.06, True), (0.5, False)])
def test_worse_is_more_than_five_percent(factor: float, worse: bool) -> None:
    base = np.array([0.1, 0.2, 0.4])
    found = paired_difference(factor * base, base, "base", None)
    assert found.ratio == pytest.approx(factor)
    assert found.worse is worse
    assert paired_difference(base, 0 * base, "base", None).ratio is None


@pytest.mark.parametrize("logs", [3, 6])
def test_intervals_hold_for_new_logs_of_the_column_that_looks_surest(logs: int) -> None:
    random = np.random.default_rng(3)
    held = []
    windows = 3
    numbers = np.repeat(np.arange(logs), windows)
    for _ in range(400):
        # a log has its size in common, half of it for all columns
        sizes = 0.4 * random.normal(size=(2, logs, 1)) + 0.4 * random.normal(size=(2, logs, 6))
        seen, new = np.exp(
            sizes.repeat(windows, axis=1) + 0.1 * random.normal(size=(2, 3 * logs, 6))
        )
        spans = np.array(prediction_intervals(WindowErrors(seen, numbers)))
        surest = int(np.log(seen.reshape(logs, windows, 6).mean(1)).std(0).argmin())
        low, high = spans[surest]
        held.append(low <= new.mean(0)[surest] <= high)
        np.testing.assert_allclose(np.sqrt(spans.prod(1)), seen.mean(0))
    assert 0.92 <= np.mean(held) <= 0.99


def test_what_ran_away_or_is_exact_leaves_the_intervals_of_others() -> None:
    values = np.exp(np.random.default_rng(4).normal(size=(12, 4)))
    numbers = np.repeat(np.arange(4), 3)
    plain = prediction_intervals(WindowErrors(values[:, :2], numbers))
    values[:, 2], values[5, 3] = 0.0, np.inf
    spans = prediction_intervals(WindowErrors(values, numbers))
    assert spans[:2] == plain
    assert spans[2] == (0.0, 0.0)
    assert prediction_intervals(WindowErrors(values[:6], numbers[:6])) == [None] * 4


def test_a_log_without_an_error_widens_no_interval() -> None:
    random = np.random.default_rng(5)
    held = []
    factors = []
    for _ in range(400):
        # one log in six goes straight, and nothing goes wrong in it
        seen, new = np.abs(random.normal(size=(2, 12, 2))) * (random.random((2, 12, 1)) > 1 / 6)
        low, high = np.array(prediction_intervals(WindowErrors(seen, np.arange(12)))).T
        held.append((low <= new.mean(0)) & (new.mean(0) <= high))
        factors.append(high[0] / seen.mean(0)[0])
    assert 0.92 <= np.mean(held) <= 0.98
    assert np.median(factors) < 2.5


def draw_log_errors(
    random: np.random.Generator, n_logs: int, n_windows: int, spread: float, scale: float = 1.0
) -> WindowErrors:
    """Draw errors of four columns; half of the variance between logs is common to them."""
    sizes = spread * np.sqrt(0.5) * random.normal(size=(n_logs, 1, 1))
    sizes = sizes + spread * np.sqrt(0.5) * random.normal(size=(n_logs, 1, 4))
    log_errors = sizes + 0.3 * random.normal(size=(n_logs, n_windows, 4))
    return WindowErrors(
        scale * np.exp(log_errors).reshape(-1, 4), np.repeat(np.arange(n_logs), n_windows)
    )


def test_logs_of_other_splits_estimate_the_spread_between_logs() -> None:
    random = np.random.default_rng(6)
    covered = []
    widths = []
    for _ in range(400):
        test, new = (draw_log_errors(random, 3, 2, 0.4) for _ in range(2))
        # errors on training logs are smaller, which does not change their relative spread
        others = [draw_log_errors(random, 5, 2, 0.4, 0.5), draw_log_errors(random, 2, 2, 0.4, 0.9)]
        alone = np.array(prediction_intervals(test))
        pooled = np.array(prediction_intervals(test, others))
        np.testing.assert_allclose(np.sqrt(pooled.prod(1)), test.values.mean(0))
        new_means = new.values.mean(0)
        covered.append((pooled[:, 0] <= new_means) & (new_means <= pooled[:, 1]))
        widths.append([np.log(limits[0, 1] / limits[0, 0]) for limits in (alone, pooled)])
    assert 0.93 <= np.mean(covered) <= 0.98
    # other logs prevent very wide intervals above all
    wide_alone, wide_pooled = np.quantile(widths, 0.9, axis=0)
    assert wide_pooled < 0.9 * wide_alone


def test_many_logs_determine_their_spread_themselves() -> None:
    random = np.random.default_rng(7)
    others = [draw_log_errors(random, 80, 2, 0.1)]
    relative_changes = []
    for n_logs in (4, 60):
        test = draw_log_errors(random, n_logs, 2, 1.2)
        moderated = estimate_spread_between_logs(test, others)
        assert moderated.n_logs == n_logs + 80
        relative_changes.append(moderated.variance / estimate_spread_between_logs(test).variance)
    few, many = relative_changes
    assert 0.7 < few < 0.8
    assert 0.97 < many < 1.0


def test_spread_refers_to_the_number_of_windows_of_the_logs() -> None:
    random = np.random.default_rng(8)
    one, many = (
        np.mean(
            [
                estimate_spread_between_logs(
                    draw_log_errors(random, 3, n_windows, 0.05),
                    [draw_log_errors(random, 30, 4, 0.05)],
                ).variance
                for _ in range(200)
            ]
        )
        for n_windows in (1, 9)
    )
    # 0.3 is the relative standard deviation of windows, 0.05 that of logs
    assert one == pytest.approx(0.3**2 + 0.05**2, rel=0.2)
    assert many == pytest.approx(0.3**2 / 9 + 0.05**2, rel=0.35)
