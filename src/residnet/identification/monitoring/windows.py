"""Short free runs from measured states: what they miss, and what each change would do to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from residnet.core.layout import HEADING, VELOCITIES
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.scripted import scripted
from residnet.identification.monitoring.changes import Change, ChangedDynamics, shown

SEEN = ("u", "v", "r", "heading")
"""What innovations are taken of."""
_PAST = 5.0
"""Time in s before a window that warms a memory up."""
_BLOCKS = 5
"""Parts of a window whose means count."""


@dataclass(frozen=True)
class Piece:
    """A measured window of K steps.

    Attributes:
        y: states [K + 1, 6].
        w: inputs held over each step [K, m].
        past_y: states before it that warm a memory up [P, 6].
        past_w: inputs before it [P, m].
    """

    y: np.ndarray
    w: np.ndarray
    past_y: np.ndarray
    past_w: np.ndarray


def innovations(
    model: HybridDynamics, pieces: Sequence[Piece], changes: Sequence[Change]
) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations [B, n] and what a unit of each change adds to them [B, C, n].

    Args:
        model: float64, in evaluation mode.
        pieces: B windows of one length, with pasts of one length.
        changes: C of them.
    """
    y = torch.from_numpy(np.stack([piece.y for piece in pieces]))
    w = torch.from_numpy(np.stack([piece.w for piece in pieces]))
    none = Change("none", "", "", 1.0)
    all_changes = [none, *changes]
    rows, steps, count = len(pieces), w.shape[1], len(all_changes)
    blocks = min(_BLOCKS, steps)
    mean = torch.zeros(blocks, steps, dtype=torch.float64)
    edges = np.linspace(0, steps, blocks + 1).round().astype(int)
    for block, (first, last) in enumerate(pairwise(edges.tolist())):
        mean[block, first:last] = 1.0 / (last - first)
    with torch.no_grad():
        memory = model.warmup(
            torch.from_numpy(np.stack([piece.past_y for piece in pieces])),
            torch.from_numpy(np.stack([piece.past_w for piece in pieces])),
        )
        begin = (y[:, 1] - y[:, 0])[:, VELOCITIES] / model.dt
        x0 = torch.cat(
            [y[:, 0] + shown(one.sensor, y[:, 0], begin, one.size) for one in all_changes]
        )
        changed = ChangedDynamics(model, all_changes, rows, w.shape[2])
        path, _, _ = scripted(Rollout(changed), steps)(
            x0, w.repeat(count, 1, 1), memory.repeat(count, 1)
        )
    path = path.reshape(count, rows, steps + 1, -1)
    # what a sensor shows is taken of the prediction: noise of the measurement is in the error too
    rate = mean @ path[0].diff(dim=1)[..., VELOCITIES] / model.dt
    path = mean @ path[:, :, 1:]
    error = _seen(mean @ y[:, 1:] - path[0])
    effects = [
        _seen(
            path[number + 1] - path[0]
            if not change.sensor
            else shown(change.sensor, path[0], rate, change.size) - (path[number + 1] - path[0])
        )
        / change.size
        for number, change in enumerate(changes)
    ]
    if not effects:
        return error.numpy(), np.zeros((len(error), 0, error.shape[1]))
    return error.numpy(), torch.stack(effects, dim=1).numpy()


def parted(piece: Piece, parts: int) -> list[Piece]:
    """Return the equal parts of a window, each with what went before it; a rest is left out."""
    past, steps = len(piece.past_y), len(piece.w) // parts
    y = np.concatenate((piece.past_y, piece.y))
    w = np.concatenate((piece.past_w, piece.w))
    return [
        Piece(
            y[past + k : past + k + steps + 1],
            w[past + k : past + k + steps],
            y[k : past + k],
            w[k : past + k],
        )
        for k in range(0, parts * steps, steps)
    ]


def _seen(states: Tensor) -> Tensor:
    """Return differences of states [B, k, 6] as innovations [B, 4 k]."""
    chosen = torch.cat((states[..., VELOCITIES], states[..., HEADING : HEADING + 1]), dim=-1)
    return chosen.flatten(1)


def pieces(log: Prepared, steps: int, past: int) -> list[Piece]:
    """Return the windows of a log, back to back, whose samples can all be trusted.

    Args:
        log: prepared as those of the fit.
        steps: length of a window.
        past: samples before a window that warm a memory up; the first windows go without.
    """
    out, start = [], past
    while start + steps < len(log):
        rows = slice(start - past, start + steps + 1)
        trusted = log.usable[rows] & (log.piece[rows] == log.piece[start]) & (log.piece[start] >= 0)
        if not trusted.all():
            # the next window begins behind the last sample that is not to be trusted
            start = rows.start + int(np.flatnonzero(~trusted)[-1]) + 1 + past
            continue
        out.append(
            Piece(
                log.y[start : start + steps + 1],
                log.w[start : start + steps],
                log.y[start - past : start],
                log.w[start - past : start],
            )
        )
        start += steps
    return out


def past_of(model: HybridDynamics) -> int:
    """Return the samples before a window that warm a model's memory up; 0 where it has none."""
    return round(_PAST / model.dt) if model.n_state else 0
