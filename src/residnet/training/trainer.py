"""Training of heads with the one trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.config import TrainingConfig
from residnet.training.module import HeadTraining, Validate
from residnet.training.running import run_epochs


def train(
    name: str,
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: TrainingConfig,
    scales: torch.Tensor,
    validate: Validate,
    seed: int,
    folder: Path | None,
) -> dict[str, Any]:
    """Train the head of a model and leave the weights that validated best in it (float32).

    Args:
        name: of the head.
        model: with its baseline filled in.
        samples: training samples whose target is the residual; give the scales.
        store: training windows, float64 where the training's precision is.
        config: stages.
        scales: of the velocities, [3].
        validate: divergences and free-run error of a model on the validation data.
        seed: of weights and batches.
        folder: for checkpoints (`checkpoints/<name>/last.ckpt` is resumed from where it exists) and
            the TensorBoard log; None for neither.

    Returns:
        Notes about the training: the curve by epoch, the best score, the number of parameters.

    Raises:
        FitError: where training never gave a finite free run.
    """
    model.head.calibrate(samples)
    if config.from_baseline:
        model.head.silence()
    dtype = torch.float64 if config.double else torch.float32
    scale = scales.to(dtype)
    # losses and scores are those of velocities
    model.positions = False
    try:
        module = HeadTraining(model.to(dtype), store, config, scale, validate, seed)
        return run_epochs(name, module, model, model.head, folder, config)
    finally:
        model.to(torch.float32)
        model.positions = True
