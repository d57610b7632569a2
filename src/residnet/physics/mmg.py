"""The MMG standard model of a ship with one propeller and one rudder.

Hull, propeller and rudder stand apart, with what each does to the others.

Source: Yasukawa and Yoshimura, Introduction of MMG standard method for ship maneuvering
predictions, J Mar Sci Technol 20 (2015) 37-52. Starting values of the hull's linear derivatives:
Kijima et al., On the manoeuvring performance of a ship with the parameter of loading condition, J
SNAJ 168 (1990).
"""

from __future__ import annotations

import math
from typing import NamedTuple, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Kilograms, Metres
from residnet.physics.parameters import Density, SquareMetres

_WAKE_SLOPE = 2.0
# keeps the drift angle defined for a ship at rest; (m/s)^2
_STILL = 1e-6


class MMGHull(Config):
    """Particulars of the hull; the body's origin is amidships, where u and v are measured.

    Attributes:
        length: between perpendiculars.
        beam: of the hull in m.
        draught: of the hull in m.
        mass: of the displaced water.
        gyration: radius of gyration about the centre of gravity, as a share of the length.
        x_G: centre of gravity ahead of midship.
        density: of the water.
    """

    length: Metres = Field(gt=0)
    beam: Metres = Field(gt=0)
    draught: Metres = Field(gt=0)
    mass: Kilograms = Field(gt=0)
    gyration: float = Field(default=0.25, gt=0, lt=1)
    x_G: Metres = 0.0
    density: Density = Field(default=1000.0, gt=0)

    @property
    def block(self) -> float:
        """The block coefficient, dimensionless."""
        return self.mass / (self.density * self.length * self.beam * self.draught)


class MMGPropeller(Config):
    """A propeller that turns ahead.

    Attributes:
        diameter: of it.
        x: its place ahead of midship, as a share of the length.
        thrust: K_T = k_0 + k_1 J + k_2 J^2 in open water.
    """

    diameter: Metres = Field(gt=0)
    x: float = -0.48
    thrust: tuple[float, float, float]


class MMGRudder(Config):
    """A rudder in the propeller's race.

    Attributes:
        area: of the movable part.
        aspect: span squared over area.
        x: its place ahead of midship, as a share of the length.
        race: share of its span that stands in the race, diameter over span.
    """

    area: SquareMetres = Field(gt=0)
    aspect: float = Field(gt=0)
    x: float = -0.5
    race: float = Field(gt=0, le=1)

    @property
    def lift(self) -> float:
        """The slope of the normal force by Fujii's formula, dimensionless."""
        return 6.13 * self.aspect / (2.25 + self.aspect)


class Prior(NamedTuple):
    """What is believed of a parameter before any trial: mean, standard deviation and meaning."""

    mean: float
    sd: float
    meaning: str


def usual_priors(hull: MMGHull) -> dict[str, Prior]:
    """Return the prior of every parameter, as one would expect of a merchant ship of this form.

    Linear hull derivatives by Kijima's formulas; those of higher order are thought to be near zero,
    so that the trials speak for themselves.
    """
    k = 2.0 * hull.draught / hull.length
    fullness = hull.block * hull.beam / hull.length
    mass = 2.0 * hull.mass / (hull.density * hull.length**2 * hull.draught)
    return {
        "m_x": Prior(0.022, 0.01, "added mass in surge"),
        "m_y": Prior(0.2, 0.06, "added mass in sway"),
        "J_z": Prior(0.011, 0.004, "added moment of inertia in yaw"),
        "R_0": Prior(0.02, 0.01, "resistance straight ahead"),
        "X_vv": Prior(0.0, 0.1, "surge force of drift"),
        "X_vr": Prior(0.0, 0.1, "surge force of drift in a turn, beyond the added mass's"),
        "X_rr": Prior(0.0, 0.03, "surge force of turning"),
        "X_vvvv": Prior(0.5, 0.5, "surge force of large drift"),
        "Y_0": Prior(0.0, 0.005, "sway force of asymmetry"),
        "Y_v": Prior(-(0.5 * math.pi * k + 1.4 * fullness), 0.15, "sway force of drift"),
        "Y_r": Prior(mass + 0.022 - 1.5 * fullness, 0.06, "sway force of turning"),
        "Y_vvv": Prior(-1.0, 1.0, "sway force of large drift"),
        "Y_vvr": Prior(0.0, 0.8, "sway force of large drift and turning"),
        "Y_vrr": Prior(0.0, 0.5, "sway force of drift and fast turning"),
        "Y_rrr": Prior(0.0, 0.05, "sway force of fast turning"),
        "N_0": Prior(0.0, 0.002, "yaw moment of asymmetry"),
        "N_v": Prior(-k, 0.05, "yaw moment of drift"),
        "N_r": Prior(-0.54 * k + k * k, 0.02, "yaw moment of turning"),
        "N_vvv": Prior(0.0, 0.3, "yaw moment of large drift"),
        "N_vvr": Prior(0.0, 0.3, "yaw moment of large drift and turning"),
        "N_vrr": Prior(0.0, 0.1, "yaw moment of drift and fast turning"),
        "N_rrr": Prior(0.0, 0.02, "yaw moment of fast turning"),
        "t_P": Prior(0.22, 0.03, "thrust deduction"),
        "w_P0": Prior(0.4, 0.06, "wake fraction straight ahead"),
        "C_2p": Prior(
            1.3,
            0.25,
            "inflow far aside over inflow straight ahead, drift towards port or turn to starboard",
        ),
        "C_2n": Prior(1.1, 0.25, "the same, drift towards starboard or turn to port"),
        "t_R": Prior(0.35, 0.15, "steering resistance deduction"),
        "a_H": Prior(0.3, 0.2, "sway force that the rudder raises on the hull, over its own"),
        "x_H": Prior(-0.45, 0.1, "where that force acts, lengths ahead of midship"),
        "gamma_p": Prior(0.5, 0.2, "flow straightening, inflow from port"),
        "gamma_n": Prior(0.5, 0.2, "flow straightening, inflow from starboard"),
        "l_R": Prior(-0.8, 0.3, "where the rudder feels the turning, lengths ahead of midship"),
        "epsilon": Prior(1.05, 0.2, "wake at the propeller over wake at the rudder"),
        "kappa": Prior(0.5, 0.1, "how much of the race's acceleration reaches the rudder"),
    }


PARAMETERS = tuple(usual_priors(MMGHull(length=1.0, beam=0.2, draught=0.1, mass=10.0)))
"""Names of the parameters, in the order of the columns of theta."""


@final
class MMGForces(nn.Module):
    """The accelerations of the ship.

    Holds ahead, propeller turning ahead. Hull forces are divided by rho/2 L d U^2, moments by rho/2
    L^2 d U^2, with v' = v/U and r' = r L/U.

    Args:
        hull, propeller, rudder: particulars.
        columns: of u, v, r, propeller revolutions and rudder angle among the channels z.
    """

    def __init__(
        self,
        hull: MMGHull,
        propeller: MMGPropeller,
        rudder: MMGRudder,
        columns: tuple[int, int, int, int, int],
    ) -> None:
        super().__init__()
        self.columns = list(columns)
        self.wake_slope, self.still = _WAKE_SLOPE, _STILL
        self.length = float(hull.length)
        self.pressed = 0.5 * hull.density * hull.length * hull.draught
        self.mass, self.x_G = float(hull.mass), float(hull.x_G)
        self.inertia = hull.mass * ((hull.gyration * hull.length) ** 2 + hull.x_G**2)
        self.density, self.diameter, self.x_P = (
            float(hull.density),
            float(propeller.diameter),
            propeller.x,
        )
        self.k0, self.k1, self.k2 = propeller.thrust
        self.area, self.lift, self.x_R, self.race = (
            float(rudder.area),
            rudder.lift,
            rudder.x,
            rudder.race,
        )

    def forward(self, z: Tensor, theta: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz] with parameters theta [..., 34].

        The order of the parameters is that of `PARAMETERS`.
        """
        m_x, m_y, J_z = theta[..., 0], theta[..., 1], theta[..., 2]
        chosen = [z[..., c] for c in self.columns]
        u, v, r, n, delta = chosen[0], chosen[1], chosen[2], chosen[3], chosen[4]
        speed = torch.sqrt(u * u + v * v + self.still)
        a, b = v / speed, r * self.length / speed
        x_hull, y_hull, n_hull = self._hull(theta, u, speed, a, b)
        inflow, loading, x_propeller = self._propeller(theta, u, n, a, b)
        x_rudder, y_rudder, n_rudder = self._rudder(theta, speed, a, b, delta, inflow, loading)
        # rigid body and added mass
        scale = self.pressed * self.length
        mass_x, mass_y = self.mass + m_x * scale, self.mass + m_y * scale
        inertia = self.inertia + J_z * scale * self.length**2
        arm = self.x_G * self.mass
        surge = x_hull + x_propeller + x_rudder + mass_y * v * r + arm * r * r
        sway = y_hull + y_rudder - mass_x * u * r
        yaw = n_hull + n_rudder - arm * u * r
        determinant = mass_y * inertia - arm * arm
        return torch.stack(
            (
                surge / mass_x,
                (inertia * sway - arm * yaw) / determinant,
                (mass_y * yaw - arm * sway) / determinant,
            ),
            dim=-1,
        )

    def _hull(
        self, theta: Tensor, u: Tensor, speed: Tensor, a: Tensor, b: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return X, Y [N] and N [N m] of the hull at v' = a and r' = b, each [...]."""
        (
            R_0, X_vv, X_vr, X_rr, X_vvvv, Y_0, Y_v, Y_r, Y_vvv, Y_vvr, Y_vrr, Y_rrr,
            N_0, N_v, N_r, N_vvv, N_vvr, N_vrr, N_rrr,
        ) = theta[..., 3:22].unbind(-1)  # fmt: skip
        pressure = self.pressed * speed * speed
        x_hull = pressure * (
            -R_0 * (u / speed) ** 2 + X_vv * a * a + X_vr * a * b + X_rr * b * b + X_vvvv * a**4
        )
        y_hull = pressure * (
            Y_0
            + Y_v * a
            + Y_r * b
            + Y_vvv * a**3
            + Y_vvr * a * a * b
            + Y_vrr * a * b * b
            + Y_rrr * b**3
        )
        n_hull = (
            N_0
            + N_v * a
            + N_r * b
            + N_vvv * a**3
            + N_vvr * a * a * b
            + N_vrr * a * b * b
            + N_rrr * b**3
        )
        return x_hull, y_hull, pressure * self.length * n_hull

    def _propeller(
        self, theta: Tensor, u: Tensor, n: Tensor, a: Tensor, b: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return inflow [m/s], loading n^2 D^2 K_T [m^2/s^2] and X [N] of the propeller."""
        t_P, w_P0, C_2p, C_2n = theta[..., 22:26].unbind(-1)
        # the inflow changes with the propeller's drift angle, to both sides differently
        aside = -a - self.x_P * b
        side = torch.where(aside > 0, C_2p, C_2n)
        inflow = u * (1 - w_P0) * (1 + (1 - torch.exp(-self.wake_slope * aside.abs())) * (side - 1))
        nd = n * self.diameter
        loading = self.k0 * nd * nd + self.k1 * nd * inflow + self.k2 * inflow * inflow
        thrust = self.density * self.diameter**2 * loading
        return inflow, loading, (1 - t_P) * thrust

    def _rudder(
        self,
        theta: Tensor,
        speed: Tensor,
        a: Tensor,
        b: Tensor,
        delta: Tensor,
        inflow: Tensor,
        loading: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return X, Y [N] and N [N m] of the rudder, partly in the propeller's race."""
        t_R, a_H, x_H, gamma_p, gamma_n, l_R, epsilon, kappa = theta[..., 26:34].unbind(-1)
        raced = torch.sqrt(torch.clamp(inflow * inflow + 8.0 / math.pi * loading, min=self.still))
        squared = (
            self.race * (inflow + kappa * (raced - inflow)) ** 2 + (1 - self.race) * inflow * inflow
        )
        along = epsilon * torch.sqrt(squared + self.still)
        cross = -a - l_R * b
        across = speed * torch.where(cross > 0, gamma_p, gamma_n) * cross
        angle = delta - torch.atan2(across, along)
        normal = (
            0.5
            * self.density
            * self.area
            * (along * along + across * across)
            * self.lift
            * torch.sin(angle)
        )
        return (
            -(1 - t_R) * normal * torch.sin(delta),
            -(1 + a_H) * normal * torch.cos(delta),
            -(self.x_R + a_H * x_H) * self.length * normal * torch.cos(delta),
        )
