"""Task `import`: recordings of any format become canonical logs with findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from residnet.core.config import ConfigPath
from residnet.core.errors import ConfigError
from residnet.core.files import file_stem
from residnet.core.format import minus, number, shown_unit, whole
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.progress import report
from residnet.data.readers import ReaderConfig
from residnet.data.readers.base import files_of
from residnet.data.split import log_names
from residnet.report.blocks import Block, Bullets, Section, Table, Text, bad_where, table_of
from residnet.report.figure import GLANCE, SOLID, START, Case, Curve, Figure, Panel
from residnet.report.figure_files import write_figure
from residnet.report.run_reader import RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task

_READ_AT_ONCE = 50_000_000
"""Bytes of the largest recording that a check reads."""
_NOTE = "note"


class ImportConfig(Task):
    """Recordings of any format that become canonical logs, with what was noticed on the way in.

    Attributes:
        reader: how the recordings are read.
        root: folder that `logs` start from; the current folder where not given.
        logs: files, folders (for readers of folders) or patterns such as `raw_*`.
    """

    task: Literal["import"]
    reader: ReaderConfig
    root: ConfigPath | None = None
    logs: tuple[str, ...] = Field(min_length=1)

    def check(self) -> None:
        """Check that every pattern matches, and that the reader understands the recordings.

        The smallest recording of each kind of file is read, unless it is large.

        Raises:
            ResidnetError: where a pattern matches nothing, or a recording cannot be read as the
                config says.
        """
        reader = self.reader.build()
        smallest: dict[str, tuple[int, Path]] = {}
        for path in self._paths():
            size = sum(file.stat().st_size for file in files_of(path))
            kind = path.suffix.lower()
            if size <= _READ_AT_ONCE and (kind not in smallest or size < smallest[kind][0]):
                smallest[kind] = (size, path)
        for _, path in smallest.values():
            reader.read(path)

    def input_files(self) -> list[Path]:
        return [file for path in self._paths() for file in files_of(path)]

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Read the recordings, and write logs and findings.

        Raises:
            UsageError: where a recording, topic or package is missing.
            DataError: where a recording cannot be used; those before it have been written.
        """
        paths = self._paths()
        reader, names = self.reader.build(), log_names(paths)
        findings: dict[str, Any] = {}
        rows = []
        for place, path in enumerate(paths):
            report("reading recordings", place, len(paths))
            log = reader.read(path).replace(name=names[path])
            log.save(folder.path / "logs" / f"{file_stem(log.name)}.parquet")
            findings[log.name] = log.meta.get("findings", [])
            rows.append(log_row(log, findings[log.name]))
        report("reading recordings", len(paths), len(paths))
        folder.write_json(folder.path / "findings.json", findings)
        loud = sum(row["loud"] > 0 for row in rows)
        sentence = (
            f"{len(paths)} recording{'s were' if len(paths) > 1 else ' was'} read;"
            f" {loud or 'none'} of them {'have findings' if loud != 1 else 'has findings'} that"
            " need a look."
        )
        figures = {"logs": MainFigure(len(paths)), "logs_with_findings": MainFigure(loud)}
        text = "\n".join([log_table(rows).text(), *loud_lines(findings)])
        return Outcome([sentence], figures, text)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        findings: Mapping[str, Sequence[Mapping[str, Any]]] = RunFiles(run.path).json(
            "findings.json"
        )
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
            Section("", [write_figure(run.figures, motion(logs)), table]),
            Section("Channels", channels),
            Section("What was noticed on the way in", blocks),
        ]

    def _paths(self) -> list[Path]:
        root = self.root or Path.cwd()
        found: dict[Path, None] = {}
        for pattern in self.logs:
            matches = [root / pattern] if (root / pattern).exists() else _globbed(root, pattern)
            if not matches:
                near = (
                    nearest(pattern, (path.name for path in root.iterdir()))
                    if root.is_dir()
                    else f"; there is no folder {root}"
                )
                raise ConfigError(f"logs: '{pattern}' matches nothing in {root}{near}")
            found.update(dict.fromkeys(matches))
        return list(found)


def _globbed(root: Path, pattern: str) -> list[Path]:
    try:
        return sorted(root.glob(pattern))
    except (ValueError, NotImplementedError) as error:
        raise ConfigError(
            f"logs: '{pattern}' is not a pattern relative to {root} ({error}); set `root` instead"
        ) from error


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
