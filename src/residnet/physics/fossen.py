"""The 3-DOF Fossen model M nu_dot + C(nu) nu + D(nu) nu = tau, from a vessel file alone (document 003 eqs. (5)-(9), ERRATA W1, W2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY
from residnet.physics.terms import TermLibrary
from residnet.physics.vessel import VesselConfig


class Fossen3(nn.Module):
    """Acceleration of a vessel in surge, sway and yaw.

    The Coriolis matrix is Fossen's skew form of the whole mass matrix, so inertia does no work. Buffers are float64;
    results take the dtype of the input.
    """

    def __init__(self, vessel: VesselConfig) -> None:
        super().__init__()
        body, added = vessel.rigid_body, vessel.added_mass
        m, arm = body.m.value, body.m.value * body.x_G.value
        mass = torch.tensor(
            [
                [m - added.X_udot.value, 0.0, 0.0],
                [0.0, m - added.Y_vdot.value, arm - added.Y_rdot.value],
                [0.0, arm - added.N_vdot.value, body.I_z.value - added.N_rdot.value],
            ],
            dtype=torch.float64,
        )
        if bool((torch.linalg.eigvals(mass).real <= 0).any()):
            raise ConfigError(
                f"vessel {vessel.name}: the mass matrix is not positive definite; added mass (X_udot, Y_vdot, N_rdot) is negative for a hull"
            )
        self.register_buffer("mass", mass, persistent=False)
        self.register_buffer("inverse", torch.linalg.inv(mass), persistent=False)
        rows = (vessel.damping.X, vessel.damping.Y, vessel.damping.N)
        terms = sorted({term for row in rows for term in row})
        self.terms = TermLibrary(terms, VELOCITY)
        damping = torch.tensor([[row[t].value if t in row else 0.0 for t in terms] for row in rows], dtype=torch.float64)
        self.register_buffer("damping", damping.reshape(3, len(terms)), persistent=False)
        self.mass: Tensor
        self.inverse: Tensor
        self.damping: Tensor

    def coriolis(self, nu: Tensor) -> Tensor:
        """C(nu) nu [..., 3] in N, N, N m for velocities nu [..., 3]."""
        mass = self.mass.to(nu.dtype)
        u, v, r = nu[..., 0], nu[..., 1], nu[..., 2]
        a = mass[1, 1] * v + 0.5 * (mass[1, 2] + mass[2, 1]) * r
        b = mass[0, 0] * u
        return torch.stack((-a * r, b * r, a * u - b * v), dim=-1)

    def drag(self, nu: Tensor) -> Tensor:
        """D(nu) nu [..., 3] in N, N, N m for velocities nu [..., 3] through the water."""
        return self.terms(nu) @ self.damping.to(nu.dtype).T

    def forward(self, nu: Tensor, tau: Tensor) -> Tensor:
        """Acceleration nu_dot [..., 3] from velocities through the water nu [..., 3] and forces tau [..., 3]."""
        force = tau - self.coriolis(nu) - self.drag(nu)
        return force @ self.inverse.to(nu.dtype).T
