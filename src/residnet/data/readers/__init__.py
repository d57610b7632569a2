"""Readers of logs: one file per format, listed once in `ReaderConfig`."""

from __future__ import annotations

from typing import Annotated

from residnet.core.registry import Kinds
from residnet.data.readers.base import LogReader, ReaderKind
from residnet.data.readers.canonical import CanonicalConfig, CanonicalReader
from residnet.data.readers.detect import AutoConfig
from residnet.data.readers.formats.ardupilot import ArduPilotConfig
from residnet.data.readers.formats.nmea import NmeaConfig
from residnet.data.readers.formats.rosbag import RosbagConfig
from residnet.data.readers.formats.topic_folder import TopicFolderConfig
from residnet.data.readers.formats.trees import Hdf5Config, MatConfig
from residnet.data.readers.formats.ulog import UlogConfig
from residnet.data.readers.quantities import ChannelMap
from residnet.data.readers.tables import (
    CsvConfig,
    ExcelConfig,
    JsonLinesConfig,
    ParquetConfig,
    TableReader,
    TimeColumn,
)

ReaderConfig = Annotated[
    CsvConfig
    | ParquetConfig
    | ExcelConfig
    | JsonLinesConfig
    | CanonicalConfig
    | TopicFolderConfig
    | RosbagConfig
    | MatConfig
    | Hdf5Config
    | NmeaConfig
    | UlogConfig
    | ArduPilotConfig
    | AutoConfig,
    Kinds("residnet.readers", ReaderKind),
]
"""Config of any reader, those of other packages included; its `kind` says which."""

__all__ = [
    "ArduPilotConfig",
    "AutoConfig",
    "CanonicalConfig",
    "CanonicalReader",
    "ChannelMap",
    "CsvConfig",
    "ExcelConfig",
    "Hdf5Config",
    "JsonLinesConfig",
    "LogReader",
    "MatConfig",
    "NmeaConfig",
    "ParquetConfig",
    "ReaderConfig",
    "ReaderKind",
    "RosbagConfig",
    "TableReader",
    "TimeColumn",
    "TopicFolderConfig",
    "UlogConfig",
]
