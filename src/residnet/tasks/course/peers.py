"""The controllers that fly beside the policy of a course run."""

from __future__ import annotations

from pydantic import TypeAdapter

from residnet.control.base import Policy
from residnet.control.observed.config import AnyController
from residnet.documents.gouletas2020.autopilot import load_predictive
from residnet.tasks.course.autopilot_run import AutopilotRun
from residnet.tasks.course.config import CourseSettings


def load_peers(config: CourseSettings, known: AutopilotRun) -> dict[str, Policy]:
    """Return the peers as the autopilot run tuned or trained them, then the others."""
    reader: TypeAdapter[AnyController] = TypeAdapter(AnyController)
    built: dict[str, Policy] = {}
    for name in config.peers:
        if name in known.autopilot.predictive:
            built[name] = load_predictive(
                name, known.autopilot.predictive[name], known.steering, known.run
            )
        else:
            built[name] = reader.validate_python(known.controllers[name]["config"]).build(
                known.steering
            )
    built |= {name: law.build(known.steering) for name, law in config.others.items()}
    return {name: law.double() for name, law in built.items()}
