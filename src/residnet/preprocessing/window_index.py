"""Samples at which training windows may start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError
from residnet.core.stretches import find_run_bounds

if TYPE_CHECKING:
    from residnet.preprocessing.prepare import PreparedLog

_SEGMENTS_PER_LOG = 1_000_000
"""Offset of segment labels between logs, larger than the number of segments of any log."""
WINDOW_COLUMNS = ("y", "smoothed", "nu_dot", "w", "regression_inputs", "usable", "trainable")
"""Attributes of `WindowStore` that windows contain by default."""


@dataclass(frozen=True)
class WindowIndex:
    """Samples of all logs at which windows may start, N in total.

    Attributes:
        usable: samples at which free runs are scored [N] bool.
        trainable: samples that enter fits [N] bool.
        n_remaining: samples up to the end of the segment, including this one [N]; 0 outside of
            segments.
        n_elapsed: samples since the start of the segment [N].
    """

    usable: np.ndarray
    trainable: np.ndarray
    n_remaining: np.ndarray
    n_elapsed: np.ndarray

    @classmethod
    def from_logs(cls, logs: Sequence[PreparedLog]) -> WindowIndex:
        """Count the samples before and after each sample within its gapless segment."""
        n_remaining, n_elapsed = count_segment_samples([log.segment for log in logs])
        return cls(
            np.concatenate([log.usable for log in logs]),
            np.concatenate([log.trainable for log in logs]),
            n_remaining,
            n_elapsed,
        )

    def find_starts(self, length: int, min_usable_share: float = 0.5) -> np.ndarray:
        """Return the rows [S] at which a window may start.

        A window is within one segment, its first sample is trainable, and a minimum share of its
        samples is usable.

        Args:
            length: samples in a window.
            min_usable_share: smallest share of usable samples.

        Raises:
            DataError: if no log has such a window.
        """
        cumulative_usable = np.concatenate(([0], np.cumsum(self.usable)))
        start_rows = np.flatnonzero(self.trainable & (self.n_remaining >= length))
        n_usable = cumulative_usable[start_rows + length] - cumulative_usable[start_rows]
        start_rows = start_rows[n_usable >= min_usable_share * length]
        if start_rows.size == 0:
            raise DataError(
                f"no training log holds a window of {length} samples without a gap; shorten the"
                " horizon or give longer logs"
            )
        return start_rows

    def find_segment_starts(self, length: int, n_lead: int) -> np.ndarray:
        """Return the rows [S], `n_lead` samples after the start of a segment, of valid windows.

        Args:
            length: samples in a window.
            n_lead: samples between the start of the segment and the window.

        Raises:
            DataError: if no log has such a window.
        """
        rows = self.find_starts(length)
        start_rows: np.ndarray = rows[self.n_elapsed[rows] == n_lead]
        if start_rows.size == 0:
            raise DataError(
                f"no training log holds a window of {length} samples that starts {n_lead} samples"
                " after the start of a segment; shorten the window or remove `beginnings`"
            )
        return start_rows


def count_segment_samples(segments: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples up to the end of the segment, and those since its start, [N] each.

    Args:
        segments: segment number of each sample of each log, -1 outside of segments.
    """
    labels = np.concatenate(
        [
            np.where(segment >= 0, segment + _SEGMENTS_PER_LOG * log_index, -1)
            for log_index, segment in enumerate(segments)
        ]
    )
    starts, ends = find_run_bounds(labels)
    rows = np.arange(labels.size)
    return ends - rows, rows - starts


@dataclass(frozen=True)
class WindowStage:
    """Settings of the windows in one stage of a training.

    Attributes:
        n_window_samples: samples in a window.
        batch_size: windows in a batch.
        n_history: samples before a window that are provided with it; if the segment is shorter, its
            first sample is repeated.
        n_segment_start_windows: windows of a batch that begin near the start of a segment, as a
            free run does.
        n_lead: samples between the start of the segment and these windows; their history has the
            same length, at least one sample.
        columns: attributes of the store that the windows contain; others are empty.
    """

    n_window_samples: int
    batch_size: int
    n_history: int = 1
    n_segment_start_windows: int = 0
    n_lead: int = 0
    columns: Sequence[str] = WINDOW_COLUMNS

    def check(self, index: WindowIndex) -> None:
        """Check that the logs hold windows of this stage.

        Raises:
            DataError: if no log is long enough.
        """
        index.find_starts(self.n_window_samples)
        if self.n_segment_start_windows:
            index.find_segment_starts(self.n_window_samples, self.n_lead)
