"""The channels that baselines and heads may use: velocities, commands, forces, relative wind.

Position and heading are not offered: a model in body axes must not depend on where the vessel is or
where it points. True wind enters earth-fixed and is turned into wind relative to the vessel with
the predicted heading and velocity.
"""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.columns import velocities
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.frames import to_body
from residnet.core.layout import PLANAR, ROLL, SIX, VERTICAL, Live
from residnet.core.names import WIND_INPUTS, nearest, require_plain_name, si_of
from residnet.core.samples import Samples
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.hull import FossenConfig
from residnet.physics.symmetry import ChannelNames
from residnet.physics.vessel import load_vessel

WIND_CHANNELS = ("wind_u", "wind_v", "wind_mag")
FORCE_CHANNELS = ("tau_x", "tau_y", "tau_n")


class SignalsConfig(Config):
    """The inputs that drive a model.

    Attributes:
        inputs: command channels of the log, in order; held over a step.
        exogenous: channels that are not commanded; `wind_speed` and `wind_dir` (where the true wind
            comes FROM, earth-fixed) become the channels wind_u, wind_v, wind_mag: velocity of the
            air relative to the vessel in body axes.
        forces: a vessel (by name or file) whose thrusters turn the two inputs into tau_x, tau_y,
            tau_n; or the thrusters themselves.
        pairs: inputs to port and starboard that change places in the mirror, such as
            [[left, right]]; those that end in `_port` and `_stbd` are known without. Angles change
            their sign too.
        velocities: those of u, v and r that the logs tell and the model moves; the others are zero
            at all times. A model of surge alone has [u]. With p behind them the model rolls: logs
            need the roll angle phi, which is a state and a channel of it. [u, v, r, w, p, q] are
            all six degrees of freedom: logs need depth z, roll and pitch. Those of u, w and q are
            of a motion in an upright plane, as a float or a vehicle that only dives has: with w or
            q, and pitch where there is q.
    """

    inputs: tuple[str, ...]
    exogenous: tuple[str, ...] = ()
    forces: str | DifferentialThrustConfig | None = None
    pairs: tuple[tuple[str, str], ...] = ()
    velocities: tuple[Literal["u", "v", "r", "w", "p", "q"], ...] = Field(
        default=("u", "v", "r"), min_length=1
    )

    @model_validator(mode="after")
    def _combination(self) -> SignalsConfig:
        for name in self.inputs:
            require_plain_name(name)
        for name in self.exogenous:
            if name not in WIND_INPUTS:
                raise ValueError(
                    f"exogenous channel '{name}' is not understood{nearest(name, WIND_INPUTS)}"
                )
        if self.exogenous and set(self.exogenous) != set(WIND_INPUTS):
            raise ValueError(
                f"true wind needs both {' and '.join(WIND_INPUTS)}; given {list(self.exogenous)}"
            )
        if self.resolved().forces is not None and len(self.inputs) != 2:
            raise ValueError(
                f"forces are made by two thrusters, but inputs are {list(self.inputs)}"
            )
        if self.live.spatial:
            plane = tuple(name for name in VERTICAL if name in self.velocities)
            if self.velocities not in (SIX.velocities, plane):
                raise ValueError(
                    "velocities: heave and pitch go with surge alone (u, w, q and what of these"
                    " moves) or need all six, u, v, r, w, p, q, in this order; given"
                    f" {', '.join(self.velocities)}"
                )
            if self.exogenous or self.forces:
                raise ValueError(
                    "velocities: a model of six degrees of freedom knows neither wind nor forces"
                    " of two thrusters; leave exogenous and forces out"
                )
        elif list(self.velocities) != [n for n in ROLL.velocities if n in self.velocities]:
            raise ValueError(
                f"velocities are named once each, in the order u, v, r, p; given {self.velocities}"
            )
        if not self.live.spatial and not set(self.velocities) & set(PLANAR.velocities):
            raise ValueError("velocities: a model moves at least one of u, v, r; [p] has none")
        if self.exogenous and self.live.dead:
            raise ValueError(
                "exogenous: the loads of a wind need u, v and r and a heading; leave it out, or"
                " give logs with all of these"
            )
        repeated = {
            name for name in self.inputs if name in self.exogenous or self.inputs.count(name) > 1
        }
        if repeated:
            raise ValueError(f"inputs {sorted(repeated)} are named twice")
        paired = [name for pair in self.pairs for name in pair]
        for name in paired:
            if name not in self.inputs:
                raise ValueError(f"pairs: no input '{name}'{nearest(name, self.inputs)}")
            if paired.count(name) > 1:
                raise ValueError(f"pairs: '{name}' is named twice")
        computed = (
            self.live.states
            + (FORCE_CHANNELS if self.forces is not None else ())
            + (WIND_CHANNELS if self.exogenous else ())
        )
        if taken := [name for name in self.inputs if name in computed]:
            raise ValueError(
                f"input '{taken[0]}' is a channel that the model has or makes itself; leave it out"
                " or rename it in the channel map"
            )
        return self

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of w [B, m]: inputs, then exogenous channels."""
        return self.inputs + self.exogenous

    @property
    def live(self) -> Live:
        """The velocities that live."""
        return Live(self.velocities)

    def resolved(self) -> SignalsConfig:
        """Return the same config with the vessel's name replaced by its thrusters.

        A saved model then needs no vessel file.

        Raises:
            ValueError: where there is no such vessel.
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
                " (differential_thrust); leave forces out"
            )
        return self.model_copy(update={"forces": actuators})

    def units(self) -> dict[str, str]:
        """Return SI unit of each state and input."""
        return {name: si_of(name) or "-" for name in self.live.states + self.columns}

    def build(self) -> Signals:
        """Build the module that computes the channels."""
        return Signals(self.resolved())


class Signals(nn.Module):
    """The channels z [B, nz] from state x [B, nx] and inputs w [B, m].

    `names` holds the names of the columns of z.

    `prepare` does what depends on the inputs alone, once per step; `forward` does the rest at every
    stage of the integrator.
    """

    def __init__(self, config: SignalsConfig) -> None:
        super().__init__()
        self.inputs = len(config.inputs)
        self.wind = len(config.exogenous) > 0
        thrusters = config.forces if isinstance(config.forces, DifferentialThrustConfig) else None
        self.forces = thrusters is not None
        columns = config.columns
        self.speed_column = columns.index("wind_speed") if self.wind else 0
        self.direction_column = columns.index("wind_dir") if self.wind else 0
        self.thrusters: nn.Module = nn.Identity() if thrusters is None else thrusters.build().forces
        names = config.live.moving + config.inputs
        self.dof = config.live.size
        self.spatial = config.live.spatial
        seen = torch.tensor([name not in config.live.hidden for name in config.live.moving])
        self.seen = nn.Buffer(seen.double(), persistent=False)
        names += FORCE_CHANNELS if self.forces else ()
        names += WIND_CHANNELS if self.wind else ()
        self.names: tuple[str, ...] = ChannelNames(names, config.pairs, config.live)
        self.count = len(names)

    def prepare(self, w: Tensor) -> Tensor:
        """Return what a step holds fixed, [..., k], from inputs w [..., m].

        These are inputs, forces and the air's velocity over ground (north, east).
        """
        parts = [w[..., : self.inputs]]
        if self.forces:
            parts.append(self.thrusters(w[..., : self.inputs]))
        if self.wind:
            speed, direction = w[..., self.speed_column], w[..., self.direction_column]
            parts.append(
                torch.stack((-speed * torch.cos(direction), -speed * torch.sin(direction)), dim=-1)
            )
        # joining a single part would copy it
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)

    def forward(self, x: Tensor, p: Tensor) -> Tensor:
        """Return the channels z [..., nz].

        Args:
            x: state [..., nx] (pose, then what moves).
            p: what `prepare` returned for the step's inputs.
        """
        if self.spatial:
            # nothing depends on the depth
            return torch.cat((velocities(x, self.dof) * self.seen.to(x.dtype), p), dim=-1)
        if not self.wind:
            return torch.cat((velocities(x, self.dof), p), dim=-1)
        known = p.shape[-1] - 2
        along, across = to_body(p[..., known], p[..., known + 1], x[..., 2])
        along, across = along - x[..., 3], across - x[..., 4]
        # the offset keeps the gradient finite in a calm
        magnitude = torch.sqrt(along * along + across * across + 1e-8)
        return torch.cat(
            (
                velocities(x, self.dof),
                p[..., :known],
                torch.stack((along, across, magnitude), dim=-1),
            ),
            dim=-1,
        )


_STRONG = 10.0
"""Accelerations, in standard deviations, that are balanced half a range beyond the edge."""
_SLOWEST, _FASTEST = 0.05, 2.0
"""Limits of the rate in 1/s at which velocities are pulled back."""
_LEAST = 1e-9
"""Least width of a range, for channels that do not vary."""


@final
class VelocityBound(nn.Module):
    """An acceleration [..., n] that pulls velocities back which left their range, else zero.

    Beyond the range of the training data a fitted model knows nothing: with nothing to damp it,
    what it last said would drive the vessel on for ever.

    Args:
        margin: share of the training range by which it is widened on either side.
        channels: number of channels, the velocities first, that `held` keeps in their range: what
            an input does far beyond it is as little known.
    """

    def __init__(
        self, margin: float = 0.0, channels: int = PLANAR.dof, dof: int = PLANAR.dof
    ) -> None:
        super().__init__()
        self.margin = margin
        self.channels, self.dof = channels, dof
        self.low = nn.Buffer(torch.zeros(channels, dtype=torch.float64))
        self.high = nn.Buffer(torch.zeros(channels, dtype=torch.float64))
        self.rate = nn.Buffer(torch.zeros(dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Take the ranges of the channels, and the rate from the accelerations."""
        seen, target = samples.tally()
        low, high = seen.low[: self.channels], seen.high[: self.channels]
        wide = (high - low).clamp(min=_LEAST)
        self.low.copy_(low - self.margin * wide)
        self.high.copy_(high + self.margin * wide)
        spread = target.std()
        self.rate.copy_(
            (_STRONG * spread / (0.5 * wide[: self.dof])).clamp(min=_SLOWEST, max=_FASTEST)
        )

    def held(self, z: Tensor) -> Tensor:
        """Return channels z [..., nz], where those that left their range stand at its edge."""
        low, high = self.low.to(z.dtype), self.high.to(z.dtype)
        near = z[..., : self.channels]
        # a refit differentiates this, and derivatives of minimum and maximum are slow
        near = torch.where(near > high, high, torch.where(near < low, low, near))
        return torch.cat((near, z[..., self.channels :]), dim=-1)

    def back(self, held: Tensor, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz] whose held ones are known."""
        return self.rate.to(z.dtype) * (held[..., : self.dof] - z[..., : self.dof])

    def forward(self, z: Tensor) -> Tensor:
        """Return the acceleration at channels z [..., nz]."""
        return self.back(self.held(z), z)
