"""A learned model as heading controllers see it, to train policies on."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from residnet.control.heading.steering import SteeredPlant, SteeredVessel
from residnet.core.errors import ConfigError
from residnet.core.names import STATE, nearest
from residnet.dynamics.actuated import commanded
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.steering_variation import VariedModel


@final
class SteeredModel(SteeredVessel):
    """A learned model with the steering gear and straight courses of the vessel that it models.

    Args:
        model: hybrid model of the hull.
        columns: names of its inputs; the rudder's is `delta` or `cmd_delta`, the others are
            commands of the vessel.
        hold: whether its inputs are those at a step's start or means over the step.
        vessel: in calm water.

    Raises:
        ConfigError: where the model has no rudder, or an input that the vessel does not command.
    """

    def __init__(
        self, model: HybridDynamics, columns: tuple[str, ...], hold: str, vessel: SteeredPlant
    ) -> None:
        self.hull, self.vessel, self.mean = model, vessel, hold == "mean"
        self.state = STATE if vessel.rate is None else (*STATE, "delta")
        self.inputs, self.rate = vessel.inputs, vessel.rate
        if not {"delta", "cmd_delta"} & set(columns):
            raise ConfigError(
                "heading control needs a model that is driven by 'delta' or 'cmd_delta'; its"
                f" inputs are {', '.join(columns)}"
            )
        self.any_step = model.n_state == 0
        self.take: list[int] = []
        for name in columns:
            command = commanded(name)
            if command not in vessel.inputs:
                raise ConfigError(
                    f"the model is driven by '{name}', which the vessel does not"
                    f" command{nearest(command, vessel.inputs)}"
                )
            self.take.append(vessel.inputs.index(command))

    def model(self, dt: float, integrator: str = "rk4") -> Dynamics:
        """Return the model, varied, with its own integrator.

        One without memory takes steps of any length.
        """
        return VariedModel(self.hull, dt, self.take, self.mean, self.rate)

    def memory(self, variation: Tensor) -> Tensor:
        """Return the variation, then the head's memory without a past."""
        return torch.cat((variation, variation.new_zeros(len(variation), self.hull.n_state)), dim=1)

    def start(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the states [B, nx] and inputs [B, m] of straight courses."""
        x, w = self.vessel.start(speed)
        return x[:, [self.vessel.column(name) for name in self.state]], w
