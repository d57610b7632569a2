"""Prepared logs with any pattern of usable samples and breaks, for the tests of the evaluation."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log
from residnet.core.names import STATE_NAMES
from residnet.preprocessing.prepare import PreparedLog


def made(
    y: np.ndarray,
    step: float,
    usable: np.ndarray | None = None,
    piece: np.ndarray | None = None,
    w: np.ndarray | None = None,
    name: str = "made",
    kind: str = "zigzag",
) -> PreparedLog:
    """A prepared log from measured states [T, 6]; usable and in one piece where not said."""
    count = len(y)
    piece = np.zeros(count, dtype=int) if piece is None else piece
    usable = np.ones(count, dtype=bool) if usable is None else usable
    w = np.zeros((count, 2)) if w is None else w
    t = 3.0 + step * np.arange(count)
    log = Log(name, t, {key: y[:, i] for i, key in enumerate(STATE_NAMES)}, manoeuvre=kind)
    return prepared(log, y, w, usable & (piece >= 0), piece)


def prepared(
    log: Log, y: np.ndarray, w: np.ndarray, usable: np.ndarray, piece: np.ndarray
) -> PreparedLog:
    """Without smoothing; the accelerations are no part of an evaluation."""
    return PreparedLog(
        log=log,
        split="test",
        y=y,
        smoothed=y.copy(),
        nu_dot=np.zeros((len(y), 3)),
        w=w,
        regression_inputs=w,
        segment=piece,
        usable=usable,
        trainable=usable,
    )


def random_states(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(count, 6))


def random_runs(count: int, rng: np.random.Generator, mean: float) -> np.ndarray:
    """[T] bool in runs of random length."""
    out = np.zeros(count, dtype=bool)
    value = bool(rng.random() < 0.5)
    k = 0
    while k < count:
        length = 1 + int(rng.exponential(mean))
        out[k : k + length] = value
        value = not value
        k = k + length
    return out
