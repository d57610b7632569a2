"""The choice among the models of a fit: what each is, whether it is sound, how it does."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import torch

from residnet.core.errors import UsageError
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import ClosedFormHead
from residnet.identification.cross_fitting.crossed import Crossed, with_crossed
from residnet.identification.evaluation import Evaluation
from residnet.identification.models import FittedModel
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import FreeRun
from residnet.judge.verdict.course_stability import SteadyRun, contradiction, steady_runs
from residnet.judge.verdict.sanity import BOUNDED, DAMPING, STABILITY, Finding, check_model
from residnet.judge.verdict.selection import (
    Contender,
    Selection,
    blocks_of,
    choose,
    log_errors,
    shares,
)
from residnet.judge.verdict.soundness import TrainingPoints, runaway, training_points, wrong_damping

_CHECKED = ("train", "validation")
"""Splits whose windows may not diverge; what the test data show comes too late for a choice."""


def examine(
    fitted: Iterable[FittedModel], train: Sequence[Prepared], config: EvaluationConfig, step: float
) -> dict[str, list[Finding]]:
    """Check the models of a fit for physical sanity, `zero` left out.

    Args:
        fitted: models of one fit.
        train: the logs that fitted them; what a model does where they have been makes it unsound.
        config: whose `divergence` says when a model runs away.
        step: of the grid in s.
    """
    points, steady = training_points(train), steady_runs(train, step)
    threads = torch.get_num_threads()
    # products this small only lose time to a second thread
    torch.set_num_threads(1)
    try:
        return {
            entry.name: _examined(entry, points, steady, config.divergence)
            for entry in fitted
            if entry.spec.role != "zero"
        }
    finally:
        torch.set_num_threads(threads)


def _examined(
    entry: FittedModel, points: TrainingPoints, steady: Sequence[SteadyRun], divergence: float
) -> list[Finding]:
    """All findings of a model; those that make it unsound say so first."""
    # a copy: the checks run in float64, and must not round what others hold
    model = copy.deepcopy(entry.model).to(torch.float64).eval()
    found = check_model(entry.spec, model, divergence=divergence)
    faults = {
        DAMPING: wrong_damping(model, points),
        STABILITY: contradiction(model, steady),
        BOUNDED: runaway(entry.spec, model, points, divergence),
    }
    return [
        replace(finding, ok=False, text=f"unsound: {fault}. {finding.text}", fault=fault)
        if (fault := faults.get(finding.check))
        else finding
        for finding in found
    ]


def select(
    fitted: Iterable[FittedModel],
    judged: Mapping[str, Evaluation],
    findings: Mapping[str, Sequence[Finding]],
    config: EvaluationConfig,
    deciding: FreeRun | None = None,
    crossed: Crossed | None = None,
) -> Selection:
    """Choose among the models of a fit by their free runs over the validation logs.

    Args:
        fitted: models to choose from, `zero` among them.
        judged: their free runs by split; `validation` is needed, `train` shows divergences too.
        findings: of the checks for physical sanity, by model.
        config: its `selection` protocol decides.
        deciding: free runs over the validation logs that decide in its place.
        crossed: errors of the baselines over folds of all logs, which then decide among them.

    Raises:
        UsageError: where the validation logs have not been judged.
    """
    validation = judged.get("validation")
    runs = [] if validation is None else validation.runs
    run = deciding or next((run for run in runs if run.protocol == config.selection), None)
    if validation is None or run is None:
        raise UsageError(
            f"select: no free runs over validation logs by protocol '{config.selection}'; evaluate"
            " the validation split first"
        )
    blocks, labels = blocks_of(run)
    counted = {split: judged[split].runs for split in _CHECKED if split in judged}
    if deciding is not None:
        counted["validation"] = [*counted["validation"], deciding]
    scales = config.scales.named()
    models = {entry.name: entry for entry in fitted}
    parts = {
        name: shares(run, name, validation.logs, scales, labels, len(blocks.weights))
        for name in models
    }
    more = None if crossed is None else with_crossed(parts, blocks, crossed, models)
    if more is None:
        errors = {name: float(one.sum()) for name, one in parts.items()}
        scores = log_errors(parts, blocks.weights)
    else:
        errors, scores, blocks = more.errors, more.scores, more.blocks
    contenders = []
    for entry in models.values():
        lost = [
            (split, free.protocol, diverged, len(free.windows))
            for split, runs in counted.items()
            for free in runs
            if (diverged := sum(p.diverged for p in free.predictions[entry.name]))
        ]
        faults = [
            f"{diverged} of its {count} {split} windows diverged ({protocol})"
            for split, protocol, diverged, count in lost
        ]
        faults += [finding.fault for finding in findings.get(entry.name, ()) if finding.fault]
        contenders.append(
            Contender(
                entry.name,
                family(entry),
                parameter_count(entry.model),
                errors[entry.name],
                scores[entry.name],
                sum(diverged for _, _, diverged, _ in lost),
                tuple(faults),
                None if more is None else more.direct[entry.name],
            )
        )
    return choose(contenders, blocks)


def family(entry: FittedModel) -> str:
    """Return what a model is, in the words of `residnet.judge.selection.FAMILIES`."""
    if entry.spec.role != "head":
        refitted = entry.spec.role == "baseline" and "refit" in entry.notes
        return "refitted baseline" if refitted else str(entry.spec.role)
    return "closed-form head" if isinstance(entry.model.head, ClosedFormHead) else "network"


def parameter_count(model: HybridDynamics) -> int:
    """Return the number of fitted parameters of baseline and head together."""
    of_head = (
        sum(model.head.parameter_count())
        if isinstance(model.head, ClosedFormHead)
        else sum(parameter.numel() for parameter in model.head.parameters())
    )
    # two time constants of an observer of the unknown force
    of_force = 0 if model.disturbance is None else 2
    return round(sum(model.baseline.parameter_count()) + of_head + of_force)
