"""A plant under inputs that move within a step, as some golden runs were made."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant


@final
class StagedPlantDynamics(Dynamics):
    """A plant stepped by RK4 under inputs that move during a step, taken at each stage's time.

    Inputs w [B, 3 m] hold those at the start, the middle and the end of the step side by side.
    """

    def __init__(self, plant: Plant, dt: float) -> None:
        super().__init__(dt, "rk4")
        self.plant = plant

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant under the inputs p [B, m] of one stage."""
        return self.plant.rate(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after a step; the memory passes through."""
        start, middle, end = torch.chunk(w, 3, dim=-1)
        k1 = self.rate(x, start, s)
        k2 = self.rate(x + 0.5 * self.dt * k1, middle, s)
        k3 = self.rate(x + 0.5 * self.dt * k2, middle, s)
        k4 = self.rate(x + self.dt * k3, end, s)
        return (
            self.plant.end_step(x + self.dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), end, self.dt),
            s,
        )
