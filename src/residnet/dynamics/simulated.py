"""Plants as `Dynamics`, for simulated trials, and models in an ambient current."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant


@final
class PlantDynamics(Dynamics):
    """A plant integrated by RK4 with constant actuator positions, which are updated after the step.

    The reference data of the tests have the same order of updates. Inputs are constant over all
    sub-steps of a step.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt / substeps, "rk4")
        self.set_attitude_columns(plant.attitude_columns, len(plant.state_names))
        self.plant = plant
        self.substeps = substeps

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant at p = prepare(x, w); a plant has no residual."""
        return self.plant.derivative_prepared(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        for _ in range(self.substeps):
            x = self.plant.finish_step(self.integrate(x, self.plant.prepare(x, w), s), w, self.dt)
        return x, s


@final
class InAmbientCurrent(Dynamics):
    """A model in a steady uniform current, which may differ from row to row.

    u and v are velocities through the water, x and y the position over ground. The current does not
    change the motion relative to the water; it only adds a drift to the position.
    The memory s [B, 2 + k] is the current to the north and to the east in m/s, followed by the
    memory of the model.

    Source: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, section 8.3,
    irrotational ocean currents.

    Args:
        model: a model whose steps do not depend on the position.
        state: names of its states.
    """

    def __init__(self, model: Dynamics, state: Sequence[str]) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state = 2 + model.n_state
        # maps a drift to the north and to the east to a change of the state
        drift_to_state = torch.zeros(2, len(state), dtype=torch.float64)
        drift_to_state[0, state.index("x")] = 1.0
        drift_to_state[1, state.index("y")] = 1.0
        self.drift_to_state = nn.Buffer(drift_to_state, persistent=False)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        current = s[:, :2]
        next_state, memory = self.model.step(x, w, s[:, 2:])
        drift = self.dt * current @ self.drift_to_state.to(x.dtype)
        return next_state + drift, torch.cat((current, memory), dim=-1)
