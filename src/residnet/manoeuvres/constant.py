"""Constant input: from rest to the steady state of a speed or a turn.

Source: document 003 section 4.2.2.
"""

from __future__ import annotations

from itertools import product
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config
from residnet.manoeuvres.base import Manoeuvre, Scheduled


class ConstantInput(Scheduled):
    """Drive and steer held from the start.

    Attributes:
        drive: share of full drive, -1 to 1.
        steer: share of full steer, -1 to 1; positive turns to starboard.
    """

    kind: Literal["constant"] = "constant"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return constant drive and steer [T]."""
        return torch.full_like(t, self.drive), torch.full_like(t, self.steer)


class ConstantFamily(Config):
    """Every combination of some drives and steers.

    Attributes:
        drive: shares of full drive, -1 to 1.
        steer: shares of full steer, -1 to 1.
    """

    kind: Literal["constant"] = "constant"
    drive: tuple[float, ...] = Field(min_length=1)
    steer: tuple[float, ...] = Field(min_length=1)

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Return one manoeuvre per combination; nothing is random."""
        return [ConstantInput(drive=d, steer=s) for d, s in product(self.drive, self.steer)]
