"""Translation of CasADi functions to C statements, and compilation to shared libraries."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import casadi as ca
import numpy as np

from residnet.core.errors import ExportError, UsageError
from residnet.core.files import atomic_write
from residnet.core.ownership import Manifest

FUNCTIONS: Final = {
    getattr(ca, f"OP_{name.upper()}"): name
    for name in (
        "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
        "atanh", "exp", "expm1", "log", "log1p", "sqrt", "floor", "ceil", "erf", "fabs", "atan2",
        "hypot", "pow", "fmod", "copysign",
    )
} | {ca.OP_CONSTPOW: "pow"}  # fmt: skip
"""Operations that are functions of the C library."""
_OPERATORS: Final = {
    ca.OP_ADD: "{0} + {1}", ca.OP_SUB: "{0} - {1}", ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}", ca.OP_NEG: "-{0}", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "ONE / {0}", ca.OP_ASSIGN: "{0}",
}  # fmt: skip
_COMPARISONS: Final = {
    ca.OP_LT: "{0} < {1}", ca.OP_LE: "{0} <= {1}", ca.OP_EQ: "{0} == {1}", ca.OP_NE: "{0} != {1}"
}  # fmt: skip
_LOGICAL: Final = {ca.OP_NOT: "!{0}", ca.OP_AND: "{0} && {1}", ca.OP_OR: "{0} || {1}"}
_MAX_UNROLLED_LENGTH: Final = 24
"""Largest number of elements of an operation that is unrolled instead of written as a loop."""
_MAX_UNROLLED_PRODUCTS: Final = 256
"""Largest number of scalar products of a matrix product that is unrolled."""


def write_literal(value: float) -> str:
    """Return a real number in C; in single precision the compiler rounds it."""
    if np.isnan(value):
        return "(ZERO / ZERO)"
    text = "INFINITY" if np.isinf(value) else repr(abs(float(value)))
    return f"((REAL)-{text})" if np.signbit(value) else f"(REAL){text}"


class Tables:
    """The constant arrays of a file, each written once."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.lines = dict[str, str]()
        self._names: dict[tuple[str, tuple[str, ...]], str] = {}

    def table_name(self, texts: Sequence[str], c_type: str) -> str:
        """Return the name of a constant array of these numbers."""
        key = (c_type, tuple(texts))
        if key not in self._names:
            self._names[key] = name = f"{self.prefix}table_{len(self._names)}"
            rows = ",\n    ".join(", ".join(texts[i : i + 8]) for i in range(0, len(texts), 8))
            self.lines[name] = f"static const {c_type} {name}[{len(texts)}] = {{\n    {rows}\n}};\n"
        return self._names[key]


@dataclass(frozen=True)
class _CColumn:
    """A column of numbers as C expressions.

    Attributes:
        cells: expression of each number.
        array: name of the C array that contains the numbers; None for separate variables.
        indices: positions of the numbers in that array; None for all from its beginning.
        is_boolean: whether the numbers are truth values.
    """

    cells: Sequence[str]
    array: str | None = None
    indices: Sequence[int] | None = None
    is_boolean: bool = False

    def select(self, indices: Sequence[int]) -> _CColumn:
        """Return the numbers at some positions of the column."""
        cells = [self.cells[i] for i in indices]
        if self.array is None:
            return _CColumn(cells, is_boolean=self.is_boolean)
        selected = indices if self.indices is None else [self.indices[i] for i in indices]
        return _CColumn(cells, self.array, selected, self.is_boolean)


class FunctionWriter:
    """Writes a function as C statements: scalars for short columns, loops for long ones.

    Args:
        function: CasADi function of dense columns.
        tables: constant tables of the file.
        what: name of the function, for messages.

    Attributes:
        lines: name of the variable and text of each statement.
        results: C expressions of each result, complete after all statements are written.
        conditional_halves: condition, its type and value of each variable that is `c ? value : 0`.
        negated: condition of which a variable is the negation.
        constants: literals, which are propagated instead of stored.
    """

    REAL: str = "REAL"
    FLAG: str = "int"
    max_unrolled_length: float = _MAX_UNROLLED_LENGTH
    logical: Mapping[int, str] = _LOGICAL

    @property
    def zero_literal(self) -> str:
        """Zero in the number type of the code."""
        return self.write_literal(0.0)

    @property
    def one_literal(self) -> str:
        """One in the number type of the code."""
        return self.write_literal(1.0)

    def write_literal(self, value: float) -> str:
        """Return a constant as an expression of the number type of the code."""
        return write_literal(value)

    def __init__(self, function: ca.Function, tables: Tables, what: str) -> None:
        self.function = function
        self.tables = tables
        self.what = what
        self.names = [function.name_in(i) for i in range(function.n_in())]
        self.lines: list[tuple[str, str]] = []
        self.results = [list[str]() for _ in range(function.n_out())]
        self.conditional_halves: dict[str, tuple[str, bool, str]] = {}
        self.negated: dict[str, str] = {}
        self.constants: set[str] = set()
        self.is_scalar_function = function.is_a("SXFunction")
        columns: dict[int, _CColumn] = {}
        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            inputs = function.instruction_input(k)
            outputs = function.instruction_output(k)
            if op == ca.OP_CONST:
                columns[outputs[0]] = self.write_constant(k)
            elif op == ca.OP_INPUT:
                columns[outputs[0]] = self.copy_argument(*inputs)
            elif op == ca.OP_OUTPUT:
                self.store_result(outputs[0], columns[inputs[0]])
            else:
                results = self.write_instruction(k, op, [columns[i] for i in inputs])
                columns.update(zip(outputs, results, strict=True))

    def store_result(self, result: int, column: _CColumn) -> None:
        """Append numbers to a result, which CasADi may write in several parts."""
        self.results[result] += [self.to_real(cell, column.is_boolean) for cell in column.cells]

    def write_constant(self, k: int) -> _CColumn:
        """Return the constant of an instruction, in a table if it is long."""
        if self.is_scalar_function:
            values = [self.function.instruction_constant(k)]
        else:
            matrix = ca.densify(self.function.instruction_MX(k).to_DM())
            values = matrix.nonzeros()
        texts = [*map(self.write_literal, values)]
        self.constants.update(texts)
        if len(texts) <= self.max_unrolled_length:
            return _CColumn(texts)
        return _CColumn(texts, self.tables.table_name(texts, "REAL"))

    def argument_expression(self, name: str, place: int) -> str:
        """Return the C expression of entry `place` of the array of an argument."""
        return f"{name}[{place}]"

    def copy_argument(self, argument: int, place: int | None = None) -> _CColumn:
        """Return a copy of an argument, because results may be written to the same memory."""
        name = self.names[argument]
        if place is not None:
            return _CColumn([self.write_scalar(self.argument_expression(name, place))])
        size = self.function.numel_in(argument)
        if size <= self.max_unrolled_length:
            return _CColumn(
                [self.write_scalar(self.argument_expression(name, i)) for i in range(size)]
            )
        return self.write_loop(size, f"{name}[i]", False)

    def new_name(self) -> str:
        """Return the name of a new variable, unique because each statement defines one."""
        return f"t{len(self.lines)}"

    def write_scalar(self, text: str, is_boolean: bool = False) -> str:
        """Write a single number and return its name."""
        name = self.new_name()
        self.lines.append(
            (name, f"const {self.FLAG if is_boolean else self.REAL} {name} = {text};")
        )
        return name

    def write_loop(self, size: int, text: str, is_boolean: bool) -> _CColumn:
        """Write a loop that fills an array; `text` is the expression of entry i."""
        name = self.new_name()
        c_type = self.FLAG if is_boolean else self.REAL
        self.lines.append(
            (name, f"{c_type} {name}[{size}]; for (i = 0; i < {size}; i++) {name}[i] = {text};")
        )
        return _CColumn([f"{name}[{i}]" for i in range(size)], name, is_boolean=is_boolean)

    def as_array(self, column: _CColumn) -> str:
        """Return the name of an array with the numbers of a column."""
        if column.array is not None:
            first = column.indices[0] if column.indices else 0
            size = len(column.cells)
            if column.indices is None or list(column.indices) == list(range(first, first + size)):
                return f"({column.array} + {first})" if first else column.array
            if size > self.max_unrolled_length:
                table = self.tables.table_name([str(place) for place in column.indices], "int")
                selected = self.write_loop(size, f"{column.array}[{table}[i]]", column.is_boolean)
                return str(selected.array)
        if all(cell in self.constants for cell in column.cells):
            return self.tables.table_name(column.cells, "REAL")
        name = self.new_name()
        c_type = self.FLAG if column.is_boolean else self.REAL
        assignments = "".join(f" {name}[{i}] = {cell};" for i, cell in enumerate(column.cells))
        self.lines.append((name, f"{c_type} {name}[{len(column.cells)}];{assignments}"))
        return name

    def write_instruction(self, k: int, op: int, operands: Sequence[_CColumn]) -> list[_CColumn]:
        """Write the statements of instruction k and return its results as C expressions."""
        if op in (ca.OP_VERTCAT, ca.OP_HORZCAT):
            if any(column.is_boolean for column in operands):
                operands = [self.to_real_column(column) for column in operands]
            return [_CColumn([cell for column in operands for cell in column.cells])]
        if op == ca.OP_RESHAPE:
            return [operands[0]]
        if op in (ca.OP_VERTSPLIT, ca.OP_HORZSPLIT, ca.OP_GETNONZEROS, ca.OP_TRANSPOSE):
            return [operands[0].select(places) for places in self.selected_indices(k, op)]
        if op == ca.OP_MTIMES:
            start, left_factor, right_factor = operands
            rows, columns = self.function.instruction_MX(k).shape
            return [self.write_product(start, left_factor, right_factor, rows, columns)]
        if op == ca.OP_GETNONZEROS_PARAM:
            table = self.as_array(self.to_real_column(operands[0]))
            return [
                _CColumn([self.write_scalar(f"{table}[(int){cell}]") for cell in operands[1].cells])
            ]
        return [self.write_elementwise(op, operands)]

    def selected_indices(self, k: int, op: int) -> list[list[int]]:
        """Return the indices of the operand entries in each output of an instruction."""
        matrix = self.function.instruction_MX(k)
        if op == ca.OP_TRANSPOSE:
            rows, columns = matrix.shape
            return [[i * columns + j for j in range(columns) for i in range(rows)]]
        properties = matrix.info()
        if "nz" in properties:
            return [list(properties["nz"])]
        if "slice" in properties:
            return [_slice_indices(properties["slice"])]
        if "outer" in properties:
            return [
                [
                    i + j
                    for i in _slice_indices(properties["outer"])
                    for j in _slice_indices(properties["inner"])
                ]
            ]
        offsets = properties["offset"]
        height = matrix.dep(0).shape[0] if op == ca.OP_HORZSPLIT else 1
        return [list(range(a * height, b * height)) for a, b in pairwise(offsets)]

    def to_real(self, cell: str, is_boolean: bool) -> str:
        return f"(REAL){cell}" if is_boolean else cell

    def to_truth(self, cell: str, is_boolean: bool) -> str:
        return cell

    def to_real_column(self, column: _CColumn) -> _CColumn:
        if not column.is_boolean:
            return column
        if column.array is not None:
            return self.write_loop(len(column.cells), f"(REAL){self.as_array(column)}[i]", False)
        return _CColumn([self.write_scalar(self.to_real(cell, True)) for cell in column.cells])

    def write_elementwise(self, op: int, operands: Sequence[_CColumn]) -> _CColumn:
        """Write an operation on each element; a single number is broadcast."""
        size = max(len(column.cells) for column in operands)
        is_boolean = op in _COMPARISONS or op in _LOGICAL
        if size <= self.max_unrolled_length:
            cells = []
            for i in range(size):
                expressions = [
                    column.cells[i if len(column.cells) > 1 else 0] for column in operands
                ]
                cells.append(
                    self.write_scalar_operation(
                        op, expressions, [column.is_boolean for column in operands], is_boolean
                    )
                )
            return _CColumn(cells, is_boolean=is_boolean)
        expressions = [
            f"{self.as_array(column)}[i]" if len(column.cells) > 1 else column.cells[0]
            for column in operands
        ]
        flags = [column.is_boolean for column in operands]
        result = self.write_loop(
            size, self.operation_expression(op, expressions, flags), is_boolean
        )
        self.note_conditional(op, f"{result.array}[i]", expressions, flags)
        return result

    def write_scalar_operation(
        self, op: int, expressions: Sequence[str], flags: Sequence[bool], is_boolean: bool
    ) -> str:
        """Write an operation on single numbers; additions of 0 and products with 1 are omitted."""
        is_constant = [cell in self.constants for cell in expressions]
        if op == ca.OP_ADD and self.zero_literal in expressions and not any(flags):
            return expressions[expressions[0] == self.zero_literal]
        if (
            op == ca.OP_MUL
            and self.one_literal in expressions
            and not any(flags)
            and not all(is_constant)
        ):
            return expressions[expressions[0] == self.one_literal]
        name = self.write_scalar(self.operation_expression(op, expressions, flags), is_boolean)
        self.note_conditional(op, name, expressions, flags)
        return name

    def note_conditional(
        self, op: int, name: str, expressions: Sequence[str], flags: Sequence[bool]
    ) -> None:
        """Record parts of a conditional: CasADi writes if_else(c, a, b) as (c ? a : 0) + (!c ? b :
        0).
        """
        if op == ca.OP_IF_ELSE_ZERO:
            self.conditional_halves[name] = (
                expressions[0],
                flags[0],
                self.to_real(expressions[1], flags[1]),
            )
        elif op == ca.OP_NOT:
            self.negated[name] = expressions[0]

    def find_conditional(self, expressions: Sequence[str]) -> tuple[str, str, str] | None:
        """Return condition, value and alternative if a sum adds both parts of a conditional."""
        for first, second in (expressions, expressions[::-1]):
            if first in self.conditional_halves and second in self.conditional_halves:
                condition, is_boolean, value = self.conditional_halves[first]
                negated_condition, _, alternative = self.conditional_halves[second]
                if self.negated.get(negated_condition) == condition:
                    return self.to_truth(condition, is_boolean), value, alternative
        return None

    def operation_expression(
        self, op: int, expressions: Sequence[str], flags: Sequence[bool]
    ) -> str:
        """Return the C expression of an operation on numbers."""
        if op == ca.OP_ADD and (conditional := self.find_conditional(expressions)) is not None:
            return self.conditional_expression(*conditional)
        if op == ca.OP_IF_ELSE_ZERO:
            return self.conditional_expression(
                self.to_truth(expressions[0], flags[0]),
                self.to_real(expressions[1], flags[1]),
                self.zero_literal,
            )
        if op in _LOGICAL:
            return self.logical[op].format(*map(self.to_truth, expressions, flags))
        expressions = [*map(self.to_real, expressions, flags)]
        for table in (_OPERATORS, _COMPARISONS):
            if op in table:
                return table[op].format(*expressions)
        if op == ca.OP_SIGN:
            positive, negative = (
                self.to_real(f"({expressions[0]} {relation} ZERO)", True) for relation in "><"
            )
            return f"{positive} - {negative}"
        if op in (ca.OP_FMAX, ca.OP_FMIN):
            relation = ">" if op == ca.OP_FMAX else "<"
            return self.conditional_expression(
                f"({expressions[0]} {relation} {expressions[1]})", *expressions
            )
        if op in FUNCTIONS:
            return self.call_expression(FUNCTIONS[op], expressions)
        name = next(name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op)
        raise ExportError(
            f"{self.what}: its step uses the operation '{name[3:].lower()}', which is not written"
            " in C; export it as torchscript"
        )

    def conditional_expression(self, condition: str, value: str, alternative: str) -> str:
        return f"{condition} ? {value} : {alternative}"

    def call_expression(self, name: str, expressions: Sequence[str]) -> str:
        return f"R({name})({', '.join(expressions)})"

    def write_product(
        self, start: _CColumn, left: _CColumn, right: _CColumn, rows: int, columns: int
    ) -> _CColumn:
        """Write start + left right; loops run along the results, which compilers vectorise."""
        inner = len(right.cells) // columns
        if rows * inner * columns <= min(
            _MAX_UNROLLED_PRODUCTS, self.max_unrolled_length * _MAX_UNROLLED_PRODUCTS
        ):
            cells = []
            for h in range(columns):
                for j in range(rows):
                    pairs = [
                        (left.cells[i * rows + j], right.cells[h * inner + i]) for i in range(inner)
                    ]
                    terms = [
                        " * ".join(cell for cell in pair if cell != self.one_literal) or "ONE"
                        for pair in pairs
                        if self.zero_literal not in pair
                    ]
                    start_cell = start.cells[h * rows + j]
                    terms = (
                        terms if terms and start_cell == self.zero_literal else [start_cell, *terms]
                    )
                    cells.append(self.write_scalar(_write_sum(terms)))
            return _CColumn(cells)
        a, b = self.as_array(left), self.as_array(right)
        if rows == columns == 1:
            # eight partial sums, which compilers vectorise
            name = self.new_name()
            n_unrolled = inner - inner % 8
            text = (
                f"REAL {name} = {start.cells[0]}; {{ REAL p[8] = {{ZERO}};"
                f" for (i = 0; i < {n_unrolled}; i += 8) for (j = 0; j < 8; j++)"
                f" p[j] += {a}[i + j] * {b}[i + j];"
                f" for (i = {n_unrolled}; i < {inner}; i++) p[0] += {a}[i] * {b}[i];"
                f" for (j = 0; j < 8; j++) {name} += p[j]; }}"
            )
            self.lines.append((name, text))
            return _CColumn([name])
        result = self.write_loop(rows * columns, f"{self.as_array(start)}[i]", False)
        name, text = self.lines.pop()
        column_loop = f"for (h = 0; h < {columns}; h++) " if columns > 1 else ""
        right_index, result_index = (
            (f"h * {inner} + i", f"h * {rows} + j") if columns > 1 else ("i", "j")
        )
        text += (
            f" {column_loop}for (i = 0; i < {inner}; i++) {{ const REAL a = {b}[{right_index}];"
            f" for (j = 0; j < {rows}; j++) {name}[{result_index}] += a * {a}[i * {rows} + j]; }}"
        )
        self.lines.append((name, text))
        return result

    def used_statements(self, results: Sequence[str]) -> list[str]:
        """Return the statements that some last statements depend on, followed by these."""
        used_names = set(re.findall(r"\w+", " ".join(results)))
        statements = []
        for name, text in reversed(self.lines):
            if name in used_names:
                statements.append(text)
                used_names.update(re.findall(r"\w+", text))
        return [*statements[::-1], *results]


def _write_sum(terms: Sequence[str]) -> str:
    """Return a pairwise sum, whose parts a processor can add in parallel."""
    if len(terms) < 3:
        return " + ".join(terms)
    half = len(terms) // 2
    return f"({_write_sum(terms[:half])}) + ({_write_sum(terms[half:])})"


def _slice_indices(slice_: Any) -> list[int]:
    return list(range(slice_["start"], slice_["stop"], slice_["step"]))


class CompilerError(ExportError):
    """No C compiler is installed, or the compiler fails."""


def find_compiler() -> str:
    """Return the path of the C compiler: `CC` of the environment, or cc, gcc or clang.

    Raises:
        ExportError: if no compiler is installed.
    """
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and (path := shutil.which(name)):
            return path
    raise CompilerError(
        "no C compiler was found; install gcc or clang, or name one in the environment variable CC"
    )


# -O1 compiles in half the time of -O2. With -fexpensive-optimizations, which fuses products and
# sums at no cost here, its code is as fast. Of -ffast-math only the flags that preserve infinities
# and NaN: the complete option also makes the processor flush subnormal numbers in the entire
# process from then on
_FLAGS = (
    *("-O1", "-fexpensive-optimizations", "-ftree-vectorize", "-march=native"),
    *("-fPIC", "-shared", "-w"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros"),
    *("-fassociative-math", "-freciprocal-math"),
)
_MAX_JOURNAL_SIZE = 100_000
"""Bytes of the cache's journal above which it is merged into the manifest.

These are 900 libraries; every use of the cache reads them, in about 7 ms.
"""
_MAX_CACHED_LIBRARIES = 512
"""Number of most recently used libraries in the cache, about 20 MB."""


def load_library(source: str, *, quick: bool = False) -> ctypes.CDLL:
    """Return a library compiled for this machine from a C source, or from the cache.

    The cache is `residnet/compiled` in `XDG_CACHE_HOME`, or in `~/.cache`. If `RESIDNET_CACHE` is
    set, it is the folder `residnet-cache` there. If the folder is not writable or a file in it was
    changed, the library is compiled at every call.

    Args:
        source: C source.
        quick: whether to compile without optimisation: compilation is fast, the library slow.

    Raises:
        ExportError: if no compiler is installed or the compiler fails.
    """
    compiler_path = find_compiler()
    flags = ("-O0", *_FLAGS[1:]) if quick else _FLAGS
    path = _cache_path(compiler_path, source, flags)
    try:
        # the manifest has checksums of the files that residnet wrote: no other library is loaded
        manifest = Manifest(path.parent)
        if not manifest.is_owned(path):
            with tempfile.TemporaryDirectory() as folder:
                library_path = Path(folder) / "compiled.so"
                _run_compiler(compiler_path, source, flags, library_path)
                with atomic_write(path, manifest) as partial:
                    shutil.copyfile(library_path, partial)
            _evict_old_libraries(manifest)
        path.touch()
        return ctypes.CDLL(str(path))
    except (OSError, UsageError):
        with tempfile.TemporaryDirectory() as folder:
            library_path = Path(folder) / "compiled.so"
            _run_compiler(compiler_path, source, flags, library_path)
            return ctypes.CDLL(str(library_path))


def _cache_path(compiler_path: str, source: str, flags: Sequence[str]) -> Path:
    """Return the file of a compiled library, named by a hash of source, flags and machine."""
    key = hashlib.sha256(
        "\n".join((source, *flags, *_machine_key(compiler_path))).encode()
    ).hexdigest()
    return _cache_folder() / f"{key[:32]}.so"


def _cache_folder() -> Path:
    """Return the folder of compiled libraries, which later processes reuse."""
    if folder := os.environ.get("RESIDNET_CACHE"):
        return Path(folder) / "residnet-cache"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "residnet" / "compiled"


@cache
def _machine_key(compiler_path: str) -> tuple[str, ...]:
    """Return compiler and processor, which a compiled library depends on besides its source."""
    version = subprocess.run([compiler_path, "--version"], capture_output=True, text=True).stdout
    return compiler_path, version, platform.node(), platform.machine(), platform.processor()


def _run_compiler(
    compiler_path: str, source: str, flags: Sequence[str], library_path: Path
) -> None:
    """Compile a C source to a library.

    Raises:
        ExportError: if the compiler fails; the message is its first one.
    """
    with tempfile.TemporaryDirectory() as folder:
        source_path = Path(folder) / "compiled.c"
        source_path.write_text(source)
        command = [
            compiler_path,
            "-std=gnu99",
            *flags,
            str(source_path),
            "-o",
            str(library_path),
            "-lm",
        ]
        process = subprocess.run(command, capture_output=True, text=True)
    if process.returncode:
        messages = process.stderr.strip().splitlines() or ["no message"]
        raise CompilerError(f"the generated C code does not compile ({messages[0]})")


def _evict_old_libraries(manifest: Manifest) -> None:
    """Delete the least recently used libraries, but only files that residnet wrote."""
    digests = manifest.read()
    # the folder has fewer files than the manifest, which also lists deleted ones
    paths = [path for path in manifest.folder.glob("*.so") if path.name in digests]
    paths.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for path in paths[_MAX_CACHED_LIBRARIES:]:
        manifest.remove_if_owned(path)
    # rarely: an entry that another process appends at the same time would be lost
    if manifest.journal.stat().st_size > _MAX_JOURNAL_SIZE:
        manifest.compact()
