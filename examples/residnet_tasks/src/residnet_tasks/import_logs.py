"""Task `import`: convert recordings of any format to canonical logs and inspect them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from residnet.core.config import ConfigPath
from residnet.core.errors import ConfigError
from residnet.core.files import make_file_stem, read_json
from residnet.core.format import display_unit, format_integer, format_minus_signs, format_number
from residnet.core.log import Log
from residnet.core.names import suggest_name
from residnet.core.progress import report_progress
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import list_files
from residnet.io.split import assign_log_names
from residnet.report.blocks import Block, Bullets, Section, Table, Text, build_table, flag_cell
from residnet.report.figure import (
    MAX_PREVIEW_HEIGHT,
    SOLID_STYLE,
    START_STYLE,
    Case,
    Curve,
    Figure,
    Panel,
)
from residnet.report.figure_files import write_figure
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, Task, TaskOutcome

_MAX_CHECKED_BYTES = 50_000_000
"""Size in bytes of the largest recording that a check reads."""
_NOTE_LEVEL = "note"


class ImportConfig(Task):
    """Convert recordings of any format to canonical logs and inspect them.

    Attributes:
        reader: format of the recordings and channel map.
        root: folder of relative paths in `logs`; the current folder if not given.
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
            ResidnetError: if a pattern matches nothing, or the reader cannot read a recording.
        """
        reader = self.reader.build()
        smallest_by_suffix: dict[str, tuple[int, Path]] = {}
        for path in self._find_paths():
            size = sum(file.stat().st_size for file in list_files(path))
            suffix = path.suffix.lower()
            if size <= _MAX_CHECKED_BYTES and (
                suffix not in smallest_by_suffix or size < smallest_by_suffix[suffix][0]
            ):
                smallest_by_suffix[suffix] = (size, path)
        for _, path in smallest_by_suffix.values():
            reader.read(path)

    def input_files(self) -> list[Path]:
        return [file for path in self._find_paths() for file in list_files(path)]

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Convert the recordings, and write logs and findings.

        Raises:
            UsageError: if a recording, topic or package is missing.
            DataError: if a recording cannot be used; earlier recordings are already written.
        """
        paths = self._find_paths()
        reader = self.reader.build()
        names = assign_log_names(paths)
        findings: dict[str, Any] = {}
        rows = []
        for number, path in enumerate(paths):
            report_progress("reading recordings", number, len(paths))
            log = reader.read(path).replace(name=names[path])
            log.save(folder.path / "logs" / f"{make_file_stem(log.name)}.parquet")
            findings[log.name] = log.meta.get("findings", [])
            rows.append(describe_log(log, findings[log.name]))
        report_progress("reading recordings", len(paths), len(paths))
        folder.write_json(folder.path / "findings.json", findings)
        n_with_warnings = sum(row["loud"] > 0 for row in rows)
        sentence = (
            f"{len(paths)} recording{'s were' if len(paths) > 1 else ' was'} read;"
            f" {n_with_warnings or 'none'} of them"
            f" {'have findings' if n_with_warnings != 1 else 'has findings'} that"
            " need a look."
        )
        summary_metrics = {
            "logs": SummaryMetric(len(paths)),
            "logs_with_findings": SummaryMetric(n_with_warnings),
        }
        text = "\n".join([tabulate_logs(rows).to_text(), *warning_lines(findings)])
        return TaskOutcome([sentence], summary_metrics, text)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        findings: Mapping[str, Sequence[Mapping[str, Any]]] = read_json(run.path / "findings.json")
        logs = [Log.load(path) for path in sorted((run.path / "logs").glob("*.parquet"))]
        channels = [Section(log.name, [tabulate_channels(log)], is_folded=True) for log in logs]
        table = tabulate_logs([describe_log(log, findings.get(log.name, [])) for log in logs])
        warnings = warning_lines(findings)
        blocks: list[Block] = (
            [Bullets(warnings, is_warning=True)] if warnings else [Text("Nothing needs a look.")]
        )
        for log, log_findings in findings.items():
            notes = [
                format_minus_signs(str(finding["text"]))
                for finding in log_findings
                if finding["level"] == _NOTE_LEVEL
            ]
            if notes:
                blocks.append(Section(f"Notes on {log}", [Bullets(notes)], is_folded=True))
        return [
            Section("", [write_figure(run.figures, plot_recordings(logs)), table]),
            Section("Channels", channels),
            Section("What was noticed on the way in", blocks),
        ]

    def _find_paths(self) -> list[Path]:
        root = self.root or Path.cwd()
        paths: dict[Path, None] = {}
        for pattern in self.logs:
            matches = (
                [root / pattern] if (root / pattern).exists() else _expand_pattern(root, pattern)
            )
            if not matches:
                suggestion = (
                    suggest_name(pattern, (path.name for path in root.iterdir()))
                    if root.is_dir()
                    else f"; there is no folder {root}"
                )
                raise ConfigError(f"logs: '{pattern}' matches nothing in {root}{suggestion}")
            paths.update(dict.fromkeys(matches))
        return list(paths)


def _expand_pattern(root: Path, pattern: str) -> list[Path]:
    try:
        return sorted(root.glob(pattern))
    except (ValueError, NotImplementedError) as error:
        raise ConfigError(
            f"logs: '{pattern}' is not a pattern relative to {root} ({error}); set `root` instead"
        ) from error


def plot_recordings(logs: Sequence[Log]) -> Figure:
    """Return a figure of the tracks; without positions, of a channel that all logs contain.

    Args:
        logs: at least one log; positions are relative to the first one of each log.
    """
    common_channels = [
        name for name in logs[0].channels if all(name in log.channels for log in logs)
    ]
    if has_position := {"x", "y"} <= set(common_channels):
        panel = Panel("north [m]", "east [m]", kind="map", height=MAX_PREVIEW_HEIGHT)
    else:
        name = next(iter(common_channels), next(iter(logs[0].channels)))
        unit, factor = display_unit(logs[0].units.get(name, "-"))
        panel = Panel(f"{name} [{unit}]", "time [s]", height=MAX_PREVIEW_HEIGHT)

    def log_curves(log: Log) -> dict[str, Curve]:
        if not has_position:
            return {"log": (log.t, factor * log[name])} if name in log.channels else {}
        is_finite = np.isfinite(log["x"]) & np.isfinite(log["y"])
        first_index = int(np.argmax(is_finite))
        track = tuple(log[axis][is_finite] - log[axis][first_index] for axis in ("y", "x"))
        return {"log": (track[0], track[1]), "start": (np.zeros(1), np.zeros(1))}

    return Figure(
        "recordings",
        "What was recorded",
        "",
        {"log": replace(SOLID_STYLE, label="measured"), "start": START_STYLE},
        [panel],
        [Case(log.name, [log_curves(log)], has_static_image=log is logs[0]) for log in logs],
        "Recording",
    )


def warning_lines(findings: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Return a line for each finding above the level `note`, by name of the log."""
    return [
        f"{log}: {finding['level']}: {format_minus_signs(str(finding['text']))}"
        for log, log_findings in findings.items()
        for finding in log_findings
        if finding["level"] != _NOTE_LEVEL
    ]


def describe_log(log: Log, findings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a summary of a log with its number of findings above the level `note`."""
    return {
        "log": log.name,
        "samples": len(log),
        "duration": float(log.t[-1] - log.t[0]),
        "channels": len(log.channels),
        "lost": sum(
            int(mask.sum()) for reason, mask in log.masks.items() if reason.startswith("hard:")
        ),
        "loud": sum(finding["level"] != _NOTE_LEVEL for finding in findings),
        "findings": len(findings),
    }


def tabulate_logs(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return a table with the summary of each log, see `describe_log`."""
    return build_table(
        rows,
        [
            ("log", "log"),
            ("samples", "samples", format_integer),
            (
                "step [s]",
                lambda row: format_number(row["duration"] / max(row["samples"] - 1, 1), 4),
                str,
            ),
            ("duration [s]", lambda row: format_number(row["duration"], 4), str),
            ("channels", "channels", str),
            ("samples in gaps", "lost", format_integer),
            ("to look at", lambda row: flag_cell(row["loud"], row["loud"])),
            ("notes", lambda row: row["findings"] - row["loud"], str),
        ],
    )


def tabulate_channels(log: Log) -> Table:
    """Return a table with unit, range and missing samples of each channel."""
    rows = []
    for name, values in log.channels.items():
        unit, factor = display_unit(log.units.get(name, "-"))
        finite = factor * np.asarray(values, dtype=float)[np.isfinite(values)]
        finite_or_nan = finite if finite.size else np.array([np.nan])
        rows.append(
            {
                "channel": name,
                "unit": unit,
                "least": float(finite_or_nan.min()),
                "mean": float(finite_or_nan.mean()),
                "largest": float(finite_or_nan.max()),
                "missing": format_number(100.0 * (1.0 - finite.size / max(values.size, 1)), 2),
            }
        )
    return build_table(
        rows,
        [
            ("channel", "channel"),
            ("unit", "unit", str),
            *((name, name, format_number) for name in ("least", "mean", "largest")),
            ("missing [%]", "missing", str),
        ],
    )
