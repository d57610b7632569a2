"""Heading controllers on a moving reference: the rudder that the motion itself needs is added."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy

FOLLOWED = ("heading", "yaw_rate", "rudder")
"""Reference of a course at every step: heading, yaw rate and rudder in rad, rad/s, rad."""


@final
class Following(Policy):
    """The law delta = delta_d + law(psi - psi_d, r - r_d), saturated.

    Any heading controller follows turns with it as it holds a course.

    T r_dot + r = K delta has the same form for the differences from a motion that fulfils it, so
    that a law for steps of the heading corrects them and lags behind nothing. A law with an
    observer gets the rudder angle less delta_d.

    Reference [B, 3]: `FOLLOWED`. Memory [B, 1 + n_state of the law]: the rudder angle [rad] as the
    steering gear follows, then the law's.

    Args:
        law: heading controller.
        state: names of the vessel's state.
        limit: of the rudder in rad.
        dt: step in s.
        rate: of the rudder in rad/s; None where it stands at its command at once.
    """

    def __init__(
        self,
        law: Policy,
        state: Sequence[str],
        *,
        limit: float,
        dt: float,
        rate: float | None = None,
    ) -> None:
        super().__init__()
        self.law = law
        self.limit = limit
        self.travel = 2.0 * limit if rate is None else min(rate * dt, 2.0 * limit)
        self.n_state = 1 + law.n_state
        self.psi, self.r = state.index("psi"), state.index("r")

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the rudder amidships, then the law's memory."""
        return torch.cat((torch.zeros_like(x[:, :1]), self.law.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the memory.

        Args:
            x: state [B, nx].
            reference: reference [B, 3], `FOLLOWED`.
            s: memory [B, 1 + n_state of the law].
        """
        needed = reference[:, 2:3]
        relative = x.clone()
        relative[:, self.psi] = x[:, self.psi] - reference[:, 0]
        relative[:, self.r] = x[:, self.r] - reference[:, 1]
        correction, memory = self.law(relative, torch.zeros_like(needed), s[:, 1:])
        command = (needed + correction).clamp(-self.limit, self.limit)
        rudder = s[:, 0:1] + (command - s[:, 0:1]).clamp(-self.travel, self.travel)
        memory = self.law.told(memory, rudder - needed)
        return command, torch.cat((rudder, memory), dim=-1)
