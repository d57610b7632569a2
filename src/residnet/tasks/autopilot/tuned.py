"""Constants of peers that an earlier run has tuned under the same conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from residnet.control.heading.controllers import TunableConfig
from residnet.core.config import load_mapping, validate
from residnet.core.errors import ConfigError, UsageError
from residnet.core.files import read_json
from residnet.tasks.autopilot.config import AutopilotSettings
from residnet.tasks.autopilot.pace import paced


def check_tuned(config: AutopilotSettings) -> None:
    """Check that the run whose constants are to be taken is there and had the same conditions.

    Raises:
        UsageError: where it is not there or not finished.
        ConfigError: where it is no autopilot run, or of other conditions.
    """
    if config.conditions is not None and config.conditions.tuned_in is not None:
        _earlier(paced(config), config.conditions.tuned_in)


def tuned_before(
    name: str, peer: TunableConfig, config: AutopilotSettings
) -> tuple[TunableConfig, dict[str, Any]] | None:
    """Return a peer with the constants that an earlier run found for it, and notes; None for none.

    Args:
        name: of the peer in both runs.
        peer: with constants that are to be tuned.
        config: of this run, at its pace.

    Raises:
        UsageError: where the run that the config names is not there or not finished.
        ConfigError: where it is no autopilot run, or of other conditions.
    """
    assert config.conditions is not None
    run = config.conditions.tuned_in
    if run is None:
        return None
    earlier, found = _earlier(config, run)
    if earlier.peers.get(name) != peer or name not in found:
        return None
    complete = type(peer).model_validate(found[name]["config"])
    return complete, {**found[name], "tuned_in": str(run)}


def _earlier(config: AutopilotSettings, run: Path) -> tuple[AutopilotSettings, dict[str, Any]]:
    """Return config and notes on the controllers of an earlier run under the same conditions."""
    key = "conditions.tuned_in"
    if not (run / "controllers.json").is_file():
        raise UsageError(
            f"{key}: {run} is not the folder of a finished autopilot run; run it first, or leave"
            " this key out to tune peers here"
        )
    data = load_mapping(run / "resolved.yaml")
    if data.get("task") != "autopilot" or data.get("conditions") is None:
        raise ConfigError(f"{key}: {run} is no autopilot run under conditions")
    earlier = paced(validate(data, type(config), str(run / "resolved.yaml")))
    pairs = {name: (getattr(config, name), getattr(earlier, name)) for name in ("vessel", "rudder")}
    assert config.conditions is not None
    assert earlier.conditions is not None
    for name in ("stated", "evolution"):
        own, other = (getattr(one.conditions, name) for one in (config, earlier))
        pairs[f"conditions.{name}"] = own, other
    for name, (own, other) in pairs.items():
        if own != other:
            raise ConfigError(
                f"{key}: {run} tuned its peers for another '{name}'; constants are taken from runs"
                " of the same vessel, rudder, conditions and search alone"
            )
    return earlier, read_json(run / "controllers.json")["controllers"]
