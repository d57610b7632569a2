"""Azimuth thrusters: forces from revolutions and angles, and thrust allocation.

Source: document 002 eqs. (5.1), (5.2).
"""

from __future__ import annotations

from typing import Annotated, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Config, Metres, Radians, RadiansPerSecond, RevRate, RevsPerSecond
from residnet.physics.actuators.base import ActuatorConfig, ForceActuators
from residnet.physics.actuators.servo import Servo, ServoConfig, Servos
from residnet.physics.actuators.thrust_curve import CurveRange, require_range

_TABLE = 401
"""Points of the thrust curve from which its inverse starts; between them it is known to rise."""
_NEWTON_STEPS = 4
"""Steps of Newton's method; each doubles the digits that a line between two points has."""


class PropellerShaftConfig(ServoConfig):
    """A propeller shaft that turns in either direction.

    Attributes:
        n_max: largest revolutions of either direction in 1/s.
        n_rate: largest change of revolutions in 1/s^2; None for at once.
    """

    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate | None = Field(default=None, gt=0)


class AzimuthConfig(ServoConfig):
    """The drive that turns a thruster to either side of the bow, not through its limit.

    Attributes:
        limit: largest angle from the bow in rad.
        rate: largest rate of turn in rad/s; None for at once.
    """

    limit: Radians = Field(default=3.141592653589793, gt=0)
    rate: RadiansPerSecond | None = Field(default=None, gt=0)


class PlaceConfig(Config):
    """The name and place of one thruster.

    Attributes:
        name: what ends the names of its channels.
        x: distance forward of the body origin in m.
        y: distance to starboard of the body origin in m.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]*$")
    x: Metres
    y: Metres = 0.0


class AzimuthThrustersConfig(ActuatorConfig):
    """Equal thrusters that turn, commanded by revolutions and angles.

    The commands are cmd_n_<name> [1/s], then cmd_alpha_<name> [rad] from the bow, clockwise.

    Attributes:
        places: of the thrusters.
        thrust: coefficients c0, c1, ... of the force T = c0 + c1 n + c2 n^2 + ... in N, n in 1/s.
        curve_range: revolutions (astern, ahead) that the curve was measured between; it must rise
            between +-n_max.
        shaft: limits of the revolutions.
        azimuth: limits of the angles.
    """

    kind: Literal["azimuth_thrusters"]
    places: Annotated[tuple[PlaceConfig, ...], Field(min_length=1)]
    thrust: Annotated[tuple[float, ...], Field(min_length=2)]
    curve_range: CurveRange | None = None
    shaft: PropellerShaftConfig
    azimuth: AzimuthConfig = AzimuthConfig()

    @property
    def n_max(self) -> float:
        """Largest revolutions of either direction in 1/s."""
        return self.shaft.n_max

    @model_validator(mode="after")
    def _consistent(self) -> AzimuthThrustersConfig:
        names = [place.name for place in self.places]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two thrusters are named '{repeated[0]}'")
        require_range(self)
        n = np.linspace(-self.n_max, self.n_max, _TABLE)
        falling = n[np.polynomial.Polynomial(self.thrust).deriv()(n) <= 0]
        if len(falling):
            raise ValueError(
                f"thrust falls with the revolutions at {falling[0] * 60:.0f} rpm: a force has no"
                " one speed there; lower n_max"
            )
        if len(self.places) == 1 or len({(place.x, place.y) for place in self.places}) == 1:
            raise ValueError(
                "thrusters at one place cannot make surge, sway and yaw independently; give two"
                " places"
            )
        return self

    def build(self) -> AzimuthThrusters:
        """Build the module that turns commands into forces."""
        return AzimuthThrusters(self)


@final
class AzimuthThrusters(ForceActuators):
    """Revolutions and angles of k thrusters -> tau [..., 3]."""

    def __init__(self, config: AzimuthThrustersConfig) -> None:
        super().__init__()
        names = [place.name for place in config.places]
        self.count = len(names)
        shaft, azimuth = config.shaft, config.azimuth
        servos: list[Servo] = [
            shaft.follow(f"n_{name}", shaft.n_max, shaft.n_rate) for name in names
        ]
        servos += [azimuth.follow(f"alpha_{name}", azimuth.limit, azimuth.rate) for name in names]
        self.servos = Servos(servos)
        self.state = self.servos.state
        self.commands = (
            *(f"cmd_n_{name}" for name in names),
            *(f"cmd_alpha_{name}" for name in names),
        )
        self.n_max = shaft.n_max
        self.coefficients = list(config.thrust)
        # tau = map [3, 2k] of the components forward, then to starboard, of every thruster
        ones, zeros = [1.0] * self.count, [0.0] * self.count
        rows = [
            ones + zeros,
            zeros + ones,
            [-place.y for place in config.places] + [place.x for place in config.places],
        ]
        self.register_buffer("map", torch.tensor(rows, dtype=torch.float64), persistent=False)
        self.map: Tensor
        self.register_buffer("share", torch.linalg.pinv(self.map), persistent=False)
        self.share: Tensor
        grid = torch.linspace(-self.n_max, self.n_max, _TABLE, dtype=torch.float64)
        self.register_buffer("table", torch.stack((grid, self.thrust(grid))), persistent=False)
        self.table: Tensor
        self.strongest = float(self.thrust(torch.tensor(self.n_max, dtype=torch.float64)))

    def thrust(self, n: Tensor) -> Tensor:
        """Return the force [N] of one thruster along its axis at revolutions n [1/s], any shape.

        Source: document 002 eq. (5.1).
        """
        out = torch.full_like(n, self.coefficients[-1])
        for c in self.coefficients[-2::-1]:
            out = c + n * out
        return out

    def revolutions(self, force: Tensor) -> Tensor:
        """Return the revolutions n [1/s] within +-n_max that make a force [N], any shape.

        Without gradient.
        """
        # Newton's method from a table of the curve, which rises, within the table's interval
        table = self.table.to(force.dtype)
        after = torch.searchsorted(table[1].contiguous(), force.contiguous())
        after = after.clamp(1, table.shape[1] - 1)
        low, high = table[0][after - 1], table[0][after]
        share = (force - table[1][after - 1]) / (table[1][after] - table[1][after - 1])
        n = low + share.clamp(0.0, 1.0) * (high - low)
        for _ in range(_NEWTON_STEPS):
            slope = torch.full_like(n, (len(self.coefficients) - 1) * self.coefficients[-1])
            for power in range(len(self.coefficients) - 2, 0, -1):
                slope = power * self.coefficients[power] + n * slope
            n = torch.minimum(torch.maximum(n - (self.thrust(n) - force) / slope, low), high)
        return n

    def allocate(self, tau: Tensor) -> Tensor:
        """Return the commands [..., 2k] that make forces tau [..., 3] with the least thrust.

        The sum of squared thrusts is smallest; thrusts beyond the largest saturate.
        """
        parts = tau @ self.share.to(tau.dtype).T
        return self._commands(parts[..., : self.count], parts[..., self.count :])

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2k] for drive and steer, each within +-1.

        Drive is surge force and steer the yaw moment, as shares of what the thrusters make
        together; each thruster saturates.
        """
        zero = torch.zeros_like(drive)
        lever = self.map[2].abs().sum() / 2.0
        both = torch.stack(
            (drive.clamp(-1, 1) * self.count, zero, steer.clamp(-1, 1) * lever.to(drive.dtype)),
            dim=-1,
        )
        return self.allocate(both * self.strongest)

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] in N, N, N m (5.2)."""
        return self._together(self.servos.value(a, command))

    def asked(self, command: Tensor) -> Tensor:
        """Return the forces tau [..., 3] that revolutions and angles [..., 2k] ask for (5.2)."""
        return self._together(command)

    def _together(self, state: Tensor) -> Tensor:
        """Return tau [..., 3] of revolutions and angles [..., 2k]."""
        thrust, angle = self.thrust(state[..., : self.count]), state[..., self.count :]
        parts = torch.cat((thrust * torch.cos(angle), thrust * torch.sin(angle)), dim=-1)
        return parts @ self.map.to(parts.dtype).T

    def rate(self, a: Tensor, command: Tensor) -> Tensor:
        """Return the derivative [..., k] of the states."""
        return self.servos.rate(a, command)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the states [..., k] after a step of dt seconds."""
        return self.servos.advance(a, command, dt)

    def _commands(self, along: Tensor, across: Tensor) -> Tensor:
        """Return the revolutions and angles from components [..., k]."""
        size = torch.hypot(along, across)
        angle = torch.where(size > 0, torch.atan2(across, along), torch.zeros_like(size))
        return torch.cat((self.revolutions(size.clamp(max=self.strongest)), angle), dim=-1)
