"""The format `c`: writes the files of a vessel model once they have been compiled and checked."""

from __future__ import annotations

import copy
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import torch

from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.c.compiled import CompiledModel, compile_shared
from residnet.export.c.vessel import CSource, vessel_source
from residnet.export.card import make_card
from residnet.export.contract import Apart, checked, require_numbers

_PRECISIONS: tuple[tuple[Literal["single", "double"], torch.dtype], ...] = (
    ("single", torch.float32),
    ("double", torch.float64),
)


@final
class CExporter(Exporter):
    """One C99 source file and its header: no runtime, no allocation, no global state."""

    name: ClassVar[str] = "c"
    suffix: ClassVar[str] = ".c"
    about: ClassVar[str] = "The model as one C99 file and header, without any runtime."

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write source, header and card, checked in single and in double precision.

        Where single precision does not determine the track, the file is in double precision alone.
        """
        require_numbers(spec, model)
        model = copy.deepcopy(model).eval().requires_grad_(False)
        card = make_card(spec, model, rows, {}) | {
            "format": "c",
            "dtype": "float32; float64 with the macro _DOUBLE",
            "safety": "The file is source code: compile only what you trust.",
        }
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            try:
                written, parity = _checked(spec, model, card, folder / file.name, _PRECISIONS)
            except Apart:
                card |= {"dtype": "float64"}
                written, parity = _checked(spec, model, card, folder / file.name, _PRECISIONS[1:])
            card |= {"parity": parity}
            file.parent.mkdir(parents=True, exist_ok=True)
            file.with_suffix(".h").write_text(written.header)
            file.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")
            file.write_text(written.source)
        return card


def _checked(
    spec: ModelSpec,
    model: HybridDynamics,
    card: Mapping[str, Any],
    source: Path,
    precisions: Sequence[tuple[Literal["single", "double"], torch.dtype]],
) -> tuple[CSource, dict[str, Any]]:
    """Write a model's C and return it with what a card says of the parity in each precision.

    Raises:
        Apart: where a precision does not determine the track.
        ExportError: where the file is wrong otherwise.
    """
    header = source.with_suffix(".h")
    written = vessel_source(
        spec, model, card, header.name, double_only=precisions == _PRECISIONS[1:]
    )
    source.write_text(written.source)
    header.write_text(written.header)
    parity: dict[str, Any] = {}
    for precision, dtype in precisions:
        flags = [f"-D{written.prefix.upper()}_DOUBLE"] if precision == "double" else []
        library = compile_shared([source], source.with_name(f"{precision}.so"), flags)
        stepped = CompiledModel(library, written.prefix, model.n_state, precision)
        given = copy.deepcopy(model).to(dtype)
        what = f"the C file in {precision} precision"
        parity[precision] = checked(spec, given, stepped, what, dtype)
    return written, parity
