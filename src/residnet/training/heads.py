"""Training of residual networks (heads): one-step and free-run losses, free-run validation."""

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
from residnet.dynamics.hybrid import HybridDynamics, MeasuredPast
from residnet.dynamics.time_steps import Integrator
from residnet.engine.free_runs import compile_rollout
from residnet.engine.rollout import TRAINING_STEPS, FreeRun, Rollout
from residnet.heads.mirror import MirroredHead, add_mirror_images
from residnet.heads.recurrent import GRUEnsembleHead
from residnet.heads.skip import SkipHead
from residnet.physics.signals import Signals
from residnet.physics.symmetry import get_axis_parities, mirror_channels
from residnet.preprocessing.data_module import WindowBatch, WindowsDataModule
from residnet.preprocessing.windows import WindowStore
from residnet.training.config import TrainingConfig
from residnet.training.score import Score
from residnet.training.selection import select_by_free_run
from residnet.training.trainer import EpochTraining, TrainerExtensions, run_epochs

ProcessMean = Callable[[Tensor], Tensor]
"""Function from a sum over the windows of this process to the mean over all processes."""


def single_process_mean(value: Tensor) -> Tensor:
    """Return the mean over a single process, which is the value itself."""
    return value


def one_step_loss(
    model: HybridDynamics,
    z: Tensor,
    baseline: Tensor,
    nu_dot: Tensor,
    is_counted: Tensor,
    scale: Tensor,
    process_mean: ProcessMean = single_process_mean,
) -> Tensor:
    """Return the mean squared error of accelerations along windows (Woo et al. 2018, eq. (20)).

    The error is in units of the standard deviation of the residual.

    Args:
        model: the hybrid model.
        z: channels of the smoothed states and the inputs at the same samples [B, T, nz].
        baseline: accelerations of the baseline at these samples, SI [B, T, n].
        nu_dot: measured accelerations, SI [B, T, n].
        is_counted: whether the loss includes the sample (valid acceleration, after the washout)
            [B, T].
        scale: standard deviation of the residual accelerations, SI [n].
        process_mean: mean over the processes of a training; it makes the mean of their losses equal
            to the loss of all windows.
    """
    error = (nu_dot - model.teacher_forced_accelerations(z, baseline)) / scale
    weight = is_counted.to(error.dtype).unsqueeze(-1)
    count = float(error.shape[-1])
    return (error.square() * weight).sum() / process_mean(count * weight.sum()).clamp(min=1.0)


def rollout_loss(
    rollout: FreeRun,
    x0: Tensor,
    w: Tensor,
    s: Tensor,
    y: Tensor,
    usable: Tensor,
    scales: Tensor,
    robust: float,
    process_mean: ProcessMean = single_process_mean,
) -> Tensor:
    """Return the error of free-run velocities, in units of the metrics' scales.

    The error is the mean square, or with `robust` the mean over windows of the root mean square.

    Args:
        rollout: free run of the model, for example a `Rollout`.
        x0: initial states [B, 3 + n].
        w: inputs [B, T, m].
        s: initial memory [B, n_state].
        y: measured states after each step [B, T, 3 + n].
        usable: whether the measured sample is valid [B, T].
        scales: scales of the velocities, SI [n].
        robust: 0 for the mean square; otherwise the loss of a window is
            sqrt(mean square + robust^2), as in the metrics, so that few outliers do not dominate.
        process_mean: mean over the processes of a training; it makes the mean of their losses equal
            to the loss of all windows.
    """
    states, _, _ = rollout(x0, w, s)
    n = scales.numel()
    error = (dynamic_states(states[:, 1:], n) - dynamic_states(y, n)) / scales
    weight = usable.to(error.dtype).unsqueeze(-1)
    count = float(n)
    if robust > 0:
        square = (error.square() * weight).sum((1, 2)) / (count * weight.sum((1, 2))).clamp(min=1.0)
        return torch.sqrt(square + robust**2).sum() / process_mean(torch.ones_like(square).sum())
    # the Huber loss bounds the gradient of a rollout that diverges
    square = 2.0 * torch.nn.functional.huber_loss(
        error, torch.zeros_like(error), reduction="none", delta=5.0
    )
    return (square * weight).sum() / process_mean(count * weight.sum()).clamp(min=1.0)


Validate = Callable[[HybridDynamics], Score]
"""Function that returns the free-run score of a model on the validation logs."""


@dataclass(frozen=True)
class Mirror:
    """Reflection of states [..., 3 + n] and inputs [..., m] in the centre plane of the vessel.

    Attributes:
        state_signs: sign of each state [3 + n].
        input_columns: column that replaces each input [m].
        input_signs: sign of this column [m].
    """

    state_signs: Tensor
    input_columns: Tensor
    input_signs: Tensor

    @classmethod
    def from_signals(cls, signals: Signals) -> Mirror | None:
        """Return the reflection for the channels of a model; None if a channel has no known one."""
        reflection = mirror_channels(signals.names)
        if reflection is None:
            return None
        n = signals.n_dof
        # inputs follow the velocities among the channels
        columns, signs = (part[n : n + signals.n_inputs] for part in reflection)
        columns = [channel - n for channel in columns]
        if signals.has_wind:
            # the direction of an earth-fixed wind changes its sign as a heading does
            columns = [*columns, signals.speed_column, signals.direction_column]
            signs = [*signs, 1.0, -1.0]
            # in the order of the input columns
            order = [*range(signals.n_inputs), signals.speed_column, signals.direction_column]
            columns = [columns[order.index(column)] for column in range(len(order))]
            signs = [signs[order.index(column)] for column in range(len(order))]
        return cls(
            torch.tensor([1.0, -1.0, -1.0, *map(float, get_axis_parities(signals.names))]),
            torch.tensor(columns, dtype=torch.long),
            torch.tensor(signs),
        )

    def mirror_alternate(self, windows: WindowBatch) -> WindowBatch:
        """Return the windows with every second one mirrored."""
        rows = torch.arange(len(windows.y)) % 2 == 1

        def mirror_rows(values: Tensor, mirrored: Tensor) -> Tensor:
            return torch.where(rows[:, None, None], mirrored, values)

        state_signs = self.state_signs.to(windows.y)
        input_signs = self.input_signs.to(windows.w)
        return windows._replace(
            **{
                name: mirror_rows(values, values * state_signs)
                for name in ("y", "smoothed", "past_y")
                if (values := getattr(windows, name)) is not None
            },
            **{
                name: mirror_rows(values, values[..., self.input_columns] * input_signs)
                for name in ("w", "past_w")
                if (values := getattr(windows, name)) is not None
            },
        )


@final
class HeadTraining(EpochTraining):
    """Lightning module that trains `model.head` and validates it by free runs."""

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
        self._validated_models = (model,)
        self.rollout = Rollout(model)
        self._compiled: FreeRun | None = None
        self._compiled_past: FreeRun | None = None
        self.scales = scales
        self.validate = validate
        self.stages = config.windows(model.dt)
        self.rank = 0
        self.world_size = 1
        self.mirror = Mirror.from_signals(model.signals) if config.mirror else None

    def data(self, store: WindowStore) -> WindowsDataModule:
        """Return the data module with the windows of each stage.

        Raises:
            DataError: if no log is long enough for a stage.
        """
        if self.stages[0] is not None:
            store = replace(store, precomputed=self._precompute(store))
        # methods instead of lambdas: spawned processes receive them pickled
        return WindowsDataModule(
            store, self.stages, self.settings.steps, self.seed, self.stage_of, self.present_epoch
        )

    def _precompute(self, store: WindowStore) -> Tensor:
        """Return channels, baseline and measured accelerations of all samples [N, nz + 2 n].

        They are constant during the training, and each epoch uses a sample many times.
        """
        n_columns = len(self.model.signals.names) + 2 * self.model.dof
        precomputed = paged.allocate_rows(len(store.y), n_columns, dtype=store.y.dtype)
        with torch.no_grad():
            for rows in paged.iterate_row_chunks(len(precomputed)):
                z = self.model.compute_channels(store.smoothed[rows], store.regression_inputs[rows])
                baseline = self.model.baseline_acceleration(z)
                precomputed[rows] = torch.cat((z, baseline, store.nu_dot[rows]), dim=-1)
                paged.release_pages()
        return precomputed

    def stage_of(self, epoch: int) -> int:
        """Return the stage of an epoch: 0 for one-step training, then the multi-step stages."""
        return int(self.settings.stage(epoch)[0])

    def present_epoch(self) -> int:
        """Return the index of the current epoch (for the data loaders)."""
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
            self.rank = self.global_rank
            self.world_size = torch.distributed.get_world_size()
        self.scales = self.scales.to(self.device)
        if self.epoch == 0 and _find_skip_head(self.model) is not None:
            # the linear part alone is a candidate: the network is zero before its first epoch
            self.validate_start()
            self.best_diverged = self.diverged

    def on_train_epoch_start(self) -> None:
        """Seed the epoch and set its learning rate."""
        self.seed_epoch()
        self.model.baseline.requires_grad_(False)
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.settings.rate(self.epoch)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradient of each network of an ensemble separately."""
        head = self.model.head
        if isinstance(head, GRUEnsembleHead) and gradient_clip_val is None:
            head.clip_member_gradients(self.settings.gradient_clip)
        else:
            super().configure_gradient_clipping(
                optimizer, gradient_clip_val, gradient_clip_algorithm
            )

    def training_step(self, windows: tuple[WindowBatch, ...], batch_index: int) -> Tensor:
        """Return the loss of a batch: random windows, then windows at the start of a segment."""
        stage, _ = self.settings.stage(self.epoch)
        loss = self._one_step(windows) if stage == 0 else self._multi_step(windows, stage)
        self._losses.append(float(self.process_mean(loss.detach())))
        return loss

    def process_mean(self, value: Tensor) -> Tensor:
        """Return the mean of a value over all processes of the training."""
        if self.world_size == 1:
            return value
        total = value.detach().clone()
        torch.distributed.all_reduce(total)
        return total / self.world_size

    def _one_step(self, windows: Sequence[WindowBatch]) -> Tensor:
        """Return the loss of one-step accelerations along windows."""
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
        return one_step_loss(self.model, z, baseline, nu_dot, is_counted, scale, self.process_mean)

    def _multi_step(self, windows: Sequence[WindowBatch], stage: int) -> Tensor:
        """Return the loss of free runs over windows, started from their measured past."""
        initial_states = []
        memories = []
        if self.mirror is not None:
            windows = [self.mirror.mirror_alternate(part) for part in windows]
        for number, part in enumerate(windows):
            memories.append(self._read_past(part.past_y, part.past_w))
            x0 = part.smoothed[:, 0]
            if number == 1:
                # windows at the start of a segment begin like a free run there, for which no
                # smoothed state is known, only this mean
                mean = all_but_pose(part.past_y).mean(1)
                x0 = torch.cat((pose(x0), mean), dim=1)
            initial_states.append(x0)
        x0 = torch.cat(initial_states)
        if self.settings.start_noise > 0:
            noise = self.settings.start_noise * self.scales * self._draw_noise(stage).to(x0)
            x0 = torch.cat((pose(x0), all_but_pose(x0) + noise), dim=1)
        w, y, usable = (
            torch.cat([getattr(part, name) for part in windows]) for name in ("w", "y", "usable")
        )
        return rollout_loss(
            self._run_from_measured_start,
            x0,
            w[:, :-1],
            torch.cat(memories),
            y[:, 1:],
            usable[:, 1:],
            self.scales,
            self.settings.robust,
            self.process_mean,
        )

    def _run_from_measured_start(
        self, x0: Tensor, w: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run the model from measured states x0 [B, 3 + n], see `Rollout`.

        The encoder of a head reads measured states only; the compiled rollout begins at the second
        state, without the encoder.
        """
        head = self.model.head
        if not isinstance(head, GRUEnsembleHead) or not head.has_encoder:
            return self._free_run()(x0, w, s)
        first_state, first_memory = self.model.step(x0, w[:, 0], s)
        head.is_decoding_only = True
        try:
            states, _, memory = self._free_run()(first_state, w[:, 1:], first_memory)
        finally:
            head.is_decoding_only = False
        return torch.cat((x0[:, None], states), dim=1), w, memory

    def _read_past(self, past_y: Tensor, past_w: Tensor) -> Tensor:
        """Return the memory [B, n_state] after measured states [B, T, 3 + n] and inputs [B, T, m].

        The step of an ensemble runs as compiled C here too: in torch it took a fifth of a training.
        """
        if not isinstance(self.model.head, GRUEnsembleHead) or past_y.shape[1] == 0:
            return self.model.warmup(past_y, past_w)
        if self._compiled_past is None:
            past = MeasuredPast(self.model)
            self._compiled_past = compile_rollout(Rollout(past), TRAINING_STEPS)
        memory = past_y.new_zeros(len(past_y), self.model.n_state)
        rows = torch.cat((past_y, past_w), dim=-1)
        return self._compiled_past(past_y[:, 0], rows, memory)[2]

    def _draw_noise(self, stage: int) -> Tensor:
        """Draw standard normal numbers [B, n] for the windows of this process.

        The CPU draws the numbers of the complete batch, so that they do not depend on the device
        and the number of processes.
        """
        windows = self.stages[stage]
        assert windows is not None, "a stage with epochs has windows"
        noise = torch.randn(
            windows.batch_size, self.scales.numel(), dtype=self.scales.dtype, device="cpu"
        )
        sizes = [
            windows.batch_size - windows.n_segment_start_windows,
            windows.n_segment_start_windows,
        ]
        return torch.cat([part[self.rank :: self.world_size] for part in noise.split(sizes)])

    def _free_run(self) -> FreeRun:
        """Return the compiled free run of the model."""
        if self._compiled is None:
            # compiled at the first batch, when the model is on its device and in training mode
            self._compiled = compile_rollout(self.rollout, TRAINING_STEPS)
        return self._compiled

    def compute_validation_score(self) -> tuple[nn.Module, float]:
        score = self.validate(self.model)
        self.diverged = score.diverged
        self.axes = score.axes
        self.example = score.example
        return self.model, score.error


@dataclass(frozen=True)
class TrainingSetup:
    """A network to train, its data and its settings.

    Attributes:
        model: the model with a fitted baseline; its head is trained.
        samples: training samples whose target is the residual; they determine the scales of the
            head.
        store: training windows, in the precision of the training.
        config: settings of the training.
        scales: scales of the velocities, SI [n].
        validate: returns the validation score of a model.
        seed: seed of noise and batches.
    """

    model: HybridDynamics
    samples: Samples
    store: WindowStore
    config: TrainingConfig
    scales: Tensor
    validate: Validate
    seed: int


def make_training(setup: TrainingSetup) -> tuple[HeadTraining, WindowsDataModule]:
    """Calibrate the head, and return the Lightning module and the data module of its training.

    An ensemble of recurrent networks is trained at the coarse step of its gates. Each of its
    networks has its own windows, and a batch holds the same number of windows for each.

    Raises:
        DataError: if no log is long enough for a stage.
    """
    model = setup.model
    config = setup.config
    store = setup.store
    # mirrored windows leave the range of the samples, outside of which inputs are clamped and
    # velocities are pulled back
    calibration_samples = add_mirror_images(setup.samples) if config.mirror else setup.samples
    model.head.calibrate(calibration_samples)
    skip_head = _find_skip_head(model)
    if skip_head is not None:
        _select_linear_part(setup, skip_head, calibration_samples)
    dtype = torch.float64 if config.is_double_precision else torch.float32
    if isinstance(model.head, GRUEnsembleHead):
        coarse, stride = _with_coarse_step(model, model.head)
        if _has_no_baseline(model):
            model.head.set_training_gain(_compute_training_gain(model.head, calibration_samples))
        angle_columns = [model.signals.direction_column] if model.signals.has_wind else []
        store = store.coarsen(stride, angle_columns)

        def validate_fine(trained: HybridDynamics) -> Score:
            fine = HybridDynamics(
                trained.signals, trained.baseline, trained.head, model.dt, model.integrator
            )
            try:
                return setup.validate(fine)
            finally:
                trained.head.set_step(coarse.dt)

        module = HeadTraining(coarse, config, setup.scales.to(dtype), validate_fine, setup.seed)
    else:
        module = HeadTraining(model, config, setup.scales.to(dtype), setup.validate, setup.seed)
    # losses and scores use velocities only
    module.model.has_position = False
    module.model.to(dtype)
    return module, module.data(store)


def _find_skip_head(model: HybridDynamics) -> SkipHead | None:
    return next((part for part in model.head.modules() if isinstance(part, SkipHead)), None)


def _select_linear_part(setup: TrainingSetup, head: SkipHead, samples: Samples) -> None:
    """Select the linear part of a skip connection by free runs, as for a head of this kind."""
    if isinstance(setup.model.head, MirroredHead):
        samples = add_mirror_images(samples)
    solutions = head.linear_solutions(samples)
    if solutions:
        # the network is zero, so that the model is the baseline with the linear part
        select_by_free_run(setup.model, head.linear, solutions, setup.validate)
        head.calibrate_network(samples)


def finish_training(model: HybridDynamics) -> None:
    """Return a model to the state before `make_training`, with the trained weights."""
    model.head.set_step(model.dt)
    if isinstance(model.head, GRUEnsembleHead):
        model.head.set_training_gain(None)
    model.to(torch.float32)
    model.has_position = True
    model.eval().requires_grad_(False)


def train(
    name: str,
    setup: TrainingSetup,
    folder: Path | None,
    extensions: TrainerExtensions | None = None,
) -> dict[str, Any]:
    """Train the head of a model and load its best weights.

    Args:
        name: name of the head.
        setup: the model, its data and the settings of the training.
        folder: folder of checkpoints and TensorBoard log; None to write neither. The checkpoint
            `checkpoints/<name>/last.ckpt` of an interrupted training is resumed.
        extensions: callbacks and logger of the user; None for none.

    Returns:
        Notes about the training: learning curve, best score, number of parameters.

    Raises:
        FitError: if no validation gave a finite free run.
    """
    try:
        module, data = make_training(setup)
        return run_epochs(
            name, module, data, module.model, setup.model.head, folder, setup.config, extensions
        )
    finally:
        finish_training(setup.model)


def _with_coarse_step(model: HybridDynamics, head: GRUEnsembleHead) -> tuple[HybridDynamics, int]:
    """Return the model at the step of the head's gates, and the ratio of the two steps."""
    stride = max(round(head.training_step / model.dt), 1)
    # a baseline at a step of this length needs a second-order scheme; a residual is constant.
    # An explicit Euler scheme amplifies the roll oscillation
    first_order: Integrator = "semi_implicit_euler" if model.has_roll else "euler"
    scheme: Integrator = first_order if _has_no_baseline(model) else "heun"
    return HybridDynamics(model.signals, model.baseline, head, stride * model.dt, scheme), stride


def _has_no_baseline(model: HybridDynamics) -> bool:
    return isinstance(model.baseline, FixedBaseline) and not model.baseline.library.n_terms


_INCREMENT_STD = 0.5
"""Change of a velocity in a training step for an output of 1, in standard deviations."""


def _compute_training_gain(head: GRUEnsembleHead, samples: Samples) -> Tensor:
    """Return the gain [n] of the outputs of networks that have no baseline.

    Without a baseline the networks also learn how velocities decay. The accelerations of a slow
    velocity are so small relative to it that this takes large weights in units of their standard
    deviation, which few steps of the optimiser do not reach.
    """
    velocity_std = samples.running_moments()[0].std()[: head.n_dof]
    increment = head.training_step * head.residual_scale()
    return (_INCREMENT_STD * velocity_std / increment.clamp(min=1e-12)).clamp(min=1.0)
