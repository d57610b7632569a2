"""The division of logs into training, validation and test where nobody said which is which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.parts import stretch_of

_ENOUGH = 5
"""Logs from which whole ones are taken for each split."""
_SHARES = (("train", 0.0, 0.3), ("validation", 0.3, 0.5), ("train", 0.5, 0.8), ("test", 0.8, 1.0))
"""Stretches of each log where there are fewer."""
_COPIED = 100
"""Rows that two logs share where one is a copy of part of the other."""


def divided(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return the logs by split (train, validation, test); copies are left out.

    Of each five logs, in the order of their manoeuvres, the third is for validation and the fifth
    for the test. Where there are fewer than five, each is cut in time: its first three tenths and
    those from the middle on are for training, the rest for validation and test.

    Raises:
        DataError: where a log is too short to be cut.
    """
    kept = without_copies(logs)
    out: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    if len(kept) >= _ENOUGH:
        order = sorted(kept, key=lambda log: log.manoeuvre)
        for place, log in enumerate(order):
            split = {2: "validation", 4: "test"}.get(place % 5, "train")
            out[split].append(log)
        if not out["test"]:
            raise DataError("no log is left for the test")
        return out
    for log in kept:
        for split, start, stop in stretches(log):
            out[split].append(stretch_of(log, start, stop))
    return out


def stretches(log: Log) -> list[tuple[str, float | None, float | None]]:
    """Return (split, start, stop) in s of the stretches that a log is cut into."""
    first, length = float(log.t[0]), float(log.t[-1] - log.t[0])

    def at(share: float) -> float:
        # whole numbers read better, where the log is long enough for them
        digits = max(0, 2 - int(np.log10(max(length, 1e-9))))
        return round(first + share * length, digits)

    return [
        (split, None if low == 0.0 else at(low), None if high == 1.0 else at(high))
        for split, low, high in _SHARES
    ]


def without_copies(logs: Sequence[Log]) -> list[Log]:
    """Return the logs without those whose rows another one holds; the longest stay."""
    from residnet.data.split import row_hashes

    common = sorted(set.intersection(*(set(log.channels) for log in logs))) if logs else []
    hashes = [set(row_hashes(log, common).tolist()) if common else set() for log in logs]
    kept: list[int] = []
    for i in sorted(range(len(logs)), key=lambda i: -len(logs[i])):
        if all(len(hashes[i] & hashes[j]) <= _COPIED for j in kept):
            kept.append(i)
    return [logs[i] for i in sorted(kept)]
