"""A vessel that a current carries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.dynamics.base import Dynamics


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
        self.register_buffer("places", places, persistent=False)
        self.places: Tensor

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot of the model, through the water."""
        return self.model.rate(x, p, rho)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        moved, memory = self.model.step(x, w, s[:, 2:])
        return moved + self.dt * s[:, :2] @ self.places.to(x.dtype), torch.cat(
            (s[:, :2], memory), dim=-1
        )
