"""Manoeuvres of demands that are known in advance: steps, levels, random steps, sines, replays.

Source: document 003 section 4.2.2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import product
from typing import Annotated, Any, Literal, final

import numpy as np
import torch
from pydantic import AfterValidator, Field, PrivateAttr, model_validator
from torch import Tensor

from residnet.core.config import Config, ExistingPath, Hertz, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import STATE, VELOCITY, nearest
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import (
    Family,
    Helm,
    Manoeuvre,
    Range,
    Scheduled,
    ScheduleSource,
    drawn,
)


class ConstantInput(Scheduled):
    """Drive and steer held from the start: from rest to the steady state of a speed or a turn.

    Attributes:
        drive: share of full drive, -1 to 1.
        steer: share of full steer, -1 to 1; positive turns to starboard.
    """

    kind: Literal["constant"] = "constant"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
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


class AccelerationDeceleration(Scheduled):
    """Speed steps straight ahead: drive levels, each held from its time on; the steer is zero.

    Attributes:
        times: when each level begins in s, ascending.
        levels: drive from -1 to 1 from that time on.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    times: tuple[Seconds, ...] = Field(min_length=1)
    levels: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _pairs(self) -> AccelerationDeceleration:
        if len(self.times) != len(self.levels) or list(self.times) != sorted(self.times):
            raise ValueError("times and levels need the same number of entries, times ascending")
        return self

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stepped drive [T], zero before the first time; zero steer [T]."""
        index = torch.searchsorted(torch.tensor(self.times, dtype=t.dtype), t, right=True)
        return torch.tensor((0.0, *self.levels), dtype=t.dtype)[index], torch.zeros_like(t)


class AccelerationDecelerationFamily(Family):
    """Steps between a high and a low level, drawn at random.

    The high level is lowered by a quarter and by half in turn; all is uniform in its range.

    Attributes:
        high: range of the high level of the drive.
        low: range of the low level of the drive.
        hold: range of the time for which a level is held in s.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    high: Range = (0.4, 1.0)
    low: Range = (0.0, 0.3)
    hold: tuple[Seconds, Seconds] = (6.0, 12.0)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        number = np.arange(int(duration / self.hold[0]) + 2)
        high, low = drawn(random, self.high), drawn(random, self.low)
        holds = random.uniform(*self.hold, size=number.size)
        times = np.concatenate(([0.0], np.cumsum(holds)[:-1]))
        peaks = high * np.array([1.0, 0.75, 0.5])[(number // 2) % 3]
        levels = np.where(number % 2 == 0, peaks, low)
        inside = times < duration
        return AccelerationDeceleration(
            times=tuple(times[inside].tolist()), levels=tuple(levels[inside].tolist())
        )


_PATTERN = (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0)


class ThreeTwoOneOne(Scheduled):
    """The 3-2-1-1 pattern: steering steps of 3, 2, 1 and 1 units to alternating sides.

    It excites a broad band. The steer is zero after it.

    Attributes:
        drive: share of full drive, -1 to 1.
        steer: share of full steer, -1 to 1; positive turns to starboard first.
        start: when the steering begins in s; before, the vessel goes straight ahead.
        unit: length of the shortest step in s.
        repeat: whether the pattern is repeated to the end.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)
    start: Seconds = Field(default=5.0, ge=0)
    unit: Seconds = Field(gt=0)
    repeat: bool = True

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        # times on the grid must not fall short of their unit by rounding
        units = torch.floor((t - self.start) / self.unit + 1e-9).long()
        pattern = torch.tensor(_PATTERN, dtype=t.dtype)
        steer = self.steer * pattern[units.clamp(min=0) % len(_PATTERN)]
        active = (units >= 0) & (self.repeat | (units < len(_PATTERN)))
        return torch.full_like(t, self.drive), torch.where(active, steer, torch.zeros_like(t))


class ThreeTwoOneOneFamily(Family):
    """3-2-1-1 manoeuvres with unit, steer and drive uniform in their ranges, repeated.

    Attributes:
        unit: range of the shortest step in s.
        steer: range of the share of full steer.
        drive: range of the share of full drive.
        start: when the steering begins in s.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    unit: tuple[Seconds, Seconds] = (2.0, 4.0)
    steer: Range = (0.4, 1.0)
    drive: Range = (0.1, 0.9)
    start: Seconds = 5.0

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        unit, steer, drive = (drawn(random, span) for span in (self.unit, self.steer, self.drive))
        return ThreeTwoOneOne(unit=unit, steer=steer, drive=drive, start=self.start)


def _ordered(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 < band[0] < band[1]:
        raise ValueError(
            f"a band goes from a low to a higher frequency above zero, given {band[0]:g} Hz to"
            f" {band[1]:g} Hz"
        )
    return band


Band = Annotated[tuple[Hertz, Hertz], AfterValidator(_ordered)]
"""Lowest and highest frequency."""
_DRIVE, _STEER, _SWAY, _DIVE, _OWN = range(5)


class Excitation(Scheduled, ABC):
    """Random demands over a band of frequencies.

    Attributes:
        drive: mean drive.
        drive_amplitude: how far the drive goes to either side of it.
        steer_amplitude: how far the steer goes to either side of zero.
        sway_amplitude: how far the sway force goes to either side of zero, in shares of the
            largest; for vessels whose commands are forces.
        dive_amplitude: how far the dive goes to either side of zero; for vessels that dive.
        own_amplitude: how far each command moves by itself, in shares of full steer: what tells one
            of several thrusters from the others.
        band: frequencies that the demands excite.
        seed: of everything random.
        start: when they begin; before, the drive is held and the steer is zero.
    """

    drive: float = Field(ge=-1, le=1)
    drive_amplitude: float = Field(default=0.0, ge=0, le=2)
    steer_amplitude: float = Field(default=0.0, ge=0, le=1)
    sway_amplitude: float = Field(default=0.0, ge=0, le=1)
    dive_amplitude: float = Field(default=0.0, ge=0, le=1)
    own_amplitude: float = Field(default=0.0, ge=0, le=1)
    band: Band
    seed: int = Field(default=0, ge=0)
    start: Seconds = Field(default=5.0, ge=0)

    @abstractmethod
    def _wave(self, t: Tensor, which: int) -> Tensor:
        """Return the wave [T] within +-1 of a demand at times t [T] since the start in s."""

    def _after_start(self, t: Tensor, which: int) -> Tensor:
        wave = self._wave((t - self.start).clamp(min=0.0), which)
        return torch.where(t >= self.start - 1e-9, wave, torch.zeros_like(t))

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        drive = self.drive + self.drive_amplitude * self._after_start(t, _DRIVE)
        return drive.clamp(-1.0, 1.0), self.steer_amplitude * self._after_start(t, _STEER)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the playback of the demands, with the sway forces where there are any.

        Raises:
            UsageError: where a sway force is asked of a vessel whose commands are no forces.
        """
        own = [manoeuvre for manoeuvre in manoeuvres if isinstance(manoeuvre, Excitation)]
        drive, steer = map(torch.stack, zip(*(m.demands(t) for m in own), strict=True))
        dive = torch.stack([m.dive_amplitude * m._after_start(t, _DIVE) for m in own])
        commands = helm.commanded(drive, steer, *([dive] if bool(dive.any()) else []))
        sway = torch.stack([m.sway_amplitude * m._after_start(t, _SWAY) for m in own])
        if bool(sway.any()):
            limit = helm.side_force
            if limit is None or "tau_y" not in helm.inputs:
                raise UsageError(
                    "sway_amplitude: a manoeuvre asks for a sway force, but the vessel's commands"
                    f" are {', '.join(helm.inputs[:2])} and no forces; leave it out"
                )
            commands[..., helm.inputs.index("tau_y")] += limit * sway
        if any(m.own_amplitude for m in own):
            full = helm.demand(torch.zeros_like(steer[0, :1]), torch.ones_like(steer[0, :1])).abs()
            if helm.diving is not None:
                full = torch.maximum(full, helm.diving.abs())
            for i in range(commands.shape[-1]):
                waves = [m.own_amplitude * m._after_start(t, _OWN + i) for m in own]
                commands[..., i] += full[0, i] * torch.stack(waves)
        return ScheduleSource(commands)


class RandomSteps(Excitation):
    """Drive and steer that jump to random levels.

    Levels are uniform within their amplitudes; each is held for half a period of a random frequency
    of the band.
    """

    kind: Literal["random_steps"] = "random_steps"

    def _wave(self, t: Tensor, which: int) -> Tensor:
        random = np.random.default_rng([self.seed, which])
        span, times, levels = float(t[-1]), [0.0], [random.uniform(-1.0, 1.0)]
        while times[-1] <= span:
            times.append(times[-1] + 0.5 / random.uniform(*self.band))
            levels.append(random.uniform(-1.0, 1.0))
        index = torch.searchsorted(torch.tensor(times, dtype=t.dtype), t + 1e-9, right=True) - 1
        return torch.tensor(levels, dtype=t.dtype)[index]


class MultiSine(Excitation):
    """Sums of sines at frequencies spread evenly in their logarithm over the band.

    Each demand has frequencies of its own. The phases are the ones with the flattest sum of some
    random draws, so that the amplitude is well used; what is beyond it after ten periods of the
    lowest frequency is clipped.

    Attributes:
        tones: frequencies of each of drive and steer.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def _wave(self, t: Tensor, which: int) -> Tensor:
        demands = 3 if self.sway_amplitude else 2
        demands = max(demands, which + 1)
        frequencies = np.geomspace(*self.band, demands * self.tones)[which % demands :: demands]
        random = np.random.default_rng([self.seed, which])
        trial = np.arange(0.0, 10.0 / self.band[0], min(0.05 / self.band[1], 0.005 / self.band[0]))
        angle = 2.0 * math.pi * trial[:, None] * frequencies
        best, least = np.zeros(self.tones), math.inf
        for _ in range(20):
            phases = random.uniform(0.0, 2.0 * math.pi, self.tones)
            peak = float(np.abs(np.sin(angle + phases).sum(axis=1)).max())
            if peak < least:
                best, least = phases, peak
        turned, begun = (torch.from_numpy(part).to(t.dtype) for part in (frequencies, best))
        argument = 2.0 * math.pi * t.unsqueeze(-1) * turned + begun
        return (torch.sin(argument).sum(-1) / least).clamp(-1.0, 1.0)


class ExcitationFamily(Family):
    """Random excitation: everything uniform in its range, the band as given.

    Attributes:
        drive: range of the mean drive.
        drive_amplitude: range of the drive's amplitude.
        steer_amplitude: range of the steer's amplitude.
        sway_amplitude: range of the amplitude of the sway force, in shares of the largest; for
            vessels whose commands are forces.
        dive_amplitude: range of the amplitude of the dive; for vessels that dive.
        own_amplitude: range of the amplitude by which each command moves by itself.
        band: lowest and highest frequency that the demands excite in Hz.
        start: when they begin in s.
    """

    drive: Range = (0.3, 0.7)
    drive_amplitude: Range = (0.0, 0.3)
    steer_amplitude: Range = (0.2, 1.0)
    sway_amplitude: Range = (0.0, 0.0)
    dive_amplitude: Range = (0.0, 0.0)
    own_amplitude: Range = (0.0, 0.0)
    band: Band = (0.02, 0.2)
    start: Seconds = 5.0

    def _common(self, random: np.random.Generator) -> dict[str, Any]:
        out: dict[str, Any] = {
            name: drawn(random, getattr(self, name))
            for name in ("drive", "drive_amplitude", "steer_amplitude")
        }
        out |= {"band": self.band, "seed": int(random.integers(2**31)), "start": self.start}
        for name in ("sway_amplitude", "dive_amplitude", "own_amplitude"):
            if getattr(self, name)[1] > 0:
                out[name] = drawn(random, getattr(self, name))
        return out


class RandomStepsFamily(ExcitationFamily):
    """Random steps with means and amplitudes uniform in their ranges."""

    kind: Literal["random_steps"] = "random_steps"

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        return RandomSteps.model_validate(self._common(random))


class MultiSineFamily(ExcitationFamily):
    """Multi-sines with means and amplitudes uniform in their ranges.

    Attributes:
        tones: frequencies of each of drive and steer.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def one(self, random: np.random.Generator, duration: float) -> Manoeuvre:
        return MultiSine.model_validate(self._common(random) | {"tones": self.tones})


class Replay(Manoeuvre):
    """The recorded inputs, each held until the next sample, from the recorded initial state.

    It lasts as long as the log unless `duration` is less.

    Attributes:
        log: file of the log; canonical, or any that the reader of the programme reads.
        channels: channel of the log that is taken for an input or state of the vessel, by the
            latter's name; the one of the same name where absent (`{cmd_port: n_port}` replays
            measured revolutions as commands).
    """

    kind: Literal["replay"] = "replay"
    log: ExistingPath
    channels: dict[str, str] = Field(default_factory=dict)
    _recorded: Log | None = PrivateAttr(default=None)

    def take(self, log: Log) -> None:
        """Take a log that was read already."""
        self._recorded = log

    @property
    def recorded(self) -> Log:
        """The log that is replayed.

        Raises:
            UsageError: where the file is not canonical and was not read before.
        """
        if self._recorded is None:
            self._recorded = Log.load(self.log)
        return self._recorded

    def channel(self, name: str) -> np.ndarray | None:
        """Return what the log has for an input or state of the vessel, [T].

        None where it has nothing.

        Raises:
            UsageError: where `channels` names a channel that the log does not have.
        """
        channel = self.channels.get(name, name)
        if channel in self.recorded.channels:
            return self.recorded[channel]
        if name in self.channels:
            raise UsageError(
                f"replay.channels: log {self.recorded.name} has no channel"
                f" '{channel}'{nearest(channel, self.recorded.channels)}"
            )
        return None

    def lasts(self, duration: float) -> float:
        """Return the seconds that the log lasts, or `self.duration` where that is less."""
        span = float(self.recorded.t[-1] - self.recorded.t[0])
        return span if self.duration is None else min(span, self.duration)

    def begin(self, x: Tensor, state: tuple[str, ...]) -> Tensor:
        """Return the state [nx] at the log's first sample.

        What the log does not have stays as it is in x [nx].

        Raises:
            UsageError: where the log lacks position, heading or a velocity.
            DataError: where the first sample of one is empty.
        """
        out = x.clone()
        for i, name in enumerate(state):
            values = self.channel(name)
            if values is not None:
                filled = np.flatnonzero(np.isfinite(values))
                if filled.size == 0:
                    raise DataError(
                        f"log {self.recorded.name}: channel '{name}' is empty; a replay starts from"
                        " its first value"
                    )
                out[i] = float(values[filled[0]])
            elif name in STATE:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', which a replay starts"
                    f" from{nearest(name, self.recorded.channels)}"
                )
        return out

    def inputs(self, helm: Helm, t: Tensor) -> Tensor:
        """Return the inputs [T, m] at times t [T].

        Exogenous columns that the log does not have are NaN.

        Raises:
            UsageError: where the log lacks a command.
        """
        no_demand = torch.zeros(1, dtype=torch.float64)
        commands = helm.demand(no_demand, no_demand).shape[-1]
        clock = self.recorded.t - self.recorded.t[0]
        out = np.full((t.numel(), len(helm.inputs)), np.nan)
        for i, name in enumerate(helm.inputs):
            values = self.channel(name)
            if values is None and i < commands:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', which the vessel is commanded"
                    " with; name one that it has in replay.channels; it has"
                    f" {', '.join(self.recorded.channels)}"
                )
            if values is not None and np.isfinite(values).any():
                known = np.isfinite(values)
                at = np.searchsorted(clock[known], t.numpy() + 1e-9, side="right") - 1
                out[:, i] = values[known][at.clip(min=0)]
        return torch.from_numpy(out)

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return how far the motion is from the recorded one.

        These are root mean square errors of u, v, r, and the errors of position and heading at the
        end.
        """
        clock = self.recorded.t - self.recorded.t[0]
        errors: dict[str, np.ndarray] = {}
        for name in STATE:
            values = self.channel(name)
            assert values is not None, "a replay does not begin without it"
            known = np.isfinite(values)
            errors[name] = log[name] - np.interp(log.t - log.t[0], clock[known], values[known])
        found: dict[str, Any] = {
            f"rmse_{name}": float(np.sqrt(np.mean(errors[name] ** 2))) for name in VELOCITY
        }
        distance = float(np.hypot(errors["x"][-1], errors["y"][-1]))
        return found | {
            "position_error_end": distance,
            "heading_error_end": float(abs((errors["psi"][-1] + np.pi) % (2 * np.pi) - np.pi)),
        }

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        return RecordedSource(
            torch.stack([m.inputs(helm, t) for m in manoeuvres if isinstance(m, Replay)])
        )


@final
class RecordedSource(Source):
    """A source of given inputs [B, T, m]; where they are NaN, what the surroundings give."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        given = self.values[:, k].to(w.dtype)
        return torch.where(torch.isnan(given), w, given), memory
