"""Sources of position, heading and velocities in a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.io.readers.recording import Series

MIN_MOTION_ROWS = 50
"""Smallest number of rows of a topic with motion."""


@dataclass(frozen=True)
class MotionSources:
    """Sources of the motion in a recording.

    Attributes:
        settings: reader settings with position, heading and channels.
        used_fields: topic and field of each quantity.
        step: smaller one of the median steps of position and heading in s.
    """

    settings: dict[str, Any]
    used_fields: set[tuple[str, str]]
    step: float


def median_series_step(series: Series) -> float:
    """Return the median step of a series in s; infinite for a single row."""
    return float(np.median(np.diff(series.clock))) if len(series) > 1 else float("inf")
