"""Genetic programming: fitness against NumPy's least squares, equations that are known, limits, and
the library that it needs.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest

from residnet.core.errors import FitError, UsageError
from residnet.regression.expressions import Algebra, Limits, Product
from residnet.regression.genetic import (
    EvolutionConfig,
    Fitness,
    Found,
    evolve,
    limits_of,
)

NAMES = ("a", "b", "c")
DATA = {name: np.random.default_rng(i).normal(size=200) for i, name in enumerate(NAMES)}
TRAIN = np.arange(200) % 3 != 0
NOISY = 2 * DATA["a"] - DATA["b"] * DATA["c"] + 0.1 * np.random.default_rng(9).normal(size=200)


def breed(target: np.ndarray, seed: int = 0, **config: Any) -> tuple[Algebra, Found]:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    made = EvolutionConfig.model_validate({"population": 200, "generations": 10} | config)
    algebra = Algebra(NAMES, limits_of(made))
    return algebra, evolve(algebra, DATA, target, TRAIN, made, seed)


def test_fitness_equals_least_squares() -> None:
    algebra = Algebra(NAMES)
    magnitude = next(iter(algebra.apply("abs", algebra.channel("a"))))
    sets: list[tuple[Product, ...]] = [
        ((0,), (1, 2)),
        ((0, 1), (2,), magnitude),
        (magnitude,),
        ((0,), (1,)),
    ]
    fitness = Fitness(algebra, DATA, NOISY, TRAIN)
    for terms, (train, validation, left) in zip(sets, fitness.of(sets), strict=True):
        x = algebra.values(terms, DATA).T
        best = np.linalg.lstsq(x[TRAIN], NOISY[TRAIN], rcond=None)[0]
        for part, error in ((TRAIN, train), (~TRAIN, validation)):
            share = np.square(NOISY[part] - x[part] @ best).sum() / np.square(NOISY[part]).sum()
            assert error == pytest.approx(share, rel=1e-10)
        assert left == terms
    assert fitness.fitted == 4
    fitness.of(sets)
    assert fitness.fitted == 4, "a set of terms is fitted once"


def test_terms_that_are_not_independent_or_not_finite_take_no_part() -> None:
    algebra = Algebra(("a", "b"), Limits(degree=8))
    data = {"a": DATA["a"], "b": 3 * DATA["a"]}
    fitness = Fitness(algebra, data, NOISY, TRAIN)
    one, both, nothing = fitness.of([((0,),), ((0,), (1,)), None])
    assert np.isfinite(one[0])
    assert both[0] == nothing[0] == np.inf
    huge = Fitness(algebra, {"a": DATA["a"] * 1e60, "b": DATA["b"]}, NOISY, TRAIN)
    assert huge.of([((0,) * 8, (1,))])[0][0] == np.inf


@pytest.mark.parametrize("split", ["sum", "expand"])
def test_finds_a_sum_of_products(split: str) -> None:
    target = 2 * DATA["a"] - DATA["b"] * DATA["c"] + 0.5 * DATA["c"] * np.abs(DATA["c"])
    _, found = breed(target, split=split, population=500)
    assert found.reached
    assert max(found.train, found.validation) < 1e-12
    assert found.history[-1].train == found.train


def test_genes_get_a_coefficient_each() -> None:
    target = 2 * (DATA["a"] + DATA["b"] * DATA["b"]) - 0.3 * DATA["c"]
    settings = {"genes": 3, "depth": 3, "first_depth": (0, 2), "generations": 40, "patience": 40}
    algebra, found = breed(target, split="gene", population=600, **settings)
    assert found.reached
    assert 2 <= len(found.terms) <= 3
    assert all(len(product) >= 1 for product in found.terms)
    assert algebra.limits.expand is False


def test_functions_and_protected_division() -> None:
    target = np.sin(DATA["a"]) / DATA["b"] - DATA["c"]
    _, found = breed(target, operators=("+", "*", "/", "sin"), population=500, generations=25)
    assert found.reached


def test_trees_with_a_term_twice_take_no_part_where_asked() -> None:
    settings = {"generations": 0, "population": 60, "operators": ("+", "-")}
    # a full tree of depth 2 is a sum of four of three channels
    assert breed(NOISY, 1, **settings, first_depth=(2, 2))[1].fitted > 0
    with pytest.raises(FitError, match="no individual"):
        breed(NOISY, 1, **settings, first_depth=(2, 2), equal_terms="reject")
    assert breed(NOISY, 1, **settings, first_depth=(0, 2), equal_terms="reject")[1].fitted > 0


def test_same_seed_same_result_and_pythons_generator_is_left_alone() -> None:
    random.seed(5)
    wanted = random.random()
    random.seed(5)
    one, two, other = (breed(NOISY, seed, generations=3)[1] for seed in (3, 3, 4))
    assert one == two
    assert one.history != other.history
    assert random.random() == wanted


def test_early_stopping_and_elite() -> None:
    _, found = breed(NOISY, population=60, generations=200, patience=4)
    assert len(found.history) - 1 <= found.generation + 4
    assert found.validation == min(g.validation for g in found.history)
    errors = [g.train for g in found.history]
    assert errors == sorted(errors, reverse=True), "the best goes over unchanged"


def test_bad_samples_are_told() -> None:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    config, algebra = EvolutionConfig(population=10), Algebra(NAMES)
    with pytest.raises(FitError, match="the target is not finite"):
        evolve(algebra, DATA, np.full(200, np.nan), TRAIN, config, 0)
    with pytest.raises(FitError, match="to train and to validate, given 200 of 200"):
        evolve(algebra, DATA, NOISY, np.ones(200, dtype=bool), config, 0)
    with pytest.raises(FitError, match="no individual"):
        evolve(Algebra(("a",)), {"a": np.zeros(200)}, NOISY, TRAIN, config, 0)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"crossover": 0.8, "mutation": 0.3}, "together at most 1"),
        ({"operators": ["abs"]}, "trees need one of"),
        ({"first_depth": [2, 12]}, "first_depth"),
        ({"population": 5, "elite": 5}, "elite"),
        ({"equal_terms": "reject", "split": "gene"}, "reject goes with"),
    ],
)
def test_impossible_settings(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EvolutionConfig.model_validate(config)


def test_without_deap_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'residnet\[gp\]'"):
        evolve(Algebra(NAMES), DATA, NOISY, TRAIN, EvolutionConfig(population=10), 0)
