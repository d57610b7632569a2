"""Course manoeuvres: way-points with an autopilot, and the four-corner course of Jervan 2020."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from residnet.autopilot.motion_config import MotionPIDConfig, ReferenceFilterConfig, Waypoint
from residnet.core.config import Metres, RadiansPerSecond, Seconds
from residnet.core.errors import UsageError
from residnet.core.frames import wrap_angle_array
from residnet.core.layout import HEADING, MOTION, PLANAR_LAYOUT, POSE
from residnet.core.log import Log
from residnet.manoeuvres.base import Helm, Manoeuvre

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.autopilot.base import ClosedLoop
    from residnet.autopilot.guidance import WaypointGuidance
    from residnet.engine.rollout import Source

_POSE_NAMES = PLANAR_LAYOUT.pose


class Waypoints(Manoeuvre):
    """Straight legs between way-points with line-of-sight guidance.

    The steering command is proportional to heading error and yaw rate (PD control).

    Attributes:
        drive: constant propulsion command, as a fraction of its maximum.
        points: way-points (north, east); the first leg begins at the initial position.
        acceptance: radius of the circle in which a way-point counts as reached.
        lookahead: distance along the leg to the point towards which the vessel steers.
        gain: steering command, as a fraction of its maximum, per rad of heading error.
        rate_gain: steering command, as a fraction of its maximum, per rad/s of yaw rate.
    """

    kind: Literal["waypoints"] = "waypoints"
    drive: float = Field(gt=0, le=1)
    points: tuple[tuple[Metres, Metres], ...] = Field(min_length=1)
    acceptance: Metres = Field(gt=0)
    lookahead: Metres = Field(gt=0)
    gain: float = Field(default=1.0, gt=0)
    rate_gain: Seconds = Field(default=1.0, ge=0)

    def build_guidance(self, state: tuple[str, ...]) -> WaypointGuidance:
        """Return the guidance law for a state vector with these names."""
        from residnet.autopilot.guidance import LookAheadLineOfSight, WaypointGuidance

        return WaypointGuidance(
            self.points, self.acceptance, LookAheadLineOfSight(self.lookahead), state
        )

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on position and heading, with a separate course for each row."""
        from residnet.manoeuvres.sources import StackedSource

        for name in (*_POSE_NAMES, "r"):
            helm.state_column(name)
        sources = [m._build_loop(helm) for m in manoeuvres if isinstance(m, Waypoints)]
        return StackedSource(sources, [1] * len(sources))

    def _build_loop(self, helm: Helm) -> ClosedLoop:
        import torch

        from residnet.autopilot.base import ClosedLoop
        from residnet.autopilot.heading.classical import HeadingPD
        from residnet.autopilot.motion import AllocatedPolicy

        autopilot = HeadingPD(helm.state, kp=self.gain, kd=self.rate_gain, limit=1.0)

        def to_commands(steer: Tensor) -> Tensor:
            # `demand` maps the propulsion and steering commands, each within +-1, to the vessel
            return helm.demand(torch.full_like(steer[:, 0], self.drive), steer[:, 0])

        return ClosedLoop(AllocatedPolicy(autopilot, to_commands), self.build_guidance(helm.state))

    @property
    def marked_positions(self) -> Sequence[tuple[float, float]]:
        return self.points

    @property
    def end_condition(self) -> str:
        return f"the last of {len(self.points)} way-points"

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return cross-track errors relative to the active legs, and the duration of the course.

        Args:
            log: simulated or measured motion.
            length: length of the hull in m; not used.
        """
        import torch

        x = torch.from_numpy(np.nan_to_num(log.stack(_POSE_NAMES)))
        guidance = self.build_guidance(_POSE_NAMES)
        s = guidance.initial_state(x[:1])
        errors: list[float] = []
        for k in range(len(log)):
            _, s = guidance(x[k : k + 1], k, s)
            if bool(guidance.is_finished(x[k : k + 1], k, s)):
                break
            errors.append(float(guidance.leg_geometry(x[k : k + 1], s[:, 0].long(), s)[2]))
        return {
            "largest_cross_track_error": float(np.abs(errors).max()),
            "rms_cross_track_error": math.sqrt(np.mean(np.square(errors))),
            "course_time": float(log.t[min(len(errors), len(log) - 1)] - log.t[0]),
        }


_RIGHT_ANGLE = math.pi / 2
_HALF_RIGHT_ANGLE = math.pi / 4
# Table 4.1 prints the twelve poses twice (J12 in docs/documents/corrections.md);
# headings are not wrapped, so that the vessel turns in the direction written in the table (J13)
FOUR_CORNER_POSES: tuple[Waypoint, ...] = (
    (0.0, -15.0, -_RIGHT_ANGLE),
    (15.0, -15.0, 0.0),
    (15.0, 0.0, 0.0),
    (30.0, 0.0, 0.0),
    (30.0, -15.0, 0.0),
    (30.0, -15.0, 2 * _RIGHT_ANGLE),
    (15.0, -15.0, 2 * _RIGHT_ANGLE),
    (15.0, 0.0, 3 * _HALF_RIGHT_ANGLE),
    (0.0, 0.0, 3 * _HALF_RIGHT_ANGLE),
    (0.0, 0.0, -_HALF_RIGHT_ANGLE),
    (0.0, -15.0, -_HALF_RIGHT_ANGLE),
    (0.0, 0.0, 0.0),
)
"""Poses (north and east in m, heading in rad) of the four-corner course."""


class FourCorner(Manoeuvre):
    """A sequence of poses, smoothed by a reference filter and followed by a PID controller.

    The twelve segments of the source excite surge, sway and yaw, alone and combined. The vessel
    must have commands for all three forces. Source: Jervan 2020, section 4.1, Table 4.1.

    Attributes:
        poses: poses (north, east, heading); by default the twelve of the source.
        interval: time for each pose.
        frequency: natural frequencies of the reference filter in x, y and psi, in rad/s.
        damping: damping ratios of the reference filter in x, y and psi.
        control: gains of the PID.
    """

    kind: Literal["four_corner"] = "four_corner"
    poses: Annotated[tuple[Waypoint, ...], Field(min_length=1)] = FOUR_CORNER_POSES
    interval: Seconds = Field(default=60.0, gt=0)
    frequency: tuple[RadiansPerSecond, RadiansPerSecond, RadiansPerSecond] = (0.195, 0.195, 0.415)
    damping: tuple[float, float, float] = (0.7, 0.7, 0.7)
    control: MotionPIDConfig

    @property
    def filter_config(self) -> ReferenceFilterConfig:
        """Config of the filter that turns the poses into a smooth reference motion."""
        return ReferenceFilterConfig(
            waypoints=self.poses,
            interval=self.interval,
            frequency=self.frequency,
            damping=self.damping,
        )

    def duration_within(self, duration: float) -> float:
        """Return the total duration in s: the number of poses times `interval`.

        It is at most `self.duration`, if that is set; the argument is not used.
        """
        return min(self.filter_config.duration, self.duration or math.inf)

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the closed loop on the pose, with a separate course and gains for each row.

        Raises:
            UsageError: if the vessel lacks a command for one of the three forces.
        """
        from residnet.autopilot.base import ClosedLoop
        from residnet.autopilot.motion import AllocatedPolicy
        from residnet.manoeuvres.sources import StackedSource

        # `forces` allocates surge force, sway force and yaw moment to the commands
        if helm.forces is None or helm.state[MOTION] != PLANAR_LAYOUT.state_names:
            raise UsageError(
                "a four-corner course needs a vessel in surge, sway and yaw with commands for"
                " all three, by forces or azimuth thrusters"
            )
        step = float(t[1] - t[0])
        sources = [
            ClosedLoop(
                AllocatedPolicy(m.control.build(step), helm.forces), m.filter_config.build(step)
            )
            for m in manoeuvres
            if isinstance(m, FourCorner)
        ]
        return StackedSource(sources, [1] * len(sources))

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the mean distance from the reference, and mean absolute error of the heading.

        Args:
            log: simulated or measured motion.
            length: length of the hull in m; not used.
        """
        import torch

        reference = self.filter_config.build(float(log.t[1] - log.t[0]))
        x = torch.from_numpy(log.stack(_POSE_NAMES))
        s = reference.initial_state(x[:1])
        desired_poses = []
        for k in range(len(log)):
            pose, s = reference(x[k : k + 1], k, s)
            desired_poses.append(pose[0, POSE].numpy())
        error = x.numpy() - np.stack(desired_poses)
        return {
            "mean_position_error": float(np.hypot(*error[:, :HEADING].T).mean()),
            "mean_heading_error": float(np.abs(wrap_angle_array(error[:, HEADING])).mean()),
        }
