"""Symmetry of port/starboard pairs of inputs, verified on training samples."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.names import get_pair_parity
from residnet.core.samples import Samples
from residnet.physics.symmetry import get_axis_parities, get_dof, get_partners
from residnet.regression.pair_symmetry import PairSymmetry, assess_pair_symmetry


def find_asymmetric_pairs(samples: Samples) -> list[PairSymmetry]:
    """Return the port/starboard pairs of inputs whose effects are not mirror images of each other.

    Args:
        samples: accelerations and channels of the training logs.
    """
    assessments = [
        assess_pair_symmetry(
            pair,
            samples.names,
            samples.z.numpy(),
            samples.target.numpy(),
            samples.group.numpy(),
            get_dof(samples.names).dynamic_states,
            get_axis_parities(samples.names),
            get_pair_parity(pair[0]),
        )
        for pair in _list_pairs(samples.names)
    ]
    return [assessment for assessment in assessments if not assessment.is_symmetric]


def _list_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return each pair of channels once, port first."""
    partners = get_partners(names)
    pairs: list[tuple[str, str]] = []
    for name in names:
        if name in partners and not any(name in pair for pair in pairs):
            pairs.append((name, partners[name]))
    return pairs
