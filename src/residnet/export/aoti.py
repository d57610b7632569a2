"""The format `aoti`: a step compiled ahead of time by torch, for this machine."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.export.base import (
    Exported,
    Exporter,
    Loaded,
    Numbers,
    in_precision,
    name_of,
    write_card,
)


class AotiModel(Loaded):
    """A compiled package, loaded back."""

    def __init__(self, file: Path, dtype: torch.dtype = torch.float32) -> None:
        self.package: Any = torch._inductor.aoti_load_package(str(file))
        self.dtype = dtype

    def step(self, *given: Numbers) -> tuple[Any, ...]:
        # the package takes numbers as they lie in memory, whatever a tensor's strides say
        rows = [torch.from_numpy(np.ascontiguousarray(part)).to(self.dtype)[None] for part in given]
        return tuple(part[0].numpy() for part in self.package(*rows))


@final
class AotiExporter(Exporter):
    """An AOTInductor package, which C++ and Python load with libtorch."""

    name: ClassVar[str] = "aoti"
    suffix: ClassVar[str] = ".pt2"
    about: ClassVar[str] = "The model's step compiled for this machine (AOTInductor), one row."

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Compile the step; the card stands beside the package.

        It works in float64 where float32 does not determine the track.
        """
        exported.require_numbers()
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder) / "model.pt2"

            def attempt(dtype: torch.dtype) -> dict[str, Any]:
                _compile(exported, partial, dtype)
                return exported.check(AotiModel(partial, dtype), "the compiled package", dtype)

            dtype, parity = in_precision(exported, attempt)
            card = exported.card() | {
                "format": "aoti",
                "dtype": name_of(dtype),
                "layout": "Give contiguous tensors: the package does not look at strides.",
                "safety": "The package holds machine code that runs when loaded: load only what"
                " you trust. It is for the kind of machine that it was made on.",
                "needs": "In Python: torch and setuptools, which torch imports to load a package."
                " In C++: libtorch.",
                "parity": parity,
            }
            file.parent.mkdir(parents=True, exist_ok=True)
            write_card(file, card)
            file.write_bytes(partial.read_bytes())
        return card


def _compile(exported: Exported, file: Path, dtype: torch.dtype) -> None:
    """Write the package.

    Raises:
        ExportError: where torch cannot compile the step, or there is no C++ compiler.
    """
    examples = tuple(torch.zeros(1, count, dtype=dtype) for _, count in exported.arguments)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.export.export(exported.graph(dtype), examples)
            torch._inductor.aoti_compile_and_package(program, package_path=str(file))
    except (RuntimeError, OSError) as error:
        # what torch raises here has no class of its own
        first = str(error).strip().splitlines() or [type(error).__name__]
        raise ExportError(
            f"{exported.what}: cannot be compiled ahead of time ({first[0]}); export it as c or"
            " torchscript"
        ) from None
