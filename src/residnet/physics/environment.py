"""Wind loads and waves: spectra, irregular waves as a sum of sines, and forces on a box.

Waves follow document 004 eqs. (5.30)-(5.34).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Annotated, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.core.config import Config, Metres, Radians, Seconds
from residnet.physics.parameters import Density, SquareMetres


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
        reference_areas = [self.frontal_area, self.lateral_area, self.lateral_area * self.length]
        coefficients = torch.tensor([self.C_X, self.C_Y, self.C_N], dtype=torch.float64).T
        areas = torch.tensor(reference_areas, dtype=torch.float64)
        angle = torch.tensor(self.angle, dtype=torch.float64)
        return angle, coefficients * areas * (0.5 * self.density)

    def wind_forces(self, relative_x: Tensor, relative_y: Tensor) -> Tensor:
        """Compute the loads [..., 4] by linear interpolation over the angle."""
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


GRAVITY = 9.81
"""Acceleration of gravity in m/s^2."""


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


class WavesConfig(Config):
    """Irregular waves and the hull on which they act.

    Attributes:
        spectrum: wave spectrum.
        significant_height: significant wave height, 4 sqrt(m0).
        peak_period: peak period, 2 pi / omega_p.
        direction: direction TO which the waves travel, clockwise from north (document 004 section
            5.2.2.4); 0 deg are following seas on a northerly course.
        hull: dimensions of the underwater hull.
        frequencies: number N of frequency intervals between 0.5 and 4 omega_p.
        directions: number M of direction intervals; 1 for long-crested waves, otherwise cos^2
            spreading over +-90 deg.
        water_density: density of the water.
    """

    spectrum: JonswapSpectrumConfig = JonswapSpectrumConfig()
    significant_height: Metres = Field(gt=0)
    peak_period: Seconds = Field(gt=0)
    direction: Radians
    hull: HullBoxConfig
    frequencies: int = Field(default=60, ge=10, le=2000)
    directions: int = Field(default=1, ge=1, le=72)
    water_density: Density = Field(default=1025.0, gt=0)

    def build(self, n_rows: int, random: np.random.Generator) -> IrregularWaves:
        """Build independent realisations of the waves, one per row."""
        return IrregularWaves(self, n_rows, random)


@final
class IrregularWaves(nn.Module):
    """Irregular deep-water waves as a sum of N x M sines, and their force on the hull.

    Each row is a realisation. Frequencies and directions are drawn within their intervals (5.34)
    and also replace the centres of the intervals in (5.30), so that the waves are not periodic.
    Each component has a random phase; one phase per frequency as in (5.32) would make a
    short-crested sea inhomogeneous. Amplitudes (5.33) are normalised to the exact m0. The phase
    omega t - k . (x, y) depends on the position of the vessel, which yields the encounter frequency
    (5.31) at any speed and course. The response H_i is the Froude-Krylov force of a box, from the
    pressure of the undisturbed wave on its walls and bottom. Diffraction, radiation and drift
    forces are neglected.
    """

    def __init__(self, config: WavesConfig, n_rows: int, random: np.random.Generator) -> None:
        super().__init__()
        n_frequencies = config.frequencies
        n_directions = config.directions
        peak_frequency = 2 * np.pi / config.peak_period
        frequency_edges = np.linspace(0.5, 4.0, n_frequencies + 1) * peak_frequency
        omega = frequency_edges[:-1, None] + np.diff(frequency_edges)[:, None] * random.random(
            (n_rows, n_frequencies, n_directions)
        )
        # spreading is cos^2 about the mean direction, zero beyond +-90 deg
        direction_edges = np.linspace(-np.pi / 2, np.pi / 2, n_directions + 1)
        direction_offset = (
            direction_edges[:-1]
            + np.diff(direction_edges) * random.random((n_rows, n_frequencies, n_directions))
            if n_directions > 1
            else np.zeros((n_rows, n_frequencies, n_directions))
        )
        energy = (
            config.spectrum.spectral_density(omega, config.significant_height, config.peak_period)
            * np.cos(direction_offset) ** 2
        )
        # m0 = H_s^2 / 16; the sum over finitely many components would otherwise miss it by the
        # tails
        energy *= config.significant_height**2 / 16 / energy.sum(axis=(1, 2), keepdims=True)
        phase = 2 * np.pi * random.random((n_rows, n_frequencies, n_directions))
        components = [
            torch.from_numpy(values.reshape(n_rows, n_frequencies * n_directions))
            for values in (omega, config.direction + direction_offset, np.sqrt(2 * energy), phase)
        ]
        self.omega, self.direction, self.amplitude, self.phase = components
        # dispersion relation in deep water
        self.wave_number = self.omega**2 / GRAVITY
        self.specific_weight = config.water_density * GRAVITY
        self.length = config.hull.length
        self.breadth = config.hull.breadth
        self.draught = config.hull.draught

    def component_phases(self, north: Tensor, east: Tensor, t: float) -> Tensor:
        """Return the phase [B, K] in rad of every component at a position and time.

        Args:
            north: position north [B] in m.
            east: position east [B] in m.
            t: time in s.
        """
        distance = north.unsqueeze(-1) * torch.cos(self.direction) + east.unsqueeze(-1) * torch.sin(
            self.direction
        )
        return self.omega * t - self.wave_number * distance + self.phase

    def force_response(self, psi: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forces per wave amplitude: X, Y, K [B, K, 3] and N [B, K].

        X, Y and K are in quadrature with the wave (factors of sin), and N is in phase (factor of
        cos). Units are N/m and N m/m; K is about the waterline and N about midship. The angle
        chi = direction - psi is 0 in following seas.
        """
        chi = self.direction - psi.unsqueeze(-1)
        cos_chi = torch.cos(chi)
        sin_chi = torch.sin(chi)
        wave_number = self.wave_number
        length = self.length
        breadth = self.breadth
        bottom_decay = torch.exp(-wave_number * self.draught)
        # torch.sinc is sin(pi x) / (pi x)
        sinc_length = torch.sinc(0.5 * wave_number * cos_chi * length / torch.pi)
        sinc_breadth = torch.sinc(0.5 * wave_number * sin_chi * breadth / torch.pi)
        # the wave pressure decays with exp(-k z); integrated over the draught it gives 1 - exp(-k
        # T)
        pressure = self.specific_weight * (1.0 - bottom_decay)
        area_factor = length * breadth * sinc_length * sinc_breadth
        moment_x = _sine_first_moment(wave_number * cos_chi, length)
        moment_y = _sine_first_moment(wave_number * sin_chi, breadth)
        # first moment of the pressure about the waterline, for the roll moment of the side walls
        pressure_arm = (1.0 - bottom_decay * (1.0 + wave_number * self.draught)) / wave_number
        roll_response = self.specific_weight * (
            sin_chi * pressure_arm * area_factor - bottom_decay * length * sinc_length * moment_y
        )
        quadrature = torch.stack(
            (-pressure * cos_chi * area_factor, -pressure * sin_chi * area_factor, roll_response),
            dim=-1,
        )
        return quadrature, pressure * (
            sin_chi * breadth * sinc_breadth * moment_x - cos_chi * length * sinc_length * moment_y
        )

    def forward(self, north: Tensor, east: Tensor, psi: Tensor, t: float) -> Tensor:
        """Compute the wave loads X, Y [N], K, N [N m], stacked [B, 4], at a position and time.

        Args:
            north: position north [B] in m.
            east: position east [B] in m.
            psi: heading [B] in rad.
            t: time in s.
        """
        phase = self.component_phases(north, east, t)
        quadrature, yaw = self.force_response(psi)
        in_quadrature = (quadrature * (self.amplitude * torch.sin(phase)).unsqueeze(-1)).sum(-2)
        yaw_moment = (yaw * self.amplitude * torch.cos(phase)).sum(-1, keepdim=True)
        return torch.cat((in_quadrature, yaw_moment), dim=-1)


def _sine_first_moment(kappa: Tensor, width: float) -> Tensor:
    """Return the integral of x sin(kappa x) over +-width / 2.

    Near zero a series replaces the closed form, which suffers from cancellation.
    """
    half_width = 0.5 * width
    # the replaced argument also keeps the gradient of the branch that is not used finite
    is_small = kappa.abs() * half_width < 1e-2
    safe_kappa = torch.where(is_small, torch.ones_like(kappa), kappa)
    closed_form = (
        2.0
        * (
            torch.sin(safe_kappa * half_width) / safe_kappa
            - half_width * torch.cos(safe_kappa * half_width)
        )
        / safe_kappa
    )
    series = 2.0 * kappa * half_width**3 / 3.0 * (1.0 - (kappa * half_width) ** 2 / 10.0)
    return torch.where(is_small, series, closed_form)
