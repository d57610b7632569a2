"""Assessment of a model and its logs, for the metadata (model card) of every export."""

from __future__ import annotations

from collections.abc import Sequence

from residnet.core.records import Record

SPLIT_NAMES = {"train": "identification"}
"""Names of splits in model cards, where they differ from those in the run."""


class CardFinding(Record):
    """A finding of the data checks that is worse than a note.

    Attributes:
        log: name of the log; None for the set of logs.
        level: severity.
        code: kind of finding.
        text: one line with figures.
        action: recommended action; empty without one.
    """

    log: str | None
    level: str
    code: str
    text: str
    action: str


class Assessment(Record):
    """Verdict on a model, findings on its data, and the logs of its run.

    Attributes:
        level: key of `residnet.evaluation.verdict.LEVEL_TEXTS`; None without a verdict.
        verdict: sentences of the verdict.
        findings: findings of the data checks, except notes; None if no data were checked.
        split: names of logs by split, under the names of `SPLIT_NAMES`; None without logs.
    """

    level: str | None = None
    verdict: tuple[str, ...] = ()
    findings: tuple[CardFinding, ...] | None = None
    split: dict[str, tuple[str, ...]] | None = None


def name_splits(logs: Sequence[tuple[str, str]]) -> dict[str, tuple[str, ...]] | None:
    """Return the logs of each split under the names of model cards; None without logs.

    Args:
        logs: split and name of each log.
    """
    if not logs:
        return None
    splits: dict[str, tuple[str, ...]] = {"identification": (), "validation": (), "test": ()}
    for split, log in logs:
        name = SPLIT_NAMES.get(split, split)
        splits[name] = (*splits.get(name, ()), log)
    return splits
