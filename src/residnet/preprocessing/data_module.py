"""Lightning data modules whose batches depend only on the seed and the number of the epoch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, final

import lightning as L
import torch
from torch import Tensor

from residnet.preprocessing.window_index import WINDOW_COLUMNS, WindowStage
from residnet.preprocessing.windows import WindowStore, make_samplers


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
        """Index of the current epoch, from 0; of the trainer if there is one."""
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
        """Number of batches of one epoch over all processes."""

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
        # a generator, because a resumed trainer makes the iterator before it restores the epoch
        yield from self.module.iterate_batches(self.module.current_epoch)


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
    regression_inputs: Tensor
    usable: Tensor
    trainable: Tensor
    past_y: Tensor
    past_w: Tensor
    n_elapsed: Tensor
    precomputed: Tensor


@final
class WindowsDataModule(EpochDataModule):
    """Training windows of measured logs for any Lightning module.

    A training batch is a tuple of `WindowBatch`: windows at any row, then, if the stage has them,
    windows near segment starts. Validation and test batches hold consecutive windows of these logs,
    each once. For example, with `data` from `residnet.prepare` and a module whose
    `training_step(self, batch, batch_index)` accepts such a tuple:

        windows = data.module(windows="10 s")
        lightning.Trainer(max_epochs=20).fit(module, windows)

    Args:
        store: samples of all logs.
        stages: settings of each stage; None for a stage without epochs.
        n_batches: number of batches per epoch.
        seed: seed of the random batches.
        get_stage: returns the stage index of an epoch; None for a single stage.
        get_epoch: see `EpochDataModule`.
        held_out: samples of the `validation` and `test` logs; a split that is missing has no
            batches.

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
        held_out: Mapping[str, WindowStore] | None = None,
    ) -> None:
        super().__init__(seed, get_epoch)
        self.held_out = dict(held_out or {})
        self.store = store
        self.stages = list(stages)
        self._n_batches = n_batches
        # a method, because spawned processes receive it pickled
        self._get_stage = get_stage or self._single_stage
        self._samplers = [
            make_samplers(stage_settings, store, n_batches) if stage_settings else []
            for stage_settings in self.stages
        ]

    def _single_stage(self, epoch: int) -> int:
        return 0

    @classmethod
    def from_splits(
        cls,
        splits: Mapping[str, Sequence[Any]],
        stage: WindowStage,
        n_batches: int,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> WindowsDataModule:
        """Create a data module with one stage from prepared logs by split.

        Args:
            splits: prepared logs of `train`, and of `validation` and `test` if there are any.
            stage: settings of the windows.
            n_batches: number of training batches per epoch.
            seed: seed of the random batches.
            dtype: floating-point type of the windows.
        """
        stores = {
            name: WindowStore.from_logs(logs, dtype) for name, logs in splits.items() if len(logs)
        }
        return cls(stores.pop("train"), [stage], n_batches, seed, held_out=stores)

    def val_dataloader(self) -> HeldOutBatches | list[Any]:
        """Return the consecutive windows of the validation logs; an empty list without any."""
        return self._held_out_batches("validation")

    def test_dataloader(self) -> HeldOutBatches | list[Any]:
        """Return the consecutive windows of the test logs; an empty list without any."""
        return self._held_out_batches("test")

    def _held_out_batches(self, split: str) -> HeldOutBatches | list[Any]:
        return HeldOutBatches(self, split) if split in self.held_out else []

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
        self,
        starts: Tensor,
        length: int,
        history: int,
        columns: Sequence[str] = WINDOW_COLUMNS,
        store: WindowStore | None = None,
    ) -> WindowBatch:
        """Return the windows that begin at given rows of the store.

        Args:
            starts: rows [B].
            length: samples in a window.
            history: samples before a window.
            columns: attributes of the store to include; others are empty.
            store: samples of the logs; None for the training logs.
        """
        store = self.store if store is None else store
        window_columns = dict.fromkeys((*WINDOW_COLUMNS, "precomputed"), store.y[:0]) | {
            name: store.take_windows(getattr(store, name), starts, length) for name in columns
        }
        past_y, past_w = store.take_history(starts, history)
        return WindowBatch(
            **window_columns, past_y=past_y, past_w=past_w, n_elapsed=store.n_elapsed[starts]
        )


@final
class HeldOutBatches:
    """Iterable over batches of consecutive windows of the validation or test logs.

    Windows do not overlap. In a distributed run each process receives a part of every batch; the
    last windows are repeated until all parts have the same size, as in `DistributedSampler`.

    Args:
        module: data module whose last stage determines length and number of windows of a batch.
        split: `validation` or `test`.

    Raises:
        DataError: if no log of the split holds a window.
    """

    def __init__(self, module: WindowsDataModule, split: str) -> None:
        stage = module.stages[-1]
        assert stage is not None, "the last stage of a training has epochs"
        self.module = module
        self.stage = stage
        self.store = module.held_out[split]
        possible_starts = self.store.find_starts(stage.n_window_samples)
        has_history = self.store.n_elapsed[possible_starts] >= stage.n_history
        if bool(has_history.any()):
            possible_starts = possible_starts[has_history]
        starts = []
        index = 0
        while index < len(possible_starts):
            starts.append(int(possible_starts[index]))
            index = int(torch.searchsorted(possible_starts, starts[-1] + stage.n_window_samples))
        self.starts = torch.tensor(starts)

    def __len__(self) -> int:
        return -(-len(self.starts) // self.stage.batch_size)

    def __iter__(self) -> Iterator[tuple[WindowBatch, ...]]:
        rank, world_size = self.module.rank_and_world_size
        for starts in self.starts.split(self.stage.batch_size):
            n_missing = -len(starts) % world_size
            padded = torch.cat((starts, starts[-1:].expand(n_missing)))
            batch = self.module.make_window_batch(
                padded[rank::world_size],
                self.stage.n_window_samples,
                self.stage.n_history,
                self.stage.columns,
                self.store,
            )
            yield (batch,)


@final
class RowsDataModule(EpochDataModule):
    """Shuffled rows of tensors; a batch is a tuple with the same rows of each tensor.

    Args:
        tensors: tensors with the same N rows, each [N, ...].
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
