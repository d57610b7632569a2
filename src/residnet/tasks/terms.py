"""What each term of an equation does along a log, for the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from residnet.core.names import ACCELERATION
from residnet.data.prepare import Prepared
from residnet.heads.base import EquationHead
from residnet.tasks.pipeline import Fitted


def write_terms(file: Path, fitted: Sequence[Fitted], logs: Sequence[Prepared]) -> None:
    """Terms of every head that is an equation along the longest log, times their coefficients:
    columns model, log, axis, term, t, value.

    The term `target` is what the baseline leaves of the measured acceleration, NaN where there is
    none. Nothing is written without such a head.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    log = max(logs, key=len)
    parts: dict[str, list[np.ndarray]] = {
        "model": [],
        "log": [],
        "axis": [],
        "term": [],
        "t": [],
        "value": [],
    }
    for f in fitted:
        head = f.model.to(torch.float64).head if f.spec.role == "head" else None
        if not isinstance(head, EquationHead):
            continue
        with torch.no_grad():
            x, w = (
                torch.from_numpy(np.nan_to_num(log.smooth)),
                torch.from_numpy(np.nan_to_num(log.w)),
            )
            z = f.model.signals(x, f.model.signals.prepare(w))
            left = np.where(log.good[:, None], log.nu_dot - f.model.baseline(z).numpy(), np.nan)
        for axis, name in enumerate(ACCELERATION):
            for term, value in {"target": left[:, axis], **head.contributions(z, axis)}.items():
                parts["value"].append(value)
                parts["t"].append(log.log.t - log.log.t[0])
                for column, text in (
                    ("model", f.spec.name),
                    ("log", log.log.name),
                    ("axis", name),
                    ("term", term),
                ):
                    parts[column].append(np.full(len(value), text, dtype=object))
    if parts["model"]:
        pq.write_table(
            pa.table({name: pa.array(np.concatenate(values)) for name, values in parts.items()}),
            file,
        )
