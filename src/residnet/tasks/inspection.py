"""`residnet inspect`: the data doctor over files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from residnet.core.errors import ConfigError, UsageError
from residnet.data.doctor import inspect
from residnet.data.readers import CanonicalConfig
from residnet.data.readers.base import LogReader
from residnet.data.sources import MeasuredLogs


def inspect_logs(paths: Sequence[Path], config: Path | None) -> bool:
    """Print what the doctor finds in each log; True where a fit would be misled.

    Raises:
        ResidnetError: where a log cannot be read.
    """
    from residnet.tasks import load_task
    from residnet.tasks.fit import FitConfig

    reader: LogReader = CanonicalConfig().build()
    inputs: Sequence[str] | None = None
    if config is not None:
        task = load_task(config, [])
        if not isinstance(task, FitConfig) or not isinstance(task.data, MeasuredLogs):
            raise ConfigError(f"{config}: has no channel map (data.kind is not 'measured'); leave --config out for canonical logs")
        reader, inputs = task.data.reader.build(), task.signals.columns
    misled = False
    for path in log_files(paths):
        result = inspect(reader.read(path), inputs)
        misled |= result.misled
        print("\n".join(result.lines()))
    return misled


def log_files(paths: Sequence[Path]) -> list[Path]:
    """Files, and the csv and Parquet files below folders, in order.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = sorted(p for p in path.rglob("*") if p.suffix in {".csv", ".parquet"})
            if not found:
                raise UsageError(f"{path}: holds no csv or Parquet file")
            out += found
        elif path.is_file():
            out.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    return out
