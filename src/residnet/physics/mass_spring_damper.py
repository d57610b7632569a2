"""The mass-spring-damper of document 000 (eqs. (4.1), (4.2)), the first plant of its methods."""

from __future__ import annotations

from typing import Annotated, Literal, final

import torch
from pydantic import AfterValidator, Field
from torch import Tensor

from residnet.core.config import Config, Newtons
from residnet.physics.parameters import Mass, Parameter, above_zero, of_dimension
from residnet.physics.plant import Plant


class MassSpringDamperConfig(Config):
    """The mass-spring-damper m x_ddot + d x_dot + k x = tau.

    Attributes:
        m: mass in kg; by default that of section 5.3. (4.3) is another system: m = 20 kg,
            d = 10 kg/s, k = 12 N/m (correction H24).
        d: damping in kg/s.
        k: stiffness in N/m.
        tau_max: force that the full drive of a manoeuvre stands for.
    """

    kind: Literal["mass_spring_damper"] = "mass_spring_damper"
    m: Annotated[Mass, AfterValidator(above_zero)] = Parameter(
        value=10.0, unit="kg", source="document 000, section 5.3, (5.13)"
    )
    d: Annotated[Parameter, AfterValidator(of_dimension(1, 0, -1))] = Parameter(
        value=13.0, unit="kg/s", source="document 000, section 5.3, (5.13)"
    )
    k: Annotated[Parameter, AfterValidator(of_dimension(1, 0, -2))] = Parameter(
        value=5.0, unit="N/m", source="document 000, section 5.3, (5.13)"
    )
    tau_max: Newtons = Field(default=1.0, gt=0)

    def build(self) -> MassSpringDamper:
        """Build the plant of this vessel."""
        return MassSpringDamper(self)


@final
class MassSpringDamper(Plant):
    """A mass on a spring: displacement x [m] and its rate u [m/s] in x [B, 2]; input tau_x [N]."""

    state = ("x", "u")
    inputs = ("tau_x",)
    commands = 1

    def __init__(self, config: MassSpringDamperConfig) -> None:
        super().__init__()
        self.m, self.d, self.k = config.m.value, config.d.value, config.k.value
        self.tau_max = config.tau_max

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the force [..., 1] from the drive [...]; there is nothing to steer."""
        return (drive.clamp(-1.0, 1.0) * self.tau_max).unsqueeze(-1)

    def rate(self, x: Tensor, w: Tensor) -> Tensor:
        """Return x_dot [B, 2] under the force w [B, 1]."""
        displacement, speed = x[:, 0], x[:, 1]
        return torch.stack(
            (speed, (w[:, 0] - self.d * speed - self.k * displacement) / self.m), dim=-1
        )
