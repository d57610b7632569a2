"""Training data for Lightning: batches that are drawn anew in every epoch, by its number alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import lightning as L
import torch
from torch import Tensor

from residnet.preprocessing.windows import WINDOW_COLUMNS, WindowStage, WindowStore


class EpochDataModule(L.LightningDataModule, ABC):
    """Batches that follow from the seed and the number of the epoch.

    A run resumed at the end of an epoch sees what an undisturbed one did, and so does every process
    of a training by several.

    Windows of logs and rows of tensors have theirs below; a policy that meets new conditions in
    every batch draws them in a subclass of its own.

    Args:
        get_epoch: returns the number of the present epoch; None asks the trainer.
    """

    def __init__(self, seed: int, get_epoch: Callable[[], int] | None = None) -> None:
        super().__init__()
        self.seed = seed
        self._get_epoch = get_epoch

    @property
    def current_epoch(self) -> int:
        """Number of the present epoch."""
        if self._get_epoch is not None:
            return self._get_epoch()
        return 0 if self.trainer is None else int(self.trainer.current_epoch)

    @property
    def rank_and_world_size(self) -> tuple[int, int]:
        """Number of this process, and how many there are."""
        if self.trainer is None:
            return 0, 1
        return int(self.trainer.global_rank), int(self.trainer.world_size)

    @property
    @abstractmethod
    def n_batches(self) -> int:
        """Batches in an epoch."""

    @abstractmethod
    def iterate_batches(self, epoch: int) -> Iterator[Any]:
        """Yield the batches of an epoch, those of this process."""

    def train_dataloader(self) -> EpochBatches:
        """Return the batches of the present epoch, each time that it is gone through."""
        return EpochBatches(self)


@final
class EpochBatches:
    """The batches of a data module's present epoch."""

    def __init__(self, module: EpochDataModule) -> None:
        self.module = module

    def __len__(self) -> int:
        return self.module.n_batches

    def __iter__(self) -> Iterator[Any]:
        return self.module.iterate_batches(self.module.current_epoch)


class WindowBatch(NamedTuple):
    """Windows of measured logs, B of L samples.

    Attributes are those of `Prepared` [B, L, ...], positions from the start of the log, and:
        past_y: measured states before the window [B, H, 3 + n].
        past_w: inputs before it [B, H, m].
        n_elapsed: samples since the stretch began [B]; 0 where the window begins it.
        precomputed: what a training adds of each sample [B, L, k].
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
    """Training windows of measured logs, for any module that Lightning trains.

    A batch is a tuple of `WindowBatch`: those from anywhere, then, where the stage asks for them, those
    that begin with a stretch. For example, with `prepared` logs and a module whose
    `training_step(self, batch, number)` takes such a tuple:

        data = WindowsDataModule.of(prepared, WindowStage(length=100, batch=256), steps=50)
        lightning.Trainer(max_epochs=20).fit(module, data)

    A training in stages gives one entry for each and says which stage an epoch belongs to.

    Args:
        stages: windows of each stage; None for a stage without epochs.
        get_stage: epoch -> number of its stage; None where there is one.
        get_epoch: as for `EpochDataModule`.

    Raises:
        DataError: where no log is long enough for a stage.
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
        self._n_batches, self._get_stage = n_batches, get_stage or (lambda epoch: 0)
        self._samplers = [
            stage_settings.make_samplers(store, n_batches) if stage_settings else []
            for stage_settings in self.stages
        ]

    @classmethod
    def from_logs(
        cls, logs: Sequence[Any], stage: WindowStage, n_batches: int, seed: int = 0
    ) -> WindowsDataModule:
        """Return the data module of one stage from prepared logs, in single precision."""
        return cls(WindowStore.from_logs(logs), [stage], n_batches, seed)

    @property
    def n_batches(self) -> int:
        return self._n_batches

    def iterate_batches(self, epoch: int) -> Iterator[tuple[WindowBatch, ...]]:
        """Yield the batches of an epoch: of each source the windows of this process."""
        stage_index = self._get_stage(epoch)
        stage, (rank, world_size) = self.stages[stage_index], self.rank_and_world_size
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
        """Return the windows of `length` samples from rows [B] of the store on."""
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
    """Rows of tensors of one length, shuffled in every epoch; a batch is a tuple of their rows.

    Args:
        tensors: each [N, ...].
        batch_size: rows in a batch; the last batch of an epoch may have fewer.
        seed: of the order.
        get_epoch: as for `EpochDataModule`.
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
    """Return a seed of torch, below 2^63: resumed trainings shuffle as uninterrupted ones do."""
    return (seed * 7_919 + epoch) % (2**63)
