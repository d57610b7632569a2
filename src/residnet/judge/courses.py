"""Measures of flights along courses: time, cross-track error, and how buoys were passed.

Times are compared with a reference of arcs and straight lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from residnet.control.courses.config import PlannedCourse
from residnet.control.courses.course_check import Asked, passages

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CourseFlight:
    """A flight of one vessel along one course, until it ended.

    Attributes:
        track: north, east [N, 2] in m.
        heading: [N] in rad.
        rudder: command [N] in rad.
        speed: [N] in m/s.
        cross_track: [N] in m, positive to starboard of the plan.
        dt: step in s.
        finished: whether the end was reached in the time given.
    """

    track: Array
    heading: Array
    rudder: Array
    speed: Array
    cross_track: Array
    dt: float
    finished: bool


@dataclass(frozen=True)
class Pass:
    """A passage of a buoy.

    Attributes:
        distance: smallest distance on the whole course after the start has been left, in m.
        side: that the buoy lay on when it was nearest, in its turn.
        time: of that, in s.
    """

    distance: float
    side: str
    time: float


def passes(
    flight: CourseFlight, places: Sequence[tuple[float, float]], within: Sequence[float]
) -> list[Pass]:
    """Return how each buoy at (north, east) was passed, one after the other.

    The moments follow each other, and the sum of the distances then is least.

    Args:
        places: of the buoys.
        within: radii in m; a vessel that starts in a circle first leaves it.
    """
    asked = [Asked(*place, radius, "") for place, radius in zip(places, within, strict=True)]
    return [
        Pass(passage.least, passage.side, passage.at * flight.dt)
        for passage in passages(flight.track, asked)
    ]


def row(
    model: str,
    kind: str,
    guidance: str,
    planned: PlannedCourse,
    flight: CourseFlight,
    acceptance: float,
    speed: float,
) -> dict[str, Any]:
    """Return a row of metrics.json.

    `ratio` is course time over the reference's length at the service speed; `ratio_turning` takes
    the speed that the vessel keeps in its smallest turn, for vessels that slow down. `margin` is
    how far inside the circle that was entered least, or outside the one that was passed most
    closely.
    """
    places = [(buoy.north, buoy.east) for buoy in planned.buoys]
    radii = [acceptance if planned.protocol == "enter" else buoy.radius for buoy in planned.buoys]
    seen = passes(flight, places, radii)
    time = (len(flight.track) - 1) * flight.dt
    out: dict[str, Any] = {
        "model": model,
        "kind": kind,
        "guidance": guidance,
        "split": "simulated",
        "protocol": planned.protocol,
    }
    out |= {
        "finished": flight.finished,
        "course_time": time,
        "reference_time": planned.reference / speed,
        "ratio": time * speed / planned.reference,
        "ratio_turning": time * planned.steady.speed / planned.reference,
        "cross_track_rms": float(np.sqrt(np.mean(flight.cross_track**2))),
        "cross_track_max": float(np.abs(flight.cross_track).max()),
        "travel": float(abs(flight.rudder[0]) + np.abs(np.diff(flight.rudder)).sum()),
        "tightest_turn": _tightest(flight),
        "distances": [passage.distance for passage in seen],
    }
    if planned.protocol == "enter":
        inside = [radius - passage.distance for passage, radius in zip(seen, radii, strict=True)]
        entered = sum(margin >= 0 for margin in inside)
        return out | {
            "entered": entered,
            "passed": entered == len(seen),
            "margin": min(inside),
            "n": len(seen),
        }
    buoys = zip(seen, planned.buoys, strict=True)
    right = sum(passage.side == buoy.leave_to for passage, buoy in buoys)
    outside = [passage.distance - radius for passage, radius in zip(seen, radii, strict=True)]
    clear = sum(margin >= 0 for margin in outside)
    passed = {"right_side": right, "clear": clear, "clearance": min(outside)}
    return (
        out
        | passed
        | {
            "passed": right == clear == len(seen),
            "margin": min(outside),
            "n": len(seen),
        }
    )


def _tightest(flight: CourseFlight) -> float:
    """Smallest radius in m that the vessel turned with, by its speed and yaw rate."""
    rate = np.abs(np.diff(flight.heading)) / flight.dt
    return float((flight.speed[:-1] / np.maximum(rate, 1e-9)).min())


def spread_row(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row of metrics.json for many flights of one controller, from their own rows.

    `passed` and `finished` are shares of the flights; flights that were given up count with the
    time until then.
    """
    ratio, margin = (np.array([row[name] for row in rows]) for name in ("ratio", "margin"))
    out = {
        name: rows[0][name] for name in ("model", "kind", "guidance", "protocol", "reference_time")
    }
    return out | {
        "split": "spread",
        "n": len(rows),
        "passed": float(np.mean([row["passed"] for row in rows])),
        "finished": float(np.mean([row["finished"] for row in rows])),
        "ratio": float(np.median(ratio)),
        "ratio_worst": float(ratio.max()),
        "margin": float(np.median(margin)),
        "margin_worst": float(margin.min()),
        "cross_track_rms": float(np.median([row["cross_track_rms"] for row in rows])),
    }
