"""Logs into Python: read from files of any format, looked at by the data doctor."""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.api.values import PartGiven, PathGiven, described, hearing, part, path, plain
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.progress import ProgressCallback, report, say
from residnet.data.drafting.reading import log_files, read_each
from residnet.data.parts import log_names
from residnet.data.readers import ReaderConfig
from residnet.data.readers.base import LogReader
from residnet.tasks.drafting.yaml_text import commented

if TYPE_CHECKING:
    import pandas as pd

LogsGiven = PathGiven | Log | Sequence[PathGiven] | Sequence[Log]
"""Logs that were read, or where to read them."""


def read_logs(
    source: LogsGiven,
    *,
    channels: Mapping[str, Any] | None = None,
    time: str | tuple[str, str] | Mapping[str, str] = "t",
    manoeuvre: str | None = None,
    reader: PartGiven | None = None,
    progress: ProgressCallback | None = None,
) -> list[Log]:
    """Read logs from files, patterns or folders.

    A table (csv, foreign Parquet) needs to be told what its columns are: by `channels`, or by a
    `reader` as YAML has it. Without either the reader is drafted as `draft` does it, by names,
    headers, values and physics; it is reported to `progress`, with a comment at each guess.

    Args:
        source: a path, a pattern such as `trials/*.csv`, a folder, or a list of these.
        channels: channel -> (column, unit), for example `{"u": ("speed", "kn")}`, or a mapping with
            column, unit, sign and frame as YAML has it.
        time: column that holds time, in s, or (column, unit).
        manoeuvre: kind of manoeuvre of every file; `folder` takes the name of each file's folder.
        reader: kind or settings of a reader, in place of `channels`.
        progress: is told how far the reading is.

    Returns:
        The logs in the order of the files: channels [T] in SI units and radians.

    Raises:
        UsageError: where there is no such file, or a column or unit is wrong.
        DataError: where the contents of a file cannot be used.

    Example:
        logs = residnet.read_logs("trials/*.csv", channels={"u": ("speed", "kn"), ...})
    """
    given = _listed(source)
    if all(isinstance(entry, Log) for entry in given):
        return given
    with hearing(progress):
        files = _files(given)
        chosen = _reader(files[0], channels, time, manoeuvre, reader)
        if chosen is None:
            return _drafted(files)
        logs, names = [], log_names(files)
        for number, file in enumerate(files):
            report("reading logs", number, len(files))
            logs.append(chosen.read(file).replace(name=names[file]))
        report("reading logs", len(files), len(files))
    return logs


def _drafted(files: Sequence[Path]) -> list[Log]:
    logs: dict[Path, Log] = {}
    for draft in read_each(files):
        for error in draft.left_out.values():
            raise error
        if "channels" in draft.reader:
            say(f"{next(iter(draft.logs))}: channel map as guessed, to be checked")
            content = {"data": {"reader": draft.reader}}
            for line in commented(content, draft.marks.comments, ()).splitlines():
                say(f"  {line}")
        logs |= draft.logs
    names = log_names(files)
    return [logs[file].replace(name=names[file]) for file in files]


def _listed(source: Any) -> list[Any]:
    if isinstance(source, list | tuple):
        if not source:
            raise UsageError("read_logs: no log is given; name files, a pattern or a folder")
        if len({isinstance(entry, Log) for entry in source}) > 1:
            raise UsageError("read_logs: give either paths or logs that were read, not both")
        return list(source)
    return [source]


def _files(given: Sequence[Any]) -> list[Path]:
    paths: list[Path] = []
    for entry in given:
        file = path(entry, "read_logs")
        if file.exists() or not glob.has_magic(str(file)):
            paths.append(file)
            continue
        found = sorted(Path(name) for name in glob.glob(str(file), recursive=True))  # noqa: PTH207
        if not found:
            raise UsageError(f"read_logs: '{file}' matches no file")
        paths += found
    return log_files(paths, folders=True)


def _reader(
    first: Path,
    channels: Mapping[str, Any] | None,
    time: Any,
    manoeuvre: str | None,
    reader: PartGiven | None,
) -> LogReader | None:
    """The reader that the arguments describe; None where files are to describe themselves."""
    if reader is not None and channels is not None:
        raise UsageError("read_logs: give channels or a reader, not both")
    if reader is not None:
        built: LogReader = validate(part(reader, "reader"), ReaderConfig, "read_logs").build()
        return built
    if channels is None:
        return None
    settings = {
        "kind": "parquet" if first.suffix == ".parquet" else "csv",
        "time": _column(time, "time", "s"),
        "channels": {name: _column(entry, name) for name, entry in channels.items()},
        "manoeuvre": manoeuvre,
    }
    table: LogReader = validate(plain(settings), ReaderConfig, "read_logs").build()
    return table


def _column(given: Any, name: str, unit: str | None = None) -> Any:
    if isinstance(given, tuple | list) and len(given) == 2:
        return {"column": given[0], "unit": given[1]}
    if isinstance(given, str) and unit is not None:
        return {"column": given, "unit": unit}
    if isinstance(given, str):
        raise UsageError(
            f"read_logs: channels: {name}: give the column and its unit, for example"
            f" ('{given}', 'm/s')"
        )
    if isinstance(given, Mapping):
        return given
    raise UsageError(f"read_logs: channels: {name}: expected (column, unit), {described(given)}")


def inspect(
    logs: LogsGiven, *, inputs: Sequence[str] | None = None, masks: Sequence[Any] = ()
) -> pd.DataFrame:
    """Look at logs as a doctor would: clocks, gaps, jumps, frames, lags, copies, excitation.

    Args:
        logs: from `read_logs`, or what it takes.
        inputs: channels that drive the vessel; all that no sensor of the motion measures where
            None.
        masks: rules that will leave samples out, as YAML has them.

    Returns:
        One row for each finding, with the columns log (`together` for what concerns several), level
        (`note`, `will mislead`, `fatal`), code, text and action. A fit would be misled where any
        level is above `note`.

    Raises:
        UsageError: where a log lacks an input, or a path is wrong.
        DataError: where a log cannot be examined.

    Example:
        findings = residnet.inspect(logs); findings[findings.level != "note"]
    """
    import pandas as pd

    from residnet.data.doctor import inspect as examine
    from residnet.data.doctor import inspect_together
    from residnet.data.prepare import PrepareConfig

    members = read_logs(logs)
    settings = {"grid": {"step": 1.0}, "masks": plain(masks)}
    rules = validate(settings, PrepareConfig, "inspect").masks
    reports = [examine(log, inputs, rules) for log in members]
    reports.append(inspect_together(members, inputs))
    rows = [
        {
            "log": doctor.name,
            "level": finding.level,
            "code": finding.code,
            "text": finding.text,
            "action": finding.action,
        }
        for doctor in reports
        for finding in doctor.findings
    ]
    return pd.DataFrame(rows, columns=["log", "level", "code", "text", "action"])
