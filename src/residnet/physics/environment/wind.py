"""Wind on the hull above water: force coefficients, and forces in the relative wind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import Config, Metres, Radians
from residnet.physics.parameters import Density, SquareMetres

WIND_INPUTS = ("wind_speed", "wind_dir")
"""True wind as inputs of a plant: speed [m/s] and where it comes FROM [rad], earth-fixed."""


class WindLoads(nn.Module, ABC):
    """Forces of the air on a vessel, without dynamics of its own."""

    @abstractmethod
    def forward(self, along: Tensor, across: Tensor) -> Tensor:
        """Return X, Y [N], K, N [N m], stacked [..., 4], in a relative wind.

        Args:
            u: velocity of the air relative to the vessel along body x [...] in m/s.
            v: the same along body y [...] in m/s.
        """


class WindLoadConfig(Config, ABC):
    """The part of a vessel file that describes the hull above water.

    Attributes:
        frontal_area: projected frontal area in m^2.
        lateral_area: projected lateral area in m^2.
        length: overall, which the yaw coefficient refers to.
        centre_height: of the lateral area's centre above the body origin, for the heeling moment of
            vessels that roll.
        density: of the air.
        source: where the numbers come from.
        kind: kind of the coefficients.
    """

    kind: str
    frontal_area: SquareMetres = Field(gt=0)
    lateral_area: SquareMetres = Field(gt=0)
    length: Metres = Field(gt=0)
    centre_height: Metres = Field(default=0.0, ge=0)
    density: Density = Field(default=1.225, gt=0)
    source: str = Field(min_length=1)

    @abstractmethod
    def build(self) -> WindLoads:
        """Build the module that computes the wind forces."""


class SymmetricWindConfig(WindLoadConfig):
    """Wind coefficients of ships that are nearly symmetric fore and aft.

    C_X = -c_x cos gamma, C_Y = c_y sin gamma, C_N = c_n sin 2 gamma, with gamma the relative wind's
    angle; typically c_x is 0.5 to 0.9, c_y 0.7 to 0.95, c_n 0.05 to 0.2. All three are positive.

    Attributes:
        c_x: amplitude of the longitudinal force coefficient, dimensionless.
        c_y: amplitude of the lateral force coefficient.
        c_n: amplitude of the yaw moment coefficient.
    """

    kind: Literal["symmetric"] = "symmetric"
    c_x: float = Field(ge=0, le=2)
    c_y: float = Field(ge=0, le=2)
    c_n: float = Field(ge=0, le=1)

    def build(self) -> SymmetricWind:
        """Build the module that computes the wind forces."""
        return SymmetricWind(self)


@final
class SymmetricWind(WindLoads):
    """The three coefficients, written in the components of the relative air velocity.

    This needs no angle and is smooth in a calm.
    """

    def __init__(self, config: SymmetricWindConfig) -> None:
        super().__init__()
        dynamic = 0.5 * config.density
        self.x = dynamic * config.frontal_area * config.c_x
        self.y = dynamic * config.lateral_area * config.c_y
        self.n = -2.0 * dynamic * config.lateral_area * config.length * config.c_n
        self.height = config.centre_height

    def forward(self, along: Tensor, across: Tensor) -> Tensor:
        """Return the forces [..., 4]."""
        speed = torch.sqrt(along * along + across * across + 1e-12)
        side = self.y * across * speed
        return torch.stack(
            (self.x * along * speed, side, self.height * side, self.n * along * across), dim=-1
        )


class TabulatedWindConfig(WindLoadConfig):
    """Wind coefficients at angles of the relative wind, as wind tunnels give them.

    Isherwood (1972) and Blendermann (1994) publish such tables.

    `angle` runs from 0 (head wind) to 180 deg for wind from STARBOARD; port follows by symmetry.
    Signs are those of the body axes: C_X is negative in head wind, C_Y negative (towards port).
    Linear between the angles.

    Attributes:
        angle: angles of the relative wind in rad, from 0 to pi.
        C_X: longitudinal force coefficient at each angle, dimensionless.
        C_Y: lateral force coefficient at each angle.
        C_N: yaw moment coefficient at each angle.
    """

    kind: Literal["table"] = "table"
    angle: Annotated[tuple[Radians, ...], Field(min_length=3)]
    C_X: tuple[float, ...]
    C_Y: tuple[float, ...]
    C_N: tuple[float, ...]

    @model_validator(mode="after")
    def _table(self) -> TabulatedWindConfig:
        rising = all(a < b for a, b in zip(self.angle, self.angle[1:], strict=False))
        if not rising or self.angle[0] != 0 or abs(self.angle[-1] - torch.pi) > 1e-6:
            raise ValueError("angle must rise from 0 deg (head wind) to 180 deg (following wind)")
        for name, values in (("C_X", self.C_X), ("C_Y", self.C_Y), ("C_N", self.C_N)):
            if len(values) != len(self.angle):
                raise ValueError(f"{name} has {len(values)} values for {len(self.angle)} angles")
        if max(self.C_Y) > 0:
            raise ValueError(
                "C_Y must not be positive: wind from starboard pushes to port (body y points to"
                " starboard)"
            )
        if self.C_X[0] > 0:
            raise ValueError(
                "C_X must not be positive in head wind: it pushes aft (body x points forward)"
            )
        if any(abs(values[i]) > 1e-9 for values in (self.C_Y, self.C_N) for i in (0, -1)):
            raise ValueError(
                "C_Y and C_N must be zero at 0 and 180 deg: port and starboard mirror each other"
            )
        return self

    def build(self) -> TabulatedWind:
        """Build the module that computes the wind forces."""
        return TabulatedWind(self)


@final
class TabulatedWind(WindLoads):
    """Coefficients by linear interpolation over the angle of the relative wind."""

    def __init__(self, config: TabulatedWindConfig) -> None:
        super().__init__()
        dynamic = 0.5 * config.density
        areas = torch.tensor(
            [config.frontal_area, config.lateral_area, config.lateral_area * config.length],
            dtype=torch.float64,
        )
        values = (
            torch.tensor([config.C_X, config.C_Y, config.C_N], dtype=torch.float64).T
            * areas
            * dynamic
        )
        self.register_buffer(
            "angle", torch.tensor(config.angle, dtype=torch.float64), persistent=False
        )
        self.register_buffer("values", values, persistent=False)
        self.height = config.centre_height
        self.angle: Tensor
        self.values: Tensor

    def forward(self, along: Tensor, across: Tensor) -> Tensor:
        """Return the forces [..., 4]."""
        square = along * along + across * across
        calm = square < 1e-12
        # the angle of a calm is any; a fixed one keeps the gradient finite
        ahead = torch.where(calm, torch.ones_like(along), -along)
        angle = torch.atan2(-across, ahead)
        turn = self.angle.to(angle.dtype)
        upper = torch.searchsorted(turn, angle.abs().detach().contiguous(), right=True).clamp(
            1, turn.shape[0] - 1
        )
        share = ((angle.abs() - turn[upper - 1]) / (turn[upper] - turn[upper - 1])).unsqueeze(-1)
        table = self.values.to(angle.dtype)
        force = (table[upper - 1] * (1.0 - share) + table[upper] * share) * square.unsqueeze(-1)
        side = torch.where(angle < 0, -torch.ones_like(angle), torch.ones_like(angle))
        y = side * force[..., 1]
        return torch.stack((force[..., 0], y, self.height * y, side * force[..., 2]), dim=-1)


WindLoadsConfig = Annotated[SymmetricWindConfig | TabulatedWindConfig, Field(discriminator="kind")]
"""The optional section `wind` of a vessel file."""
