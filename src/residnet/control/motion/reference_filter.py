"""Way-points through a third-order reference filter.

Source: document 002 section 2.2.1, eq. (2.15), corrections J7, J9, J13.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.base import Reference
from residnet.core.columns import accelerations, pose, velocities
from residnet.core.config import Config, Metres, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import ConfigError
from residnet.core.frames import to_body

Waypoint = tuple[Metres, Metres, Radians]
"""North, east and heading; headings are followed as they are written: from 0 to 180 deg clockwise,
from 135 to -45 deg the other way.
"""
Frequency = Annotated[RadiansPerSecond, Field(gt=0)]
Damping = Annotated[float, Field(gt=0)]


class ReferenceFilterConfig(Config):
    """A trajectory through way-points that are given one after the other, smoothed by a filter.

    Attributes:
        waypoints: (north, east, heading), the first from the start on.
        interval: between waypoints; the last one stays.
        frequency: Omega of x, y and psi.
        damping: Delta of x, y and psi.
    """

    kind: Literal["reference_filter"] = "reference_filter"
    waypoints: Annotated[tuple[Waypoint, ...], Field(min_length=1)]
    interval: Seconds = Field(default=60.0, gt=0)
    frequency: tuple[Frequency, Frequency, Frequency] = (0.5, 0.5, 0.5)
    damping: tuple[Damping, Damping, Damping] = (0.7, 0.7, 0.7)

    @property
    def duration(self) -> float:
        """Until the last waypoint's interval is over, in s."""
        return self.interval * len(self.waypoints)

    def build(self, dt: float) -> ReferenceFilter:
        """Return the guidance for a loop with steps of dt seconds.

        Raises:
            ConfigError: where the interval is no whole number of steps.
        """
        return ReferenceFilter([self], dt)


@final
class ReferenceFilter(Reference):
    """The filter (s + W)(s^2 + 2 D W s + W^2) on each of north, east and heading.

    It is stepped by RK4 with the way-point held over a step.

    The reference [B, 9] of a step is where the filter stands at its start: eta_d (north, east [m],
    heading [rad], not wrapped), then nu_d and nu_d_dot in body axes along the desired heading. The
    memory [B, 9] holds eta_d and its first and second derivative. The filter starts at rest where
    the vessel is. It has one config for all rows, or one for each row of the batch, with the same
    interval.
    """

    def __init__(self, configs: Sequence[ReferenceFilterConfig], dt: float) -> None:
        super().__init__()
        self.n_state = 9
        intervals = {config.interval for config in configs}
        steps = max(intervals) / dt
        if len(intervals) > 1 or abs(steps - round(steps)) > 1e-6 * steps or round(steps) < 1:
            given = ", ".join(f"{interval:g} s" for interval in sorted(intervals))
            raise ConfigError(
                f"reference filter: interval ({given}) must be the same for all and a whole number"
                f" of steps of {dt:g} s"
            )
        self.every = round(steps)
        self.count = max(len(config.waypoints) for config in configs)
        points = [
            (*config.waypoints, *[config.waypoints[-1]] * (self.count - len(config.waypoints)))
            for config in configs
        ]
        self.register_buffer(
            "waypoints", torch.tensor(points, dtype=torch.float64), persistent=False
        )
        self.waypoints: Tensor
        self.register_buffer(
            "advance",
            torch.stack([self._step_matrix(config, dt) for config in configs]),
            persistent=False,
        )
        self.advance: Tensor

    @staticmethod
    def _step_matrix(config: ReferenceFilterConfig, dt: float) -> Tensor:
        """Return the matrix [3, 3, 3] of an RK4 step for (error, rate, acceleration) of each axis.

        It is exact for a linear filter.
        """
        matrices = []
        for w, d in zip(config.frequency, config.damping, strict=True):
            a = (
                torch.tensor(
                    [[0, 1, 0], [0, 0, 1], [-(w**3), -(2 * d + 1) * w**2, -(2 * d + 1) * w]],
                    dtype=torch.float64,
                )
                * dt
            )
            eye = torch.eye(3, dtype=torch.float64)
            matrices.append(eye + a @ (eye + a @ (eye + a @ (eye + a / 4.0) / 3.0) / 2.0))
        return torch.stack(matrices)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory [B, 9]: at rest at the vessel's pose."""
        return torch.cat((pose(x), torch.zeros_like(x[:, :1]).expand(-1, 6)), dim=-1)

    def waypoint(self, k: int) -> Tensor:
        """Return the waypoint [B or 1, 3] that is given at step k."""
        return self.waypoints[:, min(k // self.every, self.count - 1)]

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        place, rate, change = pose(s), velocities(s), accelerations(s)
        u, v = to_body(rate[:, 0], rate[:, 1], place[:, 2])
        along, across = to_body(change[:, 0], change[:, 1], place[:, 2])
        r = rate[:, 2]
        # a vector fixed in the earth turns by -r in the body
        moving = torch.stack((u, v, r, along + r * v, across - r * u, change[:, 2]), dim=-1)
        target = self.waypoint(k).to(s.dtype)
        error = torch.stack((place - target, rate, change), dim=-1).unsqueeze(-1)
        after = (self.advance.to(s.dtype) @ error).squeeze(-1)
        memory = torch.cat((after[:, :, 0] + target, after[:, :, 1], after[:, :, 2]), dim=-1)
        return torch.cat((place, moving), dim=-1), memory
