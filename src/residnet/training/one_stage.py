"""Trainings of one stage, without Lightning: `residnet check` must stay quick."""

from __future__ import annotations

import math

from pydantic import Field

from residnet.core.config import Config


class OneStage(Config):
    """Settings of a training in one stage, with a learning rate that falls along a cosine.

    Attributes:
        epochs: at most.
        learning_rate: of Adam in the first epoch.
        final: share of it in the last.
        gradient_clip: largest norm of the gradient.
        patience: stop when this many validations in a row bring nothing better.
        validate_every: epochs between validations.
    """

    epochs: int = Field(default=20, ge=1, le=100_000)
    learning_rate: float = Field(default=1e-2, gt=0)
    final: float = Field(default=0.02, gt=0, le=1)
    gradient_clip: float = Field(default=1.0, gt=0)
    patience: int = Field(default=1000, ge=1)
    validate_every: int = Field(default=1, ge=1)

    @property
    def last_stage(self) -> int:
        """Number of the only stage, 0."""
        return 0

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return stage 0, the only one, and the epoch."""
        return 0, epoch

    def rate(self, epoch: int) -> float:
        """Return the learning rate of an epoch."""
        progress = 0.5 * (1 - math.cos(math.pi * epoch / max(self.epochs - 1, 1)))
        return self.learning_rate * (1 - progress * (1 - self.final))
