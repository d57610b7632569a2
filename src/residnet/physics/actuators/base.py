"""Interfaces of actuators: dynamics from commands to positions, and forces on the hull."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from residnet.physics.actuators.config import CommandSpec, ServoSpec, SteeredConfig


@final
class Servo(nn.Module):
    """Servo of c equal actuators: saturation, delay line and dynamic response of commands [..., c].

    States [..., k c] are blocks of c: positions, other states of the response, then the delayed
    commands, newest first. Names of states that are not measured begin with `_`.
    """

    def __init__(self, spec: ServoSpec) -> None:
        super().__init__()
        self.spec = spec
        self.response = spec.config.response
        self.limit = spec.limit
        self.n_actuators = len(spec.names)
        self.has_lag = len(self.response.state_suffixes) > 0
        self.rate_limit = float("inf") if spec.rate_limit is None else spec.rate_limit
        self.n_lag_states = len(spec.lag_suffixes) * self.n_actuators
        self.n_delay_steps = spec.n_delay_steps
        self.state_names = spec.state_names

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
        self.spec.require_step(dt)
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

    def __init__(self, *servo_specs: ServoSpec) -> None:
        super().__init__()
        servos = [Servo(spec) for spec in servo_specs]
        self.servos = nn.ModuleList(servos)
        self.state_names = tuple(name for servo in servos for name in servo.state_names)
        self.state_counts = [len(servo.state_names) for servo in servos]
        self.command_counts = [servo.n_actuators for servo in servos]
        self.is_force_constant_in_step = not (
            self.depends_on_speed or any(servo.has_lag for servo in servos)
        )

    @abstractmethod
    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return commands [..., c] for propulsion and steering commands [...] within +-1."""

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
        """Return the rates [..., k] of the servo states, per second, towards a command [..., c]."""
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


def commands_from_demand(specs: Sequence[CommandSpec], drive: Tensor, steer: Tensor) -> Tensor:
    """Return commands [..., c] for normalised propulsion and steering commands [...]."""
    no_demand = torch.zeros_like(steer)
    demand = {"drive": drive, "steer": steer, "dive": no_demand, "roll": no_demand}
    shares = [
        demand[spec.demand_axis].clamp(spec.min_demand, 1.0) * spec.max_value for spec in specs
    ]
    return torch.stack(shares, dim=-1)


@final
class SteeredActuators(ActuatorSystem):
    """Rudders, fins or jets with their propellers, defined by a configuration."""

    def __init__(self, config: SteeredConfig) -> None:
        super().__init__(*config.servo_specs())
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
