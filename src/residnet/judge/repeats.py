"""Repeatability: how far a vessel's motions differ under the same commands and start."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from residnet.core.layout import HEADING, POSE, POSITION, RANGE_VELOCITIES, VELOCITIES
from residnet.core.names import VELOCITY
from residnet.data.prepare import Prepared
from residnet.judge.protocol import ProtocolConfig, Window

_COMMAND = 0.05
_START = 0.25
_SEARCH = 0.5


@dataclass(frozen=True)
class Pair:
    """A pair of repeated runs: a window, and the stretch of a log that repeats it.

    `mismatch` is that of the commands, as a share of their range.
    """

    first: Window
    log: int
    start: int
    mismatch: float


def repeatability(
    protocol: ProtocolConfig,
    logs: Sequence[Prepared],
    commands: int,
    scales: Mapping[str, float],
    step: float,
) -> dict[str, Any]:
    """Return the part of limits.json about repeated manoeuvres.

    Every window of the protocol is compared with every stretch of equal length of the logs after
    its own, and of its own after the window, at starts every 0.5 s. A stretch repeats a window
    where the root mean square difference of every command stays below 5 % of the command's range
    over all logs, and each initial velocity differs by less than a quarter of its scale; the best
    stretch of a log counts.

    Args:
        protocol: whose windows.
        logs: on one grid.
        commands: number of columns of the inputs that are commanded.
        scales: of u, v, r.
        step: of the grid in s.

    Returns:
        tolerances; pairs, logs (how many take part); where there are pairs, means over them of the
        root mean square differences u, v, r (SI), of position and heading at the end (m, rad; seen
        from the start of each run), `nrmse` (mean over u, v, r of difference / scale), and the same
        by kind of manoeuvre. Two independent runs differ by sqrt(2) times what each is off their
        expectation.
    """
    divisor = np.array([scales[name] for name in VELOCITY])
    found = list(find_pairs(protocol, logs, commands, divisor, step))
    out: dict[str, Any] = {
        "tolerance": {
            "command_share_of_range": _COMMAND,
            "start": {name: _START * float(scales[name]) for name in VELOCITY},
        },
        "pairs": len(found),
        "logs": len({pair.first.log for pair in found} | {pair.log for pair in found}),
    }
    if found:
        apart = np.array([_apart(pair, logs) for pair in found])
        kinds = np.array([logs[pair.first.log].log.manoeuvre for pair in found])
        by_kind = {
            str(kind): {"pairs": int((kinds == kind).sum())} | _mean(apart[kinds == kind], divisor)
            for kind in np.unique(kinds)
        }
        out |= _mean(apart, divisor) | {"manoeuvres": by_kind}
    return out


def find_pairs(
    protocol: ProtocolConfig,
    logs: Sequence[Prepared],
    commands: int,
    scales: np.ndarray,
    step: float,
) -> Iterator[Pair]:
    """Return pairs of repeated runs; scales [3] are of u, v, r.

    Each window of the protocol with at most one stretch of each log from its own on. Without
    commands nothing says that two runs were to be the same, and there are none.
    """
    if commands == 0:
        return
    every = max(round(_SEARCH / step), 1)
    known = [log.recorded[log.piece >= 0, :commands] for log in logs]
    spread = np.concatenate(known).max(0) - np.concatenate(known).min(0)
    spread[spread == 0] = 1.0
    coarse = [np.nan_to_num(log.recorded[::every, :commands]) / spread for log in logs]
    for number, log in enumerate(logs):
        for window in protocol.windows(log, number, step):
            length = window.stop - window.start
            given = (
                np.nan_to_num(log.recorded[window.start : window.stop : every, :commands]) / spread
            )
            for other in range(number, len(logs)):
                starts = np.arange(0, len(logs[other]) - length + 1, every)
                if len(starts) == 0:
                    continue
                miss = mismatch(given, coarse[other])[: len(starts)]
                fits = (miss < _COMMAND) & _same_start(window, logs[other], starts, length, scales)
                if other == number:
                    fits &= starts >= window.stop
                if fits.any():
                    best = int(np.argmin(np.where(fits, miss, np.inf)))
                    yield Pair(window, other, int(starts[best]), float(miss[best]))


def mismatch(given: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the difference of a stretch [L, m] to every stretch of a series, [T - L + 1].

    It is the root mean square, the largest over the columns of the series [T, m].
    """
    if len(series) < len(given):
        return np.zeros(0)
    length, out = len(given), []
    middle = series.mean(0)
    for a, b in zip((given - middle).T, (series - middle).T, strict=True):
        energy = np.concatenate(([0.0], np.cumsum(b**2)))
        square = (
            energy[length:]
            - energy[:-length]
            - 2 * scipy.signal.correlate(b, a, mode="valid")
            + np.sum(a**2)
        )
        out.append(np.sqrt(np.maximum(square, 0.0) / length))
    return np.asarray(np.max(out, axis=0))


def _same_start(
    window: Window, log: Prepared, starts: np.ndarray, length: int, scales: np.ndarray
) -> np.ndarray:
    """[S] bool: starts in an unbroken, usable stretch with nearly the initial velocities of the
    window.
    """
    whole = (
        (log.piece[starts] >= 0)
        & (log.piece[starts] == log.piece[starts + length - 1])
        & log.usable[starts]
    )
    near = (np.abs(log.smooth[starts, VELOCITIES] - window.nu) < _START * scales).all(1)
    return np.asarray(whole & near)


def _apart(pair: Pair, logs: Sequence[Prepared]) -> list[float]:
    """Differences of two runs: root mean square of u, v (samples usable in both) and r, then
    position and heading at the end.
    """
    first, second = logs[pair.first.log], logs[pair.log]
    a = slice(pair.first.start, pair.first.stop)
    b = slice(pair.start, pair.start + a.stop - a.start)
    nu = first.y[a, VELOCITIES] - second.y[b, VELOCITIES]
    good = first.usable[a] & second.usable[b]
    end_a, end_b = _end(first.y[a]), _end(second.y[b])
    rms = [float(np.sqrt(np.mean(part**2))) for part in (nu[good, 0], nu[good, 1], nu[:, 2])]
    return [*rms, float(np.hypot(*(end_a - end_b)[POSITION])), float(abs((end_a - end_b)[HEADING]))]


def _end(y: np.ndarray) -> np.ndarray:
    """The pose [3] at the end of a run [T, 6] in the axes of its start."""
    north, east, turned = y[-1, POSE] - y[0, POSE]
    c, s = np.cos(y[0, HEADING]), np.sin(y[0, HEADING])
    return np.array([c * north + s * east, c * east - s * north, turned])


def _mean(apart: np.ndarray, scales: np.ndarray) -> dict[str, float]:
    mean = dict(zip((*VELOCITY, "position", "heading"), apart.mean(0).tolist(), strict=True))
    return mean | {"nrmse": float((apart[:, RANGE_VELOCITIES].mean(0) / scales).mean())}
