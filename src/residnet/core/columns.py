"""Select parts of state tensors.

TorchScript does not accept global slices, so the column numbers of `residnet.core.layout` are
repeated here. n is the number of dynamic states (`DegreesOfFreedom.n_dynamic`). The module is
separate from `layout` so that readers of logs do not import PyTorch.
"""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.core.frames import to_level_axes


def pose(x: Tensor) -> Tensor:
    """Return the pose (x, y, psi) [..., 3] of states [..., nx]."""
    return x[..., :3]


def dynamic_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return the dynamic states [..., n] of states [..., nx]: u, v, r, and p and phi with roll."""
    return x[..., 3 : 3 + n_dynamic]


def pose_and_dynamic_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return states [..., nx] without the actuator states at their end, [..., 3 + n]."""
    return x[..., : 3 + n_dynamic]


def actuator_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return the actuator states [..., nx - 3 - n] of states [..., nx]."""
    return x[..., 3 + n_dynamic :]


def motion_accelerations(x: Tensor) -> Tensor:
    """Return u_dot, v_dot, r_dot [..., 3] from pose, velocities and accelerations [..., 9]."""
    return x[..., 6:9]


def all_but_pose(x: Tensor) -> Tensor:
    """Return the states [..., nx - 3] without the pose."""
    return x[..., 3:]


def position(x: Tensor) -> Tensor:
    """Return the position (x, y) [..., 2] of states [..., nx]."""
    return x[..., :2]


def heading(x: Tensor) -> Tensor:
    """Return the heading [...] in rad of states [..., nx]."""
    return x[..., 2]


def surge(x: Tensor) -> Tensor:
    """Return the surge velocity [...] in m/s of states [..., nx]."""
    return x[..., 3]


def sway(x: Tensor) -> Tensor:
    """Return the sway velocity [...] in m/s of states [..., nx]."""
    return x[..., 4]


def yaw_rate(x: Tensor) -> Tensor:
    """Return the yaw rate [...] in rad/s of states [..., nx]."""
    return x[..., 5]


def roll_angle(x: Tensor) -> Tensor:
    """Return the roll angle [...] in rad of states [..., nx] with roll."""
    return x[..., 7]


def heading_rate(nu: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return the heading rate [..., 1] in rad/s of dynamic states [..., n] of a surface vessel."""
    r = nu[..., 2:3]
    return r * torch.cos(nu[..., 4:5]) if n_dynamic == 5 else r


def level_velocities(nu: Tensor) -> list[Tensor]:
    """Return the velocities forward, starboard and down [...] in level axes, in m/s.

    Args:
        nu: dynamic states u, v, r, w, p, q, z, phi, theta [..., 9].
    """
    return to_level_axes(nu[..., 0], nu[..., 1], nu[..., 3], nu[..., 7], nu[..., 8])


def with_depth_rate(nu_dot: Tensor, nu: Tensor) -> Tensor:
    """Return rates [..., 9] with the depth rate inserted, from dynamic states nu [..., 9]."""
    depth_rate = level_velocities(nu)[2].unsqueeze(-1)
    return torch.cat((nu_dot[..., :6], depth_rate, nu_dot[..., 7:]), dim=-1)


def zero_acceleration(z: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return zero accelerations [..., n] with the dtype and device of channels [..., nz]."""
    return torch.zeros_like(z[..., :n_dynamic])
