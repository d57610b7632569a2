"""Settings of the predictor of document 004's autopilot, without Lightning.

`residnet check` must stay quick.
"""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Seconds
from residnet.training.one_stage import OneStage


class PredictorTraining(OneStage):
    """Settings of a supervised training, from random states to what each rudder angle brings.

    Document 004, 6.1.1 and 6.2.1.

    Attributes:
        states: to train on; a fifth as many are kept back to validate on.
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
