"""Masses of a 3-DOF hull in a vessel file, and the inverse of a mass matrix."""

from __future__ import annotations

import torch
from pydantic import field_validator
from torch import Tensor

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.physics.parameters import Inertia, Length, Mass, MassArm, above_zero


class RigidBody(Config):
    """The rigid body: mass, yaw inertia and centre of gravity.

    Attributes:
        m: mass in kg.
        I_z: moment of inertia in yaw about the body origin in kg m^2.
        x_G: centre of gravity ahead of the body origin in m.
    """

    m: Mass
    I_z: Inertia
    x_G: Length

    _positive = field_validator("m", "I_z")(above_zero)


class AddedMass(Config):
    """The hydrodynamic derivatives of the accelerations (SNAME: negative for a normal hull).

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


class MassEntries(Config):
    """The mass matrix with added mass; the entries that are not here are zero.

    Attributes:
        m11: surge in kg.
        m22: sway in kg.
        m23: sway force by yaw acceleration in kg m.
        m32: yaw moment by sway acceleration in kg m.
        m33: yaw in kg m^2.
    """

    m11: Mass
    m22: Mass
    m23: MassArm
    m32: MassArm
    m33: Inertia


def inverse_mass(mass: Tensor, vessel: str) -> Tensor:
    """Return the inverse [n, n] of a mass matrix [n, n] in float64.

    Raises:
        ConfigError: where an eigenvalue is zero or has no positive real part, or the matrix is as
            good as singular.
    """
    if bool((torch.linalg.eigvals(mass).real <= 0).any()):
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is not positive definite; added mass (X_udot,"
            " Y_vdot, N_rdot) is negative for a hull"
        )
    scale = mass.diagonal().sqrt()
    condition = float(torch.linalg.cond(mass / torch.outer(scale, scale)))
    if condition > 1e8:
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is singular (condition {condition:.1e} after"
            " scaling); check the coupling terms x_G, Y_rdot, N_vdot"
        )
    inverse: Tensor = torch.linalg.inv(mass)
    return inverse
