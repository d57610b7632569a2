"""A watch that goes along with measurements, window by window or sample by sample."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from residnet.identification.monitoring.innovations import Sums
from residnet.identification.monitoring.monitor import Verdict, Watch
from residnet.identification.monitoring.windows import Piece

_DEADBAND = 1.0
"""Standard deviations by which scores fall below the threshold before an alarm ends."""


class Watcher:
    """A watch that goes along with measurements, sample by sample.

    A score that wavers about the threshold is one alarm: it ends where all scores lie clearly below
    the threshold.

    Args:
        watch: over a model.
        past: samples before a window that warm a memory up.
    """

    def __init__(self, watch: Watch, past: int) -> None:
        self.watch = watch
        self.past = past
        self.steps = round(watch.config.window / watch.dt)
        self.size = max(round(watch.config.group / watch.config.window), 1)
        self.windows = max(round(watch.config.stretch / watch.config.window), 1)
        self.recent: deque[tuple[int, Sums]] = deque()
        self.log = 0
        self.closed = True
        self.alarmed = False
        self.y: list[np.ndarray] = []
        self.w: list[np.ndarray] = []

    def step(self, y: np.ndarray, w: np.ndarray) -> Verdict | None:
        """Take one sample: measured state [6], and the inputs [m] held over the step after it.

        Returns:
            The verdict where a window is complete, else None. A sample that is no measurement ends
            the window that it lies in.
        """
        if not (np.isfinite(y).all() and np.isfinite(w).all()):
            self.restart()
            return None
        self.y.append(np.asarray(y, dtype=float))
        self.w.append(np.asarray(w, dtype=float))
        if len(self.y) < self.past + self.steps + 1:
            return None
        known, given = np.stack(self.y), np.stack(self.w)
        piece = Piece(
            known[self.past :],
            given[self.past : -1],
            known[: self.past],
            given[: self.past],
        )
        # the next window begins where this one ends
        keep = self.past + 1
        self.y, self.w = self.y[-keep:], self.w[-keep:]
        return self.take(self.watch.sums([piece])[0])

    def restart(self) -> None:
        """Begin a new log, whose wind and current are its own."""
        self.y, self.w = [], []
        self.log += 1
        self.closed = True

    def take(self, sums: Sums) -> Verdict:
        """Take the scores of a window, and return the verdict on the last stretch."""
        if self.closed or self.recent[-1][1].count >= self.size:
            self.recent.append((self.log, sums))
        else:
            self.recent[-1] = (self.log, self.recent[-1][1] + sums)
        self.closed = False
        counts = [group.count for _, group in self.recent]
        while sum(counts) - counts[0] >= self.windows:
            self.recent.popleft()
            counts.pop(0)
        verdict = self.watch.judge([log for log, _ in self.recent], [one for _, one in self.recent])
        lasts = self.alarmed and verdict.largest > verdict.threshold - _DEADBAND
        self.alarmed = verdict.alarm or lasts
        return replace(verdict, alarm=self.alarmed)
