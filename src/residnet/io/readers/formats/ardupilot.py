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
from residnet.io.readers.base import (
    REPORT_INTERVAL,
    optional_import,
    reading_progress,
    require_file,
    wrap_read_errors,
)
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.recording import (
    ALL_FIELDS,
    FieldFilter,
    MessageBuffer,
    RawSeries,
    Recording,
    TimeStamps,
    build_recording,
)

_BINARY_MAGIC, _TEXT_MAGIC = b"\xa3\x95\x80", b"FMT,"
"""How the two kinds of logs begin: with the message that describes messages."""
_CLOCK_FIELDS_NS = {"TimeUS": 1_000, "TimeMS": 1_000_000, "T": 1_000_000}
"""Field of the time since boot -> its unit in ns."""
_MIN_UNIX_TIME = 100_000_000.0
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
        "ArduPilot log": lambda path, head: head.lstrip().startswith((_BINARY_MAGIC, _TEXT_MAGIC))
    }

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read the wanted messages of a dataflash log, on the boot clock (TimeUS).

        Dated by the receiver's GPS time where it logged one.
        """
        require_file(path)
        with optional_import("ardupilot", "pymavlink", "an ArduPilot log"):
            from pymavlink.DFReader import DFReader_binary, DFReader_text
        columns: dict[str, MessageBuffer] = {}
        kinds: dict[str, str] = {}
        n_messages, discarded_output = 0, io.StringIO()
        # pymavlink fails in its own ways on damaged bytes
        with (
            wrap_read_errors(path, "an ArduPilot log"),
            reading_progress(path.name, path.stat().st_size, 100.0) as advance,
        ):
            with _silence_output(), path.open("rb") as stream:
                is_text = stream.read(100).lstrip().startswith(_TEXT_MAGIC)
                reader = (DFReader_text if is_text else DFReader_binary)(str(path))
            while True:
                # what cannot be parsed is skipped, and printed
                with (
                    contextlib.redirect_stdout(discarded_output),
                    contextlib.redirect_stderr(discarded_output),
                ):
                    message = reader.recv_msg()
                if message is None:
                    break
                n_messages += 1
                if n_messages % REPORT_INTERVAL == 0:
                    advance(reader.percent)
                fields = message.get_fieldnames()
                message_type, instance = message.get_type(), message.fmt.instance_field
                # logs of 2014 count milliseconds, which a fix of theirs holds at its end
                clock_field = fields[0] if fields else ""
                clock_field = (
                    "T"
                    if message_type == "GPS"
                    and clock_field not in _CLOCK_FIELDS_NS
                    and "T" in fields
                    else clock_field
                )
                if clock_field not in _CLOCK_FIELDS_NS:
                    continue
                number = int(getattr(message, instance)) if instance in fields else 0
                name = f"{message_type}_{number}" if number else message_type
                kinds[name] = message_type
                if not field_filter(name):
                    continue
                if name not in columns:
                    field_values = {
                        field: getattr(message, field) for field in fields if field != clock_field
                    }
                    numeric_fields = [
                        f for f, v in field_values.items() if isinstance(v, int | float)
                    ]
                    columns[name] = MessageBuffer(
                        f for f in numeric_fields if field_filter.accepts_field(name, f)
                    )
                buffer = columns[name]
                ns = int(getattr(message, clock_field)) * _CLOCK_FIELDS_NS[clock_field]
                buffer.add(ns, [getattr(message, field) for field in buffer.names])
            boot_seconds = float(reader.clock.timebase or 0.0)
        if not columns:
            if kinds:
                raise UsageError(
                    f"{path}: none of its messages is wanted (it holds {', '.join(sorted(kinds))})"
                )
            raise DataError(f"{path}: holds no message with a time; is it an ArduPilot log?")
        boot_ns = round(boot_seconds * 1e6) * 1000 if boot_seconds > _MIN_UNIX_TIME else 0
        topics = {
            name: RawSeries(
                f"ardupilot/{kinds[name]}",
                buffer.fields,
                TimeStamps(buffer.times + boot_ns, boot_ns > 0),
            )
            for name, buffer in sorted(columns.items())
        }
        return build_recording(path, topics, (path,), unread_series=sorted(kinds.keys() - topics))


@contextlib.contextmanager
def _silence_output() -> Iterator[None]:
    """Keeps the indexer of pymavlink, which is compiled, from printing every byte that it skips."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved_descriptors = [(descriptor, os.dup(descriptor)) for descriptor in (1, 2)]
    discarded_output = io.StringIO()
    with Path(os.devnull).open("wb") as null_device:
        for descriptor, _ in saved_descriptors:
            os.dup2(null_device.fileno(), descriptor)
        try:
            with (
                contextlib.redirect_stdout(discarded_output),
                contextlib.redirect_stderr(discarded_output),
            ):
                yield
        finally:
            for descriptor, saved_copy in saved_descriptors:
                os.dup2(saved_copy, descriptor)
                os.close(saved_copy)
