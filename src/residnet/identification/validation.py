"""The free-run score on validation logs that chooses between models and stops training early."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import Candidate, FreeRun, free_run
from residnet.judge.metrics import window_errors
from residnet.judge.protocol import all_windows, overlapping
from residnet.training.module import Score


class ValidationScore:
    """The free-run score of a model on the validation logs; the windows are laid out once.

    Args:
        logs: of the validation split.
        config: its `selection` protocol and scales are used.
        step: of the grid in s.
        limit: of |u, v, r| [3] beyond which a free run has diverged.
        dense: windows overlap, so that few logs tell more.

    Raises:
        DataError: where no log holds a window of the protocol.
    """

    def __init__(
        self,
        logs: Sequence[Prepared],
        config: EvaluationConfig,
        step: float,
        limit: np.ndarray,
        *,
        dense: bool = False,
    ) -> None:
        self.logs = logs
        self.step = step
        self.limit = limit
        self.scales = config.scales.array()
        protocol = config.protocols[config.selection]
        self.windows = all_windows(
            overlapping(protocol) if dense else protocol, logs, step, config.selection
        )

    def __call__(self, model: HybridDynamics) -> Score:
        """Return the divergences and the mean nrmse of the validation windows, run in float32."""
        candidate = Candidate("validated", "head", model)
        predictions = free_run(
            [candidate], self.windows, self.logs, self.step, self.limit, dtype=torch.float32
        )
        errors = window_errors(FreeRun("", "", self.windows, predictions), "validated", self.logs)
        diverged = sum(prediction.diverged for prediction in predictions["validated"])
        return Score(diverged, float((errors["rmse"].mean(0) / self.scales).mean()))
