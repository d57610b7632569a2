"""How a single actuator follows its command: saturation, dead time, rate limit and lag."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import Config, RadiansPerSecond, Seconds
from residnet.core.errors import ConfigError


class Response(nn.Module, ABC):
    """The way in which a position follows a target [...] with states a [..., k].

    `suffixes` are appended to the actuator's name to name the states.
    """

    suffixes: tuple[str, ...] = ("",)

    def value(self, a: Tensor, target: Tensor) -> Tensor:
        """Return the position [...] that the states a [..., k] stand for."""
        return a[..., 0]

    def rate(self, a: Tensor, target: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return torch.zeros_like(a)

    def advance(self, a: Tensor, target: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after what moves once per step."""
        return a


@final
class Immediate(Response):
    """A response that stands at its target at once."""

    suffixes = ()

    def value(self, a: Tensor, target: Tensor) -> Tensor:
        """Return the target itself."""
        return target


@final
class RateLimited(Response):
    """A response that moves towards its target by at most rate * dt, once per step."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.limit = rate

    def advance(self, a: Tensor, target: Tensor, dt: float) -> Tensor:
        """Return the position after a step of dt seconds."""
        step = self.limit * dt
        return a + (target.unsqueeze(-1) - a).clamp(-step, step)


@final
class FirstOrder(Response):
    """a_dot = (target - a) / T within the rate limit."""

    def __init__(self, time: float, rate: float) -> None:
        super().__init__()
        self.time, self.limit = time, rate

    def rate(self, a: Tensor, target: Tensor) -> Tensor:
        """Return the derivative of the position."""
        return ((target.unsqueeze(-1) - a) / self.time).clamp(-self.limit, self.limit)


@final
class SecondOrder(Response):
    """a_dotdot = w^2 (target - a) - 2 zeta w a_dot; at the rate limit it accelerates no further."""

    suffixes = ("", "_rate")

    def __init__(self, frequency: float, damping: float, rate: float) -> None:
        super().__init__()
        self.frequency, self.damping, self.limit = frequency, damping, rate

    def rate(self, a: Tensor, target: Tensor) -> Tensor:
        """Return the derivatives of position and rate."""
        position, speed = a[..., 0], a[..., 1].clamp(-self.limit, self.limit)
        pull = self.frequency**2 * (target - position) - 2.0 * self.damping * self.frequency * speed
        held = (a[..., 1].abs() >= self.limit) & (pull * a[..., 1] > 0)
        return torch.stack((speed, torch.where(held, torch.zeros_like(pull), pull)), dim=-1)


class ResponseConfig(Config, ABC):
    """The lag between a command and the position.

    Attributes:
        kind: kind of the lag.
    """

    kind: str

    @abstractmethod
    def build(self, rate: float | None) -> Response:
        """Return the response within a rate limit."""


class ImmediateConfig(ResponseConfig):
    """A position that follows at once, or as fast as the rate limit allows."""

    kind: Literal["immediate"] = "immediate"

    def build(self, rate: float | None) -> Response:
        """Build the response within a rate limit; None for no limit."""
        return Immediate() if rate is None else RateLimited(rate)


class FirstOrderConfig(ResponseConfig):
    """A lag of first order.

    Attributes:
        time: time constant in s.
    """

    kind: Literal["first_order"] = "first_order"
    time: Seconds = Field(gt=0)

    def build(self, rate: float | None) -> Response:
        """Build the response within a rate limit; None for no limit."""
        return FirstOrder(self.time, float("inf") if rate is None else rate)


class SecondOrderConfig(ResponseConfig):
    """A lag of second order.

    Attributes:
        frequency: natural frequency in rad/s.
        damping: relative damping.
    """

    kind: Literal["second_order"] = "second_order"
    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)

    def build(self, rate: float | None) -> Response:
        """Build the response within a rate limit; None for no limit."""
        return SecondOrder(self.frequency, self.damping, float("inf") if rate is None else rate)


class ServoConfig(Config):
    """The part that all actuators which follow a command share.

    Limit and rate limit stand, with their units, in the subclass' own keys.

    Attributes:
        response: lag.
        dead_time: between a command and its first effect; a whole number of `delay_step`.
        delay_step: step of the plant that the delay line moves by, once per step; the simulation
            must step by just this.
    """

    response: Annotated[
        ImmediateConfig | FirstOrderConfig | SecondOrderConfig, Field(discriminator="kind")
    ] = ImmediateConfig()
    dead_time: Seconds = Field(default=0.0, ge=0)
    delay_step: Seconds | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _delay(self) -> ServoConfig:
        if (self.dead_time > 0) != (self.delay_step is not None):
            raise ValueError(
                "dead_time and delay_step belong together: delay_step is the step of the plant"
                " (data.step over data.substeps)"
            )
        if self.delay_step is not None:
            taps = self.dead_time / self.delay_step
            if abs(taps - round(taps)) > 1e-6 * taps or not 1 <= round(taps) <= 1000:
                raise ValueError(
                    f"dead_time ({self.dead_time:g} s) must be 1 to 1000 times delay_step"
                    f" ({self.delay_step:g} s)"
                )
        return self

    def follow(self, name: str, limit: float, rate: float | None) -> Servo:
        """Return the servo of the actuator `name` within its limits."""
        taps = 0 if self.delay_step is None else round(self.dead_time / self.delay_step)
        return Servo(name, limit, self.response.build(rate), taps, self.delay_step or 0.0)


@final
class Servo(nn.Module):
    """One actuator: its command [...] is saturated, waits in a delay line, and is followed.

    States a [..., k]: the position and what else the response needs, then the delayed commands,
    newest first. Those that begin with `_` are internal: no sensor measures them.
    """

    def __init__(
        self, name: str, limit: float, response: Response, taps: int, delay_step: float
    ) -> None:
        super().__init__()
        self.limit = limit
        self.response = response
        self.width = len(response.suffixes)
        self.taps = taps
        self.delay_step = delay_step
        self.state = tuple(f"{'_' if suffix else ''}{name}{suffix}" for suffix in response.suffixes)
        self.state += tuple(f"_{name}_delay{i + 1}" for i in range(taps))

    def target(self, a: Tensor, command: Tensor) -> Tensor:
        """Return what the actuator follows now, [...]."""
        return command.clamp(-self.limit, self.limit) if self.taps == 0 else a[..., -1]

    def value(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the position [...], within the limit."""
        return self.response.value(a[..., : self.width], self.target(a, command)).clamp(
            -self.limit, self.limit
        )

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        moving = self.response.rate(a[..., : self.width], self.target(a, command))
        return torch.cat((moving, torch.zeros_like(a[..., self.width :])), dim=-1)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds.

        Raises:
            ConfigError: where the delay line does not move by dt.
        """
        moved = self.response.advance(a[..., : self.width], self.target(a, command), dt)
        if self.taps == 0:
            return moved
        if abs(dt - self.delay_step) > 1e-9:
            raise ConfigError(
                f"actuator with dead time: its delay_step is {self.delay_step:g} s, but the plant"
                f" steps by {dt:g} s; set delay_step to the step of the plant (data.step over"
                " data.substeps)"
            )
        newest = command.clamp(-self.limit, self.limit).unsqueeze(-1)
        return torch.cat((moved, newest, a[..., self.width : -1]), dim=-1)


@final
class Servos(nn.Module):
    """Several actuators side by side, in the order of their commands."""

    def __init__(self, servos: list[Servo]) -> None:
        super().__init__()
        self.servos = nn.ModuleList(servos)
        self.widths = [len(servo.state) for servo in servos]
        self.state = tuple(name for servo in servos for name in servo.state)

    def _parts(self, a: Tensor) -> list[Tensor]:
        return list(torch.split(a, self.widths, dim=-1))

    def value(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the positions [..., c] of all actuators."""
        parts = self._parts(a)
        each: list[Tensor] = []
        for i, servo in enumerate(self.servos):
            each.append(servo.value(parts[i], command[..., i]))  # type: ignore[operator]
        return torch.stack(each, dim=-1)

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivatives [..., k]."""
        parts = self._parts(a)
        each: list[Tensor] = []
        for i, servo in enumerate(self.servos):
            each.append(servo.rate(parts[i], command[..., i]))  # type: ignore[operator]
        return torch.cat(each, dim=-1)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        parts = self._parts(a)
        each: list[Tensor] = []
        for i, servo in enumerate(self.servos):
            each.append(servo.advance(parts[i], command[..., i], dt))  # type: ignore[operator]
        return torch.cat(each, dim=-1)
