"""What every training of a network has: resumable epochs, the best state, early stopping."""

from __future__ import annotations

import hashlib
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
        """Number of epochs between validations."""

    def stage(self, epoch: int) -> tuple[int, int]:
        """Return (stage, epoch within it)."""

    @property
    def last_stage(self) -> int:
        """Number of the stage that may stop early."""


class EpochTraining(L.LightningModule, ABC):
    """A Lightning module that `run_epochs` trains.

    Every epoch is seeded by (seed, epoch) alone, so that a run resumed at an epoch's end repeats
    the undisturbed one.

    Attributes:
        diverged: number of runs of the last validation that are unusable, free runs that diverge
            or flights that swing; weights with fewer of them are better, whatever the scores.
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
        torch.manual_seed((self.seed * 7_919 + self.epoch) % (2**63))

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
            logger.log_metrics({k: v for k, v in entry.items() if k != "epoch"}, step=self.epoch)
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
        checkpoint["residnet"] = {
            "best_score": self.best_score,
            "best_diverged": self.best_diverged,
            "best_state": self.best_state,
            "start_score": self.start_score,
            "without_gain": self.without_gain,
            "history": self.history,
            "stopped": self.stopped,
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
        self.best_score, self.best_state, self.without_gain = (
            kept["best_score"],
            kept["best_state"],
            kept["without_gain"],
        )
        self.best_diverged = kept.get("best_diverged", 0)
        self.start_score = kept.get("start_score")
        self.history, self.stopped = kept["history"], kept["stopped"]
        torch.set_rng_state(kept["random"])
        torch.set_num_threads(kept["threads"])


def _copied(model: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().to("cpu", copy=True) for name, value in model.state_dict().items()}
