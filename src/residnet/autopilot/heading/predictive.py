"""The predictive heading autopilot of Gouletas 2020: law, predictors, configs.

Source: sections 6.1.1 to 6.1.3 and 6.2, eqs. (6.3), (6.4), and docs/documents/corrections.md. This
module does not import Lightning, so that `residnet check` is fast.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.autopilot.base import Policy
from residnet.autopilot.heading.controllers import (
    ClassicalController,
    ControllerConfig,
    ControlTask,
)
from residnet.autopilot.heading.vessels import SteeredVessel
from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import wrap_angle
from residnet.dynamics.base import Dynamics
from residnet.dynamics.store import Stored
from residnet.training.config import OneStage

_Units = Annotated[int, Field(ge=1)]


class Predictor(nn.Module, ABC):
    """A prediction of heading error and yaw rate after a horizon, for each of C rudder angles.

    It is a network or a simulated model.
    """

    @abstractmethod
    def forward(self, x: Tensor, heading: Tensor, rudder: Tensor) -> tuple[Tensor, Tensor]:
        """Return the heading errors and yaw rates [B, C] in rad and rad/s.

        Args:
            x: states [B, nx].
            heading: current reference [B], from which the predicted error is computed as in the
                listing of the source (see G22 in docs/documents/corrections.md).
            rudder: candidates [C] in rad.
        """


@final
class SimulatedPredictor(Predictor):
    """Prediction by simulation of a model of the vessel with a constant rudder command.

    Args:
        model: model with the state of the controlled vessel; its first input is the rudder.
        state: names of the state.
        steps: number of steps of the model in the horizon.
        other_inputs: the other inputs [m - 1], constant over the horizon.
    """

    def __init__(
        self, model: Dynamics, state: Sequence[str], steps: int, other_inputs: Tensor | None = None
    ) -> None:
        super().__init__()
        if steps < 1:
            raise ConfigError(f"the predictor's horizon must be one step or more, given {steps}")
        self.model = model
        self.steps = steps
        self.psi = state.index("psi")
        self.r = state.index("r")
        self.register_buffer(
            "other_inputs",
            torch.zeros(0) if other_inputs is None else other_inputs,
            persistent=False,
        )
        self.other_inputs: Tensor

    def forward(self, x: Tensor, heading: Tensor, rudder: Tensor) -> tuple[Tensor, Tensor]:
        n_rows = x.shape[0]
        n_candidates = rudder.shape[0]
        command = rudder.to(x.dtype).repeat(n_rows).unsqueeze(-1)
        w = torch.cat(
            (command, self.other_inputs.to(x.dtype).expand(n_rows * n_candidates, -1)), dim=-1
        )
        predicted_state = x.repeat_interleave(n_candidates, dim=0)
        memory = predicted_state[:, :0]
        for _ in range(self.steps):
            predicted_state, memory = self.model.step(predicted_state, w, memory)
        error = heading.unsqueeze(-1) - predicted_state[:, self.psi].reshape(n_rows, n_candidates)
        return error, predicted_state[:, self.r].reshape(n_rows, n_candidates)


@final
class NetworkPredictor(Predictor):
    """A perceptron that predicts the changes of heading and yaw rate over the horizon.

    It has outputs for each rudder angle (sections 6.1.2 and 6.2.2).

    Inputs are velocities, heel and, with a rate limit, the rudder angle. In calm water position and
    heading do not affect the motion, so that the network predicts the change of the heading only.
    With linear layers, as in the listing of the source, the map is affine: exact for Nomoto's
    model, but only a tangent for the 4-DOF vessel (see G21 in
    docs/documents/corrections.md).

    Args:
        state: names of the state of the vessel.
        candidates: number of rudder angles.
        hidden: widths of the hidden layers.
        linear: whether activations are omitted.
    """

    def __init__(
        self, state: Sequence[str], *, candidates: int, hidden: Sequence[int], linear: bool = False
    ) -> None:
        super().__init__()
        self.psi = state.index("psi")
        self.r = state.index("r")
        self.input_columns = [
            column for column, name in enumerate(state) if name not in ("x", "y", "psi")
        ]
        layers: list[nn.Module] = []
        width = len(self.input_columns)
        for units in hidden:
            layers += [nn.Linear(width, units), *([] if linear else [nn.Tanh()])]
            width = units
        self.network = nn.Sequential(*layers, nn.Linear(width, 2 * candidates))
        self.register_buffer("centre", torch.zeros(len(self.input_columns)))
        self.register_buffer("spread", torch.ones(len(self.input_columns)))
        self.register_buffer("offset", torch.zeros(2, candidates))
        self.register_buffer("scale", torch.ones(2, 1))
        self.centre: Tensor
        self.spread: Tensor
        self.offset: Tensor
        self.scale: Tensor

    def calibrate(self, x: Tensor, change: Tensor) -> None:
        """Set the scales from states [S, nx] and their changes [S, 2, C]."""
        inputs = x[:, self.input_columns]
        self.centre.copy_(inputs.mean(0))
        standard_deviation = inputs.std(0)
        # constant inputs, such as the speed in Nomoto's model, get a scale of one
        self.spread.copy_(
            torch.where(
                standard_deviation > 1e-9 * (1.0 + self.centre.abs()), standard_deviation, 1.0
            )
        )
        self.offset.copy_(change.mean(0))
        self.scale.copy_(
            (change - change.mean(0)).square().mean((0, 2)).sqrt().unsqueeze(-1).clamp(min=1e-12)
        )

    def predict_changes(self, x: Tensor) -> Tensor:
        """Return the changes of heading and yaw rate [B, 2, C] over the horizon."""
        network_output: Tensor = self.network(
            (x[:, self.input_columns] - self.centre) / self.spread
        )
        return network_output.reshape(len(x), 2, -1) * self.scale + self.offset

    def forward(self, x: Tensor, heading: Tensor, rudder: Tensor) -> tuple[Tensor, Tensor]:
        """Return the heading errors and yaw rates [B, C].

        The rudder angles must be those of the training, since they only select outputs.
        """
        change = self.predict_changes(x)
        return (heading - x[:, self.psi]).unsqueeze(-1) - change[:, 0], x[:, self.r].unsqueeze(
            -1
        ) + change[:, 1]


@final
class DocumentAutopilot(Policy):
    """The law delta = weight d_e + (1 - weight) d_r among candidate rudder angles.

    d_e gives the smallest predicted heading error and d_r the smallest predicted yaw rate.

    The source uses 41 candidates between -5 and 5 deg, a weight of 0.2 and a horizon of one step of
    0.01 s. With this horizon d_e is saturated and d_r stops the yaw, so that the vessel turns at
    only 0.011 deg/s (see docs/documents/corrections.md). A horizon of seconds avoids this.

    Args:
        predictor: prediction for the candidates.
        limit: largest rudder angle of the candidates in rad, to both sides.
        candidates: number of evenly spaced candidates, including both limits; an odd number
            includes the rudder amidships.
        weight: weight of d_e.
    """

    def __init__(
        self, predictor: Predictor, *, limit: float, candidates: int = 41, weight: float = 0.2
    ) -> None:
        super().__init__()
        if limit <= 0 or candidates < 2 or not 0 <= weight <= 1:
            raise ConfigError(
                "document autopilot: limit > 0, candidates >= 2 and 0 <= weight <= 1, given"
                f" {limit:g}, {candidates}, {weight:g}"
            )
        self.predictor = predictor
        self.weight = weight
        # from integers, so that amidships is exactly zero and both sides are symmetric
        angles = limit * (
            torch.arange(1 - candidates, candidates, 2, dtype=torch.float64) / (candidates - 1)
        )
        self.register_buffer("rudder", angles, persistent=False)
        self.rudder: Tensor

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rudder command [B, 1] in rad; there is no memory.

        Args:
            x: state [B, nx].
            reference: heading [B, 1] in rad.
            s: memory [B, 0].
        """
        error, rate = self.predictor(x, reference[:, 0], self.rudder)
        rudder = self.rudder.to(x.dtype)
        heading_rudder = rudder[wrap_angle(error).abs().argmin(-1)]
        rate_rudder = rudder[rate.abs().argmin(-1)]
        return (self.weight * heading_rudder + (1.0 - self.weight) * rate_rudder).unsqueeze(-1), s


@final
class NominalSteering(Dynamics):
    """The nominal vessel as dynamics without memory, as required by predictors.

    Attributes:
        other_inputs: inputs other than the rudder at service speed [m - 1].
    """

    def __init__(self, vessel: SteeredVessel, dt: float) -> None:
        super().__init__(dt, "rk4")
        self.nominal_model = vessel.model(dt)
        self.other_inputs = vessel.straight_course(torch.ones(1, dtype=torch.float64))[1][0, 1:]
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
        self.register_buffer("nominal_memory", vessel.memory(nominal), persistent=False)
        self.nominal_memory: Tensor

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.nominal_model.step(
            x, w, self.nominal_memory.to(x.dtype).expand(x.shape[0], -1)
        )[0], s


class _PredictiveLawConfig(Config):
    """Settings of the control law of Gouletas 2020, eq. (6.4)."""

    horizon: Seconds = Field(gt=0)
    candidates: int = Field(default=41, ge=3, le=10_001)
    weight: float = Field(default=0.2, ge=0, le=1)

    def build_exact_predictor(self, task: ControlTask) -> SimulatedPredictor:
        """Return the exact predictor: a simulation of the nominal vessel.

        Long horizons are divided into steps of about a twentieth of T, which are accurate enough.
        """
        steps = math.ceil(self.horizon / max(task.nomoto.time / 20.0, task.dt))
        model = NominalSteering(task.vessel, self.horizon / steps)
        return SimulatedPredictor(model, task.vessel.state, steps, model.other_inputs)

    def build_law(self, predictor: Predictor, task: ControlTask) -> DocumentAutopilot:
        """Return the controller with some predictor of this horizon."""
        return DocumentAutopilot(
            predictor, limit=task.limit, candidates=self.candidates, weight=self.weight
        )


class DocumentConfig(_PredictiveLawConfig, ControllerConfig):
    """The predictive law of Gouletas 2020 with an exact predictor of the nominal vessel.

    Attributes:
        horizon: horizon of the prediction in s; the heading does not settle with the 0.01 s of the
            source (see docs/documents/corrections.md).
        candidates: number of rudder angles.
        weight: weight of the angle with the smallest heading error.
    """

    kind: Literal["document"] = "document"

    def build(self, task: ControlTask) -> Policy:
        return self.build_law(self.build_exact_predictor(task), task)


AnyController = Annotated[ClassicalController | DocumentConfig, Field(discriminator="kind")]
"""Settings of a controller that is not trained: a classical law or the predictive one."""


class PredictorSpec(Stored):
    """A description of a network that predicts heading and yaw rate by rudder angle.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        candidates: number of rudder angles.
        hidden: widths of the layers.
        linear: whether activations are omitted.
    """

    schema_name: Literal["residnet.heading_predictor/1"] = Field(
        default="residnet.heading_predictor/1", alias="schema"
    )
    state: tuple[str, ...]
    candidates: int = Field(ge=1, le=10_001)
    hidden: tuple[int, ...]
    linear: bool

    def build(self) -> NetworkPredictor:
        """Return the network with its weights not yet trained, in float64."""
        return NetworkPredictor(
            self.state, candidates=self.candidates, hidden=self.hidden, linear=self.linear
        ).double()


class PredictorTraining(OneStage):
    """Settings of the supervised training on random states and their simulated changes.

    Gouletas 2020, 6.1.1 and 6.2.1.

    Attributes:
        states: number of states for training; a fifth of this number is used for validation.
        wander: longest time with random rudder angles before a state is sampled, from straight
            motion at service speed.
        hold: mean time between changes of these angles.
        scatter: noise added to the states, relative to the standard deviation of each channel.
        batch: number of states in a batch.
    """

    states: int = Field(default=4000, ge=100, le=10_000_000)
    wander: Seconds = Field(default=30.0, gt=0)
    hold: Seconds = Field(default=4.0, gt=0)
    scatter: float = Field(default=0.2, ge=0)
    epochs: int = Field(default=50, ge=1, le=100_000)
    batch: int = Field(default=100, ge=1, le=1_000_000)
    learning_rate: float = Field(default=2e-2, gt=0)
    final: float = Field(default=0.01, gt=0, le=1)
    gradient_clip: float = Field(default=10.0, gt=0)


class PredictiveConfig(_PredictiveLawConfig):
    """The predictive autopilot of Gouletas 2020: a trained predictor and the control law (6.4).

    The predictor is a perceptron. It predicts heading error and yaw rate for each candidate rudder
    angle; the law is a weighted mean of the angles that minimise the one and the other.

    Attributes:
        horizon: horizon of the prediction, in s; the heading does not settle with the
            0.01 s of the source (see docs/documents/corrections.md).
        candidates: number of rudder angles that are compared, evenly spaced between the limits.
        weight: weight in eq. (6.4) of the angle with the smallest heading error, from 0 to 1.
        hidden: widths of the hidden layers; the source has 20 units for Nomoto's model and 30 for
            the 4-DOF vessel.
        linear: whether activations are omitted, as in the listing of the source (see G21 in
            docs/documents/corrections.md).
        training: settings of the training.
    """

    hidden: Annotated[tuple[_Units, ...], Field(min_length=1)] = (20,)
    linear: bool = False
    training: PredictorTraining = PredictorTraining()

    def predictor_spec(self, task: ControlTask) -> PredictorSpec:
        """Return the description of the perceptron for a vessel."""
        return PredictorSpec(
            state=tuple(task.vessel.state),
            candidates=self.candidates,
            hidden=tuple(self.hidden),
            linear=self.linear,
        )
