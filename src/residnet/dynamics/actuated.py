"""A learned model with actuators in front, flown by commands like the vessel itself."""

from __future__ import annotations

from typing import Literal, final

import torch
from torch import Tensor

from residnet.core.errors import ConfigError
from residnet.core.layout import actuators, motion
from residnet.core.names import STATE, nearest
from residnet.dynamics.base import Dynamics
from residnet.dynamics.gear import Gear, commanded
from residnet.dynamics.hybrid import HybridDynamics


@final
class ActuatedDynamics(Dynamics):
    """A learned model behind actuators, with states x [B, 6 + k] and the gear's inputs w [B, m].

    The state is x, y, psi, u, v, r, then the states of the gear.

    Each input of the model is a state of the gear where it has one of that name, else an input of
    the gear, else the command of that name (`cmd_delta` for `delta`: a rudder that stands at its
    command at once has no state). A model that was fitted on inputs averaged over each step (`hold:
    mean`) is given the mean of the values at the step's ends, as in its fit.

    Args:
        model: the learned model.
        columns: names of the model's inputs, `spec.signals.columns`.
        hold: of the model's inputs, `spec.hold`.
        gear: with the step of the model.

    Raises:
        ConfigError: where the gear has nothing for an input of the model.
    """

    def __init__(
        self,
        model: HybridDynamics,
        columns: tuple[str, ...],
        hold: Literal["start", "mean"],
        gear: Gear,
    ) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.gear = gear
        self.n_state = model.n_state
        self.state = (*STATE, *gear.state)
        self.mean = hold == "mean"
        names = [*gear.state, *gear.inputs]
        self.take: list[int] = []
        for name in columns:
            found = next((given for given in (name, commanded(name)) if given in names), None)
            if found is None:
                raise ConfigError(
                    f"the model is driven by '{name}', which the vessel's actuators do not"
                    f" have{nearest(name, names)}"
                )
            self.take.append(names.index(found))

    def initial_state(self, batch: int) -> Tensor:
        """Return the memory [batch, n_state] without a past."""
        return self.model.initial_state(batch)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, 6 + k] of the model at a stage; the gear moves once per step."""
        return torch.cat(
            (self.model.rate(motion(x), p, rho), torch.zeros_like(actuators(x))), dim=-1
        )

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later."""
        a = actuators(x)
        moved = self.gear.move(a, w)
        given = torch.cat((a, w), dim=-1)[:, self.take]
        if self.mean:
            given = 0.5 * (given + torch.cat((moved, w), dim=-1)[:, self.take])
        y, s = self.model.step(motion(x), given, s)
        return torch.cat((y, moved), dim=-1), s
