"""The finished autopilot run that a course is flown with: vessel, policy and peers."""

from __future__ import annotations

from typing import Any, NamedTuple

from residnet.control.courses.config import smallest_turn
from residnet.control.courses.turns import SteadyTurn
from residnet.control.heading.controllers import Steering
from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.steering import SteeredPlant
from residnet.control.heading.turning import Turning
from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.core.files import read_json
from residnet.core.names import nearest
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.tasks.autopilot.stored import stored_policy
from residnet.tasks.autopilot.task import AutopilotConfig
from residnet.tasks.course.config import CourseSettings


def autopilot_of(config: CourseSettings) -> AutopilotConfig:
    """Return the config of the autopilot, from its run folder or its file.

    Raises:
        UsageError: where the folder is not that of a finished autopilot run.
        ConfigError: where the file is no config of an autopilot, or has no such policy or peer.
    """
    given = config.autopilot
    file = RunFolder.open(given).resolved if given.is_dir() else given
    autopilot = load_config(file, [], AutopilotConfig)
    trained = {**autopilot.policies, **autopilot.recurrent}
    if config.policy not in trained:
        raise ConfigError(
            f"policy: '{config.policy}' is none of {given}{nearest(config.policy, trained)}"
        )
    for name in config.peers:
        if name not in (known := {**autopilot.peers, **autopilot.predictive}):
            raise ConfigError(f"peers: '{name}' is none of {given}{nearest(name, known)}")
    if taken := sorted({config.policy, *config.peers} & set(config.others)):
        raise ConfigError(
            f"others: '{taken[0]}' is a policy or peer already; names are unique in a run"
        )
    return autopilot


class AutopilotRun(NamedTuple):
    """The finished autopilot run that courses are planned and flown with.

    Attributes:
        autopilot: config of the autopilot run.
        run: its folder.
        steering: vessel, K and T, rudder limit and step.
        steady: the smallest turn.
        controllers: configs of its peers as tuned, by name.
    """

    autopilot: AutopilotConfig
    run: RunFolder
    steering: Steering
    steady: SteadyTurn
    controllers: dict[str, Any]


def ready(config: CourseSettings, folder: RunFolder) -> AutopilotRun:
    """Read the finished autopilot run: the given one, or the one in the folder of the course.

    Raises:
        UsageError: where it is not finished.
    """
    autopilot = autopilot_of(config)
    run = RunFolder.open(
        config.autopilot if config.autopilot.is_dir() else folder.path / "autopilot"
    )
    notes = read_json(run.path / "controllers.json")
    steering = Steering(
        SteeredPlant(load_vessel(autopilot.vessel).build()),
        Turning(**notes["turning"]),
        autopilot.rudder,
        config.dt,
    )
    return AutopilotRun(
        autopilot,
        run,
        steering,
        smallest_turn(config.course, steering.vessel, steering.turning, steering.limit),
        notes["controllers"],
    )


def load_policy(known: AutopilotRun, name: str) -> HeadingKeeper:
    """Return a trained policy of the autopilot's run, at the step of the course.

    Raises:
        UsageError: where the run lacks it, or it is not as it was written.
    """
    steering = known.steering
    policy = stored_policy(known.autopilot, known.run.models, name, steering.dt)
    policy.read_from(steering.vessel.state)
    return policy
