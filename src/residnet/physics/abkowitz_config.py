"""Configuration of Abkowitz models: Taylor series of the forces about straight motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, model_validator

from residnet.core.config import Config, MetresPerSecond, RevsPerSecond
from residnet.core.layout import PLANAR_LAYOUT
from residnet.core.names import VELOCITY_NAMES
from residnet.physics.actuators.config import (
    CommandSpec,
    ServoSpec,
    ShaftConfig,
    SteeringGearConfig,
)
from residnet.physics.environment_config import WindLoadsConfig
from residnet.physics.parameters import Density
from residnet.physics.plant_channels import (
    PlantChannels,
    list_exogenous_inputs,
    require_invertible_mass,
)
from residnet.physics.terms import parse_axis_terms
from residnet.physics.vessel_file import VesselFile

if TYPE_CHECKING:
    from residnet.physics.plant import Hull, HullPlant

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

    series_variables: ClassVar[tuple[str, ...]] = SERIES_VARIABLES
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

    def servo_specs(self) -> tuple[ServoSpec, ...]:
        shaft_specs = () if self.shaft is None else (self.shaft.servo_spec("n"),)
        return (self.rudder.servo_spec("delta"), *shaft_specs)

    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands: rudder angle and, with terms in dn, revolutions."""
        rudder_command = CommandSpec("cmd_delta", "steer", self.rudder.limit)
        if self.shaft is None:
            return (rudder_command,)
        return rudder_command, CommandSpec("cmd_n", "drive", self.shaft.n_max)

    def plant_channels(self) -> PlantChannels:
        return PlantChannels(
            PLANAR_LAYOUT.state_names
            + tuple(name for spec in self.servo_specs() for name in spec.state_names),
            tuple(command.name for command in self.command_specs()),
            list_exogenous_inputs(PLANAR_LAYOUT, has_wind=self.wind is not None),
            self.rudder.limit,
        )

    def check_parameters(self) -> None:
        require_invertible_mass(self.mass_matrix(), self.name)

    def build(self) -> HullPlant:
        """Build the plant; trials start with straight-ahead motion at service speed.

        Raises:
            ConfigError: if the mass matrix is not positive definite or is singular.
        """
        from residnet.physics.abkowitz import AbkowitzForces
        from residnet.physics.plant import HullPlant

        initial_values = {"u": self.speed, "n": self.shaft.n_0 if self.shaft is not None else 0.0}
        return HullPlant(self.build_hull(), AbkowitzForces(self), self.wind, initial_values)

    def mass_units(self) -> tuple[float, float]:
        """Return the units of mass in kg and of length in m of the series."""
        length = self.length.value
        return (0.5 * self.density * length**3, length) if self.units == "prime" else (1.0, 1.0)

    def mass_matrix(self) -> list[list[float]]:
        """Return the mass matrix with added mass [3, 3], SI."""
        mass_terms = self.mass
        mass_unit, length_unit = self.mass_units()
        moment = mass_terms.m * mass_terms.x_G
        return [
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

    def build_hull(self) -> Hull:
        """Build the inertia in SI, with rigid-body Coriolis forces if the series excludes them.

        `AbkowitzForces` computes the hydrodynamic forces.
        """
        from residnet.physics.plant import Hull

        mass_unit, length_unit = self.mass_units()
        mass_si = self.mass.m * mass_unit
        moment_si = self.mass.m * self.mass.x_G * mass_unit * length_unit
        coriolis_rows: tuple[Mapping[str, float], ...] = ({}, {}, {})
        if self.coriolis == "rigid_body":
            coriolis_rows = (
                # rows of -C_RB(nu) nu (Fossen 2011)
                {"v r": mass_si, "r^2": moment_si},
                {"u r": -mass_si},
                {"u r": -moment_si},
            )
        return Hull(self.mass_matrix(), coriolis_rows, VELOCITY_NAMES, self.name)
