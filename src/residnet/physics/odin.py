"""The USV Odin: accelerations as terms of the velocities, and forces by their gains.

Source: document 000 eqs. (6.6)-(6.8), corrections H1 to H5.
"""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY
from residnet.physics.actuators import ActuatorsConfig
from residnet.physics.environment.wind import WindLoadsConfig
from residnet.physics.kinematics import Planar
from residnet.physics.parameters import Parameter, above_zero, dimension, of_dimension, unit_text
from residnet.physics.plant import HullPlant
from residnet.physics.terms import TermLibrary, parse_term
from residnet.physics.vessel_file import VesselFile


class Gains(Config):
    """The acceleration per force or moment on each axis.

    Attributes:
        x: surge in 1/kg.
        y: sway in 1/kg.
        n: yaw in 1/(kg m^2).
    """

    x: Parameter
    y: Parameter
    n: Parameter

    _linear = field_validator("x", "y")(of_dimension(-1, 0, 0))
    _angular = field_validator("n")(of_dimension(-1, -2, 0))
    _positive = field_validator("x", "y", "n")(above_zero)


class AccelerationTerms(Config):
    """The accelerations without force as terms of (u, v, r); terms that brake are negative.

    Attributes:
        u: terms of the surge acceleration, each in the SI unit that its term asks for.
        v: terms of the sway acceleration.
        r: terms of the yaw acceleration.
    """

    u: dict[str, Parameter] = Field(default_factory=dict)
    v: dict[str, Parameter] = Field(default_factory=dict)
    r: dict[str, Parameter] = Field(default_factory=dict)

    def rows(self) -> tuple[dict[str, Parameter], ...]:
        """Return the terms of u_dot, v_dot, r_dot."""
        return self.u, self.v, self.r

    @model_validator(mode="after")
    def _units(self) -> AccelerationTerms:
        for axis, row in zip(VELOCITY, self.rows(), strict=True):
            for term, parameter in row.items():
                try:
                    factors = parse_term(term, VELOCITY, functions=False)
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if any(factor.power < 0 for factor in factors):
                    raise ValueError(f"{axis}: term '{term}' is infinite at rest")
                metres = (axis != "r") - sum(
                    factor.power for factor in factors if factor.name != "r"
                )
                seconds = -2 + sum(factor.power for factor in factors)
                if dimension(parameter.unit, 0) != (metres, seconds):
                    raise ValueError(
                        f"{axis}.{term}: its unit must be {unit_text(metres, seconds, 0)}, given"
                        f" '{parameter.unit}'"
                    )
        return self


class OdinConfig(VesselFile):
    """A 3-DOF vessel known by its accelerations.

    A file may name another one as `base` and give only what differs.

    Attributes:
        name: of the vessel, as its file is called.
        description: one line for `residnet list vessels`.
        length: of the hull, which manoeuvring indices and the Froude number are measured with.
        gains: acceleration per force.
        terms: acceleration without force.
        wind: coefficients of the hull above water; without them the vessel feels no wind.
        actuators: what the vessel is driven and steered by.
    """

    kind: Literal["odin"]
    gains: Gains
    terms: AccelerationTerms
    actuators: ActuatorsConfig
    wind: WindLoadsConfig | None = None

    def equations(self) -> tuple[tuple[str, ...], list[list[float]]]:
        """Return nu_dot as terms of (u, v, r), and the coefficients on each axis.

        The coefficients of the terms come first, then those of tau_x, tau_y, tau_n.
        """
        hull = AccelerationHull(self.gains, self.terms)
        return (
            hull.terms.terms,
            torch.cat((hull.coefficients.T, torch.diag(hull.gain)), dim=1).tolist(),
        )

    def build(self) -> OdinVessel:
        """Build the plant of this vessel."""
        return OdinVessel(self)


class AccelerationHull(nn.Module):
    """A hull given by nu_dot = gain tau + terms of the velocities.

    Buffers are float64; results take the dtype of the input.
    """

    def __init__(self, gains: Gains, terms: AccelerationTerms) -> None:
        super().__init__()
        rows = terms.rows()
        used = sorted({term for row in rows for term in row})
        self.terms = TermLibrary(used, VELOCITY)
        coefficients = [[row[term].value if term in row else 0.0 for row in rows] for term in used]
        self.register_buffer(
            "coefficients",
            torch.tensor(coefficients, dtype=torch.float64).reshape(len(used), 3),
            persistent=False,
        )
        gain = [gains.x.value, gains.y.value, gains.n.value]
        self.register_buffer("gain", torch.tensor(gain, dtype=torch.float64), persistent=False)
        self.coefficients: Tensor
        self.gain: Tensor

    def forward(self, nu: Tensor, tau: Tensor) -> Tensor:
        """Return the acceleration nu_dot [..., 3].

        Args:
            nu: velocities through the water [..., 3].
            tau: forces [..., 3] in N, N, N m.
        """
        force: Tensor = tau * self.gain.to(nu.dtype) + self.terms(nu) @ self.coefficients.to(
            nu.dtype
        )
        return force


@final
class OdinVessel(HullPlant):
    """A hull with its actuators, in current and external force.

    State x [B, 6 + k]: x, y [m], psi [rad], u, v [m/s] over ground, r [rad/s], then the actuators'
    states.
    """

    def __init__(self, vessel: OdinConfig) -> None:
        super().__init__(
            Planar(),
            vessel.actuators.build(),
            vessel.wind.build() if vessel.wind is not None else None,
        )
        self.hull = AccelerationHull(vessel.gains, vessel.terms)

    def acceleration(self, pose: Tensor, nu: Tensor, tau: Tensor) -> Tensor:
        """Return nu_dot [B, 3] from velocities through the water [B, 3] and forces [B, 3]."""
        acceleration: Tensor = self.hull(nu, tau)
        return acceleration
