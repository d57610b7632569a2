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
from residnet.core.stretches import stretch_bounds
from residnet.data.prepare import Prepared


@dataclass(frozen=True)
class WindowStore:
    """All logs end to end, N samples.

    Attributes are those of `Prepared`, positions from the start of each log, and:
        reach: samples from here to the end of the stretch, itself included, [N]; 0 where there is
            none.
        depth: samples since the stretch began, [N].
        log: number of the log, in the order gathered, [N].
        told: what a training adds of each sample [N, k]; None where it adds nothing.
    """

    y: Tensor
    smooth: Tensor
    nu_dot: Tensor
    w: Tensor
    recorded: Tensor
    usable: Tensor
    good: Tensor
    reach: Tensor
    depth: Tensor
    log: Tensor
    told: Tensor | None = None

    @classmethod
    def gather(cls, logs: Sequence[Prepared], dtype: torch.dtype = torch.float32) -> WindowStore:
        """Build the store from prepared logs.

        Positions are counted from each log's start so that float32 keeps them exact enough.
        """
        lengths = [len(p) for p in logs]
        total = sum(lengths)
        labels = np.empty(total, dtype=np.int64)
        whole: dict[str, Tensor] = {}
        for name in COLUMNS:
            first: np.ndarray = getattr(logs[0], name)
            kind = torch.bool if first.dtype == bool else dtype
            whole[name] = paged.rows(total, *first.shape[1:], dtype=kind)
        begin = 0
        for number, (p, length) in enumerate(zip(logs, lengths, strict=True)):
            rows = slice(begin, begin + length)
            start = np.zeros_like(p.y[0])
            start[POSITION] = p.y[0, POSITION]
            for name, values in whole.items():
                part = getattr(p, name) - start if name in ("y", "smooth") else getattr(p, name)
                values[rows] = torch.from_numpy(np.nan_to_num(part)).to(values.dtype)
            labels[rows] = np.where(p.piece >= 0, p.piece + 1_000_000 * number, -1)
            begin += length
            paged.forget()
        begins, ends = stretch_bounds(labels)
        told = {"reach": ends - np.arange(total), "depth": np.arange(total) - begins}
        told |= {"log": np.repeat(np.arange(len(logs)), lengths)}
        return cls(**whole, **{name: torch.from_numpy(values) for name, values in told.items()})

    def coarse(self, steps: int, turning: Sequence[int] = ()) -> WindowStore:
        """Return the same logs in steps so many times as long: once for each sample to begin with.

        States are sampled; inputs over a long step are the mean of those over its short ones.

        Args:
            turning: columns of w that are angles, whose means keep to the circle.
        """
        if steps == 1:
            return self
        order = torch.cat([torch.arange(k, len(self.y), steps) for k in range(steps)])

        def averaged(values: Tensor) -> Tensor:
            # the last samples of all have no step behind them
            padded = torch.cat((values, values[-1:].expand(steps - 1, -1)))
            blocks = padded.unfold(0, steps, 1)
            apart = blocks - blocks[..., :1]
            for column in turning:
                apart[:, column] = torch.remainder(apart[:, column] + torch.pi, 2 * torch.pi)
                apart[:, column] -= torch.pi
            return (blocks[..., 0] + apart.mean(-1))[order]

        rest = {
            part.name: getattr(self, part.name)[order]
            for part in fields(self)
            if part.name != "told"
        }
        return replace(
            self,
            **rest
            | {
                "w": averaged(self.w),
                "recorded": averaged(self.recorded),
                "reach": (self.reach[order] + steps - 1) // steps,
                "depth": self.depth[order] // steps,
            },
        )

    def starts(self, length: int, share: float = 0.5) -> Tensor:
        """Return the rows at which a window of `length` samples may start.

        It lies within one stretch, its first sample is good, and at least `share` of all are
        usable.
        """
        total = torch.nn.functional.pad(self.usable.cumsum(0), (1, 0))
        fits = self.good & (self.reach >= length)
        rows = torch.nonzero(fits).squeeze(1)
        rows = rows[(total[rows + length] - total[rows]) >= share * length]
        if rows.numel() == 0:
            raise DataError(
                f"no training log holds a window of {length} samples without a break; shorten the"
                " horizon or give longer logs"
            )
        return rows

    def beginnings(self, length: int, lead: int) -> Tensor:
        """Return the rows `lead` samples after a stretch's beginning where a window may start."""
        rows = self.starts(length)
        rows = rows[self.depth[rows] == lead]
        if rows.numel() == 0:
            raise DataError(
                f"no training log holds a window of {length} samples from {lead} samples after its"
                " beginning on; shorten it or leave out `beginnings`"
            )
        return rows

    def take(self, values: Tensor, starts: Tensor, length: int) -> Tensor:
        """Return the windows [B, length, ...] of one of the tensors, from rows `starts` [B] on."""
        # all windows that there are, which lie in one another
        shape = (len(values) - length + 1, length, *values.shape[1:])
        return values.as_strided(shape, (values.stride(0), *values.stride()))[starts]

    def history(self, starts: Tensor, length: int) -> tuple[Tensor, Tensor]:
        """Return the measured states and inputs of the `length` samples before each start.

        Where the stretch is shorter, its first sample is repeated.
        """
        back = torch.arange(-length, 0, device=starts.device)
        index = starts[:, None] + torch.maximum(back, -self.depth[starts][:, None])
        rows = index.reshape(-1)
        shape = (starts.numel(), length)
        return self.y.index_select(0, rows).unflatten(0, shape), self.w.index_select(
            0, rows
        ).unflatten(0, shape)


class WindowBatches:
    """Random batches of window starts, the same for the same seed, stage and epoch.

    A resumed run sees what an undisturbed one did.
    """

    def __init__(self, starts: Tensor, batch: int, steps: int) -> None:
        self.starts = starts
        self.batch = batch
        self.steps = steps

    def epoch(self, seed: int, epoch: int) -> Tensor:
        """Return the starts [steps, batch] of one epoch, drawn without replacement."""
        generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % (2**63))
        need = self.batch * self.steps
        rounds = -(-need // self.starts.numel())
        order = torch.cat(
            [torch.randperm(self.starts.numel(), generator=generator) for _ in range(rounds)]
        )[:need]
        return self.starts[order].reshape(self.steps, self.batch)


COLUMNS = ("y", "smooth", "nu_dot", "w", "recorded", "usable", "good")
"""What the windows of a log hold of each sample."""


@dataclass(frozen=True)
class WindowStage:
    """The windows of one stage of a training.

    Attributes:
        length: samples in a window.
        batch: windows in a batch.
        history: samples before a window that come with it; where the stretch is shorter, its first
            is repeated.
        begun: how many of the batch begin near the start of a stretch, as a free run does.
        lead: how many samples after it these begin; their history is as long, and at least one.
        columns: of the store that its windows hold, the others are left empty.
    """

    length: int
    batch: int
    history: int = 1
    begun: int = 0
    lead: int = 0
    columns: Sequence[str] = COLUMNS

    def sources(self, store: WindowStore, steps: int) -> list[WindowBatches]:
        """Return where the windows of `steps` batches come from: anywhere, then beginnings.

        Raises:
            DataError: where no log is long enough.
        """
        out = [WindowBatches(store.starts(self.length), self.batch - self.begun, steps)]
        if self.begun:
            begins = store.beginnings(self.length, self.lead)
            out.append(WindowBatches(begins, self.begun, steps))
        return out
