"""The format `aoti`: the model's step compiled ahead of time by torch, for this machine."""

from __future__ import annotations

import copy
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.card import make_card
from residnet.export.contract import Apart, Numbers, accepted, checked, require_numbers, warmed
from residnet.export.stepping import Step


class AotiModel:
    """A compiled package, loaded back, for one vessel."""

    def __init__(
        self, file: Path, spec: ModelSpec, model: HybridDynamics, dtype: torch.dtype = torch.float32
    ) -> None:
        self.package: Any = torch._inductor.aoti_load_package(str(file))
        self.memory, self.dtype = model.n_state, dtype
        self.measured = accepted(spec, model)

    def step(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, bool]:
        """Return state, memory and flag one step later."""
        # the package takes numbers as they lie in memory, whatever a tensor's strides say
        given = [
            torch.from_numpy(np.ascontiguousarray(part)).to(self.dtype)[None] for part in (x, w, s)
        ]
        after, memory, outside = self.package(*given)
        return after[0].numpy(), memory[0].numpy(), bool(outside[0])

    def warmup(self, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory that a measured past leaves."""
        empty = torch.zeros(self.memory, dtype=self.dtype).numpy()
        return warmed(self.measured, self.step, y, w, empty)


@final
class AotiExporter(Exporter):
    """An AOTInductor package, which C++ and Python load with libtorch."""

    name: ClassVar[str] = "aoti"
    suffix: ClassVar[str] = ".pt2"
    about: ClassVar[str] = "The model's step compiled for this machine (AOTInductor), one row."

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Compile the model; the card stands beside the package.

        It works in float64 where float32 does not determine the track.
        """
        require_numbers(spec, model)
        model = copy.deepcopy(model).eval().requires_grad_(False)
        card = make_card(spec, model, rows, {}) | {
            "format": "aoti",
            "layout": "Give contiguous tensors: the package does not look at strides.",
            "safety": "The package holds machine code that runs when loaded: load only what"
            " you trust. It is for the kind of machine that it was made on.",
        }
        with tempfile.TemporaryDirectory() as name:
            partial = Path(name) / "model.pt2"
            try:
                parity = _checked(spec, copy.deepcopy(model).float(), partial, torch.float32)
            except Apart:
                parity = _checked(spec, model.double(), partial, torch.float64)
                card |= {"dtype": "float64"}
            card |= {"parity": parity}
            file.parent.mkdir(parents=True, exist_ok=True)
            file.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")
            file.write_bytes(partial.read_bytes())
        return card


def _checked(
    spec: ModelSpec, model: HybridDynamics, file: Path, dtype: torch.dtype
) -> dict[str, Any]:
    """Write the package in a precision and return what a card says of its parity.

    Raises:
        Apart: where the precision does not determine the track.
        ExportError: where the package is wrong otherwise, or cannot be compiled.
    """
    _compile(spec, model, file, dtype)
    stepped = AotiModel(file, spec, model, dtype)
    return checked(spec, model, stepped, "the compiled package", dtype)


def _compile(spec: ModelSpec, model: HybridDynamics, file: Path, dtype: torch.dtype) -> None:
    """Write the package.

    Raises:
        ExportError: where torch cannot compile the step, or there is no C++ compiler.
    """
    sizes = (len(STATE), len(spec.signals.columns), model.n_state)
    examples = tuple(torch.zeros(1, size, dtype=dtype) for size in sizes)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.export.export(Step(model, spec).to(dtype).eval(), examples)
            torch._inductor.aoti_compile_and_package(program, package_path=str(file))
    except (RuntimeError, OSError) as error:
        # what torch raises here has no class of its own
        first = str(error).strip().splitlines() or [type(error).__name__]
        raise ExportError(
            f"model {spec.name}: cannot be compiled ahead of time ({first[0]}); export it as c or"
            " torchscript"
        ) from None
