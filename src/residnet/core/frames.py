"""Frames and angles: NED, and body axes x forward, y starboard, z down (SNAME, Fossen).

Angles are unwrapped in logs and states; only differences of angles are wrapped.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """Bring angles [rad] of any shape to [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def wrap_array(angle: np.ndarray) -> np.ndarray:
    """Bring angles [rad] of a NumPy array to [-pi, pi)."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def to_body(north: Tensor, east: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of an earth-fixed vector along body x and y; shapes broadcast.

    Args:
        north: component along north.
        east: component along east.
        psi: heading [rad].

    Source: document 003 eq. (4), transposed.
    """
    c, s = torch.cos(psi), torch.sin(psi)
    return c * north + s * east, c * east - s * north


def to_earth(forward: Tensor, starboard: Tensor, psi: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of a body-fixed vector along north and east; shapes broadcast.

    Args:
        forward: component along body x.
        starboard: component along body y.
        psi: heading [rad].

    Source: document 003 eq. (4).
    """
    c, s = torch.cos(psi), torch.sin(psi)
    return c * forward - s * starboard, s * forward + c * starboard


def upright(u: Tensor, v: Tensor, w: Tensor, phi: Tensor, theta: Tensor) -> list[Tensor]:
    """Return a body vector forward, to starboard and down, as one sees it who stands upright.

    Args:
        u: component along body x; shapes broadcast.
        v: component along body y.
        w: component along body z.
        phi: roll angle [rad].
        theta: pitch angle [rad].

    Source: Fossen 2021, eq. (2.31), without the heading.
    """
    across, normal = to_earth(v, w, phi)
    ahead, down = to_body(u, normal, theta)
    return [ahead, across, down]


def along_axes(north: Tensor, east: Tensor, angles: Tensor) -> list[Tensor]:
    """Return a horizontal vector along the body's x, y and z.

    Args:
        north: component along north [...].
        east: component along east.
        angles: roll, pitch and heading [..., 3] in rad.
    """
    phi, theta, psi = angles.unbind(-1)
    along, across = to_body(north, east, psi)
    side, normal = to_body(across, along * torch.sin(theta), phi)
    return [along * torch.cos(theta), side, normal]


def rotated(angles: Tensor, turn: Tensor) -> Tensor:
    """Return the attitude [..., 3] after a further rotation, by way of unit quaternions.

    Nothing in it is singular but the angles themselves, at a pitch of 90 deg, where any pair of
    roll and heading with the right difference means the same attitude. Roll and heading go on from
    where they were, and so count whole turns.

    Args:
        angles: roll, pitch and heading [rad].
        turn: the rotation vector about body axes [rad].

    Source: Fossen 2021, section 2.2.2.
    """
    half = 0.5 * angles
    cf, ct, cp = torch.cos(half).unbind(-1)
    sf, st, sp = torch.sin(half).unbind(-1)
    w, x = cf * ct * cp + sf * st * sp, sf * ct * cp - cf * st * sp
    y, z = cf * st * cp + sf * ct * sp, cf * ct * sp - sf * st * cp
    # the offset keeps the gradient finite where nothing turns
    size = torch.sqrt(turn.square().sum(-1) + 1e-24)
    a = torch.cos(0.5 * size)
    bx, by, bz = (turn * (torch.sin(0.5 * size) / size).unsqueeze(-1)).unbind(-1)
    w, x, y, z = (
        w * a - x * bx - y * by - z * bz,
        w * bx + x * a + y * bz - z * by,
        w * by - x * bz + y * a + z * bx,
        w * bz + x * by - y * bx + z * a,
    )
    unit = torch.rsqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * unit, x * unit, y * unit, z * unit
    across, normal = 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    level = torch.sqrt(across * across + normal * normal + 1e-24)
    phi, psi = angles[..., 0], angles[..., 2]
    return torch.stack(
        (
            phi + wrap(torch.atan2(across, normal) - phi),
            torch.atan2(2.0 * (w * y - x * z), level),
            psi + wrap(torch.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)) - psi),
        ),
        dim=-1,
    )


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector product [..., 3] of vectors [..., 3]."""
    return a.roll(-1, -1) * b.roll(-2, -1) - a.roll(-2, -1) * b.roll(-1, -1)


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle [...] in rad of the one rotation that leads from attitudes a to b.

    Args:
        a: roll, pitch and heading [..., 3] in rad.
        b: the same.
    """
    from scipy.spatial.transform import Rotation

    one, other = (Rotation.from_euler("ZYX", np.reshape(x, (-1, 3))[:, ::-1]) for x in (a, b))
    return np.asarray((one.inv() * other).magnitude().reshape(np.shape(a)[:-1]))
