"""An observed policy of an untrained network, for the tests of what controllers run."""

from __future__ import annotations

import math
from typing import Any

import torch

from residnet.autopilot.heading.controllers import ObserverPolicySpec, PtosConfig

DEG = math.pi / 180
DT = 0.02
GAIN = 3.47
TIME = 3.94
SPEED = 3.2
LIMIT = 5 * DEG
LAW = PtosConfig(
    lag=0.3, steepness=37.0, share=0.65, damping=0.88, heading_rate=2.0, yaw_rate_rate=5.0,
    push_rate=1.0, cross_rate=0.3,
)  # fmt: skip
SETTINGS: dict[str, Any] = {
    "state": ("psi", "u", "r"), "gain": GAIN, "time": TIME, "speed": SPEED, "limit": LIMIT,
    "dt": DT, "trained_at": 0.04, "units": 4,
}  # fmt: skip


def observed(rate: float | None, **changes: Any) -> tuple[ObserverPolicySpec, Any]:
    """Return the description of a policy and the policy, its network slightly off zero."""
    torch.manual_seed(0)
    spec = ObserverPolicySpec(rate=rate, law=LAW, **SETTINGS | changes)
    made = spec.build().requires_grad_(False)
    made.network.out.weight.normal_(std=0.02)
    return spec, made
