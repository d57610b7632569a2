"""Errors of free runs in the channels that have bands, and what is known of a run beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.layout import HEADING, POSITION, SURGE, SWAY, YAW_RATE
from residnet.data.prepare import Prepared
from residnet.judge.bands.channels import CHANNELS
from residnet.judge.freerun import Prediction
from residnet.judge.protocol import Window

_MASKED = tuple(CHANNELS.index(name) for name in ("u", "v", "position"))
"""Channels that are scored over usable samples alone."""


@dataclass(frozen=True)
class RunErrors:
    """What a free run of L samples after the first got wrong, and how it moved.

    Attributes:
        log: name of the log.
        manoeuvre: its kind.
        error: absolute errors [L, 5] by channel, NaN where they are not scored.
        states: predicted [L + 1, 6], from the initial state on.
    """

    log: str
    manoeuvre: str
    error: np.ndarray
    states: np.ndarray

    def __len__(self) -> int:
        return len(self.error)


def run_errors(
    windows: Sequence[Window], predictions: Sequence[Prediction], logs: Sequence[Prepared]
) -> list[RunErrors]:
    """Return the errors of one model's free runs.

    u, v and the position are scored over usable samples, r and the heading over all.

    Args:
        windows: W windows of a protocol.
        predictions: of the model, one for each.
        logs: that the windows belong to.
    """
    return [
        RunErrors(
            logs[window.log].log.name,
            logs[window.log].log.manoeuvre,
            absolute(prediction.states, logs[window.log], window),
            prediction.states,
        )
        for window, prediction in zip(windows, predictions, strict=True)
    ]


def absolute(states: np.ndarray, log: Prepared, window: Window) -> np.ndarray:
    """Return absolute errors [L, 5] of predicted states [L + 1, 6], without the initial state."""
    rows = slice(window.start + 1, window.stop)
    difference = states[1:] - log.y[rows]
    good = log.usable[rows]
    out = np.stack(
        (
            np.abs(difference[:, SURGE]),
            np.abs(difference[:, SWAY]),
            np.abs(difference[:, YAW_RATE]),
            np.abs(difference[:, HEADING]),
            np.hypot(*difference[:, POSITION].T),
        ),
        axis=1,
    )
    for column in _MASKED:
        out[~good, column] = np.nan
    return out
