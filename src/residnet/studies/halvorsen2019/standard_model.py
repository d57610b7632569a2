"""The standard model of Halvorsen 2019 and its fit to accelerations (section 7.5.1).

M nu_dot + C(nu) nu + D(nu) nu = tau with a known mass: appendix C.2, (9.4)-(9.9), with the
missing values and signs of H17 to H21 in docs/documents/corrections.md. The document counts 14
unknown parameters and lists 13; the fourteenth is N_v of (9.8), which its table lacks (correction
H20). The centre of gravity is amidships (x_g of (9.6) is not in the table either).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.physics.hull import AccelerationHullConfig, coefficient_rows
from residnet.regression.equation_rows import effective_correlation_length
from residnet.studies import load_published

_RANK_TOLERANCE = 1e-6
"""Singular values below this share of the largest belong to undetermined directions."""
_MIN_DETERMINANT = 1e-3
"""Smallest determinant of the sway and yaw inertia, relative to the product of typical values."""
_MAX_OPEN_COMPONENT = 0.1
"""A parameter with a larger component in an undetermined direction counts as undetermined."""
_MAX_OPEN_COMBINATION = 1e-3
"""A combination with a larger share in undetermined directions has no standard error."""


_MASS = 5e3
"""Typical mass in kg, the scale of the parameters with this unit."""
_INERTIA = 2e4
"""Typical moment of inertia in kg m^2, the scale of the parameters with this unit."""
PARAMETERS: dict[str, tuple[float, float, float]] = {
    "I_z": (1e3, 1e7, _INERTIA),
    "X_udot": (-1e6, 0.0, _MASS),
    "Y_vdot": (-1e6, 0.0, _MASS),
    "Y_rdot": (-1e6, 1e6, _INERTIA),
    "N_vdot": (-1e7, 1e7, _INERTIA),
    "N_rdot": (-1e7, 0.0, _INERTIA),
    "X_u": (-1e5, 0.0, 500.0),
    "Y_v": (-1e6, 0.0, 500.0),
    "Y_r": (-1e6, 1e6, 2e3),
    "N_v": (-1e6, 1e6, 2e3),
    "N_r": (-1e6, 0.0, 2e3),
    "X_|u|u": (-1e5, 0.0, 250.0),
    "Y_|v|v": (-1e6, 0.0, 2e3),
    "N_|r|r": (-1e7, 0.0, 3e3),
}
"""Lower bound, upper bound and typical size in SI units by name.

Initial values are in published.yaml.
"""
STANDARD_PARAMETER_NAMES = tuple(PARAMETERS)
LOWER, UPPER, SCALE = np.array(list(PARAMETERS.values())).T
INERTIA_SUMS: dict[str, tuple[float, dict[str, float]]] = {
    "m - X_udot": (1.0, {"X_udot": -1.0}),
    "m - Y_vdot": (1.0, {"Y_vdot": -1.0}),
    "I_z - N_rdot": (0.0, {"I_z": 1.0, "N_rdot": -1.0}),
}
"""Inertias as the equations contain them: factors of the mass and of parameters."""


def inertia_sums(values: Mapping[str, float], mass: float) -> dict[str, float]:
    """Return the inertias as the equations contain them, from parameters by name."""
    return {
        name: mass_factor * mass
        + sum(factor * values[parameter] for parameter, factor in parameter_factors.items())
        for name, (mass_factor, parameter_factors) in INERTIA_SUMS.items()
    }


class StandardFitConfig(Config):
    """Bounded weighted nonlinear least squares (7.9) by the trust-region reflective method.

    Attributes:
        mass: known mass in kg.
        weights: weights W_0, W_1, W_2 of the squared errors of u_dot, v_dot and r_dot; 1, 1, 10 in
            the document.
        starts: number of starting points: the document's original values, and random ones around
            them within the bounds.
        seed: seed of the random starting points.
        thin: stride of the samples that are used in the fit.
    """

    mass: float = Field(default=4935.14, gt=0)
    weights: tuple[float, float, float] = (1.0, 1.0, 10.0)
    starts: int = Field(default=4, ge=1, le=10_000)
    seed: int = Field(default=0, ge=0)
    thin: int = Field(default=2, ge=1)

    @model_validator(mode="after")
    def _check_weights(self) -> StandardFitConfig:
        if min(self.weights) <= 0:
            raise ValueError(f"weights: all must be positive, given {list(self.weights)}")
        return self

    def starting_points(self) -> list[np.ndarray]:
        """Return the starting points [14] of the searches, inside the bounds."""
        generator = np.random.default_rng([self.seed, 14])
        start = np.array(
            [load_published("halvorsen2019")["start"][name] for name in STANDARD_PARAMETER_NAMES]
        )
        bound_margin = 1e-9 * (UPPER - LOWER)
        points = [
            start,
            *(start + SCALE * generator.normal(size=len(start)) for _ in range(self.starts - 1)),
        ]
        return [np.clip(values, LOWER + bound_margin, UPPER - bound_margin) for values in points]


def standard_accelerations(
    p: np.ndarray, mass: float, nu: np.ndarray, tau: np.ndarray
) -> np.ndarray:
    """Return nu_dot = M^-1 (tau - C nu - D nu), [N, 3].

    M_A(3,2) = -N_vdot, M_A(3,3) = -N_rdot, C is skew-symmetric and D = -diag(...), which the
    document misprints (H1, H4, H18, H19 in docs/documents/corrections.md).

    Args:
        p: parameters [14] in SI units, in the order of `STANDARD_PARAMETER_NAMES`.
        mass: known mass in kg.
        nu: velocities u, v, r [N, 3].
        tau: forces [N, 3] in N, N, N m.
    """
    i_z, x_udot, y_vdot, y_rdot, n_vdot, n_rdot, x_u, y_v, y_r, n_v, n_r, x_uu, y_vv, n_rr = p
    u, v, r = nu.T
    sway_momentum = (mass - y_vdot) * v - y_rdot * r
    surge_momentum = (mass - x_udot) * u
    x = tau[:, 0] + sway_momentum * r + (x_u + x_uu * np.abs(u)) * u
    y = tau[:, 1] - surge_momentum * r + (y_v + y_vv * np.abs(v)) * v + y_r * r
    n = tau[:, 2] - sway_momentum * u + surge_momentum * v + n_v * v + (n_r + n_rr * np.abs(r)) * r
    sway_inertia = mass - y_vdot
    yaw_inertia = i_z - n_rdot
    # a lower limit keeps the search finite when it passes a singular mass matrix
    determinant = max(
        sway_inertia * yaw_inertia - y_rdot * n_vdot, _MIN_DETERMINANT * mass * _INERTIA
    )
    return np.stack(
        (
            x / (mass - x_udot),
            (yaw_inertia * y + y_rdot * n) / determinant,
            (sway_inertia * n + n_vdot * y) / determinant,
        ),
        axis=1,
    )


def fit_standard_model(
    nu: np.ndarray, tau: np.ndarray, nu_dot: np.ndarray, config: StandardFitConfig
) -> dict[str, Any]:
    """Fit the parameters by weighted least squares.

    Standard errors come from a sandwich estimator: each axis has its own noise, correlated in time.

    Args:
        nu: velocities [N, 3].
        tau: forces [N, 3] in N, N, N m.
        nu_dot: accelerations [N, 3].

    Returns:
        The fit as in study.json. By name `values` and `standard_errors` (None in undetermined
        directions) of the parameters in SI units, and `inertia_sums`, pairs of estimate and
        standard error of the inertias; names of parameters that are `undetermined` except in
        combinations, or end `at_bound`; `condition`, the condition number of the scaled Jacobian
        without the undetermined directions; `cost`, half the weighted sum of squared errors of each
        starting point, in ascending order.

    Raises:
        FitError: if there are fewer samples than parameters, or no start gives finite errors.
    """
    from scipy.optimize import least_squares

    nu = nu[:: config.thin]
    tau = tau[:: config.thin]
    nu_dot = nu_dot[:: config.thin]
    if 3 * len(nu) <= len(STANDARD_PARAMETER_NAMES):
        raise FitError(
            f"the standard model's {len(STANDARD_PARAMETER_NAMES)} parameters need more than"
            f" {len(nu)} samples; give a"
            " longer trial"
        )
    root_weights = np.sqrt(config.weights)

    def weighted_errors(p: np.ndarray) -> np.ndarray:
        return np.asarray(
            (
                (nu_dot - standard_accelerations(p * SCALE, config.mass, nu, tau)) * root_weights
            ).ravel()
        )

    solutions = [
        least_squares(
            weighted_errors,
            p / SCALE,
            jac="3-point",
            bounds=(LOWER / SCALE, UPPER / SCALE),
            method="trf",
        )
        for p in config.starting_points()
    ]
    best_solution = min(solutions, key=lambda answer: float(answer.cost))
    if not np.isfinite(best_solution.cost):
        raise FitError("the fit of the standard model has no finite error")
    values = best_solution.x * SCALE
    is_at_bound = np.minimum(values - LOWER, UPPER - values) <= 1e-6 * SCALE
    # identifiability is assessed without the bounds, since an active bound fixes a parameter that
    # the data do not determine
    jacobian = np.asarray(best_solution.jac)
    errors = best_solution.fun.reshape(-1, 3)
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    is_determined = singular > _RANK_TOLERANCE * singular[0]
    open_directions = directions[~is_determined].T
    noise = np.square(errors).mean(axis=0) * effective_correlation_length(errors)
    free_jacobian = jacobian[:, ~is_at_bound]
    bread = np.linalg.pinv(
        free_jacobian.T @ free_jacobian, rcond=_RANK_TOLERANCE**2, hermitian=True
    )
    meat = sum(noise[k] * free_jacobian[k::3].T @ free_jacobian[k::3] for k in range(3))
    covariance = np.zeros((len(STANDARD_PARAMETER_NAMES), len(STANDARD_PARAMETER_NAMES)))
    covariance[np.ix_(~is_at_bound, ~is_at_bound)] = bread @ meat @ bread

    def sum_standard_error(factors: Mapping[str, float]) -> float | None:
        """Return the standard error of a sum of parameters; None if undetermined."""
        combination = (
            np.array([factors.get(name, 0.0) for name in STANDARD_PARAMETER_NAMES]) * SCALE
        )
        if np.linalg.norm(open_directions.T @ combination) > _MAX_OPEN_COMBINATION * np.linalg.norm(
            combination
        ):
            return None
        return float(np.sqrt(max(combination @ covariance @ combination, 0.0)))

    estimates = dict(zip(STANDARD_PARAMETER_NAMES, values.tolist(), strict=True))
    open_components = np.abs(open_directions).max(axis=1, initial=0.0)
    return {
        "values": estimates,
        "standard_errors": {
            name: sum_standard_error({name: 1.0}) for name in STANDARD_PARAMETER_NAMES
        },
        "sums": {
            name: [estimate, sum_standard_error(INERTIA_SUMS[name][1])]
            for name, estimate in inertia_sums(estimates, config.mass).items()
        },
        "undetermined": [
            STANDARD_PARAMETER_NAMES[i]
            for i in np.flatnonzero(open_components > _MAX_OPEN_COMPONENT)
        ],
        "at_bound": [STANDARD_PARAMETER_NAMES[i] for i in np.flatnonzero(is_at_bound)],
        "condition": float(singular[0] / singular[is_determined][-1]),
        "cost": sorted(float(solution.cost) for solution in solutions),
    }


def true_parameters(vessel: AccelerationHullConfig, mass: float) -> dict[str, float]:
    """Return the true parameters of a vessel whose accelerations are known as terms.

    Terms that are not in the standard model are ignored. The result is exact for a vessel
    without added mass and with the Coriolis terms v r and -u r, as in Halvorsen 2019.
    """
    gain = [1.0 / parameter.value for parameter in (vessel.gains.x, vessel.gains.y, vessel.gains.n)]
    acceleration_terms = coefficient_rows(vessel.terms)
    term_of_parameter = {
        "X_u": (0, "u"),
        "Y_v": (1, "v"),
        "Y_r": (1, "r"),
        "N_v": (2, "v"),
        "N_r": (2, "r"),
    }
    term_of_parameter |= {"X_|u|u": (0, "u|u|"), "Y_|v|v": (1, "v|v|"), "N_|r|r": (2, "r|r|")}
    parameters = dict.fromkeys(STANDARD_PARAMETER_NAMES, 0.0) | {
        name: gain[axis] * acceleration_terms[axis].get(term, 0.0)
        for name, (axis, term) in term_of_parameter.items()
    }
    return parameters | {"I_z": gain[2], "X_udot": mass - gain[0], "Y_vdot": mass - gain[1]}
