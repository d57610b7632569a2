"""Kinematics: how the pose moves with the body-fixed velocities, in 3 and 4 degrees of freedom."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.frames import to_body, to_earth


class Kinematics(nn.Module, ABC):
    """The relation of pose [..., n] and velocities [..., n] with n degrees of freedom.

    Attributes:
        pose, velocity: names.
        axes: letters of the axes of force, in the order of the velocities.
        heading: column of psi in the pose.
    """

    pose: tuple[str, ...]
    velocity: tuple[str, ...]
    axes: tuple[str, ...]
    heading: int

    @abstractmethod
    def rate(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the derivative [..., n] of the pose."""

    @abstractmethod
    def body_components_and_rate(
        self, north: Tensor, east: Tensor, pose: Tensor, nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return an earth-fixed constant velocity in body axes, and its derivative, each [..., n].

        The derivative is not zero while the body turns.

        Args:
            north: velocity along north [...] in m/s.
            east: velocity along east [...] in m/s.
            pose: pose [..., n].
            nu: velocities [..., n].
        """

    @abstractmethod
    def body_components(self, north: Tensor, east: Tensor, pose: Tensor) -> Tensor:
        """Return an earth-fixed horizontal force in body axes, [..., n]."""


@final
class Planar(Kinematics):
    """Surge, sway and yaw (document 003 eq. (1))."""

    pose = ("x", "y", "psi")
    velocity = ("u", "v", "r")
    axes = ("x", "y", "n")
    heading = 2

    def rate(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return x_dot = u cos psi - v sin psi, y_dot = u sin psi + v cos psi, psi_dot = r."""
        u, v, r = torch.unbind(nu, dim=-1)
        north, east = to_earth(u, v, pose[..., 2])
        return torch.stack((north, east, r), dim=-1)

    def body_components_and_rate(
        self, north: Tensor, east: Tensor, pose: Tensor, nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the body components and their derivative: the vector turns by -r."""
        along, across = to_body(north, east, pose[..., 2])
        zero = torch.zeros_like(along)
        r = nu[..., 2]
        return torch.stack((along, across, zero), dim=-1), torch.stack(
            (r * across, -r * along, zero), dim=-1
        )

    def body_components(self, north: Tensor, east: Tensor, pose: Tensor) -> Tensor:
        """Return the force along x and y; no moment."""
        along, across = to_body(north, east, pose[..., 2])
        return torch.stack((along, across, torch.zeros_like(along)), dim=-1)


@final
class Rolling(Kinematics):
    """Surge, sway, roll and yaw, without heave and pitch (document 004 and its corrections).

    The pose is x, y, phi, psi; the velocities are u, v, p, r.
    """

    pose = ("x", "y", "phi", "psi")
    velocity = ("u", "v", "p", "r")
    axes = ("x", "y", "k", "n")
    heading = 3

    def rate(self, pose: Tensor, nu: Tensor) -> Tensor:
        """Return the derivative [..., 4] of the pose.

        x_dot = u cos psi - v sin psi cos phi, y_dot = u sin psi + v cos psi cos phi, phi_dot = p,
        psi_dot = r cos phi.
        """
        cos_phi = torch.cos(pose[..., 2])
        north, east = to_earth(nu[..., 0], nu[..., 1] * cos_phi, pose[..., 3])
        return torch.stack((north, east, nu[..., 2], nu[..., 3] * cos_phi), dim=-1)

    def body_components_and_rate(
        self, north: Tensor, east: Tensor, pose: Tensor, nu: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the components along the rolled body axes x and y, and their derivative."""
        along, across = to_body(north, east, pose[..., 3])
        cos_phi, sin_phi = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
        zero = torch.zeros_like(along)
        turning = nu[..., 3] * cos_phi
        body = torch.stack((along, across * cos_phi, zero, zero), dim=-1)
        change = torch.stack(
            (
                turning * across,
                -turning * along * cos_phi - nu[..., 2] * across * sin_phi,
                zero,
                zero,
            ),
            dim=-1,
        )
        return body, change

    def body_components(self, north: Tensor, east: Tensor, pose: Tensor) -> Tensor:
        """Return the force along the rolled body axes x and y; no moments."""
        along, across = to_body(north, east, pose[..., 3])
        zero = torch.zeros_like(along)
        return torch.stack((along, across * torch.cos(pose[..., 2]), zero, zero), dim=-1)
