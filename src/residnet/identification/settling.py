"""The settings of a fit by the standard recipe, once the logs are known."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.samples import Samples
from residnet.data.prepare import Prepared
from residnet.identification.settings import FitSettings
from residnet.identification.standard import Facts


def settled(settings: FitSettings, samples: Samples, logs: Sequence[Prepared]) -> FitSettings:
    """Return settings whose parts are those of the recipe for these logs.

    Settings without a recipe are returned as they are.

    Args:
        settings: of the fit.
        samples: of the training logs.
        logs: for training.
    """
    if settings.recipe is None:
        return settings
    step = settings.prepare.grid.step
    return settings.with_parts(Facts.of(samples, logs, settings.evaluation, step))
