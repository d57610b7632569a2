"""Rows that repeat the last fix because no new one had come."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, share_of

# share of the rows from which on repeats are no accident
_LEAST = 0.1
_LONGEST = 5


def repeated_findings(log: Log) -> Iterator[Finding]:
    """Return the single rows in which position stands still while the vessel moves."""
    if any(name not in log.channels for name in ("x", "y")):
        return
    same = (np.diff(log.stack(("x", "y")), axis=0) == 0.0).all(axis=1)
    starts, stops = stretches(same)
    short = np.zeros(same.size, dtype=bool)
    for start, stop in zip(starts, stops, strict=True):
        if stop - start < _LONGEST:
            short[start:stop] = True
    share = float(short.mean())
    if share < _LEAST or not _moves(log, same):
        return
    at = np.append(False, short)
    others = [
        name
        for name in ("psi", "u", "v", "r")
        if name in log.channels and float((np.diff(log[name])[short] == 0.0).mean()) > 0.8
    ]
    names = ", ".join(("x", "y", *others))
    text = (
        f"{int(short.sum())} rows ({share_of(share)}) repeat the last {names}: the fix is older"
        " than the row"
    )
    yield Finding(
        "will mislead",
        "repeated_fix",
        text,
        {"count": float(short.sum()), "share": share},
        "leave these cells empty, or log at the receiver's rate",
        at,
        channels=("x", "y", *others),
    )


def _moves(log: Log, same: np.ndarray) -> bool:
    """Return whether a position changes by far more than its resolution where it changes."""
    steps = np.hypot(np.diff(log["x"]), np.diff(log["y"]))[~same]
    steps = steps[np.isfinite(steps)]
    if steps.size < 20:
        return False
    axis = np.abs(np.diff(log["x"]))
    least = float(axis[axis > 0.0].min(initial=np.inf))
    return float(np.median(steps)) > 4.0 * least
