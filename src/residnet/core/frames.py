"""Transform vectors and angles between NED and body axes (x forward, y starboard, z down; SNAME).

Angles are unwrapped (continuous) in logs and states; only differences of angles are wrapped.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    # functions use methods of tensors, so that readers of logs do not import PyTorch
    from torch import Tensor


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap angles [rad] of any shape to [-pi, pi)."""
    return (angle + math.pi).remainder(2.0 * math.pi) - math.pi


def wrap_angle_array(angle: np.ndarray) -> np.ndarray:
    """Wrap angles [rad] of a NumPy array to [-pi, pi)."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def to_body(north: Tensor, east: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate a horizontal vector from NED to body axes; shapes broadcast.

    Args:
        north: component along north.
        east: component along east.
        psi: heading [rad].

    Source: Woo et al. 2018, eq. (4), transposed.
    """
    cos_psi = psi.cos()
    sin_psi = psi.sin()
    return cos_psi * north + sin_psi * east, cos_psi * east - sin_psi * north


def to_earth(forward: Tensor, starboard: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate a horizontal vector from body axes to NED; shapes broadcast.

    Args:
        forward: component along body x.
        starboard: component along body y.
        psi: heading [rad].

    Source: Woo et al. 2018, eq. (4).
    """
    cos_psi = psi.cos()
    sin_psi = psi.sin()
    return cos_psi * forward - sin_psi * starboard, sin_psi * forward + cos_psi * starboard


def to_level_axes(u: Tensor, v: Tensor, w: Tensor, phi: Tensor, theta: Tensor) -> list[Tensor]:
    """Rotate a body-fixed vector to level axes: forward, starboard and down without roll and pitch.

    Args:
        u: component along body x; shapes broadcast.
        v: component along body y.
        w: component along body z.
        phi: roll angle [rad].
        theta: pitch angle [rad].

    Source: Fossen 2021, eq. (2.31), without the heading.
    """
    starboard, down_before_pitch = to_earth(v, w, phi)
    forward, down = to_body(u, down_before_pitch, theta)
    return [forward, starboard, down]


def horizontal_to_body(north: Tensor, east: Tensor, angles: Tensor) -> list[Tensor]:
    """Rotate a horizontal vector from NED to body axes with roll, pitch and heading.

    Args:
        north: component along north [...].
        east: component along east.
        angles: roll, pitch and heading [..., 3] in rad.
    """
    phi, theta, psi = angles.unbind(-1)
    forward, starboard = to_body(north, east, psi)
    body_y, body_z = to_body(starboard, forward * theta.sin(), phi)
    return [forward * theta.cos(), body_y, body_z]


def compose_rotation(angles: Tensor, rotation_vector: Tensor) -> Tensor:
    """Apply a body-fixed rotation to an attitude by unit quaternions.

    The computation is singular only in the Euler angles themselves, at a pitch of 90 deg, where
    only the difference of roll and heading is defined. Roll and heading are continuous with the
    previous values, so they count full turns.

    Args:
        angles: roll, pitch and heading [..., 3] in rad.
        rotation_vector: rotation about the body axes [..., 3] in rad.

    Returns:
        Roll, pitch and heading [..., 3] in rad.

    Source: Fossen 2021, section 2.2.2.
    """
    import torch

    # quaternion of the Euler angles (zyx): c and s are cosine and sine of the halves of roll (f),
    # pitch (t) and heading (p)
    half_angles = 0.5 * angles
    cf, ct, cp = half_angles.cos().unbind(-1)
    sf, st, sp = half_angles.sin().unbind(-1)
    w = cf * ct * cp + sf * st * sp
    x = sf * ct * cp - cf * st * sp
    y = cf * st * cp + sf * ct * sp
    z = cf * ct * sp - sf * st * cp
    # the offset keeps the gradient finite for a zero rotation
    rotation_angle = torch.sqrt(rotation_vector.square().sum(-1) + 1e-24)
    cos_half_rotation = torch.cos(0.5 * rotation_angle)
    bx, by, bz = (
        rotation_vector * (torch.sin(0.5 * rotation_angle) / rotation_angle).unsqueeze(-1)
    ).unbind(-1)
    # quaternion product: a rotation about body axes multiplies from the right
    w, x, y, z = (
        w * cos_half_rotation - x * bx - y * by - z * bz,
        w * bx + x * cos_half_rotation + y * bz - z * by,
        w * by - x * bz + y * cos_half_rotation + z * bx,
        w * bz + x * by - y * bx + z * cos_half_rotation,
    )
    # normalised, because rounding errors accumulate over the steps of a simulation
    inverse_norm = torch.rsqrt(w * w + x * x + y * y + z * z)
    w = w * inverse_norm
    x = x * inverse_norm
    y = y * inverse_norm
    z = z * inverse_norm
    # Euler angles from elements of the rotation matrix; the pitch from atan2, because asin has an
    # infinite slope at 90 deg
    sin_roll_component = 2.0 * (y * z + w * x)
    cos_roll_component = 1.0 - 2.0 * (x * x + y * y)
    horizontal_norm = torch.sqrt(
        sin_roll_component * sin_roll_component + cos_roll_component * cos_roll_component + 1e-24
    )
    phi = angles[..., 0]
    psi = angles[..., 2]
    return torch.stack(
        (
            phi + wrap_angle(torch.atan2(sin_roll_component, cos_roll_component) - phi),
            torch.atan2(2.0 * (w * y - x * z), horizontal_norm),
            psi + wrap_angle(torch.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)) - psi),
        ),
        dim=-1,
    )


def cross_product(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector product [..., 3] of vectors [..., 3]."""
    return a.roll(-1, -1) * b.roll(-2, -1) - a.roll(-2, -1) * b.roll(-1, -1)


def rotation_angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle [...] in rad of the rotation between two attitudes.

    Args:
        a: roll, pitch and heading [..., 3] in rad.
        b: roll, pitch and heading [..., 3] in rad.
    """
    from scipy.spatial.transform import Rotation

    rotation_a, rotation_b = (
        Rotation.from_euler("ZYX", np.reshape(attitude, (-1, 3))[:, ::-1]) for attitude in (a, b)
    )
    return np.asarray((rotation_a.inv() * rotation_b).magnitude().reshape(np.shape(a)[:-1]))


def unwrap_angle(angle: np.ndarray) -> np.ndarray:
    """Unwrap an angle [T] in rad over its finite samples; NaN values are preserved.

    A change of more than half a circle between two finite samples is ambiguous.
    """
    unwrapped = np.asarray(angle, dtype=np.float64).copy()
    if unwrapped.size and np.abs(np.diff(unwrapped)).max(initial=0.0) < np.pi:
        # already continuous, without missing samples
        return unwrapped
    is_finite = np.isfinite(angle)
    unwrapped[is_finite] = np.unwrap(unwrapped[is_finite])
    return unwrapped


def rotate(
    x: np.ndarray | float, y: np.ndarray | float, angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate vectors [T] by angles [T] in rad.

    The heading as the angle rotates from body axes to NED, minus the heading from NED to body axes.
    Source: Woo et al. 2018, eq. (4).
    """
    c = np.cos(angle)
    s = np.sin(angle)
    return c * x - s * y, s * x + c * y
