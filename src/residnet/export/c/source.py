"""A C99 source file and its header from the programs of a module's functions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from residnet.export.c.arrays import Tables
from residnet.export.c.function import FunctionBody
from residnet.export.c.words import HELPERS
from residnet.export.lowering.program import Program


@dataclass(frozen=True)
class CFunction:
    """A function of the file.

    Attributes:
        name: without the file's prefix.
        about: its comment in the header, one line.
        program: what it does. The first result that is a truth value is what the function returns.
    """

    name: str
    about: str
    program: Program


def identifier(text: str) -> str:
    """Return a name as an identifier of C."""
    plain = re.sub(r"\W", "_", text.lower(), flags=re.ASCII)
    return plain if re.match(r"[a-z]", plain) else f"m_{plain}"


def c_file(
    prefix: str, functions: Sequence[CFunction], extra: Sequence[tuple[str, str]], header: str
) -> str:
    """Return the source file.

    Args:
        prefix: stands before every name of the file.
        functions: in the order in which they stand there.
        extra: prototype and body of further functions that call those.
        header: name of the header file.
    """
    tables = Tables(f"{prefix}_")
    helpers: set[str] = set()
    bodies = []
    for function in functions:
        text, used = _definition(prefix, function, tables)
        bodies.append(text)
        helpers |= used
    bodies += [f"{prototype} {{\n{body}}}\n" for prototype, body in extra]
    made = [f"static REAL {prefix}_{name}{HELPERS[name]}\n" for name in sorted(helpers)]
    parts = (
        f'#include "{header}"\n\n#include <math.h>\n',
        f"#define REAL {prefix}_real\n#define ZERO ((REAL)0)\n#define ONE ((REAL)1)\n"
        f"#ifdef {prefix.upper()}_DOUBLE\n#define R(name) name\n"
        "#else\n#define R(name) name##f\n#endif\n",
        *tables.lines,
        *made,
        *bodies,
    )
    return "\n".join(parts)


def h_file(
    prefix: str,
    functions: Sequence[CFunction],
    extra: Sequence[tuple[str, str]],
    sizes: Mapping[str, tuple[int | str, str]],
    about: str,
    *,
    double_only: bool = False,
) -> str:
    """Return the header file, with the comment that tells how to use it.

    Args:
        prefix: see `c_file`.
        functions: see `c_file`.
        extra: comment and prototype of further functions.
        sizes: value and comment of each constant, by name without prefix.
        about: comment at the top.
        double_only: whether single precision is not offered.
    """
    guard = f"{prefix.upper()}_H"
    comment = "\n".join(f" * {line}".rstrip() for line in about.replace("*/", "* /").splitlines())
    numbers = "\n".join(
        f"#define {prefix.upper()}_{name} {value} /* {text} */"
        for name, (value, text) in sizes.items()
    )
    prototypes = "\n\n".join(
        f"/* {text} */\n{line};"
        for text, line in [
            *((function.about, prototype(prefix, function)) for function in functions),
            *extra,
        ]
    )
    return (
        f"/*\n{comment}\n */\n#ifndef {guard}\n#define {guard}\n\n#include <stddef.h>\n\n"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n'
        f"{_precision(prefix, double_only)}\n{numbers}\n\n{prototypes}\n\n"
        "#ifdef __cplusplus\n}\n#endif\n\n#endif\n"
    )


def _precision(prefix: str, double_only: bool) -> str:
    """Return the lines that say what a real number is."""
    macro = f"{prefix.upper()}_DOUBLE"
    if double_only:
        return (
            f"/* in double precision alone: single would not follow it closely enough */\n"
            f"#ifndef {macro}\n#define {macro}\n#endif\ntypedef double {prefix}_real;\n"
        )
    return (
        f"/* define {macro} for double precision, here and in the source file */\n"
        f"#ifdef {macro}\ntypedef double {prefix}_real;\n"
        f"#else\ntypedef float {prefix}_real;\n#endif\n"
    )


def prototype(prefix: str, function: CFunction) -> str:
    """Return the prototype of a function; arguments first, then where the results go."""
    given = [f"const {prefix}_real *{block.name}" for block in function.program.arguments]
    taken = [
        f"{prefix}_real *{name}" if kind == "real" else f"int *{name}"
        for name, kind, _ in function.program.results
        if name != returned(function.program)
    ]
    kind = "void" if returned(function.program) is None else "int"
    return f"{kind} {prefix}_{function.name}({', '.join(given + taken) or 'void'})"


def returned(program: Program) -> str | None:
    """Return the name of the result that a function returns; None where it returns nothing."""
    return next(
        (name for name, kind, cells in program.results if kind == "flag" and cells.size == 1), None
    )


def _definition(prefix: str, function: CFunction, tables: Tables) -> tuple[str, set[str]]:
    """Return a function in C and the helpers that it calls."""
    program = function.program
    body = FunctionBody(program, tables, f"{prefix}_", f"{prefix}_{function.name}")
    body.write()
    back = returned(program)
    ends: list[str] = []
    for name, _, cells in program.results:
        if name == back:
            continue
        ends += body.stored(name, cells)
    last = []
    if back is not None:
        cells = next(cells for name, _, cells in program.results if name == back)
        last = [f"return {body.cell(int(cells[0]))};"]
    statements = [*body.copies, *body.lines, *ends]
    counters = body.counters("\n".join(statements))
    read = "\n".join([*statements, *last])
    unread = [
        f"(void){block.name};"
        for block in program.arguments
        if not re.search(rf"\b{block.name}\b", read)
    ]
    unread += [
        f"(void){name};" for name, _, cells in program.results if name != back and cells.size == 0
    ]
    lines = [
        *([f"int {', '.join(counters)};"] if counters else []), *unread, *statements, *last
    ]  # fmt: skip
    inside = "".join(f"    {line}\n" for line in lines)
    return f"{prototype(prefix, function)} {{\n{inside}}}\n", body.helpers
