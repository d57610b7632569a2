"""The formats `fmu` and `fmu2`: co-simulation units of FMI 3.0 and 2.0 around the exported C.

The archive holds the sources and binaries for this machine and for every other platform whose
compiler is installed.
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
from residnet.core.files import atomic_write
from residnet.export.base import Exportable, Exporter, render_template
from residnet.export.c import (
    CompiledModel,
    CSource,
    compile_shared_library,
    generate_c_source,
    to_c_identifier,
)
from residnet.export.vessel import ExportedVessel

_VALUE_REFERENCES = (
    ("inputs", "", 1, "input"),
    ("states", "", 101, "output"),
    ("states", "_start", 201, "parameter"),
)
"""Entries of the card, what follows their names, first value reference, and causality;
`instance.h` counts in the same way.
"""
LIBRARY_NAME = "model"


def render_model_description(card: Mapping[str, Any], token: str, version: str) -> str:
    """Return modelDescription.xml for `version` 3.0 or 2.0."""
    variables = [
        (f"{entry['name']}{name_suffix}", first_reference + i, causality, entry["unit"])
        for card_section, name_suffix, first_reference, causality in _VALUE_REFERENCES
        for i, entry in enumerate(card[card_section])
    ]
    return render_template(f"fmi{version[0]}.xml", card=card, token=token, variables=variables)


class FmuExporter(Exporter):
    """A co-simulation unit in double precision, with its sources."""

    version: ClassVar[Literal["2.0", "3.0"]]
    suffix: ClassVar[str] = ".fmu"

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the FMU with its card under `resources`."""
        if not isinstance(exported, ExportedVessel):
            raise UsageError(f"{exported.label}: an FMU holds a vessel model; export it as c")
        exported.require_finite_numbers()
        card = exported.build_card() | {
            "format": self.name,
            "dtype": "float64",
            "safety": "The unit holds compiled code that runs when loaded: load only what you"
            " trust.",
        }
        prefix = to_c_identifier(file.stem)
        c_files = generate_c_source(exported, card, "model_code.h", prefix)
        token = "{" + hashlib.sha256(c_files.source.encode()).hexdigest()[:32] + "}"
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            sources = self._make_sources(c_files, token, exported.spec.dt)
            for file_name, text in sources.items():
                (folder / file_name).write_text(text)
            library = compile_shared_library(
                _c_sources(folder, sources),
                folder / f"{LIBRARY_NAME}{_LIBRARY_SUFFIX.get(sys.platform, '.so')}",
            )
            loaded = CompiledModel(library, exported, torch.float64, prefix)
            cross_binaries = {}
            for cross_compiler, platforms, suffix in _CROSS_COMPILERS:
                platform_folder = platforms[self.version]
                if (
                    platform_folder not in ("", self.platform_name())
                    and shutil.which(cross_compiler) is not None
                ):
                    library_path = folder / f"{platform_folder}{suffix}"
                    cross_binaries[platform_folder] = compile_shared_library(
                        _c_sources(folder, sources), library_path, compiler_path=cross_compiler
                    )
            binaries = {self.platform_name(): library} | cross_binaries
            card |= {
                "parity": exported.check_parity(loaded, "the FMU's code", torch.float64),
                "binaries": list(binaries),
            }
            with (
                atomic_write(file) as temporary_path,
                zipfile.ZipFile(temporary_path, "w", zipfile.ZIP_DEFLATED) as archive,
            ):
                archive.writestr(
                    "modelDescription.xml", render_model_description(card, token, self.version)
                )
                archive.writestr("resources/card.json", json.dumps(card, indent=1))
                for file_name, text in sources.items():
                    archive.writestr(f"sources/{file_name}", text)
                if self.version == "3.0":
                    build_description = _read_packaged_file("fmi3_build.xml")
                    archive.writestr("sources/buildDescription.xml", build_description)
                for platform_folder, binary in binaries.items():
                    archive.write(
                        binary, f"binaries/{platform_folder}/{LIBRARY_NAME}{binary.suffix}"
                    )
        return card

    def _make_sources(self, c_files: CSource, token: str, dt: float) -> dict[str, str]:
        """Return the source files by name."""
        prefix = c_files.prefix
        upper = c_files.prefix.upper()
        fmi_source = f"fmi{self.version[0]}.c"
        return {
            fmi_source: _read_packaged_file(fmi_source),
            "instance.h": _read_packaged_file("instance.h"),
            "model.h": render_template(
                "fmi_model.h", p=prefix, upper=upper, dt=f"{dt:g}", token=token
            ),
            "model_code.c": f"#define {upper}_DOUBLE\n{c_files.source}",
            "model_code.h": c_files.header,
        }

    @abstractmethod
    def platform_name(self) -> str:
        """Return this machine as the standard names it."""


_LIBRARY_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}
"""Of libraries, by the system; `.so` elsewhere."""
_CROSS_COMPILERS = (
    ("x86_64-w64-mingw32-gcc", {"3.0": "x86_64-windows", "2.0": "win64"}, ".dll"),
    # version 2.0 has no name for it
    ("aarch64-linux-gnu-gcc", {"3.0": "aarch64-linux", "2.0": ""}, ".so"),
)
"""Compilers for other machines as Linux distributions name them, the platform, and its suffix."""


def _c_sources(folder: Path, sources: Mapping[str, str]) -> list[Path]:
    return [folder / file_name for file_name in sources if file_name.endswith(".c")]


def _read_packaged_file(name: str) -> str:
    return resources.files("residnet.export").joinpath(name).read_text()


def _machine_name() -> str:
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

    def platform_name(self) -> str:
        system = {"win32": "windows", "darwin": "darwin"}.get(sys.platform, "linux")
        return f"{_machine_name()}-{system}"


@final
class Fmu2Exporter(FmuExporter):
    """A co-simulation unit of FMI 2.0."""

    name: ClassVar[str] = "fmu2"
    about: ClassVar[str] = "A co-simulation unit of FMI 2.0, with its C sources."
    version: ClassVar[Literal["2.0", "3.0"]] = "2.0"

    def platform_name(self) -> str:
        return {"win32": "win64", "darwin": "darwin64"}.get(sys.platform, "linux64")
