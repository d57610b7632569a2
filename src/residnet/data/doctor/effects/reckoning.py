"""Dead reckoning: how far the velocities of a log lead from its positions and headings."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log

# windows of a free run, s; a short log has at least three of them
_WINDOW = 60.0


def reckoning_error(log: Log, without: np.ndarray | None = None) -> np.ndarray:
    """Return the errors [2] of dead reckoning over a minute in place and heading, as shares.

    They are shares of the way sailed.

    An error of the heading counts with the share by which it displaces the end of a straight way.

    Args:
        log: with an increasing clock.
        without: [T] bool, samples that no window may touch; where that leaves too few windows, in
            which none may begin or end.
    """
    step = float(np.median(np.diff(log.t)))
    size = min(round(_WINDOW / step), len(log) // 3)
    if size < 2:
        return np.zeros(2)
    bad = np.zeros(len(log), dtype=bool) if without is None else without
    count = np.append(0, np.cumsum(bad))
    first = np.flatnonzero(count[size + 1 :] == count[: -size - 1])
    if first.size < 0.2 * (len(log) - size):
        first = np.flatnonzero(~bad[:-size] & ~bad[size:])
    if not first.size:
        return np.zeros(2)
    return np.array([_place(log, first, size), _heading(log, first, size)])


def _place(log: Log, first: np.ndarray, size: int) -> float:
    if any(name not in log.channels for name in ("x", "y", "psi", "u", "v")):
        return 0.0
    velocity = _bridged((log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"]), log.t)
    way = _change(_integral(velocity, log.t), first, size)
    moved = _change(log["x"] + 1j * log["y"], first, size)
    sailed = _change(_integral(np.abs(velocity), log.t), first, size)
    known = np.isfinite(moved) & np.isfinite(way)
    if not known.any():
        return 0.0
    total = float(np.sqrt(np.mean(sailed[known] ** 2)))
    return float(np.sqrt(np.mean(np.abs(moved - way)[known] ** 2))) / max(total, 1e-9)


def _heading(log: Log, first: np.ndarray, size: int) -> float:
    if any(name not in log.channels for name in ("psi", "r")):
        return 0.0
    off = _change(log["psi"], first, size) - _change(
        _integral(_bridged(log["r"], log.t), log.t), first, size
    )
    off = off[np.isfinite(off)]
    return 0.5 * float(np.sqrt(np.mean(off**2))) if off.size else 0.0


def _bridged(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the values [T] with straight lines where some are missing."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.asarray(np.nan_to_num(values))
    filled: np.ndarray = np.interp(t, t[known], values[known])
    return filled


def _change(values: np.ndarray, first: np.ndarray, size: int) -> np.ndarray:
    return np.asarray(values[first + size] - values[first])


def _integral(rate: np.ndarray, t: np.ndarray) -> np.ndarray:
    area: np.ndarray = np.cumsum(0.5 * np.diff(t) * (rate[1:] + rate[:-1]))
    return np.append(0.0, area)
