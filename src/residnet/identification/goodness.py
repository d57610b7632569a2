"""Goodness of one-step predictions of fitted models along the logs of a split."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.arrays import paged
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification.models import FittedModel
from residnet.identification.references import references
from residnet.identification.teacher_forced import teacher_forced
from residnet.judge.goodness import OneStep, table

SPLITS = ("train", "test")


def goodness_rows(
    fitted: Iterable[FittedModel], logs: Mapping[str, Sequence[Prepared]], step: float
) -> dict[str, list[dict[str, Any]]]:
    """Return statistics of what each model leaves of the measured accelerations, by split.

    Of very many logs as many are taken, evenly spread, as have 200,000 samples.

    Args:
        fitted: models of one fit.
        logs: by split; training and test logs are used.
        step: of the grid in s.
    """
    models = {entry.name: entry for entry in fitted}
    compared_with = references(
        {name: entry.spec.role for name, entry in models.items()},
        {name: entry.notes for name, entry in models.items()},
    )
    splits = {}
    for split in SPLITS:
        taken = _some(logs[split])
        measured = [piece for log in taken for piece in measured_stretches(log)]
        predictions = [
            OneStep(
                name,
                entry.spec.role,
                _parameter_counts(entry.model),
                [part for log in taken for part in _residuals(entry.model, log)],
                compared_with.get(name),
            )
            for name, entry in models.items()
        ]
        splits[split] = table(predictions, measured, step) if measured else []
    return splits


def _some(logs: Sequence[Prepared]) -> Sequence[Prepared]:
    """Return the logs, or evenly spread ones of 200,000 samples where there are more."""
    every = -(-sum(len(log) for log in logs) // paged.LARGE)
    return logs[:: max(every, 1)]


def measured_stretches(log: Prepared) -> list[np.ndarray]:
    """Return the measured accelerations [T, 3] of each stretch that may be learned from."""
    return [log.nu_dot[begin:end] for begin, end in zip(*stretches(log.good), strict=True)]


def _parameter_counts(model: HybridDynamics) -> list[float]:
    """Fitted parameters of each axis, baseline and head together."""
    return [
        of_baseline + of_head
        for of_baseline, of_head in zip(
            model.baseline.parameter_count(), model.head.parameter_count(), strict=True
        )
    ]


def _residuals(model: HybridDynamics, log: Prepared) -> list[np.ndarray]:
    """Measured minus predicted acceleration [T, 3] of each stretch; a head runs along the whole
    log, as its memory needs.
    """
    predicted = teacher_forced(model, log).predicted
    return [
        log.nu_dot[begin:end] - predicted[begin:end]
        for begin, end in zip(*stretches(log.good), strict=True)
    ]
