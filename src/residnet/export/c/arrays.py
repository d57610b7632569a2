"""Numbers, constant arrays and indices in C."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.export.lowering.program import Kind

TYPES: dict[Kind, str] = {"real": "REAL", "flag": "int", "whole": "int"}
"""The type of each kind of cell."""


class Tables:
    """The constant arrays of a file, each written once."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.lines: list[str] = []
        self._names: dict[tuple[str, bytes], str] = {}

    def name(self, values: np.ndarray, kind: Kind) -> str:
        """Return the name of a constant array with these values."""
        key = (kind, values.tobytes())
        if key not in self._names:
            name = f"{self.prefix}table_{len(self._names)}"
            self._names[key] = name
            texts = [literal(float(value), kind) for value in values]
            rows = [", ".join(texts[i : i + 8]) for i in range(0, len(texts), 8)]
            body = ",\n    ".join(rows)
            self.lines.append(
                f"static const {TYPES[kind]} {name}[{len(texts)}] = {{\n    {body}\n}};\n"
            )
        return self._names[key]


def literal(value: float, kind: Kind = "real") -> str:
    """Return a number in C; in single precision the compiler rounds it."""
    if kind != "real":
        return str(int(value))
    if np.isnan(value):
        return "(ZERO / ZERO)"
    if np.isinf(value):
        return "(REAL)INFINITY" if value > 0 else "(-(REAL)INFINITY)"
    text = repr(float(value))
    return f"(REAL){text}" if value >= 0 and not text.startswith("-") else f"((REAL){text})"


def index(offset: int, strides: Sequence[int]) -> str:
    """Return an index in C from the loop counters."""
    parts = [
        f"i{d}" if stride == 1 else f"{stride} * i{d}" for d, stride in enumerate(strides) if stride
    ]
    return " + ".join(([str(offset)] if offset or not parts else []) + parts)


def merge(
    shape: Sequence[int], strides: Sequence[Sequence[int]]
) -> tuple[list[int], list[list[int]]]:
    """Return the same loop nest with as few loops as possible: sizes and strides of each array."""
    sizes: list[int] = []
    out: list[list[int]] = [[] for _ in strides]
    for d, n in enumerate(shape):
        if n == 1:
            continue
        if sizes and all(o[-1] == s[d] * n for o, s in zip(out, strides, strict=True)):
            sizes[-1] *= n
            for o, s in zip(out, strides, strict=True):
                o[-1] = s[d]
            continue
        sizes.append(n)
        for o, s in zip(out, strides, strict=True):
            o.append(s[d])
    return sizes, out
