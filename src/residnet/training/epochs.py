"""What every training has in common: epochs that repeat themselves when resumed, the best state so far, the curve, early stopping."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Protocol

import lightning as L
import torch
from torch import Tensor, nn


class Epochs(Protocol):
    """Settings of a training, as far as the trainer needs them."""

    @property
    def epochs(self) -> int:
        """Of all stages together."""

    @property
    def gradient_clip(self) -> float:
        """Largest norm of the gradient."""

    @property
    def patience(self) -> int:
        """Validations without gain after which the last stage ends."""

    @property
    def validate_every(self) -> int:
        """Epochs between validations."""

    def stage(self, epoch: int) -> tuple[int, int]:
        """(stage, epoch within it)."""

    @property
    def last_stage(self) -> int:
        """Number of the stage that may stop early."""


class EpochTraining(L.LightningModule, ABC):
    """A Lightning module that `run_epochs` trains.

    Every epoch is seeded by (seed, epoch) alone, so that a run resumed at an epoch's end repeats the undisturbed one.
    """

    def __init__(self, settings: Epochs, seed: int) -> None:
        super().__init__()
        self.settings: Any = settings
        self.seed = seed
        self.best_score = math.inf
        self.best_state: dict[str, Tensor] = {}
        self.without_gain = 0
        self.stopped = False
        self.history: list[dict[str, float]] = []

    @abstractmethod
    def validated(self) -> tuple[nn.Module, float]:
        """The module that is kept if it is the best so far, and its score: less is better."""

    @property
    def epoch(self) -> int:
        """Epochs finished; Lightning's own count is one behind while it restores a checkpoint."""
        return len(self.history)

    @property
    def finished(self) -> bool:
        """Whether all epochs are done or training has stopped early."""
        return self.stopped or self.epoch >= self.settings.epochs

    def seed_epoch(self) -> None:
        """Random numbers of the present epoch."""
        torch.manual_seed((self.seed * 7_919 + self.epoch) % (2**63))

    def finish_epoch(self) -> None:
        """Validate; keep the best weights; stop early in the last stage. Called by the first callback of an epoch's end."""
        stage, _ = self.settings.stage(self.epoch)
        last = self.epoch + 1 == self.settings.epochs
        entry = {"epoch": float(self.epoch), "stage": float(stage), "loss": sum(self._losses) / max(len(self._losses), 1)}
        self._losses.clear()
        if last or (self.epoch + 1) % self.settings.validate_every == 0:
            model, score = self.validated()
            entry["validation"] = score
            if score < self.best_score:
                self.best_score, self.without_gain = score, 0
                self.best_state = {name: value.detach().clone() for name, value in model.state_dict().items()}
            else:
                self.without_gain += 1
        self.history.append(entry)
        logger = self.trainer.logger
        if logger is not None:
            logger.log_metrics({k: v for k, v in entry.items() if k != "epoch"}, step=self.epoch)
        self.stopped = stage == self.settings.last_stage and self.without_gain >= self.settings.patience
        self.trainer.should_stop = self.stopped

    def on_fit_start(self) -> None:
        """Losses of the running epoch."""
        self._losses: list[float] = []

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Beside weights and optimiser: the best weights, the curve, random state and thread count."""
        checkpoint["residnet"] = {
            "best_score": self.best_score,
            "best_state": self.best_state,
            "without_gain": self.without_gain,
            "history": self.history,
            "stopped": self.stopped,
            "stage": self.settings.stage(self.epoch)[0],
            "random": torch.get_rng_state(),
            "threads": torch.get_num_threads(),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Put back what `on_save_checkpoint` kept."""
        self.restore(checkpoint["residnet"])

    def restore(self, own: dict[str, Any]) -> None:
        """Put back what a checkpoint kept of this module."""
        self.best_score, self.best_state, self.without_gain = own["best_score"], own["best_state"], own["without_gain"]
        self.history, self.stopped = own["history"], own["stopped"]
        torch.set_rng_state(own["random"])
        torch.set_num_threads(own["threads"])
