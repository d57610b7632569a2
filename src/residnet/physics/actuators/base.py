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

    state_suffixes: ClassVar[tuple[str, ...]]
    """Of the actuator's name, one for each state of the lag."""
    kind: str

    @abstractmethod
    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return the derivative of the states a [..., k c], towards target [..., c]."""


@final
class ImmediateConfig(ResponseConfig):
    """A position that follows at once, or as fast as the rate limit allows."""

    state_suffixes = ()
    kind: Literal["immediate"] = "immediate"

    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return zeros: the position moves once per step."""
        return torch.zeros_like(states)


@final
class FirstOrderConfig(ResponseConfig):
    """A lag of first order, a_dot = (target - a) / T within the rate limit.

    Attributes:
        time: time constant in s.
    """

    state_suffixes = ("",)
    kind: Literal["first_order"] = "first_order"
    time: Seconds = Field(gt=0)

    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        return ((target - states) / self.time).clamp(-rate_limit, rate_limit)


@final
class SecondOrderConfig(ResponseConfig):
    """A lag of second order, a_dotdot = w^2 (target - a) - 2 zeta w a_dot.

    At the rate limit it accelerates no further.

    Attributes:
        frequency: natural frequency in rad/s.
        damping: relative damping.
    """

    state_suffixes = ("", "_rate")
    kind: Literal["second_order"] = "second_order"
    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)

    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return the derivatives of the positions, then of their rates."""
        position, velocity = states.chunk(2, dim=-1)
        limited_velocity = velocity.clamp(-rate_limit, rate_limit)
        acceleration = (
            self.frequency**2 * (target - position)
            - 2.0 * self.damping * self.frequency * limited_velocity
        )
        is_rate_limited = (velocity.abs() >= rate_limit) & (acceleration * velocity > 0)
        return torch.cat(
            (
                limited_velocity,
                torch.where(is_rate_limited, torch.zeros_like(acceleration), acceleration),
            ),
            dim=-1,
        )


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
    def _validate_delay(self) -> ServoConfig:
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

    def build_limited_servo(self, limit: float, rate_limit: float | None, *names: str) -> Servo:
        """Return the servo of actuators that are alike, within their limits."""
        return Servo(self, limit, rate_limit, names)


class SteeringGearConfig(ServoConfig):
    """The steering gear: how far and how fast the rudder turns.

    Attributes:
        limit: largest rudder angle of either side in rad.
        rate: largest rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)

    def build_servo(self, *names: str) -> Servo:
        """Return the servo of rudders by name."""
        return self.build_limited_servo(self.limit, self.rate, *names)


class ShaftConfig(ServoConfig):
    """A shaft with a propeller or jet.

    Attributes:
        n_max: largest revolutions of either direction in 1/s; commands beyond it saturate.
        n_rate: largest change of revolutions in 1/s^2; None for at once.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)

    def build_servo(self, *names: str) -> Servo:
        """Return the servo of shafts by name."""
        return self.build_limited_servo(self.n_max, self.n_rate, *names)


@final
class Servo(nn.Module):
    """Actuators alike: each command [..., c] is saturated, waits in a delay line, and is followed.

    States a [..., k c] stand in blocks of c: positions, what else the lag needs, then the delayed
    commands, newest first. Those that begin with `_` are internal: no sensor measures them.
    """

    def __init__(
        self, config: ServoConfig, limit: float, rate_limit: float | None, names: Sequence[str]
    ) -> None:
        super().__init__()
        self.response = config.response
        self.limit = limit
        self.n_actuators = len(names)
        self.has_lag = len(config.response.state_suffixes) > 0
        self.rate_limit = float("inf") if rate_limit is None else rate_limit
        suffixes = config.response.state_suffixes or (() if rate_limit is None else ("",))
        self.n_lag_states = len(suffixes) * self.n_actuators
        self.delay_step = config.delay_step or 0.0
        self.n_delay_steps = round(config.dead_time / self.delay_step) if self.delay_step else 0
        self.state_names = (
            *(f"{'_' if suffix else ''}{name}{suffix}" for suffix in suffixes for name in names),
            *(f"_{name}_delay{i + 1}" for i in range(self.n_delay_steps) for name in names),
        )

    def current_target(self, states: Tensor, command: Tensor) -> Tensor:
        """Return what the actuators follow now, [..., c]."""
        if self.n_delay_steps == 0:
            return command.clamp(-self.limit, self.limit)
        return states[..., -self.n_actuators :]

    def position(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the positions [..., c], within the limit."""
        if self.n_lag_states == 0:
            return self.current_target(states, command)
        return states[..., : self.n_actuators].clamp(-self.limit, self.limit)

    def derivative(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k c] of the states."""
        if not self.has_lag:
            return torch.zeros_like(states)
        lag_derivative = self.response.derivative(
            states[..., : self.n_lag_states], self.current_target(states, command), self.rate_limit
        )
        return torch.cat(
            (lag_derivative, torch.zeros_like(states[..., self.n_lag_states :])), dim=-1
        )

    def advance_step(self, states: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k c] after a step of dt seconds: rate limits and delay lines.

        Raises:
            ConfigError: where the delay line does not move by dt.
        """
        lag_states = states[..., : self.n_lag_states]
        if self.n_lag_states > 0 and not self.has_lag:
            max_change = self.rate_limit * dt
            lag_states = lag_states + (self.current_target(states, command) - lag_states).clamp(
                -max_change, max_change
            )
        if self.n_delay_steps == 0:
            return lag_states
        if abs(dt - self.delay_step) > 1e-9:
            raise ConfigError(
                f"actuator with dead time: its delay_step is {self.delay_step:g} s, but the plant"
                f" steps by {dt:g} s; set delay_step to the step of the plant (data.step over"
                " data.substeps)"
            )
        newest_command = command.clamp(-self.limit, self.limit)
        return torch.cat(
            (lag_states, newest_command, states[..., self.n_lag_states : -self.n_actuators]), dim=-1
        )


class ActuatorSystem(nn.Module, ABC):
    """All actuators of a vessel: commands move their states, and the states push the hull.

    Commands are [..., c], states a [..., k].

    A state may move continuously (`rate`, integrated with the hull: lags) or once per step
    (`advance_step`, after the hull has moved with the states held: rate limits).

    Attributes:
        state_names: names of the states; empty where the commands act at once. What no sensor measures
            begins with `_` and enters no log.
        command_names: names of the commands.
        depends_on_speed: whether forces depend on the vessel's speed.
        is_force_constant_in_step: whether forces stay the same over a step.
        dive_commands: commands [c] that dive with full force; None where nothing does.
    """

    command_names: tuple[str, ...] = ()
    dive_commands: Tensor | None = None
    depends_on_speed: bool = True

    def __init__(self, *servos: Servo) -> None:
        super().__init__()
        self.servos = nn.ModuleList(servos)
        self.state_names = tuple(name for servo in servos for name in servo.state_names)
        self.state_counts = [len(servo.state_names) for servo in servos]
        self.command_counts = [servo.n_actuators for servo in servos]
        self.is_force_constant_in_step = not (
            self.depends_on_speed or any(servo.has_lag for servo in servos)
        )

    @abstractmethod
    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., c] for a manoeuvre's drive and steer [...], each within +-1."""

    @abstractmethod
    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., n] on the hull in N and N m.

        Args:
            states: states [..., k].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] that servos follow, in their order."""
        return command

    def _iterate_servos(
        self, states: Tensor, command: Tensor
    ) -> Iterator[tuple[Servo, Tensor, Tensor]]:
        servo_states = torch.split(states, self.state_counts, dim=-1)
        servo_commands = torch.split(self.servo_commands(command), self.command_counts, dim=-1)
        yield from zip(self.servos, servo_states, servo_commands, strict=True)

    def servo_positions(self, states: Tensor, command: Tensor) -> Tensor:
        """Return where all servos stand, [..., c]."""
        positions = [
            servo.position(servo_state, servo_command)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(positions, dim=-1)

    def derivative(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        derivatives = [
            servo.derivative(servo_state, servo_command)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(derivatives, dim=-1)

    def advance_step(self, states: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds, of what moves once per step."""
        next_states = [
            servo.advance_step(servo_state, servo_command, dt)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(next_states, dim=-1)


class ForceActuators(ActuatorSystem, ABC):
    """Actuators that push a hull in surge, sway and yaw, each as asked for, within their limits."""

    depends_on_speed = False

    @abstractmethod
    def allocate(self, force: Tensor) -> Tensor:
        """Return the commands [..., c] that ask for forces tau [..., 3] in N, N, N m."""

    @abstractmethod
    def requested_force(self, command: Tensor) -> Tensor:
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
    def build(self) -> ActuatorSystem:
        """Build the module that turns commands into forces."""


class CommandSpec(NamedTuple):
    """One command of steered actuators.

    Attributes:
        name: of the command.
        demand_axis: what a manoeuvre sets it by.
        max_value: value of a whole share.
        min_share: least share; 0 for what pushes one way.
    """

    name: str
    demand_axis: Literal["drive", "steer", "dive"]
    max_value: float
    min_share: float = -1.0


def commands_from_demand(specs: Sequence[CommandSpec], drive: Tensor, steer: Tensor) -> Tensor:
    """Return commands [..., c] for drive and steer [...], shares of what is largest."""
    demand = {"drive": drive, "steer": steer, "dive": torch.zeros_like(steer)}
    shares = [
        demand[spec.demand_axis].clamp(spec.min_share, 1.0) * spec.max_value for spec in specs
    ]
    return torch.stack(shares, dim=-1)


class SteeredConfig(ActuatorConfig, ABC):
    """Actuators whose config says what they do."""

    @abstractmethod
    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the commands, those that servos follow first."""

    @abstractmethod
    def build_servos(self) -> tuple[Servo, ...]:
        """Return the servos, in the order of the commands."""

    @abstractmethod
    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return the forces tau [..., n] on the hull in N and N m.

        Args:
            position: where the servos stand [..., c].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] that servos follow, in their order."""
        return command

    @final
    def build(self) -> SteeredActuators:
        return SteeredActuators(self)


@final
class SteeredActuators(ActuatorSystem):
    """Rudders, fins and jets with their propellers, as their config has them."""

    def __init__(self, config: SteeredConfig) -> None:
        super().__init__(*config.build_servos())
        self.config = config
        self.command_specs = config.command_specs()
        self.command_names = tuple(command.name for command in self.command_specs)
        dive_values = [
            command.max_value * (command.demand_axis == "dive") for command in self.command_specs
        ]
        self.dive_commands = (
            torch.tensor(dive_values, dtype=torch.float64) if any(dive_values) else None
        )

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        return commands_from_demand(self.command_specs, drive, steer)

    def servo_commands(self, command: Tensor) -> Tensor:
        return self.config.servo_commands(command)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        return self.config.force(self.servo_positions(states, command), command, nu)


Coefficients = tuple[float, float, float]
CurveRange = tuple[RevsPerSecond, RevsPerSecond]
"""Revolutions (astern, ahead) between which a curve was measured."""


def require_curve_covers_range(curve_range: CurveRange | None, n_max: float) -> None:
    """Stop where a shaft may turn faster than its thrust curve is known.

    Raises:
        ValueError: naming both.
    """
    lower, upper = curve_range or (-n_max, n_max)
    if lower > -n_max or upper < n_max:
        raise ValueError(
            f"curve_range {lower * 60:g} to {upper * 60:g} rpm does not reach n_max"
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
    def _validate_curve_range(self) -> Self:
        require_curve_covers_range(self.curve_range, self.n_max)
        return self
