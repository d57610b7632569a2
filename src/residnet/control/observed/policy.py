"""Heading policies with observer and predictor: a law on the estimates, and a network beside it."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, final

import torch
from torch import Tensor

from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.laws import HeadingLaw
from residnet.control.heading.turning import Turning
from residnet.control.observed.cell import OddCell
from residnet.control.observed.observer import CONSTANTS, HeadingObserver
from residnet.core.frames import wrap

FIXED = ("heading", "yaw_rate", "push", "rudder", "last_command")
"""Memory of every observed policy; pending rudder angles and the network's units stand behind."""
_FEATURES = 11
_DEGREE = math.pi / 180.0


@final
class ObservedPolicy(HeadingKeeper):
    """The command clamp(limit (law + network) - push), with the law on estimates.

    An observer estimates heading, yaw rate and push, a predictor where they will be once the
    pending commands have arrived; the law sees these, and the push is taken away. The network is a
    recurrent residual, odd, so that port and starboard are alike; its output starts at zero. With
    no units there is no network.

    Memory s [B, 5 + pending + units]: `FIXED` in rad and rad/s, rudder angles that have still to
    act, the oldest first, and the network's units.

    Args:
        state: names of the vessel's state.
        turning: K, T and speed of the vessel about straight ahead.
        law: on the estimates.
        constants: of the law, then `observer.CONSTANTS`, all positive.
        limit: of the rudder in rad.
        dt: step of the controller in s; `at` changes it.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        lag: time in s between a command and its rudder; 0 for no predictor.
        units: of the network; 0 for none.
        trained_at: step in s that the network is trained at.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        law: HeadingLaw,
        constants: Mapping[str, float | Tensor],
        limit: float,
        dt: float,
        rate: float | None = None,
        lag: float = 0.0,
        units: int = 0,
        trained_at: float = 0.04,
    ) -> None:
        super().__init__(turning, limit, rate, dt)
        self.read_from(state)
        self.units, self.degree = units, _DEGREE
        self.law = law
        self.observer = HeadingObserver(turning, limit, lag, dt)
        self.names = (*law.constants, *CONSTANTS)
        self.own = len(law.constants)
        values = [torch.as_tensor(constants[name], dtype=torch.float32) for name in self.names]
        self.constants = torch.nn.Parameter(torch.stack(values, dim=-1).log())
        self.network = OddCell(_FEATURES, max(units, 1), trained_at).requires_grad_(units > 0)
        self.trained_at = trained_at
        self.travel = 0.0
        self.at(dt)

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt = dt
        self.observer.at(dt)
        # a large number where the rudder has no rate: infinity would spoil gradients
        self.travel = min(self.rate * dt, 2.0 * self.limit)
        self.n_state = len(FIXED) + self.observer.pending + self.units

    def read_from(self, state: Sequence[str]) -> None:
        """Take heading, speed and yaw rate from a state with these names."""
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")

    def without_network(self) -> ObservedPolicy:
        """Return a copy whose network gives nothing: the law with its constants as they are."""
        alone = copy.deepcopy(self)
        torch.nn.init.zeros_(alone.network.out.weight)
        return alone

    def values(self) -> dict[str, float]:
        """Return the constants by name."""
        found = torch.exp(self.constants.detach()).tolist()
        return dict(zip(self.names, found, strict=True))

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        """Return the memory once the rudder angle [B, 1] is known that is really taken."""
        newest = 5 + self.observer.pending
        parts = (s[:, :3], rudder, s[:, 4:newest])
        if self.observer.pending > 0:
            parts = (s[:, :3], rudder, torch.cat((s[:, 4 : newest - 1], rudder), dim=1))
        return torch.cat((parts[0], parts[1], parts[2], s[:, newest:]), dim=1)

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        """Return what the entries of the memory can be, [low, high] by name, with some room."""
        push, rudder, half = 1.001 * self.limit, 1.001 * angle, 1.001 * math.pi
        most = dict(zip(FIXED, (half, 3.0 * turn, push, rudder, rudder), strict=True))
        most |= {f"pending_{k}": rudder for k in range(self.observer.pending)}
        most |= {f"unit_{k}": 1.001 for k in range(self.units)}
        return {name: (-high, high) for name, high in most.items()}

    def described(self) -> dict[str, Any]:
        """Return the constants of law and observer, the predictor's lag and the network's units."""
        return {
            "kind": "observed",
            "constants": self.values(),
            "lag": self.observer.lag,
            "units": self.units,
            "trained_at": self.trained_at,
        }

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start: heading and yaw rate as seen, rudder amidships."""
        heading = wrap(x[:, self.psi : self.psi + 1])
        rest = torch.zeros(x.shape[0], self.n_state - 2, dtype=x.dtype)
        return torch.cat((heading, x[:, self.r : self.r + 1], rest), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory.
        """
        fixed, waiting = 5, self.observer.pending
        rudder, last = s[:, 3:4], s[:, 4:5]
        pending = s[:, fixed : fixed + waiting]
        constants = list(torch.exp(self.constants).split(1, dim=-1))
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        psi = x[:, self.psi : self.psi + 1]
        seen = self.observer(
            psi,
            x[:, self.r : self.r + 1],
            s[:, 0:1],
            s[:, 1:2],
            s[:, 2:3],
            pending,
            ratio,
            constants[self.own :],
        )
        error = wrap(reference - seen.heading_ahead)
        decay = ratio / self.time
        force = decay * self.gain * ratio * self.limit
        acting = (rudder + seen.push) / self.limit
        law = self.law(error, seen.r_ahead, acting, force, decay, constants[: self.own])
        law = law - seen.push / self.limit
        memory = s[:, fixed + waiting :]
        wish = law
        if self.units > 0:
            full = self.gain * ratio * self.limit
            noise = math.sqrt(self.dt / self.trained_at)
            features = torch.cat(
                (
                    torch.tanh(wrap(reference - psi) / self.degree),
                    torch.tanh(error / self.degree),
                    torch.tanh(error / (5.0 * self.degree)),
                    error / (30.0 * self.degree),
                    1.7 * seen.r_ahead / full,
                    torch.tanh(17.0 * seen.r_ahead / full),
                    5.0 * seen.push / self.limit,
                    (3.0 * noise / self.degree) * seen.surprise_heading,
                    (52.0 * noise) * seen.surprise_r / full,
                    last / self.limit,
                    torch.tanh(law),
                ),
                dim=1,
            )
            correction, memory = self.network(features, memory, self.dt)
            wish = law + correction
        command = self.limit * wish.clamp(-1.0, 1.0)
        follows = rudder + (command - rudder).clamp(-self.travel, self.travel)
        queue = torch.cat((pending, follows), dim=1)
        heading, yaw_rate = self.observer.expected(
            seen.heading, seen.r, seen.push, queue[:, 0:1], ratio
        )
        s = torch.cat((heading, yaw_rate, seen.push, follows, command, queue[:, 1:], memory), dim=1)
        return command, s
