"""Recognition of a file's reader, by content first and ending second, without a config."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.data.readers.base import LogReader, require_file
from residnet.data.readers.composing.clocks import align_clocks
from residnet.data.readers.composing.composed import RecordingConfig
from residnet.data.readers.composing.wanted import EVERYTHING, Wanted
from residnet.data.readers.encoding import encoding_of_head
from residnet.data.readers.recorders.ardupilot import ArduPilotConfig
from residnet.data.readers.recorders.hdf5 import Hdf5Config, is_hdf5
from residnet.data.readers.recorders.mat import MatConfig
from residnet.data.readers.recorders.nmea import NmeaConfig
from residnet.data.readers.recorders.rosbag import RosbagConfig
from residnet.data.readers.recorders.topic_folder import TopicFolderConfig, is_topic_folder
from residnet.data.readers.recorders.ulog import UlogConfig
from residnet.data.readers.recording import Recording
from residnet.data.readers.tables.canonical import CanonicalConfig

TABLES = (".csv", ".tsv", ".txt", ".dat", ".xlsx", ".parquet", ".jsonl", ".ndjson")
"""Endings of tables, which do not say what their columns are."""
_MCAP = b"\x89MCAP0\r\n"
_SQLITE = b"SQLite format 3\x00"
_MAT5 = b"MATLAB 5.0"
_ULOG = b"ULog\x01\x12\x35"
_DATAFLASH = b"\xa3\x95\x80"
# a sentence with its checksum at the start of a line, or behind a time
_NMEA = re.compile(rb"(?m)^[^$!\n]{0,40}[$!][A-Z]{2}[A-Z]{3},[\x20-\x7e]*\*[0-9A-Fa-f]{2}\s*$")


def _text(head: bytes) -> bytes:
    """Return the first bytes of a text as UTF-8."""
    return head.decode(encoding_of_head(head), errors="replace").encode("utf-8")


@dataclass(frozen=True)
class Format:
    """A format of recordings: how it is recognised, and its config for standard messages."""

    name: str
    fits: Callable[[Path, bytes], bool]
    config: Callable[[], RecordingConfig]


# in the order in which they are asked: content that cannot be mistaken first, endings last
FORMATS: tuple[Format, ...] = (
    Format(
        "ROS 2 bag",
        lambda path, head: path.is_dir() and (path / "metadata.yaml").is_file(),
        RosbagConfig,
    ),
    Format("folder of csv files", lambda path, head: is_topic_folder(path), TopicFolderConfig),
    Format("ROS 1 bag", lambda path, head: head.startswith(b"#ROSBAG"), RosbagConfig),
    Format("MCAP", lambda path, head: head.startswith(_MCAP), RosbagConfig),
    Format(
        "ROS 2 bag (SQLite)",
        lambda path, head: head.startswith(_SQLITE) and path.suffix == ".db3",
        RosbagConfig,
    ),
    Format("PX4 ULog", lambda path, head: head.startswith(_ULOG), UlogConfig),
    Format("ArduPilot log", lambda path, head: head.startswith(_DATAFLASH), ArduPilotConfig),
    Format("NMEA 0183", lambda path, head: _NMEA.search(_text(head)) is not None, NmeaConfig),
    Format(
        "MATLAB",
        lambda path, head: head.startswith(_MAT5) or path.suffix.lower() == ".mat",
        MatConfig,
    ),
    Format("HDF5", lambda path, head: is_hdf5(path), Hdf5Config),
)


@final
class AutoConfig(RecordingConfig):
    """Any recording that describes itself, recognised by its content and ending.

    The kinds of single formats have settings of their own.
    """

    kind: Literal["auto"] = "auto"

    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Read a recording of any format that describes itself."""
        return _config_for(path).load(path, wanted)


def format_of(path: Path) -> Format | None:
    """Return the format of a recording.

    None where it is none that describes itself (a csv table, a foreign Parquet file, anything
    else).

    Raises:
        UsageError: where there is nothing at `path`.
    """
    head = b""
    if not path.is_dir():
        require_file(path)
        with path.open("rb") as stream:
            head = stream.read(1024)
    return next(
        (recording_format for recording_format in FORMATS if recording_format.fits(path, head)),
        None,
    )


def kind_of(path: Path) -> str:
    """Return the kind of a log: canonical, table, or the name of a format of recordings.

    Raises:
        UsageError: where there is nothing at `path`, or it is of no format that residnet knows.
    """
    if Log.recognises(path):
        return "canonical"
    recording = format_of(path)
    if recording is None and path.suffix.lower() not in TABLES:
        raise UsageError(f"{path}: is of no format that residnet knows")
    return "table" if recording is None else recording.name


def reader_for(path: Path) -> LogReader:
    """Return a reader for a file or folder that describes itself.

    Raises:
        UsageError: where there is nothing at `path`, or it needs a channel map.
    """
    if Log.recognises(path):
        return CanonicalConfig().build()
    return _config_for(path).build()


def recording_for(path: Path) -> Recording:
    """Return all that a file or folder holds, its clocks settled, before it becomes a log.

    Raises:
        UsageError: where there is nothing at `path`, or its format describes no channels.
        DataError: where it cannot be read.
    """
    return align_clocks(_config_for(path).load(path, EVERYTHING), {}, None)


def _config_for(path: Path) -> RecordingConfig:
    recording_format = format_of(path)
    if recording_format is None:
        names = ", ".join(dict.fromkeys(entry.name for entry in FORMATS))
        raise UsageError(
            f"{path}: does not say what its columns are; give a channel map with --config (formats"
            f" that need none: {names}, canonical Parquet)"
        )
    return recording_format.config()
