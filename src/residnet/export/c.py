"""Formats as C: `c`, one C99 source file and its header without a runtime; `casadi`, for MPC; and
`simulink`, a level-2 S-function around the exported C.

Source: MathWorks, "S-Function Callback Methods" and "Guidelines for Writing C MEX S-Functions".
"""

from __future__ import annotations

import ctypes
import json
import math
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, final

import casadi as ca
import numpy as np
import torch

from residnet.core.errors import ExportError, UsageError
from residnet.core.progress import say
from residnet.dynamics.c_code import Body, Tables, compiler, literal
from residnet.dynamics.lowering import in_numbers, lowered
from residnet.dynamics.store import BandTable
from residnet.export.base import (
    Exported,
    Exporter,
    Loaded,
    Numbers,
    filled,
    in_precision,
    name_of,
    write_card,
)
from residnet.export.policy import ExportedController
from residnet.export.vessel import ExportedVessel

_SCALAR: Final = 1100
"""Most operations of a function that is taken apart into operations on single numbers."""


def taken_apart(function: ca.Function) -> ca.Function:
    """Return a function of single numbers where it is small; networks keep their matrices."""
    count = 0
    for k in range(function.n_instructions()):
        if function.instruction_id(k) == ca.OP_MTIMES:
            product = function.instruction_MX(k)
            count += product.numel() * product.dep(1).shape[1]
    if count > _SCALAR:
        return function
    alone = in_numbers(function)
    return alone if alone.n_instructions() <= _SCALAR else function


def identifier(text: str) -> str:
    """Return a name as an identifier of C."""
    plain = re.sub(r"\W", "_", text.lower(), flags=re.ASCII)
    return plain if re.match(r"[a-z]", plain) else f"m_{plain}"


_C_HEADERS: Final = frozenset(
    {
        *("assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits"),
        *("locale", "math", "setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio"),
        *("stdlib", "string", "tgmath", "time", "wchar", "wctype", "simstruc"),
    }
)
"""Headers without `.h` that an exported header must not hide from `#include <...>`."""


def file_prefix(file: Path) -> str:
    """Return what all names of a C file begin with: the file's name as an identifier.

    Two exports with different file names can then be linked into one program.

    Raises:
        UsageError: where the header would hide one of the C library.
    """
    if file.stem.lower() in _C_HEADERS:
        raise UsageError(
            f"{file.name}: its header {file.stem}.h would hide that of the C library; give another"
            " file name with --out"
        )
    return identifier(file.stem)


@dataclass(frozen=True)
class CFunction:
    """A function of a C file.

    Attributes:
        name: without the file's prefix.
        about: its comment in the header.
        function: what it does.
        flags: which of its results are truth values; the first is what the C function returns.
    """

    name: str
    about: str
    function: ca.Function
    flags: Sequence[str] = ()

    def prototype(self, prefix: str) -> str:
        """Return the prototype; arguments first, then where the results go."""
        given = [f"const {prefix}_real *{name}" for name in self.function.name_in()]
        taken = [
            f"{'int' if name in self.flags else f'{prefix}_real'} *{name}"
            for name in self.function.name_out()
            if name not in self.flags[:1]
        ]
        kind = "int" if self.flags else "void"
        return f"{kind} {prefix}_{self.name}({', '.join(given + taken) or 'void'})"

    def definition(self, prefix: str, tables: Tables) -> str:
        """Return the function in C."""
        body = Body(taken_apart(self.function), tables, f"{prefix}_{self.name}")
        names = self.function.name_out()
        ends = [
            f"{name}[{i}] = {cell};"
            for name, cells in zip(names, body.results, strict=True)
            for i, cell in enumerate(cells)
            if name not in self.flags[:1]
        ]
        if self.flags:
            ends.append(f"return {body.results[names.index(self.flags[0])][0]} != ZERO;")
        statements = body.read(ends)
        words = set(re.findall(r"\w+", "\n".join(statements)))
        unread = [
            f"(void){name};"
            for name in (*body.names, *names)
            if name not in words and name not in self.flags[:1]
        ]
        counters = [name for name in "hij" if name in words]
        lines = [*([f"int {', '.join(counters)};"] if counters else []), *unread, *statements]
        inside = "".join(f"    {line}\n" for line in lines)
        return f"{self.prototype(prefix)} {{\n{inside}}}\n"


def c_files(
    prefix: str,
    functions: Sequence[CFunction],
    extra: Sequence[tuple[str, str, str]],
    sizes: Mapping[str, tuple[int | str, str]],
    about: str,
    header: str,
    *,
    double_only: bool = False,
    build: str = "",
) -> tuple[str, str]:
    """Return the source and the header of functions.

    Args:
        prefix: stands before every name of the file.
        functions: in the order in which they stand there.
        extra: comment, prototype and body of further functions that call those.
        sizes: value and comment of each constant, by name without prefix.
        about: comment at the top of the header, which tells how to use it.
        double_only: whether single precision is not offered.
        build: identity of what is exported, which ends in hexadecimal digits; empty for none.
    """
    tables = Tables(f"{prefix}_")
    bodies = [function.definition(prefix, tables) for function in functions]
    bodies += [f"{prototype} {{\n{body}}}\n" for _, prototype, body in extra]
    names = {
        "prefix": prefix,
        "macro": f"{prefix.upper()}_DOUBLE",
        "build": build,
        # a preprocessor compares integers of 32 bits on every platform, and no strings
        "build_number": f"0x{build.rpartition('+')[2][:8]}UL",
    }
    words = set(re.findall(r"\w+", "\n".join(bodies)))
    used = [text for name, text in tables.lines.items() if name in words]
    source = filled("c_source.c", header=header, body="\n".join((*used, *bodies)), **names)
    told = [(function.about, function.prototype(prefix)) for function in functions]
    told += [(comment, prototype) for comment, prototype, _ in extra]
    return source, filled(
        "c_header.h",
        comment="\n".join(f" * {x}".rstrip() for x in _comment(about).splitlines()),
        guard=f"{prefix.upper()}_H",
        double_only=double_only,
        **names,
        numbers="\n".join(
            f"#define {prefix.upper()}_{name} {value} /* {_comment(text)} */"
            for name, (value, text) in sizes.items()
        ),
        prototypes="\n\n".join(f"/* {_comment(text)} */\n{line};" for text, line in told),
    )


def _comment(text: str) -> str:
    """Return a text that cannot end the comment in which it stands."""
    return text.replace("*/", "* /").replace("/*", "/ *")


STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
"""Flags under which every exported file compiles without a warning."""


def compile_shared(
    sources: Sequence[Path], out: Path, flags: Sequence[str] = (), tool: str = ""
) -> Path:
    """Compile C files to a shared library, without a single warning.

    Args:
        flags: of the compiler, beside its usual ones.
        tool: the compiler; empty for that of this machine.

    Raises:
        ExportError: with the compiler's first complaint.
    """
    # all code for Windows is independent of its position, and the flag a warning there
    own = () if out.suffix == ".dll" else ("-fPIC",)
    call = [tool or compiler(), "-O2", *STRICT, "-shared", *own, *flags, *map(str, sources)]
    done = subprocess.run([*call, "-o", str(out), "-lm"], capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        said = next((line for line in lines if "error" in line), "no message")
        raise ExportError(f"{sources[0].name}: does not compile ({said})")
    return out


STACK_LIMIT: Final = 4096
"""Bytes of stack above which an export warns: a usual task of a real-time system has no more."""
CODE_LIMIT: Final = 262_144
"""Bytes of code and constants above which an export warns: the flash of a small controller."""


def footprint(source: Path) -> dict[str, Any]:
    """Return the stack and the size of a C file on this machine, built for size.

    Stack is measured by `-fstack-usage`, size by `size`. What the tools here do not measure is
    estimated from the source: arrays in memory, four bytes for each operation and constant.

    Returns:
        `machine`; `stack_bytes` of each function without those that it calls; `largest_stack_bytes`
        of a call with the functions of the file that it calls, those of the C library aside;
        `code_bytes` of code and constants; `stack_from` and `code_from`, the tool or "estimate".
    """
    text = source.read_text()
    bodies = function_bodies(text)
    stack = {name: estimated_stack(body) for name, body in bodies.items()}
    code = estimated_code(text)
    stack_from = code_from = "estimate"
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made.o"
        try:
            tool = compiler()
        except ExportError:
            tool = ""
        call = [tool, "-std=c99", "-Os", "-c", str(source), "-o", str(made)]
        # a compiler that does not know the flag may still tell the size
        for flags in (["-fstack-usage"], []) if tool else ():
            if subprocess.run([*call, *flags], capture_output=True).returncode == 0:
                break
        usage = made.with_suffix(".su")
        if usage.is_file():
            rows = (line.split("\t") for line in usage.read_text().splitlines())
            stack = {name.rsplit(":", 1)[-1]: int(size) for name, size, *_ in rows}
            stack_from = f"{Path(tool).name} -Os -fstack-usage"
        if made.is_file() and (program := shutil.which("size")) is not None:
            lines = subprocess.run([program, str(made)], capture_output=True, text=True).stdout
            # the first column of Berkeley's format holds code and constants
            code = int(lines.splitlines()[1].split()[0])
            code_from = f"{Path(tool).name} -Os, size"
    return {
        "machine": f"{platform.machine()}, -Os",
        "stack_bytes": stack,
        "largest_stack_bytes": deepest_stack(stack, bodies),
        "stack_from": stack_from,
        "code_bytes": code,
        "code_from": code_from,
    }


_SPILLED: Final = 32
"""Single numbers of a function that an estimate puts on the stack; registers hold the others."""


def function_bodies(text: str) -> dict[str, str]:
    """Return the body of each function of a written C file by its name."""
    found = re.finditer(r"^(?!#)[\w ]+ \*?(\w+)\([^;{]*\) \{\n(.*?)^\}$", text, re.M | re.S)
    return {match[1]: match[2] for match in found}


def estimated_stack(body: str) -> int:
    """Return an estimate of the bytes of stack that the body of a function takes."""
    locals_ = re.findall(r"^\s*(?:const )?(?:REAL|int|size_t|\w+_real) ([^=;(]+)", body, re.M)
    names = [name for declared in locals_ for name in declared.split(",")]
    arrays = [re.findall(r"\[(\d+)\]", name) for name in names]
    sizes = [math.prod(map(int, size)) for size in arrays if size]
    # a compiler holds few single numbers in memory at a time, however many there are in the source
    single = min(len(names) - len(sizes), _SPILLED)
    # 64 bytes for the return address and saved registers
    return 64 + 8 * (sum(sizes) + single)


def estimated_code(text: str) -> int:
    """Return an estimate of the bytes of code and constants of a C file."""
    return 4 * len(re.findall(r"[-+*/=<>(]|\b\d[\w.]*", text))


def deepest_stack(stack: Mapping[str, int], bodies: Mapping[str, str]) -> int:
    """Return the most bytes of stack of a call with all calls within the file that it makes."""

    def depth(name: str) -> int:
        called = set(re.findall(r"\b(\w+)\(", bodies.get(name, ""))) & (stack.keys() - {name})
        return stack[name] + max(map(depth, called), default=0)

    return max(map(depth, stack), default=0)


def report_footprint(what: str, size: Mapping[str, Any]) -> list[str]:
    """Report stack and size to the user before a file is written; return the warnings."""
    stack, code = size["largest_stack_bytes"], size["code_bytes"]
    say(
        f"  {what}: {stack:,} bytes of stack ({size['stack_from']}), {code:,} bytes of code and"
        f" constants ({size['code_from']}) on {size['machine']}"
    )
    warnings = []
    if stack > STACK_LIMIT:
        warnings.append(
            f"{stack:,} bytes of stack exceed {STACK_LIMIT:,}, the stack of a usual real-time task;"
            " enlarge the task's stack or export a smaller model"
        )
    if code > CODE_LIMIT:
        warnings.append(
            f"{code:,} bytes of code and constants exceed {CODE_LIMIT:,}, the flash of a small"
            " controller; export a smaller model"
        )
    for warning in warnings:
        say(f"  warning: {warning}")
    return warnings


_STEP = {
    "vessel": "state and memory one step later; returns 1 where anything was outside the training"
    "\n * range or no number, else 0; results may go where arguments came from",
    "policy": "command, s_after once per step; returns 1 where a measurement, the reference"
    "\n * or the memory was wrong, else 0; results may go where arguments came from",
    "force": "the force that a motion needs; returns 1 where it was outside the training range or"
    "\n * no number, else 0",
}


class CSource(NamedTuple):
    """The two files of what is exported.

    Attributes:
        prefix: of all names in them.
        source: text of the .c file.
        header: text of the .h file.
    """

    prefix: str
    source: str
    header: str


def c_source(
    exported: Exported,
    card: Mapping[str, Any],
    header: str,
    prefix: str,
    *,
    double_only: bool = False,
) -> CSource:
    """Return source and header.

    Args:
        card: stands as a comment in the header.
        header: name of the header.
        prefix: of all names, see `file_prefix`.
        double_only: whether single precision is not offered.

    Raises:
        ExportError: where there is an operation that is not written in C.
    """
    what = exported.what
    functions: list[CFunction] = []
    extra: list[tuple[str, str, str]] = []
    sizes: dict[str, tuple[int | str, str]] = {
        f"SIZE_{name.upper()}": (size, f"entries of {name}") for name, size in exported.arguments
    }
    # what is found in double precision is written for both
    step = lowered(exported.graph(torch.float64), exported.arguments, exported.results, what)
    kind, told = "force", "a feed-forward, written by residnet. All arrays are the caller's."
    if isinstance(exported, ExportedVessel):
        kind = "vessel"
        told = (
            "a vessel model, written by residnet. All arrays are the caller's; nothing is"
            "\nallocated, nothing is kept between calls.\n\nx [STATES] state, w [INPUTS] inputs"
            " held over the step, s [MEMORY] memory."
        )
        guarded = exported.guarded(torch.float64)
        measured = lowered(guarded.measured, exported.arguments[:2], ["good"], what)
        about = "1 where every entry of a state and its inputs is a measurement, else 0"
        functions.append(CFunction("measured", about, measured, ["good"]))
        extra = _vessel_functions(prefix, exported)
        units = {key: ", ".join(f"{e['name']} {e['unit']}" for e in card[key]) for key in
                 ("states", "inputs")}  # fmt: skip
        counts = [count for _, count in exported.arguments]
        sizes = {
            "STATES": (counts[0], units["states"]),
            "INPUTS": (counts[1], units["inputs"]),
            "MEMORY": (counts[2], "entries of the memory s"),
        }
    elif isinstance(exported, ExportedController):
        kind, told = "policy", "a policy, written by residnet. All arrays are the caller's."
        begun = lowered(
            exported.controller(torch.float64).initial_state, exported.arguments[:1], ["s"], what
        )
        functions.append(CFunction("initial_state", "memory at the first measurement", begun))
    functions.append(CFunction("step", _STEP[kind], step, exported.flags))
    if exported.dt is not None:
        sizes["DT"] = (repr(float(exported.dt)), "step in s")
    about = f"{exported.name}: {told}\n\n{json.dumps(card, indent=1)}"
    build = card["build"]["identity"]
    files = c_files(
        prefix, functions, extra, sizes, about, header, double_only=double_only, build=build
    )
    return CSource(prefix, *files)


def _vessel_functions(prefix: str, exported: ExportedVessel) -> list[tuple[str, str, str]]:
    """Return comment, prototype and body of the memory's functions and of the band."""
    upper, real = prefix.upper(), f"{prefix}_real"
    memory = exported.model.n_state > 0
    begin = f"    size_t k;\n    for (k = 0; k < {upper}_MEMORY; k++) s[k] = 0;\n"
    unread = "    (void)x;\n    (void)w;\n    (void)count;\n    (void)s;\n"
    table: BandTable | None = exported.spec.band
    steps = (1,) if table is None else table.steps
    banded = exported.spec.signals.live.layout.banded
    rows = [(math.inf,) * len(banded)] if table is None else list(zip(*table.columns, strict=True))
    widths = ["{" + ", ".join(map(literal, row)) + "}" for row in rows]
    band = filled("c_band.c", steps=steps, widths=widths, channels=len(banded))
    return [
        (
            "memory without a past",
            f"void {prefix}_initial_state({real} *s)",
            begin if memory else "    (void)s;\n",
        ),
        (
            "memory that a measured past leaves: count states and inputs, oldest first",
            f"void {prefix}_warmup(const {real} *x, const {real} *w, size_t count, {real} *s)",
            filled("c_warmup.c", p=prefix, P=upper) if memory else unread,
        ),
        (
            f"half widths of {', '.join(banded)} k steps after a measured state: between"
            "\n * steps of the table interpolated, beyond the last in proportion to time, infinite"
            "\n * without a table",
            f"void {prefix}_band(int k, {real} *half)",
            band,
        ),
    ]


class CompiledModel(Loaded):
    """An exported C file as a library; `prefix` is that of its names."""

    def __init__(
        self, library: Path, exported: Exported, dtype: torch.dtype, prefix: str
    ) -> None:
        self.real: Any = np.float64 if dtype == torch.float64 else np.float32
        self.exported, self.prefix = exported, prefix
        self.library = ctypes.CDLL(str(library))
        self.outputs = self._sizes()

    def _sizes(self) -> dict[str, int]:
        """Return the sizes of the results."""
        given = [torch.zeros(1, size, dtype=torch.float64) for _, size in self.exported.arguments]
        with torch.no_grad():
            found = self.exported.graph(torch.float64)(*given)
        return {name: part.numel() for name, part in zip(self.exported.results, found, strict=True)}

    def _call(self, name: str, *given: np.ndarray | int) -> int:
        function = getattr(self.library, f"{self.prefix}_{name}")
        function.restype = ctypes.c_int
        return int(
            function(
                *(
                    ctypes.c_size_t(part) if isinstance(part, int) else
                    ctypes.c_void_p(part.ctypes.data)
                    for part in given
                )
            )
        )  # fmt: skip

    def step(self, *given: Numbers) -> tuple[Any, ...]:
        flags = self.exported.flags
        out = {
            name: np.zeros(size, np.int32 if name in flags else self.real)
            for name, size in self.outputs.items()
            if name not in flags[:1]
        }
        rows = [np.ascontiguousarray(part, dtype=self.real) for part in given]
        returned = self._call("step", *rows, *out.values())
        found = out | {name: np.array([returned]) for name in flags[:1]}
        return tuple(
            bool(found[name][0]) if name in flags else found[name] for name in self.exported.results
        )

    def memory(self, *past: Numbers) -> Numbers | None:
        s = np.zeros(self.exported.arguments[-1][1], self.real)
        rows = [np.ascontiguousarray(part, dtype=self.real) for part in past]
        if len(rows) > 1:
            self._call("warmup", *rows, len(rows[0]), s)
        else:
            self._call("initial_state", *rows, s)
        return s


@final
class CExporter(Exporter):
    """One C99 source file and its header: no runtime, no allocation, no global state."""

    name: ClassVar[str] = "c"
    suffix: ClassVar[str] = ".c"
    about: ClassVar[str] = "The model as one C99 file and header, without any runtime."
    default_name_from_run: ClassVar[bool] = True

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write source, header and card, checked in single and in double precision.

        Where single precision does not determine the track, the file is in double precision alone.
        """
        exported.require_numbers()
        # a header that is asked for names the pair
        file = file.with_suffix(self.suffix) if file.suffix == ".h" else file
        prefix = file_prefix(file)
        card = exported.card() | {
            "format": "c",
            "dtype": "float32; float64 with the macro _DOUBLE",
            "safety": "The file is source code: compile only what you trust.",
        }
        with tempfile.TemporaryDirectory() as name:
            partial = Path(name) / file.name

            def attempt(dtype: torch.dtype) -> tuple[CSource, dict[str, Any]]:
                double_only = dtype == torch.float64
                told = card | {"dtype": name_of(dtype)} if double_only else card
                header = partial.with_suffix(".h")
                written = c_source(exported, told, header.name, prefix, double_only=double_only)
                partial.write_text(written.source)
                header.write_text(written.header)
                macro = [f"-D{written.prefix.upper()}_DOUBLE"]
                parity = {}
                for each in exported.precisions[exported.precisions.index(dtype) :]:
                    precision = "double" if each == torch.float64 else "single"
                    library = partial.with_name(f"{precision}.so")
                    compile_shared([partial], library, macro if precision == "double" else [])
                    parity[precision] = exported.check(
                        CompiledModel(library, exported, each, prefix),
                        f"the C file in {precision} precision",
                        each,
                    )
                return written, parity

            dtype, (written, parity) = in_precision(exported, attempt)
            if dtype == torch.float64:
                card |= {"dtype": name_of(dtype)}
            size = footprint(partial)
            size["warnings"] = report_footprint(file.name, size)
            card |= {"size": size, "parity": parity}
            write_card(file, card)
            file.with_suffix(".h").write_text(written.header)
            file.write_text(written.source)
        return card


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
            write_card(file, card)
            file.write_bytes(partial.read_bytes())
        return card


def s_function(exported: Exported, prefix: str, name: str, sizes: Mapping[str, int]) -> str:
    """Return the source of the S-function of a vessel or a controller.

    A vessel's output is its state, which it keeps beside the memory, and its flags; a controller's
    its first result and the flags.

    Args:
        exported: with its step.
        prefix: of the functions in the C file.
        sizes: of the step's results.
    """
    given = dict(exported.arguments)
    vessel = isinstance(exported, ExportedVessel)
    held = [given.pop(name) for name in (("x", "s") if vessel else ("s",))]
    out = "x" if vessel else next(one for one in exported.results if one in sizes)
    return filled(
        "s_function.c",
        about=exported.what,
        vessel=vessel,
        prefix=prefix,
        name=name,
        dt=repr(float(exported.dt or 0.0)),
        ports=list(given.items()),
        out=out,
        width=held[0] if vessel else sizes[out],
        flags=exported.flags,
        memory=held[-1],
        kept=sum(held),
    )


@final
class SimulinkExporter(Exporter):
    """A level-2 S-function in double precision, with the C that it calls."""

    name: ClassVar[str] = "simulink"
    suffix: ClassVar[str] = "_sfun.c"
    about: ClassVar[str] = "A level-2 S-function for Simulink around the C code."
    default_name_from_run: ClassVar[bool] = True

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write the S-function, the C file and header that it calls, and the card."""
        if exported.dt is None:
            raise UsageError(f"{exported.what}: has no step of its own; export it as c")
        exported.require_numbers()
        name = identifier(file.stem)
        file = file.with_name(f"{name}.c")
        card = exported.card() | {
            "format": self.name,
            "dtype": "float64",
            "safety": "The file is source code: compile only what you trust.",
        }
        prefix = f"{name}_model"
        written = c_source(exported, card, f"{prefix}.h", prefix, double_only=True)
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder) / f"{name}_model.c"
            partial.write_text(written.source)
            partial.with_suffix(".h").write_text(written.header)
            library = compile_shared([partial], partial.with_suffix(".so"))
            loaded = CompiledModel(library, exported, torch.float64, prefix)
            parity = exported.check(loaded, "the S-function's code", torch.float64)
            size = footprint(partial)
            size["warnings"] = report_footprint(partial.name, size)
            card |= {"size": size, "parity": parity}
        text = s_function(exported, written.prefix, name, loaded.outputs)
        write_card(file, card)
        file.with_name(f"{name}_model.c").write_text(written.source)
        file.with_name(f"{name}_model.h").write_text(written.header)
        file.write_text(text)
        return card
