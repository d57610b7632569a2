"""Abkowitz models: Taylor series of the forces about straight motion at service speed.

A vessel file contains all hydrodynamic derivatives (Abkowitz 1964).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, final

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor, nn

from residnet.core.config import Config, MetresPerSecond, RevsPerSecond
from residnet.core.names import VELOCITY_NAMES
from residnet.physics.actuators.base import (
    ActuatorSystem,
    CommandSpec,
    ShaftConfig,
    SteeringGearConfig,
    commands_from_demand,
)
from residnet.physics.environment import WindLoadsConfig
from residnet.physics.parameters import Density
from residnet.physics.plant import Hull, HullPlant
from residnet.physics.terms import TermLibrary, parse_axis_terms
from residnet.physics.vessel_file import VesselFile

SERIES_VARIABLES = ("du", "v", "r", "delta", "dn")
"""Variables of the terms: u - U0, sway, yaw rate, rudder angle, n - n0."""


class AbkowitzShaftConfig(ShaftConfig):
    """Propeller shaft, for series with terms in dn.

    Attributes:
        n_0: revolutions at service speed in 1/s.
    """

    n_0: RevsPerSecond = Field(gt=0)


class AbkowitzMassConfig(Config):
    """Rigid body and added mass, in the units of the series.

    Attributes:
        m: mass (kg; in the prime system all values are dimensionless).
        I_z: moment of inertia in yaw about the body origin (kg m^2).
        x_G: longitudinal position of the centre of gravity, forward of the body origin (m).
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


def _validate_terms(rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Validate the terms of each axis and add empty rows for missing axes."""
    parse_axis_terms(rows, SERIES_VARIABLES)
    return {axis: rows.get(axis, {}) for axis in "XYN"}


HydrodynamicDerivatives = Annotated[
    dict[Literal["X", "Y", "N"], dict[str, float]], AfterValidator(_validate_terms)
]


class AbkowitzConfig(VesselFile):
    """Vessel given by hydrodynamic derivatives, M nu_dot = sum of terms in (du, v, r, delta, dn).

    Attributes:
        length: length between perpendiculars L.
        units: `prime` for dimensionless coefficients (prime system of SNAME: forces divided by 0.5
            rho L^2 U^2, moments by 0.5 rho L^3 U^2, masses by 0.5 rho L^3, with the current speed
            through the water U; du/U, v/U, r L/U, dn/n_0); `si` for coefficients in SI.
        speed: service speed U0 of the expansion. In the prime system U has a lower bound of a tenth
            of it, because the series is not valid at rest.
        density: density of the water, for the prime system.
        coriolis: `included` if the coefficients of v r and u r contain the rigid-body terms (m in
            X_vr, -m in Y_r), as in most published series; `rigid_body` to add -C_RB(nu) nu.
        delta_sign: -1 if the rudder angle of the coefficients is positive to port (Y_delta > 0), +1
            if it is positive to starboard. Commands and states are positive to starboard.
        mass: rigid body and added mass, in the units of the series.
        coefficients: hydrodynamic derivatives of surge and sway force and yaw moment, in the units
            of the series, such as `Y: {v: ..., v^2 r: ...}`.
        rudder: limits and dynamics of the steering gear.
        shaft: limits and dynamics of the propeller shaft; only with terms in dn.
        wind: wind coefficients.
        source: reference of the coefficients.
    """

    kind: Literal["abkowitz"]
    units: Literal["prime", "si"]
    speed: MetresPerSecond = Field(gt=0)
    density: Density = Field(default=1025.0, gt=0)
    coriolis: Literal["included", "rigid_body"]
    delta_sign: Literal[-1, 1]
    mass: AbkowitzMassConfig
    coefficients: HydrodynamicDerivatives
    source: str = Field(min_length=1)
    rudder: SteeringGearConfig
    shaft: AbkowitzShaftConfig | None = None
    wind: WindLoadsConfig | None = None

    @model_validator(mode="after")
    def _validate_series(self) -> AbkowitzConfig:
        parsed_terms = parse_axis_terms(self.coefficients, SERIES_VARIABLES)
        # dn has a value only with a shaft, and a shaft without terms in dn would have no effect
        if any(factor.name == "dn" for *_, factors in parsed_terms for factor in factors) != (
            self.shaft is not None
        ):
            raise ValueError("terms in dn and the section 'shaft' must be given together")
        turning_derivative = self.delta_sign * self.coefficients["N"].get("delta", 0.0)
        if turning_derivative < 0:
            raise ValueError(
                "N.delta times delta_sign must be positive, so that a starboard rudder turns the"
                " vessel to starboard; check delta_sign"
            )
        return self

    def build(self) -> HullPlant:
        """Build the plant; trials start with straight-ahead motion at service speed.

        Raises:
            ConfigError: if the mass matrix is not positive definite or is singular.
        """
        initial_values = {"u": self.speed, "n": self.shaft.n_0 if self.shaft is not None else 0.0}
        return HullPlant(self.build_hull(), AbkowitzForces(self), self.wind, initial_values)

    def build_hull(self) -> Hull:
        """Build the inertia in SI, with rigid-body Coriolis forces if the series excludes them.

        The hydrodynamic forces are those of `AbkowitzForces`.
        """
        mass_terms = self.mass
        length = self.length.value
        is_prime_system = self.units == "prime"
        # prime system: mass in 0.5 rho L^3, length in L
        mass_unit, length_unit = (
            (0.5 * self.density * length**3, length) if is_prime_system else (1.0, 1.0)
        )
        # static moment m x_G
        moment = mass_terms.m * mass_terms.x_G
        mass_si = mass_terms.m * mass_unit
        moment_si = moment * mass_unit * length_unit
        mass = [
            [mass_unit * (mass_terms.m - mass_terms.X_udot), 0.0, 0.0],
            [
                0.0,
                mass_unit * (mass_terms.m - mass_terms.Y_vdot),
                mass_unit * length_unit * (moment - mass_terms.Y_rdot),
            ],
            [
                0.0,
                mass_unit * length_unit * (moment - mass_terms.N_vdot),
                mass_unit * length_unit**2 * (mass_terms.I_z - mass_terms.N_rdot),
            ],
        ]
        coriolis_rows: tuple[Mapping[str, float], ...] = ({}, {}, {})
        if self.coriolis == "rigid_body":
            coriolis_rows = (
                # rows of -C_RB(nu) nu (Fossen 2011)
                {"v r": mass_si, "r^2": moment_si},
                {"u r": -mass_si},
                {"u r": -moment_si},
            )
        return Hull(mass, coriolis_rows, VELOCITY_NAMES, self.name)


@final
class AbkowitzForces(ActuatorSystem):
    """Forces tau [..., 3] in N, N, N m of the series, of rudder, propeller and motion."""

    def __init__(self, config: AbkowitzConfig) -> None:
        rudder = config.rudder
        shaft = config.shaft
        servos = [rudder.build_servo("delta")]
        command_specs = [CommandSpec("cmd_delta", "steer", rudder.limit)]
        if shaft is not None:
            servos.append(shaft.build_servo("n"))
            command_specs.append(CommandSpec("cmd_n", "drive", shaft.n_max))
        super().__init__(*servos)
        self.command_specs = tuple(command_specs)
        self.has_shaft = shaft is not None
        self.n_0 = shaft.n_0 if shaft is not None else 1.0
        self.command_names = tuple(command.name for command in command_specs)
        self.is_prime_system = config.units == "prime"
        self.length = config.length.value
        self.speed = config.speed
        self.delta_sign = float(config.delta_sign)
        # 0.5 rho L^2, the factor of U^2 in the unit of force
        self.pressure_area = 0.5 * config.density * self.length**2
        coefficient_rows = list(config.coefficients.values())
        self.terms = TermLibrary(
            sorted({term for axis_coefficients in coefficient_rows for term in axis_coefficients}),
            SERIES_VARIABLES,
        )
        coefficient_values = [
            [axis_coefficients.get(term, 0.0) for axis_coefficients in coefficient_rows]
            for term in self.terms.terms
        ]
        self.coefficients = nn.Buffer(
            torch.tensor(coefficient_values, dtype=torch.float64), persistent=False
        )
        # moments carry one length more than forces
        moment_arms = torch.tensor([1.0, 1.0, self.length], dtype=torch.float64)
        self.moment_arms = nn.Buffer(moment_arms, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder command from steer, and revolutions from drive with terms in dn."""
        return commands_from_demand(self.command_specs, drive, steer)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        position = self.servo_positions(states, command)
        u = nu[..., 0]
        v = nu[..., 1]
        r = nu[..., 2]
        delta = self.delta_sign * position[..., 0]
        # without a shaft no term contains dn, so that its value does not matter
        dn = position[..., 1] - self.n_0 if self.has_shaft else torch.zeros_like(u)
        coefficients = self.coefficients.to(nu.dtype)
        if not self.is_prime_system:
            series_variables = torch.stack((u - self.speed, v, r, delta, dn), dim=-1)
            force: Tensor = self.terms(series_variables) @ coefficients
            return force
        # the lower bound keeps v / U finite at rest
        speed = torch.sqrt((u * u + v * v).clamp(min=(0.1 * self.speed) ** 2))
        series_variables = torch.stack(
            ((u - self.speed) / speed, v / speed, r * self.length / speed, delta, dn / self.n_0),
            dim=-1,
        )
        force = (
            self.pressure_area
            * (speed * speed).unsqueeze(-1)
            * (self.terms(series_variables) @ coefficients)
        )
        return force * self.moment_arms.to(nu.dtype)
