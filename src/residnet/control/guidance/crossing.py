"""Line-of-sight guidance with a circle of acceptance that feeds a reference filter.

Source: document 002 section 2.2.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.control.base import Reference
from residnet.control.motion.anticipation import (
    Derivatives,
    Lag,
    derivatives,
    needed_force,
    reference_row,
)
from residnet.control.motion.reference_filter import ReferenceFilterConfig
from residnet.core.columns import accelerations, heading, pose, position, velocities
from residnet.core.config import Config, Metres, RadiansPerSecond, Seconds
from residnet.core.frames import wrap
from residnet.physics.force_model import ForceModel


class CrossingConfig(Config):
    """Legs from the first point to the last, where the ferry stops.

    Attributes:
        points: (north, east) in m, where the ferry starts and then where each leg ends.
        circle: radius around the ferry; it meets the leg at the point that is steered for
            (2.16)-(2.18).
        frequency: Omega of the filter, all axes.
        damping: Delta of the filter.
        duration: of the whole crossing with its stop.
    """

    kind: Literal["crossing"] = "crossing"
    points: tuple[tuple[Metres, Metres], ...] = Field(min_length=2)
    circle: Metres = Field(default=6.0, gt=0)
    frequency: RadiansPerSecond = Field(default=0.5, gt=0)
    damping: float = Field(default=0.7, gt=0)
    duration: Seconds = Field(gt=0)

    @model_validator(mode="after")
    def _legs(self) -> CrossingConfig:
        if any(a == b for a, b in zip(self.points, self.points[1:], strict=False)):
            raise ValueError("points: two in a row are the same; a leg needs a direction")
        return self

    def filter(self) -> ReferenceFilterConfig:
        """Return the filter behind the guidance."""
        last = (*self.points[-1], 0.0)
        three = (self.frequency,) * 3
        return ReferenceFilterConfig(
            waypoints=(last,), frequency=three, damping=(self.damping,) * 3
        )


@final
class Crossing(Reference):
    """Reference [B, 18] for `Assisted`: the filtered line-of-sight point and each model's force.

    Memory [B, 13]: the filter's nine, the number of the leg, the point and heading that were
    steered for last.
    """

    def __init__(
        self, config: CrossingConfig, dt: float, models: Sequence[tuple[ForceModel, Lag | None]]
    ) -> None:
        super().__init__()
        self.n_state = 13
        self.config, self.dt, self.models = config, dt, list(models)
        self.filter_config = config.filter()
        self.advance = self.filter_config.build(dt).advance[0]
        self.points = torch.tensor(config.points, dtype=torch.float64)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at rest where the ferry is, on the first leg; NaN for no point yet."""
        rest = torch.zeros_like(x[:, :1])
        return torch.cat((pose(x), rest.expand(-1, 7), torch.full_like(pose(x), torch.nan)), dim=-1)

    def target(self, x: Tensor, desired: Tensor, leg: Tensor) -> tuple[Tensor, Tensor]:
        """Return the point and heading [B, 3] to steer for, and the leg [B] after a change.

        `desired` [B] is the desired heading in rad, x [B, nx] the state.
        """
        last = len(self.points) - 2
        place = position(x)
        near = (self.points[leg + 1] - place).norm(dim=-1) < self.config.circle
        arrived = near & (leg == last)
        leg = torch.where(near & (leg < last), leg + 1, leg)
        start, end = self.points[leg], self.points[leg + 1]
        along = (end - start) / (end - start).norm(dim=-1, keepdim=True)
        offset = place - start
        travelled = (offset * along).sum(-1)
        across = offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]
        reach = (self.config.circle**2 - across.square()).clamp(min=0.0).sqrt()
        point = torch.where(arrived[:, None], end, start + (travelled + reach)[:, None] * along)
        aim = torch.where(arrived[:, None], along, point - place)
        direction = torch.atan2(aim[:, 1], aim[:, 0])
        return torch.cat((point, (desired + wrap(direction - desired))[:, None]), dim=-1), leg

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        old = s[:, 9].long()
        target, leg = self.target(x, heading(s), old)
        # where the point jumps (first step, change of leg, the stop) it has no rate
        rate = (target - s[:, 10:]) / self.dt
        steady = (position(rate).norm(dim=-1) < self.config.circle) & (leg == old)
        rate = torch.where(steady[:, None], rate, torch.zeros_like(rate))
        motion = derivatives(self.filter_config, s[:, :9], target, rate)
        forces = [
            needed_force(model, Derivatives(*(part[i : i + 1] for part in motion)), lag, self.dt)
            for i, (model, lag) in enumerate(self.models)
        ]
        error = torch.stack((pose(s) - target, velocities(s), accelerations(s)), dim=-1)
        after = torch.einsum("aij,baj->bia", self.advance, error)
        memory = torch.cat(
            (after[:, 0] + target, after[:, 1], after[:, 2], leg[:, None].to(s.dtype), target),
            dim=-1,
        )
        return reference_row(motion, torch.cat(forces)), memory
