"""An exported S-function, built and stepped by a harness of Simulink's interface."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np

from residnet.export import exporter
from residnet.export.base import Exported
from residnet.export.c import compile_shared

HARNESS = Path(__file__).parent / "simstruct"


class SFunction:
    """An exported S-function under a harness that does what Simulink documents."""

    def __init__(self, exported: Exported, folder: Path) -> None:
        card = exporter("simulink").export(exported, folder / "Boat 2_sfun.c")
        assert card["format"] == "simulink"
        sources = [folder / "boat_2_sfun.c", folder / "boat_2_sfun_model.c"]
        library = compile_shared(sources, folder / "boat.so", [f"-I{HARNESS}"])
        self.library = ctypes.CDLL(str(library))
        self.library.fly.restype = ctypes.c_double

    def fly(self, given: np.ndarray, outputs: int, start: Any = ()) -> tuple[float, np.ndarray]:
        """Return its sample time and its outputs [T, outputs] at inputs [T, n]."""
        begin, rows = (np.ascontiguousarray(part, dtype=float) for part in (start, given))
        out = np.zeros((len(rows), outputs))
        at = [ctypes.c_void_p(part.ctypes.data) for part in (begin, rows, out)]
        return self.library.fly(at[0], begin.size, len(rows), at[1], at[2]), out
