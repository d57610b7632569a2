"""What fitted models predict along measured logs: residuals and terms, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from residnet.core.names import ACCELERATION
from residnet.data.prepare import Prepared, channels
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import EquationHead
from residnet.identification.models import FittedModel

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class TeacherForced:
    """What a model computes along the measured states of a log, its memory empty at first.

    Attributes:
        z: channels that baseline and head see [T, nz].
        baseline: accelerations of the baseline [T, 3].
        predicted: accelerations of baseline and head together [T, 3].
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
        baseline = model.baseline(z).numpy()
        predicted = model.one_step(z[None])[0].numpy()
    return TeacherForced(z, baseline, predicted)


def residual_table(
    fitted: Iterable[FittedModel], logs: Sequence[Prepared], most: int = 1500
) -> pd.DataFrame:
    """Return residual targets against what each head predicts along the measured states.

    Every head runs teacher-forced over each log.

    Args:
        fitted: models; those without a head are left out.
        logs: of one split.
        most: about how many samples of each model and axis are kept, evenly spaced.

    Returns:
        Columns model, axis, target, predicted (accelerations, SI); no row where there is no head.
    """
    import pandas as pd

    parts = []
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
        for axis, name in enumerate(ACCELERATION):
            columns = {
                "model": entry.name,
                "axis": name,
                "target": joined[:, axis, 0],
                "predicted": joined[:, axis, 1],
            }
            parts.append(pd.DataFrame(columns))
    names = ["model", "axis", "target", "predicted"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=names)


def term_table(fitted: Iterable[FittedModel], logs: Sequence[Prepared]) -> pd.DataFrame:
    """Return the terms of every head that is an equation along the longest log.

    Args:
        fitted: models; heads that are no equation are left out.
        logs: of one split, at least one.

    Returns:
        Columns model, log, axis, term, t (s), value (the term times its coefficient). The term
        `target` is what the baseline leaves of the measured acceleration, NaN where there is none.
    """
    import pandas as pd

    log = max(logs, key=len)
    parts = []
    for entry in fitted:
        head = entry.model.head if entry.spec.role == "head" else None
        if not isinstance(head, EquationHead):
            continue
        run = teacher_forced(entry.model, log)
        target = np.where(log.good[:, None], log.nu_dot - run.baseline, np.nan)
        for axis, name in enumerate(ACCELERATION):
            for term, value in {
                "target": target[:, axis],
                **head.contributions(run.z, axis),
            }.items():
                columns = {
                    "model": entry.name,
                    "log": log.log.name,
                    "axis": name,
                    "term": term,
                    "t": log.log.t - log.log.t[0],
                    "value": value,
                }
                parts.append(pd.DataFrame(columns))
    names = ["model", "log", "axis", "term", "t", "value"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=names)
