"""The policies of a finished autopilot run, whatever their kind."""

from __future__ import annotations

from pathlib import Path

from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.stored import load_heading_policy
from residnet.control.observed.stored import load_recurrent
from residnet.tasks.autopilot.config import AutopilotSettings


def stored_policy(config: AutopilotSettings, models: Path, name: str, dt: float) -> HeadingKeeper:
    """Return a trained policy of a run, at a step of dt seconds.

    Raises:
        UsageError: where the run lacks it, or it is not as it was written.
    """
    policy: HeadingKeeper
    if name in config.recurrent:
        policy = load_recurrent(models / name, config.recurrent[name].spec)
    else:
        policy = load_heading_policy(models / name)
    policy.at(dt)
    return policy
