"""Plants as `Dynamics`, the truth of simulated trials; a current."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.dynamics.base import Dynamics
from residnet.physics.plant import Plant

MOST_STEPS = 2_000_000
"""Steps of the longest simulation: more than two days at ten steps a second."""


def check_steps(duration: float, step: float, what: str = "duration") -> None:
    """Refuse a simulation of so many steps that it can only be a slip.

    Args:
        duration: of the simulation in s.
        step: of the simulation in s.
        what: name of the duration in the message.

    Raises:
        ValueError: where there are more steps than `MOST_STEPS`.
    """
    count = duration / step
    if count > MOST_STEPS:
        raise ValueError(
            f"{what} of {duration:g} s has {count:.3g} steps of {step:g} s; at most {MOST_STEPS:,}"
            " are simulated: shorten it or take a larger step"
        )


@final
class PlantDynamics(Dynamics):
    """A plant stepped by RK4 with held actuators, which move afterwards.

    This is the order of the golden runs.

    A step of the log may hold several sub-steps of the plant: inputs are held over all of them.
    """

    def __init__(self, plant: Plant, dt: float, substeps: int = 1) -> None:
        super().__init__(dt / substeps, "rk4")
        self.turn_about(plant.attitude_columns, len(plant.state_names))
        self.plant = plant
        self.substeps = substeps

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the plant; a plant has no residual.

        A step holds p = prepare(x, w).
        """
        return self.plant.derivative_prepared(x, p)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        for _ in range(self.substeps):
            x = self.plant.finish_step(self.integrate(x, self.plant.prepare(x, w), s), w, self.dt)
        return x, s


@final
class InAmbientCurrent(Dynamics):
    """A model in an ambient current that is steady and each row's own.

    u and v are velocities through the water, x and y the place over ground.

    In a current that is the same everywhere and always, a vessel moves through the water as it does
    in water at rest (T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control,
    section 8.3, irrotational ocean currents); only its position is carried away. Memory s [B, 2 +
    k]: current to the north and to the east in m/s, then the model's.

    Args:
        model: whose steps do not depend on the position.
        state: names of its state.
    """

    def __init__(self, model: Dynamics, state: Sequence[str]) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state = 2 + model.n_state
        places = torch.zeros(2, len(state), dtype=torch.float64)
        places[0, state.index("x")] = places[1, state.index("y")] = 1.0
        self.places = nn.Buffer(places, persistent=False)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        moved, memory = self.model.step(x, w, s[:, 2:])
        return moved + self.dt * s[:, :2] @ self.places.to(x.dtype), torch.cat(
            (s[:, :2], memory), dim=-1
        )
