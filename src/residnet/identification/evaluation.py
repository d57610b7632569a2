"""Fitted models judged: free runs over all protocols of a split, and their metrics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.data.prepare import Prepared
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import MeasuredLogs
from residnet.dynamics.simulated import TracedPlantDynamics
from residnet.identification.models import FittedModel
from residnet.identification.references import references
from residnet.judge.bands.band import Bands
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import Candidate, FreeRun, free_run
from residnet.judge.limits import limits
from residnet.judge.metrics import rows
from residnet.judge.tables import metrics_table
from residnet.physics.vessel import load_vessel

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Evaluation:
    """The free runs of models over the logs of one split.

    Attributes:
        split: train, validation, test or external.
        logs: of the split, in the order that the windows count them in.
        runs: free runs by protocol; protocols without a window are left out.
        rows: of metrics.json, without `selected`.
        limits: contents of limits.json by protocol.
        bands: that the models were judged with, by model and protocol.
    """

    split: str
    logs: Sequence[Prepared]
    runs: list[FreeRun]
    rows: list[dict[str, Any]]
    limits: dict[str, Any]
    bands: Bands = field(default_factory=dict)

    @property
    def metrics(self) -> pd.DataFrame:
        """The rows as a table, see `residnet.judge.tables.metrics_table`."""
        return metrics_table(self.rows)


def evaluate(
    models: Sequence[Candidate],
    logs: Sequence[Prepared],
    config: EvaluationConfig,
    step: float,
    limit: np.ndarray,
) -> Evaluation:
    """Free-run models over all protocols of one split.

    Args:
        models: to be judged, see `candidates`.
        logs: of one split, at least one.
        config: protocols, scales and groups.
        step: of the grid in s.
        limit: of |u, v, r| [3] beyond which a free run has diverged.
    """
    return evaluate_splits(models, {logs[0].split: logs}, config, step, limit)[logs[0].split]


def evaluate_splits(
    models: Sequence[Candidate],
    splits: Mapping[str, Sequence[Prepared]],
    config: EvaluationConfig,
    step: float,
    limit: np.ndarray,
) -> dict[str, Evaluation]:
    """Free-run models over all protocols of several splits, all windows of a model side by side.

    Args:
        models: to be judged, see `candidates`.
        splits: their logs, at least one each.
        config: protocols, scales and groups.
        step: of the grid in s.
        limit: of |u, v, r| [3] beyond which a free run has diverged.
    """
    laid = {
        (split, name): [
            window
            for number, log in enumerate(logs)
            for window in protocol.windows(log, number, step)
        ]
        for split, logs in splits.items()
        for name, protocol in config.protocols.items()
    }
    everywhere = [log for logs in splits.values() for log in logs]
    before = dict(zip(splits, np.cumsum([0, *map(len, splits.values())]).tolist(), strict=False))
    together = [
        replace(window, log=window.log + before[split])
        for (split, _), windows in laid.items()
        for window in windows
    ]
    predictions = free_run(models, together, everywhere, step, limit)
    bands = {model.name: model.bands for model in models}
    scales = config.scales.named()
    found = {split: Evaluation(split, logs, [], [], {}, bands) for split, logs in splits.items()}
    begin = 0
    for (split, name), windows in laid.items():
        if not windows:
            continue
        end = begin + len(windows)
        own = {model: part[begin:end] for model, part in predictions.items()}
        begin, out, logs = end, found[split], splits[split]
        run = FreeRun(name, split, windows, own)
        out.runs.append(run)
        out.rows.extend(rows(run, models, logs, scales, config.groups))
        out.limits[name] = limits(run, models, logs, scales, step)
    return found


def candidates(
    fitted: Iterable[FittedModel], data: MeasuredLogs | SimulatedTrials | None = None
) -> list[Candidate]:
    """Return the models to judge, each with the one that it is compared with.

    Args:
        fitted: models of one fit.
        data: where the logs came from; simulated trials add the plant that made them as `truth`.
    """
    models = {entry.name: entry for entry in fitted}
    compared_with = references(
        {name: entry.spec.role for name, entry in models.items()},
        {name: entry.notes for name, entry in models.items()},
    )
    out = [
        Candidate(
            name,
            entry.spec.role,
            entry.model,
            reference=compared_with.get(name),
            ranges=entry.spec.ranges,
            bands=entry.bands,
        )
        for name, entry in models.items()
    ]
    truth = _truth(data) if isinstance(data, SimulatedTrials) else None
    return out if truth is None else [*out, truth]


def _truth(data: SimulatedTrials) -> Candidate | None:
    """The plant that made the logs; None where a log does not show all of its state."""
    plant = load_vessel(data.vessel).build()
    if any(name.startswith("_") for name in plant.state):
        # no log shows what is under way in a delay line, so that the plant could not start from one
        return None
    commands = plant.inputs[: plant.commands]
    model = TracedPlantDynamics(plant, data.step, data.substeps)
    unknown = len(plant.inputs) - len(commands)
    return Candidate("truth", "truth", model, plant.state, commands, unknown, "baseline")
