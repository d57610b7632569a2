"""Lightning data modules whose batches depend only on the seed and the number of the epoch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import lightning as L
import torch
from torch import Tensor

from residnet.preprocessing.windows import WINDOW_COLUMNS, WindowStage, WindowStore


class EpochDataModule(L.LightningDataModule, ABC):
    """Base class of data modules with batches that depend only on seed and epoch.

    A run that is resumed at the end of an epoch receives the same batches as an uninterrupted one,
    and all processes of a distributed training agree.

    Args:
        seed: seed of the random batches.
        get_epoch: returns the number of the current epoch; None takes it from the trainer.
    """

    def __init__(self, seed: int, get_epoch: Callable[[], int] | None = None) -> None:
        super().__init__()
        self.seed = seed
        self._get_epoch = get_epoch

    @property
    def current_epoch(self) -> int:
        """Number of the current epoch."""
        if self._get_epoch is not None:
            return self._get_epoch()
        return 0 if self.trainer is None else int(self.trainer.current_epoch)

    @property
    def rank_and_world_size(self) -> tuple[int, int]:
        """Rank of this process and number of processes."""
        if self.trainer is None:
            return 0, 1
        return int(self.trainer.global_rank), int(self.trainer.world_size)

    @property
    @abstractmethod
    def n_batches(self) -> int:
        """Number of batches in an epoch."""

    @abstractmethod
    def iterate_batches(self, epoch: int) -> Iterator[Any]:
        """Yield the batches of an epoch for this process."""

    def train_dataloader(self) -> EpochBatches:
        """Return an iterable over the batches of the current epoch."""
        return EpochBatches(self)


@final
class EpochBatches:
    """Iterable over the batches of the current epoch of a data module."""

    def __init__(self, module: EpochDataModule) -> None:
        self.module = module

    def __len__(self) -> int:
        return self.module.n_batches

    def __iter__(self) -> Iterator[Any]:
        return self.module.iterate_batches(self.module.current_epoch)


class WindowBatch(NamedTuple):
    """Batch of B windows of L samples.

    The other attributes are described in `PreparedLog` [B, L, ...], with positions relative
    to the start of the log.

    Attributes:
        past_y: measured states before the window [B, H, 3 + n].
        past_w: inputs before the window [B, H, m].
        n_elapsed: samples between the start of the segment and the window [B].
        precomputed: additional columns of a training [B, L, k].
    """

    y: Tensor
    smoothed: Tensor
    nu_dot: Tensor
    w: Tensor
    rate_inputs: Tensor
    usable: Tensor
    trainable: Tensor
    past_y: Tensor
    past_w: Tensor
    n_elapsed: Tensor
    precomputed: Tensor


@final
class WindowsDataModule(EpochDataModule):
    """Training windows of measured logs for any Lightning module.

    A batch is a tuple of `WindowBatch`: windows at any row, then, if the stage has them, windows
    near segment starts. For example, with `prepared` logs and a module whose
    `training_step(self, batch, batch_index)` accepts such a tuple:

        stage = WindowStage(n_window_samples=100, batch_size=256)
        data = WindowsDataModule.from_logs(prepared, stage, n_batches=50)
        lightning.Trainer(max_epochs=20).fit(module, data)

    Args:
        store: samples of all logs.
        stages: settings of each stage; None for a stage without epochs.
        n_batches: number of batches per epoch.
        seed: seed of the random batches.
        get_stage: returns the stage index of an epoch; None for a single stage.
        get_epoch: see `EpochDataModule`.

    Raises:
        DataError: if no log is long enough for a stage.
    """

    def __init__(
        self,
        store: WindowStore,
        stages: Sequence[WindowStage | None],
        n_batches: int,
        seed: int = 0,
        get_stage: Callable[[int], int] | None = None,
        get_epoch: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(seed, get_epoch)
        self.store = store
        self.stages = list(stages)
        self._n_batches = n_batches
        self._get_stage = get_stage or (lambda epoch: 0)
        self._samplers = [
            stage_settings.make_samplers(store, n_batches) if stage_settings else []
            for stage_settings in self.stages
        ]

    @classmethod
    def from_logs(
        cls, logs: Sequence[Any], stage: WindowStage, n_batches: int, seed: int = 0
    ) -> WindowsDataModule:
        """Create a data module with one stage from prepared logs, in single precision."""
        return cls(WindowStore.from_logs(logs), [stage], n_batches, seed)

    @property
    def n_batches(self) -> int:
        return self._n_batches

    def iterate_batches(self, epoch: int) -> Iterator[tuple[WindowBatch, ...]]:
        """Yield the batches of an epoch for this process."""
        stage_index = self._get_stage(epoch)
        stage = self.stages[stage_index]
        rank, world_size = self.rank_and_world_size
        assert stage is not None, "an epoch of a stage without windows"
        histories = (stage.n_history, max(stage.n_lead, 1))
        starts_by_source = [
            sampler.draw_epoch(self.seed, epoch)[:, rank::world_size]
            for sampler in self._samplers[stage_index]
        ]
        for starts_of_batch in zip(*starts_by_source, strict=True):
            yield tuple(
                self.make_window_batch(starts, stage.n_window_samples, history, stage.columns)
                for starts, history in zip(starts_of_batch, histories, strict=False)
            )

    def make_window_batch(
        self, starts: Tensor, length: int, history: int, columns: Sequence[str] = WINDOW_COLUMNS
    ) -> WindowBatch:
        """Return the windows that begin at given rows of the store.

        Args:
            starts: rows [B].
            length: samples in a window.
            history: samples before a window.
            columns: attributes of the store to include; others are empty.
        """
        store = self.store
        window_columns = dict.fromkeys((*WINDOW_COLUMNS, "precomputed"), store.y[:0]) | {
            name: store.take_windows(getattr(store, name), starts, length) for name in columns
        }
        past_y, past_w = store.take_history(starts, history)
        return WindowBatch(
            **window_columns, past_y=past_y, past_w=past_w, n_elapsed=store.n_elapsed[starts]
        )


@final
class RowsDataModule(EpochDataModule):
    """Shuffled rows of tensors; a batch is a tuple with the same rows of each tensor.

    Args:
        tensors: each [N, ...].
        batch_size: rows in a batch; the last batch of an epoch may be smaller.
        seed: seed of the order.
        get_epoch: see `EpochDataModule`.
    """

    def __init__(
        self,
        tensors: Sequence[Tensor],
        batch_size: int,
        seed: int = 0,
        get_epoch: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(seed, get_epoch)
        self.tensors = tuple(tensors)
        self.batch_size = batch_size

    @property
    def n_batches(self) -> int:
        return -(-self.tensors[0].shape[0] // self.batch_size)

    def iterate_batches(self, epoch: int) -> Iterator[tuple[Tensor, ...]]:
        rank, world_size = self.rank_and_world_size
        generator = torch.Generator().manual_seed(compute_epoch_seed(self.seed, epoch))
        for row_indices in torch.randperm(len(self.tensors[0]), generator=generator).split(
            self.batch_size
        ):
            yield tuple(values[row_indices[rank::world_size]] for values in self.tensors)


def compute_epoch_seed(seed: int, epoch: int) -> int:
    """Return a seed below 2^63 for an epoch, so that resumed trainings use the same order."""
    return (seed * 7_919 + epoch) % (2**63)
