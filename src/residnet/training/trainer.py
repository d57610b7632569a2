"""One trainer for all networks: Lightning with checkpoints that survive a kill, TensorBoard and a progress line."""

from __future__ import annotations

import logging
import sys
import warnings
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.config import TrainingConfig
from residnet.training.epochs import Epochs, EpochTraining
from residnet.training.module import HeadTraining, Validate


class FinishEpoch(L.Callback):
    """Lets the module finish its epoch before the checkpoint is written: Lightning runs callbacks before the module's own hook."""

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Validate."""
        assert isinstance(pl_module, EpochTraining)
        pl_module.finish_epoch()


class KeepCheckpoint(L.Callback):
    """Writes `last.ckpt` after every epoch, whole or not at all."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write beside the old one, then put it in place."""
        partial = self.path.with_suffix(".partial")
        trainer.save_checkpoint(partial)
        partial.replace(self.path)


class ProgressLine(L.Callback):
    """One line that is rewritten on a terminal; a line every tenth of the epochs elsewhere."""

    def __init__(self, name: str, epochs: int) -> None:
        self.name = name
        self.epochs = epochs

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Show epoch, loss and the best validation."""
        assert isinstance(pl_module, EpochTraining)
        done, last = trainer.current_epoch + 1, pl_module.history[-1]
        text = f"  {self.name}: epoch {done}/{self.epochs}, stage {int(last['stage'])}, loss {last['loss']:.4g}"
        text += f", best validation {pl_module.best_score:.4g}"
        if sys.stderr.isatty():
            print(f"\r{text}\033[K", end="\n" if done == self.epochs or trainer.should_stop else "", file=sys.stderr, flush=True)
        elif done % max(self.epochs // 10, 1) == 0 or done == self.epochs:
            print(text, file=sys.stderr, flush=True)


def train(
    name: str,
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: TrainingConfig,
    scales: torch.Tensor,
    validate: Validate,
    seed: int,
    folder: Path,
) -> dict[str, Any]:
    """Train the head of a model and leave the weights that validated best in it (float32).

    Args:
        name: of the head.
        model: with its baseline filled in.
        samples: training samples whose target is the residual; give the scales.
        store: training windows.
        config: stages.
        scales: of the velocities, [3].
        validate: free-run error of a model on the validation data.
        seed: of weights and batches.
        folder: of the run; `checkpoints/<name>/last.ckpt` is resumed from where it exists.

    Returns:
        What there is to say: the curve by epoch, the best score, the number of parameters.

    Raises:
        FitError: where training never gave a finite free run.
    """
    model.head.calibrate(samples)
    module = HeadTraining(model.to(torch.float32), store, config, scales.to(torch.float32), validate, seed)
    run_epochs(name, module, config, folder)
    if not module.best_state:
        raise FitError(f"head {name}: no epoch gave a finite free run on the validation data; lower the learning rate or the horizon")
    model.load_state_dict(module.best_state)
    model.eval().requires_grad_(False)
    return {
        "parameters": sum(p.numel() for p in model.head.parameters()),
        "best_validation": module.best_score,
        "epochs": len(module.history),
        "curve": module.history,
    }


def run_epochs(name: str, module: EpochTraining, config: Epochs, folder: Path) -> None:
    """Train a module to its last epoch, from its last checkpoint where there is one; Ctrl-C leaves one to resume from."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    checkpoints = folder / "checkpoints" / name
    checkpoints.mkdir(parents=True, exist_ok=True)
    last = checkpoints / "last.ckpt"
    trainer = L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=config.epochs,
        gradient_clip_val=config.gradient_clip,
        logger=TensorBoardLogger(folder / "tensorboard", name=name, version=""),
        callbacks=[FinishEpoch(), KeepCheckpoint(last), ProgressLine(name, config.epochs)],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=10**9,
    )
    if last.is_file():
        module.restore(torch.load(last, weights_only=True)["residnet"])
    # killed between the last epoch and the model's file: there is nothing left to train
    if not module.finished:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trainer.fit(module, ckpt_path=str(last) if last.is_file() else None, weights_only=True)
    if trainer.interrupted:
        raise KeyboardInterrupt
