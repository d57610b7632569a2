"""Two fixed thrusters side by side: thrust curves, rate limits and forces on the hull."""

from __future__ import annotations

from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.core.config import Metres, RevRate, RevsPerSecond
from residnet.physics.actuators.base import ActuatorConfig, Actuators
from residnet.physics.actuators.thrust_curve import (
    Coefficients,
    CurveRange,
    ThrustCurve,
    require_range,
)


class DifferentialThrustConfig(ActuatorConfig):
    """Two fixed thrusters side by side (document 003 section 4.1; revolutions in 1/s).

    The thrust curve is clipped so that thrust never opposes the sense of rotation, which closes the
    jump that the printed polynomials have at zero (correction W5).

    Attributes:
        spacing: distance between the thrusters in m.
        n_max: largest revolutions of either direction in 1/s.
        n_rate: largest change of revolutions in 1/s^2.
        forward: coefficients (c0 [N], c1 [N s], c2 [N s^2]) of T = c0 + c1 n + c2 n^2 per thruster,
            for n > 0.
        reverse: coefficients for n < 0 (signed).
        curve_range: revolutions (astern, ahead) in 1/s that the curves were measured between; they
            must include +-n_max.
    """

    kind: Literal["differential_thrust"] = "differential_thrust"
    spacing: Metres = Field(gt=0)
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate = Field(gt=0)
    forward: Coefficients
    reverse: Coefficients
    curve_range: CurveRange | None = None

    @model_validator(mode="after")
    def _range(self) -> DifferentialThrustConfig:
        require_range(self)
        return self

    def build(self) -> DifferentialThrust:
        """Return the force map."""
        return DifferentialThrust(self)


@final
class DifferentialThrust(Actuators):
    """Two thrusters: revolutions n [..., 2] (port, starboard) in 1/s make forces tau [..., 3].

    Source: document 003 eq. (6).
    """

    state = ("n_port", "n_stbd")
    commands = ("cmd_port", "cmd_stbd")
    held = True

    def __init__(self, config: DifferentialThrustConfig) -> None:
        super().__init__()
        self.n_max = config.n_max
        self.n_rate = config.n_rate
        self.arm = 0.5 * config.spacing
        self.curve = ThrustCurve(config.forward, config.reverse)

    def thrust(self, n: Tensor) -> Tensor:
        """Return the thrust of one propeller [N] at revolutions n [1/s], any shape.

        Source: document 003 eqs. (21), (22), clipped as in correction W5.
        """
        thrust: Tensor = self.curve(n)
        return thrust

    def forward(self, n: Tensor) -> Tensor:
        """Return tau [..., 3] in N, N, N m of revolutions n [..., 2] in 1/s."""
        t = self.thrust(n)
        port, stbd = t[..., 0], t[..., 1]
        return torch.stack((port + stbd, torch.zeros_like(port), self.arm * (port - stbd)), dim=-1)

    def demand(self, drive: Tensor, steer: Tensor) -> Tensor:
        """Return the commands [..., 2] in 1/s for a normalised mean and difference of revolutions.

        Each side is clipped to +-1 (document 003 eqs. (30), (31)).
        """
        both = torch.stack((drive + steer, drive - steer), dim=-1)
        return both.clamp(-1.0, 1.0) * self.n_max

    def force(self, a: Tensor, command: Tensor, nu: Tensor) -> Tensor:
        """Return tau [..., 3] of the present revolutions a [..., 2], whatever is commanded."""
        return self.forward(a)

    def advance(self, a: Tensor, command: Tensor, dt: float) -> Tensor:
        """Return the revolutions [..., 2] after a step of dt seconds.

        They move towards the saturated command by at most the rate limit.
        """
        target = command.clamp(-self.n_max, self.n_max)
        step = self.n_rate * dt
        return a + (target - a).clamp(-step, step)
