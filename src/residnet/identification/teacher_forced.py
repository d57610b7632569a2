"""What fitted models predict along measured logs: residuals and terms, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from residnet.core.names import ACCELERATION
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import EquationHead
from residnet.identification.models import FittedModel

if TYPE_CHECKING:
    import pandas as pd


def channels_along(model: HybridDynamics, log: Prepared) -> Tensor:
    """Return the channels [1, T, nz] that a float64 model sees along a log, gaps filled with 0."""
    with torch.no_grad():
        x = torch.from_numpy(np.nan_to_num(log.smooth))[None]
        w = torch.from_numpy(np.nan_to_num(log.w))[None]
        channels: Tensor = model.signals(x, model.signals.prepare(w))
    return channels


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
        model = entry.model.to(torch.float64)
        pairs = []
        for log in logs:
            z = channels_along(model, log)
            with torch.no_grad():
                baseline = model.baseline(z)[0].numpy()
                predicted = model.one_step(z)[0].numpy() - baseline
            pairs.append(np.stack((log.nu_dot - baseline, predicted), axis=-1)[log.good])
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
        head = entry.model.to(torch.float64).head if entry.spec.role == "head" else None
        if not isinstance(head, EquationHead):
            continue
        z = channels_along(entry.model, log)[0]
        with torch.no_grad():
            left = log.nu_dot - entry.model.baseline(z).numpy()
        left = np.where(log.good[:, None], left, np.nan)
        for axis, name in enumerate(ACCELERATION):
            for term, value in {"target": left[:, axis], **head.contributions(z, axis)}.items():
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
