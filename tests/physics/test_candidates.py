"""Candidate terms against their definition."""

from __future__ import annotations

import pytest
import torch

from residnet.core.errors import ConfigError
from residnet.physics.terms import CandidatesConfig, rated

JETS = CandidatesConfig(
    inputs=("rpm",), input_degree=2, coupling=("u",), coupling_degree=2, angles=("nozzle",)
)
NAMES = ("u", "v", "r", "rpm", "nozzle")


def test_motions_with_magnitudes() -> None:
    terms = {c.term for c in CandidatesConfig(inputs=()).candidates(("u", "v"))}
    assert terms == {
        "1",
        "u",
        "v",
        "|u|",
        "|v|",
        "u^2",
        "u v",
        "u |u|",
        "u |v|",
        "v^2",
        "v |u|",
        "v |v|",
        "|u| |v|",
    }
    assert {
        c.term for c in CandidatesConfig(inputs=(), magnitudes=False).candidates(("u", "v"))
    } == {"1", "u", "v", "u^2", "u v", "v^2"}


def test_jets_have_every_term_of_the_document() -> None:
    found = JETS.candidates(NAMES)
    terms = [c.term for c in found]
    assert len(terms) == len(set(terms)) == 49
    # (6.21)-(6.23): nine products with the cosine, nine with the sine, and the hull
    products = [
        " ".join(p for p in (a, b) if p) for a in ("", "u", "u^2") for b in ("", "rpm", "rpm^2")
    ]
    assert {f"{p} {f}(nozzle)".strip() for p in products for f in ("sin", "cos")} <= set(terms)
    assert {"v r", "u r", "u", "v", "r", "u |u|", "v |v|", "r |r|"} <= set(terms)
    assert "v rpm" not in terms
    assert "nozzle" not in terms


def test_order_is_by_degree_then_by_effort() -> None:
    found = JETS.candidates(NAMES)
    assert [c.degree for c in found] == sorted(c.degree for c in found)
    place = {c.term: i for i, c in enumerate(found)}
    assert place["1"] == 0
    assert place["u"] < place["|u|"] < place["u^2"] < place["u |u|"]
    assert place["u"] < place["sin(nozzle)"]
    degree = {c.term: c.degree for c in found}
    assert (degree["1"], degree["u |u|"], degree["u^2 rpm^2 cos(nozzle)"]) == (0, 2, 5)


def test_all_other_channels_are_inputs_unless_named() -> None:
    assert {"tau_x", "tau_n"} <= {
        c.term for c in CandidatesConfig().candidates(("u", "v", "r", "tau_x", "tau_n"))
    }
    extra = CandidatesConfig(inputs=(), extra=("tau_x inv(u)",)).candidates(("u", "tau_x"))
    assert [c.term for c in extra if "tau" in c.term] == ["tau_x inv(u)"]


def test_candidates_know_propellers_and_rudders_unless_told_otherwise() -> None:
    """Thrust of both directions, lift in the flow past the hull and in the propeller's."""
    ship = {"n |n|", "u |n|", "u^2 delta", "u |u| delta", "|u| delta", "n |n| delta", "u n delta"}
    found = {c.term for c in CandidatesConfig().candidates(("u", "v", "r", "n", "delta"))}
    assert ship <= found
    assert not ship & {
        c.term for c in CandidatesConfig(input_degree=1).candidates(("u", "v", "r", "n", "delta"))
    }
    plain = CandidatesConfig(magnitudes=False).candidates(("u", "v", "r", "n", "delta"))
    assert {"u^2 delta", "n^2 delta"} <= {c.term for c in plain}
    assert not any("|" in c.term for c in plain)
    assert {"|r|", "r |r|", "delta |delta|"} <= {
        c.term for c in CandidatesConfig().candidates(("r", "delta"))
    }


def test_nothing_divides_by_what_comes_near_zero() -> None:
    names = ("u", "n", "delta")
    config = CandidatesConfig(extra=("u inv(delta)",))
    terms = [c.term for c in config.candidates(names)]
    z = torch.tensor([[1.0, 4.0, 0.3], [-1.0, 20.0, -0.3], [0.5, 9.0, 0.1]]).double()

    def kept(z: torch.Tensor) -> set[str]:
        clear = config.clear(terms, names, z)
        return {t for t, good in zip(terms, clear.tolist(), strict=True) if good and "inv" in t}

    # what is named by hand stays
    over = {"inv(n)", "u inv(n)", "u^2 inv(n)", "delta inv(n)", "u inv(delta)"}
    assert kept(z) == over
    assert kept(-z) == over
    z[0, 1] = 1.9
    assert kept(z) == {"u inv(delta)"}


def test_unknown_channels_are_named() -> None:
    with pytest.raises(
        ConfigError, match="'nozle' is not a channel of the model; did you mean 'nozzle'"
    ):
        CandidatesConfig(angles=("nozle",)).candidates(NAMES)
    with pytest.raises(ConfigError, match="no channel 'w'"):
        rated(["u w"], NAMES)
