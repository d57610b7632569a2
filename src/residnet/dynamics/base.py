"""The interface of all models, with the explicit Runge-Kutta step that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from residnet.core.columns import (
    all_but_pose,
    dynamic_states,
    heading,
    level_velocities,
    pose,
    roll_angle,
    surge,
    sway,
    yaw_rate,
)
from residnet.core.frames import compose_rotation, cross_product, to_earth
from residnet.core.layout import PLANAR_LAYOUT

Integrator = Literal["rk4", "heun", "euler", "semi_implicit_euler"]

# nodes and weights of explicit schemes in which every stage starts from the one before it; the
# first stage is at the state itself
_TABLEAUX: dict[str, tuple[list[float], list[float]]] = {
    "rk4": ([0.0, 0.5, 0.5, 1.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]),
    "heun": ([0.0, 1.0], [0.5, 0.5]),
    "euler": ([0.0], [1.0]),
    "semi_implicit_euler": ([0.0], [1.0]),
}


class Dynamics(nn.Module, ABC):
    """A vessel model in discrete time: `step(x, w, s) -> (x', s')` at a fixed dt.

    Inputs are held over the step.

    Subclasses give `step`, and `rate(x, p, rho)`, the derivative of the state at a stage, where
    they integrate. All is pure tensor code that TorchScript compiles.

    Attributes:
        dof: number of what moves: u, v, r, and p and phi of a vessel that rolls.
        rolls: whether it does.
        spatial: whether it turns about all axes, so that rotations are composed.
        positions: whether x and y move. Velocities and heading do not depend on them: a training
            that asks for no positions takes 24 to 33 % less time (float32, one thread, batches of
            64 and 256 rows, with gradients).
    """

    def __init__(self, dt: float, integrator: Integrator) -> None:
        super().__init__()
        self.dt = dt
        self.integrator: Integrator = integrator
        self.nodes, self.weights = (list(part) for part in _TABLEAUX[integrator])
        self.semi_implicit = integrator == "semi_implicit_euler"
        self.n_state = 0
        self.dof, self.rolls = PLANAR_LAYOUT.n_dof, False
        self.positions = True
        self.turn_about((), 0)

    def turn_about(self, attitude: Sequence[int], width: int) -> None:
        """Take columns of roll, pitch and heading whose rates are those about the body axes.

        Args:
            attitude: the columns; none where angles add up.
            width: number of states.
        """
        self.spatial = len(attitude) > 0
        places = torch.arange(width)
        places[list(attitude)] = width + torch.arange(len(attitude))
        self.attitude = nn.Buffer(torch.tensor(attitude).long(), persistent=False)
        self.rearranged = nn.Buffer(places, persistent=False)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the derivative of the state [B, nx] at a stage, for models that integrate.

        A step holds p [B, k] and rho [B, n] fixed.
        """
        raise NotImplementedError

    @abstractmethod
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state [B, nx] and the memory [B, n_state] one step later, inputs w [B, m]."""

    def initial_state(self, batch: int) -> Tensor:
        """Return the memory [batch, n_state] without a past: zeros."""
        return torch.zeros(batch, self.n_state)

    def kinematics(self, x: Tensor) -> Tensor:
        """Return the derivative of the pose [B, 3] of states [B, nx].

        Source: document 003 eq. (1), and document 004 for a vessel that rolls.
        """
        if self.spatial:
            # the heading has its share of a rotation vector, which is r
            forward, starboard, _ = level_velocities(dynamic_states(x, self.dof))
            north, east = to_earth(forward, starboard, heading(x))
            return torch.stack((north, east, yaw_rate(x)), dim=-1)
        across, turned = sway(x), yaw_rate(x)
        if self.rolls:
            level = torch.cos(roll_angle(x))
            across, turned = across * level, turned * level
        if not self.positions:
            still = torch.zeros_like(turned)
            return torch.stack((still, still, turned), dim=-1)
        north, east = to_earth(surge(x), across, heading(x))
        return torch.stack((north, east, turned), dim=-1)

    def angled(self, x: Tensor, after: Tensor) -> Tensor:
        """Return states [B, nx] after a step from x whose angles moved with the new velocities.

        There are none but where a subclass says so.
        """
        return after

    def from_start(self, change: Tensor, k: Tensor) -> Tensor:
        """Return rates k [B, nx] after a change [B, nx] as those of the change itself."""
        turn, rate = change.index_select(-1, self.attitude), k.index_select(-1, self.attitude)
        bent = cross_product(turn, rate)
        rate = rate + 0.5 * bent + cross_product(turn, bent) / 12.0
        return torch.cat((k, rate), dim=-1).index_select(-1, self.rearranged)

    def integrate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state one step later, [B, nx]."""
        return self.integrate_from(self.rate(x, p, rho), x, p, rho)

    def moved_on(self, x: Tensor, change: Tensor) -> Tensor:
        """Return states [B, nx] after a change [B, nx], whose angles are a rotation vector."""
        after = x + change
        if not self.spatial:
            return after
        turned = compose_rotation(
            x.index_select(-1, self.attitude), change.index_select(-1, self.attitude)
        )
        return torch.cat((after, turned), dim=-1).index_select(-1, self.rearranged)

    def integrate_from(self, k: Tensor, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state one step later [B, nx], where its derivative k [B, nx] is known.

        Rotations are integrated as rotation vectors from the step's start (Munthe-Kaas 1998), with
        the first commutator.
        """
        total = self.weights[0] * k
        for i in range(1, len(self.nodes)):
            change = (self.dt * self.nodes[i]) * k
            k = self.rate(self.moved_on(x, change), p, rho)
            if self.spatial:
                k = self.from_start(change, k)
            total = total + self.weights[i] * k
        after = self.moved_on(x, self.dt * total)
        if self.semi_implicit and self.spatial:
            return self.angled(x, after)
        if self.semi_implicit:
            after = self.angled(x, after)
            # the pose moves with the new velocities, which keeps an undamped oscillation bounded;
            # what stands behind the velocities goes along
            moved = all_but_pose(after)
            return torch.cat(
                (
                    pose(x) + self.dt * self.kinematics(torch.cat((pose(x), moved), dim=-1)),
                    moved,
                ),
                dim=-1,
            )
        return after
