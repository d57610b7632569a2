"""Random excitation over a band of frequencies: random steps, and sums of sines."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from residnet.core.config import Config, Hertz, Seconds
from residnet.core.errors import UsageError
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre, Range, Scheduled, ScheduleSource


def _ordered(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 < band[0] < band[1]:
        raise ValueError(
            f"a band goes from a low to a higher frequency above zero, given {band[0]:g} Hz to"
            f" {band[1]:g} Hz"
        )
    return band


Band = Annotated[tuple[Hertz, Hertz], AfterValidator(_ordered)]
"""Lowest and highest frequency."""


class Excitation(Scheduled, ABC):
    """The part that both kinds of excitation share.

    Attributes:
        drive: mean drive.
        drive_amplitude: how far the drive goes to either side of it.
        steer_amplitude: how far the steer goes to either side of zero.
        sway_amplitude: how far the sway force goes to either side of zero, in shares of the
            largest; for vessels whose commands are forces.
        band: frequencies that the demands excite.
        seed: of everything random.
        start: when they begin; before, the drive is held and the steer is zero.
        kind: kind of the manoeuvre.
    """

    drive: float = Field(ge=-1, le=1)
    drive_amplitude: float = Field(default=0.0, ge=0, le=2)
    steer_amplitude: float = Field(default=0.0, ge=0, le=1)
    sway_amplitude: float = Field(default=0.0, ge=0, le=1)
    band: Band
    seed: int = Field(default=0, ge=0)
    start: Seconds = Field(default=5.0, ge=0)

    @abstractmethod
    def _wave(self, t: Tensor, which: int) -> Tensor:
        """Return the wave [T] within +-1 of the drive (0), the steer (1) or the sway force (2).

        Args:
            t: times [T] since the start in s.
            which: 0 for the drive, 1 for the steer, 2 for the sway force.
        """

    def demands(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return drive and steer [T], clipped to +-1."""
        drive, steer = (self._after_start(t, which) for which in (0, 1))
        return (self.drive + self.drive_amplitude * drive).clamp(
            -1.0, 1.0
        ), self.steer_amplitude * steer

    def _after_start(self, t: Tensor, which: int) -> Tensor:
        """Return a wave [T] that is zero before the start."""
        wave = self._wave((t - self.start).clamp(min=0.0), which)
        return torch.where(t >= self.start - 1e-9, wave, torch.zeros_like(t))

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the playback of the demands, with the sway forces where there are any.

        Raises:
            UsageError: where a sway force is asked of a vessel whose commands are no forces.
        """
        drawn = [manoeuvre for manoeuvre in manoeuvres if isinstance(manoeuvre, Excitation)]
        sway = torch.stack([m.sway_amplitude * m._after_start(t, 2) for m in drawn])
        if not bool(sway.any()):
            return super().source(manoeuvres, helm, t)
        limit, column = helm.side_force, "tau_y"
        if limit is None or column not in helm.inputs:
            raise UsageError(
                "sway_amplitude: a manoeuvre asks for a sway force, but the vessel's commands are"
                f" {', '.join(helm.inputs[:2])} and no forces; leave it out"
            )
        push = limit * sway.unsqueeze(-1) * torch.eye(3, dtype=t.dtype)[helm.inputs.index(column)]
        pairs = [manoeuvre.demands(t) for manoeuvre in drawn]
        return ScheduleSource(
            torch.stack([drive for drive, _ in pairs]),
            torch.stack([steer for _, steer in pairs]),
            lambda drive, steer: helm.demand(drive, steer) + push,
        )


class RandomSteps(Excitation):
    """Drive and steer that jump to random levels.

    Levels are uniform within their amplitudes; each is held for half a period of a random frequency
    of the band.
    """

    kind: Literal["random_steps"] = "random_steps"

    def _wave(self, t: Tensor, which: int) -> Tensor:
        """Return the levels [T] within +-1."""
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
    random draws, so that the amplitude is well used.

    Attributes:
        tones: frequencies of each of drive and steer.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def _wave(self, t: Tensor, which: int) -> Tensor:
        """Return the sum of sines [T], within +-1 over ten periods of the lowest; clipped."""
        # every demand has frequencies of its own
        demands = 3 if self.sway_amplitude else 2
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
        argument = 2.0 * math.pi * t.unsqueeze(-1) * torch.from_numpy(frequencies).to(
            t.dtype
        ) + torch.from_numpy(best).to(t.dtype)
        return (torch.sin(argument).sum(-1) / least).clamp(-1.0, 1.0)


class _Family(Config):
    """The part that the families share: everything uniform in its range, the band as given.

    Attributes:
        count: how many manoeuvres.
        drive: range of the mean drive.
        drive_amplitude: range of the drive's amplitude.
        steer_amplitude: range of the steer's amplitude.
        sway_amplitude: range of the amplitude of the sway force, in shares of the largest; for
            vessels whose commands are forces.
        band: lowest and highest frequency that the demands excite in Hz.
        start: when they begin in s.
    """

    count: int = Field(ge=1, le=10_000)
    drive: Range = (0.3, 0.7)
    drive_amplitude: Range = (0.0, 0.3)
    steer_amplitude: Range = (0.2, 1.0)
    sway_amplitude: Range = (0.0, 0.0)
    band: Band = (0.02, 0.2)
    start: Seconds = 5.0

    def _draw_common(
        self, random: np.random.Generator
    ) -> dict[str, float | int | tuple[float, float]]:
        common: dict[str, float | int | tuple[float, float]] = {
            "drive": float(random.uniform(*self.drive)),
            "drive_amplitude": float(random.uniform(*self.drive_amplitude)),
            "steer_amplitude": float(random.uniform(*self.steer_amplitude)),
            "band": self.band,
            "seed": int(random.integers(2**31)),
            "start": self.start,
        }
        if self.sway_amplitude[1] > 0:
            common["sway_amplitude"] = float(random.uniform(*self.sway_amplitude))
        return common


class RandomStepsFamily(_Family):
    """Random steps with means and amplitudes uniform in their ranges."""

    kind: Literal["random_steps"] = "random_steps"

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres with a random generator."""
        return [RandomSteps.model_validate(self._draw_common(random)) for _ in range(self.count)]


class MultiSineFamily(_Family):
    """Multi-sines with means and amplitudes uniform in their ranges.

    Attributes:
        tones: frequencies of each of drive and steer.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def draw(self, random: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Draw `count` manoeuvres with a random generator."""
        return [
            MultiSine.model_validate({**self._draw_common(random), "tones": self.tones})
            for _ in range(self.count)
        ]
