"""A plant as `Dynamics`: the truth that simulated trials are made with."""

from __future__ import annotations

from typing import final

from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.physics.plant import DifferentialThrustVessel


@final
class PlantDynamics(Dynamics):
    """Steps a plant's hull with held actuators by RK4, then moves the actuators (the order of the golden runs).

    A step of the log may hold several sub-steps of the plant: inputs are held over all of them.
    """

    def __init__(self, plant: DifferentialThrustVessel, dt: float, substeps: int = 1) -> None:
        super().__init__(dt / substeps, "rk4")
        self.plant = plant
        self.substeps = substeps

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """x_dot [B, nx] of the plant under inputs p = w; a plant has no residual."""
        return self.plant.rate(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """State after a step of the log; the memory passes through."""
        for _ in range(self.substeps):
            x = self.plant.settle(self.integrate(x, w, s), w, self.dt)
        return x, s
