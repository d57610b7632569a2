"""Recognition of a file's reader, by content first and ending second, without a config."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.io.readers.base import require_file
from residnet.io.readers.compose import RecordingConfig
from residnet.io.readers.formats.ardupilot import ArduPilotConfig
from residnet.io.readers.formats.moos import MoosConfig
from residnet.io.readers.formats.nmea import NmeaConfig
from residnet.io.readers.formats.rosbag import RosbagConfig
from residnet.io.readers.formats.topic_folder import TopicFolderConfig
from residnet.io.readers.formats.trees import Hdf5Config, MatConfig
from residnet.io.readers.formats.ulog import UlogConfig
from residnet.io.readers.recording import FieldFilter, Recording
from residnet.io.readers.tables import TABLE_KINDS
from residnet.io.readers.texts import read_table_head

# in the order in which they are asked: content that cannot be mistaken first, endings last
_RECORDING_CONFIGS: tuple[type[RecordingConfig], ...] = (
    RosbagConfig,
    TopicFolderConfig,
    UlogConfig,
    ArduPilotConfig,
    MoosConfig,
    NmeaConfig,
    MatConfig,
    Hdf5Config,
)
LOG_ENDINGS = (
    *(ending for ending in TABLE_KINDS if ending != ".json"),
    *(ending for config in _RECORDING_CONFIGS for ending in config.endings),
)
"""Endings of files that may be logs; a .json beside them rather tells of them."""
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
"""Ending -> how Python gets the table in such a file."""


@dataclass(frozen=True)
class RecordingFormat:
    """A format of recordings, and its config for standard messages."""

    name: str
    config: type[RecordingConfig]


def suggest_conversion(ending: str) -> str:
    """Return how a file with such an ending, which no reader knows, becomes a log."""
    pandas_call = _PANDAS_READERS.get(ending, "pandas.DataFrame(rows, columns=[...])")
    return (
        "write such rows as csv with a line of names, in Python"
        f" {pandas_call}.to_csv('log.csv', index=False)"
    )


def is_text_table(path: Path) -> bool:
    """Return whether a file of any ending holds lines of names and numbers, or is JSON."""
    if path.suffix.lower() == ".json":
        return True
    try:
        table, _ = read_table_head(path, 20)
    except DataError:
        return False
    return len(table.select_dtypes("number").columns) > 1


@final
class AutoConfig(RecordingConfig):
    """Any recording that describes itself, recognised by its content and ending.

    The kinds of single formats have settings of their own.
    """

    kind: Literal["auto"] = "auto"

    def load(self, path: Path, field_filter: FieldFilter) -> Recording:
        recording_format = detect_recording_format(path)
        if recording_format is None:
            names = ", ".join(name for config in _RECORDING_CONFIGS for name in config.formats)
            raise UsageError(
                f"{path}: does not say what its columns are; give a channel map with --config"
                f" (formats that need none: {names}, canonical Parquet)"
            )
        return recording_format.config().load(path, field_filter)


def detect_recording_format(path: Path) -> RecordingFormat | None:
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
    for config in _RECORDING_CONFIGS:
        for name, matches in config.formats.items():
            if matches(path, head):
                return RecordingFormat(name, config)
    return None


def detect_log_kind(path: Path) -> str:
    """Return the kind of a log: canonical, table, or the name of a format of recordings."""
    if Log.is_canonical_log(path):
        return "canonical"
    recording = detect_recording_format(path)
    ending = path.suffix.lower()
    if recording is None and ending not in TABLE_KINDS and not is_text_table(path):
        raise UsageError(
            f"{path}: is of no format that residnet knows; {suggest_conversion(ending)}"
        )
    return "table" if recording is None else recording.name
