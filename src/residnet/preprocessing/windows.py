"""Training windows as batches of indices over one tensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.errors import DataError
from residnet.core.layout import POSITION
from residnet.core.stretches import find_run_bounds
from residnet.preprocessing.prepare import PreparedLog


@dataclass(frozen=True)
class WindowStore:
    """All logs end to end, N samples.

    Attributes are those of `Prepared`, positions from the start of each log, and:
        n_remaining: samples from here to the end of the stretch, itself included, [N]; 0 where
            there is none.
        n_elapsed: samples since the stretch began, [N].
        log_index: number of the log, in the order gathered, [N].
        precomputed: what a training adds of each sample [N, k]; None where it adds nothing.
    """

    y: Tensor
    smoothed: Tensor
    nu_dot: Tensor
    w: Tensor
    rate_inputs: Tensor
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

        Positions are counted from each log's start so that float32 keeps them exact enough.
        """
        lengths = [len(log) for log in logs]
        n_samples = sum(lengths)
        segment_labels = np.empty(n_samples, dtype=np.int64)
        columns: dict[str, Tensor] = {}
        for name in WINDOW_COLUMNS:
            first_values: np.ndarray = getattr(logs[0], name)
            column_dtype = torch.bool if first_values.dtype == bool else dtype
            columns[name] = paged.allocate_rows(
                n_samples, *first_values.shape[1:], dtype=column_dtype
            )
        row_start = 0
        for log_index, (log, length) in enumerate(zip(logs, lengths, strict=True)):
            row_slice = slice(row_start, row_start + length)
            origin = np.zeros_like(log.y[0])
            origin[POSITION] = log.y[0, POSITION]
            for name, values in columns.items():
                values_of_log = (
                    getattr(log, name) - origin if name in ("y", "smoothed") else getattr(log, name)
                )
                values[row_slice] = torch.from_numpy(np.nan_to_num(values_of_log)).to(values.dtype)
            segment_labels[row_slice] = np.where(
                log.segment >= 0, log.segment + 1_000_000 * log_index, -1
            )
            row_start += length
            paged.release_pages()
        segment_starts, segment_ends = find_run_bounds(segment_labels)
        return cls(
            **columns,
            n_remaining=torch.from_numpy(segment_ends - np.arange(n_samples)),
            n_elapsed=torch.from_numpy(np.arange(n_samples) - segment_starts),
            log_index=torch.from_numpy(np.repeat(np.arange(len(logs)), lengths)),
        )

    def coarsen(self, stride: int, angle_columns: Sequence[int] = ()) -> WindowStore:
        """Return the same logs in steps so many times as long: once for each sample to begin with.

        States are sampled; inputs over a long step are the mean of those over its short ones.

        Args:
            angle_columns: columns of w that are angles, whose means keep to the circle.
        """
        if stride == 1:
            return self
        row_order = torch.cat([torch.arange(k, len(self.y), stride) for k in range(stride)])

        def average_over_step(values: Tensor) -> Tensor:
            # the last samples of all have no step behind them
            padded = torch.cat((values, values[-1:].expand(stride - 1, -1)))
            step_values = padded.unfold(0, stride, 1)
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
                "rate_inputs": average_over_step(self.rate_inputs),
                "n_remaining": (self.n_remaining[row_order] + stride - 1) // stride,
                "n_elapsed": self.n_elapsed[row_order] // stride,
            },
        )

    def find_starts(self, length: int, min_usable_share: float = 0.5) -> Tensor:
        """Return the rows at which a window of `n_window_samples` samples may start.

        It lies within one stretch, its first sample is good, and at least `min_usable_share` of all
        are usable.
        """
        cumulative_usable = torch.nn.functional.pad(self.usable.cumsum(0), (1, 0))
        is_long_enough = self.trainable & (self.n_remaining >= length)
        start_rows = torch.nonzero(is_long_enough).squeeze(1)
        start_rows = start_rows[
            (cumulative_usable[start_rows + length] - cumulative_usable[start_rows])
            >= min_usable_share * length
        ]
        if start_rows.numel() == 0:
            raise DataError(
                f"no training log holds a window of {length} samples without a break; shorten the"
                " horizon or give longer logs"
            )
        return start_rows

    def find_segment_starts(self, length: int, n_lead: int) -> Tensor:
        """Return the rows `n_lead` samples after a stretch's beginning where a window may start."""
        start_rows = self.find_starts(length)
        start_rows = start_rows[self.n_elapsed[start_rows] == n_lead]
        if start_rows.numel() == 0:
            raise DataError(
                f"no training log holds a window of {length} samples from {n_lead} samples after"
                " its beginning on; shorten it or leave out `find_segment_starts`"
            )
        return start_rows

    def take_windows(self, values: Tensor, starts: Tensor, length: int) -> Tensor:
        """Return the windows [B, length, ...] of one of the tensors, from rows `find_starts` [B] on."""
        # all windows that there are, which lie in one another
        view_shape = (len(values) - length + 1, length, *values.shape[1:])
        return values.as_strided(view_shape, (values.stride(0), *values.stride()))[starts]

    def take_history(self, starts: Tensor, length: int) -> tuple[Tensor, Tensor]:
        """Return the measured states and inputs of the `n_window_samples` samples before each start.

        Where the stretch is shorter, its first sample is repeated.
        """
        offsets = torch.arange(-length, 0, device=starts.device)
        row_indices = starts[:, None] + torch.maximum(offsets, -self.n_elapsed[starts][:, None])
        flat_rows = row_indices.reshape(-1)
        window_shape = (starts.numel(), length)
        return self.y.index_select(0, flat_rows).unflatten(0, window_shape), self.w.index_select(
            0, flat_rows
        ).unflatten(0, window_shape)


class WindowSampler:
    """Random batches of window starts, the same for the same seed, stage and epoch.

    A resumed run sees what an undisturbed one did.
    """

    def __init__(self, starts: Tensor, batch_size: int, n_batches: int) -> None:
        self.starts = starts
        self.batch_size = batch_size
        self.n_batches = n_batches

    def draw_epoch(self, seed: int, epoch: int) -> Tensor:
        """Return the starts [steps, batch] of one epoch, drawn without replacement."""
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


WINDOW_COLUMNS = ("y", "smoothed", "nu_dot", "w", "rate_inputs", "usable", "trainable")
"""What the windows of a log hold of each sample."""


@dataclass(frozen=True)
class WindowStage:
    """The windows of one stage of a training.

    Attributes:
        n_window_samples: samples in a window.
        batch_size: windows in a batch.
        n_history: samples before a window that come with it; where the stretch is shorter, its
            first is repeated.
        n_segment_start_windows: how many of the batch begin near the start of a stretch, as a free
            run does.
        n_lead: how many samples after it these begin; their history is as long, and at least one.
        columns: of the store that its windows hold, the others are left empty.
    """

    n_window_samples: int
    batch_size: int
    n_history: int = 1
    n_segment_start_windows: int = 0
    n_lead: int = 0
    columns: Sequence[str] = WINDOW_COLUMNS

    def make_samplers(self, store: WindowStore, n_batches: int) -> list[WindowSampler]:
        """Return where the windows of `steps` batches come from: anywhere, then beginnings.

        Raises:
            DataError: where no log is long enough.
        """
        samplers = [
            WindowSampler(
                store.find_starts(self.n_window_samples),
                self.batch_size - self.n_segment_start_windows,
                n_batches,
            )
        ]
        if self.n_segment_start_windows:
            segment_start_rows = store.find_segment_starts(self.n_window_samples, self.n_lead)
            samplers.append(
                WindowSampler(segment_start_rows, self.n_segment_start_windows, n_batches)
            )
        return samplers
