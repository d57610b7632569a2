"""Recognition of the zigzag in a measured log, so that a model can repeat it in closed loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log

_MOVING = 0.1
_OVER = 0.5


class SteeredZigzag(NamedTuple):
    """A zigzag as it was steered.

    Attributes:
        start: time of the first execute in s, from the log's first sample.
        side: of the first execute, +1 starboard, -1 port.
        angle: rudder angle held, mean over both sides, rad.
        heading: change of heading at which the rudder was ordered back, mean over the reversals,
            rad.
        leaves: change of heading at which the rudder left its side, rad; beyond `heading` by what
            the vessel turned while the order took effect.
        turning: rate of turn when it left, mean over the reversals, rad/s.
    """

    start: float
    side: float
    angle: float
    heading: float
    leaves: float
    turning: float


def steered_zigzag(log: Log, rudder: str) -> SteeredZigzag:
    """Return the zigzag of a log that holds t, psi and a rudder angle.

    An order is given at the last sample before the rudder moves, at a tenth of its largest rate.
    When the rudder left its side is known to a fraction of a sample, by its rate on the way across:
    a sample of a coarse grid can be worth half a degree of heading.

    Raises:
        DataError: where the rudder does not change sides with the heading at least twice.
    """
    delta, psi = log[rudder], log["psi"] - log["psi"][0]
    low, high = (float(level) for level in np.quantile(delta, (0.05, 0.95)))
    middle, angle = 0.5 * (low + high), 0.5 * (high - low)
    rate = np.abs(np.gradient(delta, log.t))
    moving = rate > _MOVING * rate.max()
    # -1, 0 or +1: the side that the rudder is held on, 0 between them
    side_held = np.where(np.abs(delta - middle) > _OVER * angle, np.sign(delta - middle), 0.0)
    over = np.flatnonzero(side_held)
    changed = side_held[over[1:]] != side_held[over[:-1]]
    changes = list(zip(over[:-1][changed], over[1:][changed], strict=True))
    if angle == 0.0 or len(changes) < 2:
        raise DataError(
            f"log {log.name}: the rudder is reversed {len(changes)} times; a zigzag needs at"
            " least 2"
        )
    # the rudder may rest beside the middle before the first order
    begun = int(np.argmax(moving))
    arrived = int(np.argmax(~moving & (np.arange(delta.size) > begun)))
    side = float(np.sign(delta[arrived] - delta[begun]))
    reversals = [(int(a), int(b)) for a, b in changes if b > arrived]
    if len(reversals) < 2:
        raise DataError(
            f"log {log.name}: the rudder is reversed {len(reversals)} times; a zigzag needs at"
            " least 2"
        )
    towards = side * (-1.0) ** np.arange(len(reversals))
    orders = [int(np.flatnonzero(~moving[:b])[-1]) for _, b in reversals]
    crossed = [
        _crossing_time(log.t[a : b + 1], side_held[b] * (delta[a : b + 1] - middle) / angle)
        for a, b in reversals
    ]
    heading, leaves = (
        float(np.mean(towards * psi[orders])),
        float(np.mean(towards * np.interp(crossed, log.t, psi))),
    )
    turning = float(np.mean(towards * np.interp(crossed, log.t, np.gradient(psi, log.t))))
    if heading <= 0.0:
        raise DataError(
            f"log {log.name}: the heading does not follow the rudder at the reversals; check the"
            f" sign of {rudder}"
        )
    return SteeredZigzag(
        float(log.t[max(begun - 1, 0)] - log.t[0]), side, angle, heading, leaves, turning
    )


def _crossing_time(t: np.ndarray, travel: np.ndarray) -> float:
    """Return the time at which the rudder leaves -1 for +1.

    `travel` [N] goes from below -1/2 to above +1/2 at times t [N].
    """
    below, above = np.interp((-_OVER, _OVER), np.maximum.accumulate(travel), t)
    return float(below - (1.0 - _OVER) / (2.0 * _OVER) * (above - below))
