"""Training and validation logs seen through the water, where the configuration says that each ran
in an unknown current.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from residnet.baselines import RegressorBaseline
from residnet.data.prepare import Prepared
from residnet.tasks.fit import FitConfig
from residnet.training.current import CurrentConfig, estimate_currents, through_water


def through_currents(
    logs: Mapping[str, list[Prepared]], config: FitConfig, current: CurrentConfig
) -> tuple[dict[str, list[Prepared]], list[dict[str, Any]]]:
    """Logs by split with training and validation logs as motion through the water, and the table of
    their currents.

    Raises:
        FitError: where the logs do not determine their currents.
    """
    signals = config.signals.build()
    regressors = {"baseline": config.baseline, **config.baselines}[current.baseline].build(
        signals.names
    )
    assert isinstance(regressors, RegressorBaseline), "the configuration was validated"
    fitted = [*logs["train"], *logs["validation"]]
    values, table = estimate_currents(regressors, signals, fitted, current)
    moved = [through_water(log, value, signals) for log, value in zip(fitted, values, strict=True)]
    count = len(logs["train"])
    return {**logs, "train": moved[:count], "validation": moved[count:]}, table


def summary(table: list[dict[str, Any]]) -> str:
    """One line about the currents for the progress of a run."""
    north, east = (
        np.array([row[name] for row in table]) for name in ("current_north", "current_east")
    )
    speed = np.hypot(north, east)
    return (
        f"currents of {len(table)} logs: {speed.mean():.3f} m/s on average, at most"
        f" {speed.max():.3f} m/s"
    )
