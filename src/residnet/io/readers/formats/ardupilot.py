"""Reader of ArduPilot dataflash logs (binary or text), with the package pymavlink."""

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

_BINARY_MAGIC = b"\xa3\x95\x80"
_TEXT_MAGIC = b"FMT,"
"""First bytes of binary and of text logs: the message that defines messages."""
_CLOCK_FIELDS_NS = {"TimeUS": 1_000, "TimeMS": 1_000_000, "T": 1_000_000}
"""Field of the time since boot -> its unit in ns."""
_MIN_UNIX_TIME = 100_000_000.0
"""Unix time in s (in 1973) below which a clock counts from boot, because GPS was missing."""


@final
class ArduPilotConfig(RecordingConfig):
    """Reader of ArduPilot dataflash logs.

    A series has the name of its message (`ATT`, `GPS`, the second instance `GPS_1`). Fields have
    the names of ArduPilot.
    """

    kind: Literal["ardupilot"] = "ardupilot"
    endings: ClassVar = (".bin",)
    formats: ClassVar = {
        "ArduPilot log": lambda path, head: head.lstrip().startswith((_BINARY_MAGIC, _TEXT_MAGIC))
    }

    def load(self, path: Path, field_filter: FieldFilter = ALL_FIELDS) -> Recording:
        """Read messages of a dataflash log.

        Times are those since boot, completed with the date from GPS time if it was logged.
        """
        require_file(path)
        with optional_import("ardupilot", "pymavlink", "an ArduPilot log"):
            from pymavlink.DFReader import DFReader_binary, DFReader_text
        columns: dict[str, MessageBuffer] = {}
        kinds: dict[str, str] = {}
        n_messages = 0
        discarded_output = io.StringIO()
        # pymavlink raises many types of exceptions on damaged files
        with (
            wrap_read_errors(path, "an ArduPilot log"),
            reading_progress(path.name, path.stat().st_size, 100.0) as advance,
        ):
            with _silence_output(), path.open("rb") as stream:
                is_text = stream.read(100).lstrip().startswith(_TEXT_MAGIC)
                reader = (DFReader_text if is_text else DFReader_binary)(str(path))
            while True:
                # pymavlink prints bytes that it cannot parse and skips them
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
                message_type = message.get_type()
                instance = message.fmt.instance_field
                # logs of 2014 have milliseconds, in GPS messages in the last field T
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
                    f"{path}: has none of the configured messages (it contains"
                    f" {', '.join(sorted(kinds))})"
                )
            raise DataError(
                f"{path}: has no message with a time, an ArduPilot log was expected; leave the file"
                " out"
            )
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
    """Discard the output of compiled code, which bypasses `sys.stdout`.

    The indexer of pymavlink prints every byte that it skips.
    """
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
