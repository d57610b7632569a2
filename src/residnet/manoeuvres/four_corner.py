"""The four-corner course: twelve segments of surge, sway and yaw, alone and together.

Source: document 002 section 4.1, Table 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.control.motion.pid import MotionPIDConfig
from residnet.control.motion.reference_filter import ReferenceFilterConfig, Waypoint
from residnet.core.config import RadiansPerSecond, Seconds
from residnet.core.errors import UsageError
from residnet.core.layout import HEADING, MOTION, PLANAR, POSE
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource

_H, _D = math.pi / 2, math.pi / 4
# Table 4.1 prints the twelve twice (correction J12); headings are followed as written (J13)
SEGMENTS: tuple[Waypoint, ...] = (
    (0.0, -15.0, -_H), (15.0, -15.0, 0.0), (15.0, 0.0, 0.0), (30.0, 0.0, 0.0), (30.0, -15.0, 0.0),
    (30.0, -15.0, 2 * _H), (15.0, -15.0, 2 * _H), (15.0, 0.0, 3 * _D), (0.0, 0.0, 3 * _D),
    (0.0, 0.0, -_D), (0.0, -15.0, -_D), (0.0, 0.0, 0.0),
)  # fmt: skip


class FourCorner(Manoeuvre):
    """Poses given one after the other through a reference filter, followed by a PID.

    The vessel must be commanded in all three forces.

    Attributes:
        poses: (north, east, heading); the twelve of the document where absent.
        interval: between poses; the course lasts so long for each.
        frequency: of the reference filter in x, y and psi, in rad/s.
        damping: relative damping of the reference filter in x, y and psi.
        control: gains of the PID.
    """

    kind: Literal["four_corner"] = "four_corner"
    poses: Annotated[tuple[Waypoint, ...], Field(min_length=1)] = SEGMENTS
    interval: Seconds = Field(default=60.0, gt=0)
    frequency: tuple[RadiansPerSecond, RadiansPerSecond, RadiansPerSecond] = (0.195, 0.195, 0.415)
    damping: tuple[float, float, float] = (0.7, 0.7, 0.7)
    control: MotionPIDConfig

    @property
    def filter(self) -> ReferenceFilterConfig:
        """The config of the reference filter."""
        return ReferenceFilterConfig(
            waypoints=self.poses,
            interval=self.interval,
            frequency=self.frequency,
            damping=self.damping,
        )

    def lasts(self, duration: float) -> float:
        """Return one interval for each pose, or `self.duration` where that is less."""
        return min(self.filter.duration, self.duration or math.inf)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the pose; each row has a course and gains of its own.

        Raises:
            UsageError: where the vessel has no command for each of the three forces.
        """
        step = float(t[1] - t[0])
        return StackedSource(
            [FourCornerSource(m, helm, step) for m in manoeuvres if isinstance(m, FourCorner)],
            [1] * len(manoeuvres),
        )

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the mean distance from the reference, and mean absolute error of the heading."""
        reference = self.filter.build(float(log.t[1] - log.t[0]))
        x = torch.from_numpy(log.stack(("x", "y", "psi")))
        s = reference.initial_state(x[:1])
        desired = []
        for k in range(len(log)):
            pose, s = reference(x[k : k + 1], k, s)
            desired.append(pose[0, POSE].numpy())
        error = x.numpy() - np.stack(desired)
        heading = np.abs((error[:, HEADING] + math.pi) % (2 * math.pi) - math.pi)
        return {
            "mean_position_error": float(np.hypot(error[:, 0], error[:, 1]).mean()),
            "mean_heading_error": float(heading.mean()),
        }


@final
class FourCornerSource(Source):
    """Reference filter and PID of one course, their memories side by side."""

    def __init__(self, manoeuvre: FourCorner, helm: Helm, step: float) -> None:
        super().__init__()
        if helm.forces is None or helm.state[MOTION] != PLANAR.names:
            raise UsageError(
                "a four-corner course needs a vessel in surge, sway and yaw that is commanded in"
                " all three, by forces or azimuth thrusters"
            )
        self.forces = helm.forces
        self.reference = manoeuvre.filter.build(step)
        self.policy = manoeuvre.control.build(step)

    def initial(self, x: Tensor) -> Tensor:
        """Return the filter at the vessel's pose, no integral."""
        return torch.cat((self.reference.initial_state(x), self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] and the memory one step later."""
        n = self.reference.n_state
        target, guided = self.reference(x, k, memory[:, :n])
        tau, s = self.policy(x, target, memory[:, n:])
        command = self.forces(tau)
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), torch.cat(
            (guided, s), dim=-1
        )
