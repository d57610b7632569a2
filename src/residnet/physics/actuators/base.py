"""Interfaces of actuators: dynamics from commands to positions, and forces on the hull."""

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
    """Dynamic response of an actuator from its target to its position.

    Attributes:
        kind: kind of the response.
    """

    state_suffixes: ClassVar[tuple[str, ...]]
    """Suffixes of the names of the response states, appended to the name of the actuator."""
    kind: str

    @abstractmethod
    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return the derivative of the states [..., k c] for a target [..., c]."""


@final
class ImmediateConfig(ResponseConfig):
    """Response without lag, limited by the rate limit only."""

    state_suffixes = ()
    kind: Literal["immediate"] = "immediate"

    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return zeros, because the position is updated once per time step."""
        return torch.zeros_like(states)


@final
class FirstOrderConfig(ResponseConfig):
    """First-order response, a_dot = (target - a) / T within the rate limit.

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
    """Second-order response, a_ddot = w^2 (target - a) - 2 zeta w a_dot.

    At the rate limit the acceleration is zero.

    Attributes:
        frequency: natural frequency in rad/s.
        damping: damping ratio.
    """

    state_suffixes = ("", "_rate")
    kind: Literal["second_order"] = "second_order"
    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)

    def derivative(self, states: Tensor, target: Tensor, rate_limit: float) -> Tensor:
        """Return the derivatives of the positions, then those of their rates."""
        position, velocity = states.chunk(2, dim=-1)
        limited_velocity = velocity.clamp(-rate_limit, rate_limit)
        acceleration = (
            self.frequency**2 * (target - position)
            - 2.0 * self.damping * self.frequency * limited_velocity
        )
        # a rate at its limit must not grow further, or it would take time to leave the limit
        # (windup)
        is_rate_limited = (velocity.abs() >= rate_limit) & (acceleration * velocity > 0)
        return torch.cat(
            (
                limited_velocity,
                torch.where(is_rate_limited, torch.zeros_like(acceleration), acceleration),
            ),
            dim=-1,
        )


class ServoConfig(Config):
    """Common settings of actuators that follow a command.

    The keys of the limits belong to the subclasses, because their units differ.

    Attributes:
        response: dynamic response.
        dead_time: time between a command and its first effect, a multiple of `delay_step`.
        delay_step: time step of the delay line; the simulation must use this step.
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
                "dead_time and delay_step must be given together; delay_step is the time step of"
                " the plant (data.step divided by data.substeps)"
            )
        if self.delay_step is not None:
            # the delay line stores one command per step
            taps = self.dead_time / self.delay_step
            if abs(taps - round(taps)) > 1e-6 * taps or not 1 <= round(taps) <= 1000:
                raise ValueError(
                    f"dead_time ({self.dead_time:g} s) must be 1 to 1000 times delay_step"
                    f" ({self.delay_step:g} s)"
                )
        return self

    def build_limited_servo(self, limit: float, rate_limit: float | None, *names: str) -> Servo:
        """Build the servo of equal actuators with a limit and a rate limit."""
        return Servo(self, limit, rate_limit, names)


class SteeringGearConfig(ServoConfig):
    """Steering gear of a rudder.

    Attributes:
        limit: maximum rudder angle to either side in rad.
        rate: maximum rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)

    def build_servo(self, *names: str) -> Servo:
        """Build the servo of rudders with these names."""
        return self.build_limited_servo(self.limit, self.rate, *names)


class ShaftConfig(ServoConfig):
    """Shaft of a propeller or a jet.

    Attributes:
        n_max: maximum revolutions in either direction in 1/s, at which commands saturate.
        n_rate: maximum rate of change of the revolutions in 1/s^2; None for no limit.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)

    def build_servo(self, *names: str) -> Servo:
        """Build the servo of shafts with these names."""
        return self.build_limited_servo(self.n_max, self.n_rate, *names)


@final
class Servo(nn.Module):
    """Servo of c equal actuators: saturation, delay line and dynamic response of commands [..., c].

    States [..., k c] are blocks of c: positions, other states of the response, then the delayed
    commands, newest first. Names of states that are not measured begin with `_`.
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
        # a rate limit without lag also needs the position as a state
        suffixes = config.response.state_suffixes or (() if rate_limit is None else ("",))
        self.n_lag_states = len(suffixes) * self.n_actuators
        self.delay_step = config.delay_step or 0.0
        self.n_delay_steps = round(config.dead_time / self.delay_step) if self.delay_step else 0
        self.state_names = (
            *(f"{'_' if suffix else ''}{name}{suffix}" for suffix in suffixes for name in names),
            *(f"_{name}_delay{i + 1}" for i in range(self.n_delay_steps) for name in names),
        )

    def current_target(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the current targets [..., c]: saturated, delayed commands."""
        if self.n_delay_steps == 0:
            return command.clamp(-self.limit, self.limit)
        return states[..., -self.n_actuators :]

    def position(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the positions [..., c], clamped to the limit."""
        if self.n_lag_states == 0:
            return self.current_target(states, command)
        return states[..., : self.n_actuators].clamp(-self.limit, self.limit)

    def derivative(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the derivative of the states [..., k c]."""
        if not self.has_lag:
            return torch.zeros_like(states)
        lag_derivative = self.response.derivative(
            states[..., : self.n_lag_states], self.current_target(states, command), self.rate_limit
        )
        return torch.cat(
            (lag_derivative, torch.zeros_like(states[..., self.n_lag_states :])), dim=-1
        )

    def advance_step(self, states: Tensor, command: Tensor, dt: float) -> Tensor:
        """Apply rate limits and delay lines for a time step of dt seconds to states [..., k c].

        Raises:
            ConfigError: if dt is not the step of the delay line.
        """
        # without lag the position moves to its target at the limited rate, once per step: an
        # integrator with stages would overshoot the target
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
                f" steps by {dt:g} s; set delay_step to the time step of the plant (data.step"
                " divided by data.substeps)"
            )
        # shift the delay line by one step
        newest_command = command.clamp(-self.limit, self.limit)
        return torch.cat(
            (lag_states, newest_command, states[..., self.n_lag_states : -self.n_actuators]), dim=-1
        )


class ActuatorSystem(nn.Module, ABC):
    """All actuators of a vessel, from commands [..., c] and states [..., k] to forces on the hull.

    A state is either integrated together with the hull (`derivative`, for lags) or updated once per
    time step after the integration (`advance_step`, for rate limits and delay lines).

    Attributes:
        state_names: names of the states; empty if the commands act without dynamics. Names of
            states that are not measured begin with `_` and do not occur in logs.
        command_names: names of the commands.
        depends_on_speed: whether forces depend on the speed of the vessel.
        is_force_constant_in_step: whether forces are constant over a time step.
        dive_commands: commands [c] of full force downwards; None if the vessel cannot dive.
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
        """Return commands [..., c] for drive and steer [...] of a manoeuvre, each within +-1."""

    @abstractmethod
    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Compute the forces tau [..., n] on the hull in N and N m.

        Args:
            states: states [..., k].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] of the servos, in their order."""
        return command

    def _iterate_servos(
        self, states: Tensor, command: Tensor
    ) -> Iterator[tuple[Servo, Tensor, Tensor]]:
        servo_states = torch.split(states, self.state_counts, dim=-1)
        servo_commands = torch.split(self.servo_commands(command), self.command_counts, dim=-1)
        yield from zip(self.servos, servo_states, servo_commands, strict=True)

    def servo_positions(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the positions of all servos [..., c]."""
        positions = [
            servo.position(servo_state, servo_command)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(positions, dim=-1)

    def derivative(self, states: Tensor, command: Tensor) -> Tensor:
        """Return the derivative of the states [..., k]."""
        derivatives = [
            servo.derivative(servo_state, servo_command)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(derivatives, dim=-1)

    def advance_step(self, states: Tensor, command: Tensor, dt: float) -> Tensor:
        """Apply the updates of a time step of dt seconds to the states [..., k]."""
        next_states = [
            servo.advance_step(servo_state, servo_command, dt)
            for servo, servo_state, servo_command in self._iterate_servos(states, command)
        ]
        return torch.cat(next_states, dim=-1)


class ForceActuators(ActuatorSystem, ABC):
    """Actuators that can produce any force in surge, sway and yaw within their limits."""

    depends_on_speed = False

    @abstractmethod
    def allocate(self, force: Tensor) -> Tensor:
        """Return the commands [..., c] that request forces tau [..., 3] in N, N, N m."""

    @abstractmethod
    def requested_force(self, command: Tensor) -> Tensor:
        """Return the forces tau [..., 3] that commands [..., c] request, before dynamics."""


class ActuatorConfig(Config, ABC):
    """Common part of the section `actuators` of a vessel file.

    Attributes:
        kind: kind of the actuators.
        source: reference of the parameters.
    """

    kind: str
    source: str

    @abstractmethod
    def build(self) -> ActuatorSystem:
        """Build the actuators."""


class CommandSpec(NamedTuple):
    """Specification of a command of steered actuators.

    Attributes:
        name: name of the command.
        demand_axis: normalised demand of a manoeuvre that sets it, drive or steer.
        max_value: value at a demand of 1.
        min_share: minimum demand as a share of the maximum; 0 for actuators that act in one
            direction only, otherwise -1.
    """

    name: str
    demand_axis: Literal["drive", "steer", "dive"]
    max_value: float
    min_share: float = -1.0


def commands_from_demand(specs: Sequence[CommandSpec], drive: Tensor, steer: Tensor) -> Tensor:
    """Return commands [..., c] for normalised drive and steer [...]."""
    demand = {"drive": drive, "steer": steer, "dive": torch.zeros_like(steer)}
    shares = [
        demand[spec.demand_axis].clamp(spec.min_share, 1.0) * spec.max_value for spec in specs
    ]
    return torch.stack(shares, dim=-1)


class SteeredConfig(ActuatorConfig, ABC):
    """Actuators whose forces are computed by their configuration."""

    @abstractmethod
    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the specifications of the commands, those with servos first."""

    @abstractmethod
    def build_servos(self) -> tuple[Servo, ...]:
        """Build the servos, in the order of the commands."""

    @abstractmethod
    def force(self, position: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Compute the forces tau [..., n] on the hull in N and N m.

        Args:
            position: positions of the servos [..., c].
            command: commands [..., c].
            nu: velocities through the water [..., n].
        """

    def servo_commands(self, command: Tensor) -> Tensor:
        """Return the commands [..., c] of the servos, in their order."""
        return command

    @final
    def build(self) -> SteeredActuators:
        return SteeredActuators(self)


@final
class SteeredActuators(ActuatorSystem):
    """Rudders, fins or jets with their propellers, defined by a configuration."""

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
"""Range of revolutions (astern, ahead) in which a curve was measured."""


def require_curve_covers_range(curve_range: CurveRange | None, n_max: float) -> None:
    """Check that the measured range of a thrust curve includes +-n_max.

    Raises:
        ValueError: if it does not.
    """
    lower, upper = curve_range or (-n_max, n_max)
    if lower > -n_max or upper < n_max:
        raise ValueError(
            f"curve_range {lower * 60:g} to {upper * 60:g} rpm does not reach n_max"
            f" (+-{n_max * 60:g} rpm); lower n_max or measure the curve further"
        )


class ThrustConfig(Config):
    """Thrust curve of a propeller, c0 + c1 n + c2 n^2, clipped to the sign of the rotation.

    Attributes:
        n_max: maximum revolutions in either direction in 1/s, at which commands saturate.
        forward: coefficients c0 [N], c1 [N s], c2 [N s^2] for n > 0 [1/s], at zero speed.
        reverse: coefficients for n < 0 (signed).
        curve_range: range of revolutions (astern, ahead) in 1/s in which the curve was measured; it
            must include +-n_max.
    """

    n_max: RevsPerSecond = Field(gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None

    @model_validator(mode="after")
    def _validate_curve_range(self) -> Self:
        require_curve_covers_range(self.curve_range, self.n_max)
        return self
