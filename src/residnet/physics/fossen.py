"""The 3-DOF Fossen model M nu_dot + C(nu) nu + D(nu) nu = tau, from a vessel file alone.

Source: document 003 eqs. (5)-(9), corrections W1, W2.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, Self, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY
from residnet.physics.actuators import ActuatorsConfig
from residnet.physics.environment.wind import WindLoadsConfig
from residnet.physics.kinematics import Planar
from residnet.physics.mass import AddedMass, MassEntries, RigidBody, inverse_mass
from residnet.physics.parameters import (
    Parameter,
    dimension,
    unit_text,
)
from residnet.physics.plant import HullPlant
from residnet.physics.terms import TermLibrary, parse_term
from residnet.physics.vessel_file import VesselFile


class Damping(Config):
    """The damping force of each axis as terms of (u, v, r), for example `X: {u: ..., "u|u|": ...}`.

    Positive coefficients brake.

    Attributes:
        X: coefficients of the surge force, each in the SI unit that its term asks for.
        Y: coefficients of the sway force.
        N: coefficients of the yaw moment.
    """

    X: dict[str, Parameter] = Field(default_factory=dict)
    Y: dict[str, Parameter] = Field(default_factory=dict)
    N: dict[str, Parameter] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _units(self) -> Damping:
        for axis, row, force in (
            ("X", self.X, (1, -2)),
            ("Y", self.Y, (1, -2)),
            ("N", self.N, (2, -2)),
        ):
            for term, parameter in row.items():
                try:
                    metres, seconds = force
                    for factor in parse_term(term, VELOCITY, functions=False):
                        if factor.power < 0:
                            raise ConfigError(f"term '{term}' is infinite at rest")
                        metres -= factor.power * (factor.name != "r")
                        seconds += factor.power
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if dimension(parameter.unit) != (metres, seconds):
                    raise ValueError(
                        f"{axis}.{term}: its unit must be {unit_text(metres, seconds)}, given"
                        f" '{parameter.unit}'"
                    )
        return self


class HullConfig(VesselFile, ABC):
    """A 3-DOF vessel M nu_dot + C(nu) nu + D(nu) nu = tau.

    A file may name another one as `base` and give only what differs.

    Attributes:
        scale: what M, C and D are all multiplied by: a true vessel beside the believed one of its
            `base` (document 002 eq. (4.2)).
        wind: coefficients of the hull above water; without them the vessel feels no wind.
        damping: terms of D(nu) nu.
        actuators: what the vessel is driven and steered by.
    """

    scale: float = Field(default=1.0, gt=0)
    damping: Damping
    actuators: ActuatorsConfig
    wind: WindLoadsConfig | None = None

    @abstractmethod
    def mass_matrix(self) -> list[list[float]]:
        """Return M [3, 3], without the scale."""

    @abstractmethod
    def coupling(self) -> float:
        """Return the factor of r in the sway momentum of C(nu), in kg m, without the scale."""

    def equations(self) -> tuple[tuple[str, ...], list[list[float]]]:
        """Return nu_dot as terms of (u, v, r), and the coefficients on each axis.

        The coefficients of the terms come first, then those of tau_x, tau_y, tau_n.
        """
        terms, response = Fossen3(self).products()
        return terms, response.tolist()

    @final
    def build(self) -> FossenVessel:
        """Build the plant of this vessel.

        Raises:
            ConfigError: where the mass matrix is not positive definite or is singular.
        """
        return FossenVessel(self)


class FossenConfig(HullConfig):
    """A 3-DOF vessel given by rigid body, added mass, damping terms and actuators.

    Attributes:
        rigid_body: mass, inertia and centre of gravity.
        added_mass: hydrodynamic derivatives of the accelerations.
    """

    kind: Literal["fossen"] = "fossen"
    rigid_body: RigidBody
    added_mass: AddedMass

    def mass_matrix(self) -> list[list[float]]:
        """Return the sum of rigid body and added mass, [3, 3]."""
        body, added = self.rigid_body, self.added_mass
        m, arm = body.m.value, body.m.value * body.x_G.value
        return [
            [m - added.X_udot.value, 0.0, 0.0],
            [0.0, m - added.Y_vdot.value, arm - added.Y_rdot.value],
            [0.0, arm - added.N_vdot.value, body.I_z.value - added.N_rdot.value],
        ]

    def coupling(self) -> float:
        """Return the mean of m23 and m32, which makes C that of the symmetric part of M.

        Source: Fossen 2011, section 6.3.
        """
        mass = self.mass_matrix()
        return 0.5 * (mass[1][2] + mass[2][1])


class MassMatrixConfig(HullConfig):
    """A 3-DOF vessel whose mass matrix was identified as a whole, as that of milliAmpere.

    Attributes:
        mass: entries of the mass matrix.

    Source: document 002 eqs. (2.3)-(2.6), appendix A.
    """

    kind: Literal["mass_matrix"]
    mass: MassEntries

    def mass_matrix(self) -> list[list[float]]:
        """Return the mass matrix [3, 3] of the file; it need not be symmetric."""
        m = self.mass
        return [
            [m.m11.value, 0.0, 0.0],
            [0.0, m.m22.value, m.m23.value],
            [0.0, m.m32.value, m.m33.value],
        ]

    def coupling(self) -> float:
        """Return m23 alone, as (2.5) has it (correction J4)."""
        return self.mass.m23.value


class Fossen3(nn.Module):
    """The acceleration of a vessel in surge, sway and yaw.

    The Coriolis matrix is Fossen's skew form of the whole mass matrix, so inertia does no work
    where that is symmetric. Buffers are float64; results take the dtype of the input.
    """

    def __init__(self, vessel: HullConfig) -> None:
        super().__init__()
        mass = vessel.scale * torch.tensor(vessel.mass_matrix(), dtype=torch.float64)
        self.coupling: float = vessel.scale * vessel.coupling()
        self.register_buffer("mass", mass, persistent=False)
        self.register_buffer("inverse", inverse_mass(mass, vessel.name), persistent=False)
        rows = (vessel.damping.X, vessel.damping.Y, vessel.damping.N)
        terms = sorted({term for row in rows for term in row})
        self.terms = TermLibrary(terms, VELOCITY)
        damping = torch.tensor(
            [[row[t].value if t in row else 0.0 for t in terms] for row in rows],
            dtype=torch.float64,
        )
        self.register_buffer(
            "damping", vessel.scale * damping.reshape(3, len(terms)), persistent=False
        )
        self.register_buffer("response", torch.zeros(3, 0, dtype=torch.float64), persistent=False)
        self.compacted = False
        # not empty, so that TorchScript knows the type
        self.gather = [torch.zeros(0, dtype=torch.long)]
        self.response: Tensor
        self.mass: Tensor
        self.inverse: Tensor
        self.damping: Tensor

    def coriolis(self, nu: Tensor) -> Tensor:
        """Return C(nu) nu [..., 3] in N, N, N m for velocities nu [..., 3]."""
        mass = self.mass.to(nu.dtype)
        u, v, r = nu[..., 0], nu[..., 1], nu[..., 2]
        a = mass[1, 1] * v + self.coupling * r
        b = mass[0, 0] * u
        return torch.stack((-a * r, b * r, a * u - b * v), dim=-1)

    def drag(self, nu: Tensor) -> Tensor:
        """Return D(nu) nu [..., 3] in N, N, N m for velocities nu [..., 3] through the water."""
        damping: Tensor = self.terms(nu) @ self.damping.to(nu.dtype).T
        return damping

    def required(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """Return the forces [..., 3] that accelerate the vessel by nu_dot [..., 3].

        Source: document 002 eq. (2.10).
        """
        return nu_dot @ self.mass.to(nu.dtype).T + self.coriolis(nu) + self.drag(nu)

    def products(self) -> tuple[tuple[str, ...], Tensor]:
        """Return nu_dot as products: J terms of (u, v, r) and coefficients [3, J + 3].

        The coefficients of tau stand behind those of the terms.
        """
        m, cross = self.mass.tolist(), self.coupling
        coriolis = {
            "v r": (0, -m[1][1]),
            "r^2": (0, -cross),
            "u r": (1, m[0][0]),
            "u v": (2, m[1][1] - m[0][0]),
        }
        terms = (*self.terms.terms, *coriolis, "u r")
        force = torch.zeros(3, len(terms), dtype=torch.float64)
        force[:, : self.terms.count] = self.damping
        for column, (axis, value) in enumerate(coriolis.values()):
            force[axis, self.terms.count + column] = value
        force[2, -1] = cross
        return terms, torch.cat((-(self.inverse @ force), self.inverse), dim=1)

    def compact(self) -> None:
        """Rewrite Coriolis force, drag and tau as one product of terms and a matrix.

        Results are the same to rounding, with a third of the operations.
        """
        terms, self.response = self.products()
        library = TermLibrary(terms, VELOCITY)
        # the forces are rows of their own behind [1, nu, |nu|]
        forces = torch.zeros(library.depth, 3, dtype=torch.long)
        forces[0] = torch.tensor([7, 8, 9])
        self.gather = list(torch.cat((library.index, forces), dim=1))
        self.compacted = True

    def forward(self, nu: Tensor, tau: Tensor) -> Tensor:
        """Return the acceleration nu_dot [..., 3]; [B, 3] once compacted.

        Args:
            nu: velocities through the water [..., 3].
            tau: forces [..., 3] in N, N, N m.
        """
        if self.compacted:
            # terms as rows: gathering rows and a product of few long rows cost a third of gathering
            # columns
            motion = nu.mT.contiguous()
            base = torch.cat((torch.ones_like(motion[:1]), motion, motion.abs(), tau.mT))
            rows = base.index_select(0, self.gather[0])
            for index in self.gather[1:]:
                rows = rows * base.index_select(0, index)
            return (self.response.to(nu.dtype) @ rows).mT
        force = tau - self.coriolis(nu) - self.drag(nu)
        return force @ self.inverse.to(nu.dtype).T


@final
class FossenVessel(HullPlant):
    """A hull with its actuators, in current and external force.

    State x [B, 6 + k]: x, y [m], psi [rad], u, v [m/s] over ground, r [rad/s], then the actuators'
    states.
    """

    def __init__(self, vessel: HullConfig) -> None:
        super().__init__(
            Planar(),
            vessel.actuators.build(),
            vessel.wind.build() if vessel.wind is not None else None,
        )
        self.hull = Fossen3(vessel)

    def in_calm_water(self) -> Self:
        """Return this plant without its exogenous inputs, and the hull's forces in one product."""
        self.hull.compact()
        return super().in_calm_water()

    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [B, 3] from velocities through the water [B, 3] and forces [B, 3]."""
        acceleration: Tensor = self.hull(nu, tau)
        return acceleration
