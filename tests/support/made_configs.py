"""Configs made for the tests of configs, and how those load them."""

from __future__ import annotations

import enum
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from residnet.core.config import Config, ConfigPath, ExistingPath, Hertz, Radians, Seconds


class Space(enum.Enum):
    FORCE = "force"
    ACCELERATION = "acceleration"


class Mlp(Config):
    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (32, 32)
    dropout: float = Field(default=0.0, ge=0.0, lt=1.0)


class Lstm(Config):
    kind: Literal["lstm"] = "lstm"
    hidden_size: int = Field(gt=0)
    washout: Seconds = 1.0


Head = Annotated[Mlp | Lstm, Field(discriminator="kind")]


class Sensor(Config):
    name: str
    noise: Radians = 0.0
    limits: tuple[float, float] = (-1.0, 1.0)

    @model_validator(mode="after")
    def _ordered(self) -> Sensor:
        if self.limits[0] >= self.limits[1]:
            raise ValueError(f"limits must rise, got {self.limits}")
        return self


class Fit(Config):
    task: Literal["fit"]
    dt: Seconds = Field(default=0.1, gt=0)
    name: str = "unnamed"
    comment: str | None = None
    space: Space = Space.FORCE
    method: Literal["euler", "rk4"] = "rk4"
    resume: bool = False
    epochs: int = 1
    limit: Radians | None = None
    rates: dict[str, tuple[Hertz, ...]] = Field(default_factory=dict)
    threshold: float | list[float] = 3.0
    window: Annotated[Seconds, Field(gt=0)] | Literal["auto"] = "auto"
    heads: dict[str, Head] = Field(default_factory=dict)
    stages: list[Head] = Field(default_factory=list)
    policy: Head | None = None
    fallback: Head | float = 0.0
    pair: tuple[Seconds, dict[str, list[Head]]] | None = None
    sensors: tuple[Sensor, ...] = ()
    by_index: dict[int, float] = Field(default_factory=dict)
    out: ConfigPath = Path("runs")
    logs: tuple[ExistingPath, ...] = ()

    @field_validator("name")
    @classmethod
    def _no_slash(cls, value: str) -> str:
        if "/" in value:
            raise ValueError("a name must not hold '/'")
        return value


class Simulate(Config):
    task: Literal["simulate"]
    duration: Seconds


Task = Annotated[Fit | Simulate, Field(discriminator="task")]

Failure = Callable[..., str]
