"""The report of an import: what each recording holds, and what was noticed on the way in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.log import Log
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.format import DASH, minus, number, shown_unit, whole
from residnet.report.run_reader import RunFiles

_NOTE = "note"


def sections(run: RunFiles) -> list[Section]:
    """Return the recordings with their channels, and the findings above a note and below."""
    findings: Mapping[str, Sequence[Mapping[str, Any]]] = run.json("findings.json")
    logs = [Log.load(path) for path in sorted((run.path / "logs").glob("*.parquet"))]
    channels = [Section(log.name, [channel_table(log)], folded=True) for log in logs]
    return [
        Section("Recordings", [log_table(logs, findings), *channels]),
        Section("What was noticed on the way in", _noticed(findings)),
    ]


def log_table(logs: Sequence[Log], findings: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """Return a row for each log: samples, step, duration, gaps and number of findings."""
    table = Table(
        [
            "log",
            "samples",
            "step [s]",
            "duration [s]",
            "channels",
            "samples in gaps",
            "to look at",
            "notes",
        ]
    )
    for log in logs:
        found = findings.get(log.name, [])
        notes = sum(finding["level"] == _NOTE for finding in found)
        duration = float(log.t[-1] - log.t[0])
        lost = sum(int(mask.sum()) for kind, mask in log.masks.items() if kind.startswith("hard:"))
        table.add(
            log.name,
            [
                whole(len(log)),
                number(duration / max(len(log) - 1, 1), 4),
                number(duration, 4),
                str(len(log.channels)),
                whole(lost),
                Cell(str(len(found) - notes), mark="bad" if len(found) > notes else ""),
                str(notes),
            ],
        )
    return table


def channel_table(log: Log) -> Table:
    """Return a row for each channel: unit, range, and how many samples are missing."""
    table = Table(["channel", "unit", "least", "mean", "largest", "missing [%]"])
    for name, values in log.channels.items():
        unit, factor = shown_unit(log.units.get(name, "-"))
        finite = values[np.isfinite(values)]
        shown = (
            [number(factor * float(value)) for value in (finite.min(), finite.mean(), finite.max())]
            if finite.size
            else [DASH] * 3
        )
        missing = 100.0 * (1.0 - finite.size / max(values.size, 1))
        table.add(name, [unit, *shown, number(missing, 2)])
    return table


def _noticed(findings: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Block]:
    severe = [
        f"{log}: {finding['level']}: {minus(str(finding['text']))}"
        for log, found in findings.items()
        for finding in found
        if finding["level"] != _NOTE
    ]
    blocks: list[Block] = (
        [Bullets(severe, warning=True)] if severe else [Text("Nothing needs a look.")]
    )
    for log, found in findings.items():
        notes = [minus(str(finding["text"])) for finding in found if finding["level"] == _NOTE]
        if notes:
            blocks.append(Section(f"Notes on {log}", [Bullets(notes)], folded=True))
    return blocks
