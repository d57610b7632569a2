"""A program for many rows at once in C, by the vector types that gcc and clang know.

A cell is one vector of `LANES` rows. What all rows share is a plain number.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.export.c.arrays import literal
from residnet.export.c.words import FUNCTIONS, OPERATORS
from residnet.export.lowering.program import Cells, Fold, Instruction, Kind, Map, Pick, Product
from residnet.export.lowering.program import Program as Program

_VECTOR = {
    "where": "pick({0}, {1}, {2})",
    "maximum": "pick({0} > {1}, {0}, {1})",
    "minimum": "pick({0} < {1}, {0}, {1})",
    "relu": "pick({0} > ZERO, {0}, ALL(ZERO))",
    "sign": "(pick({0} > ZERO, ALL(ONE), ALL(ZERO)) - pick({0} < ZERO, ALL(ONE), ALL(ZERO)))",
    "remainder": "({0} - {1} * v_floor({0} / {1}))",
    "abs": "v_fabs({0})", "round": "v_rint({0})", "rsqrt": "(ONE / v_sqrt({0}))",
    "sigmoid": "(ONE / (ONE + v_exp(-{0})))",
    "and": "({0} & {1})", "or": "({0} | {1})", "not": "(~{0})",
    "isnan": "({0} != {0})", "isinf": "(v_fabs({0}) > BIG)",
}  # fmt: skip
"""Operations whose vector form is not that of plain numbers."""
_PLAIN = {
    "maximum": "({0} > {1} ? {0} : {1})",
    "minimum": "({0} < {1} ? {0} : {1})",
    "relu": "({0} > ZERO ? {0} : ZERO)",
    "sign": "(REAL)(({0} > ZERO) - ({0} < ZERO))",
    "remainder": "({0} - {1} * R(floor)({0} / {1}))",
}
"""Operations on plain numbers that exported files have small functions for."""
_TYPES: dict[Kind, tuple[str, str]] = {
    "real": ("REAL", "V"), "flag": ("int", "I"), "whole": ("int", "I"),
}  # fmt: skip
_TWO = ("atan2", "hypot", "pow", "fmod", "copysign")

_PRELUDE = (
    "#include <math.h>\n#include <string.h>\n"
    "#define ZERO ((REAL)0)\n#define ONE ((REAL)1)\n"
    "typedef REAL V __attribute__((vector_size(sizeof(REAL) * LANES)));\n"
    "typedef REAL U __attribute__((vector_size(sizeof(REAL) * LANES), aligned(4), may_alias));\n"
    "typedef INT I __attribute__((vector_size(sizeof(REAL) * LANES)));\n"
    "#define ALL(number) ((V){0} + (REAL)(number))\n"
    "#define EACH for (int l = 0; l < LANES; l++)\n"
    "static inline V pick(I c, V a, V b) { return (V)((c & (I)a) | (~c & (I)b)); }\n"
    + "".join(
        f"static __attribute__((noinline)) V v_{name}"
        + ("(V a, V b)" if name in _TWO else "(V a)")
        + f" {{ V o; EACH o[l] = R({name})(a[l]{', b[l]' if name in _TWO else ''}); return o; }}\n"
        for name in FUNCTIONS
    )
)


def prelude(dtype: torch.dtype) -> str:
    """Return what stands at the top of a file in this precision."""
    single = dtype == torch.float32
    words = {
        "LANES": lanes(dtype),
        "REAL": "float" if single else "double",
        "INT": "int" if single else "long long",
        "R(name)": "name##f" if single else "name",
        "BIG": "3e38f" if single else "1e308",
    }
    return "".join(f"#define {name} {text}\n" for name, text in words.items()) + _PRELUDE


def lanes(dtype: torch.dtype) -> int:
    """Return the number of rows of a block, which one vector of 64 bytes holds."""
    return 64 // dtype.itemsize


class LanesBody:
    """Writes the instructions of a program for a block of `LANES` rows.

    A cell of an argument or result stands `stride` numbers behind the one before it, and the rows
    of a cell stand side by side.

    Args:
        program: of one row.
        shared: names of the arguments that all rows share; what depends on nothing else is worked
            out once.
        totals: names of results that are added up over all calls, for each lane by itself.
        what: is written, for messages.

    Attributes:
        lines: the statements.
    """

    def __init__(
        self, program: Program, shared: Collection[str], totals: Collection[str], what: str
    ) -> None:
        self.program, self.totals, self.what = program, totals, what
        self.lines: list[str] = []
        self.alike = np.zeros(program.size, dtype=bool)
        for block in program.blocks:
            known = block.origin == "constant" or block.name in shared
            self.alike[block.start : block.start + block.size] = known
        self.shared = frozenset(shared)

    def write(self) -> list[str]:
        """Return the statements of all instructions and results."""
        writers: dict[type, Callable[..., None]] = {
            Map: self.map, Product: self.product, Fold: self.fold, Pick: self.pick,
        }  # fmt: skip
        for instruction in self.program.instructions:
            self.mark(instruction)
            writers[type(instruction)](instruction)
        for name, kind, cells in self.program.results:
            if kind != "real":
                raise ExportError(f"{self.what}: result '{name}' is no real number")
            for place, address in enumerate(cells):
                value = self.vector(int(address))
                if name not in self.totals:
                    self.lines.append(f"*(U *)({name} + {place} * stride) = {value};")
                elif self.program.value(int(address)) != 0.0:
                    self.lines.append(f"*(U *)({name} + {place} * LANES) += {value};")
        return self.lines

    def mark(self, instruction: Instruction) -> None:
        """Note whether all rows share what an instruction makes."""
        out = instruction.out
        read = instruction.read(np.ones(self.program.size, dtype=bool))
        self.alike[out.start : out.start + out.size] = all(self.alike[c].all() for c in read)

    def kind(self, address: int) -> Kind:
        """Return the kind of a cell."""
        return self.program.block(address).kind

    def cell(self, address: int) -> str:
        """Return one cell in C, a plain number where all rows share it."""
        block = self.program.block(address)
        place = address - block.start
        if block.origin == "constant":
            return literal(float(block.values[place]), block.kind)
        if block.origin == "argument":
            if block.name in self.shared:
                return f"{block.name}[{place}]"
            return f"(*(const U *)({block.name} + {place} * stride))"
        return f"t{address}"

    def vector(self, address: int) -> str:
        """Return one cell as a vector."""
        text = self.cell(address)
        if not self.alike[address]:
            return text
        if self.kind(address) == "real":
            return f"ALL({text})"
        # a vector's truth is all bits
        return f"((I){{0}} {'-' if self.kind(address) == 'flag' else '+'} ({text}))"

    def made(self, address: int, text: str) -> None:
        """Write what makes a cell."""
        plain, vector = _TYPES[self.kind(address)]
        kind = plain if self.alike[address] else vector
        self.lines.append(f"const {kind} t{address} = {text};")

    def apply(self, op: str, cells: Sequence[int], alike: bool) -> str:
        """Return an operation on cells in C."""
        kinds = {self.kind(cell) for cell in cells}
        if alike:
            texts = [self.cell(cell) for cell in cells]
            if op in _PLAIN:
                return _PLAIN[op].format(*texts)
        else:
            texts = [self.vector(cell) for cell in cells]
            if op == "number":
                return (
                    f"pick({texts[0]}, ALL(ONE), ALL(ZERO))"
                    if kinds == {"flag"}
                    else f"__builtin_convertvector({texts[0]}, V)"
                )
            if op in _VECTOR and (op != "where" or self.kind(cells[1]) == "real"):
                return _VECTOR[op].format(*texts)
        if op in OPERATORS and (alike or op != "where"):
            return f"({OPERATORS[op].format(*texts)})"
        if op in FUNCTIONS:
            return f"{'R(' + op + ')' if alike else 'v_' + op}({', '.join(texts)})"
        raise ExportError(f"{self.what}: the operation '{op}' is not written for many rows")

    def wanted(self, instruction: Instruction) -> list[int]:
        """Return the places of the cells that something reads."""
        out = instruction.out
        found: list[int] = np.flatnonzero(
            self.program.needed[out.start : out.start + out.size]
        ).tolist()
        return found

    def map(self, instruction: Map) -> None:
        """Write an operation on each element."""
        flat = [cells.reshape(-1) for cells in instruction.operands]
        for i in self.wanted(instruction):
            address = instruction.out.start + i
            cells = [int(part[i]) for part in flat]
            text = self.apply(instruction.op, cells, bool(self.alike[address]))
            if instruction.op == "trunc" and self.kind(address) == "whole":
                text = (
                    f"(int){text}" if self.alike[address] else f"__builtin_convertvector({text}, I)"
                )
            self.made(address, text)

    def product(self, instruction: Product) -> None:
        """Write a vector times a matrix; constant zeros are left out."""
        start = instruction.start
        for j in self.wanted(instruction):
            terms = [] if start is None else [self.cell(int(start[j]))]
            for k, address in enumerate(instruction.left):
                if not instruction.zero[k, j]:
                    factor = self.cell(int(instruction.right[k, j]))
                    terms.append(f"{self.cell(int(address))} * {factor}")
            address = instruction.out.start + j
            text = " + ".join(terms) or "ZERO"
            self.made(address, text if terms or self.alike[address] else f"ALL({text})")

    def fold(self, instruction: Fold) -> None:
        """Write the reduction of each row of cells."""
        columns = instruction.operand.shape[1]
        for i in self.wanted(instruction):
            address = instruction.out.start + i
            if instruction.op not in ("add", "mean"):
                raise ExportError(
                    f"{self.what}: the reduction '{instruction.op}' is not written for many rows"
                )
            total = " + ".join(self.cell(int(cell)) for cell in instruction.operand[i])
            if not self.alike[address]:
                total = f"ALL(ZERO) + {total}"
            self.made(
                address, f"({total}) / (REAL){columns}" if instruction.op == "mean" else total
            )

    def pick(self, instruction: Pick) -> None:
        """Write a look-up of a row, which is held to the table."""
        table: Cells = instruction.table
        row, last = int(instruction.row[0]), len(table) - 1
        for j in self.wanted(instruction):
            address = instruction.out.start + j
            if self.kind(address) != "real":
                raise ExportError(f"{self.what}: a look-up of truth values is not written")
            at = self.vector(row)
            self.lines.append(f"V t{address} = {self.vector(int(table[0, j]))};")
            for i in range(1, last + 1):
                here = f"{at} == {i}" if i < last else f"{at} >= {i}"
                self.lines.append(
                    f"t{address} = pick({here}, {self.vector(int(table[i, j]))}, t{address});"
                )
            self.alike[address] = False
