"""Dimensions of coefficients, non-dimensional systems of ship hydrodynamics and Froude scaling.

The prime systems are defined by SNAME (1952), Nomenclature for Treating the Motion of a Submerged
Body Through a Fluid, Technical and Research Bulletin 1-5, in the notation of Fossen (2011),
Handbook of Marine Craft Hydrodynamics and Motion Control, section 7.2.5, as is Norrbin's (1970)
bis system.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic import BaseModel, Field

from residnet.core.config import (
    Config,
    Kilograms,
    Metres,
    MetresPerSecond,
    PolynomialOf,
    Quantity,
)
from residnet.core.errors import UsageError
from residnet.core.names import get_si_unit
from residnet.physics.parameters import Density, Parameter, parse_dimension
from residnet.physics.terms import Factor, parse_term

SystemName = Literal["prime_i", "prime_ii", "bis"]
GRAVITY = 9.81
"""Acceleration of gravity in m/s^2."""


class Dimension(NamedTuple):
    """Exponents of mass, length and time of a quantity."""

    mass: float
    length: float
    time: float

    def times(self, other: Dimension, power: float = 1.0) -> Dimension:
        """Return the dimension of the product with another quantity to a power."""
        return Dimension(
            self.mass + power * other.mass,
            self.length + power * other.length,
            self.time + power * other.time,
        )

    @property
    def unit(self) -> str:
        """SI unit, such as kg m^-1."""
        parts = [
            symbol if exponent == 1 else f"{symbol}^{exponent:g}"
            for symbol, exponent in zip(("kg", "m", "s"), self, strict=True)
            if exponent
        ]
        return " ".join(parts) or "-"


DIMENSIONLESS = Dimension(0, 0, 0)
"""Dimension of ratios and angles."""
_DIMENSION_OF_UNIT = {
    "-": DIMENSIONLESS,
    "rad": DIMENSIONLESS,
    "m": Dimension(0, 1, 0),
    "s": Dimension(0, 0, 1),
    "1/s": Dimension(0, 0, -1),
    "1/s^2": Dimension(0, 0, -2),
    "m/s": Dimension(0, 1, -1),
    "rad/s": Dimension(0, 0, -1),
    "m/s^2": Dimension(0, 1, -2),
    "rad/s^2": Dimension(0, 0, -2),
    "kg": Dimension(1, 0, 0),
    "kg m": Dimension(1, 1, 0),
    "kg m^2": Dimension(1, 2, 0),
    "N": Dimension(1, 1, -2),
    "N m": Dimension(1, 2, -2),
    "W": Dimension(1, 2, -3),
    "m^2": Dimension(0, 2, 0),
    "m^3": Dimension(0, 3, 0),
    "kg/m^3": Dimension(1, -3, 0),
}


def dimension_of_unit(unit: str) -> Dimension | None:
    """Return the dimension of an SI unit; None if it is not mechanical, such as V."""
    return _DIMENSION_OF_UNIT.get(unit)


def dimension_of_term(factors: Sequence[Factor], units: Mapping[str, str]) -> Dimension | None:
    """Return the dimension of a product of channels.

    Args:
        factors: factors of the term, from `parse_term`.
        units: SI unit of each channel.

    Returns:
        The dimension; None if a channel has no mechanical unit, or a sine or cosine is taken of a
        quantity that is no angle.
    """
    dimension = DIMENSIONLESS
    for factor in factors:
        base = dimension_of_unit(units[factor.name])
        if base is None:
            return None
        if factor.function in ("sin", "cos"):
            if base != DIMENSIONLESS:
                return None
            continue
        # magnitudes have no function and keep the dimension of the channel
        root = {"sqrt": 0.5, "ssqrt": 0.5, "inv": -1.0}.get(factor.function, 1.0)
        dimension = dimension.times(base, root * factor.power)
    return dimension


@dataclass(frozen=True)
class ReferenceScales:
    """Units of mass, length and time of a non-dimensional system.

    Attributes:
        mass: unit of mass in kg.
        length: unit of length in m.
        time: unit of time in s.
    """

    mass: float
    length: float
    time: float

    def factor(self, dimension: Dimension) -> float:
        """Return the size, in SI units, of 1 in this system; divide by it to remove dimensions."""
        factor: float = (
            self.mass**dimension.mass * self.length**dimension.length * self.time**dimension.time
        )
        return factor


class Particulars(Config):
    """Main particulars of a vessel.

    Attributes:
        length: length between perpendiculars L.
        speed: service speed U, about which derivatives are taken.
        density: density of the water.
        draught: draught T; None if unknown.
        beam: beam B; None if unknown.
        mass: displacement; None if unknown.
        centre_of_gravity: x_G, positive ahead of the origin of the body axes.
        gyradius: radius of gyration in yaw about the centre of gravity in units of L.
    """

    length: Metres = Field(gt=0)
    speed: MetresPerSecond = Field(gt=0)
    density: Density = Field(default=1000.0, gt=0)
    draught: Metres | None = Field(default=None, gt=0)
    beam: Metres | None = Field(default=None, gt=0)
    mass: Kilograms | None = Field(default=None, gt=0)
    centre_of_gravity: Metres = 0.0
    gyradius: float = Field(default=0.25, gt=0, lt=1)

    @property
    def froude_number(self) -> float:
        """Froude number U / sqrt(g L)."""
        return self.speed / math.sqrt(GRAVITY * self.length)

    def reference_scales(self, system: SystemName) -> ReferenceScales | None:
        """Return the units of a non-dimensional system; None if a particular is unknown.

        `prime_i` has the unit of mass 1/2 rho L^3, `prime_ii` 1/2 rho L^2 T, and both the unit of
        time L/U; `bis` has the mass of the vessel and sqrt(L/g).
        """
        if system == "bis":
            if self.mass is None:
                return None
            return ReferenceScales(self.mass, self.length, math.sqrt(self.length / GRAVITY))
        # the systems differ in the reference area only: L^2 (prime I) or L T (prime II)
        area = self.length if system == "prime_i" else self.draught
        if area is None:
            return None
        return ReferenceScales(
            0.5 * self.density * self.length**2 * area, self.length, self.length / self.speed
        )

    def scaled(self, scale: float, density_ratio: float = 1.0) -> Particulars:
        """Return the particulars of a geometrically similar vessel at the same Froude number.

        Args:
            scale: length of the other vessel in units of this one's, such as 50 for full scale.
            density_ratio: density of the other vessel's water in units of this one's.
        """
        return Particulars(
            length=self.length * scale,
            # an equal Froude number requires U proportional to sqrt(L)
            speed=self.speed * math.sqrt(scale),
            density=self.density * density_ratio,
            draught=None if self.draught is None else self.draught * scale,
            beam=None if self.beam is None else self.beam * scale,
            mass=None if self.mass is None else self.mass * scale**3 * density_ratio,
            centre_of_gravity=self.centre_of_gravity * scale,
            gyradius=self.gyradius,
        )


class DerivativesConfig(Particulars):
    """Hydrodynamic derivatives that a fit writes for one of its baselines.

    Attributes:
        model: name of the baseline.
        order: highest order of the Taylor series.
        scale: length of the ship divided by the length of the vessel in the logs.
        density_ratio: density of the ship's water divided by the density in the logs.
    """

    model: str = "baseline"
    order: int = Field(default=1, ge=1, le=3)
    scale: float = Field(default=1.0, gt=0)
    density_ratio: float = Field(default=1.0, gt=0)

    def particulars(self) -> Particulars:
        """Return the main particulars alone."""
        names = Particulars.model_fields
        return Particulars.model_construct(**{name: getattr(self, name) for name in names})


def froude_factor(dimension: Dimension, scale: float, density_ratio: float = 1.0) -> float:
    """Return the factor of a quantity between similar vessels at the same Froude number.

    Lengths scale by `scale`, times by its square root and masses by its cube times the ratio of
    densities (Froude's law of similarity; viscous scale effects are not included).

    Args:
        dimension: dimension of the quantity.
        scale: ratio of lengths.
        density_ratio: ratio of the densities of the water.
    """
    scales = ReferenceScales(scale**3 * density_ratio, scale, math.sqrt(scale))
    return scales.factor(dimension)


_DRIVE_PREFIXES = ("n", "tau_x", "thrust", "throttle")


def is_drive(name: str) -> bool:
    """Return whether an input belongs to a propeller or is a thrust, by its name."""
    base_name = name.removeprefix("cmd_")
    return any(
        base_name == prefix or base_name.startswith(f"{prefix}_") for prefix in _DRIVE_PREFIXES
    )


def is_rudder(name: str) -> bool:
    """Return whether an input is the angle of a rudder, by its name."""
    return name.removeprefix("cmd_").startswith(("delta", "rudder"))


ConfigT = TypeVar("ConfigT", bound=BaseModel)


@dataclass(frozen=True)
class FroudeScaling:
    """Conversion of quantities between similar vessels at the same Froude number.

    Attributes:
        scale: length of the target vessel divided by the length of the original.
        density_ratio: density of the water at the target divided by that at the original.

    Raises:
        UsageError: if a ratio is not a positive number.
    """

    scale: float
    density_ratio: float = 1.0

    def __post_init__(self) -> None:
        for name, example in (("scale", "50"), ("density_ratio", "1.025")):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise UsageError(
                    f"{name}: expected a positive number such as {example}, got {value:g}"
                )

    @property
    def inverse(self) -> FroudeScaling:
        """Conversion from the target back to the original."""
        return FroudeScaling(1.0 / self.scale, 1.0 / self.density_ratio)

    @property
    def time_factor(self) -> float:
        """Ratio of times of the target to times of the original: sqrt(scale), dimensionless."""
        return math.sqrt(self.scale)

    def factor(self, dimension: Dimension) -> float:
        """Return the ratio of a quantity at the new scale to that at the old one (Froude's law)."""
        return froude_factor(dimension, self.scale, self.density_ratio)

    def unit_factor(self, unit: str) -> float:
        """Return the factor of quantities in an SI unit; 1 if it is not mechanical, such as V."""
        return self.factor(dimension_of_unit(unit) or DIMENSIONLESS)

    def channel_factor(self, name: str) -> float:
        """Return the factor of a channel; 1 without a known unit, such as a share of thrust."""
        return self.unit_factor(get_si_unit(name) or "-")

    def term_factor(self, term: str, names: Sequence[str]) -> float:
        """Return the factor of a product of channels, such as u|u| delta.

        Args:
            term: the term.
            names: names of the channels.
        """
        units = {name: get_si_unit(name) or "-" for name in names}
        return self.factor(dimension_of_term(parse_term(term, names), units) or DIMENSIONLESS)

    def scale_config(self, config: ConfigT) -> ConfigT:
        """Return a config with its dimensional values at the target scale.

        Units are taken from annotations such as `Metres`, and from parameters of vessel files.
        Numbers without a unit, such as coefficients in a mapping of terms, do not change.
        """
        if isinstance(config, Parameter):
            factor = self.factor(_dimension_of_parameter(config.unit))
            return config.model_copy(update={"value": config.value * factor})
        return config.model_copy(
            update={
                name: self._scale_value(
                    getattr(config, name), _annotate(field.annotation, field.metadata)
                )
                for name, field in type(config).model_fields.items()
            }
        )

    def _scale_value(self, value: Any, annotation: Any) -> Any:
        """Return a value of a config with this annotation at the target scale."""
        if isinstance(value, BaseModel):
            return self.scale_config(value)
        members = _list_alternatives(annotation)
        polynomial = next((m for m in members if isinstance(m, PolynomialOf)), None)
        if polynomial is not None and isinstance(value, tuple):
            return tuple(
                coefficient
                * self.unit_factor(polynomial.value)
                / self.unit_factor(polynomial.variable) ** power
                for power, coefficient in enumerate(value)
            )
        if isinstance(value, tuple | list):
            element_types = next(
                (get_args(member) for member in members if get_origin(member) in (tuple, list)), ()
            )
            is_uniform = len(element_types) != len(value) or Ellipsis in element_types
            return type(value)(
                self._scale_value(
                    element,
                    Any if not element_types else element_types[0 if is_uniform else index],
                )
                for index, element in enumerate(value)
            )
        if isinstance(value, dict):
            value_type = next(
                (get_args(member)[1] for member in members if get_origin(member) is dict), Any
            )
            return {key: self._scale_value(entry, value_type) for key, entry in value.items()}
        quantity = next((member for member in members if isinstance(member, Quantity)), None)
        if quantity is None or isinstance(value, bool) or not isinstance(value, int | float):
            return value
        return value * self.unit_factor(quantity.si)


def _annotate(annotation: Any, metadata: Sequence[Any]) -> Any:
    """Return an annotation with the markers that pydantic moved to the metadata of a field."""
    return Annotated[(annotation, *metadata)] if metadata else annotation


def _list_alternatives(annotation: Any) -> list[Any]:
    """Return the types of nested unions and `Annotated` types, and their unit markers, as one list.

    `Metres | None`, for example, gives float, `Quantity("m")` and NoneType.
    """
    if get_origin(annotation) is Annotated:
        wrapped_type, *metadata = get_args(annotation)
        markers = [marker for marker in metadata if isinstance(marker, Quantity | PolynomialOf)]
        return [*_list_alternatives(wrapped_type), *markers]
    if get_origin(annotation) in (Union, UnionType):
        return [
            alternative
            for member in get_args(annotation)
            for alternative in _list_alternatives(member)
        ]
    return [annotation]


def _dimension_of_parameter(unit: str) -> Dimension:
    """Return the dimension of an SI unit of a vessel file, such as kg m/s; dimensionless if none.

    `parse_dimension` accepts only units with a given exponent of the mass, which is 0 or 1 in
    vessel files.
    """
    for mass_power in (0, 1):
        powers = parse_dimension(unit, mass_power)
        if powers is not None:
            return Dimension(mass_power, *powers)
    return dimension_of_unit(unit) or DIMENSIONLESS


class AddedMass(NamedTuple):
    """Added masses in three degrees of freedom, as positive entries of the mass matrix, SI.

    Attributes:
        surge: -X_udot in kg.
        sway: -Y_vdot in kg.
        sway_yaw: -Y_rdot in kg m.
        yaw_sway: -N_vdot in kg m.
        yaw: -N_rdot in kg m^2.
    """

    surge: float
    sway: float
    sway_yaw: float
    yaw_sway: float
    yaw: float


def estimate_added_mass(particulars: Particulars) -> AddedMass | None:
    """Estimate added masses from main particulars; None if beam, draught or mass is unknown.

    Sway and yaw follow the regressions of Clarke, Gedling and Hine (1983), The application of
    manoeuvring criteria in hull design using linear theory, Trans. RINA 125; surge follows Söding
    (1982), X_udot = -2.7 rho volume^(5/3) / L^2, in the form of Brix (1993), Manoeuvring Technical
    Manual.
    """
    if particulars.beam is None or particulars.draught is None or particulars.mass is None:
        return None
    length = particulars.length
    beam = particulars.beam
    draught = particulars.draught
    volume = particulars.mass / particulars.density
    block_coefficient = volume / (length * beam * draught)
    # no hull fills more than its bounding box; usually the mass or the draught has a wrong unit
    if block_coefficient > 1.0:
        raise UsageError(
            f"mass: {particulars.mass:g} kg displace {volume:.4g} m^3, more than length x beam x"
            f" draught ({length * beam * draught:.4g} m^3); correct the particulars"
        )
    # pi (T/L)^2 is the sway added mass of a thin plate, which the regressions correct
    slenderness = math.pi * (draught / length) ** 2
    half_density = 0.5 * particulars.density
    return AddedMass(
        surge=2.7 * particulars.density * volume ** (5 / 3) / length**2,
        sway=half_density
        * length**3
        * slenderness
        * (1.0 + 0.16 * block_coefficient * beam / draught - 5.1 * (beam / length) ** 2),
        sway_yaw=half_density
        * length**4
        * slenderness
        * (0.67 * beam / length - 0.0033 * (beam / draught) ** 2),
        yaw_sway=half_density
        * length**4
        * slenderness
        * (1.1 * beam / length - 0.041 * beam / draught),
        yaw=half_density
        * length**5
        * slenderness
        * (1.0 / 12.0 + 0.017 * block_coefficient * beam / draught - 0.33 * beam / length),
    )


def estimate_linear_derivatives(particulars: Particulars) -> dict[str, float] | None:
    """Estimate Y_v, Y_r, N_v and N_r in the prime I system; None if particulars are missing.

    Source: the regressions of Clarke, Gedling and Hine (1983), for the hull without m U terms.
    """
    if particulars.beam is None or particulars.draught is None or particulars.mass is None:
        return None
    beam_to_draught = particulars.beam / particulars.draught
    beam_to_length = particulars.beam / particulars.length
    draught_to_length = particulars.draught / particulars.length
    block_coefficient = particulars.mass / (
        particulars.density * particulars.length * particulars.beam * particulars.draught
    )
    slenderness = math.pi * draught_to_length**2
    return {
        "Y_v": -slenderness * (1.0 + 0.40 * block_coefficient * beam_to_draught),
        "Y_r": -slenderness * (-0.5 + 2.2 * beam_to_length - 0.080 * beam_to_draught),
        "N_v": -slenderness * (0.5 + 2.4 * draught_to_length),
        "N_r": -slenderness * (0.25 + 0.039 * beam_to_draught - 0.56 * beam_to_length),
    }


def estimate_lateral_dynamics(particulars: Particulars) -> list[list[float]] | None:
    """Estimate the derivatives of sway and yaw accelerations by v and r at the service speed.

    The hull derivatives come from `estimate_linear_derivatives`, and the masses from
    `estimate_added_mass` and the rigid body of the particulars (Fossen 2011, section 6.5).

    Returns:
        Rows [[v_dot by v, v_dot by r], [r_dot by v, r_dot by r]] in SI; None if particulars are
        missing.
    """
    added_mass = estimate_added_mass(particulars)
    derivatives = estimate_linear_derivatives(particulars)
    if added_mass is None or derivatives is None or particulars.mass is None:
        return None
    mass = particulars.mass
    length = particulars.length
    speed = particulars.speed
    static_moment = mass * particulars.centre_of_gravity
    inertia = mass * ((particulars.gyradius * length) ** 2 + particulars.centre_of_gravity**2)
    sway_mass = mass + added_mass.sway
    coupling = static_moment + added_mass.sway_yaw
    transposed_coupling = static_moment + added_mass.yaw_sway
    yaw_inertia = inertia + added_mass.yaw
    # unit of Y_v in the prime I system
    unit_of_damping = 0.5 * particulars.density * length**2 * speed
    sway_forces = (
        derivatives["Y_v"] * unit_of_damping,
        derivatives["Y_r"] * unit_of_damping * length - mass * speed,
    )
    yaw_moments = (
        derivatives["N_v"] * unit_of_damping * length,
        derivatives["N_r"] * unit_of_damping * length**2 - static_moment * speed,
    )
    # accelerations M^-1 F of the 2 x 2 mass matrix of sway and yaw
    determinant = sway_mass * yaw_inertia - coupling * transposed_coupling
    columns = list(zip(sway_forces, yaw_moments, strict=True))
    return [
        [(yaw_inertia * force - coupling * moment) / determinant for force, moment in columns],
        [
            (sway_mass * moment - transposed_coupling * force) / determinant
            for force, moment in columns
        ],
    ]
