"""Training of heads: windows of logs, one-step and free-run losses, validation in free run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.baselines.given import FixedBaseline
from residnet.core.arrays import paged
from residnet.core.columns import all_but_pose, dynamic_states, pose
from residnet.core.samples import Samples
from residnet.dynamics.base import Integrator
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import TRAINING_STEPS, FreeRun, Rollout
from residnet.heads.recurrent import GRUEnsembleHead
from residnet.physics.signals import Signals
from residnet.physics.symmetry import get_axis_parities, mirror_channels
from residnet.preprocessing.data_module import WindowBatch, WindowsDataModule
from residnet.preprocessing.windows import WindowStore
from residnet.training.config import TrainingConfig
from residnet.training.score import Score
from residnet.training.trainer import EpochTraining, run_epochs

Shared = Callable[[Tensor], Tensor]
"""A sum over this process's windows to the mean of the sums of all processes."""


def alone(value: Tensor) -> Tensor:
    """Return the mean over one process: the value itself."""
    return value


def one_step_loss(
    model: HybridDynamics,
    z: Tensor,
    known: Tensor,
    nu_dot: Tensor,
    good: Tensor,
    spread: Tensor,
    shared: Shared = alone,
) -> Tensor:
    """Return the mean squared error of accelerations along windows (document 003 eq. (20)).

    In units of the residual's spread.

    Args:
        model: the hybrid model.
        z: channels of smoothed states and the inputs at the same samples [B, T, nz].
        known: what its baseline says there [B, T, n].
        nu_dot: accelerations [B, T, n].
        good: samples that count: acceleration known, memory filled [B, T].
        spread: of the residual, [n].
        shared: over the processes of a training, whose mean loss is that of all windows.
    """
    error = (nu_dot - model.teacher_forced_accelerations(z, known)) / spread
    weight = good.to(error.dtype).unsqueeze(-1)
    count = float(error.shape[-1])
    return (error.square() * weight).sum() / shared(count * weight.sum()).clamp(min=1.0)


def rollout_loss(
    rollout: FreeRun,
    x0: Tensor,
    w: Tensor,
    s: Tensor,
    y: Tensor,
    usable: Tensor,
    scales: Tensor,
    robust: float,
    shared: Shared = alone,
) -> Tensor:
    """Return the error of free-run velocities, in units of the metrics' scales.

    The mean square, or the mean over windows of their root mean square.

    Args:
        rollout: the free run of the model, as `Rollout` gives it.
        x0: initial states [B, 3 + n].
        w: inputs [B, T, m].
        s: initial memory [B, n_state].
        y: measured states after each step [B, T, 3 + n].
        usable: measured samples that may be scored [B, T].
        scales: [n].
        robust: 0 for the mean square; else windows count by sqrt(mean square + robust^2), as the
            metrics do, so that few bad ones do not rule.
        shared: over the processes of a training, whose mean loss is that of all windows.
    """
    states, _, _ = rollout(x0, w, s)
    n = scales.numel()
    error = (dynamic_states(states[:, 1:], n) - dynamic_states(y, n)) / scales
    weight, count = usable.to(error.dtype).unsqueeze(-1), float(n)
    if robust > 0:
        square = (error.square() * weight).sum((1, 2)) / (count * weight.sum((1, 2))).clamp(min=1.0)
        return torch.sqrt(square + robust**2).sum() / shared(torch.ones_like(square).sum())
    # a rollout that runs away must pull back, not drown the batch
    square = 2.0 * torch.nn.functional.huber_loss(
        error, torch.zeros_like(error), reduction="none", delta=5.0
    )
    return (square * weight).sum() / shared(count * weight.sum()).clamp(min=1.0)


Validate = Callable[[HybridDynamics], Score]


@dataclass(frozen=True)
class Mirror:
    """How states [..., 3 + n] and inputs [..., m] look in the mirror.

    Attributes:
        state: signs of the states [3 + n].
        index: column that each input is taken from [m].
        sign: and its sign [m].
    """

    state: Tensor
    index: Tensor
    sign: Tensor

    @classmethod
    def of(cls, signals: Signals) -> Mirror | None:
        """Return that of the channels of a model; None where it is not known for one of them."""
        found = mirror_channels(signals.names)
        if found is None:
            return None
        n = signals.n_dof
        index, sign = (part[n : n + signals.n_inputs] for part in found)
        index = [place - n for place in index]
        if signals.has_wind:
            # where an earth-fixed wind comes from is mirrored as headings are
            index = [*index, signals.speed_column, signals.direction_column]
            sign = [*sign, 1.0, -1.0]
            order = [*range(signals.n_inputs), signals.speed_column, signals.direction_column]
            index = [index[order.index(place)] for place in range(len(order))]
            sign = [sign[order.index(place)] for place in range(len(order))]
        return cls(
            torch.tensor([1.0, -1.0, -1.0, *map(float, get_axis_parities(signals.names))]),
            torch.tensor(index, dtype=torch.long),
            torch.tensor(sign),
        )

    def every_other(self, windows: WindowBatch) -> WindowBatch:
        """Return windows of which every other one is seen in the mirror."""
        rows = torch.arange(len(windows.y)) % 2 == 1

        def seen(values: Tensor, other: Tensor) -> Tensor:
            return torch.where(rows[:, None, None], other, values)

        state, sign = self.state.to(windows.y), self.sign.to(windows.w)
        return windows._replace(
            **{
                name: seen(values, values * state)
                for name in ("y", "smoothed", "past_y")
                if (values := getattr(windows, name)) is not None
            },
            **{
                name: seen(values, values[..., self.index] * sign)
                for name in ("w", "past_w")
                if (values := getattr(windows, name)) is not None
            },
        )


@final
class HeadTraining(EpochTraining):
    """A training of `model.head` that keeps the weights which validate best in free run."""

    def __init__(
        self,
        model: HybridDynamics,
        config: TrainingConfig,
        scales: Tensor,
        validate: Validate,
        seed: int,
    ) -> None:
        super().__init__(config, seed)
        self.model = model
        self.rollout = Rollout(model)
        self._compiled: FreeRun | None = None
        self.scales = scales
        self.validate = validate
        self.stages = config.windows(model.dt)
        self.rank, self.world = 0, 1
        self.mirror = Mirror.of(model.signals) if config.mirror else None

    def data(self, store: WindowStore) -> WindowsDataModule:
        """Return the windows of each epoch's stage.

        Raises:
            DataError: where no log is long enough for a stage.
        """
        if self.stages[0] is not None:
            store = replace(store, precomputed=self._precompute(store))
        # methods, which other processes can be given
        return WindowsDataModule(
            store, self.stages, self.settings.steps, self.seed, self.stage_of, self.present_epoch
        )

    def _precompute(self, store: WindowStore) -> Tensor:
        """Return channels, baseline and measured accelerations of all samples [N, nz + 2 n].

        They do not change during the training, whose epochs use each sample many times.
        """
        n_columns = len(self.model.signals.names) + 2 * self.model.dof
        precomputed = paged.allocate_rows(len(store.y), n_columns, dtype=store.y.dtype)
        with torch.no_grad():
            for rows in paged.iterate_row_chunks(len(precomputed)):
                z = self.model.compute_channels(store.smoothed[rows], store.rate_inputs[rows])
                baseline = self.model.baseline_acceleration(z)
                precomputed[rows] = torch.cat((z, baseline, store.nu_dot[rows]), dim=-1)
                paged.release_pages()
        return precomputed

    def stage_of(self, epoch: int) -> int:
        """Return the number of the stage that an epoch belongs to."""
        return int(self.settings.stage(epoch)[0])

    def present_epoch(self) -> int:
        """Return the epoch by now, for which the loaders ask."""
        return self.epoch

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return AdamW, with weight decay on matrices of the head only."""
        head = list(self.model.head.parameters())
        groups = [
            {"params": [p for p in head if p.ndim > 1], "weight_decay": self.settings.weight_decay},
            {"params": [p for p in head if p.ndim <= 1], "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=1e-3, fused=True)

    def on_fit_start(self) -> None:
        super().on_fit_start()
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            self.rank, self.world = self.global_rank, torch.distributed.get_world_size()
        self.scales = self.scales.to(self.device)

    def on_train_epoch_start(self) -> None:
        """Seed the epoch and set the stage's learning rate."""
        self.seed_epoch()
        self.model.baseline.requires_grad_(False)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.settings.rate(self.epoch)

    def training_step(self, windows: tuple[WindowBatch, ...], batch_index: int) -> Tensor:
        """Return the loss of one batch of windows, some of which may begin a stretch."""
        stage, _ = self.settings.stage(self.epoch)
        loss = self._one_step(windows) if stage == 0 else self._multi_step(windows, stage)
        self._losses.append(float(self.shared(loss.detach())))
        return loss

    def shared(self, value: Tensor) -> Tensor:
        """Return the mean of a value over the processes of the training."""
        if self.world == 1:
            return value
        total = value.detach().clone()
        torch.distributed.all_reduce(total)
        return total / self.world

    def _one_step(self, windows: Sequence[WindowBatch]) -> Tensor:
        precomputed = torch.cat([batch.precomputed for batch in windows])
        trainable = torch.cat([batch.trainable for batch in windows])
        n_elapsed = torch.cat([batch.n_elapsed for batch in windows])
        n = self.model.dof
        n_channels = precomputed.shape[-1] - 2 * n
        z, baseline, nu_dot = precomputed.split([n_channels, n, n], dim=-1)
        n_washout = round(self.settings.one_step.washout / self.model.dt)
        washout = torch.full_like(n_elapsed, n_washout)
        if self.settings.beginnings is not None:
            # windows at the start of a segment begin with an empty memory, as a free run does
            washout[n_elapsed == 0] = 0
        index = torch.arange(z.shape[1], device=z.device)
        is_counted = trainable & (index >= washout[:, None])
        scale = self.model.head.residual_scale().to(z.dtype)
        return one_step_loss(self.model, z, baseline, nu_dot, is_counted, scale, self.shared)

    def _multi_step(self, windows: Sequence[WindowBatch], stage: int) -> Tensor:
        begins, memories = [], []
        if self.mirror is not None:
            windows = [self.mirror.every_other(part) for part in windows]
        for number, part in enumerate(windows):
            memories.append(self.model.warmup(part.past_y, part.past_w))
            x0 = part.smoothed[:, 0]
            if number == 1:
                # at the beginning of a stretch the mean of what is known is all that is known
                mean = all_but_pose(part.past_y).mean(1)
                x0 = torch.cat((pose(x0), mean), dim=1)
            begins.append(x0)
        x0 = torch.cat(begins)
        if self.settings.start_noise > 0:
            drawn = self._drawn(stage).to(x0)
            noise = self.settings.start_noise * self.scales * drawn
            x0 = torch.cat((pose(x0), all_but_pose(x0) + noise), dim=1)
        w, y, usable = (
            torch.cat([getattr(part, name) for part in windows]) for name in ("w", "y", "usable")
        )
        return rollout_loss(
            self._free_run(),
            x0,
            w[:, :-1],
            torch.cat(memories),
            y[:, 1:],
            usable[:, 1:],
            self.scales,
            self.settings.robust,
            self.shared,
        )

    def _drawn(self, stage: int) -> Tensor:
        """Return standard normal numbers [B, n] for the windows of this process.

        They are drawn for the whole batch on the CPU: the same on every device, by any processes.
        """
        windows = self.stages[stage]
        assert windows is not None, "an epoch of a stage without windows"
        drawn = torch.randn(
            windows.batch_size, self.scales.numel(), dtype=self.scales.dtype, device="cpu"
        )
        sizes = [
            windows.batch_size - windows.n_segment_start_windows,
            windows.n_segment_start_windows,
        ]
        return torch.cat([part[self.rank :: self.world] for part in drawn.split(sizes)])

    def _free_run(self) -> FreeRun:
        """Return the free run of the model as the training has it now."""
        if self._compiled is None:
            # not before: by now the model is on its device and in training
            self._compiled = compile_rollout(self.rollout, TRAINING_STEPS)
        return self._compiled

    def validated(self) -> tuple[nn.Module, float]:
        score = self.validate(self.model)
        self.diverged, self.axes, self.shown = score.diverged, score.axes, score.shown
        return self.model, score.error


def train(
    name: str,
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: TrainingConfig,
    scales: torch.Tensor,
    validate: Validate,
    seed: int,
    folder: Path | None,
) -> dict[str, Any]:
    """Train the head of a model and leave the weights that validated best in it (float32).

    Args:
        name: of the head.
        model: with its baseline filled in.
        samples: training samples whose target is the residual; give the scales.
        store: training windows, float64 where the training's precision is.
        config: stages.
        scales: of what moves, [n].
        validate: divergences and free-run error of a model on the validation data.
        seed: of weights and batches.
        folder: for checkpoints (`checkpoints/<name>/last.ckpt` is resumed from where it exists) and
            the TensorBoard log; None for neither.

    Returns:
        Notes about the training: the curve by epoch, the best score, the number of parameters.

    Raises:
        FitError: where training never gave a finite free run.
    """
    model.head.calibrate(samples)
    if isinstance(model.head, GRUEnsembleHead):
        return _train_coarse(name, model, store, config, scales, validate, seed, folder)
    dtype = torch.float64 if config.double else torch.float32
    # losses and scores are those of velocities
    model.has_position = False
    try:
        module = HeadTraining(model.to(dtype), config, scales.to(dtype), validate, seed)
        return run_epochs(name, module, module.data(store), model, model.head, folder, config)
    finally:
        model.to(torch.float32)
        model.has_position = True


def _train_coarse(
    name: str,
    model: HybridDynamics,
    store: WindowStore,
    config: TrainingConfig,
    scales: torch.Tensor,
    validate: Validate,
    seed: int,
    folder: Path | None,
) -> dict[str, Any]:
    """Train networks in the coarse steps that their gates belong to; see `train`.

    Every batch holds as many windows for each network, and no network sees those of another.
    """
    head = model.head
    assert isinstance(head, GRUEnsembleHead)
    steps = max(round(head.training_step / model.dt), 1)
    signals = model.signals
    turning = [signals.direction_column] if signals.has_wind else []
    # a baseline in steps so long asks for a scheme of second order; a residual alone is held
    alone = isinstance(model.baseline, FixedBaseline) and not model.baseline.library.n_terms
    # an oscillation of the roll grows under Euler's scheme
    first: Integrator = "semi_implicit_euler" if model.has_roll else "euler"
    scheme: Integrator = first if alone else "heun"
    coarse = HybridDynamics(signals, model.baseline, head, steps * model.dt, scheme)
    coarse.has_position = False

    def fine(trained: HybridDynamics) -> HybridDynamics:
        return HybridDynamics(
            trained.signals, trained.baseline, trained.head, model.dt, model.integrator
        )

    def validated(trained: HybridDynamics) -> Score:
        try:
            return validate(fine(trained))
        finally:
            trained.head.set_step(coarse.dt)

    dtype = torch.float64 if config.double else torch.float32
    try:
        module = HeadTraining(coarse.to(dtype), config, scales.to(dtype), validated, seed)
        data = module.data(store.coarsen(steps, turning))
        return run_epochs(name, module, data, coarse, head, folder, config)
    finally:
        head.set_step(model.dt)
        model.to(torch.float32)
