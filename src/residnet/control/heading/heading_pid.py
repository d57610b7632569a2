"""A heading autopilot: proportional, derivative and integral action on the heading error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap


@final
class HeadingPID(Policy):
    """The law delta = kp e - kd r + ki I, saturated, with e the wrapped heading error.

    I_dot = e while the command is not saturated by it.

    Memory: I [rad s], where ki > 0. The command of a step uses the integral before that step's
    error enters it.

    Args:
        state: names of the vessel's state.
        kp: rad of rudder per rad of error.
        kd: rad of rudder per rad/s of yaw.
        limit: of the rudder command in rad.
        ki: rad of rudder per rad s.
        dt: step of the controller in s, where ki > 0.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        kp: float,
        kd: float,
        limit: float,
        ki: float = 0.0,
        dt: float | None = None,
    ) -> None:
        super().__init__()
        if limit <= 0 or ki < 0 or (ki > 0) != (dt is not None):
            raise ConfigError(
                "heading PID: the limit must be positive, ki >= 0, and dt belongs to ki > 0; given"
                f" {limit:g}, {ki:g}, {dt}"
            )
        self.psi, self.r = state.index("psi"), state.index("r")
        self.kp, self.kd, self.ki, self.limit = kp, kd, ki, limit
        self.dt = dt or 0.0
        self.n_state = 1 if ki > 0 else 0

    @classmethod
    def placed(
        cls,
        state: Sequence[str],
        *,
        gain: float,
        time: float,
        frequency: float,
        damping: float,
        limit: float,
    ) -> HeadingPID:
        """Return the PD law that gives T r_dot + r = K delta a natural frequency and damping.

        The frequency is in rad/s, the damping relative (document 004 eq. (5.9)).
        """
        return cls(
            state,
            kp=time * frequency**2 / gain,
            kd=(2.0 * damping * frequency * time - 1.0) / gain,
            limit=limit,
        )

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad and the integral [B, 0 or 1] in rad s.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: integral [B, 0 or 1] in rad s.
        """
        error = wrap(reference - x[:, self.psi : self.psi + 1])
        wish = self.kp * error - self.kd * x[:, self.r : self.r + 1]
        if self.n_state == 0:
            return wish.clamp(-self.limit, self.limit), s
        wish = wish + self.ki * s
        winding = (wish.abs() > self.limit) & (wish * error > 0)
        return wish.clamp(-self.limit, self.limit), torch.where(winding, s, s + self.dt * error)
