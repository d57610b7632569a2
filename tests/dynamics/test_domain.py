"""The operating domain: relations, density, and what they flag."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.dynamics.domain import DomainCheck, monomials
from residnet.dynamics.domain_config import (
    InputRelation,
    OperatingDomain,
    count_features,
    describe_domain,
)

STATES = ("x", "y", "psi", "u", "v", "r")


def check(domain: OperatingDomain, x: dict[str, float], **w: float) -> bool:
    decide = DomainCheck(domain, STATES, tuple(w), torch.float64)
    states = torch.tensor([[x.get(name, 0.0) for name in STATES]], dtype=torch.float64)
    return bool(decide(states, torch.tensor([list(w.values())], dtype=torch.float64)))


def relation(**keys: Any) -> OperatingDomain:
    return OperatingDomain(n_logs=1, relations=(InputRelation(**keys),))


def test_a_held_input_has_its_value() -> None:
    domain = relation(input="n", kind="held", offset=12.0, tolerance=0.24)
    assert check(domain, {}, n=12.2)
    assert not check(domain, {}, n=12.3)
    assert not check(domain, {}, n=math.nan)


def test_a_proportional_input_follows_another() -> None:
    domain = relation(
        input="b", kind="proportional", offset=1.0, channels=("a",), gains=(2.0,), tolerance=0.1
    )
    assert check(domain, {}, a=3.0, b=7.05)
    assert not check(domain, {}, a=3.0, b=7.2)


def test_a_controlled_input_follows_the_heading_whatever_the_number_of_turns() -> None:
    domain = relation(
        input="delta",
        kind="feedback",
        offset=0.0,
        channels=("r",),
        gains=(-0.5,),
        heading=1.0,
        heading_gain=-1.5,
        max_heading=0.4,
        tolerance=0.05,
    )
    for turns in (0.0, 2.0 * math.pi, -4.0 * math.pi):
        at = {"psi": 1.2 + turns, "r": 0.1}
        assert check(domain, at, delta=-1.5 * math.sin(0.2) - 0.05)
        assert not check(domain, at, delta=0.0)
    # on the opposite course the sine is small, too
    assert not check(domain, {"psi": 1.0 + math.pi}, delta=0.0)


def test_no_sample_is_inside_where_the_reference_of_a_controller_is_unknown() -> None:
    assert not check(OperatingDomain(n_logs=3, is_closed_loop_only=True), {}, delta=0.0)


def test_a_density_needs_a_matrix_of_its_monomials() -> None:
    z = torch.randn(7, 3, dtype=torch.float64)
    for degree in (1, 2):
        assert monomials(z, degree).shape[-1] == count_features(3, degree)
    good = {"channels": ["u"], "centre": [1.0], "scale": [2.0], "n_logs": 2}
    identity = np.eye(3).reshape(-1).tolist()
    domain = validate_config({**good, "factor": identity, "limit": 4.0}, OperatingDomain, "test")
    # 1 + z^2 + z^4 is at most 4
    assert check(domain, {"u": 1.0 + 2.0 * 1.1})
    assert not check(domain, {"u": 1.0 + 2.0 * 1.2})
    with pytest.raises(ConfigError, match="factor"):
        validate_config({**good, "factor": [1.0, 2.0, 3.0]}, OperatingDomain, "test")


def test_relations_are_described_in_words() -> None:
    domain = relation(input="n", kind="held", offset=12.0, tolerance=0.24)
    assert describe_domain(domain, {"n": "1/s"}) == [
        "n was held at 12.0 1/s (tolerance 0.240 1/s): its effect is unknown."
    ]
