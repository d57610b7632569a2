"""What an autopilot run asks of its vessel and of learned models, before anything is trained."""

from __future__ import annotations

import math

from residnet.control.conditions.config import ConditionsConfig
from residnet.control.heading.steered_model import SteeredModel
from residnet.control.heading.steering import SteeredPlant
from residnet.control.heading.turning import Turning
from residnet.core.errors import ConfigError, FitError
from residnet.dynamics.store import chosen_model, load_model
from residnet.physics.vessel import load_vessel
from residnet.tasks.autopilot.config import AutopilotSettings, PolicyConfig
from residnet.tasks.autopilot.pace import least_time, paced
from residnet.tasks.autopilot.tuned import check_tuned

_PUSHED = 2.0
"""Standard deviations of the slow push that the rudder must be able to hold."""


def check_vessels(config: AutopilotSettings) -> None:
    """Check that the vessel turns steadily and can do what is asked, and so for learned models.

    Raises:
        UsageError: where a run or a model is missing, that of `tuned_in` too.
        FitError: where a learned model does not turn towards the rudder and stay there.
        ConfigError: where the vessel does not, has no time for its changes of heading or no rudder
            left to hold its course, or where the inputs of a learned model are not its own.
    """
    vessel = SteeredPlant(load_vessel(config.vessel).build())
    learned = [
        (learned_vessel(name, wanted, vessel, config), wanted.training.dt)
        for name, wanted in config.policies.items()
        if wanted.learned is not None
    ]
    try:
        turning = vessel.turning(config.rudder, config.turning_time)
    except FitError as error:
        raise ConfigError(f"vessel '{config.vessel}' cannot be steered: {error}") from error
    _check_flights(paced(config), turning, vessel.rate)
    check_tuned(config)
    for model, dt in learned:
        model.turning(config.rudder, config.turning_time, dt)


def _check_flights(config: AutopilotSettings, turning: Turning, rate: float | None) -> None:
    """Check that changes of heading can end in their time, and that the rudder can hold a course.

    Raises:
        ConfigError: with the key, what is needed and what is given.
    """
    asked = {"test": (config.test.heading, config.test.duration)}
    if config.conditions is not None:
        stated = config.conditions.stated
        asked["conditions.stated"] = (stated.heading[0], stated.duration)
        flown = {"stated": stated, **config.conditions.beyond}
        for name, conditions in flown.items():
            _check_rudder(f"conditions.{name}", conditions, config.rudder)
    for key, (change, duration) in asked.items():
        least = least_time(turning, config.rudder, rate, change)
        if least > duration:
            raise ConfigError(
                f"{key}.duration: a change of heading of {math.degrees(change):.3g} deg takes this"
                f" vessel {least:.3g} s at least, given {duration:.3g} s; give more time, or more"
                " rudder"
            )


def _check_rudder(key: str, conditions: ConditionsConfig, limit: float) -> None:
    held = conditions.bias + _PUSHED * conditions.push
    if held >= limit:
        raise ConfigError(
            f"{key}: a bias of {math.degrees(conditions.bias):.3g} deg and a push of"
            f" {math.degrees(conditions.push):.3g} deg leave nothing of a rudder of"
            f" {math.degrees(limit):.3g} deg to steer with; give more rudder, or less of them"
        )


def learned_vessel(
    name: str, wanted: PolicyConfig, vessel: SteeredPlant, config: AutopilotSettings
) -> SteeredModel:
    """Return the learned model that a policy is trained on, steered like the vessel.

    Args:
        name: of the policy.
        wanted: its config, which names the model.
        vessel: whose steering gear stands in front of the model.
        config: of the run.

    Raises:
        UsageError: where the run or the model is missing.
        ConfigError: where its inputs are not those of the vessel, or the spread has weather, which
            a learned model does not feel.
    """
    assert wanted.learned is not None
    if config.spread.weather:
        raise ConfigError(
            f"policies.{name}.learned: a learned model feels no wind or current; leave them out of"
            " spread"
        )
    chosen = chosen_model(wanted.learned.run, wanted.learned.model)
    spec, model = load_model(wanted.learned.run / "models" / chosen)
    return SteeredModel(model, spec.signals.columns, spec.hold, vessel)
