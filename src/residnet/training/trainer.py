"""Training loop with validation, early stopping, checkpoints and TensorBoard log, by Lightning.

TensorBoard shows the loss, the validation score (of each axis too), the learning rate, the
settings with the final score, and an example free run.
"""

from __future__ import annotations

import hashlib
import logging
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import Logger as LightningLogger
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn

from residnet.core.errors import FitError, UsageError
from residnet.core.files import atomic_write
from residnet.core.ownership import find_run_manifest, require_inside
from residnet.core.progress import report_progress
from residnet.preprocessing.data_module import EpochDataModule, compute_epoch_seed
from residnet.training.config import MachineConfig, OneStage, TrainingConfig
from residnet.training.score import ExampleRun

Callback = L.Callback
Logger = LightningLogger
Epochs = OneStage | TrainingConfig
"""Settings of a training."""
_CHECKPOINT_FIELDS = (
    "best_score", "best_diverged", "best_state", "start_score", "without_gain", "history",
    "stopped",
)  # fmt: skip
"""Attributes of `EpochTraining` in a checkpoint, in addition to the state of Lightning."""


@dataclass(frozen=True)
class TrainerExtensions:
    """Callbacks and logger of the user for all trainings of a fit.

    Attributes:
        callbacks: Lightning callbacks, called in addition to those of residnet.
        logger: Lightning logger in place of the TensorBoard log of the run folder; None for the
            latter.
    """

    callbacks: Sequence[Callback] = ()
    logger: Logger | None = None


def make_extensions(callbacks: Sequence[Callback], logger: Logger | None) -> TrainerExtensions:
    """Check the callbacks and the logger of the user.

    Raises:
        UsageError: if one of them is not of Lightning.
    """
    if not isinstance(callbacks, list | tuple):
        raise UsageError(f"callbacks: expected a list, given a {type(callbacks).__name__}")
    for callback in callbacks:
        if not isinstance(callback, L.Callback):
            raise UsageError(
                "callbacks: expected objects of lightning.Callback, given a"
                f" {type(callback).__name__}"
            )
    if logger is not None and not isinstance(logger, Logger):
        raise UsageError(
            f"logger: expected a logger of lightning.pytorch.loggers, given a"
            f" {type(logger).__name__}"
        )
    return TrainerExtensions(tuple(callbacks), logger)


class EpochTraining(L.LightningModule, ABC):
    """Base class of the Lightning modules of residnet's own trainings.

    An ordinary `lightning.Trainer` gives the same result as `run_epochs`: the module clips its
    gradients, validates at the end of each epoch, logs the score as `validation`, stops early, and
    has the best weights after the fit. `max_epochs` of the trainer only needs to be large enough.

    The seed of an epoch depends on (seed, epoch) only, so that a run resumed after an epoch gives
    the same result as an uninterrupted run.

    Attributes:
        diverged: number of rejected runs of the last validation: free runs that diverge or
            simulations with limit cycles. Fewer rejected runs take precedence over a lower score.
        axes: score of each axis by name in the last validation; empty if the score has no axes.
        example: an example free run of the last validation; None without free runs.
    """

    def __init__(self, settings: Epochs, seed: int) -> None:
        super().__init__()
        self.settings: Any = settings
        self.seed = seed
        self.diverged = 0
        self.best_score = math.inf
        self.best_diverged = 0
        self.best_state: dict[str, Tensor] = {}
        self.start_score: float | None = None
        self.without_gain = 0
        self.stopped = False
        self.history: list[dict[str, float]] = []
        self.axes: dict[str, float] = {}
        self.example: ExampleRun | None = None
        # in a tuple, because an attribute would become a second submodule
        self._validated_models: tuple[nn.Module, ...] = ()

    @abstractmethod
    def compute_validation_score(self) -> tuple[nn.Module, float]:
        """Validate, and return the module to save and its score (lower is better)."""

    @property
    def epoch(self) -> int:
        """Number of finished epochs; Lightning's count is one lower during a restart."""
        return len(self.history)

    @property
    def settings_digest(self) -> str:
        """SHA-256 of settings, seed and tensor shapes; a checkpoint must have the same digest."""
        shapes = {name: str(list(value.shape)) for name, value in self.state_dict().items()}
        return hashlib.sha256(f"{self.settings!r} {self.seed} {shapes}".encode()).hexdigest()

    @property
    def is_finished(self) -> bool:
        """Whether all epochs are finished or training has stopped early."""
        return self.stopped or self.epoch >= self.settings.epochs

    def validate_start(self) -> None:
        """Validate before the first epoch; later weights must have a better score."""
        model, score = self.compute_validation_score()
        self.start_score = score
        if math.isfinite(score):
            self.best_score = score
            self.best_state = _copy_state(model)

    def seed_epoch(self) -> None:
        """Seed the random numbers of the current epoch."""
        torch.manual_seed(compute_epoch_seed(self.seed, self.epoch))

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip gradients by the norm of the settings unless the trainer has a value of its own."""
        self.clip_gradients(
            optimizer,
            gradient_clip_val=gradient_clip_val or self.settings.gradient_clip,
            gradient_clip_algorithm=gradient_clip_algorithm or "norm",
        )

    def on_train_epoch_end(self) -> None:
        """Finish the epoch before Lightning's checkpoint callbacks save it."""
        self.finish_epoch()

    def on_fit_end(self) -> None:
        """Load the weights of the best validation."""
        if self.best_state:
            for model in self._validated_models:
                model.load_state_dict(self.best_state)

    def finish_epoch(self) -> None:
        """Validate, save the best weights, and stop after the last epoch or early."""
        stage, _ = self.settings.stage(self.epoch)
        last = self.epoch + 1 == self.settings.epochs
        entry = {
            "epoch": float(self.epoch),
            "stage": float(stage),
        }
        loss = sum(self._losses) / max(len(self._losses), 1)
        # JSON has no number for an infinite or undefined loss
        entry |= {"loss": loss} if math.isfinite(loss) else {}
        self._losses.clear()
        if last or (self.epoch + 1) % self.settings.validate_every == 0:
            model, score = self.compute_validation_score()
            entry["validation"] = score
            # for callbacks that monitor a value, such as `ModelCheckpoint`
            self.log("validation", score, logger=False)
            entry["diverged"] = float(self.diverged)
            if self._is_improvement(score):
                self.best_score = score
                self.best_diverged = self.diverged
                self.without_gain = 0
                self.best_state = _copy_state(model)
                self._validated_models = (model,)
            else:
                self.without_gain += 1
        self.history.append(entry)
        logger = self.trainer.logger
        if logger is not None:
            rate = self.trainer.optimizers[0].param_groups[0]["lr"]
            axes = {f"validation_{name}": error for name, error in self.axes.items()}
            scalars = {name: value for name, value in entry.items() if name != "epoch"}
            logger.log_metrics(scalars | axes | {"learning_rate": rate}, step=self.epoch)
        self.stopped = (
            stage == self.settings.last_stage and self.without_gain >= self.settings.patience
        )
        self.trainer.should_stop = self.is_finished

    def _is_improvement(self, score: float) -> bool:
        if not self.best_state:
            return math.isfinite(score)
        return (self.diverged, score) < (self.best_diverged, self.best_score)

    def on_fit_start(self) -> None:
        """Clear the losses of the current epoch."""
        self._losses: list[float] = []

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add best weights, learning curve, random state and number of threads to a checkpoint."""
        checkpoint["residnet"] = {name: getattr(self, name) for name in _CHECKPOINT_FIELDS} | {
            "stage": self.settings.stage(self.epoch)[0],
            "random": torch.get_rng_state(),
            "threads": torch.get_num_threads(),
            "made_of": self.settings_digest,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the state that `on_save_checkpoint` saved."""
        self.restore(checkpoint["residnet"])

    def restore(self, saved: dict[str, Any]) -> None:
        """Restore the attributes of this module from a checkpoint."""
        for name in _CHECKPOINT_FIELDS:
            setattr(self, name, saved.get(name, getattr(self, name)))
        torch.set_rng_state(saved["random"])
        torch.set_num_threads(saved["threads"])


def _copy_state(model: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().to("cpu", copy=True) for name, value in model.state_dict().items()}


class EpochEnd(Checkpoint):
    """Write `last.ckpt` and report progress at the end of each epoch.

    Lightning calls checkpoint callbacks after the hooks of the module, so that the checkpoint
    contains the result of the validation.

    Args:
        name: name of the trained module in progress messages.
        epochs: number of epochs.
        checkpoint: file of the checkpoint, written atomically; None for no checkpoint.
    """

    def __init__(self, name: str, epochs: int, checkpoint: Path | None) -> None:
        self.name = name
        self.epochs = epochs
        self.checkpoint = checkpoint

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write the checkpoint, and report the loss and the best score."""
        assert isinstance(pl_module, EpochTraining)
        if self.checkpoint is not None and trainer.is_global_zero:
            with atomic_write(self.checkpoint) as file:
                trainer.save_checkpoint(file)
        elif self.checkpoint is not None:
            # all processes must call this to synchronise; only the first one writes
            trainer.save_checkpoint(self.checkpoint)
        done = trainer.current_epoch + 1
        last = pl_module.history[-1]
        score = pl_module.best_score if math.isfinite(pl_module.best_score) else None
        line = (
            f"  {self.name}: epoch {done}/{self.epochs}, stage {int(last['stage'])}, loss"
            f" {last.get('loss', math.nan):.4g}"
            + ("" if score is None else f", best validation {score:.4g}")
        )
        # about ten lines per training
        has_line = done % max(self.epochs // 10, 1) == 0 or done == self.epochs
        report_progress(f"training {self.name}", done, self.epochs, line if has_line else "", score)


def run_epochs(
    name: str,
    module: EpochTraining,
    data: EpochDataModule,
    model: nn.Module,
    trained: nn.Module,
    folder: Path | None,
    machine: MachineConfig | None = None,
    extensions: TrainerExtensions | None = None,
) -> dict[str, Any]:
    """Train to the last epoch and load the best weights into the model.

    A checkpoint of an interrupted training in the folder is resumed.

    Args:
        name: name of the trained module; its checkpoint is `checkpoints/<name>/last.ckpt`.
        module: Lightning module of the training.
        data: batches of each epoch.
        model: the validated module. On return it has the weights of the best validation and no
            trainable parameters.
        trained: submodule of `model` whose parameters are counted.
        folder: folder of checkpoints and TensorBoard log; None to write neither.
        machine: hardware and precision; None for one process on the CPU.
        extensions: callbacks and logger of the user; None for none.

    Returns:
        Notes about the training: learning curve, best score, score before the first epoch (if
        validated), number of parameters.

    Raises:
        FitError: if no validation gave a finite score.
        UsageError: if the checkpoint is damaged or belongs to another training, or the machine
            lacks the device.
    """
    machine = machine or MachineConfig()
    if machine.processes > 1 and folder is None:
        with TemporaryDirectory() as temporary:
            return run_epochs(
                name, module, data, model, trained, Path(temporary), machine, extensions
            )
    extensions = extensions or TrainerExtensions()
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    settings: Epochs = module.settings
    logger = None
    last = None
    if folder is not None:
        last = folder / "checkpoints" / name / "last.ckpt"
        tensorboard = folder / "tensorboard" / name
        for path in (last, tensorboard):
            require_inside(folder, path)
        last.parent.mkdir(parents=True, exist_ok=True)
        if extensions.logger is None:
            logger = TensorBoardLogger(folder / "tensorboard", name=name, version="")
        if logger is not None and machine.processes == 1:
            # create the event file now, so that the manifest lists it even after a crash
            logger.experiment  # noqa: B018
            _record_events(logger)
    checkpoint = last if last is not None and last.is_file() else None
    trainer = L.Trainer(
        **machine.for_lightning(),
        max_epochs=settings.epochs,
        logger=extensions.logger or logger or False,
        # `EpochEnd` reports progress and writes checkpoints
        callbacks=[EpochEnd(name, settings.epochs, last), *extensions.callbacks],
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=10**9,
    )
    if checkpoint is not None:
        module.restore(_read_checkpoint(checkpoint, module.settings_digest))
    # a run that was interrupted after its last epoch needs no further training
    if not module.is_finished:
        _run_trainer(trainer, module, data, checkpoint)
        if machine.processes > 1 and last is not None:
            # the spawned processes return their result in the checkpoint
            module.restore(_read_checkpoint(last, module.settings_digest))
    module.cpu()
    notes = make_training_notes(name, module, trained)
    if logger is not None:
        _log_result(logger, module)
        _record_events(logger)
    model.load_state_dict(module.best_state)
    model.eval().requires_grad_(False)
    return notes


def make_training_notes(name: str, module: EpochTraining, trained: nn.Module) -> dict[str, Any]:
    """Return the notes about a finished training, see `run_epochs`.

    Raises:
        FitError: if no validation gave a finite score.
    """
    if not module.best_state:
        raise FitError(
            f"{name}: no epoch gave a finite free run on the validation data; lower the learning"
            " rate or the horizon"
        )
    return {
        "parameters": sum(p.numel() for p in trained.parameters()),
        "best_validation": module.best_score,
        "start_validation": module.start_score,
        "epochs": len(module.history),
        "curve": module.history,
    }


def _read_checkpoint(checkpoint: Path, settings_digest: str) -> dict[str, Any]:
    """Read the state of an `EpochTraining` from a checkpoint.

    Raises:
        UsageError: if the file is damaged or belongs to another training.
    """
    remedy = "delete it to train from the beginning"
    try:
        saved: dict[str, Any] = torch.load(checkpoint, weights_only=True)["residnet"]
        is_same_training = saved["made_of"] == settings_digest
    except Exception as error:  # torch.load documents no exceptions
        first = next(iter(str(error).splitlines()), "")[:200]
        raise UsageError(
            f"{checkpoint}: not a checkpoint of this training ({type(error).__name__}: {first});"
            f" {remedy}"
        ) from error
    if not is_same_training:
        raise UsageError(
            f"{checkpoint}: belongs to a training with other settings or another network; {remedy}"
        )
    return saved


def _run_trainer(
    trainer: L.Trainer, module: EpochTraining, data: EpochDataModule, checkpoint: Path | None
) -> None:
    """Run the trainer and raise KeyboardInterrupt, instead of exit code 1 as Lightning does.

    Raises:
        KeyboardInterrupt: if the user interrupts the training.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            trainer.fit(
                module,
                datamodule=data,
                ckpt_path=str(checkpoint) if checkpoint is not None else None,
                weights_only=True,
            )
        except SystemExit:
            if not trainer.interrupted:
                raise
    if trainer.interrupted:
        raise KeyboardInterrupt


def _record_events(logger: TensorBoardLogger) -> None:
    """Record the files of a TensorBoard log in the manifest of its run folder."""
    folder = Path(logger.log_dir)
    if (manifest := find_run_manifest(folder / "events")) is not None:
        for file in (*folder.iterdir(), folder / "hparams.yaml"):
            manifest.record(file, None)


def _log_result(logger: TensorBoardLogger, module: EpochTraining) -> None:
    """Log the settings with the best score, and a figure of the example free run."""
    flat = {
        f"{key}.{inner}" if isinstance(value, dict) else key: text
        for key, value in module.settings.model_dump(mode="json").items()
        for inner, text in (value.items() if isinstance(value, dict) else [("", value)])
    }
    hyperparameters = {
        key: v if isinstance(v, int | float | str) else str(v) for key, v in flat.items()
    }
    logger.log_hyperparams(hyperparameters, {"best_validation": module.best_score})
    if module.example is not None:
        from matplotlib.figure import Figure

        t, columns = module.example
        figure = Figure(figsize=(6.0, 1.8 * len(columns)), layout="constrained")
        panels = figure.subplots(len(columns), sharex=True, squeeze=False)[:, 0]
        for axes, (name, (measured, predicted)) in zip(panels, columns.items(), strict=True):
            axes.plot(t, measured, "k", label="measured")
            axes.plot(t, predicted, label="free run")
            axes.set_ylabel(name)
        panels[0].legend()
        panels[-1].set_xlabel("time [s]")
        logger.experiment.add_figure("free run", figure, module.epoch)
    logger.finalize("success")
