"""The format `fmu2`: co-simulation units of FMI 2.0 around the exported C.

Simulink, Dymola and OMSimulator import FMI 2.0.

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
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, final

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
"""Model card entry, suffix of the variable names, first value reference, and causality. The value
references are the same in `instance.h`.
"""
LIBRARY_NAME = "model"


def render_model_description(card: Mapping[str, Any], token: str) -> str:
    """Return modelDescription.xml."""
    variables = [
        (f"{entry['name']}{name_suffix}", first_reference + i, causality, entry["unit"])
        for card_section, name_suffix, first_reference, causality in _VALUE_REFERENCES
        for i, entry in enumerate(card[card_section])
    ]
    return render_template("fmi2.xml", card=card, token=token, variables=variables)


@final
class FmuExporter(Exporter):
    """A co-simulation unit of FMI 2.0 in double precision, with its sources."""

    name: ClassVar[str] = "fmu2"
    about: ClassVar[str] = "A co-simulation unit of FMI 2.0, with its C sources."
    suffix: ClassVar[str] = ".fmu"

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write the FMU with its model card under `resources`."""
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
            this_platform = _platform_name()
            for cross_compiler, platform_folder, suffix in _CROSS_COMPILERS:
                if platform_folder != this_platform and shutil.which(cross_compiler) is not None:
                    library_path = folder / f"{platform_folder}{suffix}"
                    cross_binaries[platform_folder] = compile_shared_library(
                        _c_sources(folder, sources), library_path, compiler_path=cross_compiler
                    )
            binaries = {this_platform: library} | cross_binaries
            card |= {
                "parity": exported.check_parity(loaded, "the FMU's code", torch.float64),
                "binaries": list(binaries),
            }
            with (
                atomic_write(file) as temporary_path,
                zipfile.ZipFile(temporary_path, "w", zipfile.ZIP_DEFLATED) as archive,
            ):
                archive.writestr("modelDescription.xml", render_model_description(card, token))
                archive.writestr("resources/card.json", json.dumps(card, indent=1))
                for file_name, text in sources.items():
                    archive.writestr(f"sources/{file_name}", text)
                for platform_folder, binary in binaries.items():
                    archive.write(
                        binary, f"binaries/{platform_folder}/{LIBRARY_NAME}{binary.suffix}"
                    )
        return card

    def _make_sources(self, c_files: CSource, token: str, dt: float) -> dict[str, str]:
        """Return the C sources of the FMU, file name -> content."""
        prefix = c_files.prefix
        upper = c_files.prefix.upper()
        return {
            "fmi2.c": _read_packaged_file("fmi2.c"),
            "instance.h": _read_packaged_file("instance.h"),
            "model.h": render_template(
                "fmi_model.h", p=prefix, upper=upper, dt=f"{dt:g}", token=token
            ),
            "model_code.c": f"#define {upper}_DOUBLE\n{c_files.source}",
            "model_code.h": c_files.header,
        }


_LIBRARY_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}
"""Suffix of a shared library by operating system; `.so` for the others."""
_CROSS_COMPILERS = (("x86_64-w64-mingw32-gcc", "win64", ".dll"),)
"""Cross-compilers of Linux distributions: command, platform in FMI 2.0, suffix of a library.

FMI 2.0 has no name for 64-bit ARM.
"""


def _c_sources(folder: Path, sources: Mapping[str, str]) -> list[Path]:
    return [folder / file_name for file_name in sources if file_name.endswith(".c")]


def _read_packaged_file(name: str) -> str:
    return resources.files("residnet.export").joinpath(name).read_text()


def _platform_name() -> str:
    """Return the name of the platform of this machine in FMI 2.0.

    Raises:
        ExportError: if FMI 2.0 has no name for it.
    """
    machine = platform.machine().lower()
    if machine not in ("x86_64", "amd64"):
        raise ExportError(
            f"format fmu2: this machine ({machine}) has no name in FMI 2.0; export as c"
        )
    return {"win32": "win64", "darwin": "darwin64"}.get(sys.platform, "linux64")
