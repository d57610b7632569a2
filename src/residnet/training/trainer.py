"""The one trainer: Lightning runs the epochs of a module on the batches of a data module.

Epochs can be resumed, the best state is kept, and the last stage stops early. TensorBoard shows
loss, validation (by axis where there are axes), learning rate, settings with the final score, and
a free run.
"""

from __future__ import annotations

import hashlib
import logging
import math
import warnings
from abc import ABC, abstractmethod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn

from residnet.core.errors import FitError, UsageError
from residnet.core.files import atomic_write
from residnet.core.ownership import find_run_manifest, require_inside
from residnet.core.progress import report_progress
from residnet.preprocessing.data_module import EpochDataModule, compute_epoch_seed
from residnet.training.config import MachineConfig, OneStage, TrainingConfig
from residnet.training.score import Shown

Epochs = OneStage | TrainingConfig
"""Settings of a training."""
_KEPT = (
    "best_score", "best_diverged", "best_state", "start_score", "without_gain", "history",
    "stopped",
)  # fmt: skip
"""What a checkpoint keeps of a training, beside Lightning's part and random numbers."""


class EpochTraining(L.LightningModule, ABC):
    """A Lightning module that `run_epochs` trains.

    Every epoch is seeded by (seed, epoch) alone, so that a run resumed at an epoch's end repeats
    the undisturbed one.

    Attributes:
        diverged: number of runs of the last validation that are unusable, free runs that diverge
            or flights that swing; weights with fewer of them are better, whatever the scores.
        axes: of the last validation, the score of each axis by name, where there are axes.
        shown: a free run of the best validation, where there is one.
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
        self.shown: Shown | None = None

    @abstractmethod
    def validated(self) -> tuple[nn.Module, float]:
        """Return the module that is kept if it is the best so far, and its score, which falls."""

    @property
    def epoch(self) -> int:
        """Epochs finished; Lightning's own count is one behind while it restores a checkpoint."""
        return len(self.history)

    @property
    def made_of(self) -> str:
        """A SHA-256 of settings, seed and tensor shapes, which a checkpoint must share."""
        shapes = {name: str(list(value.shape)) for name, value in self.state_dict().items()}
        return hashlib.sha256(f"{self.settings!r} {self.seed} {shapes}".encode()).hexdigest()

    @property
    def finished(self) -> bool:
        """Whether all epochs are done or training has stopped early."""
        return self.stopped or self.epoch >= self.settings.epochs

    def validate_start(self) -> None:
        """Validate before the first epoch, so that training is kept only where it helps."""
        model, score = self.validated()
        self.start_score = score
        if math.isfinite(score):
            self.best_score, self.best_state = score, _copied(model)

    def seed_epoch(self) -> None:
        """Seed the random numbers of the present epoch."""
        torch.manual_seed(compute_epoch_seed(self.seed, self.epoch))

    def finish_epoch(self) -> None:
        """Validate, keep the best weights, and stop early in the last stage.

        The first callback of an epoch's end calls it.
        """
        stage, _ = self.settings.stage(self.epoch)
        last = self.epoch + 1 == self.settings.epochs
        entry = {
            "epoch": float(self.epoch),
            "stage": float(stage),
        }
        loss = sum(self._losses) / max(len(self._losses), 1)
        # a loss beyond all numbers has none; JSON knows no other way to say so
        entry |= {"loss": loss} if math.isfinite(loss) else {}
        self._losses.clear()
        if last or (self.epoch + 1) % self.settings.validate_every == 0:
            model, score = self.validated()
            entry["validation"] = score
            entry["diverged"] = float(self.diverged)
            if self._gains(score):
                self.best_score, self.best_diverged, self.without_gain = score, self.diverged, 0
                self.best_state = _copied(model)
            else:
                self.without_gain += 1
        self.history.append(entry)
        logger = self.trainer.logger
        if logger is not None:
            rate = self.trainer.optimizers[0].param_groups[0]["lr"]
            axes = {f"validation_{name}": error for name, error in self.axes.items()}
            shown = {name: value for name, value in entry.items() if name != "epoch"}
            logger.log_metrics(shown | axes | {"learning_rate": rate}, step=self.epoch)
        self.stopped = (
            stage == self.settings.last_stage and self.without_gain >= self.settings.patience
        )
        self.trainer.should_stop = self.stopped

    def _gains(self, score: float) -> bool:
        if not self.best_state:
            return math.isfinite(score)
        return (self.diverged, score) < (self.best_diverged, self.best_score)

    def on_fit_start(self) -> None:
        """Reset the losses of the running epoch."""
        self._losses: list[float] = []

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the best weights, the curve, random state and thread count in the checkpoint."""
        checkpoint["residnet"] = {name: getattr(self, name) for name in _KEPT} | {
            "stage": self.settings.stage(self.epoch)[0],
            "random": torch.get_rng_state(),
            "threads": torch.get_num_threads(),
            "made_of": self.made_of,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Put back what `on_save_checkpoint` kept."""
        self.restore(checkpoint["residnet"])

    def restore(self, kept: dict[str, Any]) -> None:
        """Put back what a checkpoint kept of this module."""
        for name in _KEPT:
            setattr(self, name, kept.get(name, getattr(self, name)))
        torch.set_rng_state(kept["random"])
        torch.set_num_threads(kept["threads"])


def _copied(model: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().to("cpu", copy=True) for name, value in model.state_dict().items()}


class EpochEnd(L.Callback):
    """What happens at the end of an epoch: validation, then `last.ckpt`, then a report.

    Lightning runs callbacks before the module's own hook, and the checkpoint must hold what the
    module finished.

    Args:
        name: of what is trained, for the report; every tenth of the epochs has a line.
        epochs: in all.
        checkpoint: file, written whole or not at all; None for none.
    """

    def __init__(self, name: str, epochs: int, checkpoint: Path | None) -> None:
        self.name, self.epochs, self.checkpoint = name, epochs, checkpoint

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Finish the epoch, keep it, and report loss and the best validation."""
        assert isinstance(pl_module, EpochTraining)
        pl_module.finish_epoch()
        if self.checkpoint is not None and trainer.is_global_zero:
            with atomic_write(self.checkpoint) as file:
                trainer.save_checkpoint(file)
        elif self.checkpoint is not None:
            # the processes wait for each other there; the first alone writes
            trainer.save_checkpoint(self.checkpoint)
        done, last = trainer.current_epoch + 1, pl_module.history[-1]
        score = pl_module.best_score if math.isfinite(pl_module.best_score) else None
        line = (
            f"  {self.name}: epoch {done}/{self.epochs}, stage {int(last['stage'])}, loss"
            f" {last.get('loss', math.nan):.4g}"
            + ("" if score is None else f", best validation {score:.4g}")
        )
        shown = done % max(self.epochs // 10, 1) == 0 or done == self.epochs
        report_progress(f"training {self.name}", done, self.epochs, line if shown else "", score)


def run_epochs(
    name: str,
    module: EpochTraining,
    data: EpochDataModule,
    model: nn.Module,
    trained: nn.Module,
    folder: Path | None,
    machine: MachineConfig | None = None,
) -> dict[str, Any]:
    """Train to the last epoch and leave the best state in the model.

    Where a folder holds a checkpoint of an interrupted training, that training goes on.

    Args:
        name: of what is trained; `checkpoints/<name>/last.ckpt` in the folder is resumed where it
            exists.
        module: that trains it.
        data: its batches.
        model: that is validated; it ends frozen, with the weights that scored best.
        trained: its part whose parameters are counted.
        folder: for checkpoints and the TensorBoard log; None for neither.
        machine: that trains; None for one process on the CPU.

    Returns:
        Notes about the training: the curve by epoch, the best score, that of the start where it was
        validated, the number of parameters.

    Raises:
        FitError: where no epoch gave a finite validation.
        UsageError: where the checkpoint is damaged or belongs to another training, or the machine
            lacks a device.
    """
    machine = machine or MachineConfig()
    if machine.processes > 1 and folder is None:
        with TemporaryDirectory() as temporary:
            return run_epochs(name, module, data, model, trained, Path(temporary), machine)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    settings: Epochs = module.settings
    logger, last = None, None
    if folder is not None:
        last = folder / "checkpoints" / name / "last.ckpt"
        tensorboard = folder / "tensorboard" / name
        for path in (last, tensorboard):
            require_inside(folder, path)
        last.parent.mkdir(parents=True, exist_ok=True)
        logger = TensorBoardLogger(folder / "tensorboard", name=name, version="")
        if machine.processes == 1:
            # the first use of it makes the file of events, which a killed training leaves
            logger.experiment  # noqa: B018
            _record_events(logger)
    # a checkpoint that is there is taken up
    checkpoint = last if last is not None and last.is_file() else None
    trainer = L.Trainer(
        **machine.for_lightning(),
        max_epochs=settings.epochs,
        gradient_clip_val=settings.gradient_clip,
        logger=logger if logger is not None else False,
        callbacks=[EpochEnd(name, settings.epochs, last)],
        # what it would print and keep is printed and kept here
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=10**9,
    )
    if checkpoint is not None:
        module.restore(_kept(checkpoint, module.made_of))
    # killed between the last epoch and the model's file: there is nothing left to train
    if not module.finished:
        _fit(trainer, module, data, checkpoint)
        if machine.processes > 1 and last is not None:
            # other processes have trained: what they found stands in the checkpoint
            module.restore(_kept(last, module.made_of))
    module.cpu()
    if not module.best_state:
        raise FitError(
            f"{name}: no epoch gave a finite free run on the validation data; lower the learning"
            " rate or the horizon"
        )
    if logger is not None:
        _conclude(logger, module)
        _record_events(logger)
    model.load_state_dict(module.best_state)
    model.eval().requires_grad_(False)
    return {
        "parameters": sum(p.numel() for p in trained.parameters()),
        "best_validation": module.best_score,
        "start_validation": module.start_score,
        "epochs": len(module.history),
        "curve": module.history,
    }


def _kept(checkpoint: Path, made_of: str) -> dict[str, Any]:
    """Return what a checkpoint keeps of a training.

    Raises:
        UsageError: where it is cut off, edited or of another training.
    """
    what_to_do = "delete it to train from the beginning"
    try:
        kept: dict[str, Any] = torch.load(checkpoint, weights_only=True)["residnet"]
        belongs = kept["made_of"] == made_of
    except Exception as error:  # PyTorch raises whatever it likes
        first = next(iter(str(error).splitlines()), "")[:200]
        raise UsageError(
            f"{checkpoint}: is no checkpoint of this training ({type(error).__name__}: {first});"
            f" {what_to_do}"
        ) from error
    if not belongs:
        raise UsageError(
            f"{checkpoint}: belongs to a training with other settings or another network;"
            f" {what_to_do}"
        )
    return kept


def _fit(
    trainer: L.Trainer, module: EpochTraining, data: EpochDataModule, checkpoint: Path | None
) -> None:
    """Train; an interruption is passed on, where Lightning would end the process with exit code 1.

    Raises:
        KeyboardInterrupt: from the keyboard.
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


def _conclude(logger: TensorBoardLogger, module: EpochTraining) -> None:
    """Log the settings with the best score, and a picture of a free run."""
    flat = {
        f"{key}.{inner}" if isinstance(value, dict) else key: text
        for key, value in module.settings.model_dump(mode="json").items()
        for inner, text in (value.items() if isinstance(value, dict) else [("", value)])
    }
    given = {key: v if isinstance(v, int | float | str) else str(v) for key, v in flat.items()}
    logger.log_hyperparams(given, {"best_validation": module.best_score})
    if module.shown is not None:
        from matplotlib.figure import Figure

        t, columns = module.shown
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
