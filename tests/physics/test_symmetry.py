"""Port/starboard symmetry against what a mirror does: scenes turned over, and terms evaluated on
both sides of it.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.physics.signals_config import SignalsConfig
from residnet.physics.symmetry import (
    compute_term_parity,
    get_channel_parity,
    mirror_channels,
    violates_symmetry,
)
from residnet.physics.term_library import TermLibrary

NAMES = ("u", "v", "r", "delta", "n", "tau_x", "tau_y", "tau_n", "wind_u", "wind_v", "wind_mag")
# what a mirror at the vessel's centre plane does to each, from the definition of the channels
SIGNS = torch.tensor([1, -1, -1, -1, 1, 1, -1, -1, 1, -1, 1], dtype=torch.float64)


def values(terms: list[str]) -> tuple[Tensor, Tensor]:
    """The terms [50, J] of random channels, and of those in the mirror."""
    z = torch.from_numpy(np.random.default_rng(0).normal(size=(50, len(NAMES))))
    library = TermLibrary(terms, NAMES)
    return library(z), library(z * SIGNS)


def test_parity_of_channels_and_terms_is_the_sign_that_the_mirror_gives_their_values() -> None:
    assert [get_channel_parity(name) for name in NAMES] == SIGNS.tolist()
    unknown = ("n_port", "cmd_stbd", "psi", "anything")
    assert [get_channel_parity(name) for name in unknown] == [None] * 4
    powers = ("{}", "|{}|", "{}^2", "|{}|^3", "{}^-1", "|{}|^-1", "{}^-2")
    functions = ("sin({})", "cos({})", "sqrt({})", "ssqrt({})", "inv({})", "sin({})^2")
    factors = [form.format(name) for name in NAMES for form in powers]
    factors += [form.format(name) for name in ("v", "u") for form in functions]
    pairs = [f"{a} {b}" for a, b in combinations_with_replacement(factors, 2)]
    terms = ["1", *factors, *pairs, "v |v| r", "|u| v |v|", "n^2 delta", "v r delta^3 u"]
    here, there = values(terms)
    parity = torch.tensor(
        [compute_term_parity(term, NAMES) or 0 for term in terms], dtype=here.dtype
    )
    torch.testing.assert_close(there, here * parity, rtol=1e-12, atol=0)
    assert set(parity.tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(("axis", "turned"), [(0, 1.0), (1, -1.0), (2, -1.0)])
def test_a_term_is_wrong_where_it_breaks_the_symmetry_of_its_axis(axis: int, turned: float) -> None:
    """A symmetric vessel's acceleration f has f(M z) = M f(z)."""
    terms = ["1", *NAMES, *(f"|{a}|" for a in NAMES)]
    terms += [f"{a} {b}" for a, b in combinations_with_replacement(NAMES, 2)]
    here, there = values(terms)
    broken = (there - turned * here).abs().amax(0) > 1e-9
    assert [violates_symmetry(term, axis, NAMES) for term in terms] == broken.tolist()


def test_a_lone_propeller_heels_and_what_nobody_said_is_not_called_wrong() -> None:
    def names(*inputs: str) -> tuple[str, ...]:
        return SignalsConfig(inputs=inputs, velocities=("u", "v", "r", "p")).build().names

    lone = names("delta", "n")
    assert mirror_channels(lone) is None
    assert mirror_channels(names("delta", "n_port", "n_stbd")) is not None
    # its torque acts about the roll, and no thrust to a side
    assert [violates_symmetry("|n| u", axis, lone) for axis in range(4)] == [
        False,
        True,
        True,
        False,
    ]
    assert violates_symmetry("u|u|", 3, lone)
    unsaid = ("u", "v", "trim")
    parities = [compute_term_parity(term, unsaid) for term in ("u trim", "|trim|", "u |v|")]
    assert parities == [None, None, 1]
    assert not any(violates_symmetry("trim", axis, unsaid) for axis in range(3))


def test_channels_are_those_of_the_scene_in_the_mirror() -> None:
    """The same vessel, thrusters and wind, turned over: y, psi, v, r and the wind's direction
    change sign, port and starboard change places.
    """
    signals = SignalsConfig(
        inputs=("n_port", "n_stbd"), exogenous=("wind_speed", "wind_dir"), forces="wam_v_cal"
    ).build()
    random = np.random.default_rng(1)
    x = torch.from_numpy(random.normal(size=(40, 6)) * [20, 20, 2, 1, 0.3, 0.2])
    w = torch.from_numpy(random.uniform([-20, -20, 0, -4], [30, 30, 12, 4], size=(40, 4)))
    x_there = x * torch.tensor([1, -1, -1, 1, -1, -1.0], dtype=x.dtype)
    w_there = w[:, [1, 0, 2, 3]] * torch.tensor([1, 1, 1, -1.0], dtype=x.dtype)
    z = signals(x, signals.prepare(w))
    z_there = signals(x_there, signals.prepare(w_there))
    found = mirror_channels(signals.names)
    assert found is not None
    mirrored = z[:, found[0]] * torch.tensor(found[1], dtype=z.dtype)
    torch.testing.assert_close(mirrored, z_there, rtol=1e-12, atol=1e-9)
    assert float((z - z_there).abs().max()) > 1


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("u v r n delta", ([0, 1, 2, 3, 4], [1.0, -1.0, -1.0, 1.0, -1.0])),
        ("cmd_stbd n_port v n_stbd cmd_port", ([4, 3, 2, 1, 0], [1.0, 1.0, -1.0, 1.0, 1.0])),
        ("u n_port", None),
        ("u trim", None),
        ("u n_port m_stbd", None),
    ],
)
def test_pairs_change_places_and_no_mirror_is_without_a_partner(
    names: str, expected: tuple[list[int], list[float]] | None
) -> None:
    assert mirror_channels(tuple(names.split())) == expected
