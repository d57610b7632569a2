"""What an identification makes: fitted models, and who keeps them while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

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


class FitStore(Protocol):
    """Where the models of a fit are kept as they are done, so that a broken fit can go on."""

    @property
    def training_folder(self) -> Path | None:
        """Folder for checkpoints and the TensorBoard log; None for neither."""

    def finished(self, name: str) -> FittedModel | None:
        """Return a head that an earlier, interrupted fit had finished; None where it had not."""

    def keep(self, fitted: FittedModel) -> None:
        """Keep a model that is done."""


class NoStore:
    """A fit that keeps nothing on disk."""

    training_folder: Path | None = None

    def finished(self, name: str) -> FittedModel | None:
        """Return None: every head is fitted anew."""
        return None

    def keep(self, fitted: FittedModel) -> None:
        """Leave the disk as it is: nothing is kept."""


_FIRST = "baseline"


def references(roles: Mapping[str, str], notes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the name of each model's reference.

    A head is compared with the baseline that it was fitted on; an ensemble, which stands on none,
    with the baseline of the run that does best on the validation data; any other model with the
    run's first baseline, which itself has no reference.

    Args:
        roles: zero, baseline, head, ensemble or truth by model.
        notes: contents of models/<model>/fit.json by model; a head's `baseline` and the baselines'
            `validation` and `validation_diverged` are read.
    """
    # a baseline that diverged is the worse one, whatever its error
    validated = {
        name: (
            int(notes[name].get("validation_diverged", 0)),
            float(notes[name].get("validation", math.inf)),
        )
        for name, role in roles.items()
        if role == "baseline"
    }
    best = min(validated, key=lambda name: validated[name], default=_FIRST)
    out = {}
    for name, role in roles.items():
        named = {
            "head": str(notes[name].get("baseline", _FIRST)) if name in notes else _FIRST,
            "ensemble": best,
        }
        out[name] = named.get(role, _FIRST)
    return {
        name: reference
        for name, reference in out.items()
        if name != reference and reference in roles
    }
