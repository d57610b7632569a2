"""Leaves out of a program what does nothing: products with one, sums with zero, known choices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.export.lowering.program import Map, Program

_LONGEST = 2000
"""Longest operation whose elements are looked at one by one."""


def simplify(program: Program) -> None:
    """Let what equals another cell stand for it, then leave out what nobody reads."""
    places = np.arange(program.size)
    kept = []
    for instruction in program.instructions:
        moved = instruction.moved(places)
        kept.append(moved)
        if isinstance(moved, Map) and moved.out.size <= _LONGEST:
            rows = zip(*(cells.reshape(-1).tolist() for cells in moved.operands), strict=True)
            for i, operands in enumerate(rows):
                same = _same(program, moved.op, operands)
                if same is not None:
                    places = _grown(places, program.size)
                    places[moved.out.start + i] = same
    places = _grown(places, program.size)
    program.instructions = kept
    program.results = [(name, kind, places[cells]) for name, kind, cells in program.results]
    program.prune()


def _grown(places: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate((places, np.arange(places.size, size)))


def _same(program: Program, op: str, operands: Sequence[int]) -> int | None:
    """Return the cell that an operation on these cells equals; None where it makes a new number."""
    if op == "where":
        condition = program.value(operands[0])
        return None if condition is None else operands[2 if condition == 0.0 else 1]
    if op not in ("mul", "add", "sub"):
        return None
    a, b = (program.value(address) for address in operands)
    if a is not None and b is not None:
        value = a * b if op == "mul" else a + b if op == "add" else a - b
        return program.constant(np.array([value]), "real").start
    nothing = 1.0 if op == "mul" else 0.0
    if b == nothing:
        return operands[0]
    return operands[1] if a == nothing and op != "sub" else None
