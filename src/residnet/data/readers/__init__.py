"""Readers of logs: one file per format, listed once in `ReaderConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.data.readers.ardupilot import ArduPilotConfig
from residnet.data.readers.base import LogReader
from residnet.data.readers.canonical import CanonicalConfig, CanonicalReader
from residnet.data.readers.channel_map import ChannelMap
from residnet.data.readers.detect import AutoConfig
from residnet.data.readers.hdf5 import Hdf5Config
from residnet.data.readers.mat import MatConfig
from residnet.data.readers.nmea import NmeaConfig
from residnet.data.readers.rosbag import RosbagConfig
from residnet.data.readers.table import CsvConfig, ParquetConfig, TableReader, TimeColumn
from residnet.data.readers.topic_folder import TopicFolderConfig
from residnet.data.readers.ulog import UlogConfig

ReaderConfig = Annotated[
    CsvConfig
    | ParquetConfig
    | CanonicalConfig
    | TopicFolderConfig
    | RosbagConfig
    | MatConfig
    | Hdf5Config
    | NmeaConfig
    | UlogConfig
    | ArduPilotConfig
    | AutoConfig,
    Field(discriminator="kind"),
]
"""Config of any reader; its `kind` says which."""

__all__ = [
    "ArduPilotConfig",
    "AutoConfig",
    "CanonicalConfig",
    "CanonicalReader",
    "ChannelMap",
    "CsvConfig",
    "Hdf5Config",
    "LogReader",
    "MatConfig",
    "NmeaConfig",
    "ParquetConfig",
    "ReaderConfig",
    "RosbagConfig",
    "TableReader",
    "TimeColumn",
    "TopicFolderConfig",
    "UlogConfig",
]
