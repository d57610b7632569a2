"""Configuration of the input channels of baselines and heads (residual models)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.layout import (
    PLANAR_LAYOUT,
    ROLL_LAYOUT,
    SIX_DOF_LAYOUT,
    VERTICAL_PLANE_VELOCITIES,
    DegreesOfFreedom,
)
from residnet.core.names import (
    FORCE_CHANNELS,
    WIND_CHANNELS,
    WIND_INPUTS,
    get_si_unit,
    require_plain_name,
    suggest_name,
)
from residnet.physics.actuators.thrusters_config import DifferentialThrustConfig
from residnet.physics.hull import FossenConfig
from residnet.physics.symmetry import ChannelNames
from residnet.physics.vessel import load_vessel

if TYPE_CHECKING:
    from residnet.physics.signals import Signals


class SignalsConfig(Config):
    """Inputs and degrees of freedom of a model.

    Attributes:
        inputs: command channels of the log, in order; constant over a time step.
        exogenous: other input channels. `wind_speed` and `wind_dir` (direction FROM which the true
            wind blows, in earth axes) are transformed to the channels wind_u, wind_v, wind_mag, the
            velocity of the air relative to the vessel in body axes.
        unexcited: inputs that the logs held at one value, or in proportion to another input. Their
            effect cannot be identified, so they are no regressors; they remain inputs of the model,
            which flags values that the logs do not contain (`residnet.dynamics.domain`).
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
    unexcited: tuple[str, ...] = ()
    forces: str | DifferentialThrustConfig | None = None
    pairs: tuple[tuple[str, str], ...] = ()
    velocities: tuple[Literal["u", "v", "r", "w", "p", "q"], ...] = Field(
        default=("u", "v", "r"), min_length=1
    )

    @model_validator(mode="after")
    def _validate_combination(self) -> SignalsConfig:
        for name in (*self.inputs, *self.unexcited):
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
        duplicates = {name for name in self.input_columns if self.input_columns.count(name) > 1}
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
        if conflicting := [n for n in (*self.inputs, *self.unexcited) if n in computed]:
            raise ValueError(
                f"input '{conflicting[0]}' is a state or a computed channel of the model;"
                " remove it or rename it in the channel map"
            )

    @property
    def input_columns(self) -> tuple[str, ...]:
        """Names of the columns of w [B, m]: inputs, exogenous channels, unexcited inputs."""
        return self.inputs + self.exogenous + self.unexcited

    @property
    def regressor_columns(self) -> tuple[str, ...]:
        """Names of the columns of w that the motion of the model depends on."""
        return self.inputs + self.exogenous

    @property
    def dof(self) -> DegreesOfFreedom:
        """Degrees of freedom that follow from `velocities`."""
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

    def channel_names(self) -> ChannelNames:
        """Return the names of the channels z of baselines and heads."""
        names = self.dof.dynamic_states + self.inputs
        names += FORCE_CHANNELS if self.forces is not None else ()
        names += WIND_CHANNELS if self.exogenous else ()
        return ChannelNames(names, self.pairs, self.dof)

    def channel_units(self) -> dict[str, str]:
        """Return the SI unit of each state and input."""
        return {
            name: get_si_unit(name) or "-" for name in self.dof.state_names + self.input_columns
        }

    def build(self) -> Signals:
        """Build the module that computes the channels."""
        from residnet.physics.signals import Signals

        return Signals(self.with_thrusters())
