"""The plan of a course and the guidance along it, for flights and for exports."""

from __future__ import annotations

from residnet.control.courses.config import PlannedCourse, plan_course
from residnet.control.courses.course_check import Protocol
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.guidance.drift import DriftEstimate
from residnet.control.heading.controllers import Steering
from residnet.tasks.course.autopilot_run import AutopilotRun
from residnet.tasks.course.config import CourseSettings


def plan_for(
    config: CourseSettings, known: AutopilotRun, protocol: Protocol
) -> tuple[PlannedCourse, CourseGuidance]:
    """Return the plan of a protocol, and the guidance along it.

    Raises:
        ConfigError: where no course fits the vessel's turns.
    """
    steering = known.steering
    planned = plan_course(
        config.course, protocol, steering.vessel, steering.turning, steering.limit, known.steady
    )
    return planned, guidance_along(config, planned, steering)


def guidance_along(
    config: CourseSettings, planned: PlannedCourse, steering: Steering
) -> CourseGuidance:
    """Return the guidance along the plan."""
    lookahead = config.course.lookahead
    drift = (
        None if config.integral is None else DriftEstimate(lookahead, config.integral, steering.dt)
    )
    return CourseGuidance(planned.course, lookahead, steering.vessel.state, drift)
