"""The report of an import: what each recording holds, and what was noticed on the way in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from residnet.core.format import minus, number, shown_unit, whole
from residnet.core.log import Log
from residnet.report.blocks import Block, Bullets, Section, Table, Text, bad_where, table_of
from residnet.report.figure import GLANCE, SOLID, START, Case, Curve, Figure, Panel
from residnet.report.figure_files import write_figure
from residnet.report.run_reader import RunFiles

_NOTE = "note"


def sections(run: RunFiles) -> list[Section]:
    """Return the recordings with their channels, and the findings above a note and below."""
    findings: Mapping[str, Sequence[Mapping[str, Any]]] = run.json("findings.json")
    logs = [Log.load(path) for path in sorted((run.path / "logs").glob("*.parquet"))]
    channels = [Section(log.name, [channel_table(log)], folded=True) for log in logs]
    table = log_table([log_row(log, findings.get(log.name, [])) for log in logs])
    severe = loud_lines(findings)
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


def loud_lines(findings: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Return a line for each finding above a note, by the name of its log."""
    return [
        f"{log}: {finding['level']}: {minus(str(finding['text']))}"
        for log, found in findings.items()
        for finding in found
        if finding["level"] != _NOTE
    ]


def log_row(log: Log, findings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a log holds, and how many of its findings are above a note."""
    return {
        "log": log.name,
        "samples": len(log),
        "duration": float(log.t[-1] - log.t[0]),
        "channels": len(log.channels),
        "lost": sum(int(mask.sum()) for why, mask in log.masks.items() if why.startswith("hard:")),
        "loud": sum(finding["level"] != _NOTE for finding in findings),
        "findings": len(findings),
    }


def log_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a row for each log, as `log_row` describes it."""
    return table_of(
        rows,
        [
            ("log", "log"),
            ("samples", "samples", whole),
            ("step [s]", lambda row: number(row["duration"] / max(row["samples"] - 1, 1), 4), str),
            ("duration [s]", lambda row: number(row["duration"], 4), str),
            ("channels", "channels", str),
            ("samples in gaps", "lost", whole),
            ("to look at", lambda row: bad_where(row["loud"], row["loud"])),
            ("notes", lambda row: row["findings"] - row["loud"], str),
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
