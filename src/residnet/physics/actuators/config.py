"""Configuration of actuators: servos, shafts, thrust curves and commands."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, Self, final

from pydantic import Field, model_validator

from residnet.core.config import (
    Config,
    PolynomialOf,
    Radians,
    RadiansPerSecond,
    RevRate,
    RevsPerSecond,
    Seconds,
)
from residnet.core.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.physics.actuators.base import ActuatorSystem, SteeredActuators


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
        import torch

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
        """Return the derivatives of the positions, then the derivatives of their rates."""
        import torch

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

    def limited_servo(self, limit: float, rate_limit: float | None, *names: str) -> ServoSpec:
        """Return the servo of equal actuators with a limit and a rate limit."""
        return ServoSpec(self, limit, rate_limit, names)


class SteeringGearConfig(ServoConfig):
    """Steering gear of a rudder.

    Attributes:
        limit: maximum rudder angle to either side in rad.
        rate: maximum rudder rate in rad/s; None for no limit.
    """

    limit: Radians = Field(gt=0, lt=1.5707)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)

    def servo_spec(self, *names: str) -> ServoSpec:
        """Return the servo of rudders with these names."""
        return self.limited_servo(self.limit, self.rate, *names)


class ShaftConfig(ServoConfig):
    """Shaft of a propeller or a jet.

    Attributes:
        n_max: maximum revolutions in either direction in 1/s, at which commands saturate.
        n_rate: maximum rate of change of the revolutions in 1/s^2; None for no limit.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)

    def servo_spec(self, *names: str) -> ServoSpec:
        """Return the servo of shafts with these names."""
        return self.limited_servo(self.n_max, self.n_rate, *names)


@dataclass(frozen=True)
class ServoSpec:
    """Specification of a servo of c equal actuators.

    Attributes:
        config: response and dead time.
        limit: largest position in either direction.
        rate_limit: largest rate of the position; None for no limit.
        names: names of the actuators.
    """

    config: ServoConfig
    limit: float
    rate_limit: float | None
    names: tuple[str, ...]

    @property
    def lag_suffixes(self) -> tuple[str, ...]:
        """Suffixes of the states of the response and the rate limit, of each actuator."""
        # a rate limit without lag also needs the position as a state
        return self.config.response.state_suffixes or (() if self.rate_limit is None else ("",))

    @property
    def n_delay_steps(self) -> int:
        """Dead time in steps of the plant, rounded; 0 without a delay."""
        delay_step = self.config.delay_step
        return round(self.config.dead_time / delay_step) if delay_step else 0

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in blocks of c; those that are not measured begin with `_`."""
        return (
            *(
                f"{'_' if suffix else ''}{name}{suffix}"
                for suffix in self.lag_suffixes
                for name in self.names
            ),
            *(f"_{name}_delay{i + 1}" for i in range(self.n_delay_steps) for name in self.names),
        )

    def require_step(self, dt: float) -> None:
        """Check that a time step in s equals the step of the delay line.

        Raises:
            ConfigError: if it is not.
        """
        delay_step = self.config.delay_step or 0.0
        if self.n_delay_steps and abs(dt - delay_step) > 1e-9:
            raise ConfigError(
                f"actuator with dead time: its delay_step is {delay_step:g} s, but the plant"
                f" steps by {dt:g} s; set delay_step to the time step of the plant (data.step"
                " divided by data.substeps)"
            )


class ActuatorConfig(Config, ABC):
    """Common part of the section `actuators` of a vessel file.

    Attributes:
        kind: kind of the actuators.
        source: reference of the parameters.
    """

    kind: str
    source: str

    @abstractmethod
    def servo_specs(self) -> tuple[ServoSpec, ...]:
        """Return the servos, in the order of the commands."""

    @abstractmethod
    def command_names(self) -> tuple[str, ...]:
        """Return the channels that command the actuators, such as `cmd_delta`."""

    @property
    def can_dive(self) -> bool:
        """Whether a command forces the vessel downwards."""
        return False

    @property
    def max_rudder(self) -> float | None:
        """Rudder angle of the full steering command in rad; None without a rudder."""
        return None

    @abstractmethod
    def build(self) -> ActuatorSystem:
        """Build the model of the forces and the dynamics of the actuators."""


class CommandSpec(NamedTuple):
    """Specification of a command of steered actuators.

    Attributes:
        name: name of the command.
        demand_axis: normalised demand of a manoeuvre that sets it; manoeuvres demand no roll, so
            that stabiliser fins stay amidships.
        max_value: value at a demand of 1.
        min_demand: smallest demand; 0 for actuators that act in one direction only, otherwise -1.
    """

    name: str
    demand_axis: Literal["drive", "steer", "dive", "roll"]
    max_value: float
    min_demand: float = -1.0


RUDDER_INPUTS = ("cmd_delta", "delta")
"""Names that the input of a rudder angle may have."""


def find_max_rudder(commands: Sequence[CommandSpec]) -> float | None:
    """Return the rudder angle in rad of the full steering command; None without a rudder angle."""
    return next((c.max_value for c in commands if c.name in RUDDER_INPUTS), None)


class SteeredConfig(ActuatorConfig, ABC):
    """Actuators whose forces are computed by their configuration."""

    @abstractmethod
    def command_specs(self) -> tuple[CommandSpec, ...]:
        """Return the specifications of the commands, those with servos first."""

    @final
    def command_names(self) -> tuple[str, ...]:
        return tuple(command.name for command in self.command_specs())

    @property
    def can_dive(self) -> bool:
        return any(command.demand_axis == "dive" for command in self.command_specs())

    @property
    def max_rudder(self) -> float | None:
        return find_max_rudder(self.command_specs())

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
        from residnet.physics.actuators.base import SteeredActuators

        return SteeredActuators(self)


Coefficients = Annotated[tuple[float, float, float], PolynomialOf("N", "1/s")]
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
