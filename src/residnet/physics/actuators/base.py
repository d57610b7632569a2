"""What turns commands into forces on the hull, and how each actuator follows its command."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, NamedTuple, Self, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import (
    Config,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
    Seconds,
)
from residnet.core.errors import ConfigError


class ResponseConfig(Config, ABC):
    """The lag between a command and the position.

    Attributes:
        kind: kind of the lag.
    """

    suffixes: ClassVar[tuple[str, ...]]
    """Of the actuator's name, one for each state of the lag."""
    kind: str

    @abstractmethod
    def rate(self, a: Tensor, target: Tensor, fastest: float) -> Tensor:
        """Return the derivative of the states a [..., k c], towards target [..., c]."""


@final
class ImmediateConfig(ResponseConfig):
    """A position that follows at once, or as fast as the rate limit allows."""

    suffixes = ()
    kind: Literal["immediate"] = "immediate"

    def rate(self, a: Tensor, target: Tensor, fastest: float) -> Tensor:
        """Return zeros: the position moves once per step."""
        return torch.zeros_like(a)


@final
class FirstOrderConfig(ResponseConfig):
    """A lag of first order, a_dot = (target - a) / T within the rate limit.

    Attributes:
        time: time constant in s.
    """

    suffixes = ("",)
    kind: Literal["first_order"] = "first_order"
    time: Seconds = Field(gt=0)

    def rate(self, a: Tensor, target: Tensor, fastest: float) -> Tensor:
        return ((target - a) / self.time).clamp(-fastest, fastest)


@final
class SecondOrderConfig(ResponseConfig):
    """A lag of second order, a_dotdot = w^2 (target - a) - 2 zeta w a_dot.

    At the rate limit it accelerates no further.

    Attributes:
        frequency: natural frequency in rad/s.
        damping: relative damping.
    """

    suffixes = ("", "_rate")
    kind: Literal["second_order"] = "second_order"
    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)

    def rate(self, a: Tensor, target: Tensor, fastest: float) -> Tensor:
        """Return the derivatives of the positions, then of their rates."""
        position, moving = a.chunk(2, dim=-1)
        speed = moving.clamp(-fastest, fastest)
        pull = self.frequency**2 * (target - position) - 2.0 * self.damping * self.frequency * speed
        held = (moving.abs() >= fastest) & (pull * moving > 0)
        return torch.cat((speed, torch.where(held, torch.zeros_like(pull), pull)), dim=-1)


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

    def follow(self, limit: float, rate: float | None, *names: str) -> Servo:
        """Return the servo of actuators that are alike, within their limits."""
        return Servo(self, limit, rate, names)


class SteeringGearConfig(ServoConfig):
    """The steering gear: how far and how fast the rudder turns.

    Attributes:
        limit: largest rudder angle of either side in rad.
        rate: largest rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)

    def servo(self, *names: str) -> Servo:
        """Return the servo of rudders by name."""
        return self.follow(self.limit, self.rate, *names)


class ShaftConfig(ServoConfig):
    """A shaft with a propeller or jet.

    Attributes:
        n_max: largest revolutions of either direction in 1/s; commands beyond it saturate.
        n_rate: largest change of revolutions in 1/s^2; None for at once.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)

    def servo(self, *names: str) -> Servo:
        """Return the servo of shafts by name."""
        return self.follow(self.n_max, self.n_rate, *names)


@final
class Servo(nn.Module):
    """Actuators alike: each command [..., c] is saturated, waits in a delay line, and is followed.

    States a [..., k c] stand in blocks of c: positions, what else the lag needs, then the delayed
    commands, newest first. Those that begin with `_` are internal: no sensor measures them.
    """

    def __init__(
        self, config: ServoConfig, limit: float, rate: float | None, names: Sequence[str]
    ) -> None:
        super().__init__()
        self.response, self.limit, self.count = config.response, limit, len(names)
        self.lags = len(config.response.suffixes) > 0
        self.fastest = float("inf") if rate is None else rate
        suffixes = config.response.suffixes or (() if rate is None else ("",))
        self.width = len(suffixes) * self.count
        self.delay_step = config.delay_step or 0.0
        self.taps = round(config.dead_time / self.delay_step) if self.delay_step else 0
        self.state = (
            *(f"{'_' if end else ''}{name}{end}" for end in suffixes for name in names),
            *(f"_{name}_delay{i + 1}" for i in range(self.taps) for name in names),
        )

    def target(self, a: Tensor, command: Tensor) -> Tensor:
        """Return what the actuators follow now, [..., c]."""
        if self.taps == 0:
            return command.clamp(-self.limit, self.limit)
        return a[..., -self.count :]

    def value(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the positions [..., c], within the limit."""
        if self.width == 0:
            return self.target(a, command)
        return a[..., : self.count].clamp(-self.limit, self.limit)

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k c] of the states."""
        if not self.lags:
            return torch.zeros_like(a)
        moving = self.response.rate(a[..., : self.width], self.target(a, command), self.fastest)
        return torch.cat((moving, torch.zeros_like(a[..., self.width :])), dim=-1)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k c] after a step of dt seconds: rate limits and delay lines.

        Raises:
            ConfigError: where the delay line does not move by dt.
        """
        moved = a[..., : self.width]
        if self.width > 0 and not self.lags:
            step = self.fastest * dt
            moved = moved + (self.target(a, command) - moved).clamp(-step, step)
        if self.taps == 0:
            return moved
        if abs(dt - self.delay_step) > 1e-9:
            raise ConfigError(
                f"actuator with dead time: its delay_step is {self.delay_step:g} s, but the plant"
                f" steps by {dt:g} s; set delay_step to the step of the plant (data.step over"
                " data.substeps)"
            )
        newest = command.clamp(-self.limit, self.limit)
        return torch.cat((moved, newest, a[..., self.width : -self.count]), dim=-1)


class Actuators(nn.Module, ABC):
    """All actuators of a vessel: commands move their states, and the states push the hull.

    Commands are [..., c], states a [..., k].

    A state may move continuously (`rate`, integrated with the hull: lags) or once per step
    (`advance`, after the hull has moved with the states held: rate limits).

    Attributes:
        state: names of the states; empty where the commands act at once. What no sensor measures
            begins with `_` and enters no log.
        commands: names of the commands.
        in_flow: whether forces depend on the vessel's speed.
        held: whether forces stay the same over a step.
        diving: commands [c] that dive with full force; None where nothing does.
    """

    commands: tuple[str, ...] = ()
    diving: Tensor | None = None
    in_flow: bool = True

    def __init__(self, *servos: Servo) -> None:
        super().__init__()
        self.servos = nn.ModuleList(servos)
        self.state = tuple(name for servo in servos for name in servo.state)
        self.widths = [len(servo.state) for servo in servos]
        self.counts = [servo.count for servo in servos]
        self.held = not (self.in_flow or any(servo.lags for servo in servos))

    @abstractmethod
    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., c] for a manoeuvre's drive and steer [...], each within +-1."""

    @abstractmethod
    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., n] on the hull in N and N m.

        Args:
            a: states [..., k].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def followed(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] that servos follow, in their order."""
        return command

    def _each(self, a: Tensor, command: Tensor) -> Iterator[tuple[Servo, Tensor, Tensor]]:
        parts = torch.split(a, self.widths, dim=-1)
        wanted = torch.split(self.followed(command), self.counts, dim=-1)
        yield from zip(self.servos, parts, wanted, strict=True)

    def positions(self, a: Tensor, command: Tensor) -> Tensor:
        """Return where all servos stand, [..., c]."""
        each = [servo.value(part, wanted) for servo, part, wanted in self._each(a, command)]
        return torch.cat(each, dim=-1)

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        each = [servo.rate(part, wanted) for servo, part, wanted in self._each(a, command)]
        return torch.cat(each, dim=-1)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds, of what moves once per step."""
        each = [servo.advance(part, wanted, dt) for servo, part, wanted in self._each(a, command)]
        return torch.cat(each, dim=-1)


class ForceActuators(Actuators, ABC):
    """Actuators that push a hull in surge, sway and yaw, each as asked for, within their limits."""

    in_flow = False

    @abstractmethod
    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., c] that ask for forces tau [..., 3] in N, N, N m."""

    @abstractmethod
    def asked(self, command: Tensor) -> Tensor:
        """Return the forces tau [..., 3] that commands [..., c] ask for, before any lag."""


class ActuatorConfig(Config, ABC):
    """The part of a vessel file that all kinds of actuators share.

    Attributes:
        kind: kind of the actuators.
        source: where their numbers come from.
    """

    kind: str
    source: str

    @abstractmethod
    def build(self) -> Actuators:
        """Build the module that turns commands into forces."""


class Command(NamedTuple):
    """One command of steered actuators.

    Attributes:
        name: of the command.
        by: what a manoeuvre sets it by.
        largest: value of a whole share.
        least: least share; 0 for what pushes one way.
    """

    name: str
    by: Literal["drive", "steer", "dive"]
    largest: float
    least: float = -1.0


def demanded(commands: Sequence[Command], drive: Tensor, steer: Tensor) -> Tensor:
    """Return commands [..., c] for drive and steer [...], shares of what is largest."""
    given = {"drive": drive, "steer": steer, "dive": torch.zeros_like(steer)}
    parts = [given[c.by].clamp(c.least, 1.0) * c.largest for c in commands]
    return torch.stack(parts, dim=-1)


class SteeredConfig(ActuatorConfig, ABC):
    """Actuators whose config says what they do."""

    @abstractmethod
    def commanded(self) -> tuple[Command, ...]:
        """Return the commands, those that servos follow first."""

    @abstractmethod
    def servos(self) -> tuple[Servo, ...]:
        """Return the servos, in the order of the commands."""

    @abstractmethod
    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., n] on the hull in N and N m.

        Args:
            position: where the servos stand [..., c].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def followed(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] that servos follow, in their order."""
        return command

    @final
    def build(self) -> SteeredActuators:
        return SteeredActuators(self)


@final
class SteeredActuators(Actuators):
    """Rudders, fins and jets with their propellers, as their config has them."""

    def __init__(self, config: SteeredConfig) -> None:
        super().__init__(*config.servos())
        self.config, self.commanded = config, config.commanded()
        self.commands = tuple(command.name for command in self.commanded)
        dive = [command.largest * (command.by == "dive") for command in self.commanded]
        self.diving = torch.tensor(dive, dtype=torch.float64) if any(dive) else None

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return demanded(self.commanded, drive, steer)

    def followed(self, command: Tensor) -> Tensor:
        return self.config.followed(command)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.config.force(self.positions(a, command), command, nu)


Coefficients = tuple[float, float, float]
CurveRange = tuple[RevsPerSecond, RevsPerSecond]
"""Revolutions (astern, ahead) between which a curve was measured."""


def require_range(curve_range: CurveRange | None, n_max: float) -> None:
    """Stop where a shaft may turn faster than its thrust curve is known.

    Raises:
        ValueError: naming both.
    """
    low, high = curve_range or (-n_max, n_max)
    if low > -n_max or high < n_max:
        raise ValueError(
            f"curve_range {low * 60:g} to {high * 60:g} rpm does not reach n_max"
            f" (+-{n_max * 60:g} rpm); lower n_max or measure the curve further"
        )


class ThrustConfig(Config):
    """The thrust curve of a propeller, c0 + c1 n + c2 n^2; it never opposes the rotation.

    Attributes:
        n_max: largest revolutions of either direction in 1/s; commands beyond it saturate.
        forward: coefficients c0 [N], c1 [N s], c2 [N s^2] for n > 0 [1/s], at standstill.
        reverse: coefficients for n < 0 (signed).
        curve_range: revolutions (astern, ahead) in 1/s that the curve was measured between; it must
            include +-n_max.
    """

    n_max: RevsPerSecond = Field(gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None

    @model_validator(mode="after")
    def _range(self) -> Self:
        require_range(self.curve_range, self.n_max)
        return self
