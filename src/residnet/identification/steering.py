"""Nomoto's K and T and the delay of a vessel's steering, identified from its logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from residnet.control.heading.turning import Record, SteeringResponse, fit_response
from residnet.core.errors import DataError
from residnet.core.log import Log

_RUDDERS = ("cmd_delta", "delta")
_SAMPLES = 50
"""Usable samples below which K and T are not looked for; chosen by hand."""
_LEAST = 1e-3
"""Least spread of the rudder in rad, rms."""


class IdentifiedSteering(NamedTuple):
    """What logs say about a vessel's steering.

    Attributes:
        response: K, T, delay and rudder rate, and how well they simulate the yaw rates.
        speed: mean surge velocity in m/s; NaN where no log has it.
        noise: standard deviations of the white noise on the heading in rad and on the yaw rate in
            rad/s, at the step of the logs; NaN where no log has the channel.
        dt: median step of the logs in s.
        rudder: largest angle in rad that the logs hold.
    """

    response: SteeringResponse
    speed: float
    noise: tuple[float, float]
    dt: float
    rudder: float


def identify_steering(logs: Sequence[Log], longest_delay: float = 2.0) -> IdentifiedSteering:
    """Return K, T and delay of the vessel that logs are of.

    Args:
        logs: with yaw rate `r` or heading `psi`, and the rudder; turns to both sides tell most. The
            rudder is the command where a log has it, since the delay of the steering gear counts,
            otherwise the measured angle.
        longest_delay: that is searched for, in s.

    Raises:
        DataError: where a log lacks the channels, or the rudder hardly moves.
        FitError: where no response to the rudder is found.
    """
    if not logs:
        raise DataError("steering: no logs given")
    found = [_record(log) for log in logs]
    records, names = [record for record, _ in found], {name for _, name in found}
    spread = max(float(np.std(record.rudder)) for record in records)
    if spread < _LEAST:
        raise DataError(
            f"steering: the rudder of the logs moves by {spread:.2g} rad (rms); K and T need turns,"
            " such as a zigzag"
        )
    speeds = [log["u"][log.usable] for log in logs if "u" in log.channels]
    speed = float(np.nanmean(np.concatenate(speeds))) if speeds else float("nan")
    return IdentifiedSteering(
        fit_response(records, longest_delay, commands=names == {"cmd_delta"}),
        speed,
        (_noise(logs, "psi"), _noise(logs, "r")),
        float(np.median([record.dt for record in records])),
        max(float(np.abs(record.rudder).max()) for record in records),
    )


def _noise(logs: Sequence[Log], name: str) -> float:
    """Return the standard deviation of white noise, from what no motion does within two samples.

    The second difference of white noise has six times its variance; half of its sizes are below
    .6745 standard deviations.
    """
    bends = [np.abs(np.diff(log[name][log.usable], 2)) for log in logs if name in log.channels]
    finite = np.concatenate([np.zeros(0), *(bend[np.isfinite(bend)] for bend in bends)])
    return float(np.median(finite) / (0.6745 * np.sqrt(6.0))) if len(finite) else float("nan")


def _record(log: Log) -> tuple[Record, str]:
    """Return a log on a uniform grid at its median step, and the rudder's channel."""
    name = next((name for name in _RUDDERS if name in log.channels), None)
    source = next((name for name in ("r", "psi") if name in log.channels), None)
    if name is None or source is None:
        raise DataError(
            f"log {log.name}: K and T need the rudder ({' or '.join(_RUDDERS)}) and the yaw rate r"
            f" or the heading psi; it has {', '.join(log.channels)}"
        )
    usable = log.usable & np.isfinite(log[source]) & np.isfinite(log[name])
    if int(usable.sum()) < _SAMPLES:
        raise DataError(
            f"log {log.name}: {int(usable.sum())} usable samples, {_SAMPLES} are needed"
        )
    dt = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1] + 0.5 * dt, dt)
    good = log.t[usable]
    values = np.interp(grid, good, log[source][usable])
    rate = values if source == "r" else np.gradient(values, dt)
    # a command stands until the next
    held = np.clip(np.searchsorted(good, grid + 1e-9 * dt, side="right") - 1, 0, None)
    near = np.clip(np.searchsorted(log.t, grid - 0.5 * dt), 0, len(log.t) - 1)
    return Record(dt, log[name][usable][held], rate, usable[near]), name
