"""Folds of logs: each part of the logs is left out once, and predicted by what fits the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from residnet.data.prepare import Prepared


@dataclass(frozen=True)
class Fold:
    """One division of logs.

    Attributes:
        fitted: logs, or what is left of them, that a model is fitted on.
        held_out: logs, or stretches of them, that it is judged on.
    """

    fitted: list[Prepared]
    held_out: list[Prepared]


def folds_of(logs: Sequence[Prepared], count: int) -> list[Fold]:
    """Return `count` folds: of whole logs where there are so many, else of stretches of logs.

    Whole logs are dealt out by falling length, so that folds are about as long as each other. Of
    fewer logs each is cut into so many stretches of equal length; they keep their places in time,
    and nothing runs across what is left out.

    Args:
        logs: with samples to learn from.
        count: number of folds, at least 2.
    """
    if len(logs) >= count:
        return _of_logs(logs, count)
    return [_of_stretches(logs, number, count) for number in range(count)]


def _of_logs(logs: Sequence[Prepared], count: int) -> list[Fold]:
    members: list[list[int]] = [[] for _ in range(count)]
    lengths = [0] * count
    for i in sorted(range(len(logs)), key=lambda i: -len(logs[i])):
        shortest = lengths.index(min(lengths))
        members[shortest].append(i)
        lengths[shortest] += len(logs[i])
    return [
        Fold([log for i, log in enumerate(logs) if i not in out], [logs[i] for i in sorted(out)])
        for out in members
    ]


def _of_stretches(logs: Sequence[Prepared], number: int, count: int) -> Fold:
    fitted, held_out = [], []
    for log in logs:
        inside = np.zeros(len(log), dtype=bool)
        inside[len(log) * number // count : len(log) * (number + 1) // count] = True
        fitted.append(_without(log, inside))
        held_out.append(_without(log, ~inside))
    return Fold([log for log in fitted if log.good.any()], held_out)


def _without(log: Prepared, out: np.ndarray) -> Prepared:
    """Return a log without some samples [T] bool; its time goes on."""
    return replace(
        log,
        piece=np.where(out, -1, log.piece),
        usable=log.usable & ~out,
        good=log.good & ~out,
    )
