"""Masses and damping of a baseline in the form M nu_dot + C(nu) nu + D nu + D_n |nu| nu = tau.

C is Fossen's skew form of M (Fossen 2011, section 6.3). What the baseline has beyond that form is
projected onto the damping over the training range, and the share that remains is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from residnet.baselines.believed import BelievedBaseline
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import UsageError
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.physics.signals import FORCE_CHANNELS

Matrix = npt.NDArray[np.float64]
_SAMPLES = 4000
# surge is damped by itself, sway and yaw by both
_DAMPED_BY = ((0,), (1, 2), (1, 2))


@dataclass(frozen=True)
class Coefficients:
    """A vessel in three degrees of freedom, SI.

    Attributes:
        mass: M [3, 3], rigid body and added mass together.
        linear: D [3, 3].
        quadratic: D_n [3, 3], of |nu| nu.
        left_out: share of the baseline's force that the form cannot hold, by axis.
        terms_left_out: terms of the baseline that the form has no place for, by axis.
    """

    mass: Matrix
    linear: Matrix
    quadratic: Matrix
    left_out: dict[str, float]
    terms_left_out: dict[str, list[str]]


def coriolis(mass: Matrix, nu: Matrix) -> Matrix:
    """Return C(nu) nu [N, 3] for velocities nu [N, 3]."""
    u, v, r = nu.T
    a = mass[1, 1] * v + 0.5 * (mass[1, 2] + mass[2, 1]) * r
    b = mass[0, 0] * u
    return np.stack((-a * r, b * r, a * u - b * v), axis=-1)


def coefficients(spec: ModelSpec, model: HybridDynamics) -> Coefficients:
    """Return the coefficients of a model's baseline.

    Raises:
        UsageError: where the baseline is no sum of terms of velocities and forces.
    """
    theta, terms = _linear(spec, model)
    forces = [terms.index(name) if name in terms else -1 for name in FORCE_CHANNELS]
    by_force = theta[:, forces] if min(forces) >= 0 else np.zeros((3, 3))
    if np.linalg.matrix_rank(by_force) < 3:
        missing = [name for name, at in zip(FORCE_CHANNELS, forces, strict=True) if at < 0]
        raise UsageError(
            f"model {spec.name}: its accelerations do not tell all masses"
            f" ({', '.join(missing) or 'the forces act alike'} is not among the baseline's terms);"
            " fit a baseline of kind believed, or one of regressors with tau_x, tau_y and tau_n"
        )
    mass: Matrix = np.linalg.inv(by_force).astype(np.float64)
    low, high = np.array(spec.low[:3]), np.array(spec.high[:3])
    nu = np.random.default_rng(0).uniform(low, high, (_SAMPLES, 3))
    z = np.zeros((_SAMPLES, len(model.signals.names)))
    z[:, :3] = nu
    with torch.no_grad():
        known = model.baseline(torch.from_numpy(z)).numpy()
    force = known @ mass.T
    rest = force + coriolis(mass, nu)
    linear, quadratic, left = np.zeros((3, 3)), np.zeros((3, 3)), {}
    for i, axis in enumerate(VELOCITY):
        by = _DAMPED_BY[i]
        basis = np.concatenate((nu[:, by], np.abs(nu[:, by]) * nu[:, by]), axis=1)
        found = -np.linalg.lstsq(basis, rest[:, i], rcond=None)[0]
        linear[i, by], quadratic[i, by] = found[: len(by)], found[len(by) :]
        remains = rest[:, i] + basis @ found
        left[axis] = float(np.sqrt(np.mean(remains**2) / max(np.mean(force[:, i] ** 2), 1e-30)))
    return Coefficients(mass, linear, quadratic, left, _unplaced(theta, terms))


def _linear(spec: ModelSpec, model: HybridDynamics) -> tuple[Matrix, list[str]]:
    """Return the coefficients [3, J] of the accelerations and the terms that they belong to."""
    baseline = model.baseline
    if isinstance(baseline, RegressorBaseline):
        theta = (baseline.theta * baseline.allowed).detach().double().numpy()
        return theta, list(baseline.library.terms)
    if isinstance(baseline, BelievedBaseline):
        return baseline.theta.double().numpy(), list(baseline.library.terms)
    raise UsageError(
        f"model {spec.name}: its baseline '{spec.baseline.kind}' is no sum of terms of velocities"
        " and forces; the parameters of a baseline of kind regressors or believed can be exported"
    )


def _unplaced(theta: Matrix, terms: list[str]) -> dict[str, list[str]]:
    """Return the terms of each axis that are neither damping, Coriolis force nor a force."""
    own = {f"{name}" for name in VELOCITY} | {f"{name}|{name}|" for name in VELOCITY}
    placed = own | set(FORCE_CHANNELS) | {"v r", "r v", "u r", "r u", "u v", "v u", "r^2"}
    return {
        ACCELERATION[i]: [
            term for j, term in enumerate(terms) if theta[i, j] != 0 and term not in placed
        ]
        for i in range(3)
    }
