"""Reading off a measured log which zigzag was steered, so that a model can repeat it in closed loop."""

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
        heading: change of heading at which the rudder was reversed, mean over the reversals, rad.
    """

    start: float
    side: float
    angle: float
    heading: float


def steered_zigzag(log: Log, rudder: str) -> SteeredZigzag:
    """The zigzag of a log that holds t, psi and a rudder angle.

    An order is given where the rudder begins to move, at a tenth of its largest rate.

    Raises:
        DataError: where the rudder does not change sides with the heading at least twice.
    """
    delta, psi = log[rudder], log["psi"] - log["psi"][0]
    low, high = (float(level) for level in np.quantile(delta, (0.05, 0.95)))
    middle, angle = 0.5 * (low + high), 0.5 * (high - low)
    rate = np.abs(np.gradient(delta, log.t))
    moving = rate > _MOVING * rate.max()
    # -1, 0 or +1: the side that the rudder stands on, 0 on its way
    stands = np.where(np.abs(delta - middle) > _OVER * angle, np.sign(delta - middle), 0.0)
    over = np.flatnonzero(stands)
    changes = over[1:][stands[over[1:]] != stands[over[:-1]]]
    if angle == 0.0 or changes.size < 2:
        raise DataError(f"log {log.name}: the rudder is reversed {changes.size} times; a zigzag needs at least 2")
    # the rudder may rest beside the middle before the first order
    begun = int(np.argmax(moving))
    arrived = int(np.argmax(~moving & (np.arange(delta.size) > begun)))
    side = float(np.sign(delta[arrived] - delta[begun]))
    reversals = [int(k) for k in changes if k > arrived]
    orders = [int(np.flatnonzero(~moving[:k])[-1]) for k in reversals]
    if len(orders) < 2:
        raise DataError(f"log {log.name}: the rudder is reversed {len(orders)} times; a zigzag needs at least 2")
    heading = float(np.mean(side * (-1.0) ** np.arange(len(orders)) * psi[orders]))
    if heading <= 0.0:
        raise DataError(f"log {log.name}: the heading does not follow the rudder at the reversals; check the sign of {rudder}")
    return SteeredZigzag(float(log.t[max(begun - 1, 0)] - log.t[0]), side, angle, heading)
