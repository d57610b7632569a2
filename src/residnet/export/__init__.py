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
        "fmu2": "residnet.export.fmu:FmuExporter",
        "aoti": "residnet.export.torchscript:AotiExporter",
        "parameters": "residnet.export.parameters:ParametersExporter",
        "feed_forward": "residnet.export.feed_forward:FeedForwardExporter",
    },
    key="name",
)
"""All registered formats, including formats of other packages."""
_REPLACEMENTS = {
    "fmu": "FMI 3.0 is no longer written; give fmu2 (FMI 2.0)",
    "simulink": "S-functions are no longer written; Simulink imports fmu2 (FMI 2.0), and calls c by"
    " its C Caller block",
}
"""Formats of earlier versions, and what to use instead."""


def get_exporter(name: str) -> Exporter:
    """Return the export format with the given name.

    Raises:
        ConfigError: if no format has this name or its package cannot be imported.
    """
    if name not in (format_names := EXPORT_FORMATS.kind_names()):
        hint = suggest_name(name, format_names)
        if name in _REPLACEMENTS:
            hint = f"; {_REPLACEMENTS[name]}"
        raise ConfigError(f"no export format '{name}'{hint}")
    exporter_class = EXPORT_FORMATS.find_kind(name)
    if isinstance(exporter_class, EntryPointPart):
        raise ConfigError(f"export format {exporter_class.error_message}")
    new_exporter: Exporter = exporter_class()
    return new_exporter
