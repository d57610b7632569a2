"""The MMG standard model of a ship with one propeller and one rudder, identified from trials.

Hull, propeller and rudder stand apart, with what each does to the others.

Source: Yasukawa and Yoshimura, Introduction of MMG standard method for ship maneuvering
predictions, J Mar Sci Technol 20 (2015) 37-52. Starting values of the hull's linear derivatives:
Kijima et al., On the manoeuvring performance of a ship with the parameter of loading condition, J
SNAJ 168 (1990).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Literal, NamedTuple, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.baselines.base import (
    Baseline,
    IdentifiedConfig,
    ParametricBaseline,
    of_manoeuvres,
    require,
)
from residnet.core.config import Config, Kilograms, Metres
from residnet.core.errors import FitError
from residnet.core.names import VELOCITY, nearest
from residnet.core.samples import Samples
from residnet.physics.parameters import Density, SquareMetres
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.least_squares import descend

_WAKE_SLOPE = 2.0
"""C_1 of the wake in drift: that of the KVLCC2 in the source."""
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
        columns: of u, v, r, propeller revolutions and rudder angle among the channels z.
    """

    def __init__(
        self, hull: MMGHull, propeller: MMGPropeller, rudder: MMGRudder, columns: Sequence[int]
    ) -> None:
        super().__init__()
        self.columns = list(columns)
        self.wake_slope, self.still = _WAKE_SLOPE, _STILL
        self.length = float(hull.length)
        self.pressed = 0.5 * hull.density * hull.length * hull.draught
        self.mass, self.x_G = float(hull.mass), float(hull.x_G)
        self.inertia = hull.mass * ((hull.gyration * hull.length) ** 2 + hull.x_G**2)
        self.density, self.diameter = float(hull.density), float(propeller.diameter)
        self.k0, self.k1, self.k2 = propeller.thrust
        self.lifting = 0.5 * hull.density * rudder.area * rudder.lift
        self.x_P, self.x_R, self.race = propeller.x, rudder.x, rudder.race

    def forward(self, z: Tensor, theta: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz] with parameters theta [..., 34].

        The order of the parameters is that of `PARAMETERS`.
        """
        (
            m_x, m_y, J_z, R_0, X_vv, X_vr, X_rr, X_vvvv,
            Y_0, Y_v, Y_r, Y_vvv, Y_vvr, Y_vrr, Y_rrr, N_0, N_v, N_r, N_vvv, N_vvr, N_vrr, N_rrr,
            t_P, w_P0, C_2p, C_2n, t_R, a_H, x_H, gamma_p, gamma_n, l_R, epsilon, kappa,
        ) = theta.unbind(-1)  # fmt: skip
        chosen = [z[..., c] for c in self.columns]
        u, v, r, n, delta = chosen[0], chosen[1], chosen[2], chosen[3], chosen[4]
        speed = torch.sqrt(u * u + v * v + self.still)
        a, b = v / speed, r * self.length / speed
        # hull
        pressure = self.pressed * speed * speed
        x_hull = (
            -R_0 * (u / speed) ** 2 + X_vv * a * a + X_vr * a * b + X_rr * b * b + X_vvvv * a**4
        )
        y_hull = (
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
        # propeller: the inflow changes with its drift angle, to both sides differently
        aside = -a - self.x_P * b
        side = torch.where(aside > 0, C_2p, C_2n)
        inflow = u * (1 - w_P0) * (1 + (1 - torch.exp(-self.wake_slope * aside.abs())) * (side - 1))
        nd = n * self.diameter
        loading = self.k0 * nd * nd + self.k1 * nd * inflow + self.k2 * inflow * inflow
        thrust = (1 - t_P) * self.density * self.diameter**2 * loading
        # rudder, partly in the propeller's race
        raced = torch.sqrt(torch.clamp(inflow * inflow + 8.0 / math.pi * loading, min=self.still))
        squared = (
            self.race * (inflow + kappa * (raced - inflow)) ** 2 + (1 - self.race) * inflow * inflow
        )
        along = epsilon * torch.sqrt(squared + self.still)
        cross = -a - l_R * b
        across = speed * torch.where(cross > 0, gamma_p, gamma_n) * cross
        angle = delta - torch.atan2(across, along)
        normal = self.lifting * (along * along + across * across) * torch.sin(angle)
        x_rudder = -(1 - t_R) * normal * torch.sin(delta)
        side_force = -normal * torch.cos(delta)
        # rigid body and added mass
        scale = self.pressed * self.length
        mass_x, mass_y = self.mass + m_x * scale, self.mass + m_y * scale
        inertia = self.inertia + J_z * scale * self.length**2
        arm = self.x_G * self.mass
        surge = pressure * x_hull + thrust + x_rudder + mass_y * v * r + arm * r * r
        sway = pressure * y_hull + (1 + a_H) * side_force - mass_x * u * r
        turning = (self.x_R + a_H * x_H) * self.length * side_force
        yaw = pressure * self.length * n_hull + turning - arm * u * r
        determinant = mass_y * inertia - arm * arm
        return torch.stack(
            (
                surge / mass_x,
                (inertia * sway - arm * yaw) / determinant,
                (mass_y * yaw - arm * sway) / determinant,
            ),
            dim=-1,
        )


_MOST_SAMPLES = 4000
"""Samples that accelerations are fitted to; more are thinned evenly."""
_MOST_STEPS = 20
"""Most steps of the search."""
_GAIN = 1e-9
"""Share of the logarithm of the likelihood that a step must gain for another one."""
# what can only be seen in the accelerations of one axis is listed under it
_AXIS = {"X": "u_dot", "R": "u_dot", "t": "u_dot", "Y": "v_dot", "N": "r_dot"}


@final
class MMGBaseline(ParametricBaseline):
    """The MMG model, nu_dot [..., 3], with parameters theta [34] as `PARAMETERS` names them."""

    def __init__(self, forces: MMGForces, priors: Iterable[Prior]) -> None:
        mean, sd, _ = zip(*priors, strict=True)
        super().__init__(torch.tensor(mean, dtype=torch.float64))
        self.forces, self.mean, self.sd = forces, list(mean), list(sd)

    def forward(self, z: Tensor) -> Tensor:
        nu_dot: Tensor = self.forces(z, self.theta.to(z.dtype))
        return nu_dot

    def parameter_count(self) -> list[float]:
        """Return the number of parameters that are not fixed, by the axis they are listed under.

        Those of propeller and rudder count in every axis.
        """
        free = [PARAMETERS[i] for i in self.free_indices().tolist()]
        return [
            float(sum(axis_of(name) in (f"{axis}_dot", "") for name in free)) for axis in VELOCITY
        ]

    def free_indices(self) -> Tensor:
        """Return the places [P] of the parameters whose prior is not fixed."""
        return torch.nonzero(torch.tensor(self.sd) > 0).squeeze(1)

    def free_names(self) -> list[tuple[str, str]]:
        """Return (axis, name) of each parameter whose prior is not fixed [P]."""
        return [(axis_of(PARAMETERS[i]), PARAMETERS[i]) for i in self.free_indices().tolist()]

    def information(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P].

        Each axis weighs by the variance that the present parameters leave of it.
        """
        part = _thinned(samples)
        with torch.no_grad():
            slopes, variance = (
                self.sensitivity(part.z),
                (part.target - self(part.z)).square().mean(0),
            )
        return torch.einsum("bip,biq,i->pq", slopes, slopes, 1.0 / variance) / len(part)

    def prior(self) -> tuple[Tensor, Tensor]:
        free = self.free_indices()
        return (
            torch.tensor(self.mean, dtype=torch.float64)[free],
            torch.tensor(self.sd, dtype=torch.float64)[free] ** -2,
        )

    def asymmetry(self, samples: Samples) -> Tensor:
        """Return zeros [P, P]: what is asymmetric here has a prior of its own."""
        count = self.free_indices().numel()
        return torch.zeros(count, count, dtype=torch.float64)

    def updated_table(self, table: Sequence[Coefficient], errors: Tensor) -> list[Coefficient]:
        known = dict(zip(self.free_indices().tolist(), errors.tolist(), strict=True))
        return [
            Coefficient(axis_of(name), name, float(self.theta[i]), known.get(i, 0.0))
            for i, name in enumerate(PARAMETERS)
        ]


def axis_of(name: str) -> str:
    """Return the acceleration that a parameter is listed under, empty where it acts on several."""
    return _AXIS.get(name.split("_")[0], "") if name != "t_R" else "u_dot"


def _thinned(samples: Samples) -> Samples:
    keep = torch.zeros(len(samples), dtype=torch.bool)
    keep[:: max(len(samples) // _MOST_SAMPLES, 1)] = True
    return samples.where(keep)


class MMGConfig(IdentifiedConfig):
    """The MMG standard model of a ship with one propeller and one rudder.

    It is that of Yasukawa and Yoshimura (2015). Every parameter has a prior, a mean and a standard
    deviation; usual values stand in for those that are not given. The trials move the parameters as
    far as they tell, first through accelerations, then, with a `refit` of this baseline, through
    free runs, which also gives the standard errors that intervals of predictions come from.

    Attributes:
        hull: particulars of the hull.
        propeller: particulars of the propeller.
        rudder: particulars of the rudder.
        beliefs: prior mean and standard deviation by parameter (non-dimensional, as the model has
            them), where not the usual ones; a standard deviation of 0 fixes it.
        revolutions: channel of the propeller's revolutions, 1/s.
        angle: channel of the rudder's angle, rad, positive to starboard.
        correlation: number of successive samples of accelerations that tell as much as one alone.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    kind: Literal["mmg"] = "mmg"
    hull: MMGHull
    propeller: MMGPropeller
    rudder: MMGRudder
    beliefs: dict[str, tuple[float, Annotated[float, Field(ge=0)]]] = Field(default_factory=dict)
    revolutions: str = "n"
    angle: str = "delta"
    correlation: int = Field(default=100, ge=1, le=100_000)
    manoeuvres: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _known(self) -> MMGConfig:
        for name in self.beliefs:
            if name not in PARAMETERS:
                raise ValueError(f"beliefs: no parameter '{name}'{nearest(name, PARAMETERS)}")
        return self

    def build(self, names: Sequence[str]) -> MMGBaseline:
        """Return the module with every parameter at its prior mean, for channels `names`."""
        wanted = (*VELOCITY, self.revolutions, self.angle)
        require(names, wanted, "the baseline 'mmg'")
        columns = [list(names).index(name) for name in wanted]
        given = {name: Prior(*belief, "") for name, belief in self.beliefs.items()}
        priors = (usual_priors(self.hull) | given).values()
        return MMGBaseline(MMGForces(self.hull, self.propeller, self.rudder, columns), priors)

    def require_samples(self, samples: Samples) -> None:
        of_manoeuvres(samples, self.manoeuvres)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the most likely parameters given accelerations and priors, by Gauss-Newton.

        Raises:
            FitError: where the accelerations at the prior means are not finite.
        """
        assert isinstance(baseline, MMGBaseline)
        picked = of_manoeuvres(samples, self.manoeuvres)
        chosen, count = _thinned(picked), len(picked) / self.correlation
        free, (mean, precision) = baseline.free_indices(), baseline.prior()

        def error(theta: Tensor) -> Tensor:
            baseline.theta[free] = theta
            known: Tensor = baseline(chosen.z)
            return chosen.target - known

        def cost(theta: Tensor) -> float:
            likelihood = 0.5 * count * error(theta).square().mean(0).log().sum()
            return float(likelihood + 0.5 * (precision * (theta - mean).square()).sum())

        def equations(theta: Tensor) -> tuple[Tensor, Tensor]:
            left = error(theta)
            weight = count / len(chosen) / left.square().mean(0)
            slopes = baseline.sensitivity(chosen.z)
            hessian = torch.einsum("bip,biq,i->pq", slopes, slopes, weight) + torch.diag(precision)
            gradient = torch.einsum("bip,bi,i->p", slopes, left, weight)
            return hessian, gradient + precision * (mean - theta)

        def near(theta: Tensor) -> tuple[float, Callable[[float], tuple[float, Tensor]]]:
            hessian, gradient = equations(theta)

            def trial(damping: float) -> tuple[float, Tensor]:
                damped = hessian + damping * torch.diag(hessian.diagonal())
                moved = theta + torch.linalg.solve(damped, gradient)
                return cost(moved), moved

            return cost(theta), trial

        if not torch.isfinite(error(mean)).all():
            raise FitError(
                "the MMG model's accelerations are not finite along the training logs; check"
                " hull, propeller and rudder, and units"
            )
        found = descend(mean, near, _MOST_STEPS, gain=_GAIN, damping=0.0).point
        errors = torch.linalg.inv(equations(found)[0]).diagonal().sqrt()
        theta = baseline.theta.detach().clone()
        return [Solution({}, {"theta": theta}, tuple(baseline.updated_table((), errors)))]
