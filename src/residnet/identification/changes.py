"""Possible changes of a vessel, its environment or its sensors, and a model with such changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor

from residnet.core.columns import heading_rate
from residnet.core.frames import horizontal_to_body, to_body
from residnet.core.layout import (
    ATTITUDE,
    DYNAMIC_STATES,
    HEADING,
    SIX_DOF_LAYOUT,
    SURGE,
    SWAY,
    YAW_RATE,
)
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.symmetry import get_dof

_AXIS_NAMES = {"u": "surge", "v": "sway", "r": "yaw", "p": "roll", "w": "heave", "q": "pitch"}
_DAMPING_PROBE_SHARES = {"u": 0.1}
"""Share of a velocity that is removed to find its damping; 1 for velocities not listed."""


@dataclass(frozen=True)
class SystemChange:
    """A change of a vessel, its commands, its environment or a sensor.

    Attributes:
        name: short name for tables.
        description: the change in words, completing "the logs look as if ...".
        unit: unit of the size.
        size: size of the change; small, where sensitivities are computed.
        inertia_share: share of the size that adds to the inertia of all axes.
        damping: velocity whose damping changes, with the size as a share; empty for none.
        damped_by: state that causes the damping: the velocity if empty, or an angle with a
            restoring moment.
        push_direction: north and east components of a force, in units of the size.
        gain_input: index of the input whose gain changes by the size; None for none.
        offset_input: index of the input whose offset is the size; None for none.
        sensor: sensor fault: `gyro_scale`, `gyro_offset`, `speed_scale`, `lag`, or `current_north`,
            `current_east` for a moving water mass; empty for none.
    """

    name: str
    description: str
    unit: str
    size: float
    inertia_share: float = 0.0
    damping: str = ""
    damped_by: str = ""
    push_direction: tuple[float, float] = (0.0, 0.0)
    gain_input: int | None = None
    offset_input: int | None = None
    sensor: str = ""


def make_fault_hypotheses(signals: SignalsConfig) -> list[SystemChange]:
    """Return the changes that a monitor looks for, given the inputs of a model."""

    def share(name: str, description: str, **effect: Any) -> SystemChange:
        return SystemChange(name, description, "share", 0.02, **effect)

    units = signals.channel_units()
    dof = signals.dof
    changes = [share("mass", "the vessel has become heavier", inertia_share=1.0)]
    for velocity in dof.velocities:
        description = f"the damping in {_AXIS_NAMES[velocity]} has grown"
        changes.append(share(f"damping {_AXIS_NAMES[velocity]}", description, damping=velocity))
    if dof.has_roll:
        description = "the vessel has become stiffer in roll"
        changes.append(share("restoring", description, damping="p", damped_by="phi"))
    if dof.is_six_dof:
        description = "the vessel has become stiffer in pitch"
        changes.append(share("restoring pitch", description, damping="q", damped_by="theta"))
    for input_index, name in enumerate(signals.inputs):
        changes.append(
            share(f"gain {name}", f"{name} has grown stronger than it was", gain_input=input_index)
        )
        if units.get(name) == "rad":
            description = f"{name} has an offset"
            changes.append(
                SystemChange(f"offset {name}", description, "rad", 0.01, offset_input=input_index)
            )
    gyro = [
        share("gyro scale", "the gyro shows too much", sensor="gyro_scale"),
        SystemChange("gyro offset", "the gyro has an offset", "rad/s", 0.001, sensor="gyro_offset"),
    ]
    speed_scale = share("speed scale", "u and v are shown too large", sensor="speed_scale")
    lag = SystemChange("lag", "velocities come late", "s", 0.1, sensor="lag")
    return [*changes, *gyro * dof.has_heading, *[speed_scale] * dof.has_position, lag]


def make_nuisance_changes() -> list[SystemChange]:
    """Return changes of wind and current, which must not be attributed to the vessel."""
    return [
        SystemChange("current north", "", "m/s", 0.05, sensor="current_north"),
        SystemChange("current east", "", "m/s", 0.05, sensor="current_east"),
        SystemChange("push north", "", "m/s^2", 0.005, push_direction=(1.0, 0.0)),
        SystemChange("push east", "", "m/s^2", 0.005, push_direction=(0.0, 1.0)),
    ]


def compute_sensor_effect(
    sensor: str, x: Tensor, accelerations: Tensor, change_size: float
) -> Tensor:
    """Return the change of measured states [..., 3 + n] due to a sensor fault.

    Args:
        sensor: sensor fault, see `SystemChange`; empty for none.
        x: true states [..., 3 + n].
        accelerations: rates of the dynamic states [..., n], for a lag.
        change_size: size of the fault.
    """
    effect = torch.zeros_like(x)
    if sensor == "gyro_scale":
        effect[..., YAW_RATE] = change_size * x[..., YAW_RATE]
    elif sensor == "gyro_offset":
        effect[..., YAW_RATE] = change_size
    elif sensor == "speed_scale":
        effect[..., SURGE : SWAY + 1] = change_size * x[..., SURGE : SWAY + 1]
    elif sensor == "lag":
        # first order in the lag: nu(t - lag) = nu(t) - lag nu_dot(t)
        effect[..., DYNAMIC_STATES] = -change_size * accelerations
    elif sensor in ("current_north", "current_east"):
        north = x.new_tensor(change_size if sensor == "current_north" else 0.0)
        effect = effect + resolve_in_body_axes(x, north, change_size - north)
    return effect


def resolve_in_body_axes(x: Tensor, north: Tensor, east: Tensor) -> Tensor:
    """Return a horizontal vector as velocities in states x [..., 3 + n], zero elsewhere."""
    velocities = torch.zeros_like(x)
    if x.shape[-1] == len(SIX_DOF_LAYOUT.state_names):
        body_components = horizontal_to_body(north, east, x[..., list(ATTITUDE)])
        columns = [SURGE, SWAY, SIX_DOF_LAYOUT.state_names.index("w")]
    else:
        body_components = [*to_body(north, east, x[..., HEADING])]
        columns = [SURGE, SWAY]
    for column, component in zip(columns, body_components, strict=True):
        velocities[..., column] = component
    return velocities


@final
class PerturbedDynamics(Dynamics):
    """A model with a different change in each block of rows.

    Args:
        model: unchanged model.
        changes: C changes; rows [C * B] are blocks of B.
        block_size: B, the number of rows of a block.
        n_inputs: number of inputs of the model.
    """

    def __init__(
        self, model: HybridDynamics, changes: Sequence[SystemChange], block_size: int, n_inputs: int
    ) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.n_state = model.n_state
        self.dof = model.dof
        self.has_roll = model.has_roll
        dynamic_states = get_dof(model.signals.names).dynamic_states

        def repeat_per_row(values: Sequence[Sequence[float]]) -> Tensor:
            table = torch.tensor(values, dtype=torch.float64)
            return table.repeat_interleave(block_size, dim=0)

        def size_per_input(get_input_index: Callable[[SystemChange], int | None]) -> Tensor:
            input_indices = range(n_inputs)
            return repeat_per_row(
                [
                    [change.size * (get_input_index(change) == i) for i in input_indices]
                    for change in changes
                ]
            )

        self.inertia_factor = repeat_per_row(
            [[1.0 + change.size * change.inertia_share] for change in changes]
        )
        self.push_acceleration = repeat_per_row(
            [[change.size * axis for axis in change.push_direction] for change in changes]
        )
        self.input_gain = 1.0 + size_per_input(lambda change: change.gain_input)
        self.input_offset = size_per_input(lambda change: change.offset_input)
        damping_change_indices = [k for k, change in enumerate(changes) if change.damping]
        self.has_damping_changes = len(damping_change_indices) > 0
        self.damped_rows = torch.tensor(damping_change_indices).repeat_interleave(
            block_size
        ) * block_size + torch.arange(block_size).repeat(len(damping_change_indices))

        def repeat_for_damped(
            values: Sequence[float], dtype: torch.dtype = torch.float64
        ) -> Tensor:
            return torch.tensor(values, dtype=dtype).repeat_interleave(block_size)

        damping_names = [changes[k].damped_by or changes[k].damping for k in damping_change_indices]
        self.damped_columns = repeat_for_damped(
            [dynamic_states.index(changes[k].damping) for k in damping_change_indices], torch.long
        )
        self.damping_columns = repeat_for_damped(
            [dynamic_states.index(name) for name in damping_names], torch.long
        )
        self.probe_shares = repeat_for_damped(
            [_DAMPING_PROBE_SHARES.get(name, 1.0) for name in damping_names]
        )
        self.damping_sizes = repeat_for_damped([changes[k].size for k in damping_change_indices])

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        # step of the nominal model with the changed commands
        w = w * self.input_gain + self.input_offset
        nominal_next_state, next_memory = self.model.step(x, w, s)
        nu = x[:, DYNAMIC_STATES]
        velocity_increment = nominal_next_state[:, DYNAMIC_STATES] - nu
        # the changes act on the velocity increment of the step
        if self.has_damping_changes:
            velocity_increment = velocity_increment - self._damping_perturbation(
                x, w, s, velocity_increment
            )
        pushed_acceleration = resolve_in_body_axes(x, *self.push_acceleration.unbind(1))[
            :, DYNAMIC_STATES
        ]
        changed_velocities = (
            nu + velocity_increment / self.inertia_factor + self.dt * pushed_acceleration
        )
        # the angles follow the changed velocities; in six degrees of freedom as a rotation
        changed_next_state = nominal_next_state.clone()
        if self.model.is_spatial:
            changed_velocities = torch.where(
                self.model.equation_mask > 0.0,
                changed_velocities,
                nominal_next_state[:, DYNAMIC_STATES],
            )
            changed_next_state[:, DYNAMIC_STATES] = changed_velocities
            rotation_vector = torch.zeros_like(nominal_next_state)
            rate_columns = [SIX_DOF_LAYOUT.state_names.index(name) for name in "pqr"]
            rotation_vector[:, ATTITUDE] = (
                0.5 * self.dt * (changed_next_state - nominal_next_state)[:, rate_columns]
            )
            return self.model.add_change(changed_next_state, rotation_vector), next_memory
        # angles change by half of the velocity change times dt: the mean over a step in which the
        # change grows linearly from zero
        angle_increments = (
            changed_velocities - nominal_next_state[:, DYNAMIC_STATES]
        ) @ self.model.angle_rate_matrix
        changed_angles = nominal_next_state[:, DYNAMIC_STATES] + 0.5 * self.dt * angle_increments
        changed_next_state[:, DYNAMIC_STATES] = torch.where(
            self.model.equation_mask > 0.0, changed_velocities, changed_angles
        )
        yaw_rate_change = heading_rate(
            changed_next_state[:, DYNAMIC_STATES], self.dof
        ) - heading_rate(nominal_next_state[:, DYNAMIC_STATES], self.dof)
        changed_next_state[:, HEADING] = (
            nominal_next_state[:, HEADING] + 0.5 * self.dt * yaw_rate_change[:, 0]
        )
        return changed_next_state, next_memory

    def _damping_perturbation(
        self, x: Tensor, w: Tensor, s: Tensor, velocity_increment: Tensor
    ) -> Tensor:
        """Return the effect of changed damping on the velocities after a step [B, n].

        Damping is the difference of the step with and without the velocity; for surge only a part
        of the speed is removed, since models may be valid only near the service speed.
        """
        damped_rows = self.damped_rows
        damped_columns = self.damped_columns
        probe_shares = self.probe_shares.to(x.dtype)
        row_indices = torch.arange(len(damped_rows))
        velocity_shares = torch.ones(len(damped_rows), self.dof, dtype=x.dtype)
        velocity_shares[row_indices, self.damping_columns] = 1.0 - probe_shares
        probe_states = x[damped_rows].clone()
        probe_states[:, DYNAMIC_STATES] = probe_states[:, DYNAMIC_STATES] * velocity_shares
        increment_without_velocity = (
            self.model.step(probe_states, w[damped_rows], s[damped_rows])[0][:, DYNAMIC_STATES]
            - probe_states[:, DYNAMIC_STATES]
        )
        perturbation = torch.zeros_like(velocity_increment)
        perturbation[damped_rows, damped_columns] = (
            self.damping_sizes
            * (
                increment_without_velocity[row_indices, damped_columns]
                - velocity_increment[damped_rows, damped_columns]
            )
            / probe_shares
        )
        return perturbation
