"""Settings of the training of networks; neither Lightning nor torch is imported here."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.errors import UsageError
from residnet.preprocessing.window_index import WindowStage


def cosine_learning_rate(rate: float, final: float, epoch: int, epochs: int) -> float:
    """Return the cosine-annealed learning rate of an epoch.

    Args:
        rate: learning rate of the first epoch.
        final: learning rate of the last epoch as a fraction of `rate`.
        epoch: index of the epoch, starting at 0.
        epochs: number of epochs.
    """
    progress = 0.5 * (1 - math.cos(math.pi * epoch / max(epochs - 1, 1)))
    return rate * (1 - progress * (1 - final))


class OneStage(Config):
    """Settings of a training in one stage with cosine annealing of the learning rate.

    Attributes:
        epochs: maximum number of epochs.
        learning_rate: learning rate of Adam in the first epoch.
        final: learning rate of the last epoch as a fraction of `learning_rate`.
        gradient_clip: largest norm of the gradient.
        patience: number of successive validations without improvement after which training stops.
        validate_every: number of epochs between validations.
    """

    epochs: int = Field(default=20, ge=1, le=100_000)
    learning_rate: float = Field(default=1e-2, gt=0)
    final: float = Field(default=0.02, gt=0, le=1)
    gradient_clip: float = Field(default=1.0, gt=0)
    patience: int = Field(default=1000, ge=1)
    validate_every: int = Field(default=1, ge=1)

    @property
    def last_stage(self) -> int:
        """Index of the only stage, 0."""
        return 0

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return the index of the stage, 0, and the epoch within it."""
        return 0, epoch

    def rate(self, epoch: int) -> float:
        """Return the learning rate of an epoch, by cosine annealing within its stage."""
        return cosine_learning_rate(self.learning_rate, self.final, epoch, self.epochs)


class MachineConfig(Config):
    """Settings of the hardware and the precision of a training.

    Attributes:
        device: `cpu`, `cuda`, `cuda:1` for the second GPU, or `auto` for a GPU if PyTorch finds
            one. Free runs for validation always use the CPU.
        precision: floating-point precision by its name in Lightning: `32-true` or `64-true`. Half
            precision is not supported: it would give the accelerations of the baseline, which a
            rollout integrates, a relative error of .01.
        processes: number of processes that share each batch, each on its own device
            (distributed data parallel).
    """

    device: str = Field(default="cpu", pattern=r"^(auto|cpu|cuda(:\d{1,3})?)$")
    precision: Literal["32-true", "64-true"] = "32-true"
    processes: int = Field(default=1, ge=1, le=1_024)

    @property
    def is_double_precision(self) -> bool:
        """Whether weights and windows are float64."""
        return self.precision == "64-true"

    def for_lightning(self) -> dict[str, Any]:
        """Return the keyword arguments of `lightning.Trainer` for this hardware.

        Raises:
            UsageError: if the machine lacks the device or has too few GPUs.
        """
        import torch

        n_gpus = torch.cuda.device_count()
        device_type, _, number = self.device.partition(":")
        if device_type == "auto":
            device_type = "cuda" if n_gpus else "cpu"
        first = int(number or 0)
        if device_type == "cuda" and first + self.processes > n_gpus:
            raise UsageError(
                f"device: {self.device} with {self.processes} processes needs"
                f" {first + self.processes} GPUs, and PyTorch finds {n_gpus}; give device: cpu, or"
                " auto"
            )
        devices: int | list[int] = self.processes
        if device_type == "cuda":
            devices = list(range(first, first + self.processes))
        return {
            "accelerator": "gpu" if device_type == "cuda" else "cpu",
            "devices": devices,
            "precision": self.precision,
            # each stage trains other parameters, so that some have no gradient
            "strategy": "auto" if self.processes == 1 else "ddp_spawn_find_unused_parameters_true",
        }


class OneStep(Config):
    """Settings of the teacher-forced stage on residual accelerations (Woo et al. 2018, eq. (20)).

    Attributes:
        epochs: number of epochs of `steps` batches each.
        window: length of a window.
        washout: initial part of each window that fills the memory of the network and is excluded
            from the loss.
        batch: number of windows per batch.
        learning_rate: initial learning rate of AdamW; it decreases along a cosine.
        final: learning rate at the end of the stage as a fraction of `learning_rate`.
    """

    epochs: int = Field(default=10, ge=0, le=100_000)
    window: Seconds = Field(default=5.0, gt=0)
    washout: Seconds = Field(default=0.0, ge=0)
    batch: int = Field(default=64, ge=1, le=1_000_000)
    learning_rate: float = Field(default=2e-3, gt=0)
    final: float = Field(default=1.0, gt=0, le=1)

    @model_validator(mode="after")
    def _washout(self) -> OneStep:
        if self.washout >= self.window:
            raise ValueError(
                f"washout ({self.washout:g} s) must be shorter than window ({self.window:g} s)"
            )
        return self


class MultiStep(Config):
    """Settings of a free-run stage, whose loss compares velocities over a horizon.

    Attributes:
        horizon: length of the rollouts.
        epochs: number of epochs of `steps` batches each.
        batch: number of rollouts per batch.
        learning_rate: initial learning rate of AdamW; it decreases along a cosine.
        final: learning rate at the end of the stage as a fraction of `learning_rate`.
    """

    horizon: Seconds = Field(gt=0)
    epochs: int = Field(ge=1, le=100_000)
    batch: int = Field(default=128, ge=1, le=1_000_000)
    learning_rate: float = Field(default=1e-3, gt=0)
    final: float = Field(default=1.0, gt=0, le=1)


class Beginnings(Config):
    """Settings of windows at the start of a segment, as free runs of a complete manoeuvre have.

    One-step windows begin with the segment, and the loss includes their first sample. Rollouts
    begin after `initial`: the mean velocities of this period are the initial state, and only this
    period warms up the memory.

    Attributes:
        share: share of such windows in each batch.
        initial: length of the period before a rollout.
    """

    share: float = Field(default=0.25, gt=0, lt=1)
    initial: Seconds = Field(default=0.5, gt=0)


class TrainingConfig(MachineConfig):
    """Settings of a training: a teacher-forced stage, then free-run stages of growing horizon.

    Without `one_step` and `multi_step`, `identification.training_schedule` derives both, and every
    other key that is not set, from the training logs and the protocol that selects models. With one
    of them, the training is exactly as set, and the other stage is omitted. The default values
    of the other keys apply to this case only.

    Attributes:
        one_step: settings of the teacher-forced stage.
        multi_step: settings of the free-run stages (a curriculum of horizons).
        steps: number of batches per epoch.
        history: length of the measured past that warms up the memory before a rollout.
        beginnings: share of windows at the start of a segment in every batch; null for random
            windows only.
        start_noise: standard deviation of the noise on the initial velocities of rollouts, in units
            of the metrics' scales.
        robust: error, in units of the scales, above which the loss of a window is linear instead
            of quadratic; 0 for the mean square error.
        gradient_clip: largest norm of the gradient; for an ensemble, of that of each network.
        weight_decay: weight decay of AdamW, applied to matrices only.
        mirror: whether every second window is mirrored, with port and starboard exchanged.
        patience: number of successive validations without a better free run, in the last stage,
            after which training stops.
        validate_every: number of epochs between validations.
        require_improvement: whether the residual is set to zero if no epoch has a smaller
            validation error than the baseline.
    """

    one_step: OneStep = OneStep(epochs=0)
    multi_step: tuple[MultiStep, ...] = ()
    steps: int = Field(default=25, ge=1, le=100_000)
    history: Seconds = Field(default=0.5, ge=0)
    beginnings: Beginnings | None = None
    start_noise: float = Field(default=0.0, ge=0)
    robust: float = Field(default=0.0, ge=0)
    gradient_clip: float = Field(default=1.0, gt=0)
    weight_decay: float = Field(default=0.0, ge=0)
    mirror: bool = False
    patience: int = Field(default=20, ge=1)
    validate_every: int = Field(default=1, ge=1)
    require_improvement: bool = False

    @model_validator(mode="after")
    def _check_stages(self) -> TrainingConfig:
        if self.epochs == 0 and not self.is_derived:
            raise ValueError("nothing to train: one_step.epochs is 0 and multi_step is empty")
        if self.beginnings is not None and 1 in (
            self.one_step.batch,
            *(stage.batch for stage in self.multi_step),
        ):
            raise ValueError(
                "beginnings need batches of at least 2 windows: some begin at the"
                " start of a segment, the others at random samples"
            )
        smallest_batch = min(
            self.one_step.batch, *(stage.batch for stage in self.multi_step), 1_024
        )
        if self.processes > smallest_batch:
            raise ValueError(
                f"processes: {self.processes} cannot share batches of {smallest_batch} windows"
            )
        return self

    @model_serializer(mode="wrap")
    def _serialize_set_keys(self, default_serializer: SerializerFunctionWrapHandler) -> Any:
        """Omit the keys that are derived from the logs, so that a stored config derives them."""
        content: dict[str, Any] = default_serializer(self)
        if self.is_derived:
            content = {key: value for key, value in content.items() if key in self.model_fields_set}
        return content

    @property
    def is_derived(self) -> bool:
        """Whether the stages, and the keys that are not set, follow from logs and protocol."""
        return not {"one_step", "multi_step"} & self.model_fields_set

    @property
    def epochs(self) -> int:
        """Number of epochs of all stages; 0 for stages that are still to be derived."""
        return self.one_step.epochs + sum(stage.epochs for stage in self.multi_step)

    @property
    def last_stage(self) -> int:
        """Index of the last stage; stage 0 is the one-step training."""
        return len(self.multi_step)

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return the index of an epoch's stage (0: one-step) and the epoch within this stage."""
        begin = 0
        for number, length in enumerate(
            (self.one_step.epochs, *(stage.epochs for stage in self.multi_step))
        ):
            if epoch < begin + length:
                return number, epoch - begin
            begin += length
        return len(self.multi_step), max(epoch - begin, 0)

    def rate(self, epoch: int) -> float:
        """Return the learning rate of an epoch, by cosine annealing within its stage."""
        number, epoch_in_stage = self.stage(epoch)
        stage = self.one_step if number == 0 else self.multi_step[number - 1]
        return cosine_learning_rate(stage.learning_rate, stage.final, epoch_in_stage, stage.epochs)

    def windows(self, dt: float) -> list[WindowStage | None]:
        """Return the windows of each stage for a step of dt seconds; None without epochs."""

        def count_segment_starts(batch: int) -> int:
            """Return the number of windows of a batch that begin with a segment."""
            if self.beginnings is None:
                return 0
            return min(max(round(self.beginnings.share * batch), 1), batch - 1)

        one_step = self.one_step
        lead = 0
        if self.beginnings is not None:
            lead = max(round(self.beginnings.initial / dt), 1)
        first = WindowStage(
            round(one_step.window / dt),
            one_step.batch,
            0,
            count_segment_starts(one_step.batch),
            columns=("precomputed", "trainable"),
        )
        return [first if one_step.epochs else None] + [
            WindowStage(
                round(stage.horizon / dt) + 1,
                stage.batch,
                round(self.history / dt),
                count_segment_starts(stage.batch),
                lead,
                ("y", "smoothed", "w", "usable"),
            )
            for stage in self.multi_step
        ]
