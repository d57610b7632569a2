"""The format `casadi`: a step as a CasADi function with exact derivatives, for MPC."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, final

import casadi as ca
import torch

from residnet.dynamics.lowering import in_numbers, lowered
from residnet.export.base import Exported, Exporter, Loaded, Numbers, write_card


class CasadiModel(Loaded):
    """A written function, loaded back."""

    def __init__(self, file: Path) -> None:
        self.function: Any = ca.Function.load(str(file))

    def step(self, *given: Numbers) -> tuple[Any, ...]:
        return tuple(part.full().reshape(-1) for part in self.function(*given))


@final
class CasadiExporter(Exporter):
    """A CasADi function of state, inputs and memory, in double precision."""

    name: ClassVar[str] = "casadi"
    suffix: ClassVar[str] = ".casadi"
    about: ClassVar[str] = "The model's step as a CasADi function with exact derivatives, for MPC."

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        exported.require_numbers()
        step = lowered(
            exported.graph(torch.float64), exported.arguments, exported.results, exported.what
        )
        with tempfile.TemporaryDirectory() as name:
            partial = Path(name) / file.name
            in_numbers(step).save(str(partial))
            parity = exported.check(CasadiModel(partial), "the CasADi function", torch.float64)
            card = exported.card() | {
                "format": "casadi",
                "dtype": "float64",
                "parity": parity,
                "safety": "The file holds expressions only.",
            }
            file.parent.mkdir(parents=True, exist_ok=True)
            write_card(file, card)
            file.write_bytes(partial.read_bytes())
        return card
