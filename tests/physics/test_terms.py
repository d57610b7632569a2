"""Terms by name against NumPy, and candidate terms against their definition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from residnet.core.errors import ConfigError
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import (
    CandidatesConfig,
    Factor,
    make_polynomial_terms,
    parse_term,
    rank_candidates,
)

NAMES = ("u", "v", "r", "n_port", "delta2")

READ: dict[str, tuple[tuple[Any, ...], ...]] = {
    "1": (),
    "u|u|": (("u", False, 1), ("u", True, 1)),
    "|u|v": (("u", True, 1), ("v", False, 1)),
    "  v   r ": (("v", False, 1), ("r", False, 1)),
    "v*r": (("v", False, 1), ("r", False, 1)),
    "n_port^2 delta2": (("n_port", False, 2), ("delta2", False, 1)),
    "|v|^3 u^9": (("v", True, 3), ("u", False, 9)),
    "1 u": (("u", False, 1),),
    "|u||v|": (("u", True, 1), ("v", True, 1)),
    "u sin(v)": (("u", False, 1), ("v", False, 1, "sin")),
}


@pytest.mark.parametrize("term", READ)
def test_parse_term_returns_factors(term: str) -> None:
    assert parse_term(term, NAMES) == tuple(Factor(*factor) for factor in READ[term])


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("   ", "empty"),
        ("n_prt u", "did you mean 'n_port'"),
        ("|w|", "no channel 'w'"),
        ("uv", "no channel 'uv'"),
        ("u|v", "invalid from '|v'"),
        ("u+v", r"invalid from '\+v'"),
        ("2 u", "invalid from '2 u'"),
        ("u^1.5", r"invalid from"),
        ("u^0", r"invalid from '\^0'"),
        ("u^10", r"invalid from '0'"),
        ("u**2", r"invalid from"),
        ("sin u", "no channel 'sin'"),
        ("sin(w)", "no channel 'w'"),
        ("tan(u)", "no function 'tan'"),
        ("sin(u v)", r"invalid from '\(u v\)'|no channel 'sin'"),
        ("|sin(u)|", "invalid from"),
        ("cos(u)^-1 v", r"cannot divide by cos\(u\)"),
    ],
)
def test_parse_term_refuses_invalid_terms(term: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_term(term, NAMES)
    assert "\n" not in str(caught.value)


def test_parse_term_without_functions_refuses_them() -> None:
    with pytest.raises(ConfigError, match="only products of channels"):
        parse_term("u sin(v)", NAMES, functions=False)


U, V, R, N, D = np.moveaxis(np.random.default_rng(0).normal(size=(7, 11, 5)), -1, 0)
ONE = np.ones_like(U)
LIBRARIES: dict[str, tuple[list[str], list[np.ndarray]]] = {
    "products": (
        ["1", "u", "u|u|", "|u|v", "v |r|", "n_port^2 delta2", "|v|^3 u^2", "1", "u^-1 r"],
        [ONE, U, U * abs(U), abs(U) * V, V * abs(R), N**2 * D, abs(V) ** 3 * U**2, ONE, R / U],
    ),
    "functions": (
        ["sin(u)", "cos(v)^2 n_port", "sqrt(r)", "ssqrt(r) |v|", "inv(n_port) u", "inv(r)^2"],
        [
            np.sin(U),
            np.cos(V) ** 2 * N,
            np.sqrt(abs(R)),
            np.sign(R) * np.sqrt(abs(R)) * abs(V),
            U / N,
            1 / R**2,
        ],
    ),
    "channels": ([*NAMES[::-1], "u"], [D, N, R, V, U, U]),
    "some channels": (["r", "1", "u"], [R, ONE, U]),
    "constants": (["1", "1"], [ONE, ONE]),
}


@pytest.mark.parametrize("name", LIBRARIES)
def test_term_library_equals_numpy(name: str) -> None:
    terms, truth = LIBRARIES[name]
    z = torch.from_numpy(np.stack((U, V, R, N, D), axis=-1))
    wanted = np.stack(truth, axis=-1)
    library = TermLibrary(terms, NAMES)
    assert library.n_terms == len(terms)
    for module in (library, torch.jit.script(library)):
        np.testing.assert_allclose(module(z), wanted, rtol=1e-13)
    single = library(z.float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, wanted, rtol=3e-5, atol=1e-6)


def test_term_library_without_terms_has_no_columns() -> None:
    assert TermLibrary([], NAMES)(torch.randn(4, 2, 5)).shape == (4, 2, 0)


@pytest.mark.parametrize(
    ("z", "terms", "expected"),
    [
        (
            [-2.0, 0.0, 0.5, -4.0, 0.0],
            ["n_port^-1", "u |n_port|^-2", "|u|^-1 r", "v"],
            [-0.25, -0.125, 0.25, 0.0],
        ),
        ([0.0] * 5, ["sqrt(u)", "ssqrt(v)", "inv(r)"], [0.0] * 3),
    ],
)
def test_term_library_gradients_are_finite_at_zero(
    z: list[float], terms: list[str], expected: list[float]
) -> None:
    at = torch.tensor([z], dtype=torch.float64, requires_grad=True)
    out = TermLibrary(terms, NAMES)(at)
    np.testing.assert_allclose(out.detach()[0], expected, rtol=1e-14, atol=1e-11)
    assert bool(torch.isfinite(torch.autograd.grad(out.sum(), at)[0]).all())


def test_make_polynomial_terms_returns_each_product_once() -> None:
    names = ("u", "v", "r")
    terms = make_polynomial_terms(names, 3, magnitudes=("u", "r"))
    # binomial(3 + 3, 3) - 1 products, then the magnitudes
    assert len(terms) == len(set(terms)) == 19 + 2
    assert terms[-2:] == ("u|u|", "r|r|")
    found = TermLibrary(terms[:19], names)(torch.rand(1, 3, dtype=torch.float64) + 0.5)[0]
    assert len({round(float(value), 12) for value in found}) == 19


JETS = CandidatesConfig(
    inputs=("rpm",), input_degree=2, coupling=("u",), coupling_degree=2, angles=("nozzle",)
)
JET_NAMES = ("u", "v", "r", "rpm", "nozzle")
SHIP = ("u", "v", "r", "n", "delta")


def terms_of(names: Sequence[str], **config: Any) -> set[str]:
    return {c.term for c in CandidatesConfig(**config).generate_candidates(tuple(names))}


def test_generate_candidates_of_motions_with_magnitudes() -> None:
    cubic = {"u^3", "u^2 v", "u v^2", "v^3"}
    plain = {"1", "u", "v", "u^2", "u v", "v^2"} | cubic
    assert terms_of("uv", inputs=(), magnitudes=False) == plain
    sized = {"|u|", "|v|", "u |u|", "u |v|", "v |u|", "v |v|", "|u| |v|"}
    assert terms_of("uv", inputs=()) == plain | sized
    # explicit degrees exclude the cubic terms
    assert terms_of("uv", inputs=(), motion_degree=2) == (plain | sized) - cubic
    assert terms_of("uv", inputs=(), input_degree=1) == (plain | sized) - cubic


def test_generate_candidates_of_jets_are_those_of_the_document() -> None:
    found = JETS.generate_candidates(JET_NAMES)
    place = {c.term: i for i, c in enumerate(found)}
    assert len(found) == len(place) == 49
    # (6.21)-(6.23): nine products with the cosine, nine with the sine, and the hull
    for speed in ("", "u ", "u^2 "):
        for turns in ("", "rpm ", "rpm^2 "):
            assert {f"{speed}{turns}{f}(nozzle)" for f in ("sin", "cos")} <= set(place)
    assert {"v r", "u r", "u", "v", "r", "u |u|", "v |v|", "r |r|"} <= set(place)
    assert not {"v rpm", "nozzle"} & set(place)
    degree = {c.term: c.degree for c in found}
    assert [*degree.values()] == sorted(degree.values())
    assert (degree["1"], degree["u |u|"], degree["u^2 rpm^2 cos(nozzle)"]) == (0, 2, 5)
    assert place["1"] == 0
    assert place["u"] < place["|u|"] < place["u^2"] < place["u |u|"]
    assert place["u"] < place["sin(nozzle)"]


def test_generate_candidates_of_propellers_and_rudders() -> None:
    """Thrust of both directions, lift in the flow past the hull and in the propeller's."""
    assert {"tau_x", "tau_n"} <= terms_of(("u", "v", "r", "tau_x", "tau_n"))
    named = terms_of(("u", "tau_x"), inputs=(), extra=("tau_x inv(u)",))
    assert [term for term in named if "tau" in term] == ["tau_x inv(u)"]
    ship = {"n |n|", "u |n|", "u^2 delta", "u |u| delta", "|u| delta", "n |n| delta", "u n delta"}
    assert ship <= terms_of(SHIP)
    cubic = {"u^3", "v^3", "r^3", "v^2 r", "v r^2", "n^2 delta^2", "n |n| delta^2", "delta^3"}
    assert cubic <= terms_of(SHIP)
    assert not cubic & terms_of(SHIP, input_degree=1)
    assert not ship & terms_of(SHIP, input_degree=1)
    plain = terms_of(SHIP, magnitudes=False)
    assert {"u^2 delta", "n^2 delta"} <= plain
    assert not any("|" in term for term in plain)
    assert {"|r|", "r |r|", "delta |delta|"} <= terms_of(("r", "delta"))


def test_find_nonsingular_terms_excludes_divisors_near_zero() -> None:
    names = ("u", "n", "delta")
    config = CandidatesConfig(extra=("u inv(delta)",))
    terms = [c.term for c in config.generate_candidates(names)]
    z = torch.tensor([[1.0, 4.0, 0.3], [-1.0, 20.0, -0.3], [0.5, 9.0, 0.1]]).double()

    def kept(z: torch.Tensor) -> set[str]:
        clear = config.find_nonsingular_terms(terms, names, z)
        return {t for t, good in zip(terms, clear.tolist(), strict=True) if good and "inv" in t}

    # what is named by hand stays
    over = {"inv(n)", "u inv(n)", "u^2 inv(n)", "delta inv(n)", "u inv(delta)"}
    assert kept(z) == kept(-z) == over
    z[0, 1] = 1.9
    assert kept(z) == {"u inv(delta)"}


def test_generate_candidates_names_unknown_channels() -> None:
    with pytest.raises(ConfigError, match=r"'nozle' is not a channel.*did you mean 'nozzle'"):
        CandidatesConfig(angles=("nozle",)).generate_candidates(JET_NAMES)
    with pytest.raises(ConfigError, match="no channel 'w'"):
        rank_candidates(["u w"], JET_NAMES)
