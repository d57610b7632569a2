"""Readers of logs: one file per format, listed once in `ReaderConfig`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.data.readers.base import LogReader
from residnet.data.readers.canonical import CanonicalConfig, CanonicalReader
from residnet.data.readers.channel_map import ChannelMap
from residnet.data.readers.hdf5 import Hdf5Config
from residnet.data.readers.mat import MatConfig
from residnet.data.readers.rosbag import RosbagConfig
from residnet.data.readers.table import CsvConfig, ParquetConfig, TableReader, TimeColumn
from residnet.data.readers.topic_folder import TopicFolderConfig

ReaderConfig = Annotated[
    CsvConfig | ParquetConfig | CanonicalConfig | TopicFolderConfig | RosbagConfig | MatConfig | Hdf5Config,
    Field(discriminator="kind"),
]
"""Config of any reader; its `kind` says which."""

__all__ = [
    "CanonicalConfig",
    "CanonicalReader",
    "ChannelMap",
    "CsvConfig",
    "Hdf5Config",
    "LogReader",
    "MatConfig",
    "ParquetConfig",
    "ReaderConfig",
    "RosbagConfig",
    "TableReader",
    "TimeColumn",
    "TopicFolderConfig",
]
