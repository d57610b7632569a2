"""Task `import`: recordings of any format become canonical logs with findings."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from residnet.core.config import ConfigPath
from residnet.core.errors import ConfigError
from residnet.core.files import file_stem
from residnet.core.names import nearest
from residnet.core.progress import report
from residnet.data.readers import ReaderConfig
from residnet.data.readers.base import files_of
from residnet.data.split import log_names
from residnet.report.sections.import_logs import log_row, log_table, loud_lines
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome, Task

_READ_AT_ONCE = 50_000_000
"""Bytes of the largest recording that a check reads."""


class ImportConfig(Task):
    """Recordings of any format that become canonical logs, with what was noticed on the way in.

    Attributes:
        reader: how the recordings are read.
        root: folder that `logs` start from; the current folder where not given.
        logs: files, folders (for readers of folders) or patterns such as `raw_*`.
    """

    page: ClassVar[str] = "import_logs"

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
        for number, path in enumerate(paths):
            report("reading recordings", number, len(paths))
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
