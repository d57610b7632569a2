"""Heading controllers on a moving reference: they see where they are against it, and the rudder
that the motion itself needs is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.policy import HeadingPolicy

FOLLOWED = ("heading", "yaw_rate", "rudder")
"""What a course asks for at every step, in rad, rad/s, rad."""


@final
class Following(Policy):
    """delta = delta_d + law(psi - psi_d, r - r_d), saturated: any heading controller follows turns
    as it holds a course.

    T r_dot + r = K delta has the same form for the differences from a motion that fulfils it, so
    that a law for steps of the heading corrects them and lags behind nothing. A law with an
    observer is told the rudder that it got, less delta_d.

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
        self.observes = isinstance(law, HeadingPolicy)
        self.n_state = 1 + law.n_state
        self.psi, self.r = state.index("psi"), state.index("r")

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the rudder amidships, then the law's memory."""
        return torch.cat((torch.zeros_like(x[:, :1]), self.law.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and memory from the state x [B, nx], the reference [B, 3] and the memory."""
        needed = reference[:, 2:3]
        away = x.clone()
        away[:, self.psi] = x[:, self.psi] - reference[:, 0]
        away[:, self.r] = x[:, self.r] - reference[:, 1]
        correction, memory = self.law(away, torch.zeros_like(needed), s[:, 1:])
        command = (needed + correction).clamp(-self.limit, self.limit)
        rudder = s[:, 0:1] + (command - s[:, 0:1]).clamp(-self.travel, self.travel)
        if self.observes:
            memory = torch.cat((rudder - needed, memory[:, 1:]), dim=-1)
        return command, torch.cat((rudder, memory), dim=-1)
