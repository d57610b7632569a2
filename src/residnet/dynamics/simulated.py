"""A plant as `Dynamics`: the truth that simulated trials are made with."""

from __future__ import annotations

from typing import Any, final

import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant


@final
class PlantDynamics(Dynamics):
    """A plant stepped by RK4 with held actuators, which move afterwards.

    This is the order of the golden runs.

    A step of the log may hold several sub-steps of the plant: inputs are held over all of them.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt / substeps, "rk4")
        self.plant = plant
        self.substeps = substeps

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant; a plant has no residual.

        A step holds p = prepare(x, w).
        """
        return self.plant.held_rate(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after a step of the log; the memory passes through."""
        for _ in range(self.substeps):
            x = self.plant.end_step(self.integrate(x, self.plant.prepare(x, w), s), w, self.dt)
        return x, s


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


@final
class TracedPlantDynamics(Dynamics):
    """A `PlantDynamics` whose step is recorded once as TorchScript.

    The numbers are the same, two to three times faster for small batches.

    For simulation only: it runs without gradients, in float64, at any batch size.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt, "rk4")
        model = PlantDynamics(plant, dt, substeps).eval()
        x = plant.approach(2)
        w = torch.zeros(2, len(plant.inputs), dtype=torch.float64)
        with torch.no_grad():
            recorded = torch.jit.trace_module(model, {"step": (x, w, x[:, :0])}, check_trace=False)
            self.recorded: Any = torch.jit.freeze(recorded, preserved_attrs=["step"])
        self.plant = plant

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant with what a step holds."""
        return self.plant.held_rate(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after a step of the log; the memory passes through."""
        after: tuple[Tensor, Tensor] = self.recorded.step(x, w, s)
        return after
