"""The fit: prepared logs to baselines, heads and ensembles, judged in free run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from residnet.core.progress import say
from residnet.data.prepare import Prepared
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import MeasuredLogs
from residnet.identification.evaluation import Evaluation, candidates, evaluate
from residnet.identification.fitter import Fitter
from residnet.identification.models import FitStore, FittedModel, NoStore
from residnet.identification.selecting import examine, select
from residnet.identification.settings import FitSettings
from residnet.identification.standard import TIED
from residnet.judge.verdict.sanity import Finding
from residnet.judge.verdict.selection import Selection


@dataclass(frozen=True)
class Identified(Mapping[str, FittedModel]):
    """The fitted models by name: zero, baselines, heads and ensembles, in this order.

    Attributes:
        settings: of the fit.
        models: by name.
        limit: of |u, v, r| [3] beyond which a free run has diverged.
        train: the logs that fitted them.
    """

    settings: FitSettings
    models: dict[str, FittedModel]
    limit: np.ndarray
    train: Sequence[Prepared]

    def evaluate(
        self, logs: Sequence[Prepared], data: MeasuredLogs | SimulatedTrials | None = None
    ) -> Evaluation:
        """Free-run all models over the logs of one split.

        Args:
            logs: of one split, prepared as those of the fit.
            data: where the logs came from; simulated trials add the plant as `truth`.
        """
        settings = self.settings
        models = candidates(self.values(), data)
        return evaluate(models, logs, settings.evaluation, settings.prepare.grid.step, self.limit)

    @cached_property
    def findings(self) -> dict[str, list[Finding]]:
        """What the checks for physical sanity find, by model; `zero` is left out."""
        return self.findings_of(list(self.values()))

    def findings_of(self, fitted: Sequence[FittedModel]) -> dict[str, list[Finding]]:
        """Return what the checks for physical sanity find of some models."""
        step = self.settings.prepare.grid.step
        return examine(fitted, self.train, self.settings.evaluation, step)

    def select(self, judged: Mapping[str, Evaluation]) -> Selection:
        """Choose a single model and an ensemble by their free runs.

        Args:
            judged: what `evaluate` returned, by split; `validation` is needed, and divergences on
                `train` count where it is there.

        Raises:
            UsageError: where the validation logs have not been judged.
        """
        return select(self.values(), judged, self.findings, self.settings.evaluation)

    def __getitem__(self, name: str) -> FittedModel:
        return self.models[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)


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
    fitter = Fitter(logs, settings, store or NoStore())
    settings = fitter.settings
    models = {"zero": fitter.zero()}
    for name in settings.all_baselines:
        models[name] = fitter.baseline(name)
        say(f"  {name}: {_said(models[name])}")
    for name in settings.heads:
        say(f"  fitting {name}")
        begin = settings.training[name].begin_with if name in settings.training else None
        base = models[settings.baseline_name_of(name)]
        models[name] = fitter.head(name, base, None if begin is None else models[begin])
        say(f"  {name}: {_said(models[name])} after {models[name].notes['seconds']:.1f} s")
    for name, members in settings.ensembles.items():
        models[name] = fitter.ensemble(name, [models[member] for member in members])
        say(f"  {name}: {_said(models[name])}")
    identified = Identified(settings, models, fitter.limit, fitter.train)
    if settings.recipe is not None:
        _add_tied(identified, fitter, logs)
    return identified


def _add_tied(
    identified: Identified, fitter: Fitter, logs: Mapping[str, Sequence[Prepared]]
) -> None:
    """Add the mean of the models that validation data cannot tell from the best."""
    judged = {split: identified.evaluate(logs[split]) for split in ("train", "validation")}
    chosen = identified.select(judged)
    if len(chosen.tied) < 2:
        say("  tied: no model comes within one standard error of the best; there is no mean")
        return
    model = fitter.ensemble(TIED, [identified.models[name] for name in chosen.tied])
    identified.models[TIED] = model
    identified.findings.update(identified.findings_of([model]))
    say(f"  {TIED}: {_said(model)} (mean of {', '.join(chosen.tied)})")


def _said(fitted: FittedModel) -> str:
    """The validation error of a model in words, its divergences beside it."""
    diverged = fitted.notes.get("validation_diverged", 0)
    lost = f" ({diverged} windows DIVERGED)" if diverged else ""
    return f"validation free-run error {fitted.notes['validation']:.4f}{lost}"
