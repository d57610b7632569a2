"""Goodness of one-step predictions of every model of a run: goodness.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.judge.goodness import OneStep, content, table
from residnet.runs.folder import RunFolder
from residnet.tasks.pipeline import Fitted
from residnet.tasks.references import references

_SPLITS = ("train", "test")


def write_goodness(
    file: Path,
    run: str,
    fitted: Sequence[Fitted],
    logs: Mapping[str, Sequence[Prepared]],
    step: float,
) -> None:
    """Statistics of what each model leaves of the measured accelerations along measured states, on
    training and test logs.
    """
    to = references(
        {f.spec.name: f.spec.role for f in fitted}, {f.spec.name: f.notes for f in fitted}
    )
    splits = {}
    for split in _SPLITS:
        pieces = [piece for log in logs[split] for piece in stretches(log)]
        models = [
            OneStep(
                f.spec.name,
                f.spec.role,
                [
                    a + b
                    for a, b in zip(
                        f.model.baseline.parameter_count(),
                        f.model.head.parameter_count(),
                        strict=True,
                    )
                ],
                [
                    part
                    for log in logs[split]
                    for part in _residuals(f.model.to(torch.float64), log)
                ],
                to.get(f.spec.name),
            )
            for f in fitted
        ]
        splits[split] = table(models, pieces, step) if pieces else []
    RunFolder(file.parent).write_json(file, content(run, splits, step))


def stretches(log: Prepared) -> list[np.ndarray]:
    """Measured accelerations [T, 3] of each stretch of samples that may be learned from."""
    return [log.nu_dot[a:b] for a, b in _bounds(log)]


def _residuals(model: HybridDynamics, log: Prepared) -> list[np.ndarray]:
    """Measured minus predicted acceleration [T, 3] of each stretch; a head runs along the whole
    log, as its memory needs.
    """
    with torch.no_grad():
        x, w = (
            torch.from_numpy(np.nan_to_num(log.smooth))[None],
            torch.from_numpy(np.nan_to_num(log.recorded))[None],
        )
        z = model.signals(x, model.signals.prepare(w))
        said = model.one_step(z)[0].numpy()
    return [log.nu_dot[a:b] - said[a:b] for a, b in _bounds(log)]


def _bounds(log: Prepared) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(log.good, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
