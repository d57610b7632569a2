"""A manoeuvre: one pulse of steer on a straight course."""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Seconds
from residnet.manoeuvres.base import ScheduledManoeuvre


@final
class Pulse(ScheduledManoeuvre):
    """Steer for a while, then straight on.

    Attributes:
        kind: names this manoeuvre in a config.
        drive: share of full drive, held throughout.
        steer: share of full steer during the pulse; positive turns to starboard.
        start: when the pulse begins, in s.
        length: of the pulse, in s.
    """

    kind: Literal["pulse"] = "pulse"
    drive: float = Field(default=0.5, ge=-1, le=1)
    steer: float = Field(default=0.3, ge=-1, le=1)
    start: Annotated[Seconds, Field(ge=0)] = 5.0
    length: Annotated[Seconds, Field(gt=0)] = 5.0

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return drive and steer [T] at times t [T] in s."""
        within = (t >= self.start) & (t < self.start + self.length)
        return torch.full_like(t, self.drive), torch.where(within, self.steer, 0.0).to(t.dtype)
