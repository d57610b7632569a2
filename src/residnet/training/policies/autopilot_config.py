"""How a heading policy is trained. No Lightning here: `residnet check` must stay quick."""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.training.one_stage import OneStage

Range = Annotated[tuple[float, float], Field(description="low and high multiple")]


class SpreadConfig(Config):
    """Settings of the range of vessels, starts and disturbances of training and comparison.

    Attributes:
        effect: of the rudder, as a multiple (K of Nomoto's model).
        time: constants of sway and yaw, as a multiple (T of Nomoto's model).
        speed: at the start, as a multiple of the service speed, thrust to match.
        disturbed: share of the training's changes of heading that start under a bias, wind or
            current.
        bias: largest constant angle that is added to the rudder's.
        wind: slowest and fastest mean wind in training, from any direction, for vessels with wind
            coefficients; null for none.
        current: fastest current in training, in any direction.
        heading: largest change of heading.
        noise_psi: standard deviation of white noise on the measured heading in rad.
        noise_r: standard deviation of white noise on the measured yaw rate in rad/s.
    """

    effect: Range = (0.8, 1.2)
    time: Range = (0.8, 1.2)
    speed: Range = (1.0, 1.0)
    disturbed: float = Field(default=0.5, ge=0, le=1)
    bias: Radians = Field(default=0.02, ge=0)
    wind: tuple[MetresPerSecond, MetresPerSecond] | None = None
    current: MetresPerSecond = Field(default=0.0, ge=0)
    heading: Radians = Field(default=1.0, gt=0, lt=3.1)
    noise_psi: Radians = Field(default=0.0, ge=0)
    noise_r: RadiansPerSecond = Field(default=0.0, ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> SpreadConfig:
        for name in ("effect", "time", "speed"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(
                    f"{name}: low and high must be positive and in order, given {low:g}, {high:g}"
                )
        if self.wind is not None and not 0 <= self.wind[0] <= self.wind[1]:
            raise ValueError(
                "wind: slowest and fastest must be in order and not negative, given"
                f" {self.wind[0]:g}, {self.wind[1]:g}"
            )
        return self

    @property
    def weather(self) -> bool:
        """Whether there is wind or current."""
        return self.wind is not None or self.current > 0

    def needs(self) -> tuple[str, ...]:
        """Return the inputs that a vessel must have for it."""
        return (
            *(("wind_speed", "wind_dir") if self.wind is not None else ()),
            *(("current_north", "current_east") if self.current > 0 else ()),
        )

    def draw_weather(self, rows: int) -> dict[str, Tensor]:
        """Return inputs of a vessel by name, each [rows]."""
        drawn, around = torch.rand(2, rows), 2.0 * torch.pi * torch.rand(2, rows)
        out: dict[str, Tensor] = {}
        if self.wind is not None:
            out |= {
                "wind_speed": self.wind[0] + (self.wind[1] - self.wind[0]) * drawn[0],
                "wind_dir": around[0],
            }
        if self.current > 0:
            out |= {
                "current_north": self.current * drawn[1] * torch.cos(around[1]),
                "current_east": self.current * drawn[1] * torch.sin(around[1]),
            }
        return out

    def draw(self, rows: int) -> Tensor:
        """Draw effect and time [rows, 2], every second row at a corner of their ranges.

        Controllers fail there first.
        """
        low, high = torch.tensor([self.effect, self.time]).T
        share = torch.rand(rows, 2)
        at_corner = torch.arange(rows)[:, None] % 2 == 1
        drawn: Tensor = low + (high - low) * torch.where(at_corner, share.round(), share)
        return drawn

    def corners(self) -> Tensor:
        """Return effect, time and zero bias [9, 3]: nominal first, then ends and middles."""
        effects = (1.0, *self.effect)
        times = (1.0, *self.time)
        return torch.tensor(
            [(effect, time, 0.0) for effect in effects for time in times], dtype=torch.float64
        )


class AutopilotTraining(OneStage):
    """Settings of a training by back-propagation through vessel and policy.

    Attributes:
        steps: batches of an epoch.
        batch: heading changes per batch.
        dt: step of the simulation in training; flights may take a finer one.
        integrator: of the simulation in training.
        horizon: length of each heading change.
        overshoot: weight of the overshoot against the time outside `band`.
        margin: overshoot that costs nothing.
        band: error at which half of the cost of a large error is left.
        sharp: weight of the time outside the band itself, beside what smoothly counts near it.
        slowest: slow vessels weigh more, by this power of time over effect: the slowest decides the
            worst case.
        smoothness: weight of the squared changes of the command.
    """

    steps: int = Field(default=15, ge=1, le=100_000)
    batch: int = Field(default=256, ge=16, le=1_000_000)
    dt: Seconds = Field(default=0.1, gt=0)
    integrator: Annotated[str, Field(pattern="^(rk4|heun)$")] = "rk4"
    horizon: Seconds = Field(default=10.0, gt=0)
    overshoot: float = Field(default=2.0, ge=0)
    margin: Radians = Field(default=3.5e-4, ge=0)
    band: Radians = Field(default=0.0175, gt=0)
    sharp: float = Field(default=1.0, ge=0)
    slowest: float = Field(default=4.0, ge=0)
    smoothness: float = Field(default=0.0, ge=0)
