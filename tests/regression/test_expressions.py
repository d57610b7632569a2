"""Expressions in normal form against SymPy and against their own values."""

from __future__ import annotations

import random

import numpy as np
import pytest
import sympy

from residnet.regression.expressions import (
    FUNCTIONS,
    ONE,
    Algebra,
    Limits,
    Sum,
    TooLargeError,
    values_of,
)

NAMES = ("a", "b", "c")
DATA = {name: np.random.default_rng(i).normal(size=40) for i, name in enumerate(NAMES)}


def value(algebra: Algebra, meant: Sum) -> np.ndarray:
    return (
        np.array(list(meant.values())) @ algebra.values(list(meant), DATA)
        if meant
        else np.zeros(40)
    )


def grown(algebra: Algebra, seed: random.Random, depth: int) -> tuple[Sum, np.ndarray]:
    """A random expression, and its values worked out beside it."""
    kind = (
        seed.choice(("channel", "number"))
        if depth == 0
        else seed.choice(("add", "subtract", "multiply", "function", "channel"))
    )
    if kind == "channel":
        name = seed.choice(NAMES)
        return algebra.channel(name), DATA[name]
    if kind == "number":
        number = seed.choice((-1.5, 1.0, 2.0))
        return {ONE: number}, np.full(40, number)
    a, x = grown(algebra, seed, depth - 1)
    if kind == "function":
        function = seed.choice([f for f in FUNCTIONS if f != "sum"])
        return algebra.apply(function, a), values_of(function, x)
    b, y = grown(algebra, seed, depth - 1)
    made = {
        "add": (lambda: algebra.add(a, b), x + y),
        "subtract": (lambda: algebra.add(a, b, -1.0), x - y),
    }
    build, result = made.get(kind, (lambda: algebra.multiply(a, b), x * y))
    return build(), result


@pytest.mark.parametrize("expand", [True, False])
def test_normal_form_keeps_the_values(expand: bool) -> None:
    limits = Limits(terms=200, degree=16, nesting=5, expand=expand)
    algebra, seed, tried = Algebra(NAMES, limits), random.Random(1), 0
    while tried < 100:
        try:
            meant, truth = grown(algebra, seed, 4)
        except TooLargeError:
            continue
        if np.abs(truth).max() > 1e-9:
            np.testing.assert_allclose(
                value(algebra, meant), truth, rtol=1e-6, atol=1e-8 * np.abs(truth).max()
            )
            tried += 1


def test_products_are_multiplied_out_as_sympy_does() -> None:
    algebra = Algebra(NAMES)
    a, b, c = (algebra.channel(name) for name in NAMES)
    second = algebra.multiply(algebra.add(a, c, -2.0), algebra.add(b, algebra.multiply(c, c)))
    made = algebra.multiply(algebra.add(a, b), second)
    x, y, z = sympy.symbols(NAMES)
    truth = sympy.Poly(sympy.expand((x + y) * (x - 2 * z) * (y + z**2)), x, y, z).as_dict()
    powers = {tuple(product.count(i) for i in range(3)): made[product] for product in made}
    assert powers == {k: float(v) for k, v in truth.items()}


def test_equal_expressions_are_one() -> None:
    algebra = Algebra(NAMES)
    a, b = algebra.channel("a"), algebra.channel("b")
    minus = algebra.add({}, a, -1.0)
    both = algebra.add(a, b)
    turned = algebra.add({}, both, -1.0)
    apply, times = algebra.apply, algebra.multiply
    assert apply("abs", times(minus, b)) == times(apply("abs", a), apply("abs", b))
    assert times(apply("abs", a), apply("abs", a)) == times(a, a)
    assert apply("abs", times(a, a)) == times(a, a)
    assert apply("abs", apply("abs", a)) == apply("abs", a)
    assert apply("cos", turned) == apply("cos", both)
    assert apply("sin", turned) == algebra.add({}, apply("sin", both), -1.0)
    assert apply("abs", turned) == apply("abs", both)
    assert algebra.add(a, a, -1.0) == {}


def test_brackets_stay_where_products_are_not_multiplied_out() -> None:
    algebra = Algebra(NAMES, Limits(expand=False))
    a, b, c = (algebra.channel(name) for name in NAMES)
    made = algebra.add(algebra.multiply(algebra.add(a, b), algebra.add(b, c)), a)
    assert len(made) == 2
    np.testing.assert_allclose(
        value(algebra, made), (DATA["a"] + DATA["b"]) * (DATA["b"] + DATA["c"]) + DATA["a"]
    )


def test_limits_hold() -> None:
    algebra = Algebra(NAMES, Limits(terms=3, degree=2, nesting=1))
    a, b, c = (algebra.channel(name) for name in NAMES)
    with pytest.raises(TooLargeError):
        algebra.multiply(algebra.multiply(a, b), c)
    with pytest.raises(TooLargeError):
        algebra.apply("sin", algebra.apply("cos", a))
    with pytest.raises(TooLargeError):
        algebra.multiply(algebra.add(a, b), algebra.add(b, c))
    # overflow is told by values that are not finite
    algebra = Algebra(("a",), Limits(degree=8))
    column = algebra.values([(0,) * 8], {"a": np.array([1e60, 1.0])})
    assert column[0].tolist() == [np.inf, 1.0]
