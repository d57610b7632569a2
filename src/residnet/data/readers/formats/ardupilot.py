"""ArduPilot's onboard logs (.bin, or the same as text), through the package pymavlink."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.data.readers.base import (
    REPORT_EVERY,
    Advance,
    missing_package,
    progress,
    require_file,
)
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import EVERYTHING, Recording, Series, Wanted

_BINARY, _TEXT = b"\xa3\x95\x80", b"FMT,"
"""How the two kinds of logs begin: with the message that describes messages."""
_TICKS = {"TimeUS": 1_000, "TimeMS": 1_000_000, "T": 1_000_000}
"""Field of the time since boot -> its unit in ns."""
_DATED = 100_000_000.0
"""Unix time in s, of 1973: a clock below it counts from the start, since it had no GPS."""


@final
class ArduPilotConfig(RecordingConfig):
    """An ArduPilot dataflash log.

    A series is named by its message (`ATT`, `GPS`, the second instance `GPS_1`), fields bear
    ArduPilot's names.
    """

    kind: Literal["ardupilot"] = "ardupilot"
    endings: ClassVar = (".bin",)
    formats: ClassVar = {
        "ArduPilot log": lambda path, head: head.lstrip().startswith((_BINARY, _TEXT))
    }

    def load(self, path: Path, wanted: Wanted = EVERYTHING) -> Recording:
        """Read the wanted messages of a dataflash log, on the boot clock (TimeUS).

        Dated by the receiver's GPS time where it logged one.

        Raises:
            UsageError: where the file is missing, nothing in it is wanted, or pymavlink is not
                installed.
            DataError: where it cannot be read.
        """
        require_file(path)
        try:
            from pymavlink.DFReader import DFReader_binary, DFReader_text
        except ImportError as error:
            raise missing_package("ardupilot", "pymavlink", "an ArduPilot log") from error
        columns: dict[str, _Columns] = {}
        listed: set[str] = set()
        try:
            with _silence():
                with path.open("rb") as stream:
                    text = stream.read(100).lstrip().startswith(_TEXT)
                reader = (DFReader_text if text else DFReader_binary)(str(path))
            with progress(path.name, path.stat().st_size, 100.0) as advance:
                _collect(reader, columns, listed, wanted, advance)
            base = float(reader.clock.timebase or 0.0)
        # pymavlink fails in its own ways on damaged bytes
        except Exception as error:
            raise DataError(
                f"{path}: damaged or not an ArduPilot log ({type(error).__name__}:"
                f" {' '.join(str(error).split())[:200]})"
            ) from error
        if not columns:
            if listed:
                raise UsageError(
                    f"{path}: none of its messages is wanted (it holds {', '.join(sorted(listed))})"
                )
            raise DataError(f"{path}: holds no message with a time; is it an ArduPilot log?")
        start = min(one.time[0] for one in columns.values())
        boot = round(base * 1e6) * 1000 if base > _DATED else None
        epoch = None if boot is None else (boot + start) // 10**9 * 10**9
        origin = 0 if boot is None or epoch is None else epoch - boot
        series = {name: one.series(name, origin) for name, one in sorted(columns.items())}
        return Recording(path, series, epoch, (path,), (), tuple(sorted(listed - set(series))))


def _collect(
    reader: Any, columns: dict[str, _Columns], listed: set[str], wanted: Wanted, advance: Advance
) -> None:
    count, quiet = 0, io.StringIO()
    while True:
        # what cannot be parsed is skipped, and printed
        with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
            message = reader.recv_msg()
        if message is None:
            return
        count += 1
        if count % REPORT_EVERY == 0:
            advance(reader.percent)
        fields = message.get_fieldnames()
        kind, instance = message.get_type(), message.fmt.instance_field
        # logs of 2014 count milliseconds, which a fix of theirs holds at its end
        clock = fields[0] if fields else ""
        clock = "T" if kind == "GPS" and clock not in _TICKS and "T" in fields else clock
        if clock not in _TICKS:
            continue
        number = int(getattr(message, instance)) if instance in fields else 0
        name = f"{kind}_{number}" if number else kind
        listed.add(name)
        if not wanted(name):
            continue
        if name not in columns:
            values = {field: getattr(message, field) for field in fields if field != clock}
            numbers = [f for f, v in values.items() if isinstance(v, int | float)]
            kept = [field for field in numbers if wanted.field(name, field)]
            columns[name] = _Columns(kind, kept, clock)
        columns[name].add(message)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keeps the indexer of pymavlink, which is compiled, from printing every byte that it skips."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [(number, os.dup(number)) for number in (1, 2)]
    quiet = io.StringIO()
    with Path(os.devnull).open("wb") as nowhere:
        for number, _ in saved:
            os.dup2(nowhere.fileno(), number)
        try:
            with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
                yield
        finally:
            for number, copy in saved:
                os.dup2(copy, number)
                os.close(copy)


@final
class _Columns:
    """Messages of one kind: time in ns since boot, numbers row by row."""

    def __init__(self, kind: str, names: list[str], clock: str) -> None:
        self._kind, self._names, self._clock = kind, names, clock
        self.time, self._rows = array("q"), array("d")

    def add(self, message: Any) -> None:
        """Append one message to the columns."""
        self.time.append(int(getattr(message, self._clock)) * _TICKS[self._clock])
        self._rows.extend([getattr(message, name) for name in self._names])

    def series(self, name: str, origin: int) -> Series:
        """Return the columns as a series with times in s from `origin` (ns since boot)."""
        rows = np.frombuffer(self._rows, dtype=np.float64).reshape(len(self.time), len(self._names))
        t = (np.frombuffer(self.time, dtype=np.int64) - origin) * 1e-9
        fields = {field: rows[:, i] for i, field in enumerate(self._names)}
        return Series(name, f"ardupilot/{self._kind}", fields, t)
