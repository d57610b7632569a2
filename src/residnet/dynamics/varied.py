"""A plant whose every row steers a little differently: what controllers are trained and compared on."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.core.errors import ConfigError
from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant

VARIATION = ("effect", "time", "bias")
"""Of each row: rudder force as a multiple, time constants of sway and yaw as a multiple, and an angle [rad] that is added to the rudder's."""


@final
class VariedPlant(Dynamics):
    """Steps a plant by RK4 with held actuators, each row with its own rudder effect, time constants and rudder bias.

    Its memory s [B, 3] is the variation, constant over a rollout: rows of ones and a zero bias are the plant itself. With Nomoto's model of
    first order, T r_dot + r = K delta, `effect` multiplies K and `time` multiplies T; with other hulls `effect` multiplies the rudder angle
    that the water feels, and `time` divides the accelerations in sway and yaw.

    Raises:
        ConfigError: where the vessel has no rudder, or one that moves within a step.
    """

    def __init__(self, plant: Plant, dt: float, integrator: str = "rk4") -> None:
        super().__init__(dt, "heun" if integrator == "heun" else "rk4")
        self.plant = plant
        self.n_state = len(VARIATION)
        if plant.inputs[0] != "cmd_delta":
            raise ConfigError(f"heading control needs a vessel whose first command is cmd_delta, found {', '.join(plant.inputs[: plant.commands])}")
        self.rudder = plant.state.index("delta") if "delta" in plant.state else -1
        slowed = torch.tensor([1.0 if name in ("v", "r") else 0.0 for name in plant.state])
        self.register_buffer("slowed", slowed, persistent=False)
        self.slowed: Tensor
        x, w = plant.approach(1), torch.zeros(1, len(plant.inputs), dtype=torch.float64)
        w[:, 0] = 0.1
        if any(name.startswith("_delta") for name in plant.state) or (self.rudder >= 0 and bool(plant.rate(x, w)[0, self.rudder] != 0)):
            raise ConfigError("a varied plant holds the rudder over a step: give the rudder the response 'immediate' (with or without a rate)")

    def initial_state(self, batch: int) -> Tensor:
        """The plant itself, [batch, 3]."""
        return torch.tensor([1.0, 1.0, 0.0]).expand(batch, 3)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """x_dot [B, nx] from the rudder angle that the water feels and 1/time - 1, rho [B, 2]."""
        x_dot = self.plant.held_rate(self._felt(x, rho[:, :1]), p)
        return x_dot * (1.0 + self.slowed.to(x.dtype) * rho[:, 1:])

    def _felt(self, x: Tensor, angle: Tensor) -> Tensor:
        if self.rudder < 0:
            return x
        return torch.cat((x[:, : self.rudder], angle, x[:, self.rudder + 1 :]), dim=-1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """State after a step; the variation passes through."""
        angle = (x[:, self.rudder : self.rudder + 1] if self.rudder >= 0 else w[:, :1]) * s[:, :1] + s[:, 2:]
        held = torch.cat((angle, w[:, 1:]), dim=-1)
        p = self.plant.prepare(self._felt(x, angle), held)
        moved = self.integrate(x, p, torch.cat((angle, 1.0 / s[:, 1:2] - 1.0), dim=-1))
        return self.plant.settle(moved, w, self.dt), s
