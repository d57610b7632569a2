"""The program of a step: few instructions over numbered cells, all of whose sizes are known.

Every number of the step has a cell, named by an address: arguments, constants and what instructions
make. Moving numbers about costs nothing here, because a view is another array of addresses.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

Kind = Literal["real", "flag", "whole"]
"""Of a cell: a real number, a truth value, or a whole number."""
Cells = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Block:
    """Neighbouring cells of one origin.

    Attributes:
        start: address of the first.
        size: number of cells.
        kind: of all of them.
        origin: where their values come from.
        name: of an argument; empty otherwise.
        values: of constants; empty otherwise.
    """

    start: int
    size: int
    kind: Kind
    origin: Literal["argument", "constant", "made"]
    name: str = ""
    values: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Map:
    """An operation on each element: `out` is a new block with as many cells as each operand."""

    op: str
    out: Block
    operands: tuple[Cells, ...]

    def read(self, needed: npt.NDArray[np.bool_]) -> Sequence[Cells]:
        """Return the cells that the instruction reads for those of its cells that are needed."""
        wanted = needed[self.out.start : self.out.start + self.out.size]
        return [cells.reshape(-1)[wanted] for cells in self.operands]

    def moved(self, places: Cells) -> Map:
        """Return the instruction with every cell that it reads at its new address."""
        return replace(self, operands=tuple(places[cells] for cells in self.operands))


@dataclass(frozen=True)
class Product:
    """A vector times a matrix, `out[j] = start[j] + sum_k left[k] right[k, j]`.

    Attributes:
        zero: where the matrix is a constant zero [k, n]; such products are left out of small ones.
    """

    out: Block
    left: Cells
    right: Cells
    start: Cells | None
    zero: npt.NDArray[np.bool_]

    def read(self, needed: npt.NDArray[np.bool_]) -> Sequence[Cells]:
        """Return the cells that the instruction reads for those of its cells that are needed."""
        wanted = needed[self.out.start : self.out.start + self.out.size]
        used = ~self.zero & wanted
        both = (self.left[used.any(axis=1)], self.right[used])
        return both if self.start is None else (*both, self.start[wanted])

    def moved(self, places: Cells) -> Product:
        """Return the instruction with every cell that it reads at its new address."""
        start = None if self.start is None else places[self.start]
        return replace(self, left=places[self.left], right=places[self.right], start=start)


@dataclass(frozen=True)
class Fold:
    """A reduction of each row of `operand` [rows, columns] to one cell of `out`."""

    op: str
    out: Block
    operand: Cells

    def read(self, needed: npt.NDArray[np.bool_]) -> Sequence[Cells]:
        """Return the cells that the instruction reads for those of its cells that are needed."""
        return (self.operand,)

    def moved(self, places: Cells) -> Fold:
        """Return the instruction with every cell that it reads at its new address."""
        return replace(self, operand=places[self.operand])


@dataclass(frozen=True)
class Pick:
    """The cells of `table` [n, columns] in the row that `row` (one cell) says, as `out`."""

    out: Block
    table: Cells
    row: Cells

    def read(self, needed: npt.NDArray[np.bool_]) -> Sequence[Cells]:
        """Return the cells that the instruction reads for those of its cells that are needed."""
        return (self.table, self.row)

    def moved(self, places: Cells) -> Pick:
        """Return the instruction with every cell that it reads at its new address."""
        return replace(self, table=places[self.table], row=places[self.row])


Instruction = Map | Product | Fold | Pick


class Program:
    """Instructions in the order in which they run, with the cells that they read and make."""

    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self.instructions: list[Instruction] = []
        self.results: list[tuple[str, Kind, Cells]] = []
        self.needed: npt.NDArray[np.bool_] = np.zeros(0, dtype=bool)
        """Of each cell, whether something reads it; known once `prune` has run."""
        self._starts: list[int] = []
        self._size = 0
        self._constants: dict[tuple[Kind, bytes], Block] = {}

    def argument(self, name: str, size: int) -> Block:
        """Return a new block of an argument."""
        return self._add(Block(self._size, size, "real", "argument", name))

    def constant(self, values: npt.NDArray[np.float64], kind: Kind) -> Block:
        """Return a block of these constants; the same ones share a block."""
        flat = np.ascontiguousarray(values, dtype=np.float64).reshape(-1)
        key = (kind, flat.tobytes())
        if key not in self._constants:
            self._constants[key] = self._add(
                Block(self._size, flat.size, kind, "constant", values=flat)
            )
        return self._constants[key]

    def made(self, size: int, kind: Kind) -> Block:
        """Return a new block for what an instruction makes."""
        return self._add(Block(self._size, size, kind, "made"))

    def _add(self, block: Block) -> Block:
        self.blocks.append(block)
        self._starts.append(block.start)
        self._size += block.size
        return block

    def block(self, address: int) -> Block:
        """Return the block that holds an address."""
        found = bisect_right(self._starts, address) - 1
        while self.blocks[found].size == 0:
            found -= 1
        return self.blocks[found]

    def value(self, address: int) -> float | None:
        """Return the value of a constant cell, None of any other."""
        block = self.block(address)
        return float(block.values[address - block.start]) if block.origin == "constant" else None

    def zeros(self, cells: Cells) -> npt.NDArray[np.bool_]:
        """Return which cells are constants that are zero."""
        out = np.zeros(cells.shape, dtype=bool)
        for block in self.blocks:
            if block.origin == "constant" and block.size:
                inside = (cells >= block.start) & (cells < block.start + block.size)
                if inside.any():
                    out[inside] = block.values[cells[inside] - block.start] == 0.0
        return out

    @property
    def size(self) -> int:
        """Number of numbers that the program holds."""
        return self._size

    @property
    def arguments(self) -> list[Block]:
        """The blocks of the arguments, in their order."""
        return [block for block in self.blocks if block.origin == "argument"]

    def prune(self) -> None:
        """Leave out the instructions whose cells nobody reads."""
        self.needed = np.zeros(self._size, dtype=bool)
        for _, _, cells in self.results:
            self.needed[cells] = True
        kept = []
        for instruction in reversed(self.instructions):
            out = instruction.out
            if self.needed[out.start : out.start + out.size].any():
                kept.append(instruction)
                for cells in instruction.read(self.needed):
                    self.needed[cells] = True
        self.instructions = kept[::-1]
