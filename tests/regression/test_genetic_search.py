"""Genetic programming: expressions in normal form against SymPy and their own values, fitness
against NumPy's least squares, equations that are known, and the library that it needs.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
import sympy

from residnet.core.errors import FitError, UsageError
from residnet.regression.expressions import (
    CONSTANT_PRODUCT,
    FUNCTIONS,
    Algebra,
    ExpressionLimits,
    Product,
    Sum,
    TooLargeError,
    apply_function,
)
from residnet.regression.genetic import EvolutionResult, FitnessEvaluator, evolve, expression_limits
from residnet.regression.genetic_config import EvolutionConfig

NAMES = ("a", "b", "c")
DATA = {name: np.random.default_rng(i).normal(size=200) for i, name in enumerate(NAMES)}
TRAIN = np.arange(200) % 3 != 0
NOISY = 2 * DATA["a"] - DATA["b"] * DATA["c"] + 0.1 * np.random.default_rng(9).normal(size=200)


def value(algebra: Algebra, meant: Sum) -> np.ndarray:
    if not meant:
        return np.zeros(200)
    return np.array(list(meant.values())) @ algebra.evaluate_products(list(meant), DATA)


def grown(algebra: Algebra, seed: random.Random, depth: int) -> tuple[Sum, np.ndarray]:
    """A random expression, and its values worked out beside it."""
    more = ("add", "subtract", "multiply", "function", "channel")
    kind = seed.choice(more if depth else ("channel", "number"))
    if kind == "channel":
        name = seed.choice(NAMES)
        return algebra.make_channel(name), DATA[name]
    if kind == "number":
        number = seed.choice((-1.5, 1.0, 2.0))
        return {CONSTANT_PRODUCT: number}, np.full(200, number)
    a, x = grown(algebra, seed, depth - 1)
    if kind == "function":
        function = seed.choice([f for f in FUNCTIONS if f != "sum"])
        return algebra.apply_function(function, a), apply_function(function, x)
    b, y = grown(algebra, seed, depth - 1)
    if kind == "multiply":
        return algebra.multiply(a, b), x * y
    sign = 1.0 if kind == "add" else -1.0
    return algebra.add(a, b, sign), x + sign * y


@pytest.mark.parametrize("expand", [True, False])
def test_normal_form_keeps_the_values(expand: bool) -> None:
    limits = ExpressionLimits(terms=200, degree=16, nesting=5, expand=expand)
    algebra = Algebra(NAMES, limits)
    seed = random.Random(1)
    tried = 0
    while tried < 100:
        try:
            meant, truth = grown(algebra, seed, 4)
        except TooLargeError:
            continue
        if np.abs(truth).max() > 1e-9:
            size = np.abs(truth).max()
            found = value(algebra, meant)
            np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-8 * size)
            tried += 1


def test_products_are_multiplied_out_as_sympy_does() -> None:
    algebra = Algebra(NAMES)
    a, b, c = (algebra.make_channel(name) for name in NAMES)
    second = algebra.multiply(algebra.add(a, c, -2.0), algebra.add(b, algebra.multiply(c, c)))
    made = algebra.multiply(algebra.add(a, b), second)
    x, y, z = sympy.symbols(NAMES)
    truth = sympy.Poly(sympy.expand((x + y) * (x - 2 * z) * (y + z**2)), x, y, z).as_dict()
    powers = {tuple(product.count(i) for i in range(3)): made[product] for product in made}
    assert powers == {k: float(v) for k, v in truth.items()}
    # unless brackets are to stay
    closed = Algebra(NAMES, ExpressionLimits(expand=False))
    assert len(closed.add(closed.multiply(closed.add(a, b), closed.add(b, c)), a)) == 2


def test_equal_expressions_are_one() -> None:
    algebra = Algebra(NAMES)
    a, b = algebra.make_channel("a"), algebra.make_channel("b")
    minus = algebra.add({}, a, -1.0)
    both = algebra.add(a, b)
    turned = algebra.add({}, both, -1.0)
    apply = algebra.apply_function
    times = algebra.multiply
    assert apply("abs", times(minus, b)) == times(apply("abs", a), apply("abs", b))
    assert times(apply("abs", a), apply("abs", a)) == times(a, a)
    assert apply("abs", times(a, a)) == times(a, a)
    assert apply("abs", apply("abs", a)) == apply("abs", a)
    assert apply("cos", turned) == apply("cos", both)
    assert apply("sin", turned) == algebra.add({}, apply("sin", both), -1.0)
    assert apply("abs", turned) == apply("abs", both)
    assert algebra.add(a, a, -1.0) == {}


def test_limits_hold() -> None:
    algebra = Algebra(NAMES, ExpressionLimits(terms=3, degree=2, nesting=1))
    a, b, c = (algebra.make_channel(name) for name in NAMES)
    with pytest.raises(TooLargeError):
        algebra.multiply(algebra.multiply(a, b), c)
    with pytest.raises(TooLargeError):
        algebra.apply_function("sin", algebra.apply_function("cos", a))
    with pytest.raises(TooLargeError):
        algebra.multiply(algebra.add(a, b), algebra.add(b, c))
    # overflow is told by values that are not finite
    algebra = Algebra(("a",), ExpressionLimits(degree=8))
    column = algebra.evaluate_products([(0,) * 8], {"a": np.array([1e60, 1.0])})
    assert column[0].tolist() == [np.inf, 1.0]


def breed(target: np.ndarray, seed: int = 0, **config: Any) -> tuple[Algebra, EvolutionResult]:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    made = EvolutionConfig.model_validate({"population": 200, "generations": 10} | config)
    algebra = Algebra(NAMES, expression_limits(made))
    return algebra, evolve(algebra, DATA, target, TRAIN, made, seed)


def test_fitness_equals_least_squares() -> None:
    algebra = Algebra(NAMES)
    magnitude = next(iter(algebra.apply_function("abs", algebra.make_channel("a"))))
    sets: list[tuple[Product, ...]] = [
        ((0,), (1, 2)),
        ((0, 1), (2,), magnitude),
        (magnitude,),
        ((0,), (1,)),
    ]
    fitness = FitnessEvaluator(algebra, DATA, NOISY, TRAIN)
    for terms, (train, validation, left) in zip(sets, fitness.evaluate(sets), strict=True):
        x = algebra.evaluate_products(terms, DATA).T
        best = np.linalg.lstsq(x[TRAIN], NOISY[TRAIN], rcond=None)[0]
        for part, error in ((TRAIN, train), (~TRAIN, validation)):
            share = np.square(NOISY[part] - x[part] @ best).sum() / np.square(NOISY[part]).sum()
            assert error == pytest.approx(share, rel=1e-10)
        assert left == terms
    assert fitness.n_fitted == 4
    fitness.evaluate(sets)
    assert fitness.n_fitted == 4, "a set of terms is fitted once"


def test_terms_that_are_not_independent_or_not_finite_take_no_part() -> None:
    algebra = Algebra(("a", "b"), ExpressionLimits(degree=8))
    data = {"a": DATA["a"], "b": 3 * DATA["a"]}
    fitness = FitnessEvaluator(algebra, data, NOISY, TRAIN)
    one, both, nothing = fitness.evaluate([((0,),), ((0,), (1,)), None])
    assert np.isfinite(one[0])
    assert both[0] == nothing[0] == np.inf
    huge = FitnessEvaluator(algebra, {"a": DATA["a"] * 1e60, "b": DATA["b"]}, NOISY, TRAIN)
    assert huge.evaluate([((0,) * 8, (1,))])[0][0] == np.inf


@pytest.mark.parametrize("split", ["sum", "expand"])
def test_finds_a_sum_of_products(split: str) -> None:
    target = 2 * DATA["a"] - DATA["b"] * DATA["c"] + 0.5 * DATA["c"] * np.abs(DATA["c"])
    _, found = breed(target, split=split, population=500)
    assert found.is_goal_reached
    assert max(found.train, found.validation) < 1e-12
    assert found.history[-1].train == found.train


def test_genes_get_a_coefficient_each() -> None:
    target = 2 * (DATA["a"] + DATA["b"] * DATA["b"]) - 0.3 * DATA["c"]
    settings: dict[str, Any] = {
        "genes": 3,
        "depth": 3,
        "first_depth": (0, 2),
        "generations": 40,
        "patience": 40,
    }
    algebra, found = breed(target, split="gene", population=600, **settings)
    assert found.is_goal_reached
    assert 2 <= len(found.terms) <= 3
    assert all(len(product) >= 1 for product in found.terms)
    assert algebra.limits.expand is False


def test_functions_and_protected_division() -> None:
    target = np.sin(DATA["a"]) / DATA["b"] - DATA["c"]
    _, found = breed(target, operators=("+", "*", "/", "sin"), population=500, generations=25)
    assert found.is_goal_reached


def test_trees_with_a_term_twice_take_no_part_where_asked() -> None:
    settings = {"generations": 0, "population": 60, "operators": ("+", "-")}
    # a full tree of depth 2 is a sum of four of three channels
    assert breed(NOISY, 1, **settings, first_depth=(2, 2))[1].n_fitted > 0
    with pytest.raises(FitError, match="no individual"):
        breed(NOISY, 1, **settings, first_depth=(2, 2), equal_terms="reject")
    assert breed(NOISY, 1, **settings, first_depth=(0, 2), equal_terms="reject")[1].n_fitted > 0


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
    config = EvolutionConfig(population=10)
    algebra = Algebra(NAMES)
    with pytest.raises(FitError, match="the target is not finite"):
        evolve(algebra, DATA, np.full(200, np.nan), TRAIN, config, 0)
    with pytest.raises(FitError, match="200 of 200 samples are for training"):
        evolve(algebra, DATA, NOISY, np.ones(200, dtype=bool), config, 0)
    with pytest.raises(FitError, match="no individual"):
        evolve(Algebra(("a",)), {"a": np.zeros(200)}, NOISY, TRAIN, config, 0)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"crossover": 0.8, "mutation": 0.3}, "crossover and mutation: .*at most 1"),
        ({"operators": ["abs"]}, "operators: "),
        ({"first_depth": [2, 12]}, "first_depth"),
        ({"population": 5, "elite": 5}, "elite"),
        ({"equal_terms": "reject", "split": "gene"}, "equal_terms: reject"),
    ],
)
def test_impossible_settings(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EvolutionConfig.model_validate(config)


def test_without_deap_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"pip install 'residnet\[gp\]'"):
        evolve(Algebra(NAMES), DATA, NOISY, TRAIN, EvolutionConfig(population=10), 0)
