"""Manoeuvres in depth: the helix, the vertical zigzag and the step of depth."""

from __future__ import annotations

from abc import ABC
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Metres, Seconds
from residnet.core.frames import upright
from residnet.manoeuvres.base import ClosedLoop, Family, Manoeuvre, Numbers, Range, Scheduled, drawn


class Helix(Scheduled):
    """Drive, steer and dive held: a turn in which the vessel descends or climbs.

    Attributes:
        drive: share of full drive, -1 to 1.
        steer: share of full steer; positive turns to starboard.
        dive: share of full dive; positive descends.
        start: when steer and dive begin.
    """

    kind: Literal["helix"] = "helix"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)
    dive: float = Field(ge=-1, le=1)
    start: Seconds = Field(default=5.0, ge=0)

    def demands(self, t: Tensor) -> tuple[Tensor, ...]:
        over = (t >= self.start - 1e-9).to(t.dtype)
        return torch.full_like(t, self.drive), self.steer * over, self.dive * over


class DivingFamily(Family, ABC):
    """Manoeuvres in depth drawn at random, to either side, down or up first.

    Attributes:
        count: how many.
        drive: range of the share of full drive.
        dive: range of the share of full dive.
        start: when it begins.
    """

    drive: Range = (0.4, 0.8)
    dive: Range = (0.2, 0.6)
    start: Seconds = 5.0

    def drawn(self, random: np.random.Generator) -> dict[str, Any]:
        """Return drive and start, and the dive to either side."""
        side = 1.0 if random.random() < 0.5 else -1.0
        drive, dive = drawn(random, self.drive), drawn(random, self.dive)
        return {"drive": drive, "dive": side * dive, "start": self.start}


class HelixFamily(DivingFamily):
    """Helices drawn at random.

    Attributes:
        steer: range of the share of full steer.
    """

    kind: Literal["helix"] = "helix"
    steer: Range = (0.2, 0.8)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        side = 1.0 if random.random() < 0.5 else -1.0
        return Helix(steer=side * drawn(random, self.steer), **self.drawn(random))


class VerticalZigzag(ClosedLoop):
    """Diving until the depth has changed by `depth`, then climbing as far beyond it, repeated.

    The memory is the side of the demand (+1 down) and the depth at the start.

    Attributes:
        drive: held throughout.
        dive: share of full dive; a negative one climbs first.
        depth: change of depth at which the dive is reversed.
        start: when it begins.
    """

    watches: ClassVar[tuple[str, ...]] = ("z",)
    kind: Literal["vertical_zigzag"] = "vertical_zigzag"
    drive: float = Field(ge=-1, le=1)
    dive: float = Field(ge=-1, le=1)
    depth: Metres = Field(gt=0)
    start: Seconds = Field(default=5.0, ge=0)

    def numbers(self, helm: Any) -> dict[str, Any]:
        """Return demands and bound."""
        first = -1.0 if self.dive < 0 else 1.0
        return {
            "drive": self.drive,
            "dive": abs(self.dive),
            "first": first,
            "bound": self.depth,
            "start": self.start,
        }

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        """Return the first side and the present depth, [B, 2]."""
        return torch.stack((numbers["first"], seen["z"]), dim=-1)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Reverse the side where the depth has reached its bound."""
        side, origin = memory.unbind(-1)
        side = torch.where(side * (seen["z"] - origin) >= numbers["bound"], -side, side)
        dive = torch.where(time >= numbers["start"], side * numbers["dive"], 0.0)
        still = torch.zeros_like(dive)
        return numbers["drive"], still, dive, torch.stack((side, origin), dim=-1)


class VerticalZigzagFamily(DivingFamily):
    """Vertical zigzags drawn at random.

    Attributes:
        depth: changes of depth to choose from.
    """

    kind: Literal["vertical_zigzag"] = "vertical_zigzag"
    depth: tuple[Metres, ...] = Field(min_length=1)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        return VerticalZigzag(depth=float(random.choice(self.depth)), **self.drawn(random))


class DepthStep(ClosedLoop):
    """A new depth, held by a law that sees depth, its rate and the pitch rate; steer is zero.

    The memory is the depth at the start.

    Attributes:
        drive: held throughout.
        dive: largest share of full dive.
        depth: change of depth; positive is deeper.
        start: when it is ordered.
        gain: dive per metre of depth that lacks.
        damping: dive per m/s of descent.
        pitch_damping: dive per rad/s of pitch rate.
    """

    watches: ClassVar[tuple[str, ...]] = ("z", "u", "v", "w", "phi", "theta", "q")
    kind: Literal["depth_step"] = "depth_step"
    drive: float = Field(ge=-1, le=1)
    dive: float = Field(default=0.5, gt=0, le=1)
    depth: Metres
    start: Seconds = Field(default=5.0, ge=0)
    gain: float = Field(default=0.3, gt=0)
    damping: float = Field(default=1.0, ge=0)
    pitch_damping: float = Field(default=1.0, ge=0)

    def numbers(self, helm: Any) -> dict[str, Any]:
        """Return demands and gains."""
        names = ("drive", "dive", "depth", "start", "gain", "damping", "pitch_damping")
        return {name: getattr(self, name) for name in names}

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        """Return the present depth, [B, 1]."""
        return seen["z"].unsqueeze(-1)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, ...]:
        """Dive by what lacks of the depth, less its rate."""
        ordered = torch.where(time >= numbers["start"], numbers["depth"], 0.0)
        lacking = memory[:, 0] + ordered - seen["z"]
        descent = upright(*(seen[name] for name in ("u", "v", "w", "phi", "theta")))[2]
        dive = numbers["gain"] * lacking - numbers["damping"] * descent
        dive = dive + numbers["pitch_damping"] * seen["q"]
        dive = torch.minimum(torch.maximum(dive, -numbers["dive"]), numbers["dive"])
        return numbers["drive"], torch.zeros_like(dive), dive, memory


class DepthStepFamily(DivingFamily):
    """Steps of depth drawn at random.

    Attributes:
        depth: changes of depth to choose from.
    """

    kind: Literal["depth_step"] = "depth_step"
    depth: tuple[Metres, ...] = Field(min_length=1)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        common = self.drawn(random)
        side = np.sign(common["dive"])
        depth = float(side * random.choice(self.depth))
        return DepthStep(depth=depth, **{**common, "dive": abs(common["dive"])})
