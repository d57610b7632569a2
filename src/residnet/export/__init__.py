"""Export for controllers: one file per format, found by name in `exporters`."""

from __future__ import annotations

from residnet.core.registry import ThirdParty, objects, usable
from residnet.export.aoti import AotiExporter
from residnet.export.base import Exported, Exporter
from residnet.export.c import CExporter
from residnet.export.casadi_function import CasadiExporter
from residnet.export.feed_forward import FeedForwardExporter
from residnet.export.fmu import Fmu2Exporter, Fmu3Exporter
from residnet.export.onnx_file import OnnxExporter
from residnet.export.parameters import ParametersExporter
from residnet.export.torchscript import TorchScriptExporter
from residnet.export.vessel import ExportedVessel

__all__ = ["Exported", "ExportedVessel", "Exporter", "exporter", "exporters"]

_BUILTIN: tuple[Exporter, ...] = (
    TorchScriptExporter(),
    CExporter(),
    OnnxExporter(),
    CasadiExporter(),
    Fmu3Exporter(),
    Fmu2Exporter(),
    AotiExporter(),
    ParametersExporter(),
    FeedForwardExporter(),
)


def exporters() -> dict[str, Exporter | ThirdParty]:
    """Return all formats by name, those of other packages included; a broken one is kept."""
    builtin = {format.name: format for format in _BUILTIN}
    return objects("residnet.exporters", builtin, Exporter)


def exporter(name: str) -> Exporter:
    """Return the format of that name.

    Raises:
        ConfigError: where there is none, or the package that offers it is broken.
    """
    found: Exporter = usable(exporters(), name, "export format")
    return found
