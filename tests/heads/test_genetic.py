"""Equations bred by genetic programming: the documents' systems, and their writing read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
import torch
from made_equations import CHANNELS, draw_ship
from made_odin import FORCE_TRUTH, force_logs
from made_samples import sampled

from residnet.core.names import ACCELERATION_NAMES
from residnet.core.samples import Samples
from residnet.dynamics.store import load_model, save_model
from residnet.heads.genetic_config import GeneticConfig
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import parse_term
from residnet.regression.expressions import (
    Algebra,
    ExpressionLibrary,
    ExpressionLimits,
    Sum,
    build_library_state,
    format_equation,
    format_product,
    products_to_sympy,
)
from residnet.testing import make_example_samples
from residnet.testing.checks import make_example_model, make_example_spec

FORCES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")


@pytest.fixture(autouse=True)
def _deap() -> None:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")


def samples(log: dict[str, np.ndarray]) -> Samples:
    z, target = (
        np.stack([log[n] for n in names], axis=1) for names in (FORCES, ACCELERATION_NAMES)
    )
    return sampled(z, target, FORCES, t=log["t"])


def test_genetic_head_finds_force_equations_of_odin() -> None:
    """Document 000 eqs. (6.6)-(6.8)."""
    head = GeneticConfig.model_validate({"evolution": {"population": 1000}}).build(FORCES)
    data = samples({name: values[::10] for name, values in force_logs(1)[0].items()})
    head.calibrate(data)
    notes = head.fit_preferred(data)
    for axis, truth in FORCE_TRUTH.items():
        found = {c["term"]: c["value"] for c in notes["coefficients"] if c["axis"] == axis}
        assert found == pytest.approx(truth, rel=1e-9)
        assert notes["equations"][axis]["reached_goal"]
        assert notes["equations"][axis]["error_share"] < 1e-10
    assert set(head.format_terms()) == {term for truth in FORCE_TRUTH.values() for term in truth}
    parts = head.term_contributions(data.z, 0)
    assert list(parts) == [name for name in head.format_terms() if name in FORCE_TRUTH["u_dot"]]
    np.testing.assert_allclose(sum(parts.values()), data.target[:, 0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("final", [True, False])
def test_genetic_head_adopts_sparse_search_in_noise(final: bool) -> None:
    design = draw_ship(3, noise=0.1)
    config = GeneticConfig.model_validate(
        {"evolution": {"population": 20, "generations": 1}} | ({} if final else {"final": None})
    )
    head = config.build(CHANNELS)
    head.calibrate(design.samples)
    notes = head.fit_preferred(design.samples)
    for axis, truth in zip(ACCELERATION_NAMES, design.truth, strict=True):
        assert bool(notes["equations"][axis]["by_sparse_search"]) == final
        assert notes["equations"][axis]["lack_of_fit"] == {}
        if final:
            found = {
                tuple(sorted(parse_term(c["term"], CHANNELS))): c["value"]
                for c in notes["coefficients"]
                if c["axis"] == axis
            }
            wanted = {tuple(sorted(parse_term(term, CHANNELS))): truth[term] for term in truth}
            assert found == pytest.approx(wanted, rel=0.1)


def test_genetic_head_saved_and_loaded_is_equal(tmp_path: Path) -> None:
    evolution = {"population": 80, "generations": 3}
    config = GeneticConfig.model_validate(
        {"evolution": evolution | {"operators": ["+", "*", "abs", "sin", "/", "sqrt"]}}
    )
    spec = make_example_spec(config)
    model: Any = make_example_model(spec)
    save_model(tmp_path / "m", spec, model)
    again: Any = load_model(tmp_path / "m")[1]
    z = make_example_samples().z[:50]
    with torch.no_grad():
        assert torch.equal(
            again.head.teacher_forced_residuals(z), model.head.teacher_forced_residuals(z)
        )
    assert again.head.format_terms() == model.head.format_terms()


def expression(algebra: Algebra) -> Sum:
    """-2 u |v + 3 sin(u r)| + sqrt(v) / (1 + cos(r)^2), not multiplied out, and a constant."""
    u, v, r = (algebra.make_channel(name) for name in ("u", "v", "r"))
    inside = algebra.add(v, algebra.apply_function("sin", algebra.multiply(u, r)), 3.0)
    one: Sum = {(): 1.0}
    cosine = algebra.apply_function("cos", r)
    below = algebra.apply_function("inv", algebra.add(one, algebra.multiply(cosine, cosine)))
    first = algebra.multiply(algebra.multiply(u, {(): -2.0}), algebra.apply_function("abs", inside))
    return algebra.add(
        algebra.add(first, algebra.multiply(algebra.apply_function("sqrt", v), below)), {(): 0.25}
    )


def truth(u: np.ndarray, v: np.ndarray, r: np.ndarray) -> np.ndarray:
    return np.asarray(
        -2 * u * np.abs(v + 3 * np.sin(u * r)) + np.sqrt(np.abs(v)) / (1 + np.cos(r) ** 2) + 0.25
    )


def test_expression_library_equals_written_equation() -> None:
    algebra = Algebra(("u", "v", "r"), ExpressionLimits(nesting=3))
    meant = expression(algebra)
    products = list(meant)
    weights = list(meant.values())
    library = ExpressionLibrary(3)
    library.load_state_dict(build_library_state(algebra, products, 3))
    z = np.random.default_rng(0).normal(size=(30, 3))
    wanted = truth(*z.T)
    for module in (library, torch.jit.script(library)):
        with torch.no_grad():
            found = module(torch.from_numpy(z)).numpy() @ weights
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    read, same = library.decode_terms(algebra.channels)
    assert [format_product(read, p) for p in same] == [format_product(algebra, p) for p in products]
    value = products_to_sympy(algebra, list(zip(products, weights, strict=True)))
    written = format_equation("total", "", value, algebra.channels)
    called = sympy.lambdify(sympy.symbols("u v r"), sympy.sympify(written["sympy"]), "numpy")
    np.testing.assert_allclose(called(*z.T), wanted, rtol=1e-12)
    assert r"\sqrt{\left|{v}\right|}" in written["latex"]


def test_format_product_is_read_by_term_library() -> None:
    algebra = Algebra(("u", "rpm", "nozzle"))
    u, rpm, nozzle = (algebra.make_channel(name) for name in algebra.channels)
    multiply = algebra.multiply
    apply = algebra.apply_function
    made: list[Sum] = [
        multiply(u, apply("abs", u)),
        multiply(multiply(rpm, rpm), apply("cos", nozzle)),
        apply("sqrt", u),
        apply("inv", rpm),
        {(): 1.0},
    ]
    products = [next(iter(a)) for a in made]
    z = np.random.default_rng(0).normal(size=(20, 3))
    library = TermLibrary(
        [format_product(algebra, product) for product in products], algebra.channels
    )
    own = algebra.evaluate_products(products, dict(zip(algebra.channels, z.T, strict=True)))
    np.testing.assert_allclose(library(torch.from_numpy(z)).numpy(), own.T, rtol=1e-12)
