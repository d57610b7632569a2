"""Input channels of baselines and heads: velocities, commands, forces and relative wind.

Position and heading are not channels, because the dynamics in body axes do not depend on them. The
true wind is transformed to wind relative to the vessel with the predicted heading and velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.columns import dynamic_states
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.frames import to_body
from residnet.core.layout import (
    PLANAR_LAYOUT,
    ROLL_LAYOUT,
    SIX_DOF_LAYOUT,
    VERTICAL_PLANE_VELOCITIES,
    DegreesOfFreedom,
)
from residnet.core.names import WIND_INPUTS, get_si_unit, require_plain_name, suggest_name
from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.hull import FossenConfig
from residnet.physics.symmetry import ChannelNames
from residnet.physics.vessel import load_vessel

WIND_CHANNELS = ("wind_u", "wind_v", "wind_mag")
FORCE_CHANNELS = ("tau_x", "tau_y", "tau_n")


class SignalsConfig(Config):
    """Inputs and degrees of freedom of a model.

    Attributes:
        inputs: command channels of the log, in order; constant over a time step.
        exogenous: other input channels. `wind_speed` and `wind_dir` (direction FROM which the true
            wind blows, in earth axes) are transformed to the channels wind_u, wind_v, wind_mag, the
            velocity of the air relative to the vessel in body axes.
        forces: a vessel (by name or file) whose thrusters convert the two inputs to tau_x, tau_y,
            tau_n; or a configuration of thrusters.
        pairs: inputs to port and starboard that are exchanged by mirroring, such as
            [[left, right]]; channels with the suffixes `_port` and `_stbd` are paired
            automatically. Angles also change sign.
        velocities: measured velocities of the model; the others are zero. A model of surge only has
            [u], one in the horizontal plane [u, v, r]. With an additional p the model has roll, and
            logs need the roll angle phi. [u, v, r, w, p, q] are six degrees of freedom, and logs
            need depth z, roll and pitch. Subsets of u, w and q are motions in the vertical plane,
            such as those of a float; logs need depth z, and pitch with q.
    """

    inputs: tuple[str, ...]
    exogenous: tuple[str, ...] = ()
    forces: str | DifferentialThrustConfig | None = None
    pairs: tuple[tuple[str, str], ...] = ()
    velocities: tuple[Literal["u", "v", "r", "w", "p", "q"], ...] = Field(
        default=("u", "v", "r"), min_length=1
    )

    @model_validator(mode="after")
    def _validate_combination(self) -> SignalsConfig:
        for name in self.inputs:
            require_plain_name(name)
        self._validate_exogenous()
        if self.with_thrusters().forces is not None and len(self.inputs) != 2:
            raise ValueError(
                f"forces: expected the inputs of two thrusters, got {list(self.inputs)}"
            )
        self._validate_velocities()
        self._validate_input_names()
        return self

    def _validate_exogenous(self) -> None:
        """Refuse exogenous channels other than the speed and direction of the wind together."""
        for name in self.exogenous:
            if name not in WIND_INPUTS:
                raise ValueError(
                    f"exogenous channel '{name}' is unknown{suggest_name(name, WIND_INPUTS)}"
                )
        if self.exogenous and set(self.exogenous) != set(WIND_INPUTS):
            raise ValueError(
                f"exogenous: expected both {' and '.join(WIND_INPUTS)}, got {list(self.exogenous)}"
            )

    def _validate_velocities(self) -> None:
        """Refuse sets of velocities that no model of this package has."""
        if self.dof.is_six_dof:
            vertical_plane = tuple(
                name for name in VERTICAL_PLANE_VELOCITIES if name in self.velocities
            )
            if self.velocities not in (SIX_DOF_LAYOUT.velocities, vertical_plane):
                raise ValueError(
                    "velocities: heave and pitch need a subset of u, w, q, or u, v, r, w, p, q in"
                    f" this order; got {', '.join(self.velocities)}"
                )
            if self.exogenous or self.forces:
                raise ValueError(
                    "velocities: a model in six degrees of freedom supports neither wind nor forces"
                    " of two thrusters; remove exogenous and forces"
                )
            return
        in_order = [name for name in ROLL_LAYOUT.velocities if name in self.velocities]
        if list(self.velocities) != in_order:
            raise ValueError(
                f"velocities: expected a subset of u, v, r, p in this order, got {self.velocities}"
            )
        if not set(self.velocities) & set(PLANAR_LAYOUT.velocities):
            raise ValueError("velocities: expected at least one of u, v, r, got [p]")
        # the wind relative to the vessel follows from heading and horizontal velocity
        if self.exogenous and self.dof.fixed_states:
            raise ValueError(
                "exogenous: wind needs u, v, r and a heading; remove it, or give logs with all of"
                " these"
            )

    def _validate_input_names(self) -> None:
        """Refuse inputs that occur twice or have the name of a computed channel."""
        duplicates = {
            name for name in self.inputs if name in self.exogenous or self.inputs.count(name) > 1
        }
        if duplicates:
            raise ValueError(f"inputs {sorted(duplicates)} are named twice")
        paired_names = [name for pair in self.pairs for name in pair]
        for name in paired_names:
            if name not in self.inputs:
                raise ValueError(f"pairs: no input '{name}'{suggest_name(name, self.inputs)}")
            if paired_names.count(name) > 1:
                raise ValueError(f"pairs: '{name}' is named twice")
        computed = (
            self.dof.state_names
            + (FORCE_CHANNELS if self.forces is not None else ())
            + (WIND_CHANNELS if self.exogenous else ())
        )
        if conflicting := [name for name in self.inputs if name in computed]:
            raise ValueError(
                f"input '{conflicting[0]}' is a state or a computed channel of the model;"
                " remove it or rename it in the channel map"
            )

    @property
    def input_columns(self) -> tuple[str, ...]:
        """Names of the columns of w [B, m]: inputs, then exogenous channels."""
        return self.inputs + self.exogenous

    @property
    def dof(self) -> DegreesOfFreedom:
        """Degrees of freedom of the model."""
        return DegreesOfFreedom(self.velocities)

    def with_thrusters(self) -> SignalsConfig:
        """Return the config with the thrusters of the vessel instead of its name.

        A saved model then needs no vessel file.

        Raises:
            ValueError: if the vessel does not exist.
        """
        if not isinstance(self.forces, str):
            return self
        try:
            vessel = load_vessel(self.forces)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        actuators = vessel.actuators if isinstance(vessel, FossenConfig) else None
        if not isinstance(actuators, DifferentialThrustConfig):
            raise ValueError(
                f"forces: the actuators of '{self.forces}' are not two thrusters"
                " (differential_thrust); remove forces"
            )
        return self.model_copy(update={"forces": actuators})

    def channel_units(self) -> dict[str, str]:
        """Return the SI unit of each state and input."""
        return {
            name: get_si_unit(name) or "-" for name in self.dof.state_names + self.input_columns
        }

    def build(self) -> Signals:
        """Build the module that computes the channels."""
        return Signals(self.with_thrusters())


class Signals(nn.Module):
    """Computes the channels z [B, nz] from state x [B, nx] and inputs w [B, m].

    `prepare` evaluates the part that depends on the inputs only, once per time step; `forward`
    evaluates the other part at every stage of the integrator.

    Attributes:
        names: names of the columns of z.
    """

    def __init__(self, config: SignalsConfig) -> None:
        super().__init__()
        self.n_inputs = len(config.inputs)
        self.has_wind = len(config.exogenous) > 0
        thrusters = config.forces if isinstance(config.forces, DifferentialThrustConfig) else None
        self.has_forces = thrusters is not None
        input_columns = config.input_columns
        # unused indices are 0, because TorchScript takes no optional attributes
        self.speed_column = input_columns.index("wind_speed") if self.has_wind else 0
        self.direction_column = input_columns.index("wind_dir") if self.has_wind else 0
        self.thrusters: nn.Module = (
            nn.Identity() if thrusters is None else thrusters.build().thruster_forces
        )
        names = config.dof.dynamic_states + config.inputs
        self.n_dof = config.dof.n_dynamic
        self.is_six_dof = config.dof.is_six_dof
        is_used = torch.tensor(
            [name not in config.dof.unmodelled_states for name in config.dof.dynamic_states]
        )
        self.used_velocities = nn.Buffer(is_used.double(), persistent=False)
        names += FORCE_CHANNELS if self.has_forces else ()
        names += WIND_CHANNELS if self.has_wind else ()
        self.names: tuple[str, ...] = ChannelNames(names, config.pairs, config.dof)
        self.n_channels = len(names)

    def prepare(self, w: Tensor) -> Tensor:
        """Compute the quantities [..., k] that are constant over a time step from w [..., m].

        They are inputs, forces and the wind velocity over ground (north, east).
        """
        # commands are constant over a step, so that the thrust and the true wind are evaluated once
        # per step and not at each stage of the integrator
        columns = [w[..., : self.n_inputs]]
        if self.has_forces:
            columns.append(self.thrusters(w[..., : self.n_inputs]))
        if self.has_wind:
            speed = w[..., self.speed_column]
            direction = w[..., self.direction_column]
            columns.append(
                # the direction is where the wind comes from: its velocity points the other way
                torch.stack((-speed * torch.cos(direction), -speed * torch.sin(direction)), dim=-1)
            )
        # joining a single part would copy it
        return columns[0] if len(columns) == 1 else torch.cat(columns, dim=-1)

    def forward(self, x: Tensor, p: Tensor) -> Tensor:
        """Compute the channels z [..., nz].

        Args:
            x: state [..., nx]: pose, then dynamic states.
            p: result of `prepare` for the inputs of the time step.
        """
        if self.is_six_dof:
            # depth and attitude are no channels; velocities that the model lacks are set to zero
            return torch.cat(
                (dynamic_states(x, self.n_dof) * self.used_velocities.to(x.dtype), p), dim=-1
            )
        if not self.has_wind:
            return torch.cat((dynamic_states(x, self.n_dof), p), dim=-1)
        n_inputs_and_forces = p.shape[-1] - 2
        wind_north = p[..., n_inputs_and_forces]
        wind_east = p[..., n_inputs_and_forces + 1]
        relative_x, relative_y = to_body(wind_north, wind_east, x[..., 2])
        relative_x = relative_x - x[..., 3]
        relative_y = relative_y - x[..., 4]
        # the offset keeps the gradient finite in a calm
        magnitude = torch.sqrt(relative_x * relative_x + relative_y * relative_y + 1e-8)
        return torch.cat(
            (
                dynamic_states(x, self.n_dof),
                p[..., :n_inputs_and_forces],
                torch.stack((relative_x, relative_y, magnitude), dim=-1),
            ),
            dim=-1,
        )


_MAX_ACCELERATION_STD = 10.0
"""Restoring acceleration half a training range outside the training range.

In standard deviations of the accelerations in the training data.
"""
_MIN_RATE = 0.05
"""Lower limit of the restoring rate of the velocity guard, 1/s."""
_MAX_RATE = 2.0
"""Upper limit of the restoring rate of the velocity guard, 1/s."""
_MIN_RANGE = 1e-9
"""Lower bound of the width of a range, for constant channels."""


@final
class RestoringAcceleration(RenamedStateModule):
    """Restoring acceleration [..., n] on velocities outside their training range, otherwise zero.

    A fitted model is not valid outside the training range. Without damping, the clamped
    acceleration would be integrated without limit.

    Args:
        margin: widening of the training range on either side, as a share of its width.
        n_channels: number of channels, the velocities first, that are clamped to their ranges.
        n_dof: number of velocities n.
    """

    renamed_state: ClassVar[Mapping[str, str]] = {"rate": "restoring_rate"}

    def __init__(
        self,
        margin: float = 0.0,
        n_channels: int = PLANAR_LAYOUT.n_dof,
        n_dof: int = PLANAR_LAYOUT.n_dof,
    ) -> None:
        super().__init__()
        self.margin = margin
        self.n_channels = n_channels
        self.n_dof = n_dof
        self.low = nn.Buffer(torch.zeros(n_channels, dtype=torch.float64))
        self.high = nn.Buffer(torch.zeros(n_channels, dtype=torch.float64))
        self.restoring_rate = nn.Buffer(torch.zeros(n_dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Compute the ranges of the channels, and the restoring rate from the accelerations."""
        channel_moments, target_moments = samples.running_moments()
        lower = channel_moments.minimum[: self.n_channels]
        upper = channel_moments.maximum[: self.n_channels]
        width = (upper - lower).clamp(min=_MIN_RANGE)
        self.low.copy_(lower - self.margin * width)
        self.high.copy_(upper + self.margin * width)
        acceleration_std = target_moments.std()
        self.restoring_rate.copy_(
            # rate * (half a range) = 10 standard deviations of the acceleration; the limits keep
            # the restoring term slower than a time step and faster than a drift
            (_MAX_ACCELERATION_STD * acceleration_std / (0.5 * width[: self.n_dof])).clamp(
                min=_MIN_RATE, max=_MAX_RATE
            )
        )

    def clamp(self, z: Tensor) -> Tensor:
        """Clamp channels z [..., nz] to their ranges."""
        lower = self.low.to(z.dtype)
        upper = self.high.to(z.dtype)
        clamped = z[..., : self.n_channels]
        # a refit differentiates this, and derivatives of minimum and maximum are slow
        clamped = torch.where(clamped > upper, upper, torch.where(clamped < lower, lower, clamped))
        return torch.cat((clamped, z[..., self.n_channels :]), dim=-1)

    def restoring_acceleration(self, clamped: Tensor, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz], given the clamped channels."""
        return self.restoring_rate.to(z.dtype) * (clamped[..., : self.n_dof] - z[..., : self.n_dof])

    def forward(self, z: Tensor) -> Tensor:
        """Return the restoring acceleration at channels z [..., nz]."""
        return self.restoring_acceleration(self.clamp(z), z)
