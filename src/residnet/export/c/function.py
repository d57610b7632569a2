"""The body of a C function from a program: scalars where few numbers act, loops where many do."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from residnet.core.errors import ExportError
from residnet.export.c.arrays import TYPES, Tables, index, literal, merge
from residnet.export.c.words import HELPERS, expression
from residnet.export.lowering.program import (
    Block,
    Cells,
    Fold,
    Instruction,
    Map,
    Pick,
    Product,
    Program,
)

_UNROLLED = 24
"""Longest operation that is written out, where it could be a loop."""
_WRITTEN_OUT = 128
"""Most products of a small matrix that are written out."""
_FOLDED = {"add": "add", "mean": "add", "mul": "mul", "or": "or", "and": "and"}


class FunctionBody:
    """Writes the instructions of a program as C statements.

    Attributes:
        lines: the statements.
        helpers: names of the helper functions that they call.
    """

    def __init__(self, program: Program, tables: Tables, prefix: str, what: str) -> None:
        self.program, self.tables, self.prefix, self.what = program, tables, prefix, what
        self.lines: list[str] = []
        self.helpers: set[str] = set()
        self.arrays: set[int] = set()
        """Starts of the blocks that are arrays; other blocks that are made are scalars."""
        # results may go where arguments came from: what is passed on is copied first
        passed = {
            self.program.block(int(address)).name
            for _, _, cells in program.results
            for address in cells
            if self.program.block(int(address)).origin == "argument"
        }
        self.names = {
            block.name: f"c_{block.name}" if block.name in passed else block.name
            for block in program.arguments
        }
        self.copies = [
            line
            for block in program.arguments
            if block.name in passed
            for line in (
                f"REAL c_{block.name}[{block.size}];",
                f"for (i0 = 0; i0 < {block.size}; i0++) c_{block.name}[i0] = {block.name}[i0];",
            )
        ]

    def write(self) -> None:
        """Write the program's instructions in their order."""
        for instruction in self.program.instructions:
            self.one(instruction)

    def one(self, instruction: Instruction) -> None:
        """Write the C statements of one instruction."""
        writers: dict[type, Callable[..., None]] = {
            Map: self.map, Product: self.product, Fold: self.fold, Pick: self.pick,
        }  # fmt: skip
        writers[type(instruction)](instruction)

    def cell(self, address: int) -> str:
        """Return one cell in C."""
        block = self.program.block(address)
        place = address - block.start
        if block.origin == "constant":
            return literal(float(block.values[place]), block.kind)
        if block.origin == "argument":
            return f"{self.names[block.name]}[{place}]"
        return f"t{block.start}[{place}]" if block.start in self.arrays else f"t{address}"

    def array(self, block: Block) -> str:
        """Return the name of a block that is an array."""
        if block.origin == "constant":
            return self.tables.name(block.values, block.kind)
        return self.names[block.name] if block.origin == "argument" else f"t{block.start}"

    def indexable(self, block: Block) -> bool:
        """Whether cells of a block can be reached by an index."""
        return block.origin != "made" or block.start in self.arrays

    def result(self, block: Block, scalars: bool) -> None:
        """Declare an array for what comes; scalars are declared where they are made."""
        if not scalars:
            self.arrays.add(block.start)
            self.lines.append(f"{TYPES[block.kind]} t{block.start}[{block.size}];")

    def apply(self, op: str, operands: Sequence[str]) -> str:
        """Return an operation in C and note the helper that it needs."""
        if op in HELPERS:
            self.helpers.add(op)
        try:
            return expression(op, list(operands), self.prefix)
        except KeyError:
            raise ExportError(
                f"{self.what}: its step uses the operation '{op}', which is not written in C;"
                " export it as torchscript"
            ) from None

    def map(self, instruction: Map) -> None:
        """Write an operation on each element, as a loop nest where its cells lie evenly."""
        out = instruction.out
        operands = instruction.operands
        if out.size > _UNROLLED:
            operands = tuple(self.gathered(cells) for cells in operands)
            patterns = [self.pattern(cells) for cells in operands]
            if all(pattern is not None for pattern in patterns):
                self.loops(instruction, [p for p in patterns if p is not None])
                return
        self.result(out, scalars=True)
        flat = [cells.reshape(-1) for cells in operands]
        for i in range(out.size):
            if not self.program.needed[out.start + i]:
                continue
            text = self.apply(instruction.op, [self.cell(int(cells[i])) for cells in flat])
            self.lines.append(f"const {TYPES[out.kind]} t{out.start + i} = {text};")

    def pattern(self, cells: Cells) -> tuple[Block, int, list[int]] | None:
        """Return block, offset and strides of evenly lying cells; None of others."""
        first = int(cells.flat[0])
        strides = [
            int(np.take(cells, 1, axis=d).flat[0]) - first if n > 1 else 0
            for d, n in enumerate(cells.shape)
        ]
        even = first + sum(
            (
                stride * np.arange(n).reshape([-1 if i == d else 1 for i in range(cells.ndim)])
                for d, (stride, n) in enumerate(zip(strides, cells.shape, strict=True))
            ),
            np.zeros((1,) * cells.ndim, dtype=np.int64),
        )
        block = self.program.block(first)
        inside = cells.min() >= block.start and cells.max() < block.start + block.size
        if not inside or not np.array_equal(np.broadcast_to(even, cells.shape), cells):
            return None
        if any(strides) and not self.indexable(block):
            return None
        return block, first - block.start, strides

    def gathered(self, cells: Cells) -> Cells:
        """Return many unevenly lying cells as evenly lying copies of them, copied by a table."""
        if cells.size <= 1000 or self.pattern(cells) is not None:
            return cells
        unique, places = np.unique(cells, return_inverse=True)
        kind = self.program.block(int(unique[0])).kind
        source, copy = self.program.made(unique.size, kind), self.program.made(cells.size, kind)
        self.result(source, scalars=False)
        for i, address in enumerate(unique):
            self.lines.append(f"t{source.start}[{i}] = {self.cell(int(address))};")
        self.result(copy, scalars=False)
        table = self.tables.name(places.reshape(-1).astype(np.float64), "whole")
        self.lines.append(
            f"for (i0 = 0; i0 < {cells.size}; i0++)"
            f" t{copy.start}[i0] = t{source.start}[{table}[i0]];"
        )
        return np.arange(copy.start, copy.start + copy.size).reshape(cells.shape)

    def loops(self, instruction: Map, patterns: Sequence[tuple[Block, int, list[int]]]) -> None:
        """Write a loop nest over the dimensions of the result."""
        out, shape = instruction.out, instruction.operands[0].shape
        steps = [int(np.prod(shape[d + 1 :])) for d in range(len(shape))]
        merged = merge(shape, [steps, *(strides for _, _, strides in patterns)])
        sizes, (made, *given) = merged
        self.result(out, scalars=False)
        operands = [
            f"{self.array(block)}[{index(offset, strides)}]"
            if any(strides)
            else self.cell(block.start + offset)
            for (block, offset, _), strides in zip(patterns, given, strict=True)
        ]
        head = " ".join(f"for (i{d} = 0; i{d} < {n}; i{d}++)" for d, n in enumerate(sizes))
        text = self.apply(instruction.op, operands)
        self.lines.append(f"{head} t{out.start}[{index(0, made)}] = {text};")

    def product(self, instruction: Product) -> None:
        """Write a vector times a matrix; loops run along the results, which compilers vectorise."""
        out, left, right = instruction.out, instruction.left, instruction.right
        # what meets zeros alone has not been made
        wanted = self.program.needed[out.start : out.start + out.size]
        kept = (~instruction.zero & wanted).any(axis=1)
        if right.size <= _WRITTEN_OUT or not kept.any():
            self.small_product(instruction)
            return
        left, right = left[kept], right[kept]
        rows, columns = right.shape
        even = self.pattern(left)
        if even is None:
            copy = self.program.made(rows, "real")
            self.copied(copy, left)
            even = copy, 0, [1]
        block, offset, strides = even
        matrix = self.pattern(right)
        if matrix is None or matrix[0].origin == "constant":
            # a constant matrix stands in the order in which it is read
            source = self.constant_matrix(right)
            where = index(0, [columns, 1])
        else:
            source, where = self.array(matrix[0]), index(matrix[1], matrix[2])
        self.result(out, scalars=False)
        name = f"t{out.start}"
        if instruction.start is None:
            self.lines.append(f"for (i1 = 0; i1 < {columns}; i1++) {name}[i1] = ZERO;")
        else:
            self.copied(out, instruction.start)
        factor = f"{self.array(block)}[{index(offset, strides)}]"
        self.lines.append(
            f"for (i0 = 0; i0 < {rows}; i0++) {{ const REAL a = {factor};"
            f" for (i1 = 0; i1 < {columns}; i1++) {name}[i1] += a * {source}[{where}]; }}"
        )

    def constant_matrix(self, right: Cells) -> str:
        """Return the name of an array that holds a matrix in the order of its cells."""
        values = [self.program.value(int(address)) for address in right.flat]
        if all(value is not None for value in values):
            return self.tables.name(np.array(values, dtype=np.float64), "real")
        copy = self.program.made(right.size, "real")
        self.copied(copy, right.reshape(-1))
        return f"t{copy.start}"

    def copied(self, block: Block, cells: Cells) -> None:
        """Fill an array block with copies of cells."""
        if block.start not in self.arrays:
            self.result(block, scalars=False)
        even = self.pattern(cells)
        if even is not None and cells.size > _UNROLLED:
            source = (
                f"{self.array(even[0])}[{index(even[1], even[2])}]"
                if any(even[2])
                else self.cell(int(cells.flat[0]))
            )
            self.lines.append(
                f"for (i0 = 0; i0 < {cells.size}; i0++) t{block.start}[i0] = {source};"
            )
            return
        for i, address in enumerate(cells.reshape(-1)):
            self.lines.append(f"t{block.start}[{i}] = {self.cell(int(address))};")

    def small_product(self, instruction: Product) -> None:
        """Write a small product out; constant zeros are left out."""
        out, start = instruction.out, instruction.start
        for j in range(out.size):
            if not self.program.needed[out.start + j]:
                continue
            terms = [] if start is None else [self.cell(int(start[j]))]
            for k, address in enumerate(instruction.left):
                weight = self.program.value(int(instruction.right[k, j]))
                if weight == 0.0:
                    continue
                factor = self.cell(int(address))
                terms.append(
                    factor
                    if weight == 1.0
                    else f"{factor} * {self.cell(int(instruction.right[k, j]))}"
                )
            self.lines.append(f"const REAL t{out.start + j} = {' + '.join(terms) or 'ZERO'};")

    def fold(self, instruction: Fold) -> None:
        """Write the reduction of each row."""
        out, (rows, columns) = instruction.out, instruction.operand.shape
        if instruction.op.startswith("arg"):
            self.place(instruction)
            return
        op = _FOLDED.get(instruction.op, instruction.op)
        even = self.pattern(instruction.operand) if columns > _UNROLLED else None
        self.result(out, scalars=even is None)
        for i in range(rows):
            cells = instruction.operand[i]
            name = f"t{out.start}[{i}]" if even is not None else f"t{out.start + i}"
            if even is not None:
                self.lines.append(f"{name} = {self.cell(int(cells[0]))};")
                block, offset, strides = even
                each = f"{self.array(block)}[{index(offset + i * strides[0], strides[1:])}]"
                text = self.apply(op, [name, each])
                self.lines.append(f"for (i0 = 1; i0 < {columns}; i0++) {name} = {text};")
                if instruction.op == "mean":
                    self.lines.append(f"{name} /= (REAL){columns};")
                continue
            total = self.cell(int(cells[0]))
            for address in cells[1:]:
                total = self.apply(op, [total, self.cell(int(address))])
            if instruction.op == "mean":
                total = f"({total}) / (REAL){columns}"
            self.lines.append(f"const {TYPES[out.kind]} {name} = {total};")

    def place(self, instruction: Fold) -> None:
        """Write the place of the largest or smallest value of each row, the first of equals."""
        out = instruction.out
        sign = ">" if instruction.op == "argmax" else "<"
        self.result(out, scalars=False)
        for i, cells in enumerate(instruction.operand):
            copy = self.program.made(cells.size, "real")
            self.copied(copy, cells)
            name = f"t{out.start}[{i}]"
            self.lines.append(
                f"{name} = 0; for (i0 = 1; i0 < {cells.size}; i0++)"
                f" if (t{copy.start}[i0] {sign} t{copy.start}[{name}]) {name} = i0;"
            )

    def pick(self, instruction: Pick) -> None:
        """Write a look-up of a row, which is held to the table."""
        table, out = instruction.table, instruction.out
        source = self.constant_matrix(table)
        rows, columns = table.shape
        self.result(out, scalars=False)
        row = self.cell(int(instruction.row[0]))
        self.lines.append(
            f"i0 = {row} < 0 ? 0 : ({row} > {rows - 1} ? {rows - 1} : {row});"
            f" for (i1 = 0; i1 < {columns}; i1++)"
            f" t{out.start}[i1] = {source}[i0 * {columns} + i1];"
        )

    def stored(self, name: str, cells: Cells) -> list[str]:
        """Return the statements that write cells to where a result goes."""
        even = self.pattern(cells) if cells.size > _UNROLLED else None
        if even is None:
            return [f"{name}[{i}] = {self.cell(int(at))};" for i, at in enumerate(cells)]
        source = (
            f"{self.array(even[0])}[{index(even[1], even[2])}]"
            if any(even[2])
            else self.cell(int(cells[0]))
        )
        return [f"for (i0 = 0; i0 < {cells.size}; i0++) {name}[i0] = {source};"]

    def counters(self, text: str) -> list[str]:
        """Return the loop counters that statements use."""
        return sorted(set(re.findall(r"\bi\d+\b", text)))
