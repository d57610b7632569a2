"""The interface of actuators: what turns commands into forces on the hull."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from residnet.core.config import Config


class Actuators(nn.Module, ABC):
    """All actuators of a vessel: commands move their states, and the states push the hull.

    Commands are [..., c], states a [..., k].

    A state may move continuously (`rate`, integrated with the hull: lags) or once per step
    (`advance`, after the hull has moved with the states held: rate limits).

    Attributes:
        state: names of the states; empty where the commands act at once. What no sensor measures
            begins with `_` and enters no log.
        commands: names of the commands.
        held: whether forces stay the same over a step: no state moves continuously, and the
            vessel's speed does not matter.
    """

    state: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    held: bool = False

    @abstractmethod
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., c] for a manoeuvre's drive and steer [...], each within +-1."""

    @abstractmethod
    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., n] on the hull in N and N m.

        Args:
            a: states [..., k].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return torch.zeros_like(a)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds, of what moves once per step."""
        return a


class ForceActuators(Actuators, ABC):
    """Actuators that push a hull in surge, sway and yaw, each as asked for, within their limits."""

    @abstractmethod
    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., c] that ask for forces tau [..., 3] in N, N, N m."""

    @abstractmethod
    def asked(self, command: Tensor) -> Tensor:
        """Return the forces tau [..., 3] that commands [..., c] ask for, before any lag."""


class ActuatorConfig(Config, ABC):
    """The part of a vessel file that all kinds of actuators share.

    Attributes:
        kind: kind of the actuators.
        source: where their numbers come from.
    """

    kind: str
    source: str

    @abstractmethod
    def build(self) -> Actuators:
        """Build the module that turns commands into forces."""
