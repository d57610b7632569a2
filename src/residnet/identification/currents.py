"""Training and validation logs as motion through the water, where each ran in unknown current."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.baselines import RegressorBaseline
from residnet.core.arrays import paged
from residnet.core.progress import say
from residnet.data.prepare import Prepared
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.training.current import estimate_currents, through_water


def through_currents(
    logs: Mapping[str, Sequence[Prepared]], settings: FitSettings
) -> tuple[PreparedSplits, list[dict[str, Any]]]:
    """Return logs by split as motion through the water, and the table of their currents.

    Training and validation logs are moved; others keep their motion over ground. Where the
    settings name no current, nothing changes and the table is empty.

    Args:
        logs: prepared logs by split.
        settings: of the fit; `current` says how currents are estimated.

    Raises:
        FitError: where the logs do not determine their currents.
    """
    splits = {split: paged.OneByOne(members) for split, members in logs.items()}
    if settings.current is None:
        return splits, []
    signals = settings.signals.build()
    baseline = settings.all_baselines[settings.current.baseline].build(signals.names)
    assert isinstance(baseline, RegressorBaseline), "the settings were validated"
    fitted = [*logs["train"], *logs["validation"]]
    values, table = estimate_currents(baseline, signals, fitted, settings.current)
    moved = [through_water(log, value, signals) for log, value in zip(fitted, values, strict=True)]
    count = len(logs["train"])
    say(f"  {_summary(table)}")
    train, validation = paged.OneByOne(moved[:count]), paged.OneByOne(moved[count:])
    return {**splits, "train": train, "validation": validation}, table


def _summary(table: list[dict[str, Any]]) -> str:
    north, east = (
        np.array([row[name] for row in table]) for name in ("current_north", "current_east")
    )
    speed = np.hypot(north, east)
    return (
        f"currents of {len(table)} logs: {speed.mean():.3f} m/s on average, at most"
        f" {speed.max():.3f} m/s"
    )
