"""How networks are trained, and on what machine. Neither Lightning nor torch is imported here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.errors import UsageError

if TYPE_CHECKING:
    from residnet.preprocessing.windows import WindowStage


def falling(rate: float, final: float, epoch: int, epochs: int) -> float:
    """Return a learning rate that falls along a cosine to a share `final` in the last epoch."""
    progress = 0.5 * (1 - math.cos(math.pi * epoch / max(epochs - 1, 1)))
    return rate * (1 - progress * (1 - final))


class OneStage(Config):
    """Settings of a training in one stage, with a learning rate that falls along a cosine.

    Attributes:
        epochs: at most.
        learning_rate: of Adam in the first epoch.
        final: share of it in the last.
        gradient_clip: largest norm of the gradient.
        patience: stop when this many validations in a row bring nothing better.
        validate_every: epochs between validations.
    """

    epochs: int = Field(default=20, ge=1, le=100_000)
    learning_rate: float = Field(default=1e-2, gt=0)
    final: float = Field(default=0.02, gt=0, le=1)
    gradient_clip: float = Field(default=1.0, gt=0)
    patience: int = Field(default=1000, ge=1)
    validate_every: int = Field(default=1, ge=1)

    @property
    def last_stage(self) -> int:
        """Number of the only stage, 0."""
        return 0

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return stage 0, the only one, and the epoch."""
        return 0, epoch

    def rate(self, epoch: int) -> float:
        """Return the learning rate of an epoch."""
        return falling(self.learning_rate, self.final, epoch, self.epochs)


class MachineConfig(Config):
    """What a training runs on.

    Attributes:
        device: `cpu`, `cuda`, `cuda:1` for the second GPU, or `auto` for a GPU where there is one.
            Free runs that validate are run on the CPU whatever it is.
        precision: of numbers, by Lightning's names: `32-true` or `64-true`. Half precision is not
            offered: the baseline's accelerations, which a rollout adds up, would be off by a
            hundredth.
        processes: that share each batch, each on a device of its own (ddp).
    """

    device: str = Field(default="cpu", pattern=r"^(auto|cpu|cuda(:\d{1,3})?)$")
    precision: Literal["32-true", "64-true"] = "32-true"
    processes: int = Field(default=1, ge=1, le=1_024)

    @property
    def double(self) -> bool:
        """Return whether weights and windows are float64."""
        return self.precision == "64-true"

    def for_lightning(self) -> dict[str, Any]:
        """Return the arguments of Lightning's trainer.

        Raises:
            UsageError: where the machine has no such device.
        """
        import torch

        found = torch.cuda.device_count()
        kind, _, number = self.device.partition(":")
        if kind == "auto":
            kind = "cuda" if found else "cpu"
        first = int(number or 0)
        if kind == "cuda" and first + self.processes > found:
            raise UsageError(
                f"device: {self.device} with {self.processes} processes needs"
                f" {first + self.processes} GPUs, and PyTorch finds {found}; give device: cpu, or"
                " auto"
            )
        devices: int | list[int] = self.processes
        if kind == "cuda":
            devices = list(range(first, first + self.processes))
        return {
            "accelerator": "gpu" if kind == "cuda" else "cpu",
            "devices": devices,
            "precision": self.precision,
            # stages train different parameters
            "strategy": "auto" if self.processes == 1 else "ddp_spawn_find_unused_parameters_true",
        }


class OneStep(Config):
    """Settings of the teacher-forced start on residual accelerations (document 003 eq. (20)).

    Attributes:
        epochs: of `steps` batches each.
        window: length of a window; the loss counts its part after `washout`, which fills a memory
            first.
        washout: see above.
        batch: windows per batch.
        learning_rate: of Adam; it falls to `final` of it over the stage, along a cosine.
        final: share of the learning rate at the stage's end.
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
    """A stage of free-run training, which compares velocities over a horizon.

    Attributes:
        horizon: length of the rollouts.
        epochs: of `steps` batches each.
        batch: rollouts per batch.
        learning_rate: at the start of the stage; it falls to `final` of it over the stage, along a
            cosine.
        final: share of the learning rate at the stage's end.
    """

    horizon: Seconds = Field(gt=0)
    epochs: int = Field(ge=1, le=100_000)
    batch: int = Field(default=128, ge=1, le=1_000_000)
    learning_rate: float = Field(default=1e-3, gt=0)
    final: float = Field(default=1.0, gt=0, le=1)


class Beginnings(Config):
    """Settings of windows at the beginning of a stretch, where there is hardly a past.

    Whole manoeuvres are run from there.

    One-step windows start with the stretch and are scored from their first sample on; rollouts
    start after `initial`, from the mean velocities of that time, which alone warms up the memory.

    Attributes:
        share: of each batch.
        initial: see above.
    """

    share: float = Field(default=0.25, gt=0, lt=1)
    initial: Seconds = Field(default=0.5, gt=0)


class TrainingConfig(MachineConfig):
    """Settings of a training: one-step, then each of `multi_step` (a curriculum of horizons).

    Attributes:
        one_step: the teacher-forced start.
        multi_step: free-run stages.
        steps: batches per epoch.
        history: measured past that warms up the memory before a rollout.
        beginnings: windows at the beginning of stretches in every batch; null for no more than
            chance brings.
        start_noise: standard deviation of the noise on the initial velocities of rollouts, in units
            of the metrics' scales.
        robust: 0 for the mean square of free-run errors; else windows whose error (in units of the
            scales) is far above this count by their error and not by its square.
        gradient_clip: largest norm of the gradient.
        weight_decay: of AdamW, on matrices only.
        mirror: every other window is seen in the mirror, port for starboard.
        patience: stop when this many validations in a row bring no better free run, once the last
            stage has begun.
        validate_every: epochs between validations.
    """

    one_step: OneStep = OneStep()
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

    @model_validator(mode="after")
    def _work(self) -> TrainingConfig:
        if self.epochs == 0:
            raise ValueError("nothing to train: one_step.epochs is 0 and multi_step is empty")
        if self.beginnings is not None and 1 in (
            self.one_step.batch,
            *(stage.batch for stage in self.multi_step),
        ):
            raise ValueError(
                "beginnings need batches of at least 2 windows: some lie at the beginning of a"
                " stretch, the others anywhere"
            )
        least = min(self.one_step.batch, *(stage.batch for stage in self.multi_step), 1_024)
        if self.processes > least:
            raise ValueError(f"processes: {self.processes} cannot share batches of {least} windows")
        return self

    @property
    def epochs(self) -> int:
        """Epochs of all stages together."""
        return self.one_step.epochs + sum(stage.epochs for stage in self.multi_step)

    @property
    def last_stage(self) -> int:
        """Number of the last free-run stage."""
        return len(self.multi_step)

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return (stage, epoch within it); stage 0 is one-step, stage i the i-th free-run stage."""
        begin = 0
        for number, length in enumerate(
            (self.one_step.epochs, *(stage.epochs for stage in self.multi_step))
        ):
            if epoch < begin + length:
                return number, epoch - begin
            begin += length
        return len(self.multi_step), max(epoch - begin, 0)

    def rate(self, epoch: int) -> float:
        """Return the learning rate of an epoch."""
        number, within = self.stage(epoch)
        stage = self.one_step if number == 0 else self.multi_step[number - 1]
        return falling(stage.learning_rate, stage.final, within, stage.epochs)

    def windows(self, dt: float) -> list[WindowStage | None]:
        """Return the windows of each stage at a step of dt seconds; None for one without epochs."""
        from residnet.preprocessing.windows import WindowStage

        def begun(batch: int) -> int:
            """Windows of a batch that begin with a stretch."""
            if self.beginnings is None:
                return 0
            return min(max(round(self.beginnings.share * batch), 1), batch - 1)

        one, lead = self.one_step, 0
        if self.beginnings is not None:
            lead = max(round(self.beginnings.initial / dt), 1)
        first = WindowStage(
            round(one.window / dt), one.batch, 0, begun(one.batch), columns=("precomputed", "trainable")
        )
        return [first if one.epochs else None] + [
            WindowStage(
                round(stage.horizon / dt) + 1,
                stage.batch,
                round(self.history / dt),
                begun(stage.batch),
                lead,
                ("y", "smoothed", "w", "usable"),
            )
            for stage in self.multi_step
        ]
