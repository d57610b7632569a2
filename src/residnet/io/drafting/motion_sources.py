"""Sources of position, heading and velocities in a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.errors import ResidnetError
from residnet.io.drafting.motion_regression import RawTable
from residnet.io.readers.compose import extract_heading, extract_position
from residnet.io.readers.quantities import HeadingConfig, PositionConfig
from residnet.io.readers.recording import Recording, Series

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
    return float(np.median(np.diff(series.clock))) if len(series) > 1 else float("inf")


def extract_pose(
    recording: Recording, position: PositionConfig, heading: HeadingConfig
) -> RawTable | None:
    """Return north, east and heading at the times of the positions, or None.

    None means that a source cannot be read, the clocks do not overlap, or the heading is constant.
    """
    try:
        position_log = extract_position(recording, position).log
        heading_log = extract_heading(recording, heading).log
    except ResidnetError:
        return None
    is_finite = np.isfinite(heading_log["psi"])
    # with a constant heading, velocities in body axes and in earth axes are equally consistent
    if is_finite.sum() < MIN_MOTION_ROWS or float(np.ptp(heading_log["psi"][is_finite])) < 0.3:
        return None
    if heading_log.t[-1] < position_log.t[0] or heading_log.t[0] > position_log.t[-1]:
        return None
    heading_at_positions = np.interp(
        position_log.t,
        heading_log.t[is_finite],
        heading_log["psi"][is_finite],
        left=np.nan,
        right=np.nan,
    )
    return RawTable(
        position_log.t,
        {"x": position_log["x"], "y": position_log["y"], "psi": heading_at_positions},
    )
