"""Training windows as indices into one tensor of all logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.layout import POSITION
from residnet.preprocessing.prepare import PreparedLog
from residnet.preprocessing.window_index import (
    WINDOW_COLUMNS,
    WindowIndex,
    WindowStage,
    count_segment_samples,
)


@dataclass(frozen=True)
class WindowStore:
    """Concatenated samples of all logs, N in total.

    Attributes:
        y: measured pose and velocities [N, 3 + n] in SI units; positions are relative to the start
            of the log.
        smoothed: the same with smoothed velocities [N, 3 + n].
        nu_dot: accelerations [N, n].
        w: inputs that act during the step after the sample [N, m].
        regression_inputs: inputs that are paired with the accelerations [N, m].
        usable: whether errors at the sample count [N] bool.
        trainable: whether the sample may be used for training [N] bool.
        n_remaining: samples up to the end of the segment, including this one [N]; 0 outside of
            segments.
        n_elapsed: samples since the start of the segment [N].
        log_index: index of the log [N].
        precomputed: quantities that a training computes once for all samples [N, k], for example
            the accelerations of the baseline; None without them.
    """

    y: Tensor
    smoothed: Tensor
    nu_dot: Tensor
    w: Tensor
    regression_inputs: Tensor
    usable: Tensor
    trainable: Tensor
    n_remaining: Tensor
    n_elapsed: Tensor
    log_index: Tensor
    precomputed: Tensor | None = None

    @classmethod
    def from_logs(
        cls, logs: Sequence[PreparedLog], dtype: torch.dtype = torch.float32
    ) -> WindowStore:
        """Build the store from prepared logs.

        Positions are relative to the start of each log, to keep their precision in float32.
        """
        lengths = [len(log) for log in logs]
        n_samples = sum(lengths)
        columns: dict[str, Tensor] = {}
        for name in WINDOW_COLUMNS:
            first_values: np.ndarray = getattr(logs[0], name)
            column_dtype = torch.bool if first_values.dtype == bool else dtype
            columns[name] = paged.allocate_rows(
                n_samples, *first_values.shape[1:], dtype=column_dtype
            )
        row_start = 0
        for log, length in zip(logs, lengths, strict=True):
            row_slice = slice(row_start, row_start + length)
            origin = np.zeros_like(log.y[0])
            origin[POSITION] = log.y[0, POSITION]
            for name, values in columns.items():
                values_of_log = (
                    getattr(log, name) - origin if name in ("y", "smoothed") else getattr(log, name)
                )
                values[row_slice] = torch.from_numpy(np.nan_to_num(values_of_log)).to(values.dtype)
            row_start += length
            # frees the memory of logs that are stored in files
            paged.release_pages()
        n_remaining, n_elapsed = count_segment_samples([log.segment for log in logs])
        return cls(
            **columns,
            n_remaining=torch.from_numpy(n_remaining),
            n_elapsed=torch.from_numpy(n_elapsed),
            log_index=torch.from_numpy(np.repeat(np.arange(len(logs)), lengths)),
        )

    def coarsen(self, stride: int, angle_columns: Sequence[int] = ()) -> WindowStore:
        """Return the logs with a time step that is `stride` times as long.

        Each log is subsampled `stride` times, from each of its first `stride` samples on, so that
        no sample is lost. The input over a long step is the mean over its short steps.

        Args:
            stride: number of short steps in a long step.
            angle_columns: columns of w with angles, which are averaged on the circle.
        """
        if stride == 1:
            return self
        row_order = torch.cat([torch.arange(k, len(self.y), stride) for k in range(stride)])

        def average_over_step(values: Tensor) -> Tensor:
            # the last samples have no following step; their last value is repeated
            padded = torch.cat((values, values[-1:].expand(stride - 1, -1)))
            step_values = padded.unfold(0, stride, 1)
            # the mean of differences to the first value is also correct for angles that wrap
            differences = step_values - step_values[..., :1]
            for column in angle_columns:
                differences[:, column] = torch.remainder(
                    differences[:, column] + torch.pi, 2 * torch.pi
                )
                differences[:, column] -= torch.pi
            return (step_values[..., 0] + differences.mean(-1))[row_order]

        sampled_columns = {
            field_.name: getattr(self, field_.name)[row_order]
            for field_ in fields(self)
            if field_.name != "precomputed"
        }
        return replace(
            self,
            **sampled_columns
            | {
                "w": average_over_step(self.w),
                "regression_inputs": average_over_step(self.regression_inputs),
                "n_remaining": (self.n_remaining[row_order] + stride - 1) // stride,
                "n_elapsed": self.n_elapsed[row_order] // stride,
            },
        )

    @property
    def index(self) -> WindowIndex:
        """The samples at which windows may start."""
        return WindowIndex(
            self.usable.numpy(),
            self.trainable.numpy(),
            self.n_remaining.numpy(),
            self.n_elapsed.numpy(),
        )

    def find_starts(self, length: int, min_usable_share: float = 0.5) -> Tensor:
        """Return the rows [S] at which a window may start; see `WindowIndex.find_starts`."""
        return torch.from_numpy(self.index.find_starts(length, min_usable_share))

    def find_segment_starts(self, length: int, n_lead: int) -> Tensor:
        """Return the rows [S] of windows `n_lead` samples after the start of a segment."""
        return torch.from_numpy(self.index.find_segment_starts(length, n_lead))

    def take_windows(self, values: Tensor, starts: Tensor, length: int) -> Tensor:
        """Return windows [B, length, ...] of a tensor [N, ...] that begin at rows `starts` [B]."""
        # a strided view of all overlapping windows, without a copy
        view_shape = (len(values) - length + 1, length, *values.shape[1:])
        return values.as_strided(view_shape, (values.stride(0), *values.stride()))[starts]

    def take_history(self, starts: Tensor, length: int) -> tuple[Tensor, Tensor]:
        """Return the measured states and inputs of the `length` samples before each start.

        If the segment is shorter, its first sample is repeated.

        Args:
            starts: rows [B].
            length: number of samples H.

        Returns:
            States [B, H, 3 + n] and inputs [B, H, m].
        """
        offsets = torch.arange(-length, 0, device=starts.device)
        row_indices = starts[:, None] + torch.maximum(offsets, -self.n_elapsed[starts][:, None])
        flat_rows = row_indices.reshape(-1)
        window_shape = (starts.numel(), length)
        past_y = self.y.index_select(0, flat_rows).unflatten(0, window_shape)
        past_w = self.w.index_select(0, flat_rows).unflatten(0, window_shape)
        return past_y, past_w


class WindowSampler:
    """Random batches of window starts, reproducible by seed and epoch.

    A resumed run draws the same batches as an uninterrupted one.
    """

    def __init__(self, starts: Tensor, batch_size: int, n_batches: int) -> None:
        self.starts = starts
        self.batch_size = batch_size
        self.n_batches = n_batches

    def draw_epoch(self, seed: int, epoch: int) -> Tensor:
        """Return the starts [n_batches, batch_size] of one epoch, drawn without replacement."""
        # a generator of its own: batches do not depend on other random numbers of the process
        generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % (2**63))
        n_starts = self.batch_size * self.n_batches
        n_permutations = -(-n_starts // self.starts.numel())
        shuffled_indices = torch.cat(
            [
                torch.randperm(self.starts.numel(), generator=generator)
                for _ in range(n_permutations)
            ]
        )[:n_starts]
        return self.starts[shuffled_indices].reshape(self.n_batches, self.batch_size)


def make_samplers(stage: WindowStage, store: WindowStore, n_batches: int) -> list[WindowSampler]:
    """Create the samplers of windows at any row and of windows near segment starts.

    Args:
        stage: settings of the windows.
        store: samples of all logs.
        n_batches: number of batches per epoch.

    Raises:
        DataError: if no log is long enough.
    """
    samplers = [
        WindowSampler(
            store.find_starts(stage.n_window_samples),
            stage.batch_size - stage.n_segment_start_windows,
            n_batches,
        )
    ]
    if stage.n_segment_start_windows:
        segment_start_rows = store.find_segment_starts(stage.n_window_samples, stage.n_lead)
        samplers.append(WindowSampler(segment_start_rows, stage.n_segment_start_windows, n_batches))
    return samplers
