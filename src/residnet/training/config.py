"""How a network head is trained. No Lightning here: `residnet check` must stay quick."""

from __future__ import annotations

from pydantic import Field, model_validator

from residnet.core.config import Config, Seconds
from residnet.training.machine import MachineConfig


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
        average: decay of the exponential average of the weights that is validated and kept; 0 for
            none.
        from_baseline: the network's output starts at zero, so that the training starts from its
            baseline, which stays a candidate: weights are kept only where they gain.
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
    average: float = Field(default=0.0, ge=0, lt=1)
    from_baseline: bool = False
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
