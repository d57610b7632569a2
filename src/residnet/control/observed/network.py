"""Heading policies that are a recurrent network alone: no law, no observer, no predictor inside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, final

import torch
from torch import Tensor

from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.turning import Turning
from residnet.control.observed.cell import OddCell
from residnet.core.frames import wrap

FIXED = ("rudder", "last_command")
"""Memory of every such policy; the network's units stand behind."""
_FEATURES = 8
_DEGREE = math.pi / 180.0


@final
class NetworkPolicy(HeadingKeeper):
    """The command clamp(limit network): what it knows of its vessel it has learned in flight.

    The network is a gated recurrent unit with an odd layer behind it, so that port and starboard
    are alike. It sees heading error, yaw rate, the rudder's angle and the last command. Its output
    starts at zero: untrained, it holds the rudder amidships. K and speed of the vessel are scales
    of what it sees.

    Memory s [B, 2 + units]: `FIXED` in rad, then the network's units.

    Args:
        state: names of the vessel's state.
        turning: K, T and speed of the vessel about straight ahead.
        limit: of the rudder in rad.
        dt: step of the controller in s; `at` changes it.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        units: of the network, at least one.
        trained_at: step in s that the network is trained at.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        limit: float,
        dt: float,
        rate: float | None = None,
        units: int,
        trained_at: float = 0.04,
    ) -> None:
        super().__init__(turning, limit, rate, dt)
        self.read_from(state)
        self.units, self.degree, self.trained_at = units, _DEGREE, trained_at
        self.network = OddCell(_FEATURES, units, trained_at, hidden=units)
        self.n_state = len(FIXED) + units
        self.travel = 0.0
        self.at(dt)

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt = dt
        # a large number where the rudder has no rate: infinity would spoil gradients
        self.travel = min(self.rate * dt, 2.0 * self.limit)

    def read_from(self, state: Sequence[str]) -> None:
        """Take heading, speed and yaw rate from a state with these names."""
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")

    def values(self) -> dict[str, float]:
        """Return no constants: there is no law that has any."""
        return {}

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        """Return the memory once the rudder angle [B, 1] is known that is really taken."""
        return torch.cat((rudder, s[:, 1:]), dim=1)

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        """Return what the entries of the memory can be, [low, high] by name, with some room."""
        most = dict.fromkeys(FIXED, 1.001 * angle)
        most |= {f"unit_{k}": 1.001 for k in range(self.units)}
        return {name: (-high, high) for name, high in most.items()}

    def described(self) -> dict[str, Any]:
        """Return the network's units and the step of its training."""
        return {"kind": "network", "units": self.units, "trained_at": self.trained_at}

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory.
        """
        rudder, last, memory = s[:, 0:1], s[:, 1:2], s[:, 2:]
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        error = wrap(reference - x[:, self.psi : self.psi + 1]) / self.degree
        turning = x[:, self.r : self.r + 1] / (self.gain * ratio * self.limit)
        features = torch.cat(
            (
                torch.tanh(error),
                torch.tanh(error / 5.0),
                torch.tanh(error / 20.0),
                error / 30.0,
                1.7 * turning,
                torch.tanh(17.0 * turning),
                rudder / self.limit,
                last / self.limit,
            ),
            dim=1,
        )
        wish, memory = self.network(features, memory, self.dt)
        command = self.limit * wish.clamp(-1.0, 1.0)
        follows = rudder + (command - rudder).clamp(-self.travel, self.travel)
        return command, torch.cat((follows, command, memory), dim=1)
