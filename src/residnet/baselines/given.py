"""Baselines with fixed coefficients: the hull of a vessel file, published equations, or none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.columns import zero_acceleration
from residnet.core.names import FORCE_CHANNELS
from residnet.physics.symmetry import get_dof
from residnet.physics.term_library import TermLibrary

if TYPE_CHECKING:
    from residnet.baselines.given_config import TermCoefficients


@final
class FixedBaseline(Baseline):
    """Baseline nu_dot = theta [n, J] phi(z) [..., J] with fixed coefficients.

    Args:
        coefficients_by_axis: coefficients of u_dot, v_dot and r_dot by term; other states have no
            terms.
        names: channels of the model.
        is_fitted: whether the coefficients were fitted to other data. If so, their number counts in
            criteria such as BIC (see E9 in docs/documents/corrections.md).
    """

    def __init__(
        self,
        coefficients_by_axis: Sequence[TermCoefficients],
        names: Sequence[str],
        *,
        is_fitted: bool = False,
    ) -> None:
        super().__init__()
        terms = list(
            dict.fromkeys(
                term for axis_coefficients in coefficients_by_axis for term in axis_coefficients
            )
        )
        self.library = TermLibrary(terms, names)
        self.n_dof = get_dof(names).n_dynamic
        self.is_fitted = is_fitted
        # roll has no published equation: its acceleration is zero
        empty_axes = [dict[str, float]()] * (self.n_dof - len(coefficients_by_axis))
        theta = [
            [axis_coefficients.get(term, 0.0) for term in terms]
            for axis_coefficients in (*coefficients_by_axis, *empty_axes)
        ]
        # a baseline without terms has nothing to store
        self.theta = nn.Buffer(
            torch.tensor(theta, dtype=torch.float64).reshape(self.n_dof, len(terms)),
            persistent=len(terms) > 0,
        )

    def forward(self, z: Tensor) -> Tensor:
        if self.library.n_terms == 0:
            return zero_acceleration(z, self.n_dof)
        phi: Tensor = self.library(z)
        return phi @ self.theta.to(z.dtype).T

    def parameter_counts(self) -> list[float]:
        """Return the number of terms per axis if they were fitted to data, otherwise zeros."""
        return [float(n_terms) * self.is_fitted for n_terms in (self.theta != 0).sum(1)]

    def inertia_matrix(self) -> Tensor | None:
        """Return the inertia matrix [3, 3], the inverse of the coefficients of the forces.

        None if they have no inverse, or the model includes roll.
        """
        terms = self.library.terms
        columns = [terms.index(name) for name in FORCE_CHANNELS if name in terms]
        if len(columns) < len(FORCE_CHANNELS) or self.n_dof > len(FORCE_CHANNELS):
            return None
        # nu_dot = M^-1 tau + ...: the coefficients of the forces are the inverse of M
        force_columns = self.theta[:, columns].to(torch.float64)
        # columns are scaled, because kg and kg m^2 cannot be compared
        is_invertible = float(torch.linalg.cond(force_columns / force_columns.abs().amax(0))) < 1e6
        return torch.linalg.inv(force_columns) if is_invertible else None
