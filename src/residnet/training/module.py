"""The Lightning module that trains one head: stages, losses, free-run validation."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.core.layout import POSE, VELOCITIES
from residnet.data.windows import WindowBatches, WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import MANY, FreeRun, Rollout, scripted
from residnet.training.config import TrainingConfig
from residnet.training.epochs import EpochTraining
from residnet.training.losses import one_step_loss, rollout_loss
from residnet.training.stage_windows import stage_windows, stages


class Score(NamedTuple):
    """How a model does in free runs over the validation logs; the lesser score is the better one.

    The error of windows that diverged says little, so that fewer of them count first.

    Attributes:
        diverged: number of windows that diverged.
        error: mean nrmse over u, v, r; a diverged window counts with the error of `zero`.
    """

    diverged: int
    error: float


Validate = Callable[[HybridDynamics], Score]


@final
class HeadTraining(EpochTraining):
    """A training of `model.head` that keeps the weights which validate best in free run."""

    def __init__(
        self,
        model: HybridDynamics,
        store: WindowStore,
        config: TrainingConfig,
        scales: Tensor,
        validate: Validate,
        seed: int,
    ) -> None:
        super().__init__(config, seed)
        self.model = model
        self.average = copy.deepcopy(model).requires_grad_(False) if config.average > 0 else None
        self.rollout = Rollout(model)
        self._compiled: FreeRun | None = None
        self.store = store
        self.scales = scales
        self.validate = validate
        self.batches = stage_windows(config, store, model.dt)
        self.rank, self.world = 0, 1

    def train_dataloader(self) -> EpochBatches:
        """Return window starts [batch], `steps` times an epoch."""
        return EpochBatches(self)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return AdamW, with weight decay on matrices of the head only."""
        head = list(self.model.head.parameters())
        groups = [
            {"params": [p for p in head if p.ndim > 1], "weight_decay": self.settings.weight_decay},
            {"params": [p for p in head if p.ndim <= 1], "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=1e-3)

    def on_fit_start(self) -> None:
        """Reset the losses; a model that is trained further is a candidate as it is."""
        super().on_fit_start()
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            self.rank, self.world = self.global_rank, torch.distributed.get_world_size()
        self.store, self.scales = self.store.to(self.device), self.scales.to(self.device)
        if self.settings.from_baseline and self.epoch == 0:
            self.validate_start()
            self.best_diverged = self.diverged

    def on_train_epoch_start(self) -> None:
        """Seed the epoch and set the stage's learning rate."""
        self.seed_epoch()
        stage, epoch = self.settings.stage(self.epoch)
        schedule = self.settings.one_step if stage == 0 else self.settings.multi_step[stage - 1]
        progress = 0.5 * (1 - math.cos(math.pi * epoch / max(schedule.epochs - 1, 1)))
        rate = schedule.learning_rate * (1 - progress * (1 - schedule.final))
        self.model.baseline.requires_grad_(False)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = rate

    def training_step(self, starts: Tensor, batch_index: int) -> Tensor:
        """Return the loss of one batch of windows."""
        stage, _ = self.settings.stage(self.epoch)
        length, _ = stages(self.settings, self.model.dt)[stage]
        loss = (
            self._one_step(starts, length)
            if stage == 0
            else self._multi_step(starts, length, self.batches[stage])
        )
        self._losses.append(float(self.shared(loss.detach())))
        return loss

    def shared(self, value: Tensor) -> Tensor:
        """Return the mean of a value over the processes of the training."""
        if self.world == 1:
            return value
        total = value.detach().clone()
        torch.distributed.all_reduce(total)
        return total / self.world

    def mine(self, sources: Sequence[WindowBatches]) -> tuple[Tensor, list[int]]:
        """Return the columns of a batch that this process takes, and how many of each source."""
        begins = [sum(one.batch for one in sources[:i]) for i in range(len(sources))]
        own = [
            torch.arange(begin + self.rank, begin + source.batch, self.world, device="cpu")
            for begin, source in zip(begins, sources, strict=True)
        ]
        return torch.cat(own), [len(part) for part in own]

    def _one_step(self, starts: Tensor, length: int) -> Tensor:
        take = self.store.take
        washout = torch.full_like(starts, round(self.settings.one_step.washout / self.model.dt))
        if self.settings.beginnings is not None:
            washout[self.store.depth[starts] == 0] = 0
        samples = torch.arange(length, device=starts.device)
        counted = take(self.store.good, starts, length) & (samples >= washout[:, None])
        y, w = take(self.store.smooth, starts, length), take(self.store.recorded, starts, length)
        spread = self.model.head.residual_std().to(y.dtype)
        return one_step_loss(
            self.model,
            y,
            w,
            take(self.store.nu_dot, starts, length),
            counted,
            spread,
            self.shared,
        )

    def _multi_step(self, starts: Tensor, length: int, sources: list[WindowBatches]) -> Tensor:
        take, dt = self.store.take, self.model.dt
        x0 = self.store.smooth[starts]
        beginnings = self.settings.beginnings
        columns, sizes = self.mine(sources)
        parts = starts.split(sizes)
        memories = [
            self.model.warmup(*self.store.history(parts[0], round(self.settings.history / dt)))
        ]
        if beginnings is not None:
            past, w_past = self.store.history(parts[1], max(round(beginnings.initial / dt), 1))
            memories.append(self.model.warmup(past, w_past))
            begun = torch.cat((x0[len(parts[0]) :, POSE], past[..., VELOCITIES].mean(1)), dim=1)
            x0 = torch.cat((x0[: len(parts[0])], begun))
        if self.settings.start_noise > 0:
            # drawn for the whole batch on the CPU: the same on every device, by any processes
            count = sum(source.batch for source in sources)
            drawn = torch.randn(count, 3, dtype=x0.dtype, device="cpu")[columns].to(x0.device)
            noise = self.settings.start_noise * self.scales * drawn
            x0 = torch.cat((x0[:, POSE], x0[:, VELOCITIES] + noise), dim=1)
        w, y = take(self.store.w, starts, length - 1), take(self.store.y, starts + 1, length - 1)
        usable = take(self.store.usable, starts + 1, length - 1)
        return rollout_loss(
            self._free_run(),
            x0,
            w,
            torch.cat(memories),
            y,
            usable,
            self.scales,
            self.settings.robust,
            self.shared,
        )

    def _free_run(self) -> FreeRun:
        """Return the free run of the model as the training has it now."""
        if self._compiled is None:
            # not before: by now the model is on its device and in training
            self._compiled = scripted(self.rollout, MANY)
        return self._compiled

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Move the averaged weights."""
        if self.average is None:
            return
        # a short memory at first, or the average would remember the untrained start
        decay = min(self.settings.average, (1.0 + self.global_step) / (10.0 + self.global_step))
        for kept, new in zip(self.average.parameters(), self.model.parameters(), strict=True):
            kept.lerp_(new.detach(), 1.0 - decay)

    def validated(self) -> tuple[nn.Module, float]:
        """Return the averaged model, where there is one, and its free-run error."""
        model = self.model if self.average is None else self.average
        self.diverged, error = self.validate(model)
        return model, error


class EpochBatches:
    """The batches of the module's present epoch."""

    def __init__(self, module: HeadTraining) -> None:
        self.module = module

    def __len__(self) -> int:
        return int(self.module.settings.steps)

    def __iter__(self) -> Iterator[Tensor]:
        epoch = self.module.epoch
        stage, _ = self.module.settings.stage(epoch)
        sources = self.module.batches[stage]
        drawn = [source.epoch(self.module.seed, epoch) for source in sources]
        return iter(torch.cat(drawn, dim=1)[:, self.module.mine(sources)[0]])
