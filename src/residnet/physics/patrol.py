"""The 4-DOF patrol vessel: surge, sway, roll and yaw with roll restoring.

Source: document 004, section 5.2, with the corrections of document 004.
"""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn

from residnet.core.config import Config, MetresPerSecond
from residnet.core.errors import ConfigError
from residnet.physics.actuators.stern_rudders import FoilRuddersConfig, LinearRuddersConfig
from residnet.physics.environment.wind import WindLoadsConfig
from residnet.physics.kinematics import Rolling
from residnet.physics.mass import inverse_mass
from residnet.physics.parameters import (
    Inertia,
    Length,
    Mass,
    MassArm,
    MassDensity,
    Parameter,
    Volume,
    above_zero,
    dimension,
    unit_text,
)
from residnet.physics.plant import HullPlant
from residnet.physics.terms import TermLibrary, parse_term
from residnet.physics.vessel_file import VesselFile

MOTION = (*Rolling.velocity, "phi")
"""What the terms are made of: surge, sway, roll and yaw velocities through the water, and the roll
angle.
"""
GRAVITY = 9.81


class RollingBody(Config):
    """The rigid body of a vessel that rolls.

    Attributes:
        m: mass in kg.
        I_x: moment of inertia in roll about the body origin in kg m^2.
        I_z: moment of inertia in yaw about the body origin in kg m^2.
        x_G: centre of gravity ahead of the body origin in m.
        z_G: centre of gravity below the body origin in m; negative above it.
    """

    m: Mass
    I_x: Inertia
    I_z: Inertia
    x_G: Length
    z_G: Length

    _positive = field_validator("m", "I_x", "I_z")(above_zero)


class RollingAddedMass(Config):
    """The hydrodynamic derivatives of the accelerations in surge, sway, roll and yaw (SNAME).

    Attributes:
        X_udot: surge force by surge acceleration in kg.
        Y_vdot: sway force by sway acceleration in kg.
        Y_pdot: sway force by roll acceleration in kg m.
        Y_rdot: sway force by yaw acceleration in kg m.
        K_vdot: roll moment by sway acceleration in kg m.
        K_pdot: roll moment by roll acceleration in kg m^2.
        K_rdot: roll moment by yaw acceleration in kg m^2.
        N_vdot: yaw moment by sway acceleration in kg m.
        N_pdot: yaw moment by roll acceleration in kg m^2.
        N_rdot: yaw moment by yaw acceleration in kg m^2.
    """

    X_udot: Mass
    Y_vdot: Mass
    Y_pdot: MassArm
    Y_rdot: MassArm
    K_vdot: MassArm
    K_pdot: Inertia
    K_rdot: Inertia
    N_vdot: MassArm
    N_pdot: Inertia
    N_rdot: Inertia


class HullForces(Config):
    """The forces of the water on the hull as terms of (u, v, p, r, phi).

    Terms that brake are negative.

    Attributes:
        X: terms of the surge force, each in the SI unit that its term asks for.
        Y: terms of the sway force.
        K: terms of the roll moment.
        N: terms of the yaw moment.
    """

    X: dict[str, Parameter] = Field(default_factory=dict)
    Y: dict[str, Parameter] = Field(default_factory=dict)
    K: dict[str, Parameter] = Field(default_factory=dict)
    N: dict[str, Parameter] = Field(default_factory=dict)

    def rows(self) -> tuple[dict[str, Parameter], ...]:
        """Return X, Y, K, N."""
        return self.X, self.Y, self.K, self.N

    @model_validator(mode="after")
    def _units(self) -> HullForces:
        for axis, row in zip("XYKN", self.rows(), strict=True):
            for term, parameter in row.items():
                try:
                    factors = parse_term(term, MOTION, functions=False)
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if any(factor.power < 0 for factor in factors):
                    raise ValueError(f"{axis}: term '{term}' is infinite at rest")
                metres = (2 if axis in "KN" else 1) - sum(
                    f.power for f in factors if f.name in "uv"
                )
                seconds = -2 + sum(f.power for f in factors if f.name != "phi")
                if dimension(parameter.unit) != (metres, seconds):
                    raise ValueError(
                        f"{axis}.{term}: its unit must be {unit_text(metres, seconds)}, given"
                        f" '{parameter.unit}'"
                    )
        return self


class Hydrostatics(Config):
    """Roll restoring K = -rho g V GM phi.

    Attributes:
        density: of the water.
        volume: displaced.
        GM: transverse metacentric height.
    """

    density: MassDensity
    volume: Volume
    GM: Length

    _positive = field_validator("density", "volume", "GM")(above_zero)

    @property
    def stiffness(self) -> float:
        """rho g V GM in N m per rad."""
        return self.density.value * GRAVITY * self.volume.value * self.GM.value


class PatrolConfig(VesselFile):
    """A vessel in surge, sway, roll and yaw, given by its derivatives.

    Attributes:
        speed: service speed, which trials start from.
        actuators: rudders as foils in the propellers' race, or linear ones.
        wind: coefficients of the hull above water; without them the vessel feels no wind.
        hydrostatics: roll restoring.
        rigid_body: mass, inertia and centre of gravity.
        added_mass: hydrodynamic derivatives of the accelerations.
        forces: terms of the forces of the water.
    """

    kind: Literal["patrol"]
    speed: MetresPerSecond = Field(gt=0)
    hydrostatics: Hydrostatics
    rigid_body: RollingBody
    added_mass: RollingAddedMass
    forces: HullForces
    actuators: FoilRuddersConfig | LinearRuddersConfig = Field(discriminator="kind")
    wind: WindLoadsConfig | None = None

    def build(self) -> PatrolVessel:
        """Build the plant of this vessel.

        Raises:
            ConfigError: where the mass matrix is not positive definite or is singular.
        """
        return PatrolVessel(self)


class PatrolHull(nn.Module):
    """The acceleration of a hull that rolls.

    Inertia is that of the rigid body about the origin (eq. (5.12)); the water's Coriolis forces are
    among the terms, as far as the source has them (X_vr). Buffers are float64; results take the
    dtype of the input.
    """

    def __init__(self, vessel: PatrolConfig) -> None:
        super().__init__()
        body, added = vessel.rigid_body, vessel.added_mass
        m = body.m.value
        along, down = m * body.x_G.value, m * body.z_G.value
        mass = torch.tensor(
            [
                [m - added.X_udot.value, 0.0, 0.0, 0.0],
                [
                    0.0,
                    m - added.Y_vdot.value,
                    -(down + added.Y_pdot.value),
                    along - added.Y_rdot.value,
                ],
                [
                    0.0,
                    -(down + added.K_vdot.value),
                    body.I_x.value - added.K_pdot.value,
                    -added.K_rdot.value,
                ],
                [
                    0.0,
                    along - added.N_vdot.value,
                    -added.N_pdot.value,
                    body.I_z.value - added.N_rdot.value,
                ],
            ],
            dtype=torch.float64,
        )
        # centripetal terms of the rigid body, (5.12), and the restoring moment, which (5.17) leaves
        # out
        inertia = {
            "v r": (m, 0.0, 0.0, 0.0),
            "r r": (along, 0.0, 0.0, 0.0),
            "p r": (-down, 0.0, 0.0, 0.0),
            "u r": (0.0, -m, down, -along),
            "phi": (0.0, 0.0, -vessel.hydrostatics.stiffness, 0.0),
        }
        rows = vessel.forces.rows()
        force_terms = sorted({term for row in rows for term in row})
        coefficients = [
            [row[term].value if term in row else 0.0 for row in rows] for term in force_terms
        ]
        self.terms = TermLibrary([*inertia, *force_terms], MOTION)
        self.register_buffer("mass", mass, persistent=False)
        self.register_buffer("inverse", inverse_mass(mass, vessel.name), persistent=False)
        self.register_buffer(
            "coefficients",
            torch.tensor([*inertia.values(), *coefficients], dtype=torch.float64),
            persistent=False,
        )
        self.mass: Tensor
        self.inverse: Tensor
        self.coefficients: Tensor

    def load(self, phi: Tensor, nu: Tensor) -> Tensor:
        """Return the forces [..., 4] in N, N, N m, N m of water, weight and rotation.

        Args:
            phi: roll angle [...] in rad.
            nu: velocities through the water [..., 4].
        """
        force: Tensor = self.terms(
            torch.cat((nu, phi.unsqueeze(-1)), dim=-1)
        ) @ self.coefficients.to(nu.dtype)
        return force

    def forward(self, phi: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return the acceleration nu_dot [..., 4] under the further forces tau [..., 4]."""
        return (self.load(phi, nu) + tau) @ self.inverse.to(nu.dtype).T


@final
class PatrolVessel(HullPlant):
    """A hull with rudders and propellers, in current, wind and external force.

    State x [B, 8 + k]: x, y [m], phi, psi [rad], u, v [m/s] over ground, p, r [rad/s], then the
    rudder angle where it has a rate.
    """

    def __init__(self, vessel: PatrolConfig) -> None:
        super().__init__(
            Rolling(),
            vessel.actuators.build(),
            vessel.wind.build() if vessel.wind is not None else None,
        )
        self.hull = PatrolHull(vessel)
        self.speed = vessel.speed

    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [B, 4].

        Args:
            pose: pose [B, 4].
            nu: velocities through the water [B, 4].
            tau: forces [B, 4] in N, N, N m, N m.
        """
        acceleration: Tensor = self.hull(pose[..., 2], nu, tau)
        return acceleration

    def approach(self, rows: int) -> Tensor:
        """Return the state straight ahead at service speed, [rows, nx].

        The source's thrust compensates the resistance there.
        """
        x = super().approach(rows)
        x[:, self.state.index("u")] = self.speed
        return x
