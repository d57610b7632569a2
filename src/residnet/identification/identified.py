"""The judged fit: free runs of all models, the choice among them, what they leave of the logs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.errors import UsageError
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared, channels
from residnet.data.simulated import SimulatedTrials, surrounded
from residnet.data.sources import MeasuredLogs
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.simulated import RecordedPlantDynamics
from residnet.heads.base import ClosedFormHead, EquationHead
from residnet.identification.fitter import FittedModel, references
from residnet.identification.recipe import MEAN, SINGLE
from residnet.identification.settings import FitSettings
from residnet.judge.band import Bands
from residnet.judge.freerun import Candidate, FreeRun, free_run
from residnet.judge.goodness import OneStep, table
from residnet.judge.metrics import Judged, metrics_table
from residnet.judge.protocol import EvaluationConfig
from residnet.judge.selection import Contender, Selection, blocks_of, choose, log_errors, shares
from residnet.judge.soundness import Finding, Recorded, check_model

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
        """The rows as a table, see `residnet.judge.metrics.metrics_table`."""
        return metrics_table(self.rows)


def evaluate(
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
        step: of the grid in s.
        limit: size of what moves [n] beyond which a free run has diverged.
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
        judged = Judged(run, models, logs, scales)
        out.rows.extend(judged.rows(config.groups))
        out.limits[name] = judged.limits(step)
    return found


def candidates(
    fitted: Iterable[FittedModel], data: MeasuredLogs | SimulatedTrials | None = None
) -> list[Candidate]:
    """Return the models to judge, each with the one that it is compared with.

    Args:
        data: where the logs came from; simulated trials add the plant that made them as `truth`.
    """
    models = {entry.name: entry for entry in fitted}
    compared_with = references(models.values())
    unlike = unlike_models(models.values())
    out = [
        Candidate(
            name,
            entry.spec.role,
            entry.model,
            reference=compared_with.get(name),
            ranges=entry.spec.ranges,
            bands=entry.bands,
            members=members_of(entry),
            unlike=unlike,
        )
        for name, entry in models.items()
    ]
    truth = _truth(data) if isinstance(data, SimulatedTrials) else None
    return out if truth is None else [*out, truth]


def members_of(entry: FittedModel) -> tuple[str, ...]:
    """Return the models whose trajectories a model is the mean of; empty for any other."""
    return tuple(one.name for one in entry.spec.members if entry.spec.of == "trajectories")


def unlike_models(fitted: Iterable[FittedModel]) -> tuple[str, ...]:
    """Return the models whose distance tells where logs did not determine the motion.

    They are those that can quickly be fitted again without some of the logs: baselines and heads of
    closed form. Bands know of each how far they lie apart in free runs over logs left out.
    """
    return tuple(one.name for one in fitted if one.spec.role == "baseline" or closed_form(one))


def closed_form(entry: FittedModel) -> bool:
    """Return whether a model has a head of closed form that is solved again in no time."""
    head = entry.model.head
    quick = isinstance(head, ClosedFormHead) and not isinstance(head, EquationHead)
    return entry.spec.role == "head" and quick


def _truth(data: SimulatedTrials) -> Candidate | None:
    """The plant that made the logs; None where a log does not show all of its state."""
    plant = surrounded(data.vessel, data.disturbance)
    if any(name.startswith("_") for name in plant.state):
        # no log shows what is under way in a delay line, so that the plant could not start from one
        return None
    commands = plant.inputs[: plant.commands]
    model = RecordedPlantDynamics(plant, data.step, data.substeps)
    unknown = len(plant.inputs) - len(commands)
    return Candidate("truth", "truth", model, plant.state, commands, unknown, "baseline")


_CHECKED = ("train", "validation")
"""Splits whose windows may not diverge; what the test data show comes too late for a choice."""


def family(entry: FittedModel) -> str:
    """Return what a model is, in the words of `residnet.judge.selection.FAMILIES`."""
    if isinstance(entry.model, MeanOfTrajectories):
        return "ensemble"
    if entry.spec.role != "head":
        refitted = entry.spec.role == "baseline" and "refit" in entry.notes
        return "refitted baseline" if refitted else str(entry.spec.role)
    return "closed-form head" if isinstance(entry.model.head, ClosedFormHead) else "network"


def parameter_count(model: HybridDynamics) -> int:
    """Return the number of fitted parameters of baseline and head together."""
    if isinstance(model, MeanOfTrajectories):
        return sum(map(parameter_count, model.members))
    of_head = (
        sum(model.head.parameter_count())
        if isinstance(model.head, ClosedFormHead)
        else sum(parameter.numel() for parameter in model.head.parameters())
    )
    return round(sum(model.baseline.parameter_count()) + of_head)


@dataclass(frozen=True)
class Identified(Mapping[str, FittedModel]):
    """The fitted models by name: zero, baselines, heads and ensembles, in this order.

    Attributes:
        settings: of the fit.
        models: by name.
        limit: size of what moves [n] beyond which a free run has diverged.
        train: the logs that fitted them.
        seen: whether the validation logs are among them.
    """

    settings: FitSettings
    models: dict[str, FittedModel]
    limit: np.ndarray
    train: Sequence[Prepared]
    seen: bool = False

    def evaluate(
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
        return evaluate(
            candidates(self.values(), data),
            splits,
            settings.evaluation,
            settings.prepare.grid.step,
            self.limit,
        )

    @cached_property
    def findings(self) -> dict[str, list[Finding]]:
        """What the checks for physical sanity find, by model; `zero` is left out."""
        fitted = list(self.values())
        settings = self.settings
        recorded = Recorded.of(self.train, settings.prepare.grid.step)
        return {
            one.name: check_model(one.spec, one.model, recorded, settings.evaluation.divergence)
            for one in fitted
            if one.spec.role != "zero"
        }

    def select(self, judged: Mapping[str, Evaluation]) -> Selection:
        """Choose a single model and an ensemble by their free runs over the validation logs.

        The recipe chooses neither: the evidence is smaller than its noise. Its hull is the single
        model, unless it diverged in a window, and its mean the ensemble.

        Args:
            judged: what `evaluate` returned, by split; `validation` is needed, and divergences on
                `train` count where it is there.

        Raises:
            UsageError: where the validation logs have not been judged.
        """
        config = self.settings.evaluation
        validation = judged.get("validation")
        runs = [] if validation is None else validation.runs
        run = next((run for run in runs if run.protocol == config.selection), None)
        if validation is None or run is None:
            raise UsageError(
                f"select: no free runs over validation logs by protocol '{config.selection}';"
                " evaluate the validation split first"
            )
        blocks, labels = blocks_of(run)
        counted = {split: judged[split].runs for split in _CHECKED if split in judged}
        scales = config.scales.named()
        parts = {
            name: shares(run, name, validation.logs, scales, labels, len(blocks.weights))
            for name in self
        }
        scores = log_errors(parts, blocks.weights)
        contenders = []
        for entry in self.values():
            lost = [
                (n, f"{n} of its {len(free.windows)} {split} windows diverged ({free.protocol})")
                for split, runs in counted.items()
                for free in runs
                if (n := sum(one.diverged for one in free.predictions[entry.name]))
            ]
            found_wrong = [one.fault for one in self.findings.get(entry.name, ()) if one.fault]
            contenders.append(
                Contender(
                    entry.name,
                    family(entry),
                    parameter_count(entry.model),
                    float(parts[entry.name].sum()),
                    scores[entry.name],
                    sum(n for n, _ in lost),
                    (*(said for _, said in lost), *found_wrong),
                )
            )
        found = choose(contenders, blocks)
        if self.settings.recipe is None or MEAN not in self.models:
            return found
        found = replace(found, selected_ensemble=MEAN, leading=MEAN)
        hull = next((one for one in found.contenders if one.name == SINGLE), None)
        if hull is None or hull.diverged:
            return found
        against = f"; against it speaks: {'; '.join(hull.faults)}" if hull.faults else ""
        return replace(
            found, selected=SINGLE, reason=f"{SINGLE} is the recipe's single model{against}."
        )

    def __getitem__(self, name: str) -> FittedModel:
        return self.models[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)


@dataclass(frozen=True)
class TeacherForced:
    """What a model computes along the measured states of a log, its memory empty at first.

    Attributes:
        z: channels that baseline and head see [T, nz].
        baseline: accelerations of the baseline [T, n].
        predicted: accelerations of baseline and head together [T, n].
    """

    z: Tensor
    baseline: np.ndarray
    predicted: np.ndarray


def teacher_forced(model: HybridDynamics, log: Prepared) -> TeacherForced:
    """Run a model along a log without letting it move the vessel.

    Args:
        model: brought to float64.
        log: gaps are filled with 0; what is predicted there means nothing.
    """
    model = model.to(torch.float64)
    z = channels(log, model.signals)
    with torch.no_grad():
        baseline = model.known(z).numpy()
        predicted = model.one_step(z[None])[0].numpy()
    return TeacherForced(z, baseline, predicted)


def residual_table(
    fitted: Iterable[FittedModel], logs: Sequence[Prepared], most: int = 1500
) -> pd.DataFrame:
    """Return residual targets against what each head predicts along the measured states.

    Every head runs teacher-forced over each log.

    Args:
        fitted: models; those without a head are left out.
        most: about how many samples of each model and axis are kept, evenly spaced.

    Returns:
        Columns model, axis, target, predicted (accelerations, SI); no row where there is no head.
    """
    rows: list[tuple[Any, ...]] = []
    for entry in fitted:
        if entry.spec.role != "head":
            continue
        pairs = []
        for log in logs:
            run = teacher_forced(entry.model, log)
            residuals = (log.nu_dot - run.baseline, run.predicted - run.baseline)
            pairs.append(np.stack(residuals, axis=-1)[log.good])
        joined = np.concatenate(pairs)
        joined = joined[:: max(len(joined) // most, 1)]
        rows += [(entry.name, name, *joined[:, axis].T) for axis, name in _live(logs)]
    return _table(["model", "axis", "target", "predicted"], rows)


def term_table(fitted: Iterable[FittedModel], logs: Sequence[Prepared]) -> pd.DataFrame:
    """Return the terms of every head that is an equation along the longest log.

    Args:
        fitted: models; heads that are no equation are left out.
        logs: of one split, at least one.

    Returns:
        Columns model, log, axis, term, t (s), value (the term times its coefficient). The term
        `target` is what the baseline leaves of the measured acceleration, NaN where there is none.
    """
    log = max(logs, key=len)
    t = log.log.t - log.log.t[0]
    rows: list[tuple[Any, ...]] = []
    for entry in fitted:
        head = entry.model.head if entry.spec.role == "head" else None
        if not isinstance(head, EquationHead):
            continue
        run = teacher_forced(entry.model, log)
        target = np.where(log.good[:, None], log.nu_dot - run.baseline, np.nan)
        for axis, name in _live([log]):
            terms = {"target": target[:, axis], **head.contributions(run.z, axis)}
            rows += [(entry.name, log.log.name, name, term, t, terms[term]) for term in terms]
    return _table(["model", "log", "axis", "term", "t", "value"], rows)


def _table(names: list[str], rows: list[tuple[Any, ...]]) -> pd.DataFrame:
    """Return a table of rows, each with some arrays of one length in the place of a number."""
    import pandas as pd

    parts = [pd.DataFrame(dict(zip(names, row, strict=True))) for row in rows]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=names)


def _live(logs: Sequence[Prepared]) -> list[tuple[int, str]]:
    """Return number and name of each acceleration that logs tell."""
    live = logs[0].live
    return [(axis, live.rates[axis]) for axis in live.learned]


SPLITS = ("train", "test")


def goodness_rows(
    fitted: Iterable[FittedModel], logs: Mapping[str, Sequence[Prepared]], step: float
) -> dict[str, list[dict[str, Any]]]:
    """Return statistics of what each model leaves of the measured accelerations, by split.

    Of very many logs as many are taken, evenly spread, as have 200,000 samples.

    Args:
        logs: by split; training and test logs are used.
        step: of the grid in s.
    """
    models = {entry.name: entry for entry in fitted}
    compared_with = references(models.values())
    splits = {}
    for split in SPLITS:
        every = -(-sum(len(log) for log in logs[split]) // paged.LARGE)
        taken = logs[split][:: max(every, 1)]
        measured = [piece for log in taken for piece in _learned(log, log.nu_dot)]
        predictions = [
            OneStep(
                name,
                entry.spec.role,
                _parameter_counts(entry.model),
                [
                    piece
                    for log in taken
                    for piece in _learned(
                        log, log.nu_dot - teacher_forced(entry.model, log).predicted
                    )
                ],
                compared_with.get(name),
            )
            for name, entry in models.items()
        ]
        axes = _live(taken) if measured else []
        splits[split] = table(predictions, measured, step, axes) if measured else []
    return splits


def _learned(log: Prepared, values: np.ndarray) -> list[np.ndarray]:
    """Return values [T, n] of each stretch that may be learned from."""
    return [values[begin:end] for begin, end in zip(*stretches(log.good), strict=True)]


def _parameter_counts(model: HybridDynamics) -> list[float]:
    """Fitted parameters of each axis, baseline and head together."""
    if isinstance(model, MeanOfTrajectories):
        members = map(_parameter_counts, model.members)
        return [sum(axis) for axis in zip(*members, strict=True)]
    return [
        of_baseline + of_head
        for of_baseline, of_head in zip(
            model.baseline.parameter_count(), model.head.parameter_count(), strict=True
        )
    ]
