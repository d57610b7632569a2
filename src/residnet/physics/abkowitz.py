"""Abkowitz models: Taylor series of the forces about straight motion at service speed.

A vessel file contains all hydrodynamic derivatives (Abkowitz 1964).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.physics.actuators.base import ActuatorSystem, commands_from_demand
from residnet.physics.term_library import TermLibrary

if TYPE_CHECKING:
    from residnet.physics.abkowitz_config import AbkowitzConfig


@final
class AbkowitzForces(ActuatorSystem):
    """Forces tau [..., 3] in N, N, N m of the series, of rudder, propeller and motion."""

    def __init__(self, config: AbkowitzConfig) -> None:
        super().__init__(*config.servo_specs())
        self.command_specs = config.command_specs()
        shaft = config.shaft
        self.has_shaft = shaft is not None
        self.n_0 = shaft.n_0 if shaft is not None else 1.0
        self.command_names = tuple(command.name for command in self.command_specs)
        self.is_prime_system = config.units == "prime"
        self.length = config.length.value
        self.speed = config.speed
        self.delta_sign = float(config.delta_sign)
        # 0.5 rho L^2, the factor of U^2 in the unit of force
        self.pressure_area = 0.5 * config.density * self.length**2
        coefficient_rows = list(config.coefficients.values())
        self.terms = TermLibrary(
            sorted({term for axis_coefficients in coefficient_rows for term in axis_coefficients}),
            config.series_variables,
        )
        coefficient_values = [
            [axis_coefficients.get(term, 0.0) for axis_coefficients in coefficient_rows]
            for term in self.terms.terms
        ]
        self.coefficients = nn.Buffer(
            torch.tensor(coefficient_values, dtype=torch.float64), persistent=False
        )
        # moments carry one length more than forces
        moment_arms = torch.tensor([1.0, 1.0, self.length], dtype=torch.float64)
        self.moment_arms = nn.Buffer(moment_arms, persistent=False)

    def commands_for_demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the rudder command and, with terms in dn, the revolutions."""
        return commands_from_demand(self.command_specs, drive, steer)

    def force(self, states: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        position = self.servo_positions(states, command)
        u = nu[..., 0]
        v = nu[..., 1]
        r = nu[..., 2]
        delta = self.delta_sign * position[..., 0]
        # without a shaft no term contains dn, so that its value does not matter
        dn = position[..., 1] - self.n_0 if self.has_shaft else torch.zeros_like(u)
        coefficients = self.coefficients.to(nu.dtype)
        if not self.is_prime_system:
            series_variables = torch.stack((u - self.speed, v, r, delta, dn), dim=-1)
            force: Tensor = self.terms(series_variables) @ coefficients
            return force
        # the lower bound keeps v / U finite at rest
        speed = torch.sqrt((u * u + v * v).clamp(min=(0.1 * self.speed) ** 2))
        series_variables = torch.stack(
            ((u - self.speed) / speed, v / speed, r * self.length / speed, delta, dn / self.n_0),
            dim=-1,
        )
        force = (
            self.pressure_area
            * (speed * speed).unsqueeze(-1)
            * (self.terms(series_variables) @ coefficients)
        )
        return force * self.moment_arms.to(nu.dtype)
