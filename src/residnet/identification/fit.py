"""The fit: prepared logs to baselines, heads and ensembles, judged in free run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from residnet.core.errors import DataError, FitError, MissingPackageError
from residnet.core.progress import say
from residnet.data.prepare import Prepared
from residnet.heads.genetic import GeneticConfig
from residnet.identification.bands.calibrating import calibrate_bands
from residnet.identification.fitter import Fitter
from residnet.identification.identified import Identified
from residnet.identification.models import FitStore, NoStore
from residnet.identification.parts import fit_parts, said
from residnet.identification.settings import FitSettings
from residnet.identification.standard import TIED
from residnet.judge.verdict.selection import Selection


def fit(
    logs: Mapping[str, Sequence[Prepared]], settings: FitSettings, *, store: FitStore | None = None
) -> Identified:
    """Fit the baselines, then heads on what each leaves, then ensembles.

    Args:
        logs: prepared logs by split; `train` is fitted, `validation` chooses and stops early.
        settings: of the fit.
        store: keeps every model as it is done and hands finished heads back; None to keep none.

    Raises:
        FitError: where the data do not determine a part, or a training never ran freely.
        DataError: where a split holds no sample or no window.
    """
    given, fitter = settings, Fitter(logs, settings, store or NoStore())
    settings = fitter.settings
    models = {"zero": fitter.zero()}
    fit_parts(fitter, logs, given, models, _optional)
    for name, force in settings.forces.items():
        if force.of in models:
            models[name] = fitter.with_force(name, models[force.of], force)
            say(f"  {name}: {said(models[name])}")
    for name, members in settings.ensembles.items():
        models[name] = fitter.ensemble(name, [models[member] for member in members])
        say(f"  {name}: {said(models[name])}")
    for name, gate in settings.gates.items():
        if gate.of in models:
            models[name] = fitter.gated(name, models[gate.of], gate)
            say(f"  {name}: {said(models[name])}")
    identified = Identified(settings, models, fitter.limit, fitter.train, fitter.crossed)
    if settings.recipe is not None:
        _add_tied(identified, fitter, logs)
    if settings.bands is not None:
        identified.models.update(calibrate_bands(identified, logs["validation"], settings.bands))
        for model in identified.values():
            fitter.store.keep(model)
    return identified


@contextmanager
def _optional(settings: FitSettings, name: str) -> Iterator[None]:
    """Leave a model out that the recipe can do without, or whose optional package is not installed.

    The recipe does without what the logs do not determine, except its first model. A head of kind
    `genetic` can be `optional`.

    Raises:
        FitError: of a model that was asked for by name, or of the recipe's first.
        MissingPackageError: of a head that is not optional.
    """
    head = settings.heads.get(name)
    try:
        yield
    except MissingPackageError as error:
        if not (isinstance(head, GeneticConfig) and head.optional):
            raise
        say(f"  {name} is left out: {error}")
    except (DataError, FitError) as error:
        if settings.recipe is None or name == "baseline":
            raise
        say(f"  {name} is left out: {error}")


def _add_tied(
    identified: Identified, fitter: Fitter, logs: Mapping[str, Sequence[Prepared]]
) -> None:
    """Add the mean of the models that validation data cannot tell from the best."""
    judged = identified.evaluate_splits({split: logs[split] for split in ("train", "validation")})
    chosen = identified.select(judged)
    # a mean of accelerations has no place for a force that one member estimates for itself
    tied = [n for n in _apart(chosen) if identified.models[n].spec.disturbance is None]
    if len(tied) < 2:
        say("  tied: no model is as good as the best; there is no mean")
        return
    model = fitter.ensemble(TIED, [identified.models[name] for name in tied])
    identified.models[TIED] = model
    identified.findings.update(identified.findings_of([model]))
    say(f"  {TIED}: {said(model)} (mean of {', '.join(tied)})")


def _apart(chosen: Selection) -> list[str]:
    """Return the tied models without those that err as another one does, to the last digit.

    A training that gained nothing ends where it began, and would count twice in a mean.
    """
    errors = {e.name: e.scores.tobytes() for e in chosen.contenders}
    first = {errors[name]: name for name in reversed(chosen.tied)}
    return [name for name in chosen.tied if first[errors[name]] == name]
