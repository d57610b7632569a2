"""Identification of the ferry's force residual from one course (document 002, chapter 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from residnet.control.motion.anticipation import Lag
from residnet.documents.jervan2020.ferry.config import FerryModelConfig
from residnet.documents.jervan2020.regressions import Fit
from residnet.documents.jervan2020.residual_model import Record, fit_model, unseen_mse
from residnet.physics.force_model import ForceModel


@dataclass(frozen=True)
class FerryModel:
    """A fitted model of the ferry.

    Attributes:
        model: F = F_0 + corrections.
        lag: lag of the thrusters; None where it was not fitted.
        fit: coefficients.
        test_mse: mean square of the remaining residual on the test half, by axis in N^2, N^2,
            (N m)^2; against the command, or for a model with lag against the lagged command.
        notes: what the estimator chose.
    """

    model: ForceModel
    lag: Lag | None
    fit: Fit
    test_mse: list[float]
    notes: dict[str, Any]


def identify(config: FerryModelConfig, record: Record, base: ForceModel) -> FerryModel:
    """Fit one model on the training samples and judge it on the test samples as they were logged.

    Raises:
        FitError: where the data do not determine the model.
    """
    used = record.smoothed() if config.smooth else record
    model, lag, fit, notes = fit_model(config, used, base)
    return FerryModel(model, lag, fit, unseen_mse(model, lag, record), notes)
