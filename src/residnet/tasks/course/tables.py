"""Flights and plans of a course run as tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from residnet.control.courses.config import PlannedCourse
from residnet.judge.courses import CourseFlight
from residnet.tasks.course.flights import Vessels

_KEPT = 0.1
"""Seconds between the stored samples of a track."""


def spread_table(rows: list[dict[str, Any]], vessels: Vessels) -> pd.DataFrame:
    """Return one line for each flight of the spread."""
    columns = (
        "model",
        "guidance",
        "protocol",
        "finished",
        "passed",
        "course_time",
        "ratio",
        "margin",
        "cross_track_rms",
    )
    drawn = {
        "effect": vessels.variation[:, 0],
        "time": vessels.variation[:, 1],
        "bias": vessels.variation[:, 2],
    }
    drawn |= {"current_north": vessels.current[:, 0], "current_east": vessels.current[:, 1]}
    return pd.DataFrame(
        {name: [row[name] for row in rows] for name in columns}
        | {name: values.numpy() for name, values in drawn.items()}
    )


def track_table(name: str, guidance: str, protocol: str, flight: CourseFlight) -> pd.DataFrame:
    """Return the track of one flight, a sample every 0.1 s: positions in m, angles in rad."""
    every = max(round(_KEPT / flight.dt), 1)
    count = len(flight.track)
    columns = {
        "controller": name,
        "guidance": guidance,
        "protocol": protocol,
        "t": flight.dt * np.arange(count)[::every],
        "north": flight.track[::every, 0],
        "east": flight.track[::every, 1],
        "psi": flight.heading[::every],
        "rudder": np.resize(flight.rudder, count)[::every],
        "speed": flight.speed[::every],
        "cross_track": flight.cross_track[::every],
    }
    return pd.DataFrame(columns)


def plan_table(planned: PlannedCourse) -> pd.DataFrame:
    """Return the planned course up to its end: positions in m, heading and rudder in rad."""
    course = planned.course
    within = course.step * np.arange(len(course.track)) <= course.length
    columns = {
        "north": course.track[within, 0],
        "east": course.track[within, 1],
        "heading": course.heading[within],
        "rudder": course.rudder[within],
    }
    return pd.DataFrame({"protocol": planned.protocol, **columns})
