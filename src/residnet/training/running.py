"""The one trainer: Lightning runs the epochs of a module, with checkpoints and progress."""

from __future__ import annotations

import logging
import math
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import nn

from residnet.core.errors import FitError, UsageError
from residnet.core.files import whole
from residnet.core.progress import report
from residnet.training.epochs import Epochs, EpochTraining
from residnet.training.machine import MachineConfig


class FinishEpoch(L.Callback):
    """A callback that lets the module finish its epoch before the checkpoint is written.

    Lightning runs callbacks before the module's own hook.
    """

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Run the module's own end of the epoch."""
        assert isinstance(pl_module, EpochTraining)
        pl_module.finish_epoch()


class KeepCheckpoint(L.Callback):
    """Writes `last.ckpt` after every epoch, whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write beside the old one, then put it in place; the first process alone writes."""
        if not trainer.is_global_zero:
            # the processes wait for each other there
            trainer.save_checkpoint(self.path)
            return
        with whole(self.path) as file:
            trainer.save_checkpoint(file)


class ReportProgress(L.Callback):
    """A callback that reports every epoch, and every tenth of the epochs with a line."""

    def __init__(self, name: str, epochs: int) -> None:
        self.name = name
        self.epochs = epochs

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Report the epoch, and now and then loss and the best validation."""
        assert isinstance(pl_module, EpochTraining)
        done, last = trainer.current_epoch + 1, pl_module.history[-1]
        line = (
            f"  {self.name}: epoch {done}/{self.epochs}, stage {int(last['stage'])}, loss"
            f" {last.get('loss', math.nan):.4g}, best validation {pl_module.best_score:.4g}"
        )
        shown = done % max(self.epochs // 10, 1) == 0 or done == self.epochs
        score = pl_module.best_score if math.isfinite(pl_module.best_score) else None
        report(f"training {self.name}", done, self.epochs, line if shown else "", score)


def run_epochs(
    name: str,
    module: EpochTraining,
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
            return run_epochs(name, module, model, trained, Path(temporary), machine)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    settings: Epochs = module.settings
    callbacks: list[L.Callback] = [FinishEpoch(), ReportProgress(name, settings.epochs)]
    logger, last = None, None
    if folder is not None:
        last = folder / "checkpoints" / name / "last.ckpt"
        last.parent.mkdir(parents=True, exist_ok=True)
        callbacks.insert(1, KeepCheckpoint(last))
        logger = TensorBoardLogger(folder / "tensorboard", name=name, version="")
    # a checkpoint that is there is taken up
    checkpoint = last if last is not None and last.is_file() else None
    trainer = _trainer(settings, callbacks, logger, machine)
    if checkpoint is not None:
        module.restore(_kept(checkpoint, module.made_of))
    # killed between the last epoch and the model's file: there is nothing left to train
    if not module.finished:
        _fit(trainer, module, checkpoint)
        if machine.processes > 1 and last is not None:
            # other processes have trained: what they found stands in the checkpoint
            module.restore(_kept(last, module.made_of))
    module.cpu()
    if not module.best_state:
        raise FitError(
            f"{name}: no epoch gave a finite free run on the validation data; lower the learning"
            " rate or the horizon"
        )
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


def _fit(trainer: L.Trainer, module: EpochTraining, checkpoint: Path | None) -> None:
    """Train; an interruption is passed on, where Lightning would end the process with exit code 1.

    Raises:
        KeyboardInterrupt: from the keyboard.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            trainer.fit(
                module,
                ckpt_path=str(checkpoint) if checkpoint is not None else None,
                weights_only=True,
            )
        except SystemExit:
            if not trainer.interrupted:
                raise
    if trainer.interrupted:
        raise KeyboardInterrupt


def _trainer(
    settings: Epochs,
    callbacks: list[L.Callback],
    logger: TensorBoardLogger | None,
    machine: MachineConfig,
) -> L.Trainer:
    """Return a trainer that prints nothing and keeps no checkpoints of its own."""
    return L.Trainer(
        **machine.for_lightning(),
        max_epochs=settings.epochs,
        gradient_clip_val=settings.gradient_clip,
        logger=logger if logger is not None else False,
        callbacks=callbacks,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=10**9,
    )
