"""Terms by name against NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from residnet.core.errors import ConfigError
from residnet.physics.terms import Factor, TermLibrary, parse_term, polynomial_terms

NAMES = ("u", "v", "r", "n_port", "delta2")

READ = {
    "1": (),
    "u": (("u", False, 1),),
    "u|u|": (("u", False, 1), ("u", True, 1)),
    "|u|v": (("u", True, 1), ("v", False, 1)),
    "v |r|": (("v", False, 1), ("r", True, 1)),
    "  v   r ": (("v", False, 1), ("r", False, 1)),
    "v*r": (("v", False, 1), ("r", False, 1)),
    "n_port^2 delta2": (("n_port", False, 2), ("delta2", False, 1)),
    "|v|^3 u^9": (("v", True, 3), ("u", False, 9)),
    "1 u": (("u", False, 1),),
    "|u||v|": (("u", True, 1), ("v", True, 1)),
}


@pytest.mark.parametrize("term", READ)
def test_parse(term: str) -> None:
    assert parse_term(term, NAMES) == tuple(Factor(*factor) for factor in READ[term])


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("", "empty"),
        ("   ", "empty"),
        ("n_prt u", "did you mean 'n_port'"),
        ("w", "no channel 'w'"),
        ("|w|", "no channel 'w'"),
        ("uv", "no channel 'uv'"),
        ("u|v", "cannot read it from '|v'"),
        ("u+v", r"cannot read it from '\+v'"),
        ("2 u", "cannot read it from '2 u'"),
        ("u^1.5", r"cannot read it"),
        ("u^0", r"cannot read it from '\^0'"),
        ("u^10", r"cannot read it from '0'"),
        ("u**2", r"cannot read it"),
        ("sin u", "no channel 'sin'"),
        ("sin(w)", "no channel 'w'"),
        ("tan(u)", "no function 'tan'"),
        ("sin(u v)", r"cannot read it from '\(u v\)'|no channel 'sin'"),
        ("|sin(u)|", "cannot read it"),
        ("cos(u)^-1 v", r"cannot divide by cos\(u\)"),
    ],
)
def test_what_cannot_be_read_is_one_line(term: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_term(term, NAMES)
    assert "\n" not in str(caught.value)


def test_library_equals_numpy() -> None:
    terms = ["1", "u", "u|u|", "|u|v", "v |r|", "n_port^2 delta2", "|v|^3 u^2", "1"]
    z = np.random.default_rng(0).normal(size=(7, 11, len(NAMES)))
    u, v, r, n, d = (z[..., i] for i in range(5))
    truth = [
        np.ones_like(u),
        u,
        u * abs(u),
        abs(u) * v,
        v * abs(r),
        n**2 * d,
        abs(v) ** 3 * u**2,
        np.ones_like(u),
    ]
    library = TermLibrary(terms, NAMES)
    assert library.count == len(terms)
    np.testing.assert_allclose(library(torch.from_numpy(z)), np.stack(truth, axis=-1), rtol=1e-14)
    single = library(torch.from_numpy(z).float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, np.stack(truth, axis=-1), rtol=3e-5, atol=1e-6)


@pytest.mark.parametrize("terms", [NAMES, NAMES[::-1], ["r", "u"], ["u", "u"]])
def test_library_of_channels_alone(terms: Sequence[str]) -> None:
    z = torch.randn(3, 4, len(NAMES), dtype=torch.float64)
    columns = [list(NAMES).index(term) for term in terms]
    assert torch.equal(TermLibrary(terms, NAMES)(z), z[..., columns])


def test_division_keeps_signs_and_leaves_other_gradients_finite() -> None:
    z = torch.tensor([[-2.0, 0.0, 0.5, -4.0, 0.0]], dtype=torch.float64, requires_grad=True)
    out = TermLibrary(["n_port^-1", "u |n_port|^-2", "|u|^-1 r", "v"], NAMES)(z)
    np.testing.assert_allclose(out.detach(), [[-0.25, -0.125, 0.25, 0.0]], rtol=1e-14)
    out.sum().backward()
    assert z.grad is not None
    assert bool(torch.isfinite(z.grad).all())


def test_library_of_constants_and_of_nothing() -> None:
    z = torch.randn(4, 2, len(NAMES))
    assert torch.equal(TermLibrary(["1", "1"], NAMES)(z), torch.ones(4, 2, 2))
    assert TermLibrary([], NAMES)(z).shape == (4, 2, 0)
    beside = TermLibrary(["r", "1"], NAMES)(z)
    assert torch.equal(beside, torch.stack((z[..., 2], torch.ones(4, 2)), dim=-1))


def test_functions_equal_numpy() -> None:
    terms = [
        "sin(u)",
        "cos(v)^2 n_port",
        "u^2 n_port^2 cos(delta2)",
        "sqrt(r)",
        "ssqrt(r) |v|",
        "inv(n_port) u",
        "inv(r)^2",
        "u^-1 sin(v)",
    ]
    z = np.random.default_rng(1).normal(size=(9, len(NAMES)))
    u, v, r, n, d = z.T
    truth = [
        np.sin(u),
        np.cos(v) ** 2 * n,
        u**2 * n**2 * np.cos(d),
        np.sqrt(abs(r)),
        np.sign(r) * np.sqrt(abs(r)) * abs(v),
        u / n,
        1 / r**2,
        np.sin(v) / u,
    ]
    library = TermLibrary(terms, NAMES)
    np.testing.assert_allclose(library(torch.from_numpy(z)), np.stack(truth, axis=-1), rtol=1e-13)
    np.testing.assert_allclose(
        torch.jit.script(library)(torch.from_numpy(z)), np.stack(truth, axis=-1), rtol=1e-13
    )


def test_protected_functions_are_finite_at_zero_with_their_gradients() -> None:
    z = torch.zeros(1, len(NAMES), dtype=torch.float64, requires_grad=True)
    out = TermLibrary(["sqrt(u)", "ssqrt(v)", "inv(r)"], NAMES)(z)
    np.testing.assert_allclose(out.detach(), np.zeros((1, 3)), atol=1e-11)
    out.sum().backward()
    assert z.grad is not None
    assert bool(torch.isfinite(z.grad).all())


def test_functions_can_be_forbidden() -> None:
    assert parse_term("u sin(v)", NAMES)[1] == Factor("v", False, 1, "sin")
    with pytest.raises(ConfigError, match="only products of channels"):
        parse_term("u sin(v)", NAMES, functions=False)


def test_polynomials_are_all_products_once() -> None:
    names = ("u", "v", "r")
    terms = polynomial_terms(names, 3, magnitudes=("u", "r"))
    # binomial(3 + 3, 3) - 1 products, then the magnitudes
    assert len(terms) == len(set(terms)) == 19 + 2
    assert terms[-2:] == ("u|u|", "r|r|")
    z = torch.rand(1, 3, dtype=torch.float64) + 0.5
    values = TermLibrary(terms[:19], names)(z)[0]
    assert len({round(float(value), 12) for value in values}) == 19


@pytest.mark.parametrize(
    "terms",
    [
        ["1", "u", "u|u|", "|u|v", "v |r|", "n_port^2 delta2", "|v|^3 u^2"],
        ["r", "v"],
        ["1"],
        ["u sin(v)", "n_port^-1 r", "sqrt(r) u"],
    ],
)
def test_derivatives_along_directions(terms: Sequence[str]) -> None:
    torch.manual_seed(2)
    library = TermLibrary(terms, NAMES)
    z = torch.randn(6, len(NAMES), dtype=torch.float64)
    ahead = torch.randn(3, 6, len(NAMES), dtype=torch.float64)
    step = 1e-6
    about = (library(z + step * ahead) - library(z - step * ahead)) / (2.0 * step)
    torch.testing.assert_close(library.along(z, ahead), about, rtol=1e-6, atol=1e-6)
