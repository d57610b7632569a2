"""Training data for Lightning: batches that are drawn anew in every epoch, by its number alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import lightning as L
import torch
from torch import Tensor

from residnet.data.windows import COLUMNS, WindowStage, WindowStore


class EpochDataModule(L.LightningDataModule, ABC):
    """Batches that follow from the seed and the number of the epoch.

    A run resumed at the end of an epoch sees what an undisturbed one did, and so does every process
    of a training by several.

    Windows of logs and rows of tensors have theirs below; a policy that meets new conditions in
    every batch draws them in a subclass of its own.

    Args:
        epoch: returns the number of the present epoch; None asks the trainer.
    """

    def __init__(self, seed: int, epoch: Callable[[], int] | None = None) -> None:
        super().__init__()
        self.seed = seed
        self._epoch = epoch

    @property
    def epoch(self) -> int:
        """Number of the present epoch."""
        if self._epoch is not None:
            return self._epoch()
        return 0 if self.trainer is None else int(self.trainer.current_epoch)

    @property
    def share(self) -> tuple[int, int]:
        """Number of this process, and how many there are."""
        if self.trainer is None:
            return 0, 1
        return int(self.trainer.global_rank), int(self.trainer.world_size)

    @property
    @abstractmethod
    def steps(self) -> int:
        """Batches in an epoch."""

    @abstractmethod
    def batches(self, epoch: int) -> Iterator[Any]:
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
        return self.module.steps

    def __iter__(self) -> Iterator[Any]:
        return self.module.batches(self.module.epoch)


class Windows(NamedTuple):
    """Windows of measured logs, B of L samples.

    Attributes are those of `Prepared` [B, L, ...], positions from the start of the log, and:
        past_y: measured states before the window [B, H, 3 + n].
        past_w: inputs before it [B, H, m].
        depth: samples since the stretch began [B]; 0 where the window begins it.
        told: what a training adds of each sample [B, L, k].
    """

    y: Tensor
    smooth: Tensor
    nu_dot: Tensor
    w: Tensor
    recorded: Tensor
    usable: Tensor
    good: Tensor
    past_y: Tensor
    past_w: Tensor
    depth: Tensor
    told: Tensor


@final
class WindowsDataModule(EpochDataModule):
    """Training windows of measured logs, for any module that Lightning trains.

    A batch is a tuple of `Windows`: those from anywhere, then, where the stage asks for them, those
    that begin with a stretch. For example, with `prepared` logs and a module whose
    `training_step(self, batch, number)` takes such a tuple:

        data = WindowsDataModule.of(prepared, WindowStage(length=100, batch=256), steps=50)
        lightning.Trainer(max_epochs=20).fit(module, data)

    A training in stages gives one entry for each and says which stage an epoch belongs to.

    Args:
        stages: windows of each stage; None for a stage without epochs.
        stage: epoch -> number of its stage; None where there is one.
        epoch: as for `EpochDataModule`.

    Raises:
        DataError: where no log is long enough for a stage.
    """

    def __init__(
        self,
        store: WindowStore,
        stages: Sequence[WindowStage | None],
        steps: int,
        seed: int = 0,
        stage: Callable[[int], int] | None = None,
        epoch: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(seed, epoch)
        self.store = store
        self.stages = list(stages)
        self._steps, self._stage = steps, stage or (lambda epoch: 0)
        self._drawn = [one.sources(store, steps) if one else [] for one in self.stages]

    @classmethod
    def of(
        cls, logs: Sequence[Any], stage: WindowStage, steps: int, seed: int = 0
    ) -> WindowsDataModule:
        """Return the data module of one stage from prepared logs, in single precision."""
        return cls(WindowStore.gather(logs), [stage], steps, seed)

    @property
    def steps(self) -> int:
        return self._steps

    def batches(self, epoch: int) -> Iterator[tuple[Windows, ...]]:
        """Yield the batches of an epoch: of each source the windows of this process."""
        number = self._stage(epoch)
        stage, (rank, world) = self.stages[number], self.share
        assert stage is not None, "an epoch of a stage without windows"
        histories = (stage.history, max(stage.lead, 1))
        drawn = [source.epoch(self.seed, epoch)[:, rank::world] for source in self._drawn[number]]
        for rows in zip(*drawn, strict=True):
            yield tuple(
                self.windows(starts, stage.length, history, stage.columns)
                for starts, history in zip(rows, histories, strict=False)
            )

    def windows(
        self, starts: Tensor, length: int, history: int, columns: Sequence[str] = COLUMNS
    ) -> Windows:
        """Return the windows of `length` samples from rows [B] of the store on."""
        store = self.store
        taken = dict.fromkeys((*COLUMNS, "told"), store.y[:0]) | {
            name: store.take(getattr(store, name), starts, length) for name in columns
        }
        past_y, past_w = store.history(starts, history)
        return Windows(**taken, past_y=past_y, past_w=past_w, depth=store.depth[starts])


@final
class RowsDataModule(EpochDataModule):
    """Rows of tensors of one length, shuffled in every epoch; a batch is a tuple of their rows.

    Args:
        tensors: each [N, ...].
        batch: rows in a batch; the last batch of an epoch may have fewer.
        seed: of the order.
        epoch: as for `EpochDataModule`.
    """

    def __init__(
        self,
        tensors: Sequence[Tensor],
        batch: int,
        seed: int = 0,
        epoch: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(seed, epoch)
        self.tensors = tuple(tensors)
        self.batch = batch

    @property
    def steps(self) -> int:
        return -(-self.tensors[0].shape[0] // self.batch)

    def batches(self, epoch: int) -> Iterator[tuple[Tensor, ...]]:
        rank, world = self.share
        generator = torch.Generator().manual_seed(epoch_seed(self.seed, epoch))
        for rows in torch.randperm(len(self.tensors[0]), generator=generator).split(self.batch):
            yield tuple(values[rows[rank::world]] for values in self.tensors)


def epoch_seed(seed: int, epoch: int) -> int:
    """Return a seed of torch, below 2^63: resumed trainings shuffle as uninterrupted ones do."""
    return (seed * 7_919 + epoch) % (2**63)
