"""What an identification makes: fitted models, and who keeps them while it runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.judge.band import Band


@dataclass(frozen=True)
class FittedModel:
    """A model with the notes of its fit.

    Attributes:
        spec: everything that determines the model but its numbers.
        model: with its numbers filled in.
        notes: about the fit, as JSON takes them: coefficients, validation error, seconds, ...
        covariance: of the coefficients of a baseline that was refitted through rollouts, [P, P];
            None where there was no refit.
        bands: of its free runs by protocol; empty where none were calibrated.
    """

    spec: ModelSpec
    model: HybridDynamics
    notes: dict[str, Any]
    covariance: Tensor | None = None
    bands: Mapping[str, Band] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.spec.name


class FitStore:
    """Where the models of a fit are kept as they are done, so that a broken fit can go on.

    This one keeps no model.

    Args:
        training_folder: for checkpoints and the TensorBoard log; None for neither.
    """

    def __init__(self, training_folder: Path | None = None) -> None:
        self.training_folder = training_folder

    def finished(self, name: str) -> FittedModel | None:
        """Return a head that an earlier, interrupted fit had finished; None where it had not."""
        return None

    def keep(self, fitted: FittedModel) -> None:
        """Keep a model that is done."""


_FIRST = "baseline"


def references(models: Iterable[FittedModel]) -> dict[str, str]:
    """Return the name of each model's reference.

    A head is compared with the baseline that it was fitted on; an ensemble, which stands on none,
    with the baseline of the run that does best on the validation data; any other model with the
    run's first baseline, which itself has no reference.
    """
    known = {one.name: one for one in models}
    # a baseline that diverged is the worse one, whatever its error
    validated = {
        name: (
            int(one.notes.get("validation_diverged", 0)),
            float(one.notes.get("validation", math.inf)),
        )
        for name, one in known.items()
        if one.spec.role == "baseline"
    }
    best = min(validated, key=lambda name: validated[name], default=_FIRST)
    out = {}
    for name, one in known.items():
        named = {"head": str(one.notes.get("baseline", _FIRST)), "ensemble": best}
        reference = named.get(one.spec.role, _FIRST)
        if name != reference and reference in known:
            out[name] = reference
    return out
