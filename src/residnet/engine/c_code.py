"""CasADi functions as C statements, and the compiler that makes libraries of them."""

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
"""Operations that C's own library has."""
_OPERATORS: Final = {
    ca.OP_ADD: "{0} + {1}", ca.OP_SUB: "{0} - {1}", ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}", ca.OP_NEG: "-{0}", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "ONE / {0}", ca.OP_ASSIGN: "{0}",
}  # fmt: skip
_COMPARED: Final = {
    ca.OP_LT: "{0} < {1}", ca.OP_LE: "{0} <= {1}", ca.OP_EQ: "{0} == {1}", ca.OP_NE: "{0} != {1}"
}  # fmt: skip
_JOINED: Final = {ca.OP_NOT: "!{0}", ca.OP_AND: "{0} && {1}", ca.OP_OR: "{0} || {1}"}
_UNROLLED: Final = 24
"""Longest operation that is written out, where it could be a loop."""
_WRITTEN_OUT: Final = 256
"""Most products of a small matrix that are written out."""


def literal(value: float) -> str:
    """Return a real number in C; in single precision the compiler rounds it."""
    if np.isnan(value):
        return "(ZERO / ZERO)"
    text = "INFINITY" if np.isinf(value) else repr(abs(float(value)))
    return f"((REAL)-{text})" if np.signbit(value) else f"(REAL){text}"


class Tables:
    """The constant arrays of a file, each written once."""

    def __init__(self, prefix: str) -> None:
        self.prefix, self.lines = prefix, dict[str, str]()
        self._names: dict[tuple[str, tuple[str, ...]], str] = {}

    def name(self, texts: Sequence[str], kind: str) -> str:
        """Return the name of a constant array of these numbers."""
        key = (kind, tuple(texts))
        if key not in self._names:
            self._names[key] = name = f"{self.prefix}table_{len(self._names)}"
            rows = ",\n    ".join(", ".join(texts[i : i + 8]) for i in range(0, len(texts), 8))
            self.lines[name] = f"static const {kind} {name}[{len(texts)}] = {{\n    {rows}\n}};\n"
        return self._names[key]


@dataclass(frozen=True)
class _Column:
    """Numbers in C.

    Attributes:
        cells: each of them.
        array: where they lie side by side, or are taken from by `places`; None of single numbers.
        places: in that array; None for all from its beginning on.
        flag: whether they are truth values.
    """

    cells: Sequence[str]
    array: str | None = None
    places: Sequence[int] | None = None
    flag: bool = False

    def taken(self, places: Sequence[int]) -> _Column:
        cells = [self.cells[i] for i in places]
        if self.array is None:
            return _Column(cells, flag=self.flag)
        known = places if self.places is None else [self.places[i] for i in places]
        return _Column(cells, self.array, known, self.flag)


class Body:
    """Writes a function as C statements: single numbers where few act, loops where many do.

    Args:
        function: of dense columns.
        tables: of the file.
        what: is written, for messages.

    Attributes:
        lines: name and text of each statement.
        results: what is known of each result once all is written.
    """

    REAL: str = "REAL"
    FLAG: str = "int"
    unrolled: float = _UNROLLED
    joined: Mapping[int, str] = _JOINED

    @property
    def zero(self) -> str:
        """Zero, as constants are written."""
        return self.literal(0.0)

    @property
    def one(self) -> str:
        """One, as constants are written."""
        return self.literal(1.0)

    def literal(self, value: float) -> str:
        """Return a constant."""
        return literal(value)

    def __init__(self, function: ca.Function, tables: Tables, what: str) -> None:
        self.function, self.tables, self.what = function, tables, what
        self.names = [function.name_in(i) for i in range(function.n_in())]
        self.lines: list[tuple[str, str]] = []
        self.results = [list[str]() for _ in range(function.n_out())]
        self.chosen: dict[str, tuple[str, bool, str]] = {}
        self.negated: dict[str, str] = {}
        self.constants: set[str] = set()
        self.single = function.is_a("SXFunction")
        held: dict[int, _Column] = {}
        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            given, out = function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_CONST:
                held[out[0]] = self.constant(k)
            elif op == ca.OP_INPUT:
                held[out[0]] = self.taken_in(*given)
            elif op == ca.OP_OUTPUT:
                self.put(out[0], held[given[0]])
            else:
                found = self.instruction(k, op, [held[i] for i in given])
                held.update(zip(out, found, strict=True))

    def put(self, result: int, column: _Column) -> None:
        """Take numbers as those that come next in a result."""
        self.results[result] += [self.real(cell, column.flag) for cell in column.cells]

    def constant(self, k: int) -> _Column:
        if self.single:
            values = [self.function.instruction_constant(k)]
        else:
            matrix = ca.densify(self.function.instruction_MX(k).to_DM())
            values = matrix.nonzeros()
        texts = [*map(self.literal, values)]
        self.constants.update(texts)
        if len(texts) <= self.unrolled:
            return _Column(texts)
        return _Column(texts, self.tables.name(texts, "REAL"))

    def argument(self, name: str, place: int) -> str:
        """Return an entry of an argument."""
        return f"{name}[{place}]"

    def taken_in(self, argument: int, place: int | None = None) -> _Column:
        """Return an argument, copied because results may go where arguments came from."""
        name = self.names[argument]
        if place is not None:
            return _Column([self.number(self.argument(name, place))])
        size = self.function.numel_in(argument)
        if size <= self.unrolled:
            return _Column([self.number(self.argument(name, i)) for i in range(size)])
        return self.looped(size, f"{name}[i]", False)

    def new(self) -> str:
        return f"t{len(self.lines)}"

    def number(self, text: str, flag: bool = False) -> str:
        """Write a single number and return its name."""
        name = self.new()
        self.lines.append((name, f"const {self.FLAG if flag else self.REAL} {name} = {text};"))
        return name

    def looped(self, size: int, text: str, flag: bool) -> _Column:
        """Write an array whose entry i is what a text says."""
        name = self.new()
        kind = self.FLAG if flag else self.REAL
        self.lines.append(
            (name, f"{kind} {name}[{size}]; for (i = 0; i < {size}; i++) {name}[i] = {text};")
        )
        return _Column([f"{name}[{i}]" for i in range(size)], name, flag=flag)

    def array(self, column: _Column) -> str:
        """Return the name of an array with the numbers of a column."""
        if column.array is not None:
            first = column.places[0] if column.places else 0
            size = len(column.cells)
            if column.places is None or list(column.places) == list(range(first, first + size)):
                return f"({column.array} + {first})" if first else column.array
            if size > self.unrolled:
                table = self.tables.name([str(place) for place in column.places], "int")
                made = self.looped(size, f"{column.array}[{table}[i]]", column.flag)
                return str(made.array)
        if all(cell in self.constants for cell in column.cells):
            return self.tables.name(column.cells, "REAL")
        name = self.new()
        kind = self.FLAG if column.flag else self.REAL
        filled = "".join(f" {name}[{i}] = {cell};" for i, cell in enumerate(column.cells))
        self.lines.append((name, f"{kind} {name}[{len(column.cells)}];{filled}"))
        return name

    def instruction(self, k: int, op: int, given: Sequence[_Column]) -> list[_Column]:
        """Return what an instruction makes."""
        if op in (ca.OP_VERTCAT, ca.OP_HORZCAT):
            if any(column.flag for column in given):
                given = [self.as_real(column) for column in given]
            return [_Column([cell for column in given for cell in column.cells])]
        if op == ca.OP_RESHAPE:
            return [given[0]]
        if op in (ca.OP_VERTSPLIT, ca.OP_HORZSPLIT, ca.OP_GETNONZEROS, ca.OP_TRANSPOSE):
            return [given[0].taken(places) for places in self.places(k, op)]
        if op == ca.OP_MTIMES:
            start, left, right = given
            rows, columns = self.function.instruction_MX(k).shape
            return [self.product(start, left, right, rows, columns)]
        if op == ca.OP_GETNONZEROS_PARAM:
            table = self.array(self.as_real(given[0]))
            return [_Column([self.number(f"{table}[(int){cell}]") for cell in given[1].cells])]
        return [self.elementwise(op, given)]

    def places(self, k: int, op: int) -> list[list[int]]:
        """Return the places of the numbers that each output of an instruction takes."""
        matrix = self.function.instruction_MX(k)
        if op == ca.OP_TRANSPOSE:
            rows, columns = matrix.shape
            return [[i * columns + j for j in range(columns) for i in range(rows)]]
        info = matrix.info()
        if "nz" in info:
            return [list(info["nz"])]
        if "slice" in info:
            return [_range(info["slice"])]
        if "outer" in info:
            return [[i + j for i in _range(info["outer"]) for j in _range(info["inner"])]]
        offsets = info["offset"]
        height = matrix.dep(0).shape[0] if op == ca.OP_HORZSPLIT else 1
        return [list(range(a * height, b * height)) for a, b in pairwise(offsets)]

    def real(self, cell: str, flag: bool) -> str:
        return f"(REAL){cell}" if flag else cell

    def truth(self, cell: str, flag: bool) -> str:
        return cell

    def as_real(self, column: _Column) -> _Column:
        if not column.flag:
            return column
        if column.array is not None:
            return self.looped(len(column.cells), f"(REAL){self.array(column)}[i]", False)
        return _Column([self.number(self.real(cell, True)) for cell in column.cells])

    def elementwise(self, op: int, given: Sequence[_Column]) -> _Column:
        """Write an operation on each element; single numbers go with each."""
        size = max(len(column.cells) for column in given)
        flag = op in _COMPARED or op in _JOINED
        if size <= self.unrolled:
            cells = []
            for i in range(size):
                row = [column.cells[i if len(column.cells) > 1 else 0] for column in given]
                cells.append(self.applied(op, row, [column.flag for column in given], flag))
            return _Column(cells, flag=flag)
        row = [
            f"{self.array(column)}[i]" if len(column.cells) > 1 else column.cells[0]
            for column in given
        ]
        flags = [column.flag for column in given]
        made = self.looped(size, self.expression(op, row, flags), flag)
        self.note(op, f"{made.array}[i]", row, flags)
        return made

    def applied(self, op: int, row: Sequence[str], flags: Sequence[bool], flag: bool) -> str:
        """Write an operation on single numbers; what does nothing is left out."""
        known = [cell in self.constants for cell in row]
        if op == ca.OP_ADD and self.zero in row and not any(flags):
            return row[row[0] == self.zero]
        if op == ca.OP_MUL and self.one in row and not any(flags) and not all(known):
            return row[row[0] == self.one]
        name = self.number(self.expression(op, row, flags), flag)
        self.note(op, name, row, flags)
        return name

    def note(self, op: int, name: str, row: Sequence[str], flags: Sequence[bool]) -> None:
        """Remember halves of a choice, which CasADi has as the sum of two."""
        if op == ca.OP_IF_ELSE_ZERO:
            self.chosen[name] = row[0], flags[0], self.real(row[1], flags[1])
        elif op == ca.OP_NOT:
            self.negated[name] = row[0]

    def choice(self, row: Sequence[str]) -> tuple[str, str, str] | None:
        """Return condition, value and alternative where two halves of a choice are added."""
        for one, other in (row, row[::-1]):
            if one in self.chosen and other in self.chosen:
                condition, flag, value = self.chosen[one]
                against, _, alternative = self.chosen[other]
                if self.negated.get(against) == condition:
                    return self.truth(condition, flag), value, alternative
        return None

    def expression(self, op: int, row: Sequence[str], flags: Sequence[bool]) -> str:
        """Return an operation on numbers in C."""
        if op == ca.OP_ADD and (choice := self.choice(row)) is not None:
            return self.pick(*choice)
        if op == ca.OP_IF_ELSE_ZERO:
            return self.pick(self.truth(row[0], flags[0]), self.real(row[1], flags[1]), self.zero)
        if op in _JOINED:
            return self.joined[op].format(*map(self.truth, row, flags))
        row = [*map(self.real, row, flags)]
        for table in (_OPERATORS, _COMPARED):
            if op in table:
                return table[op].format(*row)
        if op == ca.OP_SIGN:
            above, below = (self.real(f"({row[0]} {way} ZERO)", True) for way in "><")
            return f"{above} - {below}"
        if op in (ca.OP_FMAX, ca.OP_FMIN):
            way = ">" if op == ca.OP_FMAX else "<"
            return self.pick(f"({row[0]} {way} {row[1]})", *row)
        if op in FUNCTIONS:
            return self.call(FUNCTIONS[op], row)
        name = next(name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op)
        raise ExportError(
            f"{self.what}: its step uses the operation '{name[3:].lower()}', which is not written"
            " in C; export it as torchscript"
        )

    def pick(self, condition: str, value: str, alternative: str) -> str:
        return f"{condition} ? {value} : {alternative}"

    def call(self, name: str, row: Sequence[str]) -> str:
        return f"R({name})({', '.join(row)})"

    def product(
        self, start: _Column, left: _Column, right: _Column, rows: int, columns: int
    ) -> _Column:
        """Write start + left right; loops run along the results, which compilers vectorise."""
        inner = len(right.cells) // columns
        if rows * inner * columns <= min(_WRITTEN_OUT, self.unrolled * _WRITTEN_OUT):
            cells = []
            for h in range(columns):
                for j in range(rows):
                    pairs = [
                        (left.cells[i * rows + j], right.cells[h * inner + i]) for i in range(inner)
                    ]
                    terms = [
                        " * ".join(cell for cell in pair if cell != self.one) or "ONE"
                        for pair in pairs
                        if self.zero not in pair
                    ]
                    begin = start.cells[h * rows + j]
                    terms = terms if terms and begin == self.zero else [begin, *terms]
                    cells.append(self.number(_sum(terms)))
            return _Column(cells)
        a, b = self.array(left), self.array(right)
        if rows == columns == 1:
            # eight sums side by side, which compilers vectorise
            name, whole = self.new(), inner - inner % 8
            text = (
                f"REAL {name} = {start.cells[0]}; {{ REAL p[8] = {{ZERO}};"
                f" for (i = 0; i < {whole}; i += 8) for (j = 0; j < 8; j++)"
                f" p[j] += {a}[i + j] * {b}[i + j];"
                f" for (i = {whole}; i < {inner}; i++) p[0] += {a}[i] * {b}[i];"
                f" for (j = 0; j < 8; j++) {name} += p[j]; }}"
            )
            self.lines.append((name, text))
            return _Column([name])
        made = self.looped(rows * columns, f"{self.array(start)}[i]", False)
        name, text = self.lines.pop()
        outer = f"for (h = 0; h < {columns}; h++) " if columns > 1 else ""
        at, into = (f"h * {inner} + i", f"h * {rows} + j") if columns > 1 else ("i", "j")
        text += (
            f" {outer}for (i = 0; i < {inner}; i++) {{ const REAL a = {b}[{at}];"
            f" for (j = 0; j < {rows}; j++) {name}[{into}] += a * {a}[i * {rows} + j]; }}"
        )
        self.lines.append((name, text))
        return made

    def read(self, ends: Sequence[str]) -> list[str]:
        """Return the statements that the last ones need, and those."""
        used = set(re.findall(r"\w+", " ".join(ends)))
        kept = []
        for name, text in reversed(self.lines):
            if name in used:
                kept.append(text)
                used.update(re.findall(r"\w+", text))
        return [*kept[::-1], *ends]


def _sum(terms: Sequence[str]) -> str:
    """Return a sum in pairs, whose parts a processor adds side by side."""
    if len(terms) < 3:
        return " + ".join(terms)
    half = len(terms) // 2
    return f"({_sum(terms[:half])}) + ({_sum(terms[half:])})"


def _range(slice_: Any) -> list[int]:
    return list(range(slice_["start"], slice_["stop"], slice_["step"]))


class CompilerError(ExportError):
    """There is no C compiler, or it fails."""


def compiler() -> str:
    """Return the C compiler: what CC names, or cc, gcc or clang.

    Raises:
        ExportError: where there is none.
    """
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and (found := shutil.which(name)):
            return found
    raise CompilerError(
        "no C compiler was found; install gcc or clang, or name one in the environment variable CC"
    )


# -O1 is twice as quick as -O2 over all, and what it makes is as quick, but that the latter joins
# products and sums: one of the "expensive" ones, which cost nothing here. Of -ffast-math only what
# leaves infinities and NaN as they are: a whole one also makes the processor flush subnormal
# numbers, in all that the process computes from then on
_FLAGS = (
    *("-O1", "-fexpensive-optimizations", "-ftree-vectorize", "-march=native"),
    *("-fPIC", "-shared", "-w"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros"),
    *("-fassociative-math", "-freciprocal-math"),
)
_LONGEST_JOURNAL = 1_000_000
"""Bytes of the cache's journal above which it is merged into the manifest."""
_KEPT = 64
"""Libraries that are kept, those used last."""


def compiled_library(source: str, *, quick: bool = False) -> ctypes.CDLL:
    """Return a C source as a library compiled for this machine, from the cache where it is there.

    The cache is `residnet/compiled` in `XDG_CACHE_HOME`, or in `~/.cache`; `RESIDNET_CACHE` names
    a folder in which the cache is the folder `residnet-cache`. Without a folder to write to, or if
    a file there is not as residnet wrote it, the library is compiled every time.

    Args:
        source: in C.
        quick: whether it is compiled in little time and runs slowly, rather than the reverse.

    Raises:
        ExportError: where there is no compiler, or it fails.
    """
    tool = compiler()
    flags = ("-O0", *_FLAGS[1:]) if quick else _FLAGS
    file = _kept(tool, source, flags)
    try:
        manifest = Manifest(file.parent)
        if not manifest.is_owned(file):
            with tempfile.TemporaryDirectory() as folder:
                out = Path(folder) / "compiled.so"
                _compile(tool, source, flags, out)
                with atomic_write(file, manifest) as partial:
                    shutil.copyfile(out, partial)
            _forget(manifest)
        file.touch()
        return ctypes.CDLL(str(file))
    except (OSError, UsageError):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "compiled.so"
            _compile(tool, source, flags, out)
            return ctypes.CDLL(str(out))


def _kept(tool: str, source: str, flags: Sequence[str]) -> Path:
    """Return the file of the cache that is the library of a source."""
    key = hashlib.sha256("\n".join((source, *flags, *_machine(tool))).encode()).hexdigest()
    return _folder() / f"{key[:32]}.so"


def _folder() -> Path:
    """Return the folder of the cache."""
    if named := os.environ.get("RESIDNET_CACHE"):
        return Path(named) / "residnet-cache"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "residnet" / "compiled"


@cache
def _machine(tool: str) -> tuple[str, ...]:
    """Return what a compiled library depends on beside its source: compiler and processor."""
    said = subprocess.run([tool, "--version"], capture_output=True, text=True).stdout
    return tool, said, platform.node(), platform.machine(), platform.processor()


def _compile(tool: str, source: str, flags: Sequence[str], out: Path) -> None:
    """Compile a C source to a library.

    Raises:
        ExportError: with the compiler's first complaint.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "compiled.c"
        file.write_text(source)
        call = [tool, "-std=gnu99", *flags, str(file), "-o", str(out), "-lm"]
        done = subprocess.run(call, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["no message"]
        raise CompilerError(f"compiled code does not compile ({said[0]})")


def _forget(manifest: Manifest) -> None:
    """Delete all but the libraries that were used last; files that residnet did not write stay."""
    files = [file for name in manifest.read() if (file := manifest.folder / name).is_file()]
    files.sort(key=lambda file: file.stat().st_mtime, reverse=True)
    for file in files[_KEPT:]:
        manifest.remove_if_owned(file)
    # another process may append meanwhile, and its entry would be lost: not after each library
    if manifest.journal.stat().st_size > _LONGEST_JOURNAL:
        manifest.compact()
