"""Config of the predictive heading autopilot of document 004 (Gouletas 2020)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.training.policies.predictor_config import PredictorTraining

_Units = Annotated[int, Field(ge=1)]


class PredictiveConfig(Config):
    """The predictive autopilot of document 004: a trained predictor and the control law (6.4).

    The predictor is a perceptron. It says which heading error and yaw rate each candidate rudder
    angle leads to; the law mixes the angle that is best for the one and that for the other.

    Attributes:
        horizon: how far ahead the perceptron predicts, in s; the heading cannot settle with the
            document's 0.01 s (corrections, "The controller of document 004").
        candidates: number of rudder angles that are compared, evenly spaced between the limits.
        weight: weight in (6.4) of the angle that is best for the heading error, from 0 to 1; the
            angle that is best for the yaw rate has the rest.
        hidden: widths of the hidden layers; the document has 20 units for Nomoto's model and 30 for
            the 4-DOF vessel.
        linear: leave the activations out, as the document's listing does (correction G21).
        training: how the perceptron is trained.
    """

    horizon: Seconds = Field(gt=0)
    candidates: int = Field(default=41, ge=3, le=10_001)
    weight: float = Field(default=0.2, ge=0, le=1)
    hidden: Annotated[tuple[_Units, ...], Field(min_length=1)] = (20,)
    linear: bool = False
    training: PredictorTraining = PredictorTraining()
