"""Block bootstrap against enumeration of all resamples, the normal interval, and the share of
intervals that hold a known mean.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from residnet.judge.metrics import Blocks, blocks, difference, intervals, tail


def test_a_block_is_a_log_from_five_logs_on() -> None:
    found = blocks([7, 7, 2, 3, 3, 3, 9, 4])
    assert found is not None
    assert (found.of, found.count) == ("logs", 5)
    same = found.labels[:, None] == found.labels[None, :]
    numbers = np.array([7, 7, 2, 3, 3, 3, 9, 4])
    assert (same == (numbers[:, None] == numbers[None, :])).all()


def test_few_logs_are_cut_into_runs_that_stay_within_a_log() -> None:
    # 12 + 5 + 1 windows: runs of 3 make 4 + 2 + 1 = 7 blocks, runs of 2 make 6 + 3 + 1 = 10
    logs = [0] * 12 + [1] * 5 + [2]
    found = blocks(logs)
    assert found is not None
    assert (found.of, found.count) == ("windows", 10)
    for block in range(found.count):
        members = np.flatnonzero(found.labels == block)
        assert len({logs[i] for i in members}) == 1
        assert (np.diff(members) == 1).all()
        assert 1 <= len(members) <= 2


@pytest.mark.parametrize(
    "logs", [[0], [0] * 40, [0, 0, 0, 1, 1, 1, 1, 1, 1], [0, 1, 2, 3], [0, 1, 2, 2]]
)
def test_too_little_gives_no_interval(logs: list[int]) -> None:
    assert blocks(logs) is None
    assert intervals(np.ones((len(logs), 2)), blocks(logs)) == [None, None]
    found = difference(np.arange(len(logs)) + 2.0, np.ones(len(logs)), "base", blocks(logs))
    assert found["ci95"] is None
    assert found["excludes_zero"] is False
    assert found["nrmse_mean"] == pytest.approx(np.mean(np.arange(len(logs)) + 1.0))


def test_equals_the_enumeration_of_all_resamples() -> None:
    logs = [0, 0, 0, 1, 2, 2, 3, 3, 3, 3, 4, 5]
    values = np.random.default_rng(3).normal(1.0, 0.5, len(logs))
    sums = np.array([values[np.array(logs) == k].sum() for k in range(6)])
    sizes = np.array([logs.count(k) for k in range(6)])
    picks = np.array(list(itertools.product(range(6), repeat=6)))
    means = sums[picks].sum(1) / sizes[picks].sum(1)
    found = blocks(logs)
    (interval,) = intervals(values[:, None], found)
    assert interval is not None
    wide = 2.5706 * np.sqrt(6 / 5)
    level = 0.5 * (1 - _erf(wide / np.sqrt(2)))
    expected = np.quantile(means, [level, 1 - level])
    assert interval == pytest.approx(expected.tolist(), abs=0.06 * (expected[1] - expected[0]))


def _erf(x: float) -> float:
    """Error function by its integral."""
    grid = np.linspace(0, x, 20001)
    return float(2 / np.sqrt(np.pi) * np.trapezoid(np.exp(-(grid**2)), grid))


def test_levels_widen_as_student_s_t() -> None:
    assert tail(10**6) == pytest.approx(0.025, rel=1e-4)
    # t of 4 and 7 degrees of freedom from tables
    for count, t in ((5, 2.7764), (8, 2.3646)):
        assert tail(count) == pytest.approx(
            0.5 * (1 - _erf(t * np.sqrt(count / (count - 1) / 2))), rel=1e-3
        )


def test_many_single_windows_have_the_normal_interval() -> None:
    values = np.random.default_rng(0).normal(2.0, 0.3, (400, 1))
    (interval,) = intervals(values, blocks(range(400)))
    assert interval is not None
    half = 1.96 * values.std() / np.sqrt(400)
    assert interval == pytest.approx([values.mean() - half, values.mean() + half], abs=0.1 * half)


def test_exchanging_the_models_exchanges_the_sign() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(0.1, 0.2, 30), rng.uniform(0.1, 0.25, 30)
    drawn = blocks(np.arange(30) // 3)
    one, other = difference(a, b, "b", drawn), difference(b, a, "a", drawn)
    assert one["nrmse_mean"] == pytest.approx((a - b).mean())
    assert other["nrmse_mean"] == pytest.approx(-one["nrmse_mean"])
    assert other["ci95"] == pytest.approx([-one["ci95"][1], -one["ci95"][0]])
    assert one["excludes_zero"] == other["excludes_zero"]
    assert one["ratio"] * other["ratio"] == pytest.approx(1)
    assert difference(a, b, "b", drawn) == one


def test_a_model_against_itself() -> None:
    a = np.random.default_rng(1).uniform(0.1, 0.2, 12)
    found = difference(a, a, "a", blocks(np.arange(12) // 2))
    assert found == {
        "to": "a",
        "nrmse_mean": 0.0,
        "ci95": [0.0, 0.0],
        "excludes_zero": False,
        "ratio": 1.0,
        "worse": False,
    }


def test_pairing_finds_what_the_errors_of_each_model_hide() -> None:
    # windows differ a hundred times more than models do
    hard = np.random.default_rng(5).uniform(0.1, 1.0, 24)
    drawn = blocks(np.arange(24) // 3)
    found = difference(hard - 0.01, hard, "base", drawn)
    assert found["excludes_zero"] is True
    assert found["ci95"] == pytest.approx([-0.01, -0.01])
    first, second = intervals(np.stack((hard - 0.01, hard), axis=1), drawn)
    assert first is not None
    assert second is not None
    assert first[1] > second[0]


@pytest.mark.parametrize(("factor", "worse"), [(1.04, False), (1.06, True), (0.5, False)])
def test_worse_is_more_than_five_percent(factor: float, worse: bool) -> None:
    base = np.array([0.1, 0.2, 0.4])
    found = difference(factor * base, base, "base", None)
    assert found["ratio"] == pytest.approx(factor)
    assert found["worse"] is worse
    assert difference(base, 0 * base, "base", None)["ratio"] is None


@pytest.mark.parametrize("sizes", [[1, 1, 7, 4, 1], [4, 4, 3, 23, 13, 6], [4] * 12])
def test_coverage_of_differences_that_logs_have_in_common(sizes: list[int]) -> None:
    """Windows of a log share a part of their difference and follow each other: intervals by log
    hold the mean, intervals by window do not.
    """
    rng = np.random.default_rng(11)
    logs = np.repeat(np.arange(len(sizes)), sizes)
    by_log, by_window = blocks(logs), Blocks(np.arange(len(logs)), "windows", len(logs))
    values = np.array([_clustered(sizes, rng) for _ in range(600)]).T
    held = {}
    for name, drawn in (("log", by_log), ("window", by_window)):
        found = np.array(intervals(values, drawn))
        held[name] = float(((found[:, 0] <= 0) & (found[:, 1] >= 0)).mean())
    assert 0.88 < held["log"] < 0.985
    assert held["window"] < held["log"] - 0.05


def _clustered(sizes: list[int], rng: np.random.Generator) -> np.ndarray:
    """Differences of mean zero: a quarter of the variance between logs, the rest autoregressive
    (0.2) within.
    """
    out = []
    for size in sizes:
        noise = rng.normal(size=size)
        for i in range(1, size):
            noise[i] = 0.2 * noise[i - 1] + np.sqrt(1 - 0.04) * noise[i]
        out.append(0.5 * rng.normal() + np.sqrt(0.75) * noise)
    return np.concatenate(out)
