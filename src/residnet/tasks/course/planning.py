"""Whether the courses of a course run can be planned, before any controller is trained."""

from __future__ import annotations

from residnet.control.courses.config import plan_course, smallest_turn
from residnet.control.heading.steering import SteeredPlant
from residnet.core.errors import ConfigError
from residnet.physics.vessel import load_vessel
from residnet.tasks.autopilot.config import AutopilotSettings
from residnet.tasks.course.config import CourseSettings


def check_plans(config: CourseSettings, autopilot: AutopilotSettings) -> None:
    """Plan every protocol's course for the vessel of the autopilot.

    Raises:
        ConfigError: where there is no course, with the buoy and what can be done.
    """
    vessel = SteeredPlant(load_vessel(autopilot.vessel).build())
    turning = vessel.turning(autopilot.rudder, autopilot.turning_time)
    steady = smallest_turn(config.course, vessel, turning, autopilot.rudder)
    for protocol in config.protocols:
        try:
            plan_course(config.course, protocol, vessel, turning, autopilot.rudder, steady)
        except ConfigError as error:
            raise ConfigError(f"course.buoys, protocol {protocol}: {error}") from error
