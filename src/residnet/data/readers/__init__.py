"""Readers of logs: one row per format."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.data.readers.base import CanonicalConfig, ReaderKind

    ReaderConfig: TypeAlias = ReaderKind | CanonicalConfig
else:
    ReaderConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.readers",
            "residnet.data.readers.base:ReaderKind",
            {
                "csv": "residnet.data.readers.tables:CsvConfig",
                "parquet": "residnet.data.readers.tables:ParquetConfig",
                "excel": "residnet.data.readers.tables:ExcelConfig",
                "json_lines": "residnet.data.readers.tables:JsonLinesConfig",
                "joined": "residnet.data.readers.joined:JoinedConfig",
                "canonical": "residnet.data.readers.base:CanonicalConfig",
                "csv_topics": "residnet.data.readers.formats.topic_folder:TopicFolderConfig",
                "rosbag": "residnet.data.readers.formats.rosbag:RosbagConfig",
                "mat": "residnet.data.readers.formats.trees:MatConfig",
                "hdf5": "residnet.data.readers.formats.trees:Hdf5Config",
                "nmea": "residnet.data.readers.formats.nmea:NmeaConfig",
                "moos": "residnet.data.readers.formats.moos:MoosConfig",
                "ulog": "residnet.data.readers.formats.ulog:UlogConfig",
                "ardupilot": "residnet.data.readers.formats.ardupilot:ArduPilotConfig",
                "auto": "residnet.data.readers.detect:AutoConfig",
            },
        ),
    ]
"""Config of any reader, those of other packages included; its `kind` says which."""
