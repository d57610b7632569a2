"""Formats as C: `c`, one C99 source file and its header without a runtime; `casadi`, for MPC."""

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
from residnet.core.progress import log_message
from residnet.dynamics.store import BandTable
from residnet.engine.c_code import FunctionWriter, Tables, find_compiler, write_literal
from residnet.engine.lowering import lower, to_scalar_function
from residnet.export.base import (
    Exportable,
    Exporter,
    LoadedExport,
    NumberArray,
    get_dtype_name,
    render_template,
    run_in_sufficient_precision,
    write_card,
)
from residnet.export.vessel import ExportedVessel

_MAX_SCALAR_OPERATIONS: Final = 1100
"""Maximum number of operations of a function that is expanded into scalar operations."""


def expand_if_small(function: ca.Function) -> ca.Function:
    """Expand a small function into scalar operations; networks keep their matrices."""
    n_operations = 0
    for k in range(function.n_instructions()):
        if function.instruction_id(k) == ca.OP_MTIMES:
            product = function.instruction_MX(k)
            n_operations += product.numel() * product.dep(1).shape[1]
    if n_operations > _MAX_SCALAR_OPERATIONS:
        return function
    expanded = to_scalar_function(function)
    return expanded if expanded.n_instructions() <= _MAX_SCALAR_OPERATIONS else function


def to_c_identifier(text: str) -> str:
    """Return a text in lower case with underscores for all characters that C does not allow."""
    cleaned = re.sub(r"\W", "_", text.lower(), flags=re.ASCII)
    return cleaned if re.match(r"[a-z]", cleaned) else f"m_{cleaned}"


_C_HEADERS: Final = frozenset(
    {
        *("assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits"),
        *("locale", "math", "setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio"),
        *("stdlib", "string", "tgmath", "time", "wchar", "wctype", "simstruc"),
    }
)
"""Headers without `.h` that an exported header must not hide from `#include <...>`."""


def make_symbol_prefix(file: Path) -> str:
    """Return the prefix of all names in a C file: the stem of the file as a C identifier.

    Two exports with different file names can then be linked into one program.

    Raises:
        UsageError: if the header would hide a header of the C library.
    """
    if file.stem.lower() in _C_HEADERS:
        raise UsageError(
            f"{file.name}: its header {file.stem}.h would hide that of the C library; give another"
            " file name with --out"
        )
    return to_c_identifier(file.stem)


@dataclass(frozen=True)
class CFunction:
    """A function of a C file.

    Attributes:
        name: name without the prefix of the file.
        comment: comment of the function in the header.
        function: CasADi function that the C function evaluates.
        flags: Boolean results; the first one is the return value of the C function.
    """

    name: str
    comment: str
    function: ca.Function
    flags: Sequence[str] = ()

    def render_prototype(self, prefix: str) -> str:
        """Return the prototype: the arguments, then pointers to the results."""
        inputs = [f"const {prefix}_real *{name}" for name in self.function.name_in()]
        outputs = [
            f"{'int' if name in self.flags else f'{prefix}_real'} *{name}"
            for name in self.function.name_out()
            if name not in self.flags[:1]
        ]
        return_type = "int" if self.flags else "void"
        return f"{return_type} {prefix}_{self.name}({', '.join(inputs + outputs) or 'void'})"

    def render_definition(self, prefix: str, tables: Tables) -> str:
        """Return the C code of the function, and add its constant arrays to `tables`."""
        statement_writer = FunctionWriter(
            expand_if_small(self.function), tables, f"{prefix}_{self.name}"
        )
        names = self.function.name_out()
        store_statements = [
            f"{name}[{i}] = {value};"
            for name, values in zip(names, statement_writer.results, strict=True)
            for i, value in enumerate(values)
            if name not in self.flags[:1]
        ]
        if self.flags:
            store_statements.append(
                f"return {statement_writer.results[names.index(self.flags[0])][0]} != ZERO;"
            )
        statements = statement_writer.used_statements(store_statements)
        used_words = set(re.findall(r"\w+", "\n".join(statements)))
        unused_argument_statements = [
            f"(void){name};"
            for name in (*statement_writer.names, *names)
            if name not in used_words and name not in self.flags[:1]
        ]
        counters = [name for name in "hij" if name in used_words]
        lines = [
            *([f"int {', '.join(counters)};"] if counters else []),
            *unused_argument_statements,
            *statements,
        ]
        indented_lines = "".join(f"    {line}\n" for line in lines)
        return f"{self.render_prototype(prefix)} {{\n{indented_lines}}}\n"


def render_c_files(
    prefix: str,
    functions: Sequence[CFunction],
    extra_functions: Sequence[tuple[str, str, str]],
    constants: Mapping[str, tuple[int | str, str]],
    header_comment: str,
    header: str,
    *,
    is_double_only: bool = False,
    build: str = "",
) -> tuple[str, str]:
    """Return source and header of a C file with the given functions.

    Args:
        prefix: prefix of every name in the file.
        functions: functions in the order of the file.
        extra_functions: comment, prototype and body of further functions that call `functions`.
        constants: value and comment of each constant, by name without prefix.
        header_comment: comment at the top of the header that explains its use.
        header: name of the header, which the source includes.
        is_double_only: whether only double precision is supported.
        build: version and hash of the exported model, which ends in hexadecimal digits; empty for
            none.
    """
    tables = Tables(f"{prefix}_")
    definitions = [function.render_definition(prefix, tables) for function in functions]
    definitions += [f"{prototype} {{\n{body}}}\n" for _, prototype, body in extra_functions]
    template_names = {
        "prefix": prefix,
        "macro": f"{prefix.upper()}_DOUBLE",
        "build": build,
        # a preprocessor compares integers of 32 bits on every platform, and no strings
        "build_number": f"0x{build.rpartition('+')[2][:8]}UL",
    }
    used_words = set(re.findall(r"\w+", "\n".join(definitions)))
    used_tables = [table_line for name, table_line in tables.lines.items() if name in used_words]
    source = render_template(
        "c_source.c", header=header, body="\n".join((*used_tables, *definitions)), **template_names
    )
    declarations = [(function.comment, function.render_prototype(prefix)) for function in functions]
    declarations += [(comment, prototype) for comment, prototype, _ in extra_functions]
    return source, render_template(
        "c_header.h",
        comment="\n".join(
            f" * {comment_line}".rstrip()
            for comment_line in escape_comment(header_comment).splitlines()
        ),
        guard=f"{prefix.upper()}_H",
        double_only=is_double_only,
        **template_names,
        numbers="\n".join(
            f"#define {prefix.upper()}_{name} {value} /* {escape_comment(entry_comment)} */"
            for name, (value, entry_comment) in constants.items()
        ),
        prototypes="\n\n".join(
            f"/* {escape_comment(entry_comment)} */\n{prototype_line};"
            for entry_comment, prototype_line in declarations
        ),
    )


def escape_comment(text: str) -> str:
    """Return a text that cannot terminate a C comment."""
    return text.replace("*/", "* /").replace("/*", "/ *")


STRICT_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
"""Flags under which every exported file compiles without a warning."""


def compile_shared_library(
    sources: Sequence[Path], library_path: Path, flags: Sequence[str] = (), compiler_path: str = ""
) -> Path:
    """Compile C files to a shared library, without a single warning.

    Args:
        flags: additional compiler flags.
        compiler_path: path of the compiler; empty for the default compiler.

    Raises:
        ExportError: if the compiler gives an error or a warning; the message contains the first
            one.
    """
    # code for Windows is always position-independent; compilers warn about the flag there
    position_flags = () if library_path.suffix == ".dll" else ("-fPIC",)
    command = [
        compiler_path or find_compiler(),
        "-O2",
        *STRICT_FLAGS,
        "-shared",
        *position_flags,
        *flags,
        *map(str, sources),
    ]
    completed = subprocess.run(
        [*command, "-o", str(library_path), "-lm"], capture_output=True, text=True
    )
    if completed.returncode:
        lines = completed.stderr.strip().splitlines()
        error_line = next((line for line in lines if "error" in line), "no message")
        raise ExportError(f"{sources[0].name}: does not compile ({error_line})")
    return library_path


STACK_LIMIT: Final = 4096
"""Bytes of stack above which an export warns: a usual task of a real-time system has no more."""
CODE_LIMIT: Final = 262_144
"""Bytes of code and constants above which an export warns: the flash of a small controller."""


def measure_footprint(source: Path) -> dict[str, Any]:
    """Return stack and code size of a C file compiled for size on this machine.

    The stack is measured with `-fstack-usage` and the code with `size`. Without these tools both
    are estimated from the source: local arrays, and four bytes per operation and constant.

    Returns:
        `machine`; `stack_bytes` of each function without its callees; `largest_stack_bytes` of the
        deepest call chain within the file (without the C library); `code_bytes` of code and
        constants; `stack_from` and `code_from`, the tool or "estimate".
    """
    text = source.read_text()
    bodies = parse_function_bodies(text)
    stack = {name: estimate_stack(body) for name, body in bodies.items()}
    code = estimate_code_size(text)
    stack_from = code_from = "estimate"
    with tempfile.TemporaryDirectory() as folder:
        object_file = Path(folder) / "footprint.o"
        try:
            compiler = find_compiler()
        except ExportError:
            compiler = ""
        command = [compiler, "-std=c99", "-Os", "-c", str(source), "-o", str(object_file)]
        # a compiler without this flag can still compile the file, whose size is then measured
        for flags in (["-fstack-usage"], []) if compiler else ():
            if subprocess.run([*command, *flags], capture_output=True).returncode == 0:
                break
        stack_file = object_file.with_suffix(".su")
        if stack_file.is_file():
            usage_rows = (line.split("\t") for line in stack_file.read_text().splitlines())
            stack = {name.rsplit(":", 1)[-1]: int(size) for name, size, *_ in usage_rows}
            stack_from = f"{Path(compiler).name} -Os -fstack-usage"
        if object_file.is_file() and (size_program := shutil.which("size")) is not None:
            lines = subprocess.run(
                [size_program, str(object_file)], capture_output=True, text=True
            ).stdout
            # the first column of Berkeley's format holds code and constants
            code = int(lines.splitlines()[1].split()[0])
            code_from = f"{Path(compiler).name} -Os, size"
    return {
        "machine": f"{platform.machine()}, -Os",
        "stack_bytes": stack,
        "largest_stack_bytes": measure_deepest_stack(stack, bodies),
        "stack_from": stack_from,
        "code_bytes": code,
        "code_from": code_from,
    }


_TIMING_PROGRAM: Final = """#include <stdio.h>
#include <time.h>
int {function}();
{arrays}
int main(void) {{
  long count = 16;
  for (;;) {{
    struct timespec start, end;
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (long i = 0; i < count; i++) {function}({names});
    clock_gettime(CLOCK_MONOTONIC, &end);
    double seconds = (end.tv_sec - start.tv_sec) + 1e-9 * (end.tv_nsec - start.tv_nsec);
    if (seconds > 0.02 || count > 100000000L) {{ printf("%.9g\\n", seconds / count); return 0; }}
    count *= 2;
  }}
}}
"""
"""Program that repeats a step at zero state and inputs for at least 20 ms."""


def measure_step_time(library: Path, function: str, sizes: Sequence[int]) -> float | None:
    """Return the seconds of one call of a C function on this machine; None without POSIX clocks.

    Args:
        library: the compiled C file, a shared library.
        function: name of the function.
        sizes: number of entries of each array that the function takes, in order.
    """
    names = [f"a{number}" for number in range(len(sizes))]
    arrays = [
        f"static double {name}[{max(size, 1)}];" for name, size in zip(names, sizes, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        main = Path(folder) / "timing.c"
        main.write_text(
            _TIMING_PROGRAM.format(
                function=function, arrays="\n".join(arrays), names=", ".join(names)
            )
        )
        program = Path(folder) / "timing"
        # the header of the clock is POSIX, not C99
        command = [find_compiler(), "-std=gnu99", "-O2", "-w", str(main), str(library.resolve())]
        compiled = subprocess.run([*command, "-o", str(program), "-lm"], capture_output=True)
        if compiled.returncode:
            return None
        completed = subprocess.run([str(program)], capture_output=True, text=True)
    return float(completed.stdout) if completed.returncode == 0 else None


_MAX_SPILLED_SCALARS: Final = 32
"""Maximum number of scalar variables that the estimate places on the stack; the other scalars are
assumed to be in registers.
"""


def parse_function_bodies(text: str) -> dict[str, str]:
    """Return the body of each function of a written C file by its name."""
    matches = re.finditer(r"^(?!#)[\w ]+ \*?(\w+)\([^;{]*\) \{\n(.*?)^\}$", text, re.M | re.S)
    return {match[1]: match[2] for match in matches}


def estimate_stack(body: str) -> int:
    """Estimate the stack in bytes that the body of a function needs."""
    declarations = re.findall(r"^\s*(?:const )?(?:REAL|int|size_t|\w+_real) ([^=;(]+)", body, re.M)
    names = [name for declaration in declarations for name in declaration.split(",")]
    arrays = [re.findall(r"\[(\d+)\]", name) for name in names]
    sizes = [math.prod(map(int, size)) for size in arrays if size]
    # a compiler keeps few scalars in memory at a time, however many the source has
    n_scalars = min(len(names) - len(sizes), _MAX_SPILLED_SCALARS)
    # 64 bytes for the return address and saved registers
    return 64 + 8 * (sum(sizes) + n_scalars)


def estimate_code_size(text: str) -> int:
    """Estimate the size in bytes of the code and the constants of a C file."""
    return 4 * len(re.findall(r"[-+*/=<>(]|\b\d[\w.]*", text))


def measure_deepest_stack(stack: Mapping[str, int], bodies: Mapping[str, str]) -> int:
    """Return the stack in bytes of the deepest call chain within the file."""

    def depth(name: str) -> int:
        called_names = set(re.findall(r"\b(\w+)\(", bodies.get(name, ""))) & (stack.keys() - {name})
        return stack[name] + max(map(depth, called_names), default=0)

    return max(map(depth, stack), default=0)


def measure_c_export(exported: Exportable) -> dict[str, Any]:
    """Return stack, code and memory of the C export of a model without writing it.

    Args:
        exported: the model; its export is not checked.
    """
    card = exported.build_card() | {"format": "c"}
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "model.c"
        c_files = generate_c_source(exported, card, "model.h", "model")
        path.write_text(c_files.source)
        path.with_suffix(".h").write_text(c_files.header)
        return measure_footprint(path) | {"memory_bytes": measure_memory(exported)}


def measure_memory(exported: Exportable) -> int:
    """Return the bytes that a program keeps between two steps: state and memory in float."""
    return _FLOAT_BYTES * sum(n_entries for name, n_entries in exported.arguments if name != "w")


_FLOAT_BYTES = 4
"""Size of a single-precision number in bytes."""


def report_footprint(file_name: str, footprint: Mapping[str, Any]) -> list[str]:
    """Log the stack and size of a file and return the warnings.

    Args:
        file_name: name of the C file.
        footprint: result of `measure_footprint`, with `memory_bytes` and `step_seconds`.
    """
    stack = footprint["largest_stack_bytes"]
    code = footprint["code_bytes"]
    log_message(
        f"  {file_name}: {stack:,} bytes of stack ({footprint['stack_from']}), {code:,} bytes of"
        f" code and constants ({footprint['code_from']}), {footprint['memory_bytes']:,} bytes of"
        f" memory between steps{_describe_step_time(footprint)} on {footprint['machine']}"
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
        log_message(f"  warning: {warning}")
    return warnings


def _describe_step_time(footprint: Mapping[str, Any]) -> str:
    """Return the time of one step in words; empty if it was not measured."""
    seconds = footprint.get("step_seconds")
    return "" if seconds is None else f", {1e6 * seconds:.2g} us per step"


_STEP_COMMENTS = {
    "vessel": "state and memory one step later; returns 1 where anything was outside the training"
    "\n * range or no number, else 0; results may go where arguments came from",
    "policy": "command, s_after once per step; returns 1 where a measurement, the reference"
    "\n * or the memory was wrong, else 0; results may go where arguments came from",
    "force": "the force that a motion needs; returns 1 where it was outside the training range or"
    "\n * no number, else 0",
}


class CSource(NamedTuple):
    """Source and header of an exported step.

    Attributes:
        prefix: prefix of all names.
        source: text of the .c file.
        header: text of the .h file.
    """

    prefix: str
    source: str
    header: str


def generate_c_source(
    exported: Exportable,
    card: Mapping[str, Any],
    header: str,
    prefix: str,
    *,
    is_double_only: bool = False,
) -> CSource:
    """Generate the C source and the header of a model, policy or force model.

    Args:
        exported: the exported object.
        card: model card, written as a comment into the header.
        header: name of the header.
        prefix: prefix of all names, see `make_symbol_prefix`.
        is_double_only: whether single precision is not offered.

    Raises:
        ExportError: if an operation has no C equivalent.
    """
    label = exported.label
    functions: list[CFunction] = []
    extra_functions: list[tuple[str, str, str]] = []
    constants: dict[str, tuple[int | str, str]] = {
        f"SIZE_{name.upper()}": (n_entries, f"entries of {name}")
        for name, n_entries in exported.arguments
    }
    # the code is traced in double precision, and the macro of the file selects its precision
    step_function = lower(
        exported.build_step_module(torch.float64), exported.arguments, exported.results, label
    )
    description_key = "force"
    introduction = "a feed-forward, written by residnet. All arrays are the caller's."
    if isinstance(exported, ExportedVessel):
        description_key = "vessel"
        introduction = (
            "a vessel model, written by residnet. All arrays are the caller's; nothing is"
            "\nallocated, nothing is kept between calls.\n\nx [STATES] state, w [INPUTS] inputs"
            " held over the step, s [MEMORY] memory."
        )
        guarded = exported.guard_model(torch.float64)
        measured_function = lower(guarded.is_measurement, exported.arguments[:2], ["good"], label)
        function_comment = "1 where every entry of a state and its inputs is a measurement, else 0"
        functions.append(CFunction("measured", function_comment, measured_function, ["good"]))
        extra_functions = _render_vessel_functions(prefix, exported)
        unit_texts = {
            key: ", ".join(f"{entry['name']} {entry['unit']}" for entry in card[key])
            for key in ("states", "inputs")
        }
        argument_sizes = [argument_size for _, argument_size in exported.arguments]
        constants = {
            "STATES": (argument_sizes[0], unit_texts["states"]),
            "INPUTS": (argument_sizes[1], unit_texts["inputs"]),
            "MEMORY": (argument_sizes[2], "entries of the memory s"),
        }
    elif (initial_state := exported.build_initial_state(torch.float64)) is not None:
        description_key = "policy"
        introduction = "a policy, written by residnet. All arrays are the caller's."
        initial_function = lower(initial_state, exported.arguments[:1], ["s"], label)
        functions.append(
            CFunction("initial_state", "memory at the first measurement", initial_function)
        )
    functions.append(
        CFunction("step", _STEP_COMMENTS[description_key], step_function, exported.flags)
    )
    if exported.dt is not None:
        constants["DT"] = (repr(float(exported.dt)), "step in s")
    header_comment = f"{exported.name}: {introduction}\n\n{json.dumps(card, indent=1)}"
    build = card["build"]["identity"]
    file_texts = render_c_files(
        prefix,
        functions,
        extra_functions,
        constants,
        header_comment,
        header,
        is_double_only=is_double_only,
        build=build,
    )
    return CSource(prefix, *file_texts)


def _render_vessel_functions(prefix: str, exported: ExportedVessel) -> list[tuple[str, str, str]]:
    """Return comment, prototype and body of the functions of the memory and of the band."""
    prefix_upper = prefix.upper()
    real_type = f"{prefix}_real"
    has_memory = exported.model.n_state > 0
    zero_loop = f"    size_t k;\n    for (k = 0; k < {prefix_upper}_MEMORY; k++) s[k] = 0;\n"
    warmup_body = render_template(
        "c_warmup.c",
        p=prefix,
        P=prefix_upper,
        has_prediction_flag=exported.model.has_prediction_flag,
    )
    unused_argument_statements = "    (void)x;\n    (void)w;\n    (void)count;\n    (void)s;\n"
    band_table: BandTable | None = exported.spec.band
    steps = (1,) if band_table is None else band_table.steps
    band_channels = exported.spec.signals.dof.layout.band_channels
    level_text = "" if band_table is None else f"{100.0 * band_table.level:.3g} % "
    width_rows = (
        [(math.inf,) * len(band_channels)]
        if band_table is None
        else list(zip(*band_table.columns, strict=True))
    )
    widths = ["{" + ", ".join(map(write_literal, half_widths)) + "}" for half_widths in width_rows]
    band_body = render_template("c_band.c", steps=steps, widths=widths, channels=len(band_channels))
    return [
        (
            "memory without a past",
            f"void {prefix}_initial_state({real_type} *s)",
            zero_loop if has_memory else "    (void)s;\n",
        ),
        (
            "memory after a measured past: count states and inputs, oldest first",
            f"void {prefix}_warmup(const {real_type} *x, const {real_type} *w, size_t count,"
            f" {real_type} *s)",
            warmup_body if has_memory else unused_argument_statements,
        ),
        (
            f"half widths of the {level_text}prediction intervals of"
            f"\n * {', '.join(band_channels)} k steps after a measured state: between steps of"
            "\n * the table interpolated, beyond the last in proportion to time, infinite without a"
            "\n * table",
            f"void {prefix}_band(int k, {real_type} *half)",
            band_body,
        ),
    ]


class CompiledModel(LoadedExport):
    """An exported C file loaded as a shared library; `prefix` is the prefix of its names."""

    def __init__(
        self, library: Path, exported: Exportable, dtype: torch.dtype, prefix: str
    ) -> None:
        self.real_dtype: Any = np.float64 if dtype == torch.float64 else np.float32
        self.exported = exported
        self.prefix = prefix
        self.library = ctypes.CDLL(str(library))
        self.output_sizes = self._result_sizes()

    def _result_sizes(self) -> dict[str, int]:
        """Return the number of entries of each result of a step, by name."""
        zero_arguments = [
            torch.zeros(1, n_entries, dtype=torch.float64)
            for _, n_entries in self.exported.arguments
        ]
        with torch.no_grad():
            results = self.exported.build_step_module(torch.float64)(*zero_arguments)
        return {
            name: result.numel()
            for name, result in zip(self.exported.results, results, strict=True)
        }

    def _call_function(self, name: str, *call_arguments: np.ndarray | int) -> int:
        function = getattr(self.library, f"{self.prefix}_{name}")
        function.restype = ctypes.c_int
        return int(
            function(
                *(
                    ctypes.c_size_t(call_argument) if isinstance(call_argument, int) else
                    ctypes.c_void_p(call_argument.ctypes.data)
                    for call_argument in call_arguments
                )
            )
        )  # fmt: skip

    @property
    def step_sizes(self) -> list[int]:
        """Number of entries of each array that the function `step` takes, in order."""
        skipped_flags = self.exported.flags[:1]
        return [n_entries for _, n_entries in self.exported.arguments] + [
            n_entries for name, n_entries in self.output_sizes.items() if name not in skipped_flags
        ]

    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        flags = self.exported.flags
        outputs = {
            name: np.zeros(n_entries, np.int32 if name in flags else self.real_dtype)
            for name, n_entries in self.output_sizes.items()
            if name not in flags[:1]
        }
        arrays = [np.ascontiguousarray(array, dtype=self.real_dtype) for array in step_arguments]
        # the C function returns the first flag
        return_value = self._call_function("step", *arrays, *outputs.values())
        results = outputs | {name: np.array([return_value]) for name in flags[:1]}
        return tuple(
            bool(results[name][0]) if name in flags else results[name]
            for name in self.exported.results
        )

    def initial_memory(self, *measured_past: NumberArray) -> NumberArray | None:
        initial_memory = np.zeros(self.exported.arguments[-1][1], self.real_dtype)
        arrays = [np.ascontiguousarray(array, dtype=self.real_dtype) for array in measured_past]
        if len(arrays) > 1:
            self._call_function("warmup", *arrays, len(arrays[0]), initial_memory)
        else:
            self._call_function("initial_state", *arrays, initial_memory)
        return initial_memory


@final
class CExporter(Exporter):
    """One C99 source file and its header: no runtime, no allocation, no global state."""

    name: ClassVar[str] = "c"
    suffix: ClassVar[str] = ".c"
    about: ClassVar[str] = "The model as one C99 file and header, without any runtime."
    default_name_from_run: ClassVar[bool] = True
    is_for_microcontrollers: ClassVar[bool] = True

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write source, header and model card, checked in single and in double precision.

        If rounding in single precision changes the track, the file has double precision only.
        """
        exported.require_finite_numbers()
        # a request for x.h also writes x.c
        file = file.with_suffix(self.suffix) if file.suffix == ".h" else file
        prefix = make_symbol_prefix(file)
        card = exported.build_card() | {
            "format": "c",
            "dtype": "float32; float64 with the macro _DOUBLE",
            "safety": "The file is source code: compile only what you trust.",
        }
        step_sizes: list[int] = []
        libraries: list[Path] = []
        with tempfile.TemporaryDirectory() as name:
            temporary_path = Path(name) / file.name

            def write_and_check(dtype: torch.dtype) -> tuple[CSource, dict[str, Any]]:
                """Write the C file, and compare it compiled with the model in each precision."""
                double_only = dtype == torch.float64
                card_of_precision = card | {"dtype": get_dtype_name(dtype)} if double_only else card
                header = temporary_path.with_suffix(".h")
                c_files = generate_c_source(
                    exported, card_of_precision, header.name, prefix, is_double_only=double_only
                )
                temporary_path.write_text(c_files.source)
                header.write_text(c_files.header)
                double_flags = [f"-D{c_files.prefix.upper()}_DOUBLE"]
                parity = {}
                libraries.clear()
                for checked_dtype in exported.precisions[exported.precisions.index(dtype) :]:
                    precision = "double" if checked_dtype == torch.float64 else "single"
                    library = temporary_path.with_name(f"{precision}.so")
                    compile_shared_library(
                        [temporary_path], library, double_flags if precision == "double" else []
                    )
                    libraries.append(library)
                    compiled = CompiledModel(library, exported, checked_dtype, prefix)
                    step_sizes[:] = compiled.step_sizes
                    parity[precision] = exported.check_parity(
                        compiled,
                        f"the C file in {precision} precision",
                        checked_dtype,
                    )
                return c_files, parity

            dtype, (c_files, parity) = run_in_sufficient_precision(exported, write_and_check)
            if dtype == torch.float64:
                card |= {"dtype": get_dtype_name(dtype)}
            footprint = measure_footprint(temporary_path)
            footprint["memory_bytes"] = measure_memory(exported)
            # the first library has the precision that the file has without a macro
            footprint["step_seconds"] = measure_step_time(
                libraries[0], f"{prefix}_step", step_sizes
            )
            footprint["warnings"] = report_footprint(file.name, footprint)
            card |= {"size": footprint, "parity": parity}
            write_card(file, card)
            file.with_suffix(".h").write_text(c_files.header)
            file.write_text(c_files.source)
        return card


class CasadiModel(LoadedExport):
    """A CasADi function that was written to a file and loaded again."""

    def __init__(self, file: Path) -> None:
        self.function: Any = ca.Function.load(str(file))

    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        return tuple(result.full().reshape(-1) for result in self.function(*step_arguments))


@final
class CasadiExporter(Exporter):
    """A CasADi function of state, inputs and memory, in double precision."""

    name: ClassVar[str] = "casadi"
    suffix: ClassVar[str] = ".casadi"
    about: ClassVar[str] = "The model's step as a CasADi function with exact derivatives, for MPC."

    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        exported.require_finite_numbers()
        step_function = lower(
            exported.build_step_module(torch.float64),
            exported.arguments,
            exported.results,
            exported.label,
        )
        with tempfile.TemporaryDirectory() as name:
            temporary_path = Path(name) / file.name
            to_scalar_function(step_function).save(str(temporary_path))
            parity = exported.check_parity(
                CasadiModel(temporary_path), "the CasADi function", torch.float64
            )
            card = exported.build_card() | {
                "format": "casadi",
                "dtype": "float64",
                "parity": parity,
                "safety": "The file holds expressions only.",
            }
            write_card(file, card)
            file.write_bytes(temporary_path.read_bytes())
        return card
