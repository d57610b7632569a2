"""Configuration of wind loads and waves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, ExistingPath, Metres, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.physics.force_rao import ForceRao, read_wamit_excitation
from residnet.physics.parameters import GRAVITY, Density, SquareMetres

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.physics.environment import IrregularWaves

_MAX_UNRESOLVED_SHARE = 0.05
"""Largest share of the wave loads in the two highest orders of the directions of a table.

The error between the directions is .2 to 2 times this share for a box in directions of 5 to 30 deg.
"""


class WindLoadConfig(Config, ABC):
    """Wind loads of a vessel.

    Attributes:
        frontal_area: projected frontal area in m^2.
        lateral_area: projected lateral area in m^2.
        length: length overall, the reference length of the yaw coefficient.
        centre_height: height of the centre of the lateral area above the body origin, for the
            heeling moment of vessels with roll.
        density: density of the air.
        source: reference of the coefficients.
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
    def wind_forces(self, relative_x: Tensor, relative_y: Tensor) -> Tensor:
        """Compute the wind loads X, Y [N], K, N [N m], stacked [..., 4].

        Args:
            relative_x: velocity of the air relative to the vessel along body x [...] in m/s.
            relative_y: velocity of the air relative to the vessel along body y [...] in m/s.
        """


@final
class SymmetricWindConfig(WindLoadConfig):
    """Wind coefficients of vessels that are nearly symmetric fore and aft.

    C_X = -c_x cos gamma, C_Y = c_y sin gamma, C_N = c_n sin 2 gamma with the relative wind angle
    gamma. Typical values are c_x 0.5 to 0.9, c_y 0.7 to 0.95 and c_n 0.05 to 0.2.

    Attributes:
        c_x: amplitude of the longitudinal force coefficient, dimensionless.
        c_y: amplitude of the lateral force coefficient.
        c_n: amplitude of the yaw moment coefficient.
    """

    kind: Literal["symmetric"] = "symmetric"
    c_x: float = Field(ge=0, le=2)
    c_y: float = Field(ge=0, le=2)
    c_n: float = Field(ge=0, le=1)

    def wind_forces(self, relative_x: Tensor, relative_y: Tensor) -> Tensor:
        """Compute the loads [..., 4] without an arctangent, which is not smooth at zero wind."""
        import torch

        frontal_factor = 0.5 * self.density * self.frontal_area
        lateral_factor = 0.5 * self.density * self.lateral_area
        speed = torch.sqrt(relative_x * relative_x + relative_y * relative_y + 1e-12)
        y = lateral_factor * self.c_y * relative_y * speed
        # C_N sin 2 gamma times the squared speed: sin gamma cos gamma is the product of both
        # components
        n = -2.0 * lateral_factor * self.length * self.c_n * relative_x * relative_y
        x = frontal_factor * self.c_x * relative_x * speed
        return torch.stack((x, y, self.centre_height * y, n), dim=-1)


@final
class TabulatedWindConfig(WindLoadConfig):
    """Table of wind coefficients over the relative wind angle, such as from a wind tunnel.

    Isherwood (1972) and Blendermann (1994) publish such tables. `angle` increases from 0 (head
    wind) to 180 deg for wind from STARBOARD; wind from port follows by symmetry. Signs are those of
    the body axes: C_X is negative in head wind, and C_Y is negative (to port). Interpolation is
    linear.

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
    def _validate_table(self) -> TabulatedWindConfig:
        import torch

        is_increasing = all(a < b for a, b in zip(self.angle, self.angle[1:], strict=False))
        if not is_increasing or self.angle[0] != 0 or abs(self.angle[-1] - torch.pi) > 1e-6:
            raise ValueError("angle must rise from 0 deg (head wind) to 180 deg (following wind)")
        for name, values in (("C_X", self.C_X), ("C_Y", self.C_Y), ("C_N", self.C_N)):
            if len(values) != len(self.angle):
                raise ValueError(f"{name} has {len(values)} values for {len(self.angle)} angles")
        if max(self.C_Y) > 0:
            raise ValueError(
                "C_Y must not be positive: wind from starboard acts to port (body y points"
                " to starboard)"
            )
        if self.C_X[0] > 0:
            raise ValueError(
                "C_X must not be positive in head wind: the force is aft (body x points forward)"
            )
        if any(abs(values[i]) > 1e-9 for values in (self.C_Y, self.C_N) for i in (0, -1)):
            raise ValueError("C_Y and C_N must be zero at 0 and 180 deg by symmetry")
        return self

    @cached_property
    def forces_by_angle(self) -> tuple[Tensor, Tensor]:
        """Angles [A] and loads X, Y, N per squared speed [A, 3], float64."""
        import torch

        reference_areas = [self.frontal_area, self.lateral_area, self.lateral_area * self.length]
        coefficients = torch.tensor([self.C_X, self.C_Y, self.C_N], dtype=torch.float64).T
        areas = torch.tensor(reference_areas, dtype=torch.float64)
        angle = torch.tensor(self.angle, dtype=torch.float64)
        return angle, coefficients * areas * (0.5 * self.density)

    def wind_forces(self, relative_x: Tensor, relative_y: Tensor) -> Tensor:
        """Compute the loads [..., 4] by linear interpolation over the angle."""
        import torch

        table_angles, table_forces = (
            values.to(relative_x.dtype) for values in self.forces_by_angle
        )
        speed_squared = relative_x * relative_x + relative_y * relative_y
        # in a calm the angle is undefined; a fixed one keeps the gradient of atan2 finite
        head_wind = torch.where(speed_squared < 1e-12, torch.ones_like(relative_x), -relative_x)
        angle = torch.atan2(-relative_y, head_wind)
        upper_index = torch.searchsorted(
            # the index has no gradient; the interpolation within the interval has
            table_angles,
            angle.abs().detach().contiguous(),
            right=True,
        ).clamp(1, table_angles.shape[0] - 1)
        fraction = (
            (angle.abs() - table_angles[upper_index - 1])
            / (table_angles[upper_index] - table_angles[upper_index - 1])
        ).unsqueeze(-1)
        force = (
            table_forces[upper_index - 1] * (1.0 - fraction) + table_forces[upper_index] * fraction
        ) * speed_squared.unsqueeze(-1)
        # the table is for wind from starboard; wind from port mirrors Y, K and N
        side_sign = torch.where(angle < 0, -torch.ones_like(angle), torch.ones_like(angle))
        y = side_sign * force[..., 1]
        return torch.stack(
            (force[..., 0], y, self.centre_height * y, side_sign * force[..., 2]), dim=-1
        )


WindLoadsConfig = Annotated[SymmetricWindConfig | TabulatedWindConfig, Field(discriminator="kind")]
"""Optional section `wind` of a vessel file."""


class JonswapSpectrumConfig(Config):
    """JONSWAP spectrum of a fetch-limited sea (Hasselmann et al. 1973).

    It is the ITTC form with peak enhancement gamma, normalised to the significant wave height. With
    gamma = 1 it is the modified Pierson-Moskowitz spectrum of a fully developed sea (ITTC 1978).

    Attributes:
        kind: kind of the spectrum.
        gamma: peak enhancement factor, dimensionless.
    """

    kind: Literal["jonswap"] = "jonswap"
    gamma: float = Field(default=3.3, ge=1, le=7)

    def spectral_density(self, omega: np.ndarray, height: float, period: float) -> np.ndarray:
        """Return S(omega) [m^2 s] at omega [rad/s] without the normalisation of its area.

        Args:
            omega: frequencies in rad/s, any shape.
            height: significant wave height in m, 4 sqrt(m0).
            period: peak period in s.
        """
        peak_frequency = 2 * np.pi / period
        frequency_ratio = omega / peak_frequency
        pierson_moskowitz = (
            5
            / 16
            * height**2
            / peak_frequency
            * frequency_ratio**-5.0
            * np.exp(-1.25 * frequency_ratio**-4.0)
        )
        # sigma of the JONSWAP peak: narrower below the peak than above it
        peak_width = np.where(frequency_ratio <= 1, 0.07, 0.09)
        peak_enhancement = self.gamma ** np.exp(-((frequency_ratio - 1) ** 2) / (2 * peak_width**2))
        return np.asarray(pierson_moskowitz * peak_enhancement)


class HullBoxConfig(Config):
    """Box approximation of the underwater hull for wave forces.

    Attributes:
        length: length of the box in m.
        breadth: breadth of the box in m.
        draught: draught of the box in m.
    """

    length: Metres = Field(gt=0)
    breadth: Metres = Field(gt=0)
    draught: Metres = Field(gt=0)


class ForceRaoConfig(Config):
    """First-order wave loads from a WAMIT file, see `residnet.physics.force_rao`.

    The origin of WAMIT's axes is the body origin, at the waterline amidships. The table is for a
    hull at rest; speed changes the frequency of encounter only.

    Attributes:
        file: WAMIT file .2 (Haskind) or .3 (diffraction), with the columns PER in s, BETA in deg,
            I, MOD, PHA in deg, RE and IM; dimensionless by rho g L^2 (forces) and rho g L^3
            (moments).
        unit_length: length L of the table, ULEN in WAMIT's geometry file.
    """

    file: ExistingPath
    unit_length: Metres = Field(gt=0)


class WavesConfig(Config):
    """Irregular waves and the hull on which they act.

    Attributes:
        spectrum: wave spectrum.
        significant_height: significant wave height, 4 sqrt(m0).
        peak_period: peak period, 2 pi / omega_p.
        direction: direction TO which the waves travel, clockwise from north (Gouletas 2020, section
            5.2.2.4); 0 deg are following seas on a northerly course.
        hull: box whose Froude-Krylov loads are computed; null with `force_rao`.
        force_rao: table of the wave loads from WAMIT; null with `hull`.
        frequencies: number N of frequency intervals between 0.5 and 4 omega_p.
        directions: number M of direction intervals; 1 for long-crested waves, otherwise cos^2
            spreading over +-90 deg.
        water_density: density of the water.
    """

    spectrum: JonswapSpectrumConfig = JonswapSpectrumConfig()
    significant_height: Metres = Field(gt=0)
    peak_period: Seconds = Field(gt=0)
    direction: Radians
    hull: HullBoxConfig | None = None
    force_rao: ForceRaoConfig | None = None
    frequencies: int = Field(default=60, ge=10, le=2000)
    directions: int = Field(default=1, ge=1, le=72)
    water_density: Density = Field(default=1025.0, gt=0)

    @model_validator(mode="after")
    def _require_one_hull(self) -> WavesConfig:
        if (self.hull is None) == (self.force_rao is None):
            raise ValueError("expected either hull (a box) or force_rao (a table of WAMIT)")
        return self

    def load_force_rao(self, config: ForceRaoConfig) -> ForceRao:
        """Read the table of wave loads.

        Raises:
            ConfigError: if the file is invalid, does not cover the energetic frequencies, or does
                not resolve the dependence on the direction.
        """
        table = read_wamit_excitation(config.file, config.unit_length, self.water_density * GRAVITY)
        longest_period = self.peak_period / 0.7
        shortest_period = self.peak_period / 2.0
        table_periods = 2.0 * np.pi / table.omega
        if table_periods[0] < longest_period or table_periods[-1] > shortest_period:
            raise ConfigError(
                f"{config.file}: periods {table_periods[-1]:.3g} to {table_periods[0]:.3g} s;"
                f" expected {shortest_period:.3g} to {longest_period:.3g} s for a peak period of"
                f" {self.peak_period:.3g} s; extend the table or change the peak period"
            )
        omega = np.linspace(0.5, 4.0, 200) * 2.0 * np.pi / self.peak_period
        density = self.spectrum.spectral_density(omega, self.significant_height, self.peak_period)
        share = table.unresolved_share(omega, density)
        if share > _MAX_UNRESOLVED_SHARE:
            step_deg = 360.0 / table.response.shape[1]
            raise ConfigError(
                f"{config.file}: wave directions in steps of {step_deg:.3g} deg do not resolve the"
                f" loads at a peak period of {self.peak_period:.3g} s: the two highest orders of"
                f" their Fourier series hold {share:.0%} of the load, expected at most"
                f" {_MAX_UNRESOLVED_SHARE:.0%}; compute directions in steps of {step_deg / 2:.3g}"
                " deg"
            )
        return table

    def build(self, n_rows: int, random: np.random.Generator) -> IrregularWaves:
        """Build independent realisations of the waves, one per row."""
        from residnet.physics.environment import IrregularWaves

        return IrregularWaves(self, n_rows, random)
