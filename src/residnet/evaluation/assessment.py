"""What a run says of a model and of its logs, as the card of every export holds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

SPLIT_NAMES = {"train": "identification"}
"""Splits of a run that have another name in cards; the others keep theirs."""


@dataclass(frozen=True)
class Assessment:
    """What a run says of a model and of the logs that it was made of and judged on.

    Attributes:
        level: key of `residnet.evaluation.verdict.LEVELS`; empty where no verdict was passed.
        verdict: its sentences.
        findings: of the data checks, those above a note, each with `log`, `level`, `code`, `text`
            and `action`; None where no data were checked.
        split: names of logs by split, of the run's data; None where the run has no logs.
    """

    level: str = ""
    verdict: Sequence[str] = ()
    findings: Sequence[Mapping[str, Any]] | None = None
    split: Mapping[str, Sequence[str]] | None = None

    def content(self) -> dict[str, Any]:
        """Return the entries of the card; null means unknown."""
        split: dict[str, list[str]] | None = None
        if self.split is not None:
            split = {"identification": [], "validation": [], "test": []}
            split |= {SPLIT_NAMES.get(name, name): list(logs) for name, logs in self.split.items()}
        return {
            "level": self.level or None,
            "verdict": list(self.verdict),
            "findings": None if self.findings is None else [dict(row) for row in self.findings],
            "split": split,
        }
