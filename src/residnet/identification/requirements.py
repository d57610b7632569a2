"""What a fit asks of its logs, checked before any part is fitted."""

from __future__ import annotations

from residnet.core.errors import FitError
from residnet.data.windows import WindowStore
from residnet.heads import ClosedFormHead
from residnet.identification.fitter import Fitter
from residnet.identification.models import NoStore
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.training.config import TrainingConfig
from residnet.training.refit import free_run_starts
from residnet.training.stage_windows import stage_windows


def require_fit(logs: PreparedSplits, settings: FitSettings) -> Fitter:
    """Check that prepared logs hold the manoeuvres, folds and windows that a fit asks for.

    The fit itself calls the same functions, so that it refuses with the same lines.

    Returns:
        What would fit the parts, nothing fitted yet.

    Raises:
        DataError: where a split holds no sample, or no window of a protocol or of a training.
        FitError: where manoeuvres are missing that a baseline is fitted on, are too few for the
            folds of a head, or too short for a refit.
    """
    fitter = Fitter(logs, settings, NoStore())
    step, windows = settings.prepare.grid.step, WindowStore.gather(fitter.train)
    for baseline in settings.all_baselines.values():
        baseline.require_samples(fitter.samples)
    for refit in settings.refit.values():
        free_run_starts(windows, refit, step)
    for name, config in settings.heads.items():
        head = config.build(fitter.signals.names)
        if isinstance(head, ClosedFormHead):
            try:
                head.require_samples(fitter.samples)
            except FitError as error:
                raise FitError(f"head {name}: {error}") from None
        else:
            stage_windows(settings.training.get(name, TrainingConfig()), windows, step)
    return fitter
