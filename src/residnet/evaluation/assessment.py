"""Assessment of a model and its logs, for the card of every export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

SPLIT_NAMES = {"train": "identification"}
"""Names of splits in cards, where they differ from those in the run."""


@dataclass(frozen=True)
class Assessment:
    """Verdict on a model, findings on its data, and the logs of its run.

    Attributes:
        level: key of `residnet.evaluation.verdict.LEVEL_TEXTS`; empty without a verdict.
        verdict: sentences of the verdict.
        findings: findings of the data checks above the level of a note, each with `log`, `level`,
            `code`, `text` and `action`; None if the data were not checked.
        split: names of the logs by split; None for a run without logs.
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
