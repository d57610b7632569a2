"""Particulars and parameters of the MMG standard model of a ship."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from pydantic import Field

from residnet.core.config import Config, Kilograms, Metres
from residnet.physics.parameters import Density, SquareMetres
from residnet.physics.similarity import (
    Particulars,
    estimate_added_mass,
    estimate_linear_derivatives,
)


class MMGHull(Config):
    """Particulars of the hull; the origin of the body frame is midship.

    Attributes:
        length: length between perpendiculars.
        beam: beam of the hull.
        draught: draught of the hull.
        mass: mass of the displaced water.
        gyration: radius of gyration about the centre of gravity, divided by the length.
        x_G: longitudinal position of the centre of gravity, positive forward of midship.
        density: density of the water.
    """

    length: Metres = Field(gt=0)
    beam: Metres = Field(gt=0)
    draught: Metres = Field(gt=0)
    mass: Kilograms = Field(gt=0)
    gyration: float = Field(default=0.25, gt=0, lt=1)
    x_G: Metres = 0.0
    density: Density = Field(default=1000.0, gt=0)

    @property
    def block_coefficient(self) -> float:
        """Displaced volume divided by length, beam and draught, dimensionless."""
        return self.mass / (self.density * self.length * self.beam * self.draught)


class MMGPropeller(Config):
    """Propeller with ahead revolutions.

    Attributes:
        diameter: diameter of the propeller.
        x: longitudinal position divided by the length, positive forward of midship.
        thrust: coefficients of the open-water thrust K_T = k_0 + k_1 J + k_2 J^2.
    """

    diameter: Metres = Field(gt=0)
    x: float = -0.48
    thrust: tuple[float, float, float]


class MMGRudder(Config):
    """Rudder in the slipstream of the propeller.

    Attributes:
        area: area of the movable part.
        aspect: aspect ratio, span squared divided by area.
        x: longitudinal position divided by the length, positive forward of midship.
        race: share of the span in the slipstream (propeller race), propeller diameter divided by
            span.
        curve: normal force over the angle of attack: `fujii` (Fujii and Tsuda 1961), a sine with
            the slope `lift_slope`, or `soeding` (Söding 1982), lift and drag with the separated
            flow at the edges of a rudder of small aspect ratio.
    """

    area: SquareMetres = Field(gt=0)
    aspect: float = Field(gt=0)
    x: float = -0.5
    race: float = Field(gt=0, le=1)
    curve: Literal["fujii", "soeding"] = "fujii"

    @property
    def lift_slope(self) -> float:
        """Gradient of the rudder normal force at zero angle of attack, dimensionless.

        With `soeding`, the friction of the rudder, less than 0.02, is not part of it.
        """
        if self.curve == "soeding":
            return 2.0 * math.pi * self.aspect * (self.aspect + 0.7) / (self.aspect + 1.7) ** 2
        return 6.13 * self.aspect / (2.25 + self.aspect)

    @property
    def chord(self) -> float:
        """Mean chord in m."""
        return math.sqrt(self.area / self.aspect)


class ParameterPrior(NamedTuple):
    """Normal prior of a parameter.

    Attributes:
        mean: mean.
        sd: standard deviation.
        meaning: description of the parameter.
    """

    mean: float
    sd: float
    meaning: str


def default_priors(hull: MMGHull) -> dict[str, ParameterPrior]:
    """Return the default prior of every parameter, for a merchant ship with this hull.

    The means of the linear hull derivatives follow from the formulas of Kijima. The means of most
    higher-order derivatives are zero, so that the trials determine them.
    """
    # aspect ratio k of the hull as a low-aspect-ratio wing, with its mirror image at the surface
    aspect_ratio = 2.0 * hull.draught / hull.length
    beam_fullness = hull.block_coefficient * hull.beam / hull.length
    # m' = m / (rho/2 L^2 d)
    mass_nondim = 2.0 * hull.mass / (hull.density * hull.length**2 * hull.draught)
    return {
        "m_x": ParameterPrior(0.022, 0.01, "added mass in surge"),
        "m_y": ParameterPrior(0.2, 0.06, "added mass in sway"),
        "J_z": ParameterPrior(0.011, 0.004, "added moment of inertia in yaw"),
        "R_0": ParameterPrior(0.02, 0.01, "resistance straight ahead"),
        "X_vv": ParameterPrior(0.0, 0.1, "surge force of drift"),
        "X_vr": ParameterPrior(
            0.0, 0.1, "surge force of drift in a turn, in addition to that of the added mass"
        ),
        "X_rr": ParameterPrior(0.0, 0.03, "surge force of turning"),
        "X_vvvv": ParameterPrior(0.5, 0.5, "surge force of large drift"),
        "Y_0": ParameterPrior(0.0, 0.005, "sway force of asymmetry"),
        "Y_v": ParameterPrior(
            -(0.5 * math.pi * aspect_ratio + 1.4 * beam_fullness), 0.15, "sway force of drift"
        ),
        "Y_r": ParameterPrior(
            mass_nondim + 0.022 - 1.5 * beam_fullness, 0.06, "sway force of turning"
        ),
        "Y_vvv": ParameterPrior(-1.0, 1.0, "sway force of large drift"),
        "Y_vvr": ParameterPrior(0.0, 0.8, "sway force of large drift and turning"),
        "Y_vrr": ParameterPrior(0.0, 0.5, "sway force of drift and fast turning"),
        "Y_rrr": ParameterPrior(0.0, 0.05, "sway force of fast turning"),
        "N_0": ParameterPrior(0.0, 0.002, "yaw moment of asymmetry"),
        "N_v": ParameterPrior(-aspect_ratio, 0.05, "yaw moment of drift"),
        "N_r": ParameterPrior(
            -0.54 * aspect_ratio + aspect_ratio * aspect_ratio, 0.02, "yaw moment of turning"
        ),
        "N_vvv": ParameterPrior(0.0, 0.3, "yaw moment of large drift"),
        "N_vvr": ParameterPrior(0.0, 0.3, "yaw moment of large drift and turning"),
        "N_vrr": ParameterPrior(0.0, 0.1, "yaw moment of drift and fast turning"),
        "N_rrr": ParameterPrior(0.0, 0.02, "yaw moment of fast turning"),
        "t_P": ParameterPrior(0.22, 0.03, "thrust deduction"),
        "w_P0": ParameterPrior(0.4, 0.06, "wake fraction straight ahead"),
        "C_2p": ParameterPrior(
            1.3,
            0.25,
            "inflow at large drift over inflow straight ahead, drift to port or turn to starboard",
        ),
        "C_2n": ParameterPrior(1.1, 0.25, "the same, drift to starboard or turn to port"),
        "t_R": ParameterPrior(0.35, 0.15, "steering resistance deduction"),
        "a_H": ParameterPrior(
            0.3, 0.2, "sway force induced on the hull by the rudder, divided by the rudder force"
        ),
        "x_H": ParameterPrior(
            -0.45, 0.1, "longitudinal position of that force, in lengths forward of midship"
        ),
        "gamma_p": ParameterPrior(0.5, 0.2, "flow straightening, inflow from port"),
        "gamma_n": ParameterPrior(0.5, 0.2, "flow straightening, inflow from starboard"),
        "l_R": ParameterPrior(
            -0.8, 0.3, "effective longitudinal position of the rudder in a turn, in lengths"
        ),
        "epsilon": ParameterPrior(1.05, 0.2, "wake at the propeller over wake at the rudder"),
        "kappa": ParameterPrior(0.5, 0.1, "share of the slipstream acceleration at the rudder"),
    }


def inoue_priors(hull: MMGHull) -> dict[str, ParameterPrior]:
    """Return the default priors with linear hull derivatives by Inoue, Hirano and Kijima (1981).

    Source: Hydrodynamic derivatives on ship manoeuvring, International Shipbuilding Progress 28,
    at even keel. Only the sway force of turning differs from Kijima et al. (1990): the derivative
    without the added mass in surge is pi/4 k with the aspect ratio k = 2 d / L. The MMG system's
    Y_r contains this added mass (Yasukawa and Yoshimura 2015, eq. (7)).
    """
    priors = default_priors(hull)
    sway_of_turning = 0.25 * math.pi * 2.0 * hull.draught / hull.length
    mean = sway_of_turning + priors["m_x"].mean
    return priors | {"Y_r": priors["Y_r"]._replace(mean=mean)}


def clarke_priors(hull: MMGHull) -> dict[str, ParameterPrior]:
    """Return the default priors with linear hull derivatives by Clarke, Gedling and Hine (1983).

    Clarke's regressions are in the prime I system (forces by 1/2 rho L^2 U^2) and do not contain
    m U; the MMG system divides by 1/2 rho L d U^2, and its Y_r includes the added mass in surge
    (Yasukawa and Yoshimura 2015, eq. (7)). The added masses are those of
    `residnet.physics.similarity.estimate_added_mass`.
    """
    priors = default_priors(hull)
    particulars = Particulars(
        length=hull.length,
        # the regressions are non-dimensional: the speed cancels
        speed=1.0,
        density=hull.density,
        draught=hull.draught,
        beam=hull.beam,
        mass=hull.mass,
    )
    derivatives = estimate_linear_derivatives(particulars)
    added_mass = estimate_added_mass(particulars)
    assert derivatives is not None, "beam, draught and mass are known"
    assert added_mass is not None, "beam, draught and mass are known"
    mass_unit = 0.5 * hull.density * hull.length**2 * hull.draught
    ratio = hull.length / hull.draught
    surge = added_mass.surge / mass_unit
    means = {
        "m_x": surge,
        "m_y": added_mass.sway / mass_unit,
        "J_z": added_mass.yaw / (mass_unit * hull.length**2),
        "Y_v": derivatives["Y_v"] * ratio,
        "Y_r": derivatives["Y_r"] * ratio + surge,
        "N_v": derivatives["N_v"] * ratio,
        "N_r": derivatives["N_r"] * ratio,
    }
    return priors | {name: priors[name]._replace(mean=mean) for name, mean in means.items()}


def kijima_rudder_means(hull: MMGHull) -> dict[str, float]:
    """Return prior means of the rudder-hull interaction by Kijima et al. (1990).

    The regressions are on the block coefficient C_b and on C_b B / L: the induced hull force a_H,
    the steering resistance deduction t_R and the wake ratio epsilon.
    """
    block_coefficient = hull.block_coefficient
    beam_fullness = block_coefficient * hull.beam / hull.length
    return {
        "a_H": 0.627 * block_coefficient - 0.153,
        "t_R": 1.0 - (0.28 * block_coefficient + 0.55),
        "epsilon": -156.2 * beam_fullness**2 + 41.6 * beam_fullness - 1.76,
    }


def brix_rudder_means(hull: MMGHull) -> dict[str, float]:
    """Return prior means of the flow straightening by Brix (1993), Manoeuvring Technical Manual.

    The transverse inflow of the rudder is -0.364 v plus a share of the yaw rate that corresponds to
    the position 2 * 0.907 x_R, with x_R = -L/2; the constants are from Kose (1982), On a new
    mathematical model of maneuvering motions of a ship, International Shipbuilding Progress 29,
    from Series 60 models. They do not depend on the hull.
    """
    del hull
    return {"gamma_p": 0.364, "gamma_n": 0.364, "l_R": -0.907}


PARAMETER_NAMES = tuple(default_priors(MMGHull(length=1.0, beam=0.2, draught=0.1, mass=10.0)))
"""Names of the parameters, in the order of the columns of theta."""
