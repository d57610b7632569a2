"""Wheel-over: how far before a way-point the rudder is put over to come out on the next leg."""

from __future__ import annotations

import math
from typing import final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.control.heading.turning import Turning

_ANGLES = 181
_SAMPLES = 100
_DISTANCES = 400


@final
class WheelOver(nn.Module):
    """Distance before a way-point at which the leg changes, by the change of course there.

    A vessel T r_dot + r = K delta that puts its rudder over to the limit, and then back until the
    yaw stops on the next leg, has turned about the corner of both legs from the distance where its
    track begins to where it ends. In sharp corners that track would stay out of the way-point's
    circle of acceptance; there the distance is the largest from which it still reaches into the
    circle.

    Args:
        turning: K, T and speed.
        limit: of the rudder in rad.
        acceptance: radius of the circle in m.
        share: of that radius that the track keeps within.
        rate: of the rudder in rad/s; None where it stands at its command at once. While it moves,
            half of the way is lost.
    """

    def __init__(
        self,
        turning: Turning,
        limit: float,
        acceptance: float,
        *,
        share: float = 0.6,
        rate: float | None = None,
    ) -> None:
        super().__init__()
        angles, reach, tracks = _turns(turning, limit)
        within = share * acceptance
        radius = turning.speed / (turning.gain * limit)
        # an arc without lag, then the lag
        farthest = math.sqrt(within * (2.0 * radius + within)) + turning.speed * turning.time
        distance = np.linspace(0.0, farthest, _DISTANCES)
        missed = np.stack(
            [np.hypot(distance[:, None] - track[:, 0], track[:, 1]).min(axis=1) for track in tracks]
        )
        found = np.where((distance <= reach[:, None]) & (missed <= within), distance, 0.0).max(
            axis=1
        )
        even = np.linspace(0.0, math.pi, _ANGLES)
        moving = 0.0 if rate is None else 0.5 * turning.speed * limit / rate
        self.register_buffer(
            "table", torch.from_numpy(np.interp(even, angles, found) + moving), persistent=False
        )
        self.table: Tensor

    def forward(self, change: Tensor) -> Tensor:
        """Return the distance [B] in m for changes of course [B] in rad, within +-pi."""
        table = self.table.to(change.dtype)
        along = change.abs() * (float(table.shape[0] - 1) / math.pi)
        before = along.floor().clamp(max=float(table.shape[0] - 2))
        number, share = before.long(), along - before
        return (1.0 - share) * table[number] + share * table[number + 1]


def _turns(turning: Turning, limit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heading changes [N], distances to the corner [N] and tracks [N, M, 2] of turns.

    The heading changes go from 0 to past pi in rad; a distance is from a turn's beginning to where
    the lines before and after it meet, in m; tracks are ahead and aside, in m.
    """
    full, time = turning.gain * limit, turning.time
    held = np.concatenate(
        ([0.0], np.geomspace(1e-3 * time, math.pi / full + 2.0 * time, 4 * _ANGLES))
    )[:, None]
    first = full * (1.0 - np.exp(-held / time))
    share = np.linspace(0.0, 1.0, _SAMPLES)[None, :]
    # over, then back until the yaw has stopped
    over = held * share
    back = time * np.log1p(first / full) * share[:, 1:]
    turned = full * held - time * first
    rate = (first + full) * np.exp(-back / time) - full
    heading = np.concatenate(
        (
            full * (over - time * (1.0 - np.exp(-over / time))),
            turned + time * (first - rate) - full * back,
        ),
        axis=1,
    )
    moments = np.concatenate((over, held + back), axis=1)
    step = turning.speed * np.diff(moments, axis=1)
    middle = 0.5 * (heading[:, 1:] + heading[:, :-1])
    parts = np.stack((step * np.cos(middle), step * np.sin(middle)), axis=-1)
    track = np.concatenate((np.zeros((len(parts), 1, 2)), parts.cumsum(axis=1)), axis=1)
    angle = heading[:, -1]
    sine = np.sin(angle)
    meet = np.where(
        sine > 1e-9,
        track[:, -1, 0] - track[:, -1, 1] * np.cos(angle) / np.maximum(sine, 1e-9),
        math.inf,
    )
    return angle, np.where(angle == 0.0, 0.0, meet), track
