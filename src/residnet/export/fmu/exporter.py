"""Writes a co-simulation unit: the model's C in an archive, compiled for this machine too."""

from __future__ import annotations

import copy
import hashlib
import json
import platform
import sys
import tempfile
import zipfile
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import torch

from residnet.core.errors import ExportError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.c.compiled import CompiledModel, compile_shared
from residnet.export.c.vessel import CSource, vessel_source
from residnet.export.card import make_card
from residnet.export.contract import checked, require_numbers
from residnet.export.fmu.description import NAME, description

_BUILD = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="model">
    <SourceFileSet language="C99">
      <SourceFile name="fmi3.c"/>
      <SourceFile name="model_code.c"/>
    </SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""


class FmuExporter(Exporter):
    """A co-simulation unit in double precision, with its sources."""

    version: ClassVar[Literal["2.0", "3.0"]]
    suffix: ClassVar[str] = ".fmu"

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the unit; its card stands under `resources`."""
        require_numbers(spec, model)
        model = copy.deepcopy(model).double().eval().requires_grad_(False)
        card = make_card(spec, model, rows, {}) | {
            "format": self.name,
            "dtype": "float64",
            "safety": "The unit holds compiled code that runs when loaded: load only what you"
            " trust.",
        }
        written = vessel_source(spec, model, card, "model_code.h")
        token = "{" + hashlib.sha256(written.source.encode()).hexdigest()[:32] + "}"
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            sources = self._sources(written, token, spec.dt)
            for part, text in sources.items():
                (folder / part).write_text(text)
            library = compile_shared(
                [folder / part for part in sources if part.endswith(".c")],
                folder / f"{NAME}{_library_suffix()}",
            )
            stepped = CompiledModel(library, written.prefix, model.n_state, "double")
            card |= {"parity": checked(spec, model, stepped, "the FMU's code", torch.float64)}
            file.parent.mkdir(parents=True, exist_ok=True)
            partial = file.with_name(file.name + ".partial")
            with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("modelDescription.xml", description(card, token, self.version))
                archive.writestr("resources/card.json", json.dumps(card, indent=1))
                for part, text in sources.items():
                    archive.writestr(f"sources/{part}", text)
                if self.version == "3.0":
                    archive.writestr("sources/buildDescription.xml", _BUILD)
                archive.write(library, f"binaries/{self.platform()}/{library.name}")
            partial.replace(file)
        return card

    def _sources(self, written: CSource, token: str, dt: float) -> dict[str, str]:
        """Return the source files by name."""
        p, upper = written.prefix, written.prefix.upper()
        model = (
            f'#define {upper}_DOUBLE\n#include "model_code.h"\n\n'
            f"#define MODEL_REAL {p}_real\n#define MODEL_STATES {upper}_STATES\n"
            f"#define MODEL_INPUTS {upper}_INPUTS\n#define MODEL_MEMORY {upper}_MEMORY\n"
            f"#define MODEL_DT {upper}_DT\n"
            f'#define MODEL_DT_TEXT "{dt:g}"\n#define MODEL_STEP {p}_step\n'
            f"#define MODEL_INITIAL_STATE {p}_initial_state\n"
            f'#define MODEL_TOKEN "{token}"\n'
        )
        part = f"fmi{self.version[0]}.c"
        return {
            part: _packaged(part),
            "instance.h": _packaged("instance.h"),
            "model.h": model,
            "model_code.c": f"#define {upper}_DOUBLE\n{written.source}",
            "model_code.h": written.header,
        }

    @abstractmethod
    def platform(self) -> str:
        """Return this machine as the standard names it."""


def _packaged(name: str) -> str:
    return resources.files("residnet.export.fmu").joinpath(name).read_text()


def _library_suffix() -> str:
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


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
        """Return machine and system."""
        system = {"win32": "windows", "darwin": "darwin"}.get(sys.platform, "linux")
        return f"{_machine()}-{system}"


@final
class Fmu2Exporter(FmuExporter):
    """A co-simulation unit of FMI 2.0."""

    name: ClassVar[str] = "fmu2"
    about: ClassVar[str] = "A co-simulation unit of FMI 2.0, with its C sources."
    version: ClassVar[Literal["2.0", "3.0"]] = "2.0"

    def platform(self) -> str:
        """Return system and bits."""
        return {"win32": "win64", "darwin": "darwin64"}.get(sys.platform, "linux64")
