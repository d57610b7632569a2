"""Kinds of manoeuvre that are worth a line of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from residnet.report.run_reader import RunFiles


def distinct(run: RunFiles, kinds: Sequence[str], split: str, protocol: str) -> list[str]:
    """Return kinds and groups without those that hold the same runs as one before.

    A group of a single kind holds the same runs as that kind.
    """
    seen: list[Any] = []
    out: list[str] = []
    for kind in kinds:
        errors = [
            (row["windows"], row["rmse"])
            for model in run.kinds
            if (row := run.row(model, split, protocol, kind)) is not None
        ]
        if errors not in seen:
            seen.append(errors)
            out.append(kind)
    return out
