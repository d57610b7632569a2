"""Sparse regression against planted equations and the best of all subsets."""

from __future__ import annotations

from itertools import combinations
from math import comb, log
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from residnet.core.errors import FitError
from residnet.regression.sparse import (
    ForwardSearch,
    SparseEquation,
    find_equation,
    merge_similar_columns,
    reduce_problem,
    rss_with_one_added,
)
from residnet.regression.sparse_config import SparseSearchConfig


def named(count: int) -> list[str]:
    return [f"c{i}" for i in range(count)]


def solve(x: np.ndarray, y: np.ndarray, **config: Any) -> SparseEquation:
    return find_equation(
        reduce_problem(x, y[:, None], named(x.shape[1]), [1] * x.shape[1]),
        0,
        SparseSearchConfig(**config),
    )[0]


def planted(
    seed: int, rows: int = 300, columns: int = 30, noise: float = 0.0
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Correlated columns of very different sizes, and a target of four of them."""
    random = np.random.default_rng(seed)
    mix = np.eye(columns) + 0.5 * random.normal(size=(columns, columns))
    x = random.normal(size=(rows, columns)) @ mix * 10.0 ** random.uniform(-3, 5, columns)
    chosen = random.choice(columns, 4, replace=False)
    values = random.uniform(0.5, 2.0, 4) * random.choice([-1, 1], 4) / x[:, chosen].std(0)
    y = x[:, chosen] @ values
    truth = {f"c{i}": float(v) for i, v in zip(chosen, values, strict=True)}
    return x, y + noise * y.std() * random.normal(size=rows), truth


@pytest.mark.parametrize("seed", range(4))
def test_a_planted_equation_is_found_exactly(seed: int) -> None:
    x, y, truth = planted(seed)
    equation = solve(x, y)
    assert equation.is_exact
    assert dict(zip(equation.terms, equation.values, strict=True)) == pytest.approx(truth, rel=1e-9)
    assert not equation.alternatives
    assert not equation.undecided


@pytest.mark.parametrize("seed", range(4))
def test_a_planted_equation_is_found_in_noise_with_honest_errors(seed: int) -> None:
    x, y, truth = planted(seed, rows=2000, noise=0.2)
    equation = solve(x, y)
    assert set(equation.terms) == set(truth)
    assert equation.relative_error == pytest.approx(0.2 / np.sqrt(1.04), rel=0.1)
    found = dict(zip(equation.terms, equation.values, strict=True))
    off = (
        np.array([found[term] - truth[term] for term in equation.terms]) / equation.standard_errors
    )
    assert np.abs(off).max() < 4.0
    # the textbook formula on the columns that were found
    own = x[:, [int(term[1:]) for term in equation.terms]]
    left = y - own @ equation.values
    textbook = np.sqrt(np.diag(np.linalg.inv(own.T @ own)) * (left @ left) / (len(y) - 4))
    np.testing.assert_allclose(equation.standard_errors, textbook, rtol=0.1)


def test_standard_errors_grow_with_the_correlation_of_the_noise() -> None:
    random = np.random.default_rng(0)
    x = np.cumsum(random.normal(size=(4000, 3)), axis=0)
    x -= x.mean(0)
    noise = lfilter([1.0], [1.0, -0.9], random.normal(size=4000))
    white = solve(x, x[:, 0] + random.normal(size=4000) * noise.std())
    coloured = solve(x, x[:, 0] + noise)
    # (1 + phi) / (1 - phi) = 19 samples say what one does
    assert coloured.standard_errors[0] / white.standard_errors[0] == pytest.approx(
        np.sqrt(19), rel=0.3
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_search_finds_the_best_of_all_subsets(seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.normal(size=(60, 9)) @ (np.eye(9) + random.normal(size=(9, 9)))
    x /= np.linalg.norm(x, axis=0)
    y = x[:, :3] @ [1.0, -1.0, 1.0] + 0.05 * random.normal(size=60)
    search = ForwardSearch(x, y, 60.0, SparseSearchConfig(gamma=0.5))
    everything = [list(chosen) for k in range(10) for chosen in combinations(range(9), k)]
    best = min(everything, key=search.criterion_of)
    value, chosen = search.beam_search()
    assert (
        value == search.criterion_of(chosen) == pytest.approx(search.criterion_of(best), abs=1e-6)
    )


def test_criterion_is_the_formula_and_columns_added_leave_what_refits_do() -> None:
    search = ForwardSearch(np.zeros((2, 20)), np.full(2, 5.0), 100.0, SparseSearchConfig(gamma=0.5))
    wanted = 100 * log(2.0 / 50.0) + 3 * log(100) + log(comb(20, 3))
    assert float(search.criterion(2.0, 3)) == pytest.approx(wanted)
    x, y, _ = planted(3, columns=7, noise=0.5)
    unit = x / np.linalg.norm(x, axis=0)
    table = rss_with_one_added(unit, y, np.array([[4, 5], [1, 5], [1, 4]]))
    for row, gone in enumerate((1, 4, 5)):
        for j in (0, 2, 3, 6, gone):
            own = unit[:, [c for c in (1, 4, 5) if c != gone] + [j]]
            left = y - own @ np.linalg.lstsq(own, y, rcond=None)[0]
            assert table[row, j] == pytest.approx(left @ left, rel=1e-9)


def test_columns_that_simpler_ones_make_up_are_set_aside_and_told() -> None:
    random = np.random.default_rng(0)
    a, b, c = np.abs(random.normal(size=(3, 100)))
    levels = random.choice([1.0, 3.0], 100)
    x = np.stack(
        (a * np.abs(a), a**2, b, np.ones(100), levels, levels**2, np.zeros(100), c), axis=1
    )
    names = ["a|a|", "a^2", "b", "1", "n", "n^2", "v", "c"]
    reduced = reduce_problem(
        x,
        (2 * a**2 + levels**2 - b)[:, None],
        names,
        [2, 2, 1, 0, 1, 2, 1, 1],
        complexity=[1.5, 1.0, 1, 0, 1, 1, 1, 1],
    )
    assert reduced.names == ("1", "b", "n", "c", "a^2")
    assert reduced.unexcited == ("v",)
    assert reduced.dependent == {
        "a|a|": pytest.approx({"a^2": 1.0}),
        "n^2": pytest.approx({"1": -3.0, "n": 4.0}),
    }
    equation = find_equation(reduced, 0, SparseSearchConfig())[0]
    assert dict(zip(equation.terms, equation.values, strict=True)) == pytest.approx(
        {"1": -3.0, "n": 4.0, "b": -1.0, "a^2": 2.0}
    )


def test_noise_does_not_set_columns_apart() -> None:
    """A vessel that never goes astern, with a sensor that says it did: u^2 and u|u| must not both
    be taken.
    """
    random = np.random.default_rng(2)
    u = np.append(np.zeros(100), random.uniform(0.5, 2.0, 900)) + 0.01 * random.normal(size=1000)
    w = random.normal(size=1000)
    y = -u * np.abs(u) + w + 0.05 * random.normal(size=1000)
    x = np.stack((u, np.abs(u), u**2, u * np.abs(u), w), axis=1)
    reduced = reduce_problem(
        x,
        y[:, None],
        ["u", "|u|", "u^2", "u|u|", "w"],
        [1, 1, 2, 2, 1],
        complexity=[1, 1.5, 1, 1.5, 1],
    )
    assert reduced.rank == 5
    equation, within = find_equation(reduced, 0, SparseSearchConfig())
    assert equation.terms == ("w", "u^2")
    assert set(within.dependent) == {"|u|", "u|u|"}
    assert merge_similar_columns(reduced, 0.0).rank == 5


def test_a_term_close_to_simpler_ones_is_taken_where_the_criterion_prefers_it() -> None:
    """u^2 n^2 differs from simpler terms by less than a hundredth, and explains the target."""
    random = np.random.default_rng(3)
    u, n = random.uniform(0.8, 1.6, 2000), random.uniform(8.0, 12.0, 2000)
    w = random.normal(size=2000)
    names = ["1", "u", "n", "w", "u^2", "n^2", "u n", "u^2 n", "u n^2", "u^2 n^2"]
    x = np.stack(
        (np.ones(2000), u, n, w, u**2, n**2, u * n, u**2 * n, u * n**2, u**2 * n**2), axis=1
    )
    y = u**2 * n**2 / 100.0 + w
    y += 0.05 * y.std() * random.normal(size=2000)
    reduced = reduce_problem(x, y[:, None], names, [0, 1, 1, 1, 2, 2, 2, 3, 3, 4])
    assert "u^2 n^2" not in merge_similar_columns(reduced, 1e-2).names
    assert set(find_equation(reduced, 0, SparseSearchConfig())[0].terms) == {"w", "u^2 n^2"}


def test_terms_that_the_data_cannot_tell_apart_are_named() -> None:
    random = np.random.default_rng(0)
    a = random.normal(size=200)
    x = np.stack((a, a + 0.05 * random.normal(size=200), random.normal(size=200)), axis=1)
    equation = solve(x, a + 2 * x[:, 2] + 0.5 * random.normal(size=200))
    (taken,) = set(equation.terms) - {"c2"}
    assert equation.alternatives == {taken: [{"c0": "c1", "c1": "c0"}[taken]]}


def test_what_the_data_leave_open_is_named_instead_of_taken() -> None:
    """A true but weak term: left out, and said to be possible; a candidate that is surely absent is
    not.
    """
    random = np.random.default_rng(4)
    x = random.normal(size=(400, 3))
    x[:, 1] = x[:, 0] + 0.1 * x[:, 1]
    equation = solve(x, x[:, 0] + 0.5 * x[:, 1] + 0.8 * random.normal(size=400))
    assert len(equation.terms) == 1
    assert {"c0", "c1"} - set(equation.terms) <= set(equation.undecided)
    assert equation.undecided.get("c2", 0.0) < 0.15


def test_pure_noise_and_a_target_of_zero_have_no_terms() -> None:
    def noise(seed: int, *shape: int) -> np.ndarray:
        return np.random.default_rng(seed).normal(size=shape)

    found = [len(solve(noise(s, 500, 40), noise(100 + s, 500)).terms) for s in range(10)]
    assert sum(found) <= 1
    equation = solve(noise(0, 50, 5), np.zeros(50))
    assert equation.terms == ()
    assert equation.is_exact


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.zeros((20, 2)), np.ones((20, 1)), "every candidate term is zero"),
        (np.ones((3, 5)), np.ones((3, 1)), "3 samples do not determine 5 candidates"),
        (np.full((20, 2), np.nan), np.ones((20, 1)), "term 'c0' is not finite"),
        (np.ones((20, 2)), np.full((20, 1), np.inf), "the target is not finite"),
    ],
)
def test_errors_are_one_line(x: np.ndarray, y: np.ndarray, message: str) -> None:
    with pytest.raises(FitError, match=message) as caught:
        reduce_problem(x, y, named(x.shape[1]), [1] * x.shape[1])
    assert "\n" not in str(caught.value)
