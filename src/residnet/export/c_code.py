"""CasADi functions as C: source and header, and the compiler that checks them."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import casadi as ca

from residnet.core.errors import ExportError
from residnet.dynamics.c_code import Body, Tables, compiler
from residnet.dynamics.lowering import in_numbers

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


_HEADER = """/*
{comment}
 */
#ifndef {guard}
#define {guard}

#include <stddef.h>

#ifdef __cplusplus
extern "C" {{
#endif

{precision}
{numbers}

{prototypes}

#ifdef __cplusplus
}}
#endif

#endif
"""
_EITHER = """/* define {macro} for double precision, here and in the source file */
#ifdef {macro}
typedef double {prefix}_real;
#else
typedef float {prefix}_real;
#endif
"""
_DOUBLE_ALONE = """/* in double precision alone: single would not follow it closely enough */
#ifndef {macro}
#define {macro}
#endif
typedef double {prefix}_real;
"""
_SOURCE = """#include "{header}"

#include <math.h>

#define REAL {prefix}_real
#define ZERO ((REAL)0)
#define ONE ((REAL)1)
#ifdef {macro}
#define R(name) name
#else
#define R(name) name##f
#endif

"""


def c_files(
    prefix: str,
    functions: Sequence[CFunction],
    extra: Sequence[tuple[str, str, str]],
    sizes: Mapping[str, tuple[int | str, str]],
    about: str,
    header: str,
    *,
    double_only: bool = False,
) -> tuple[str, str]:
    """Return the source and the header of functions.

    Args:
        prefix: stands before every name of the file.
        functions: in the order in which they stand there.
        extra: comment, prototype and body of further functions that call those.
        sizes: value and comment of each constant, by name without prefix.
        about: comment at the top of the header, which tells how to use it.
        double_only: whether single precision is not offered.
    """
    tables = Tables(f"{prefix}_")
    bodies = [function.definition(prefix, tables) for function in functions]
    bodies += [f"{prototype} {{\n{body}}}\n" for _, prototype, body in extra]
    names = {"prefix": prefix, "macro": f"{prefix.upper()}_DOUBLE"}
    words = set(re.findall(r"\w+", "\n".join(bodies)))
    used = [text for name, text in tables.lines.items() if name in words]
    source = _SOURCE.format(header=header, **names) + "\n".join((*used, *bodies))
    told = [(function.about, function.prototype(prefix)) for function in functions]
    told += [(comment, prototype) for comment, prototype, _ in extra]
    return source, _HEADER.format(
        comment="\n".join(f" * {x}".rstrip() for x in about.replace("*/", "* /").splitlines()),
        guard=f"{prefix.upper()}_H",
        precision=(_DOUBLE_ALONE if double_only else _EITHER).format(**names),
        numbers="\n".join(
            f"#define {prefix.upper()}_{name} {value} /* {text} */"
            for name, (value, text) in sizes.items()
        ),
        prototypes="\n\n".join(f"/* {text} */\n{line};" for text, line in told),
    )


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


def footprint(source: Path, flags: Sequence[str] = ()) -> dict[str, Any]:
    """Return what a C file takes on this machine, built for size, by the compiler's own account.

    That is the bytes of each function's stack, without those of the C library that it calls, and of
    code and constants. What the tools here do not tell is left out: a compiler without
    `-fstack-usage`, or no `size`.
    """
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made.o"
        call = [compiler(), "-std=c99", "-Os", "-fstack-usage", "-c", *flags, str(source)]
        if subprocess.run([*call, "-o", str(made)], capture_output=True).returncode:
            return {}
        out: dict[str, Any] = {"machine": f"{platform.machine()}, -Os"}
        usage = made.with_suffix(".su")
        if usage.is_file():
            rows = (line.split("\t") for line in usage.read_text().splitlines())
            out["stack_bytes"] = {name.rsplit(":", 1)[-1]: int(size) for name, size, *_ in rows}
        if (tool := shutil.which("size")) is not None:
            told = subprocess.run([tool, str(made)], capture_output=True, text=True).stdout
            # the first column of Berkeley's format holds code and constants
            out["code_bytes"] = int(told.splitlines()[1].split()[0])
        return out
