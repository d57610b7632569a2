"""Vessel files of hulls: rigid body, added mass and terms of forces or accelerations.

Sources: Woo et al. 2018, eqs. (5)-(9); Jervan 2020, eqs. (2.3)-(2.6) and appendix A; Halvorsen
2019, eqs. (6.6)-(6.8); Gouletas 2020, section 5.2. Wrong signs, symbols and missing terms are
corrected as listed in docs/documents/corrections.md (W1, W2, J1 to J4, H1 to H5, G1 to G7).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import AfterValidator, Field

from residnet.core.config import Config, MetresPerSecond
from residnet.core.layout import PLANAR_LAYOUT, ROLL_PLANT_LAYOUT, SIX_DOF_PLANT_LAYOUT, StateLayout
from residnet.core.names import VELOCITY_NAMES
from residnet.physics.actuators import (
    ActuatorsConfig,
    RollingActuatorsConfig,
    SubmergedActuatorsConfig,
)
from residnet.physics.actuators.config import ActuatorConfig, ServoSpec
from residnet.physics.actuators.thrusters_config import AzimuthThrustersConfig, ForceCommandsConfig
from residnet.physics.environment_config import WindLoadsConfig
from residnet.physics.parameters import (
    GRAVITY,
    Inertia,
    Length,
    Mass,
    MassArm,
    MassDensity,
    Parameter,
    Positive,
    Volume,
    format_unit,
    parse_dimension,
    require_dimension,
)
from residnet.physics.plant_channels import (
    PlantChannels,
    list_exogenous_inputs,
    require_invertible_mass,
)
from residnet.physics.terms import parse_axis_terms
from residnet.physics.vessel_file import VesselFile

if TYPE_CHECKING:
    from residnet.physics.plant import Hull, HullPlant

_METRE_POWER = {"X": 1, "Y": 1, "Z": 1, "K": 2, "M": 2, "N": 2, "u": 1, "v": 1, "r": 0}
"""Exponent of metre in the unit of the force or acceleration of each axis."""


class RigidBody(Config):
    """Rigid body: mass, yaw inertia and centre of gravity.

    Attributes:
        m: mass in kg.
        I_z: moment of inertia in yaw about the body origin in kg m^2.
        x_G: longitudinal position of the centre of gravity in m, forward of the body origin.
    """

    m: Annotated[Mass, Positive]
    I_z: Annotated[Inertia, Positive]
    x_G: Length


class AddedMass(Config):
    """Hydrodynamic derivatives of the accelerations (SNAME notation; negative for most hulls).

    Attributes:
        X_udot: surge force by surge acceleration in kg.
        Y_vdot: sway force by sway acceleration in kg.
        Y_rdot: sway force by yaw acceleration in kg m.
        N_vdot: yaw moment by sway acceleration in kg m.
        N_rdot: yaw moment by yaw acceleration in kg m^2.
    """

    X_udot: Mass
    Y_vdot: Mass
    Y_rdot: MassArm
    N_vdot: MassArm
    N_rdot: Inertia


AxisTerms = dict[str, Parameter]
"""Coefficients of an axis by term, each in the SI unit determined by its term."""


def _axis_terms_validator(
    axes: str, channels: tuple[str, ...], mass_power: int = 1
) -> AfterValidator:
    """Return a validator of the units of terms, which also adds empty rows for missing axes.

    Args:
        axes: names of the axes, in the order of the velocities.
        channels: channels of the terms.
        mass_power: exponent of mass in the units, 1 for forces and 0 for accelerations.
    """

    def validate_units(axis_terms: dict[str, AxisTerms]) -> dict[str, AxisTerms]:
        for axis, term, factors in parse_axis_terms(axis_terms, channels, functions=False):
            metre_power = _METRE_POWER[axis] - sum(
                # each linear velocity in a term takes a metre from the unit of its coefficient
                factor.power
                for factor in factors
                if factor.name in ("u", "v", "w")
            )
            # each velocity or rate adds a second; the roll angle is dimensionless
            second_power = -2 + sum(factor.power for factor in factors if factor.name != "phi")
            unit = axis_terms[axis][term].unit
            if parse_dimension(unit, mass_power) != (metre_power, second_power):
                raise ValueError(
                    f"{axis}.{term}: expected the unit"
                    f" {format_unit(metre_power, second_power, mass_power)}, got '{unit}'"
                )
        return {axis: axis_terms.get(axis, {}) for axis in axes}

    return AfterValidator(validate_units)


PlanarRows = Annotated[
    dict[Literal["X", "Y", "N"], AxisTerms], _axis_terms_validator("XYN", VELOCITY_NAMES)
]
"""Forces as terms of (u, v, r), for example `X: {u: ..., "u|u|": ...}`."""
AccelerationRows = Annotated[
    dict[Literal["u", "v", "r"], AxisTerms], _axis_terms_validator("uvr", VELOCITY_NAMES, 0)
]
"""Accelerations as terms of (u, v, r)."""
ROLLING_CHANNELS = (*ROLL_PLANT_LAYOUT.velocities, "phi")
RollingRows = Annotated[
    dict[Literal["X", "Y", "K", "N"], AxisTerms], _axis_terms_validator("XYKN", ROLLING_CHANNELS)
]
"""Forces as terms of (u, v, p, r, phi)."""
SubmergedRows = Annotated[
    dict[Literal["X", "Y", "Z", "K", "M", "N"], AxisTerms],
    _axis_terms_validator("XYZKMN", SIX_DOF_PLANT_LAYOUT.velocities),
]
"""Forces as terms of (u, v, w, p, q, r)."""


def coefficient_rows(
    terms_by_axis: Mapping[Any, AxisTerms], factor: float = 1.0
) -> list[dict[str, float]]:
    """Return the coefficients of each axis by term, in SI units and multiplied by a factor."""
    return [
        {term: factor * parameter.value for term, parameter in axis_terms.items()}
        for axis_terms in terms_by_axis.values()
    ]


class HullCoefficients(NamedTuple):
    """Coefficients of a hull M nu_dot = f(motion) + tau, in which f is a sum of terms.

    Attributes:
        mass: mass matrix M with added mass [n][n].
        force_rows: coefficients of f by term, one row for each axis; coefficients of damping are
            negative.
        channels: channels of the motion: velocities, then phi with roll and theta with pitch.
    """

    mass: list[list[float]]
    force_rows: list[dict[str, float]]
    channels: tuple[str, ...]


class HullVessel(VesselFile, ABC):
    """Vessel with hull, actuators and wind loads.

    A file can refer to another one as `base` and contain the differences only.

    Attributes:
        actuators: actuators of the vessel.
        wind: wind coefficients; without them there is no wind load.
    """

    actuators: ActuatorConfig
    wind: WindLoadsConfig | None = None

    layout: ClassVar[StateLayout] = PLANAR_LAYOUT
    """Pose and velocities of the hull."""

    @abstractmethod
    def hull_coefficients(self) -> HullCoefficients:
        """Return mass and force coefficients of the hull."""

    @final
    def build_hull(self) -> Hull:
        """Build the hull.

        Raises:
            ConfigError: if the mass matrix is not positive definite or is singular.
        """
        from residnet.physics.plant import Hull

        coefficients = self.hull_coefficients()
        return Hull(coefficients.mass, coefficients.force_rows, coefficients.channels, self.name)

    @final
    def check_parameters(self) -> None:
        require_invertible_mass(self.hull_coefficients().mass, self.name)

    @final
    def servo_specs(self) -> tuple[ServoSpec, ...]:
        return self.actuators.servo_specs()

    @final
    def plant_channels(self) -> PlantChannels:
        actuators = self.actuators
        servo_states = tuple(name for spec in actuators.servo_specs() for name in spec.state_names)
        return PlantChannels(
            self.layout.state_names + servo_states,
            actuators.command_names(),
            list_exogenous_inputs(self.layout, has_wind=self.wind is not None),
            actuators.max_rudder,
            actuators.can_dive,
            isinstance(actuators, ForceCommandsConfig | AzimuthThrustersConfig),
            actuators.y_max if isinstance(actuators, ForceCommandsConfig) else None,
        )

    def initial_speeds(self) -> Mapping[str, float]:
        """Return the nonzero initial states of trials by name."""
        return {}

    @final
    def build(self) -> HullPlant:
        from residnet.physics.plant import HullPlant

        return HullPlant(
            self.build_hull(), self.actuators.build(), self.wind, self.initial_speeds()
        )


class HullConfig(HullVessel, ABC):
    """3-DOF vessel M nu_dot + C(nu) nu + D(nu) nu = tau.

    A file can refer to another one as `base` and contain the differences only.

    Attributes:
        scale: common factor of M, C and D, which defines a plant that differs from the prior model
            of its `base` (Jervan 2020, eq. (4.2)).
        damping: terms of D(nu) nu of each axis; positive coefficients damp.
    """

    scale: float = Field(default=1.0, gt=0)
    damping: PlanarRows
    actuators: ActuatorsConfig

    @abstractmethod
    def mass_matrix(self) -> list[list[float]]:
        """Return M [3, 3] without the scale."""

    @abstractmethod
    def sway_yaw_coupling(self) -> float:
        """Return the coefficient of r in the sway momentum of C(nu), in kg m, without the scale."""

    @final
    def hull_coefficients(self) -> HullCoefficients:
        """Return the coefficients with the skew-symmetric Coriolis matrix of the mass (Fossen).

        Coriolis forces of a symmetric mass matrix do no work.
        """
        mass = [
            [self.scale * value for value in axis_coefficients]
            for axis_coefficients in self.mass_matrix()
        ]
        surge = mass[0][0]
        sway = mass[1][1]
        coupling = self.scale * self.sway_yaw_coupling()
        # D(nu) nu is on the left-hand side: as a force it has the opposite sign
        coefficients = coefficient_rows(self.damping, -self.scale)
        for axis_coefficients, coriolis in zip(
            coefficients,
            (
                # rows of -C(nu) nu for a mass matrix with the entries m11, m22 and m23 (Fossen
                # 2011)
                {"v r": sway, "r^2": coupling},
                {"u r": -surge},
                {"u v": surge - sway, "u r": -coupling},
            ),
            strict=True,
        ):
            for term, value in coriolis.items():
                axis_coefficients[term] = axis_coefficients.get(term, 0.0) + value
        return HullCoefficients(mass, coefficients, VELOCITY_NAMES)


@final
class FossenConfig(HullConfig):
    """3-DOF vessel with rigid body and added mass.

    Attributes:
        rigid_body: mass, inertia and centre of gravity.
        added_mass: hydrodynamic derivatives of the accelerations.
    """

    kind: Literal["fossen"]
    rigid_body: RigidBody
    added_mass: AddedMass

    def mass_matrix(self) -> list[list[float]]:
        """Return the mass matrix of rigid body and added mass [3, 3]."""
        rigid_body = self.rigid_body
        added_mass = self.added_mass
        m = rigid_body.m.value
        mass_moment = rigid_body.m.value * rigid_body.x_G.value
        return [
            [m - added_mass.X_udot.value, 0.0, 0.0],
            [0.0, m - added_mass.Y_vdot.value, mass_moment - added_mass.Y_rdot.value],
            [
                0.0,
                mass_moment - added_mass.N_vdot.value,
                rigid_body.I_z.value - added_mass.N_rdot.value,
            ],
        ]

    def sway_yaw_coupling(self) -> float:
        """Return the mean of m23 and m32, so that C belongs to the symmetric part of M.

        Source: Fossen 2011, section 6.3.
        """
        mass = self.mass_matrix()
        return 0.5 * (mass[1][2] + mass[2][1])


class MassEntries(Config):
    """Entries of the mass matrix with added mass; all other entries are zero.

    Attributes:
        m11: surge force by surge acceleration in kg.
        m22: sway force by sway acceleration in kg.
        m23: sway force by yaw acceleration in kg m.
        m32: yaw moment by sway acceleration in kg m.
        m33: yaw moment by yaw acceleration in kg m^2.
    """

    m11: Mass
    m22: Mass
    m23: MassArm
    m32: MassArm
    m33: Inertia


@final
class MassMatrixConfig(HullConfig):
    """3-DOF vessel with an identified mass matrix, such as milliAmpere.

    Attributes:
        mass: entries of the mass matrix.

    Source: Jervan 2020, eqs. (2.3)-(2.6), appendix A.
    """

    kind: Literal["mass_matrix"]
    mass: MassEntries

    def mass_matrix(self) -> list[list[float]]:
        """Return the mass matrix [3, 3], which need not be symmetric."""
        entries = self.mass
        return [
            [entries.m11.value, 0.0, 0.0],
            [0.0, entries.m22.value, entries.m23.value],
            [0.0, entries.m32.value, entries.m33.value],
        ]

    def sway_yaw_coupling(self) -> float:
        """Return m23, as in Jervan 2020, eq. (2.5), whose mass matrix is not symmetric."""
        return self.mass.m23.value


class InverseMass(Config):
    """Acceleration per force or moment of each axis.

    Attributes:
        x: surge acceleration by surge force in 1/kg.
        y: sway acceleration by sway force in 1/kg.
        n: yaw acceleration by yaw moment in 1/(kg m^2).
    """

    x: Annotated[Parameter, AfterValidator(require_dimension(-1, 0, 0)), Positive]
    y: Annotated[Parameter, AfterValidator(require_dimension(-1, 0, 0)), Positive]
    n: Annotated[Parameter, AfterValidator(require_dimension(-1, -2, 0)), Positive]


@final
class AccelerationHullConfig(HullVessel):
    """3-DOF vessel given by its accelerations, nu_dot = gain tau + terms of the velocities.

    A file can refer to another one as `base` and contain the differences only.

    Attributes:
        gains: acceleration per force.
        terms: acceleration without force; coefficients of damping are negative.
    """

    kind: Literal["odin"]
    gains: InverseMass
    terms: AccelerationRows
    actuators: ActuatorsConfig

    def hull_coefficients(self) -> HullCoefficients:
        """Return the coefficients, whose masses are the reciprocals of the gains."""
        # the terms are accelerations: multiplied by the mass they are forces, and the mass cancels
        mass = [1.0 / gain.value for gain in (self.gains.x, self.gains.y, self.gains.n)]
        force_rows = [
            {term: m * value for term, value in acceleration_row.items()}
            for m, acceleration_row in zip(mass, coefficient_rows(self.terms), strict=True)
        ]
        return HullCoefficients(np.diag(mass).tolist(), force_rows, VELOCITY_NAMES)


class RollingBody(RigidBody):
    """Rigid body of a vessel with roll.

    Attributes:
        I_x: moment of inertia in roll about the body origin in kg m^2.
        z_G: vertical position of the centre of gravity in m, below the body origin.
    """

    I_x: Annotated[Inertia, Positive]
    z_G: Length


class RollingAddedMass(AddedMass):
    """Hydrodynamic derivatives of the accelerations in surge, sway, roll and yaw (SNAME).

    Attributes:
        Y_pdot: sway force by roll acceleration in kg m.
        K_vdot: roll moment by sway acceleration in kg m.
        K_pdot: roll moment by roll acceleration in kg m^2.
        K_rdot: roll moment by yaw acceleration in kg m^2.
        N_pdot: yaw moment by roll acceleration in kg m^2.
    """

    Y_pdot: MassArm
    K_vdot: MassArm
    K_pdot: Inertia
    K_rdot: Inertia
    N_pdot: Inertia


class Hydrostatics(Config):
    """Hydrostatic roll moment K = -rho g V GM phi.

    Attributes:
        density: density of the water.
        volume: displaced volume.
        GM: transverse metacentric height.
    """

    density: Annotated[MassDensity, Positive]
    volume: Annotated[Volume, Positive]
    GM: Annotated[Length, Positive]

    @property
    def roll_stiffness(self) -> float:
        """Roll stiffness rho g V GM in N m per rad."""
        return self.density.value * GRAVITY * self.volume.value * self.GM.value


@final
class RollingHullConfig(HullVessel):
    """4-DOF vessel in surge, sway, roll and yaw, given by hydrodynamic derivatives.

    Attributes:
        speed: service speed, the initial speed of trials.
        actuators: rudders as foils in the slipstream of the propellers, or linear rudders.
        hydrostatics: roll restoring.
        rigid_body: mass, inertia and centre of gravity.
        added_mass: hydrodynamic derivatives of the accelerations.
        forces: terms of the hydrodynamic forces; coefficients of damping are negative.
    """

    layout: ClassVar[StateLayout] = ROLL_PLANT_LAYOUT
    kind: Literal["patrol"]
    speed: MetresPerSecond = Field(gt=0)
    hydrostatics: Hydrostatics
    rigid_body: RollingBody
    added_mass: RollingAddedMass
    forces: RollingRows
    actuators: RollingActuatorsConfig

    def initial_speeds(self) -> Mapping[str, float]:
        """Return the service speed, at which the thrust of the source equals the resistance."""
        return {"u": self.speed}

    def hull_coefficients(self) -> HullCoefficients:
        """Return the coefficients with the inertia about the origin (Gouletas 2020, eq. (5.12)).

        Coriolis forces of the added mass are not computed from the added mass: the source contains
        them in its hydrodynamic forces, for example in the term X_vr.
        """
        rigid_body = self.rigid_body
        added_mass = self.added_mass
        m = rigid_body.m.value
        # first moments of mass, which couple sway, roll and yaw through the centre of gravity
        mass_moment_x = m * rigid_body.x_G.value
        mass_moment_z = m * rigid_body.z_G.value
        mass = [
            [m - added_mass.X_udot.value, 0.0, 0.0, 0.0],
            [
                0.0,
                m - added_mass.Y_vdot.value,
                -(mass_moment_z + added_mass.Y_pdot.value),
                mass_moment_x - added_mass.Y_rdot.value,
            ],
            [
                0.0,
                -(mass_moment_z + added_mass.K_vdot.value),
                rigid_body.I_x.value - added_mass.K_pdot.value,
                -added_mass.K_rdot.value,
            ],
            [
                0.0,
                mass_moment_x - added_mass.N_vdot.value,
                -added_mass.N_pdot.value,
                rigid_body.I_z.value - added_mass.N_rdot.value,
            ],
        ]
        # centripetal terms of the rigid body (5.12), and the restoring moment, which is missing in
        # (5.17)
        inertial_terms: tuple[dict[str, float], ...] = (
            {"v r": m, "r r": mass_moment_x, "p r": -mass_moment_z},
            {"u r": -m},
            {"u r": mass_moment_z, "phi": -self.hydrostatics.roll_stiffness},
            {"u r": -mass_moment_x},
        )
        coefficients = coefficient_rows(self.forces)
        for axis_coefficients, added_terms in zip(coefficients, inertial_terms, strict=True):
            for term, value in added_terms.items():
                axis_coefficients[term] = axis_coefficients.get(term, 0.0) + value
        return HullCoefficients(mass, coefficients, ROLLING_CHANNELS)


class SubmergedBody(RollingBody):
    """Rigid body of an underwater vessel with port/starboard symmetry.

    Attributes:
        I_y: moment of inertia in pitch about the body origin in kg m^2.
    """

    I_y: Annotated[Inertia, Positive]


class SubmergedAddedMass(Config):
    """Hydrodynamic derivatives of the accelerations (SNAME) of a hull with three symmetry planes.

    Attributes:
        X_udot: surge force by surge acceleration in kg.
        Y_vdot: sway force by sway acceleration in kg.
        Z_wdot: heave force by heave acceleration in kg.
        K_pdot: roll moment by roll acceleration in kg m^2.
        M_qdot: pitch moment by pitch acceleration in kg m^2.
        N_rdot: yaw moment by yaw acceleration in kg m^2.
    """

    X_udot: Mass
    Y_vdot: Mass
    Z_wdot: Mass
    K_pdot: Inertia
    M_qdot: Inertia
    N_rdot: Inertia


class Buoyancy(Config):
    """Buoyancy of a hull.

    Attributes:
        density: density of the water.
        volume: displaced volume.
        x_B: longitudinal position of the centre of buoyancy in m, forward of the body origin.
        z_B: vertical position of the centre of buoyancy in m, below the body origin.
    """

    density: Annotated[MassDensity, Positive]
    volume: Annotated[Volume, Positive]
    x_B: Length
    z_B: Length


@final
class SubmergedHullConfig(HullVessel):
    """Underwater vessel in six degrees of freedom.

    Attributes:
        actuators: fins and propeller, or vectored thrusters.
        buoyancy: buoyancy of the hull.
        rigid_body: mass, inertia and centre of gravity.
        added_mass: hydrodynamic derivatives of the accelerations.
        forces: terms of the hydrodynamic forces without inertial forces; coefficients of damping
            are negative.
        speed: initial speed of trials.
    """

    layout: ClassVar[StateLayout] = SIX_DOF_PLANT_LAYOUT
    kind: Literal["submerged"]
    speed: MetresPerSecond = Field(default=0.0, ge=0)
    buoyancy: Buoyancy
    rigid_body: SubmergedBody
    added_mass: SubmergedAddedMass
    forces: SubmergedRows
    actuators: SubmergedActuatorsConfig

    def initial_speeds(self) -> Mapping[str, float]:
        return {"u": self.speed}

    def hull_coefficients(self) -> HullCoefficients:
        """Return the coefficients with mass, Coriolis forces, weight and buoyancy.

        With linear momentum l and angular momentum h, the Coriolis force is -w x l and the moment
        is -v x l - w x h (Kirchhoff; Fossen 2021, section 6.3). Weight and buoyancy act along the
        vertical in body axes (Fossen 2021, eq. (4.6)).
        """
        rigid_body = self.rigid_body
        added_mass = self.added_mass
        buoyancy = self.buoyancy
        m, x, z = (parameter.value for parameter in (rigid_body.m, rigid_body.x_G, rigid_body.z_G))
        mass = np.diag(
            np.array([m, m, m, rigid_body.I_x.value, rigid_body.I_y.value, rigid_body.I_z.value])
            - np.array([parameter.value for parameter in dict(added_mass).values()])
        )
        # the centre of gravity (x, 0, z) couples forces and moments: blocks -m S(r_G) and m S(r_G)
        for force_axis, moment_axis, lever in ((0, 4, z), (1, 3, -z), (1, 5, x), (2, 4, -x)):
            mass[force_axis, moment_axis] = mass[moment_axis, force_axis] = m * lever
        coefficients = coefficient_rows(self.forces)

        def add_term(axis: int, term: str, value: float) -> None:
            # terms without a coefficient would only cost time
            if value:
                coefficients[axis][term] = coefficients[axis].get(term, 0.0) + value

        # (a x b)_axis = a_i b_j - a_j b_i for the cyclic permutations (axis, i, j)
        axis_cycles = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        # momenta are linear in the velocities: column k of M multiplies velocity k, so that each
        # cross product becomes a sum of products of two velocities
        for k, name in enumerate(SIX_DOF_PLANT_LAYOUT.velocities):
            momentum = mass[:3, k].tolist()
            angular_momentum = mass[3:, k].tolist()
            v = SIX_DOF_PLANT_LAYOUT.velocities[:3]
            w = SIX_DOF_PLANT_LAYOUT.velocities[3:]
            for axis, a, b in axis_cycles:
                for sign, i, j in ((-1.0, a, b), (1.0, b, a)):
                    add_term(axis, _format_velocity_product(w[i], name), sign * momentum[j])
                    add_term(3 + axis, _format_velocity_product(v[i], name), sign * momentum[j])
                    add_term(
                        3 + axis, _format_velocity_product(w[i], name), sign * angular_momentum[j]
                    )
        # gravity and buoyancy (Fossen 2021, eq. (4.6)): the force is (W - B) along the vertical,
        # and the moment is (W r_G - B r_B) x vertical
        weight = m * GRAVITY
        buoyancy_force = buoyancy.density.value * GRAVITY * buoyancy.volume.value
        # components of the downward vertical in body axes, without their signs
        vertical_direction = ("sin(theta)", "cos(theta) sin(phi)", "cos(theta) cos(phi)")
        signs = (-1.0, 1.0, 1.0)
        net_weight = weight - buoyancy_force
        levers = (
            weight * x - buoyancy_force * buoyancy.x_B.value,
            0.0,
            weight * z - buoyancy_force * buoyancy.z_B.value,
        )
        for axis, a, b in axis_cycles:
            add_term(axis, vertical_direction[axis], signs[axis] * net_weight)
            add_term(3 + axis, vertical_direction[b], signs[b] * levers[a])
            add_term(3 + axis, vertical_direction[a], -signs[a] * levers[b])
        channels = (*SIX_DOF_PLANT_LAYOUT.velocities, "phi", "theta")
        return HullCoefficients(mass.tolist(), coefficients, channels)


def _format_velocity_product(a: str, b: str) -> str:
    """Format the product of two velocities in a fixed order."""
    return (
        f"{a}^2" if a == b else " ".join(sorted((a, b), key=SIX_DOF_PLANT_LAYOUT.velocities.index))
    )
