"""Readers of log files and the registry of their formats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from residnet.core.registry import PluginUnion

if TYPE_CHECKING:
    from residnet.io.readers.base import CanonicalConfig, ReaderKind

    ReaderConfig: TypeAlias = ReaderKind | CanonicalConfig
else:
    ReaderConfig = Annotated[
        Any,
        PluginUnion(
            "residnet.readers",
            "residnet.io.readers.base:ReaderKind",
            {
                "csv": "residnet.io.readers.tables:CsvConfig",
                "parquet": "residnet.io.readers.tables:ParquetConfig",
                "excel": "residnet.io.readers.tables:ExcelConfig",
                "json_lines": "residnet.io.readers.tables:JsonLinesConfig",
                "joined": "residnet.io.readers.joined_files:JoinedConfig",
                "canonical": "residnet.io.readers.base:CanonicalConfig",
                "csv_topics": "residnet.io.readers.formats.topic_folder:TopicFolderConfig",
                "rosbag": "residnet.io.readers.formats.rosbag:RosbagConfig",
                "mat": "residnet.io.readers.formats.matlab_hdf5:MatConfig",
                "hdf5": "residnet.io.readers.formats.matlab_hdf5:Hdf5Config",
                "nmea": "residnet.io.readers.formats.nmea:NmeaConfig",
                "nmea2000": "residnet.io.readers.formats.nmea2000:Nmea2000Config",
                "mavlink": "residnet.io.readers.formats.mavlink:MavlinkConfig",
                "moos": "residnet.io.readers.formats.moos:MoosConfig",
                "ulog": "residnet.io.readers.formats.ulog:UlogConfig",
                "ardupilot": "residnet.io.readers.formats.ardupilot:ArduPilotConfig",
                "auto": "residnet.io.readers.detect:AutoConfig",
            },
        ),
    ]
"""Config of any reader, including readers of other packages; `kind` selects the reader."""
