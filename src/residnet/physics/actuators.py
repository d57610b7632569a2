"""Actuators: thrust curves, rate limits and the forces that they make on the hull."""

from __future__ import annotations

from typing import Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config, Metres, RevRate, RevsPerSecond


class DifferentialThrustConfig(Config):
    """Two fixed thrusters side by side (document 003 section 4.1; revolutions in 1/s).

    `forward` and `reverse` are the coefficients (c0 [N], c1 [N s], c2 [N s^2]) of T = c0 + c1 n + c2 n^2 per thruster,
    for n > 0 and n < 0 (signed). The curve is clipped so that thrust never opposes the sense of rotation, which closes
    the jump that the printed polynomials have at zero (ERRATA W5). `spacing` is the distance between the thrusters.
    """

    kind: Literal["differential_thrust"] = "differential_thrust"
    spacing: Metres = Field(gt=0)
    n_max: RevsPerSecond = Field(gt=0)
    n_rate: RevRate = Field(gt=0)
    forward: tuple[float, float, float]
    reverse: tuple[float, float, float]
    source: str

    def build(self) -> DifferentialThrust:
        """The force map."""
        return DifferentialThrust(self)


class DifferentialThrust(nn.Module):
    """Forces of two thrusters: revolutions n [..., 2] (port, starboard; 1/s) -> tau [..., 3] (N, N, N m), document 003 eq. (6)."""

    def __init__(self, config: DifferentialThrustConfig) -> None:
        super().__init__()
        self.n_max = config.n_max
        self.n_rate = config.n_rate
        self.arm = 0.5 * config.spacing
        self.register_buffer("forward_curve", torch.tensor(config.forward, dtype=torch.float64), persistent=False)
        self.register_buffer("reverse_curve", torch.tensor(config.reverse, dtype=torch.float64), persistent=False)
        self.forward_curve: Tensor
        self.reverse_curve: Tensor

    def thrust(self, n: Tensor) -> Tensor:
        """Thrust of one propeller [N] at revolutions n [1/s], any shape (document 003 eqs. (21), (22), clipped as in ERRATA W5)."""
        f, b = self.forward_curve.to(n.dtype), self.reverse_curve.to(n.dtype)
        ahead = (f[0] + n * (f[1] + n * f[2])).clamp(min=0.0)
        astern = (b[0] + n * (b[1] + n * b[2])).clamp(max=0.0)
        return torch.where(n > 0, ahead, torch.where(n < 0, astern, torch.zeros_like(n)))

    def forward(self, n: Tensor) -> Tensor:
        """n [..., 2] -> tau [..., 3]."""
        t = self.thrust(n)
        port, stbd = t[..., 0], t[..., 1]
        return torch.stack((port + stbd, torch.zeros_like(port), self.arm * (port - stbd)), dim=-1)

    def advance(self, n: Tensor, command: Tensor, dt: float) -> Tensor:
        """Revolutions [..., 2] after a step of dt seconds: towards the saturated command by at most the rate limit."""
        target = command.clamp(-self.n_max, self.n_max)
        step = self.n_rate * dt
        return n + (target - n).clamp(-step, step)
