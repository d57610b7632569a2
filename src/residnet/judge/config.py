"""What a run is judged by."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, MetresPerSecond, RadiansPerSecond
from residnet.core.names import nearest
from residnet.judge.protocol import ProtocolConfig


class Scales(Config):
    """Scales that nrmse divides by: typical spreads of the measured velocities.

    Other logs that a run is evaluated on are judged by the same scales.

    Attributes:
        u: of the surge velocity in m/s.
        v: of the sway velocity in m/s.
        r: of the yaw rate in rad/s.
    """

    u: Annotated[MetresPerSecond, Field(gt=0)]
    v: Annotated[MetresPerSecond, Field(gt=0)]
    r: Annotated[RadiansPerSecond, Field(gt=0)]

    def array(self) -> np.ndarray:
        """Return the scales of u, v, r as one array [3], in m/s, m/s, rad/s."""
        return np.array([self.u, self.v, self.r])

    def named(self) -> dict[str, float]:
        """Return the scales by the name of the velocity."""
        return {"u": float(self.u), "v": float(self.v), "r": float(self.r)}


class EvaluationConfig(Config):
    """Settings of the evaluation: protocols and scales.

    Attributes:
        protocols: by name; the name stands in metrics.json.
        selection: the protocol whose mean nrmse over the validation windows chooses between models
            and stops training early.
        scales: what nrmse divides by.
        groups: named sets of manoeuvre kinds that get rows of their own.
        divergence: a free run diverges where a velocity exceeds this many times its largest
            training value.
        splits: which splits are evaluated.
    """

    protocols: dict[str, ProtocolConfig] = Field(min_length=1)
    selection: str
    scales: Scales
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    divergence: float = Field(default=3.0, gt=1)
    splits: tuple[Literal["train", "validation", "test"], ...] = ("train", "validation", "test")

    @model_validator(mode="after")
    def _names(self) -> EvaluationConfig:
        if self.selection not in self.protocols:
            raise ValueError(
                f"selection '{self.selection}' is not a"
                f" protocol{nearest(self.selection, self.protocols)}"
            )
        if "validation" not in self.splits:
            raise ValueError("splits must contain 'validation': models are selected on it")
        return self
