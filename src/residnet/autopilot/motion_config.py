"""Settings of reference filters, PID controllers of the pose and lags of forces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from residnet.core.config import Config, Metres, Radians, RadiansPerSecond, Seconds

if TYPE_CHECKING:
    from residnet.autopilot.motion import FeedForward, MotionPID, ReferenceFilter

Waypoint = tuple[Metres, Metres, Radians]
"""North, east and heading; headings are followed as they are written: from 0 to 180 deg clockwise,
from 135 to -45 deg the other way.
"""
Frequency = Annotated[RadiansPerSecond, Field(gt=0)]
Damping = Annotated[float, Field(gt=0)]


class ReferenceFilterConfig(Config):
    """A sequence of way-points at equal time intervals, smoothed by a reference filter.

    Attributes:
        waypoints: (north, east, heading); the first one is set at the start.
        interval: time in s between way-points; the last one is held.
        frequency: natural frequency Omega of x, y and psi.
        damping: damping ratio Delta of x, y and psi.
    """

    kind: Literal["reference_filter"] = "reference_filter"
    waypoints: Annotated[tuple[Waypoint, ...], Field(min_length=1)]
    interval: Seconds = Field(default=60.0, gt=0)
    frequency: tuple[Frequency, Frequency, Frequency] = (0.5, 0.5, 0.5)
    damping: tuple[Damping, Damping, Damping] = (0.7, 0.7, 0.7)

    @property
    def duration(self) -> float:
        """Time in s until the end of the last interval."""
        return self.interval * len(self.waypoints)

    def build(self, dt: float) -> ReferenceFilter:
        """Build the reference filter for a time step of dt seconds.

        Raises:
            ConfigError: if the interval is not a multiple of the time step.
        """
        from residnet.autopilot.motion import ReferenceFilter

        return ReferenceFilter([self], dt)


Gain = Annotated[float, Field(ge=0)]
Gains = tuple[Gain, Gain, Gain]


class MotionPIDConfig(Config):
    """PID gains of surge, sway and yaw; with zero gains only the feed-forward acts.

    Attributes:
        proportional: gains in N/m, N/m, N m/rad.
        integral: gains in N/(m s), N/(m s), N m/(rad s).
        derivative: gains in N s/m, N s/m, N m s/rad.
    """

    kind: Literal["motion_pid"] = "motion_pid"
    proportional: Gains
    integral: Gains = (0.0, 0.0, 0.0)
    derivative: Gains = (0.0, 0.0, 0.0)

    def build(self, dt: float, feed_forward: FeedForward | None = None) -> MotionPID:
        """Return the controller for a loop with steps of dt seconds."""
        from residnet.autopilot.motion import MotionPID, NoFeedForward

        return MotionPID([self], dt, NoFeedForward() if feed_forward is None else feed_forward)


class ActuatorLag(Config):
    """Second-order lag of forces: tau'' + 2 zeta omega tau' + omega^2 tau = omega^2 tau_c.

    tau_c is taken at t - delay (Jervan 2020, eq. (4.3)).

    Attributes:
        frequency: omega in rad/s.
        damping: zeta, dimensionless.
        delay: dead time in s.
    """

    frequency: RadiansPerSecond = Field(gt=0)
    damping: float = Field(gt=0)
    delay: Seconds = Field(default=0.0, ge=0)
