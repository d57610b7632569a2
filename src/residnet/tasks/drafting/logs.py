"""The logs of a draft: which files there are, how they are read, and which can be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from residnet.core.config import validate
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.log import Log
from residnet.core.progress import report
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.recordings import draft_recordings
from residnet.data.drafting.sheets import ENDINGS
from residnet.data.drafting.tables import draft_tables
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.parts import log_names, logs_below
from residnet.data.readers import ReaderConfig
from residnet.data.readers.detect import format_of

_UNTOLD = ("columns that no channel takes", "columns of text", "fields that no channel takes")


@dataclass(frozen=True)
class ReadLogs:
    """Logs and the reader that reads them.

    Attributes:
        reader: `data.reader` of a config.
        logs: path -> log, in SI, as the reader gives it.
        whole: path -> the same with the motion at every sample.
        left_out: path -> why it is not used.
    """

    reader: dict[str, Any]
    logs: dict[Path, Log]
    whole: dict[Path, Log]
    left_out: dict[Path, str] = field(default_factory=dict)


def found_logs(paths: Sequence[Path]) -> list[Path]:
    """Return the recordings and files of logs that paths name.

    Raises:
        UsageError: where a path does not exist, or there is no log.
    """
    out: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path}: no such file or folder")
        out |= dict.fromkeys(logs_below(path) if path.is_dir() else [path])
    if not out:
        raise UsageError(f"{', '.join(map(str, paths))}: holds no log of a format that is known")
    return list(out)


def read_all(paths: Sequence[Path], marks: Marks) -> ReadLogs:
    """Return the logs in files of one format, read by a drafted reader.

    Args:
        paths: files and recordings.
        marks: is told what is not sure.

    Raises:
        UsageError: where the files are of several formats.
        DataError: where none can be used.
    """
    kinds = {_kind(path) for path in paths}
    if len(kinds) > 1:
        named = "; ".join(
            f"{kind}: {', '.join(p.name for p in paths if _kind(p) == kind)[:120]}"
            for kind in sorted(kinds)
        )
        raise UsageError(
            f"the logs are of several formats, and a fit reads one ({named}); give those of one"
        )
    kind = kinds.pop()
    left_out: dict[Path, str] = {}
    if kind == "canonical":
        content: dict[str, Any] = {"kind": "canonical"}
    elif kind == "table":
        tables = draft_tables(paths, marks)
        content, left_out = tables.content, tables.left_out
    else:
        content = draft_recordings(paths, marks)
    reader = validate(content, ReaderConfig, "draft").build()
    logs: dict[Path, Log] = {}
    names = log_names(paths)
    for number, path in enumerate(paths):
        report("reading logs", number, len(paths))
        try:
            if path not in left_out:
                logs[path] = reader.read(path).replace(name=names[path])
        except ResidnetError as error:
            left_out[path] = str(error)
    report("reading logs", len(paths), len(paths))
    if not logs:
        raise DataError(next(iter(left_out.values())))
    return _completed(content, logs, left_out, marks)


def _kind(path: Path) -> str:
    """Return the kind of a log: canonical, table, or the name of a format of recordings."""
    if Log.recognises(path):
        return "canonical"
    recording = format_of(path)
    if recording is not None:
        return recording.name
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(f"{path}: is of no format that residnet knows")
    return "table"


def _completed(
    content: dict[str, Any], logs: dict[Path, Log], left_out: dict[Path, str], marks: Marks
) -> ReadLogs:
    whole: dict[Path, Log] = {}
    for path, log in logs.items():
        try:
            whole[path] = complete_motion(log, MotionConfig())
        except ResidnetError as error:
            left_out[path] = str(error)
    if not whole:
        # what the names of columns did not tell may be what is missing
        untold = "; ".join(text for _, text in marks.notes if text.startswith(_UNTOLD))
        reason = next(iter(left_out.values()))
        raise DataError(f"{reason} ({untold})" if untold else reason)
    return ReadLogs(content, {path: logs[path] for path in whole}, whole, left_out)
