"""A manoeuvre: a pulse of steer on a straight course."""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Seconds
from residnet.manoeuvres.base import ScheduledManoeuvre


@final
class Pulse(ScheduledManoeuvre):
    """Pulse of steer between straight courses.

    Attributes:
        kind: name of this manoeuvre in a config.
        drive: constant share of full drive.
        steer: share of full steer during the pulse; positive turns to starboard.
        start: start of the pulse.
        length: duration of the pulse.
    """

    kind: Literal["pulse"] = "pulse"
    drive: float = Field(default=0.5, ge=-1, le=1)
    steer: float = Field(default=0.3, ge=-1, le=1)
    start: Annotated[Seconds, Field(ge=0)] = 5.0
    length: Annotated[Seconds, Field(gt=0)] = 5.0

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return drive and steer [T] at times t [T] in s."""
        is_pulse = (t >= self.start) & (t < self.start + self.length)
        return torch.full_like(t, self.drive), torch.where(is_pulse, self.steer, 0.0).to(t.dtype)
