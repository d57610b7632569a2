"""What a fit comes to: its models by name, and what they are judged by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from residnet.data.prepare import Prepared
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import MeasuredLogs
from residnet.identification.cross_fitting.crossed import Crossed
from residnet.identification.evaluation import Evaluation, candidates, evaluate_splits
from residnet.identification.models import FittedModel
from residnet.identification.selecting import examine, select
from residnet.identification.settings import FitSettings
from residnet.judge.freerun import FreeRun, free_run
from residnet.judge.protocol import all_windows, overlapping
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
        crossed: errors of the baselines over folds of the logs; None where none were needed.
    """

    settings: FitSettings
    models: dict[str, FittedModel]
    limit: np.ndarray
    train: Sequence[Prepared]
    crossed: Crossed | None = None

    def evaluate(
        self, logs: Sequence[Prepared], data: MeasuredLogs | SimulatedTrials | None = None
    ) -> Evaluation:
        """Free-run all models over the logs of one split.

        Args:
            logs: of one split, prepared as those of the fit.
            data: where the logs came from; simulated trials add the plant as `truth`.
        """
        return self.evaluate_splits({logs[0].split: logs}, data)[logs[0].split]

    def evaluate_splits(
        self,
        splits: Mapping[str, Sequence[Prepared]],
        data: MeasuredLogs | SimulatedTrials | None = None,
    ) -> dict[str, Evaluation]:
        """Free-run all models over the logs of several splits, side by side.

        Args:
            splits: logs by split, prepared as those of the fit.
            data: where the logs came from; simulated trials add the plant as `truth`.
        """
        settings = self.settings
        return evaluate_splits(
            candidates(self.values(), data),
            splits,
            settings.evaluation,
            settings.prepare.grid.step,
            self.limit,
        )

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
        return select(
            self.values(),
            judged,
            self.findings,
            self.settings.evaluation,
            self._overlapping(judged.get("validation")),
            None if self.settings.recipe is None else self.crossed,
        )

    def _overlapping(self, validation: Evaluation | None) -> FreeRun | None:
        """Return free runs over overlapping windows, by which the recipe's models are chosen."""
        settings = self.settings
        if settings.recipe is None or validation is None:
            return None
        config, step, logs = settings.evaluation, settings.prepare.grid.step, validation.logs
        name = f"{config.selection}, overlapping"
        windows = all_windows(overlapping(config.protocols[config.selection]), logs, step, name)
        models = candidates(self.values())
        return FreeRun(
            name, "validation", windows, free_run(models, windows, logs, step, self.limit)
        )

    def __getitem__(self, name: str) -> FittedModel:
        return self.models[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)
