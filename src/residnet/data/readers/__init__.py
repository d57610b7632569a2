"""Readers of logs: one file per format, listed once in `ReaderConfig`."""

from __future__ import annotations

from typing import Annotated

from residnet.core.registry import Kinds
from residnet.data.readers.base import LogReader, ReaderKind
from residnet.data.readers.detect import AutoConfig
from residnet.data.readers.recorders.ardupilot import ArduPilotConfig
from residnet.data.readers.recorders.hdf5 import Hdf5Config
from residnet.data.readers.recorders.mat import MatConfig
from residnet.data.readers.recorders.nmea import NmeaConfig
from residnet.data.readers.recorders.rosbag import RosbagConfig
from residnet.data.readers.recorders.topic_folder import TopicFolderConfig
from residnet.data.readers.recorders.ulog import UlogConfig
from residnet.data.readers.tables.canonical import CanonicalConfig, CanonicalReader
from residnet.data.readers.tables.channel_map import ChannelMap
from residnet.data.readers.tables.table import (
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
