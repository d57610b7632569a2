"""Abkowitz vessels: Taylor series of the forces about straight motion at service speed.

A vessel file holds all coefficients (Abkowitz 1964).
"""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import (
    Config,
    MetresPerSecond,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
)
from residnet.core.errors import ConfigError
from residnet.physics.actuators.base import Actuators
from residnet.physics.actuators.servo import ServoConfig, Servos
from residnet.physics.environment.wind import WindLoadsConfig
from residnet.physics.kinematics import Planar
from residnet.physics.mass import inverse_mass
from residnet.physics.parameters import Density
from residnet.physics.plant import HullPlant
from residnet.physics.terms import TermLibrary, parse_term
from residnet.physics.vessel_file import VesselFile

SERIES = ("du", "v", "r", "delta", "dn")
"""What the terms are made of: u - U0, sway, yaw rate, rudder angle, n - n0."""


class SteeringGearConfig(ServoConfig):
    """The steering gear: how far and how fast the rudder turns.

    Attributes:
        limit: largest rudder angle of either side in rad.
        rate: largest rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class ShaftConfig(ServoConfig):
    """The propeller's shaft, for series with terms in dn.

    Attributes:
        n_0: revolutions at service speed in 1/s.
        n_max: largest revolutions in 1/s.
        n_rate: largest change of revolutions in 1/s^2; None for no limit.
    """

    n_0: RevsPerSecond = Field(gt=0)
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)


class SeriesMass(Config):
    """Rigid body and added mass, in the units of the series.

    Attributes:
        m: mass (kg, or dimensionless in the prime system, as all that follow).
        I_z: moment of inertia in yaw about the body origin (kg m^2).
        x_G: centre of gravity ahead of the body origin (m).
        X_udot: added mass in surge, negative for a normal hull (kg).
        Y_vdot: added mass in sway (kg).
        Y_rdot: sway force by yaw acceleration (kg m).
        N_vdot: yaw moment by sway acceleration (kg m).
        N_rdot: added moment of inertia in yaw (kg m^2).
    """

    m: float = Field(gt=0)
    I_z: float = Field(gt=0)
    x_G: float
    X_udot: float
    Y_vdot: float
    Y_rdot: float
    N_vdot: float
    N_rdot: float


class Derivatives(Config):
    """The coefficients of the force on each axis by term, such as `Y: {v: ..., v^2 r: ...}`.

    Attributes:
        X: coefficients of the surge force, in the units of the series.
        Y: coefficients of the sway force.
        N: coefficients of the yaw moment.
    """

    X: dict[str, float] = Field(default_factory=dict)
    Y: dict[str, float] = Field(default_factory=dict)
    N: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _terms(self) -> Derivatives:
        for axis, row in (("X", self.X), ("Y", self.Y), ("N", self.N)):
            for term in row:
                try:
                    factors = parse_term(term, SERIES)
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if any(factor.power < 0 for factor in factors):
                    raise ValueError(f"{axis}: term '{term}' divides by what may be zero")
        return self

    def rows(self) -> tuple[dict[str, float], ...]:
        """Return X, Y, N."""
        return self.X, self.Y, self.N


class AbkowitzConfig(VesselFile):
    """A vessel given by its hydrodynamic derivatives.

    M nu_dot = sum of terms in (du, v, r, delta, dn).

    Attributes:
        name: of the vessel, as its file is called.
        description: one line for `residnet list vessels`.
        length: L, between perpendiculars.
        units: `prime` for dimensionless coefficients (SNAME's prime system: forces over 0.5 rho L^2
            U^2, moments over 0.5 rho L^3 U^2, masses over 0.5 rho L^3, with U the present speed
            through the water; du/U, v/U, r L/U, dn/n_0), `si` for coefficients in SI.
        speed: U0, the service speed that the series is taken about. In the prime system the present
            speed counts as at least a tenth of it: the series says nothing about a vessel at rest.
        density: of the water, for the prime system.
        coriolis: `included` where the coefficients of v r and u r hold the rigid body's terms (m in
            X_vr, -m in Y_r), as in most published series; `rigid_body` where they do not, and
            -C_RB(nu) nu is added.
        delta_sign: -1 where the coefficients' rudder angle is positive to port (Y_delta > 0), +1
            where it is positive to starboard; commands and states here are positive to starboard.
        mass: rigid body and added mass, in the units of the series.
        coefficients: hydrodynamic derivatives of the forces.
        rudder: limits and lag of the steering gear.
        shaft: limits and lag of the propeller shaft; only where there are terms in dn.
        wind: coefficients of the hull above water.
        source: where all coefficients come from.
    """

    kind: Literal["abkowitz"]
    units: Literal["prime", "si"]
    speed: MetresPerSecond = Field(gt=0)
    density: Density = Field(default=1025.0, gt=0)
    coriolis: Literal["included", "rigid_body"]
    delta_sign: Literal[-1, 1]
    mass: SeriesMass
    coefficients: Derivatives
    source: str = Field(min_length=1)
    rudder: SteeringGearConfig
    shaft: ShaftConfig | None = None
    wind: WindLoadsConfig | None = None

    @model_validator(mode="after")
    def _consistent(self) -> AbkowitzConfig:
        used = {
            factor.name
            for row in self.coefficients.rows()
            for term in row
            for factor in parse_term(term, SERIES)
        }
        if ("dn" in used) != (self.shaft is not None):
            raise ValueError(
                "terms in dn and the section 'shaft' belong together: the series needs both or"
                " neither"
            )
        turning = self.delta_sign * self.coefficients.N.get("delta", 0.0)
        if turning < 0:
            raise ValueError(
                "N.delta times delta_sign must be positive: a rudder to starboard turns to"
                " starboard; check delta_sign"
            )
        return self

    def build(self) -> AbkowitzVessel:
        """Build the plant of this vessel.

        Raises:
            ConfigError: where the mass matrix is not positive definite or is singular.
        """
        return AbkowitzVessel(self)


@final
class SeriesForces(Actuators):
    """The whole series as forces of rudder, propeller and motion: tau [..., 3] in N, N, N m."""

    def __init__(self, config: AbkowitzConfig) -> None:
        super().__init__()
        servos = [config.rudder.follow("delta", config.rudder.limit, config.rudder.rate)]
        self.commands: tuple[str, ...] = ("cmd_delta",)
        limits = [config.rudder.limit]
        self.n_0 = 1.0
        if config.shaft is not None:
            servos.append(config.shaft.follow("n", config.shaft.n_max, config.shaft.n_rate))
            self.commands += ("cmd_n",)
            limits.append(config.shaft.n_max)
            self.n_0 = config.shaft.n_0
        self.servos = Servos(servos)
        self.state = self.servos.state
        self.prime = config.units == "prime"
        self.length, self.speed, self.sign = (
            config.length.value,
            config.speed,
            float(config.delta_sign),
        )
        self.turns = config.shaft is not None
        self.dynamic = 0.5 * config.density * self.length**2
        rows = config.coefficients.rows()
        terms = sorted({term for row in rows for term in row})
        self.terms = TermLibrary(terms, SERIES)
        values = torch.tensor(
            [[row.get(term, 0.0) for row in rows] for term in terms], dtype=torch.float64
        ).reshape(len(terms), 3)
        self.register_buffer("coefficients", values, persistent=False)
        self.register_buffer("limits", torch.tensor(limits, dtype=torch.float64), persistent=False)
        # moments carry one length more than forces
        self.register_buffer(
            "lengths", torch.tensor([1.0, 1.0, self.length], dtype=torch.float64), persistent=False
        )
        self.coefficients: Tensor
        self.limits: Tensor
        self.lengths: Tensor

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder angle from steer.

        Revolutions from drive where the series knows them (else it keeps its service power).
        """
        both = torch.stack((steer, drive) if self.turns else (steer,), dim=-1)
        return both.clamp(-1.0, 1.0) * self.limits.to(drive.dtype)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] of the whole series at velocities through the water nu [..., 3]."""
        position = self.servos.value(a, command)
        u, v, r, delta = nu[..., 0], nu[..., 1], nu[..., 2], self.sign * position[..., 0]
        dn = position[..., 1] - self.n_0 if self.turns else torch.zeros_like(u)
        coefficients = self.coefficients.to(nu.dtype)
        if not self.prime:
            force: Tensor = (
                self.terms(torch.stack((u - self.speed, v, r, delta, dn), dim=-1)) @ coefficients
            )
            return force
        speed = torch.sqrt((u * u + v * v).clamp(min=(0.1 * self.speed) ** 2))
        motion = torch.stack(
            ((u - self.speed) / speed, v / speed, r * self.length / speed, delta, dn / self.n_0),
            dim=-1,
        )
        force = self.dynamic * (speed * speed).unsqueeze(-1) * (self.terms(motion) @ coefficients)
        scaled: Tensor = force * self.lengths.to(nu.dtype)
        return scaled

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, command)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, command, dt)


class SeriesInertia(nn.Module):
    """The mass matrix of the series in SI, its inverse, and the rigid body's Coriolis force.

    The Coriolis force is added only where the series leaves it out.
    """

    def __init__(self, config: AbkowitzConfig) -> None:
        super().__init__()
        body, length = config.mass, config.length.value
        prime = config.units == "prime"
        unit = 0.5 * config.density * length**3 if prime else 1.0
        arm = length if prime else 1.0
        self.m, self.x_G = body.m * unit, body.x_G * arm
        self.added = config.coriolis == "rigid_body"
        moment = body.m * body.x_G
        rows = [
            [body.m - body.X_udot, 0.0, 0.0],
            [0.0, body.m - body.Y_vdot, (moment - body.Y_rdot) * arm],
            [0.0, (moment - body.N_vdot) * arm, (body.I_z - body.N_rdot) * arm**2],
        ]
        mass = unit * torch.tensor(rows, dtype=torch.float64)
        self.register_buffer("mass", mass, persistent=False)
        self.register_buffer("inverse", inverse_mass(mass, config.name), persistent=False)
        self.mass: Tensor
        self.inverse: Tensor

    def forward(self, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [..., 3]."""
        if self.added:
            u, v, r = nu[..., 0], nu[..., 1], nu[..., 2]
            tau = tau + self.m * torch.stack(
                (r * (v + self.x_G * r), -u * r, -self.x_G * u * r), dim=-1
            )
        return tau @ self.inverse.to(nu.dtype).T


@final
class AbkowitzVessel(HullPlant):
    """The vessel of an Abkowitz series in current, wind and external force.

    State x [B, 6 + k]: x, y, psi, u, v, r, then rudder and shaft.
    """

    def __init__(self, config: AbkowitzConfig) -> None:
        super().__init__(
            Planar(), SeriesForces(config), config.wind.build() if config.wind is not None else None
        )
        self.inertia = SeriesInertia(config)
        self.speed = config.speed
        self.n_0 = config.shaft.n_0 if config.shaft is not None else 0.0

    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [B, 3]."""
        acceleration: Tensor = self.inertia(nu, tau)
        return acceleration

    def approach(self, rows: int) -> Tensor:
        """Return straight ahead at service speed and service revolutions, [B, nx]."""
        x = super().approach(rows)
        x[:, 3] = self.speed
        if "n" in self.state:
            x[:, self.state.index("n")] = self.n_0
        return x
