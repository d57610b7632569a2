"""Detection of file formats by content and file extension, without a config."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.registry import get_kind, list_external_classes
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import ReaderKind, locate_file, require_file
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.formats.ardupilot import ArduPilotConfig
from residnet.io.readers.formats.matlab_hdf5 import Hdf5Config, MatConfig
from residnet.io.readers.formats.mavlink import MavlinkConfig
from residnet.io.readers.formats.moos import MoosConfig
from residnet.io.readers.formats.nmea import NmeaConfig
from residnet.io.readers.formats.nmea2000 import Nmea2000Config
from residnet.io.readers.formats.rosbag import RosbagConfig
from residnet.io.readers.formats.topic_folder import TopicFolderConfig
from residnet.io.readers.formats.ulog import UlogConfig
from residnet.io.readers.recording import FieldFilter, Recording
from residnet.io.readers.tables import TABLE_KINDS
from residnet.io.readers.text_tables import HeaderlessTableError, read_table_head

# formats with unambiguous content are tested first, formats known by their extension last
_RECORDING_CONFIGS: tuple[type[RecordingConfig], ...] = (
    RosbagConfig,
    TopicFolderConfig,
    UlogConfig,
    ArduPilotConfig,
    MavlinkConfig,
    MoosConfig,
    NmeaConfig,
    Nmea2000Config,
    MatConfig,
    Hdf5Config,
)
_BUILTIN_ENDINGS = (
    *(ending for ending in TABLE_KINDS if ending != ".json"),
    *(ending for config in _RECORDING_CONFIGS for ending in config.endings),
)
"""Extensions of files that may be logs; .json files usually hold metadata."""
_RESERVED_ENDINGS = {*_BUILTIN_ENDINGS, ".json"}
_PANDAS_READERS = {
    **dict.fromkeys((".gz", ".zip", ".bz2", ".xz"), "pandas.read_csv(file)"),
    **dict.fromkeys((".xls", ".ods"), "pandas.read_excel(file)"),
    ".pkl": "pandas.read_pickle(file)",
    ".feather": "pandas.read_feather(file)",
    **dict.fromkeys(
        (".db", ".sqlite", ".sqlite3"),
        "pandas.read_sql('SELECT * FROM log', sqlite3.connect(file))",
    ),
    **dict.fromkeys((".gpx", ".xml"), "pandas.read_xml(file, xpath='//*[@lat]')"),
    ".nc": "xarray.open_dataset(file).to_dataframe().reset_index()",
}
"""Extension -> Python expression that reads such a file as a table."""


@dataclass(frozen=True)
class RecordingFormat:
    """Format of a recording.

    Attributes:
        name: name of the format for messages.
        config: reader; one of residnet maps standard messages without further settings.
    """

    name: str
    config: type[ReaderKind]


def list_external_readers() -> list[type[ReaderKind]]:
    """Return the readers that other packages or Python arguments have registered."""
    return list_external_classes(ReaderConfig)


def list_log_endings() -> tuple[str, ...]:
    """Return the extensions of files that may be logs, including registered readers."""
    return (
        *_BUILTIN_ENDINGS,
        *(ending for reader in list_external_readers() for ending in _external_endings(reader)),
    )


def _external_endings(reader: type[ReaderKind]) -> list[str]:
    """Return the endings of a registered reader in lower case, if residnet does not use them."""
    # a package must not take over the tables and recordings that residnet reads
    return [ending.lower() for ending in reader.endings if ending.lower() not in _RESERVED_ENDINGS]


def suggest_conversion(ending: str) -> str:
    """Return an instruction to convert a file of an unsupported format to csv.

    Args:
        ending: extension of the file, with its dot.
    """
    pandas_call = _PANDAS_READERS.get(ending, "pandas.DataFrame(rows, columns=[...])")
    endings_text = ", ".join(
        f"{ending} ({get_kind(reader)})"
        for reader in list_external_readers()
        for ending in _external_endings(reader)
    )
    return (
        "convert it to csv with a line of column names, in Python"
        f" {pandas_call}.to_csv('log.csv', index=False)"
        + (f"; installed readers of other packages accept {endings_text}" if endings_text else "")
    )


def is_text_table(path: Path) -> bool:
    """Return whether a file is a text table with two or more numeric columns, or JSON."""
    if path.suffix.lower() == ".json":
        return True
    try:
        table, _ = read_table_head(path, 20)
    except HeaderlessTableError:
        return True
    except DataError:
        return False
    return len(table.select_dtypes("number").columns) > 1


@final
class AutoConfig(RecordingConfig):
    """Reader of any recording format that describes its contents, with automatic detection.

    The readers of single formats have further settings.
    """

    kind: Literal["auto"] = "auto"

    def load(self, path: Path, field_filter: FieldFilter) -> Recording:
        recording_format = detect_recording_format(path)
        if recording_format is None:
            names = ", ".join(name for config in _RECORDING_CONFIGS for name in config.formats)
            raise UsageError(
                f"{path}: the format does not describe its columns; set `kind` of the reader (csv,"
                " parquet, excel or json_lines) and `channels`, which `residnet new FOLDER` drafts"
                f" (kind auto reads: {names})"
            )
        reader = recording_format.config
        if not issubclass(reader, RecordingConfig):
            raise UsageError(
                f"{path}: kind auto reads recordings, and the reader of this file returns"
                f" channels; set `kind: {get_kind(reader)}`"
            )
        return reader.model_validate({}).load_checked(path, field_filter)


def detect_recording_format(path: Path) -> RecordingFormat | None:
    """Detect the format of a recording from its first bytes and its extension.

    Returns:
        The format; None for tables (csv, Parquet) and unknown files, which need a channel map.

    Raises:
        UsageError: if `path` does not exist.
    """
    head = b""
    if not path.is_dir():
        require_file(path)
        with path.open("rb") as stream:
            head = stream.read(1024)
    for config in _RECORDING_CONFIGS:
        for name, matches in config.formats.items():
            if matches(path, head):
                return RecordingFormat(name, config)
    return _detect_external_format(path, head)


def _detect_external_format(path: Path, head: bytes) -> RecordingFormat | None:
    """Return the format of a registered reader that accepts a log; None without one.

    Args:
        path: file or folder.
        head: first bytes of the file; empty for a folder.
    """
    for reader in list_external_readers():
        has_ending = path.suffix.lower() in _external_endings(reader) and not path.is_dir()
        if has_ending or any(matches(path, head) for matches in reader.formats.values()):
            return RecordingFormat(str(get_kind(reader)), reader)
    return None


def detect_external_kind(path: Path) -> str:
    """Return the kind of the registered reader that reads a log; empty for one of residnet."""
    recording_format = detect_recording_format(path)
    if recording_format is None or recording_format.config in _RECORDING_CONFIGS:
        return ""
    return recording_format.name


def is_channel_reader(kind: str) -> bool:
    """Return whether a registered reader returns channels itself, so that it needs no map."""
    return any(
        get_kind(reader) == kind and not issubclass(reader, RecordingConfig)
        for reader in list_external_readers()
    )


def detect_log_kind(path: Path) -> str:
    """Return `canonical`, `table`, or the name of the recording format of a log.

    Raises:
        UsageError: if the format is unknown.
    """
    path = locate_file(path)
    if Log.is_canonical_log(path):
        return "canonical"
    recording = detect_recording_format(path)
    ending = path.suffix.lower()
    if recording is None and ending not in TABLE_KINDS and not is_text_table(path):
        raise UsageError(f"{path}: residnet cannot read this format; {suggest_conversion(ending)}")
    return "table" if recording is None else recording.name
