"""Export for controllers: one file per format, found by name in `FORMATS`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.core.registry import Kinds, ThirdParty

if TYPE_CHECKING:
    from residnet.export.base import Exporter

FORMATS = Kinds(
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
"""All formats, those of other packages included."""


def exporter(name: str) -> Exporter:
    """Return the format of that name.

    Raises:
        ConfigError: where there is none, or the package that offers it is broken.
    """
    if name not in (known := FORMATS.names()):
        raise ConfigError(f"no export format '{name}'{nearest(name, known)}")
    found = FORMATS.find(name)
    if isinstance(found, ThirdParty):
        raise ConfigError(f"export format {found.complaint}")
    format: Exporter = found()
    return format
