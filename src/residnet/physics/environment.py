"""Wind loads and waves: spectra, irregular waves as a sum of sines, and forces on a box.

Waves follow Gouletas 2020, eqs. (5.30)-(5.34).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.physics.parameters import GRAVITY

if TYPE_CHECKING:
    from residnet.physics.environment_config import WavesConfig


@final
class IrregularWaves(nn.Module):
    """Irregular deep-water waves as a sum of N x M sines, and their force on the hull.

    Each row is a realisation. Frequencies and directions are drawn within their intervals (5.34)
    and also replace the centres of the intervals in (5.30), so that the waves are not periodic.
    Each component has a random phase; one phase per frequency as in (5.32) would make a
    short-crested sea inhomogeneous. Amplitudes (5.33) are normalised to the exact m0. The phase
    omega t - k . (x, y) depends on the position of the vessel, which yields the encounter frequency
    (5.31) at any speed and course. The response H_i is the Froude-Krylov force of a box, from the
    pressure of the undisturbed wave on its walls and bottom; diffraction is neglected. With a
    table of first-order loads, H_i is the value of the table, which includes diffraction.
    Radiation and drift forces are neglected.
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
        self.rao_coefficients: tuple[Tensor, ...] = ()
        if config.hull is not None:
            self.length = config.hull.length
            self.breadth = config.hull.breadth
            self.draught = config.hull.draught
        if config.force_rao is not None:
            table = config.load_force_rao(config.force_rao)
            cosine, sine = table.fourier_coefficients(self.omega.numpy())
            # the load Re(H a exp(i phase)) has the factors Re(H) of cos and -Im(H) of sin
            self.rao_coefficients = tuple(
                torch.from_numpy(np.ascontiguousarray(part))
                for part in (cosine.real, sine.real, -cosine.imag, -sine.imag)
            )

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

    def table_response(self, psi: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loads per wave amplitude from the table, factors of cos and sin [B, K, 4].

        Args:
            psi: heading [B] in rad.
        """
        cosine_in_phase, sine_in_phase, cosine_quadrature, sine_quadrature = self.rao_coefficients
        orders = torch.arange(cosine_in_phase.shape[-1], dtype=psi.dtype)
        angles = ((self.direction - psi.unsqueeze(-1)).unsqueeze(-1) * orders).unsqueeze(-2)
        cosine = torch.cos(angles)
        sine = torch.sin(angles)
        return (
            (cosine_in_phase * cosine + sine_in_phase * sine).sum(-1),
            (cosine_quadrature * cosine + sine_quadrature * sine).sum(-1),
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
        if self.rao_coefficients:
            cosine_amplitude = (self.amplitude * torch.cos(phase)).unsqueeze(-1)
            sine_amplitude = (self.amplitude * torch.sin(phase)).unsqueeze(-1)
            in_phase, in_quadrature = self.table_response(psi)
            return (in_phase * cosine_amplitude + in_quadrature * sine_amplitude).sum(-2)
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
