"""The standard model of document 000 (appendix C.2, (9.4)-(9.9), ERRATA H17-H21) and its fit to
accelerations (section 7.5.1).

M nu_dot + C(nu) nu + D(nu) nu = tau with a known mass. The document counts 14 parameters to find
and lists 13 beside the mass; the fourteenth is N_v of (9.8), which its table lacks (ERRATA H20).
The centre of gravity is amidships (x_g of (9.6) is not in the table either).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.core.names import nearest
from residnet.physics.odin import OdinConfig
from residnet.regression.equation_rows import correlation_time

_RANK = 1e-6
"""Singular values of the scaled Jacobian below this share of the largest belong to directions that
the data do not determine.
"""
_LEAST = 1e-3
"""Share of the known inertias squared that the determinant of sway and yaw is kept above."""


class Entry(NamedTuple):
    """A parameter: value before the fit (C.2, N_v by ERRATA H20), bounds, a typical size, and the
    value that the document found.
    """

    start: float
    low: float
    high: float
    scale: float
    published: float | None


_MASS, _INERTIA = 5e3, 2e4
PARAMETERS: dict[str, Entry] = {
    "I_z": Entry(2.09e4, 1e3, 1e7, _INERTIA, 1.57e6),
    "X_udot": Entry(0.0, -1e6, 0.0, _MASS, -4.47e4),
    "Y_vdot": Entry(0.0, -1e6, 0.0, _MASS, -7.18e4),
    "Y_rdot": Entry(0.0, -1e6, 1e6, _INERTIA, -0.256),
    "N_vdot": Entry(0.0, -1e7, 1e7, _INERTIA, -1.28e6),
    "N_rdot": Entry(0.0, -1e7, 0.0, _INERTIA, -2.67e6),
    "X_u": Entry(-50.0, -1e5, 0.0, 500.0, -239.71),
    "Y_v": Entry(-200.0, -1e6, 0.0, 500.0, -1.32e4),
    "Y_r": Entry(0.0, -1e6, 1e6, 2e3, -2.38e5),
    "N_v": Entry(-1281.0, -1e6, 1e6, 2e3, None),
    "N_r": Entry(-1281.0, -1e6, 0.0, 2e3, -194.30),
    "X_|u|u": Entry(-243.0, -1e5, 0.0, 250.0, -9.0),
    "Y_|v|v": Entry(-2000.0, -1e6, 0.0, 2e3, -3.45e4),
    "N_|r|r": Entry(-2975.44, -1e7, 0.0, 3e3, -1.58e5),
}
NAMES = tuple(PARAMETERS)
SUMS: dict[str, tuple[str, float, str]] = {
    "m - X_udot": ("X_udot", -1.0, ""),
    "m - Y_vdot": ("Y_vdot", -1.0, ""),
    "I_z - N_rdot": ("I_z", 1.0, "N_rdot"),
}
"""What the equations contain of the inertias: a parameter with its sign, minus another or plus the
mass.
"""


class StandardFitConfig(Config):
    """Bounded weighted nonlinear least squares (7.9) by the trust-region reflective method.

    Attributes:
        mass: known, kg.
        weights: W_0, W_1, W_2 of the squared errors of u_dot, v_dot, r_dot; the document's are 1,
            1, 10.
        bounds: lowest and highest values by parameter, SI, instead of the built-in ones.
        starts: the document's original values, then this many less one random ones around them
            within the bounds.
        seed: of these.
        thin: every so manieth sample is fitted.
    """

    mass: float = Field(default=4935.14, gt=0)
    weights: tuple[float, float, float] = (1.0, 1.0, 10.0)
    bounds: dict[str, tuple[float, float]] = Field(default_factory=dict)
    starts: int = Field(default=4, ge=1)
    seed: int = Field(default=0, ge=0)
    thin: int = Field(default=2, ge=1)

    @model_validator(mode="after")
    def _known(self) -> StandardFitConfig:
        if min(self.weights) <= 0:
            raise ValueError(f"weights: all must be positive, given {list(self.weights)}")
        for name, (low, high) in self.bounds.items():
            if name not in PARAMETERS:
                raise ValueError(f"bounds: no parameter '{name}'{nearest(name, NAMES)}")
            if low >= high:
                raise ValueError(f"bounds.{name}: expected the lower first, given {[low, high]}")
        return self

    def limits(self) -> np.ndarray:
        """Bounds [14, 2]."""
        return np.array(
            [self.bounds.get(name, (entry.low, entry.high)) for name, entry in PARAMETERS.items()]
        )

    def begins(self) -> list[np.ndarray]:
        """Values [14] that searches start from, inside the bounds."""
        random, limits = np.random.default_rng([self.seed, 14]), self.limits()
        start, scale = (
            np.array([getattr(entry, key) for entry in PARAMETERS.values()])
            for key in ("start", "scale")
        )
        inside = 1e-9 * (limits[:, 1] - limits[:, 0])
        tried = [
            start,
            *(start + scale * random.normal(size=len(start)) for _ in range(self.starts - 1)),
        ]
        return [np.clip(values, limits[:, 0] + inside, limits[:, 1] - inside) for values in tried]


@dataclass(frozen=True)
class StandardFit:
    """A fit.

    Attributes:
        values: [14], SI.
        errors: standard errors [14]; infinite in directions that the data do not determine.
        sums: estimate and standard error of what the equations contain of the inertias, by name.
        undetermined: names of the parameters that only combinations of are determined.
        bound: names of those that end on a bound.
        condition: of the scaled Jacobian, without the undetermined directions.
        cost: half the weighted sum of squared errors; of every start.
        mass: kg.
    """

    values: np.ndarray
    errors: np.ndarray
    sums: dict[str, tuple[float, float]]
    undetermined: tuple[str, ...]
    bound: tuple[str, ...]
    condition: float
    cost: tuple[float, ...]
    mass: float

    def accelerations(self, nu: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """nu_dot [N, 3] from velocities [N, 3] and forces [N, 3]."""
        return accelerations(self.values, self.mass, nu, tau)


def accelerations(p: np.ndarray, mass: float, nu: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """nu_dot = M^-1 (tau - C nu - D nu), [N, 3], with parameters [14] in the order of `PARAMETERS`,
    kg, m, s, rad.

    M_A(3,2) = -N_vdot and M_A(3,3) = -N_rdot (ERRATA H18), C skew (H4, H19), D = -diag(...) (H1).
    """
    i_z, x_udot, y_vdot, y_rdot, n_vdot, n_rdot, x_u, y_v, y_r, n_v, n_r, x_uu, y_vv, n_rr = p
    u, v, r = nu.T
    sway, yaw = (mass - y_vdot) * v - y_rdot * r, (mass - x_udot) * u
    x = tau[:, 0] + sway * r + (x_u + x_uu * np.abs(u)) * u
    y = tau[:, 1] - yaw * r + (y_v + y_vv * np.abs(v)) * v + y_r * r
    n = tau[:, 2] - sway * u + yaw * v + n_v * v + (n_r + n_rr * np.abs(r)) * r
    across, about = mass - y_vdot, i_z - n_rdot
    determinant = max(across * about - y_rdot * n_vdot, _LEAST * mass * _INERTIA)
    return np.stack(
        (
            x / (mass - x_udot),
            (about * y + y_rdot * n) / determinant,
            (across * n + n_vdot * y) / determinant,
        ),
        axis=1,
    )


def fit(
    nu: np.ndarray, tau: np.ndarray, nu_dot: np.ndarray, config: StandardFitConfig
) -> StandardFit:
    """The parameters of least weighted squared error.

    Args:
        nu: velocities [N, 3].
        tau: forces [N, 3].
        nu_dot: accelerations [N, 3].
        config: how.

    Raises:
        FitError: with fewer samples than parameters, or where no start leads to finite errors.
    """
    from scipy.optimize import least_squares

    nu, tau, nu_dot = nu[:: config.thin], tau[:: config.thin], nu_dot[:: config.thin]
    if 3 * len(nu) <= len(NAMES):
        raise FitError(
            f"the standard model's {len(NAMES)} parameters need more than {len(nu)} samples; give a"
            " longer trial"
        )
    root, limits = np.sqrt(config.weights), config.limits()
    scale = np.array([entry.scale for entry in PARAMETERS.values()])

    def left(p: np.ndarray) -> np.ndarray:
        return np.asarray(
            ((nu_dot - accelerations(p * scale, config.mass, nu, tau)) * root).ravel()
        )

    found = [
        least_squares(
            left, p / scale, jac="3-point", bounds=(limits / scale[:, None]).T, method="trf"
        )
        for p in config.begins()
    ]
    best = min(found, key=lambda answer: float(answer.cost))
    if not np.isfinite(best.cost):
        raise FitError("the standard model's fit does not stay finite; narrow `bounds`")
    values = best.x * scale
    near = np.minimum(values - limits[:, 0], limits[:, 1] - values) <= 1e-6 * scale
    free = ~near
    # bounds make directions definite that the data leave open: those are judged by the data alone
    told = _errors(np.asarray(best.jac), best.fun.reshape(-1, 3), free)
    sums = {}
    for name, (first, sign, second) in SUMS.items():
        along = np.zeros(len(NAMES))
        along[NAMES.index(first)] = sign * scale[NAMES.index(first)]
        if second:
            along[NAMES.index(second)] = -scale[NAMES.index(second)]
        sums[name] = (
            float(along @ best.x) + (0.0 if second else config.mass),
            _spread(told, along),
        )
    errors = np.array([_spread(told, scale[i] * np.eye(len(NAMES))[i]) for i in range(len(NAMES))])
    return StandardFit(
        values=values,
        errors=errors,
        sums=sums,
        undetermined=tuple(
            NAMES[i] for i in np.flatnonzero(np.abs(told.open).max(axis=1, initial=0.0) > 0.1)
        ),
        bound=tuple(NAMES[i] for i in np.flatnonzero(near)),
        condition=told.condition,
        cost=tuple(sorted(float(answer.cost) for answer in found)),
        mass=config.mass,
    )


class _Told(NamedTuple):
    """Covariance of the scaled parameters [14, 14], directions that the data leave open [14, k],
    and the condition of the rest.
    """

    covariance: np.ndarray
    open: np.ndarray
    condition: float


def _errors(jacobian: np.ndarray, left: np.ndarray, free: np.ndarray) -> _Told:
    """What the Jacobian [3 N, 14] of weighted errors [N, 3] says, each axis with its own noise and
    its memory (sandwich).
    """
    count = jacobian.shape[1]
    _, values, turned = np.linalg.svd(jacobian, full_matrices=False)
    kept = values > _RANK * values[0]
    noise = np.square(left).mean(axis=0) * correlation_time(left)
    own = jacobian[:, free]
    inverse = np.linalg.pinv(own.T @ own, rcond=_RANK**2, hermitian=True)
    middle = sum(noise[k] * own[k::3].T @ own[k::3] for k in range(3))
    covariance = np.zeros((count, count))
    covariance[np.ix_(free, free)] = inverse @ middle @ inverse
    return _Told(covariance, turned[~kept].T, float(values[0] / values[kept][-1]))


def _spread(told: _Told, along: np.ndarray) -> float:
    """Standard error of a combination of scaled parameters; infinite where it is left open."""
    if told.open.size and np.linalg.norm(told.open.T @ along) > 1e-3 * np.linalg.norm(along):
        return float("inf")
    return float(np.sqrt(max(along @ told.covariance @ along, 0.0)))


def truth(vessel: OdinConfig, mass: float) -> dict[str, float]:
    """The parameters of a vessel whose accelerations are known as terms; what it has beyond them is
    left out.

    Exact for a vessel without added mass and with Coriolis terms v r and -u r, as document 000 has
    it.
    """
    gain = [1.0 / parameter.value for parameter in (vessel.gains.x, vessel.gains.y, vessel.gains.n)]
    rows = [
        {term: parameter.value for term, parameter in row.items()} for row in vessel.terms.rows()
    ]
    of = {"X_u": (0, "u"), "Y_v": (1, "v"), "Y_r": (1, "r"), "N_v": (2, "v"), "N_r": (2, "r")}
    of |= {"X_|u|u": (0, "u|u|"), "Y_|v|v": (1, "v|v|"), "N_|r|r": (2, "r|r|")}
    out = dict.fromkeys(NAMES, 0.0) | {
        name: gain[axis] * rows[axis].get(term, 0.0) for name, (axis, term) in of.items()
    }
    return out | {"I_z": gain[2], "X_udot": mass - gain[0], "Y_vdot": mass - gain[1]}
