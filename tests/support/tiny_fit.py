"""The settings and logs of a fit that runs in seconds."""

from __future__ import annotations

from typing import Any

from tiny import TINY

from residnet.core.config import validate_config
from residnet.identification.prepared import PreparedSplits, prepare_splits
from residnet.identification.settings import FitSettings
from residnet.io.sources import read_split_logs
from residnet.manoeuvres.trials_config import SimulatedTrials

DATA = validate_config(TINY["data"], SimulatedTrials, "here")


def settings_of(*keys: str, **changes: Any) -> FitSettings:
    """Return settings of a baseline alone, with other parts of the tiny config and changes."""
    content = {key: TINY[key] for key in ("prepare", "signals", "baseline", "evaluation", *keys)}
    return validate_config(content | changes, FitSettings, "here")


def logs_of(settings: FitSettings) -> PreparedSplits:
    """Return the tiny config's logs by split, prepared."""
    return prepare_splits(read_split_logs(DATA), settings)
