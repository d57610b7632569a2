"""The formats `fmu` and `fmu2`: co-simulation units of FMI 3.0 and 2.0 around the exported C.

The archive holds the sources, and the unit compiled for this machine and for others whose compilers
are at hand.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import sys
import tempfile
import zipfile
from abc import abstractmethod
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import torch

from residnet.core.errors import ExportError, UsageError
from residnet.core.files import whole
from residnet.export.base import Exported, Exporter, filled
from residnet.export.c import CompiledModel, CSource, c_source, compile_shared, identifier
from residnet.export.vessel import ExportedVessel

_REFERENCES = (
    ("inputs", "", 1, "input"),
    ("states", "", 101, "output"),
    ("states", "_start", 201, "parameter"),
)
"""Entries of the card, what follows their names, first value reference, and causality;
`instance.h` counts in the same way.
"""
NAME = "model"


def description(card: Mapping[str, Any], token: str, version: str) -> str:
    """Return modelDescription.xml for `version` 3.0 or 2.0."""
    variables = [
        (f"{entry['name']}{ending}", first + i, causality, entry["unit"])
        for part, ending, first, causality in _REFERENCES
        for i, entry in enumerate(card[part])
    ]
    return filled(f"fmi{version[0]}.xml", card=card, token=token, variables=variables)


class FmuExporter(Exporter):
    """A co-simulation unit in double precision, with its sources."""

    version: ClassVar[Literal["2.0", "3.0"]]
    suffix: ClassVar[str] = ".fmu"

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write the unit; its card stands under `resources`."""
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.what}: an FMU holds a vessel model; export it as c")
        exported.require_numbers()
        card = exported.card() | {
            "format": self.name,
            "dtype": "float64",
            "safety": "The unit holds compiled code that runs when loaded: load only what you"
            " trust.",
        }
        prefix = identifier(file.stem)
        written = c_source(exported, card, "model_code.h", prefix)
        token = "{" + hashlib.sha256(written.source.encode()).hexdigest()[:32] + "}"
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            sources = self._sources(written, token, exported.spec.dt)
            for part, text in sources.items():
                (folder / part).write_text(text)
            library = compile_shared(
                _compiled(folder, sources), folder / f"{NAME}{_SUFFIX.get(sys.platform, '.so')}"
            )
            loaded = CompiledModel(library, exported, torch.float64, prefix)
            out = {}
            for tool, platforms, suffix in _CROSS:
                where = platforms[self.version]
                if where not in ("", self.platform()) and shutil.which(tool) is not None:
                    made = folder / f"{where}{suffix}"
                    out[where] = compile_shared(_compiled(folder, sources), made, tool=tool)
            binaries = {self.platform(): library} | out
            card |= {
                "parity": exported.check(loaded, "the FMU's code", torch.float64),
                "binaries": list(binaries),
            }
            with (
                whole(file) as partial,
                zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive,
            ):
                archive.writestr("modelDescription.xml", description(card, token, self.version))
                archive.writestr("resources/card.json", json.dumps(card, indent=1))
                for part, text in sources.items():
                    archive.writestr(f"sources/{part}", text)
                if self.version == "3.0":
                    build = _packaged("fmi3_build.xml")
                    archive.writestr("sources/buildDescription.xml", build)
                for where, binary in binaries.items():
                    archive.write(binary, f"binaries/{where}/{NAME}{binary.suffix}")
        return card

    def _sources(self, written: CSource, token: str, dt: float) -> dict[str, str]:
        """Return the source files by name."""
        p, upper = written.prefix, written.prefix.upper()
        part = f"fmi{self.version[0]}.c"
        return {
            part: _packaged(part),
            "instance.h": _packaged("instance.h"),
            "model.h": filled("fmi_model.h", p=p, upper=upper, dt=f"{dt:g}", token=token),
            "model_code.c": f"#define {upper}_DOUBLE\n{written.source}",
            "model_code.h": written.header,
        }

    @abstractmethod
    def platform(self) -> str:
        """Return this machine as the standard names it."""


_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}
"""Of libraries, by the system; `.so` elsewhere."""
_CROSS = (
    ("x86_64-w64-mingw32-gcc", {"3.0": "x86_64-windows", "2.0": "win64"}, ".dll"),
    # version 2.0 has no name for it
    ("aarch64-linux-gnu-gcc", {"3.0": "aarch64-linux", "2.0": ""}, ".so"),
)
"""Compilers for other machines as Linux distributions name them, the platform, and its suffix."""


def _compiled(folder: Path, sources: Mapping[str, str]) -> list[Path]:
    return [folder / part for part in sources if part.endswith(".c")]


def _packaged(name: str) -> str:
    return resources.files("residnet.export").joinpath(name).read_text()


def _machine() -> str:
    names = {"x86_64": "x86_64", "amd64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}
    machine = platform.machine().lower()
    if machine not in names:
        raise ExportError(
            f"format fmu: this machine ({machine}) has no name in the standard; export as c"
        )
    return names[machine]


@final
class Fmu3Exporter(FmuExporter):
    """A co-simulation unit of FMI 3.0."""

    name: ClassVar[str] = "fmu"
    about: ClassVar[str] = "A co-simulation unit of FMI 3.0, with its C sources."
    version: ClassVar[Literal["2.0", "3.0"]] = "3.0"

    def platform(self) -> str:
        system = {"win32": "windows", "darwin": "darwin"}.get(sys.platform, "linux")
        return f"{_machine()}-{system}"


@final
class Fmu2Exporter(FmuExporter):
    """A co-simulation unit of FMI 2.0."""

    name: ClassVar[str] = "fmu2"
    about: ClassVar[str] = "A co-simulation unit of FMI 2.0, with its C sources."
    version: ClassVar[Literal["2.0", "3.0"]] = "2.0"

    def platform(self) -> str:
        return {"win32": "win64", "darwin": "darwin64"}.get(sys.platform, "linux64")
