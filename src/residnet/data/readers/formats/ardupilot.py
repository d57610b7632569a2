"""ArduPilot's onboard logs (.bin, or the same as text), through the package pymavlink."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Literal, final

from residnet.core.errors import DataError, UsageError
from residnet.data.readers.base import (
    REPORT_EVERY,
    package,
    progress,
    readable,
    require_file,
)
from residnet.data.readers.compose import RecordingConfig
from residnet.data.readers.recording import (
    EVERYTHING,
    Columns,
    Recording,
    Rows,
    Stamps,
    Wanted,
    recording_of,
)

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
        """
        require_file(path)
        with package("ardupilot", "pymavlink", "an ArduPilot log"):
            from pymavlink.DFReader import DFReader_binary, DFReader_text
        columns: dict[str, Columns] = {}
        kinds: dict[str, str] = {}
        count, quiet = 0, io.StringIO()
        # pymavlink fails in its own ways on damaged bytes
        with (
            readable(path, "an ArduPilot log"),
            progress(path.name, path.stat().st_size, 100.0) as advance,
        ):
            with _silence(), path.open("rb") as stream:
                text = stream.read(100).lstrip().startswith(_TEXT)
                reader = (DFReader_text if text else DFReader_binary)(str(path))
            while True:
                # what cannot be parsed is skipped, and printed
                with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
                    message = reader.recv_msg()
                if message is None:
                    break
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
                kinds[name] = kind
                if not wanted(name):
                    continue
                if name not in columns:
                    values = {field: getattr(message, field) for field in fields if field != clock}
                    numbers = [f for f, v in values.items() if isinstance(v, int | float)]
                    columns[name] = Columns(f for f in numbers if wanted.field(name, f))
                one = columns[name]
                ns = int(getattr(message, clock)) * _TICKS[clock]
                one.add(ns, [getattr(message, field) for field in one.names])
            base = float(reader.clock.timebase or 0.0)
        if not columns:
            if kinds:
                raise UsageError(
                    f"{path}: none of its messages is wanted (it holds {', '.join(sorted(kinds))})"
                )
            raise DataError(f"{path}: holds no message with a time; is it an ArduPilot log?")
        boot = round(base * 1e6) * 1000 if base > _DATED else 0
        topics = {
            name: Rows(f"ardupilot/{kinds[name]}", one.fields, Stamps(one.times + boot, boot > 0))
            for name, one in sorted(columns.items())
        }
        return recording_of(path, topics, (path,), listed=sorted(kinds.keys() - topics))


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
