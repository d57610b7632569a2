"""Measures of flights along courses: time, cross-track error, and how buoys were passed.

Times are compared with a reference of arcs and straight lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from residnet.control.courses.config import PlannedCourse
from residnet.control.courses.course_check import Asked, passages
from residnet.core.columns import velocities_on
from residnet.core.frames import wrap
from residnet.core.layout import HEADING, POSITION, RANGE_VELOCITIES


@dataclass(frozen=True)
class Tracking:
    """The metrics of one run in closed loop; SI, angles in rad.

    Attributes:
        position_mae, position_mse: of the distance to the desired position in m, m^2 (4.6).
        heading_mae, heading_mse: of the wrapped heading error in rad, rad^2 (4.7).
        tau: mean |tau| commanded in surge, sway, yaw.
        feedback: mean |tau_FB| in surge, sway, yaw.
        motion_mse: of the velocities and accelerations against the desired ones in (m/s)^2,
            (m/s)^2, (rad/s)^2 and per second squared (Table 4.8).
        energy: integral of |tau' nu| in J, surge and sway, then yaw.
        power: the same per second in W (Table 4.13).
        iaew: integral of |e| times integral of power (3.18), position [m s J] and heading [rad s
            J].
    """

    position_mae: float
    position_mse: float
    heading_mae: float
    heading_mse: float
    tau: tuple[float, float, float]
    feedback: tuple[float, float, float]
    motion_mse: tuple[float, ...]
    energy: tuple[float, float]
    power: tuple[float, float]
    iaew: tuple[float, float]

    def row(self) -> dict[str, float | list[float]]:
        """Return the metrics for JSON."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }


def tracking(
    pose: Tensor, motion: Tensor, desired: Tensor, command: Tensor, feedback: Tensor, dt: float
) -> Tracking:
    """Return the metrics of a run in closed loop.

    Args:
        pose: x, y, psi [T, 3].
        motion: nu, nu_dot [T, 6].
        desired: eta_d, nu_d, nu_dot_d [T, 9].
        command: tau_c [T, 3].
        feedback: its part tau_FB [T, 3].
        dt: step in s.
    """
    position = (desired[:, POSITION] - pose[:, POSITION]).norm(dim=-1)
    heading = wrap(desired[:, HEADING] - pose[:, HEADING]).abs()
    work = command * motion[:, RANGE_VELOCITIES]
    # the power of keeping the position and of keeping the heading are told apart (Table 4.13)
    energy = [float(work[:, :2].sum(-1).abs().sum() * dt), float(work[:, 2].abs().sum() * dt)]
    errors = [float(position.sum() * dt), float(heading.sum() * dt)]
    seconds, missed = dt * len(pose), (velocities_on(desired) - motion).square().mean(0).tolist()
    tau, fed = command.abs().mean(0).tolist(), feedback.abs().mean(0).tolist()
    return Tracking(
        float(position.mean()),
        float(position.square().mean()),
        float(heading.mean()),
        float(heading.square().mean()),
        (tau[0], tau[1], tau[2]),
        (fed[0], fed[1], fed[2]),
        tuple(missed),
        (energy[0], energy[1]),
        (energy[0] / seconds, energy[1] / seconds),
        (errors[0] * energy[0], errors[1] * energy[1]),
    )


def mse(residual: Tensor) -> list[float]:
    """Return the mean square of a residual [N, 3] by axis."""
    return [float(value) for value in torch.mean(residual.square(), dim=0)]


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
    rate = np.abs(np.diff(flight.heading)) / flight.dt
    out |= {
        "finished": flight.finished,
        "course_time": time,
        "reference_time": planned.reference / speed,
        "ratio": time * speed / planned.reference,
        "ratio_turning": time * planned.steady.speed / planned.reference,
        "cross_track_rms": float(np.sqrt(np.mean(flight.cross_track**2))),
        "cross_track_max": float(np.abs(flight.cross_track).max()),
        "travel": float(abs(flight.rudder[0]) + np.abs(np.diff(flight.rudder)).sum()),
        "tightest_turn": float((flight.speed[:-1] / np.maximum(rate, 1e-9)).min()),
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
        | {"passed": right == clear == len(seen), "margin": min(outside), "n": len(seen)}
    )


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
