"""Parts of states as tensors, for code that TorchScript compiles, which takes no global slices.

The columns are those of `layout`; n is the number of what moves (`Live.size`). They stand apart, so
that what reads logs imports no torch.
"""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.core.frames import to_level_axes


def pose(x: Tensor) -> Tensor:
    """Return the pose (x, y, psi) [..., 3] of states [..., nx]."""
    return x[..., :3]


def dynamic_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return what moves [..., n] of states [..., nx]: u, v, r, and p and phi of a roll."""
    return x[..., 3 : 3 + n_dynamic]


def pose_and_dynamic_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return pose and what moves [..., 3 + n] of states [..., nx]."""
    return x[..., : 3 + n_dynamic]


def actuator_states(x: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return the states of actuators [..., nx - 3 - n] of states [..., nx]."""
    return x[..., 3 + n_dynamic :]


def motion_accelerations(x: Tensor) -> Tensor:
    """Return the accelerations [..., 3] behind pose and velocities of a motion [..., 9]."""
    return x[..., 6:9]


def all_but_pose(x: Tensor) -> Tensor:
    """Return all but the pose [..., nx - 3] of states [..., nx]: velocities and what follows."""
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
    """Return the rate of the heading [..., 1] in rad/s from what moves on the surface [..., n]."""
    r = nu[..., 2:3]
    return r * torch.cos(nu[..., 4:5]) if n_dynamic == 5 else r


def level_velocities(nu: Tensor) -> list[Tensor]:
    """Return the velocity forward, to starboard and down [...] of what moves in six [..., 9]."""
    return to_level_axes(nu[..., 0], nu[..., 1], nu[..., 3], nu[..., 7], nu[..., 8])


def with_depth_rate(nu_dot: Tensor, nu: Tensor) -> Tensor:
    """Return rates [..., 9] of what moves in six [..., 9] with that of the depth."""
    depth_rate = level_velocities(nu)[2].unsqueeze(-1)
    return torch.cat((nu_dot[..., :6], depth_rate, nu_dot[..., 7:]), dim=-1)


def zero_acceleration(z: Tensor, n_dynamic: int = 3) -> Tensor:
    """Return accelerations of zero [..., n], alike in type to channels [..., nz]."""
    return torch.zeros_like(z[..., :n_dynamic])
