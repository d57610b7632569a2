"""Time-optimal heading changes of Nomoto's first-order model.

Full rudder, full counter-rudder, then a linear law at the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap


@final
class BangBangHeading(Policy):
    """Full rudder towards the switching curve of T r_dot + r = K delta (document 004 eq. (5.9)).

    Full counter-rudder stops a yaw rate r within T r - T K d ln(1 + r / (K d)) of heading, d the
    largest angle; the sign of the heading error less that decides. Within `layer` of the curve the
    command is proportional, and where error and yaw rate are inside `capture` the command is kp e -
    kd r, which brings them to zero.

    Args:
        state: names of the vessel's state.
        gain, time: K [1/s] and T [s], both positive.
        limit: d [rad].
        layer: of the heading error about the curve [rad].
        capture: largest heading error [rad] and yaw rate [rad/s] of the linear law.
        kp, kd: of the linear law; kd is T / (2 K) where none is given.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        gain: float,
        time: float,
        limit: float,
        layer: float = 2.5e-3,
        capture: tuple[float, float] = (2e-4, 2e-3),
        kp: float = 0.8,
        kd: float | None = None,
    ) -> None:
        super().__init__()
        if min(gain, time, limit, layer) <= 0:
            raise ConfigError(
                f"bang-bang heading: gain, time, limit and layer must be positive, given {gain:g},"
                f" {time:g}, {limit:g}, {layer:g}"
            )
        self.psi, self.r = state.index("psi"), state.index("r")
        self.time, self.limit, self.layer = time, limit, layer
        self.steady = gain * limit
        self.near, self.slow = capture
        self.kp, self.kd = kp, time / (2.0 * gain) if kd is None else kd

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad; there is no memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 0].
        """
        r = x[:, self.r : self.r + 1]
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        braking = self.time * (r - r.sign() * self.steady * torch.log1p(r.abs() / self.steady))
        full = ((error - braking) * (self.limit / self.layer)).clamp(-self.limit, self.limit)
        caught = (error.abs() < self.near) & (r.abs() < self.slow)
        linear = (self.kp * error - self.kd * r).clamp(-self.limit, self.limit)
        return torch.where(caught, linear, full), s
