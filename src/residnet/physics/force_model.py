"""Force models tau = F(nu_dot, nu): a prior hull model and corrections to it.

Source: Jervan 2020, eqs. (3.19)-(3.27).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.frames import to_body
from residnet.physics.force_terms import MOTION_CHANNELS, find_acceleration_terms, term_order
from residnet.physics.plant import Hull
from residnet.physics.term_library import TermLibrary

_MAX_CONDITION = 100.0
"""Maximum condition number of a mass matrix relative to that of the prior model.

Above this value one axis has less than a hundredth of the mass of another, which is not physical.
"""


def weighted_column_std(terms: Sequence[str], x: Tensor) -> Tensor:
    """Return the scales beta std(x) [J] of the columns x [N, J] of basis functions.

    beta is the order of a basis function, so that regularisation penalises high orders more (Jervan
    2020, eqs. (4.8), (4.9)). Eq. (3.12) there prints the divisor for beta = 2 only (J15 in
    docs/documents/corrections.md).

    Raises:
        FitError: if a column is constant.
    """
    std = x.std(0)
    # a constant column is collinear with the intercept
    is_constant = std <= 1e-9 * x.abs().amax(0).clamp(min=1e-300)
    if bool(is_constant.any()):
        raise FitError(
            f"basis function '{terms[int(is_constant.nonzero()[0, 0])]}' is constant over the"
            " samples; remove it or give data that excite it"
        )
    return std * torch.tensor([term_order(term) for term in terms], dtype=x.dtype)


class ForceCorrection(nn.Module):
    """Force that is linear in basis functions phi of the motion, theta_0 + Theta' phi(nu_dot, nu).

    Args:
        terms: names of the J basis functions.
        coefficients: Theta [J, 3].
        intercept: theta_0 [3].
    """

    def __init__(self, terms: Sequence[str], coefficients: Tensor, intercept: Tensor) -> None:
        super().__init__()
        self.library = TermLibrary(terms, MOTION_CHANNELS)
        self.coefficients = nn.Buffer(coefficients.to(torch.float64))
        self.intercept = nn.Buffer(intercept.to(torch.float64))

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [..., 3] in N, N, N m at nu_dot [..., 3] and nu [..., 3] in SI units."""
        basis = self.library(torch.cat((nu_dot, nu), dim=-1))
        force: Tensor = basis @ self.coefficients.to(nu.dtype) + self.intercept.to(nu.dtype)
        return force


@final
class ForceCorrectionSum(nn.Module):
    """Sum of the forces of several corrections of a hull model."""

    def __init__(self, corrections: Sequence[nn.Module] | nn.ModuleList) -> None:
        super().__init__()
        self.corrections = nn.ModuleList(corrections)

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force [..., 3] in N, N, N m at nu_dot [..., 3] and nu [..., 3] in SI units."""
        force = torch.zeros_like(nu)
        for correction in self.corrections:
            force = force + correction(nu_dot, nu)
        return force


@final
class ForceModel(nn.Module):
    """Prior hull model with a list of corrections, F_k = F_(k-1) + Theta phi.

    Source: Jervan 2020, eq. (3.26).

    Attributes:
        earth_force: constant external force in earth axes [2] (north, east) in N.
    """

    def __init__(
        self,
        hull: Hull,
        corrections: Sequence[ForceCorrection] = (),
        earth_force: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.hull = hull
        self.corrections = nn.ModuleList(corrections)
        self.earth_force = nn.Buffer(
            torch.zeros(2, dtype=torch.float64) if earth_force is None else earth_force
        )

    def with_correction(
        self, correction: ForceCorrection, earth_force: Tensor | None = None
    ) -> ForceModel:
        """Return a copy of the model to whose force a learned correction is added."""
        total_earth_force = (
            self.earth_force if earth_force is None else self.earth_force + earth_force
        )
        return ForceModel(self.hull, [*self.corrections, correction], total_earth_force)

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the force tau [..., 3] in N, N, N m of a motion in calm water."""
        tau: Tensor = self.hull.required_force(nu_dot, nu)
        for correction in self.corrections:
            tau = tau + correction(nu_dot, nu)
        return tau

    def split_corrections(self) -> tuple[ForceModel, ForceCorrectionSum]:
        """Return the prior hull model and the sum of its corrections as two modules."""
        return ForceModel(self.hull), ForceCorrectionSum(self.corrections)

    def thruster_force(self, nu_dot: Tensor, nu: Tensor, psi: Tensor) -> Tensor:
        """Return the thruster force tau [..., 3] at heading psi [...] rad.

        It is the force of the motion minus the constant external force.
        """
        earth_force = self.earth_force.to(nu.dtype)
        # mean wind and current forces are constant in earth axes and turn with the heading in body
        # axes
        body_x, body_y = to_body(earth_force[0], earth_force[1], psi)
        required_force: Tensor = self(nu_dot, nu) - torch.stack(
            (body_x, body_y, torch.zeros_like(body_x)), dim=-1
        )
        return required_force

    def force_residual(self, tau: Tensor, nu_dot: Tensor, nu: Tensor, psi: Tensor) -> Tensor:
        """Return the force residual eps = tau - F(nu_dot, nu) [..., 3].

        Source: Jervan 2020, eqs. (3.20), (3.25).
        """
        return tau - self.thruster_force(nu_dot, nu, psi)


def augment_mass(
    mass: Tensor,
    terms: Sequence[str],
    coefficients: Tensor,
    subject: str,
    names: Sequence[str] = MOTION_CHANNELS,
) -> tuple[Tensor, list[int]]:
    """Return M + A [3, 3] of a residual eps = A nu_dot + b(nu), and the indices of the terms of b.

    Args:
        mass: mass matrix M of the prior model [3, 3].
        terms: names of the basis functions of eps.
        coefficients: coefficients of the basis functions [J, 3].
        subject: name of the model in error messages.
        names: channels of the basis functions.

    Raises:
        ConfigError: if a term is not affine in nu_dot with a constant factor.
        FitError: if M + A has an eigenvalue without positive real part, or is ill-conditioned, so
            that the model cannot be solved for nu_dot.
    """
    axis_of_term = find_acceleration_terms(terms, names)
    augmented_mass = mass.clone()
    other_terms = [j for j in range(len(terms)) if j not in axis_of_term]
    for j, axis in axis_of_term.items():
        # the coefficient of u_dot in eps is an added mass: it moves to the left-hand side
        augmented_mass[:, axis] += coefficients[j]
    # divided by the prior masses, so that the condition number does not depend on the units kg and
    # kg m^2, and shows an axis whose fitted added mass cancels its mass
    scale = mass.diagonal().abs().sqrt()
    eigenvalues = torch.linalg.eigvals(augmented_mass).real
    condition = float(torch.linalg.cond(augmented_mass / torch.outer(scale, scale)))
    if bool((eigenvalues <= 0).any()) or not condition < _MAX_CONDITION:
        raise FitError(
            f"{subject}: its mass matrix with the fitted accelerations has eigenvalues"
            f" {[round(float(v), 1) for v in eigenvalues]} and condition"
            f" number {condition:.1e}, so that it cannot be solved for the acceleration; give data"
            " with more acceleration, fewer terms, a higher penalty or a lower order"
        )
    return augmented_mass, other_terms
