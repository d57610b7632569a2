"""Detection of file formats by content and file extension, without a config."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.io.readers.base import require_file
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
LOG_ENDINGS = (
    *(ending for ending in TABLE_KINDS if ending != ".json"),
    *(ending for config in _RECORDING_CONFIGS for ending in config.endings),
)
"""Extensions of files that may be logs; .json files usually hold metadata."""
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
        config: reader, which maps standard messages without further settings.
    """

    name: str
    config: type[RecordingConfig]


def suggest_conversion(ending: str) -> str:
    """Return an instruction to convert a file of an unsupported format to csv.

    Args:
        ending: extension of the file, with its dot.
    """
    pandas_call = _PANDAS_READERS.get(ending, "pandas.DataFrame(rows, columns=[...])")
    return (
        "convert it to csv with a line of column names, in Python"
        f" {pandas_call}.to_csv('log.csv', index=False)"
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
                f"{path}: the format does not describe its columns; give a channel map with"
                f" --config (formats that need none: {names}, canonical Parquet)"
            )
        return recording_format.config.model_validate({}).load(path, field_filter)


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
    return None


def detect_log_kind(path: Path) -> str:
    """Return `canonical`, `table`, or the name of the recording format of a log.

    Raises:
        UsageError: if the format is unknown.
    """
    if Log.is_canonical_log(path):
        return "canonical"
    recording = detect_recording_format(path)
    ending = path.suffix.lower()
    if recording is None and ending not in TABLE_KINDS and not is_text_table(path):
        raise UsageError(f"{path}: residnet cannot read this format; {suggest_conversion(ending)}")
    return "table" if recording is None else recording.name
