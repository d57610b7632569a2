"""Mass matrices: they must be invertible, and positive as that of a body in water is."""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.core.errors import ConfigError


def inverse_mass(mass: Tensor, vessel: str) -> Tensor:
    """Return the inverse [n, n] of a mass matrix [n, n] in float64.

    Raises:
        ConfigError: where an eigenvalue is zero or has no positive real part, or the matrix is as
            good as singular.
    """
    if bool((torch.linalg.eigvals(mass).real <= 0).any()):
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is not positive definite; added mass (X_udot,"
            " Y_vdot, N_rdot) is negative for a hull"
        )
    scale = mass.diagonal().sqrt()
    condition = float(torch.linalg.cond(mass / torch.outer(scale, scale)))
    if condition > 1e8:
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is singular (condition {condition:.1e} after"
            " scaling); check the coupling terms x_G, Y_rdot, N_vdot"
        )
    inverse: Tensor = torch.linalg.inv(mass)
    return inverse
