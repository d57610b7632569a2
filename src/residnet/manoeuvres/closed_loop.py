"""Manoeuvres that steer by the motion: zigzag, turning circle, stopping trial, spiral, and those
in depth: helix, vertical zigzag and step.
"""

from __future__ import annotations

import math
from abc import ABC
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.core.frames import upright
from residnet.core.log import Log
from residnet.manoeuvres import indices
from residnet.manoeuvres.base import (
    ClosedLoop,
    Family,
    Helm,
    Manoeuvre,
    Numbers,
    Range,
    RudderSteering,
    Scheduled,
    drawn,
    rudder_share,
)

_FULL_RUDDER, _NEAR = 34.9, 0.05
"""Rudder in deg from which IMO's limits of a turning circle hold (35 deg or as much as it goes),
and the share by which a zigzag may differ from 10/10 or 20/20."""


class Zigzag(RudderSteering, ClosedLoop):
    """Steering to one side until the heading has changed by `heading`, then to the other, repeated.

    Source: document 003 section 4.2.2. The memory is the side of the command (+1 starboard, -1
    port), the heading at the start and the reversals so far.

    Attributes:
        heading: change of heading at which the steering is reversed.
        first: side of a positive steer or rudder.
        reversals: ends when the heading is back on its initial course after so many reversals;
            None: lasts as long as it is given time.
    """

    watches: ClassVar[tuple[str, ...]] = ("psi",)
    kind: Literal["zigzag"] = "zigzag"
    heading: Radians = Field(gt=0)
    first: Literal["starboard", "port"] = "starboard"
    reversals: int | None = Field(default=None, ge=1)

    @property
    def goal(self) -> str | None:
        if self.reversals is None:
            return None
        angle = f"{math.degrees(self.heading):.4g} deg"
        return f"{self.reversals} reversals at {angle} of heading and the way back"

    @property
    def begins(self) -> float:
        """The side of the first execute, +1 starboard or -1 port."""
        return self.side if self.first == "starboard" else -self.side

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        return indices.zigzag(log, self.start, self.begins, self.heading, length)

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limits of the 10/10 and 20/20 zigzag.

        Where there is no rudder the heading alone tells which of them it is.
        """
        angle = self.heading if helm.hard_over is None else abs(self.share(helm)) * helm.hard_over
        asked = [math.degrees(self.heading), math.degrees(angle)]
        for nominal in (10.0, 20.0):
            if all(abs(given - nominal) < _NEAR * nominal for given in asked):
                return indices.zigzag_limits(nominal, length, speed)
        return {}

    def numbers(self, helm: Helm) -> dict[str, Any]:
        return super().numbers(helm) | {
            "steer": self.share(helm),
            "bound": self.heading,
            "sense": self.side,
            "first": 1.0 if self.first == "starboard" else -1.0,
            "most": math.inf if self.reversals is None else float(self.reversals),
        }

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        """Return the first side, the present heading and no reversals, [B, 3]."""
        psi = seen["psi"]
        return torch.stack((numbers["first"], psi, torch.zeros_like(psi)), dim=-1)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Reverse the side where the heading has reached its bound."""
        side, origin, count = memory.unbind(-1)
        turned = side * numbers["sense"] * (seen["psi"] - origin)
        reached = turned >= numbers["bound"]
        side = torch.where(reached, -side, side)
        steer = torch.where(time >= numbers["start"], side * numbers["steer"], 0.0)
        return numbers["drive"], steer, torch.stack((side, origin, count + reached.to(side)), -1)

    @classmethod
    def ended(cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor) -> Tensor:
        """Return the rows whose heading is back after their last reversal."""
        side, origin, count = memory.unbind(-1)
        back = side * numbers["sense"] * (seen["psi"] - origin) >= 0
        return (count >= numbers["most"]) & back


class SteeringFamily(Family, ABC):
    """Manoeuvres of a steer and a drive that are uniform in their ranges.

    Attributes:
        steer: range of the share of full steer.
        drive: range of the share of full drive.
        start: time of the first helm order in s.
    """

    steer: Range = (0.25, 1.0)
    drive: Range = (0.2, 1.0)
    start: Seconds = 5.0


class ZigzagFamily(SteeringFamily):
    """Zigzags drawn at random: the heading is one of some, either side comes first.

    Attributes:
        heading: changes of heading to choose from in rad.
    """

    kind: Literal["zigzag"] = "zigzag"
    heading: tuple[Radians, ...] = Field(min_length=1)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        heading = float(random.choice(self.heading))
        steer, drive = drawn(random, self.steer), drawn(random, self.drive)
        first: Literal["starboard", "port"] = "starboard" if random.random() < 0.5 else "port"
        return Zigzag(heading=heading, steer=steer, drive=drive, start=self.start, first=first)


class SteadyConfig(Config):
    """The condition that a turn is steady: for `window` seconds r stays near its running mean.

    Attributes:
        window: how long it must stay, and time constant of the running mean; a few times what the
            vessel needs to sail its length.
        tolerance: how far it may be off, as a share of the largest yaw rate of the manoeuvre so
            far.
    """

    window: Seconds = Field(default=10.0, gt=0)
    tolerance: float = Field(default=0.005, gt=0)


def steady_at(r: Tensor) -> Tensor:
    """Return the memory [B, 3] of a steady turn: mean of r, largest |r|, and time near the mean."""
    return torch.stack((r, r.abs(), torch.zeros_like(r)), dim=-1)


def steadied(r: Tensor, numbers: Numbers, memory: Tensor) -> Tensor:
    """Return the memory [B, 3] of a steady turn one step later, with yaw rate r [B]."""
    mean, largest, calm = memory.unbind(-1)
    mean = mean + (numbers["dt"] / numbers["window"]).clamp(max=1.0) * (r - mean)
    largest = torch.maximum(largest, r.abs())
    near = (r - mean).abs() <= numbers["tolerance"] * largest
    return torch.stack((mean, largest, torch.where(near, calm + numbers["dt"], 0.0)), dim=-1)


def is_steady(numbers: Numbers, memory: Tensor) -> Tensor:
    """Return which rows [B] have a steady turn."""
    return memory[:, 2] >= numbers["window"] - 1e-9


def restarted(memory: Tensor, where: Tensor) -> Tensor:
    """Return the memory of a steady turn with the wait begun anew in rows [B] bool."""
    return torch.cat((memory[:, :2], memory[:, 2:].masked_fill(where.unsqueeze(-1), 0.0)), dim=-1)


class TurningCircle(RudderSteering, ClosedLoop):
    """Straight ahead until `start`, then the helm held until the heading has changed by `until`.

    IMO asks for 540 deg and full rudder. The memory is the heading at the helm order; 0 before the
    heading change is reached, then 1, then 2; and that of a steady turn.

    Attributes:
        until: change of heading.
        pull_out: the helm then goes amidships until the yaw rate is steady: a vessel that is
            straight-line stable stops turning.
        steady: when it is.
    """

    watches: ClassVar[tuple[str, ...]] = ("psi", "r")
    told: ClassVar[tuple[str, ...]] = ("drive", "start", "until", "side")
    kind: Literal["turning_circle"] = "turning_circle"
    until: Radians = Field(default=3.0 * math.pi, gt=0)
    pull_out: bool = False
    steady: SteadyConfig = SteadyConfig()

    @property
    def goal(self) -> str:
        turned = f"a heading change of {math.degrees(self.until):.4g} deg"
        return f"{turned} and a steady pull-out" if self.pull_out else turned

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        found = indices.turning(log, self.start, self.side, self.until, length)
        if self.pull_out and "advance" in found:
            found["pull_out_yaw_rate"] = self.side * float(log["r"][np.isfinite(log["r"])][-1])
        return found

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limits, which hold for 35 deg of rudder or as much as it goes."""
        share = abs(self.share(helm))
        angle = math.degrees(share * (helm.hard_over or 0.0))
        full = share > 0.999 or angle > _FULL_RUDDER
        return indices.turning_limits(length) if full else {}

    def numbers(self, helm: Helm) -> dict[str, Any]:
        own = {"steer": self.share(helm), "after": 1.0 if self.pull_out else 2.0}
        return super().numbers(helm) | own | dict(self.steady)

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        """Return the memory [B, 5] at the present heading, in the approach."""
        psi = seen["psi"]
        return torch.cat((torch.stack((psi, psi * 0.0), -1), steady_at(seen["r"])), dim=-1)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Hold the helm until the heading has changed, then amidships until the turn is steady."""
        origin, phase = memory[:, 0], memory[:, 1]
        steadiness = steadied(seen["r"], numbers, memory[:, 2:])
        over = time >= numbers["start"]
        origin = torch.where(over, origin, seen["psi"])
        change = numbers["side"] * (seen["psi"] - origin)
        turned = (phase == 0) & over & (change >= numbers["until"])
        steadiness = restarted(steadiness, turned)
        settled = (phase == 1) & is_steady(numbers, steadiness)
        phase = torch.where(turned, numbers["after"], torch.where(settled, 2.0, phase))
        steer = torch.where(over & (phase == 0), numbers["steer"], 0.0)
        return numbers["drive"], steer, torch.cat((torch.stack((origin, phase), -1), steadiness), 1)

    @classmethod
    def ended(cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor) -> Tensor:
        return memory[:, 1] == 2


class TurningCircleFamily(SteeringFamily):
    """Turning circles drawn at random, to either side.

    Attributes:
        until: change of heading that ends the manoeuvre in rad.
    """

    kind: Literal["turning_circle"] = "turning_circle"
    until: Radians = Field(default=3.0 * math.pi, gt=0)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        side = 1.0 if random.random() < 0.5 else -1.0
        steer, drive = side * drawn(random, self.steer), drawn(random, self.drive)
        return TurningCircle(steer=steer, drive=drive, start=self.start, until=self.until)


class Stopping(ClosedLoop):
    """Stopping: `drive` until `start`, then `astern` until the surge velocity is zero.

    The steer is zero; there is no memory.

    Attributes:
        drive: share of full drive of the approach.
        astern: share of full drive after the order, negative.
        start: time of the order in s.
    """

    watches: ClassVar[tuple[str, ...]] = ("u",)
    told: ClassVar[tuple[str, ...]] = ("drive", "astern", "start")
    kind: Literal["stopping"] = "stopping"
    drive: float = Field(gt=0, le=1)
    astern: float = Field(default=-1.0, ge=-1, le=0)
    start: Seconds = Field(default=5.0, ge=0)

    @property
    def goal(self) -> str:
        return "a surge velocity of zero"

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        return indices.stopping(log, self.start, length)

    def limits(self, helm: Helm, length: float, speed: float) -> dict[str, float]:
        """Return IMO's limit, which holds for full astern."""
        return indices.stopping_limits(length) if self.astern <= -0.999 else {}

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        return seen["u"].new_zeros(len(seen["u"]), 0)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Go astern from the order on."""
        drive = torch.where(time >= numbers["start"], numbers["astern"], numbers["drive"])
        return drive, torch.zeros_like(drive), memory

    @classmethod
    def ended(cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor) -> Tensor:
        """Return which rows [B] make no way any more."""
        return (time > numbers["start"]) & (seen["u"] <= 0)


_DOWN = (1.0, 0.6, 0.4, 0.2, 0.1, 0.0, -0.1, -0.2, -0.4, -0.6, -1.0)


class Spiral(ClosedLoop):
    """Dieudonne's spiral: helm angles from one side to the other and back, each until r is steady.

    An unstable vessel shows a loop of yaw rate over angle. The memory is the number of the present
    angle, and that of a steady turn.

    Attributes:
        drive: held throughout.
        steers: shares of full steer in their order; from one side to the other and back where
            neither these nor `rudders` are given.
        rudders: the same as rudder angles, for vessels that have one; instead of `steers`.
        start: of the first; an approach straight ahead before.
        steady: when the next follows.
    """

    watches: ClassVar[tuple[str, ...]] = ("r",)
    kind: Literal["spiral"] = "spiral"
    drive: float = Field(ge=-1, le=1)
    steers: tuple[float, ...] = ()
    rudders: tuple[Radians, ...] = ()
    start: Seconds = Field(default=5.0, ge=0)
    steady: SteadyConfig = SteadyConfig()

    @model_validator(mode="after")
    def _steers_or_rudders(self) -> Spiral:
        if self.steers and self.rudders:
            raise ValueError("give steers or rudders, not both")
        if any(abs(steer) > 1 for steer in self.steers):
            raise ValueError("steers are shares of full steer from -1 to 1")
        return self

    @property
    def angles(self) -> tuple[float, ...]:
        """Rudder angles in rad, or shares of full steer."""
        return self.rudders or self.steers or _DOWN + _DOWN[-2::-1]

    @property
    def goal(self) -> str:
        return f"a steady yaw rate at each of {len(self.angles)} helm angles"

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the steady yaw rate of each angle that was finished, and the height of the loop.

        The height is the largest difference of the yaw rates that the angle nearest to zero had;
        `steers` are shares of full steer (rad where the log has a rudder).
        """
        commands = [name for name in log.channels if name.startswith("cmd_")]
        moved = (np.abs(np.diff(log.stack(commands), axis=0)) > 1e-12).any(axis=1)
        changes = np.flatnonzero(moved & (log.t[1:] - log.t[0] >= self.start - 1e-9))
        angles = list(self.angles)
        # the first change is the order of the first angle, unless that is amidships as the approach
        # is
        held = changes if angles[0] == 0 else changes[1:]
        ends = [*held.tolist(), len(log) - 1][: len(angles)]
        rates = [float(log["r"][i]) for i in ends]
        angles = angles[: len(rates)]
        middle = min(angles, key=abs)
        amidships = [rate for angle, rate in zip(angles, rates, strict=True) if angle == middle]
        found: dict[str, Any] = {"steers": angles, "yaw_rates": rates}
        if len(amidships) > 1:
            found["loop_height"] = max(amidships) - min(amidships)
        return found

    def numbers(self, helm: Helm) -> dict[str, Any]:
        shares = [rudder_share(a, helm) if self.rudders else a for a in self.angles]
        own = {"shares": [*shares, 0.0], "count": float(len(shares))}
        return super().numbers(helm) | own | dict(self.steady)

    @classmethod
    def memory(cls, seen: Numbers, numbers: Numbers) -> Tensor:
        return torch.cat((torch.zeros_like(seen["r"])[:, None], steady_at(seen["r"])), dim=-1)

    @classmethod
    def law(
        cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Go to the next angle where the turn is steady."""
        over = time >= numbers["start"]
        steadiness = restarted(steadied(seen["r"], numbers, memory[:, 1:]), ~over)
        settled = is_steady(numbers, steadiness)
        number = torch.minimum(memory[:, 0] + settled.to(memory), numbers["count"])
        share = numbers["shares"].gather(1, number.long().unsqueeze(-1))[:, 0]
        memory = torch.cat((number.unsqueeze(-1), restarted(steadiness, settled)), dim=-1)
        return numbers["drive"], torch.where(over, share, 0.0), memory

    @classmethod
    def ended(cls, seen: Numbers, numbers: Numbers, time: float, memory: Tensor) -> Tensor:
        return memory[:, 0] >= numbers["count"]


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

    def numbers(self, helm: Helm) -> dict[str, Any]:
        first = -1.0 if self.dive < 0 else 1.0
        own = {"dive": abs(self.dive), "first": first, "bound": self.depth}
        return super().numbers(helm) | own

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
    told: ClassVar[tuple[str, ...]] = (
        "drive", "dive", "depth", "start", "gain", "damping", "pitch_damping",
    )  # fmt: skip
    kind: Literal["depth_step"] = "depth_step"
    drive: float = Field(ge=-1, le=1)
    dive: float = Field(default=0.5, gt=0, le=1)
    depth: Metres
    start: Seconds = Field(default=5.0, ge=0)
    gain: float = Field(default=0.3, gt=0)
    damping: float = Field(default=1.0, ge=0)
    pitch_damping: float = Field(default=1.0, ge=0)

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
