"""What an autopilot run asks of its vessel and of learned models, before anything is trained."""

from __future__ import annotations

from residnet.control.heading.steered_model import SteeredModel
from residnet.control.heading.steering import SteeredPlant
from residnet.core.errors import ConfigError, FitError
from residnet.dynamics.learned import chosen_model
from residnet.dynamics.store import load_model
from residnet.physics.vessel import load_vessel
from residnet.tasks.autopilot.config import AutopilotSettings, PolicyConfig


def check_vessels(config: AutopilotSettings) -> None:
    """Check that the vessel turns steadily, and so does every learned model of it.

    Raises:
        UsageError: where a run or a model is missing.
        FitError: where a learned model does not turn towards the rudder and stay there.
        ConfigError: where the vessel does not, or the inputs of a learned model are not its own.
    """
    vessel = SteeredPlant(load_vessel(config.vessel).build())
    learned = [
        (learned_vessel(name, wanted, vessel, config), wanted.training.dt)
        for name, wanted in config.policies.items()
        if wanted.learned is not None
    ]
    try:
        vessel.turning(config.rudder, config.turning_time)
    except FitError as error:
        raise ConfigError(f"vessel '{config.vessel}' cannot be steered: {error}") from error
    for model, dt in learned:
        model.turning(config.rudder, config.turning_time, dt)


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
