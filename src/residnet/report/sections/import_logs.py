"""The report of an import: what each recording holds, and what was noticed on the way in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from residnet.core.format import minus, number, shown_unit, whole
from residnet.core.log import Log
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text, bad_where, table_of
from residnet.report.figure import GLANCE, SOLID, START, Case, Curve, Figure, Panel
from residnet.report.figure_files import write_figure
from residnet.report.run_reader import RunFiles

_NOTE = "note"


def sections(run: RunFiles) -> list[Section]:
    """Return the recordings with their channels, and the findings above a note and below."""
    findings: Mapping[str, Sequence[Mapping[str, Any]]] = run.json("findings.json")
    logs = [Log.load(path) for path in sorted((run.path / "logs").glob("*.parquet"))]
    channels = [Section(log.name, [channel_table(log)], folded=True) for log in logs]
    table = log_table(logs, findings)
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
    return [
        Section("", [write_figure(run.path / "figures", motion(logs)), table]),
        Section("Channels", channels),
        Section("What was noticed on the way in", blocks),
    ]


def motion(logs: Sequence[Log]) -> Figure:
    """Return the tracks of the recordings, one to be chosen; else a channel that all of them hold.

    Args:
        logs: at least one; positions count from the first of each.
    """
    shared = [name for name in logs[0].channels if all(name in log.channels for log in logs)]
    if placed := {"x", "y"} <= set(shared):
        panel = Panel("north [m]", "east [m]", kind="map", height=GLANCE)
    else:
        name = next(iter(shared), next(iter(logs[0].channels)))
        unit, factor = shown_unit(logs[0].units.get(name, "-"))
        panel = Panel(f"{name} [{unit}]", "time [s]", height=GLANCE)

    def curves(log: Log) -> dict[str, Curve]:
        if not placed:
            return {"log": (log.t, factor * log[name])} if name in log.channels else {}
        known = np.isfinite(log["x"]) & np.isfinite(log["y"])
        first = int(np.argmax(known))
        track = tuple(log[axis][known] - log[axis][first] for axis in ("y", "x"))
        return {"log": (track[0], track[1]), "start": (np.zeros(1), np.zeros(1))}

    return Figure(
        "recordings",
        "What was recorded",
        "",
        {"log": replace(SOLID, label="measured"), "start": START},
        [panel],
        [Case(log.name, [curves(log)], still=log is logs[0]) for log in logs],
        "Recording",
    )


def log_table(logs: Sequence[Log], findings: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """Return a row for each log: samples, step, duration, gaps and number of findings."""

    def notes(log: Log) -> int:
        return sum(finding["level"] == _NOTE for finding in findings.get(log.name, []))

    def severe(log: Log) -> Cell:
        count = len(findings.get(log.name, [])) - notes(log)
        return bad_where(count, count)

    def lost(log: Log) -> int:
        return sum(int(mask.sum()) for kind, mask in log.masks.items() if kind.startswith("hard:"))

    def duration(log: Log) -> float:
        return float(log.t[-1] - log.t[0])

    return table_of(
        logs,
        [
            ("log", lambda log: log.name),
            ("samples", len, whole),
            ("step [s]", lambda log: number(duration(log) / max(len(log) - 1, 1), 4), str),
            ("duration [s]", lambda log: number(duration(log), 4), str),
            ("channels", lambda log: len(log.channels), str),
            ("samples in gaps", lost, whole),
            ("to look at", severe),
            ("notes", notes, str),
        ],
    )


def channel_table(log: Log) -> Table:
    """Return a row for each channel: unit, range, and how many samples are missing."""
    rows = []
    for name, values in log.channels.items():
        unit, factor = shown_unit(log.units.get(name, "-"))
        finite = factor * np.asarray(values, dtype=float)[np.isfinite(values)]
        known = finite if finite.size else np.array([np.nan])
        rows.append(
            {
                "channel": name,
                "unit": unit,
                "least": float(known.min()),
                "mean": float(known.mean()),
                "largest": float(known.max()),
                "missing": number(100.0 * (1.0 - finite.size / max(values.size, 1)), 2),
            }
        )
    return table_of(
        rows,
        [
            ("channel", "channel"),
            ("unit", "unit", str),
            *((name, name, number) for name in ("least", "mean", "largest")),
            ("missing [%]", "missing", str),
        ],
    )
