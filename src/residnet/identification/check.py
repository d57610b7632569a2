"""Check that prepared logs suffice for a fit, without fitting and without PyTorch."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.errors import FitError
from residnet.evaluation.protocol import make_windows
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.preprocessing.prepare import find_sample_origins
from residnet.preprocessing.window_index import WindowIndex
from residnet.training.config import TrainingConfig


def check_fit(logs: PreparedSplits, settings: FitSettings) -> FitSettings:
    """Check that prepared logs hold the manoeuvres, folds and windows that a fit requires.

    The fit calls the same functions and therefore refuses with the same messages.

    Args:
        logs: prepared logs by split.
        settings: settings of the fit. The parts of a recipe, and trainings without stages, follow
            from values of the logs and are computed with PyTorch.

    Returns:
        The settings with the parts and trainings for these logs.

    Raises:
        DataError: if a split holds no sample, or no window of a protocol or of a training.
        FitError: if manoeuvres that a baseline requires are missing, too few for the folds of a
            head, or too short for a refit.
    """
    training_samples = find_sample_origins(logs["train"])
    find_sample_origins(logs["validation"])
    names = settings.signals.channel_names()
    if settings.recipe is not None or _has_derived_training(settings, names):
        from residnet.identification.fitter import derive_settings

        settings = derive_settings(logs["train"], settings)
    dt = settings.prepare.grid.step
    evaluation = settings.evaluation
    make_windows(
        evaluation.protocols[evaluation.selection],
        logs["validation"],
        dt,
        evaluation.selection,
        is_overlapping=settings.recipe is not None,
    )
    for baseline in settings.all_baselines.values():
        baseline.validate_samples(training_samples)
    index = WindowIndex.from_logs(logs["train"])
    for refit_config in settings.refit.values():
        refit_config.find_free_run_starts(index, dt)
    for name, config in settings.heads.items():
        if config.has_closed_form(names):
            try:
                config.validate_samples(training_samples)
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
            continue
        for stage in settings.training.get(name, TrainingConfig()).windows(dt):
            if stage is not None:
                stage.check(index)
    return settings


def _has_derived_training(settings: FitSettings, names: Sequence[str]) -> bool:
    """Return whether the schedule of a network follows from the logs."""
    return any(
        settings.training.get(name, TrainingConfig()).is_derived
        for name, config in settings.heads.items()
        if not config.has_closed_form(names)
    )
