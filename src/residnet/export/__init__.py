"""Export for controllers: one file per format, found by name in `EXPORT_FORMATS`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.core.registry import EntryPointPart, PluginUnion

if TYPE_CHECKING:
    from residnet.export.base import Exporter

EXPORT_FORMATS = PluginUnion(
    "residnet.exporters",
    "residnet.export.base:Exporter",
    {
        "torchscript": "residnet.export.torchscript:TorchScriptExporter",
        "c": "residnet.export.c:CExporter",
        "onnx": "residnet.export.onnx_file:OnnxExporter",
        "casadi": "residnet.export.c:CasadiExporter",
        "fmu": "residnet.export.fmu:Fmu3Exporter",
        "fmu2": "residnet.export.fmu:Fmu2Exporter",
        "simulink": "residnet.export.c:SimulinkExporter",
        "aoti": "residnet.export.torchscript:AotiExporter",
        "parameters": "residnet.export.parameters:ParametersExporter",
        "feed_forward": "residnet.export.feed_forward:FeedForwardExporter",
    },
    key="name",
)
"""All registered formats, including formats of other packages."""


def get_exporter(name: str) -> Exporter:
    """Return the export format with the given name.

    Raises:
        ConfigError: if no format has this name or its package cannot be imported.
    """
    if name not in (format_names := EXPORT_FORMATS.kind_names()):
        raise ConfigError(f"no export format '{name}'{suggest_name(name, format_names)}")
    exporter_class = EXPORT_FORMATS.find_kind(name)
    if isinstance(exporter_class, EntryPointPart):
        raise ConfigError(f"export format {exporter_class.error_message}")
    new_exporter: Exporter = exporter_class()
    return new_exporter
