"""The predictive heading autopilot of document 004 (Gouletas 2020): law, predictors, configs.

Source: sections 6.1.1 to 6.1.3 and 6.2, eqs. (6.3), (6.4), corrections of document 004. There is no
Lightning here, to keep `residnet check` fast.
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
from residnet.autopilot.heading.controllers import ControllerConfig, ControlTask
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

    It is a network, or a model that is simulated.
    """

    @abstractmethod
    def forward(self, x: Tensor, heading: Tensor, rudder: Tensor) -> tuple[Tensor, Tensor]:
        """Return the heading errors and yaw rates [B, C] in rad and rad/s.

        Args:
            x: states [B, nx].
            heading: reference [B] of now, which the error is measured from (the source's own
                listing does so, correction G22).
            rudder: candidates [C] in rad.
        """


@final
class SimulatedPredictor(Predictor):
    """Simulates a model of the vessel, the rudder command held over the horizon.

    Args:
        model: with the columns of the controlled vessel's state; its commands begin with the rudder
            angle.
        steps: of the model, which make the horizon.
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

    What moves the vessel goes in: velocities, heel, and the rudder's angle where it takes time to
    move. Where the vessel is and heads changes nothing in calm water, so that the heading error
    itself passes through. With linear layers, as in the source's listing, the map is affine: exact
    for Nomoto's model, and no more than a tangent to the 4-DOF vessel (correction G21).

    Args:
        linear: without activations.
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
        """Take the scales from states [S, nx] and their changes [S, 2, C]."""
        inputs = x[:, self.input_columns]
        self.centre.copy_(inputs.mean(0))
        standard_deviation = inputs.std(0)
        # what does not vary says nothing; Nomoto's speed is one
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

        The angles are those that it was trained for.
        """
        change = self.predict_changes(x)
        return (heading - x[:, self.psi]).unsqueeze(-1) - change[:, 0], x[:, self.r].unsqueeze(
            -1
        ) + change[:, 1]


@final
class DocumentAutopilot(Policy):
    """The law delta = weight d_e + (1 - weight) d_r among candidate rudder angles.

    d_e leads to the smallest heading error and d_r to the smallest yaw rate.

    The source takes 41 candidates between -5 and 5 deg, weight 0.2 and a horizon of one step of
    0.01 s. There the first choice saturates and the second stops the yaw, so that it turns at 0.011
    deg/s (corrections of document 004); a horizon of seconds repairs it.

    Args:
        limit: of the candidates in rad, either side.
        candidates: how many, evenly spaced, both limits included; an odd number has the rudder
            amidships among them.
        weight: of the choice for the heading error.
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
        # from whole numbers, so that amidships is zero and both sides are alike
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
    """The vessel without variation, and without memory, as predictors expect it.

    Attributes:
        other_inputs: the other inputs at service speed [m - 1].
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
    """The settings of the law (6.4)."""

    horizon: Seconds = Field(gt=0)
    candidates: int = Field(default=41, ge=3, le=10_001)
    weight: float = Field(default=0.2, ge=0, le=1)

    def build_exact_predictor(self, task: ControlTask) -> SimulatedPredictor:
        """Return the exact predictor: a simulation of the nominal vessel.

        Long horizons are predicted in steps of at most a twentieth of T.
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
    """The predictive law of document 004 with an exact predictor of the nominal vessel.

    Attributes:
        horizon: of the prediction; the source's 0.01 s cannot settle (corrections of document 004).
        candidates: rudder angles.
        weight: of the choice for the heading error.
    """

    kind: Literal["document"] = "document"

    def build(self, task: ControlTask) -> Policy:
        return self.build_law(self.build_exact_predictor(task), task)


class PredictorSpec(Stored):
    """A description of a network that predicts heading and yaw rate by rudder angle.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        candidates: number of rudder angles.
        hidden: widths of the layers.
        linear: without activations.
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
    """Settings of a supervised training, from random states to what each rudder angle brings.

    Document 004, 6.1.1 and 6.2.1.

    Attributes:
        states: number of states for training; a fifth of this number is used for validation.
        wander: longest time under random rudder angles before a state is taken, from straight ahead
            at service speed.
        hold: mean time between these angles.
        scatter: noise that is added to these states, as a share of each channel's standard
            deviation.
        batch: states.
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
    """The predictive autopilot of document 004: a trained predictor and the control law (6.4).

    The predictor is a perceptron. It says which heading error and yaw rate each candidate rudder
    angle leads to; the law mixes the angle that is best for the one and that for the other.

    Attributes:
        horizon: how far ahead the perceptron predicts, in s; the heading cannot settle with the
            document's 0.01 s (corrections, "The controller of document 004").
        candidates: number of rudder angles that are compared, evenly spaced between the limits.
        weight: weight in (6.4) of the angle that is best for the heading error, from 0 to 1; the
            angle that is best for the yaw rate has the complement.
        hidden: widths of the hidden layers; the document has 20 units for Nomoto's model and 30 for
            the 4-DOF vessel.
        linear: leave the activations out, as the document's listing does (correction G21).
        training: how the perceptron is trained.
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
