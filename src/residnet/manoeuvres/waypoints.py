"""A course of way-points under a heading autopilot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.control.guidance.line_of_sight import LookAhead
from residnet.control.guidance.waypoints import WaypointGuidance
from residnet.control.heading.classical import HeadingPID
from residnet.core.config import Metres, Seconds
from residnet.core.log import Log
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource


class Waypoints(Manoeuvre):
    """Straight legs between way-points, under line-of-sight guidance.

    The steer is in proportion to heading error and yaw rate.

    Attributes:
        drive: held throughout.
        points: way-points (north, east), the first leg begins where the vessel does.
        acceptance: radius of the circle in which a way-point counts as reached.
        lookahead: how far before it on its leg the vessel steers for.
        gain: share of full steer per rad of heading error.
        rate_gain: share of full steer per rad/s of yaw rate.
    """

    kind: Literal["waypoints"] = "waypoints"
    drive: float = Field(gt=0, le=1)
    points: tuple[tuple[Metres, Metres], ...] = Field(min_length=1)
    acceptance: Metres = Field(gt=0)
    lookahead: Metres = Field(gt=0)
    gain: float = Field(default=1.0, gt=0)
    rate_gain: Seconds = Field(default=1.0, ge=0)

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on position and heading; each row has a course of its own."""
        return StackedSource(
            [WaypointSource(m, helm) for m in manoeuvres if isinstance(m, Waypoints)],
            [1] * len(manoeuvres),
        )

    @property
    def goal(self) -> str:
        """The end of the manoeuvre: the last way-point."""
        return f"the last of {len(self.points)} way-points"

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return cross-track errors from the leg that was sailed, and the time of the course."""
        names = ("x", "y", "psi")
        x = torch.from_numpy(np.nan_to_num(log.stack(names)))
        guidance = WaypointGuidance(self.points, self.acceptance, LookAhead(self.lookahead), names)
        s = guidance.initial_state(x[:1])
        errors = []
        for k in range(len(log)):
            _, s = guidance(x[k : k + 1], k, s)
            errors.append(float(guidance.leg(x[k : k + 1], s[:, 0].long(), s)[2]))
            if bool(guidance.finished(x[k : k + 1], k, s)):
                errors.pop()
                break
        found: dict[str, Any] = {
            "largest_cross_track_error": float(np.abs(errors).max()),
            "rms_cross_track_error": math.sqrt(np.mean(np.square(errors))),
        }
        return found | {"course_time": float(log.t[min(len(errors), len(log) - 1)] - log.t[0])}


@final
class WaypointSource(Source):
    """The source of one way-point course; its memory is the guidance's."""

    def __init__(self, manoeuvre: Waypoints, helm: Helm) -> None:
        super().__init__()
        for name in ("x", "y", "psi", "r"):
            helm.column(name)
        self.guidance = WaypointGuidance(
            manoeuvre.points, manoeuvre.acceptance, LookAhead(manoeuvre.lookahead), helm.state
        )
        self.autopilot = HeadingPID(
            helm.state, kp=manoeuvre.gain, kd=manoeuvre.rate_gain, limit=1.0
        )
        self.drive = manoeuvre.drive
        self.demand = helm.demand
        self.may_stop = True

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory [B, 3] of the guidance."""
        return self.guidance.initial_state(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] and the memory one step later."""
        heading, memory = self.guidance(x, k, memory)
        steer, _ = self.autopilot(x, heading, x[:, :0])
        command = self.demand(torch.full_like(steer[:, 0], self.drive), steer[:, 0])
        return torch.cat((command, w[:, command.shape[-1] :]), dim=-1), memory

    def finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows [B] have arrived at the last way-point."""
        return self.guidance.finished(x, k, memory)
