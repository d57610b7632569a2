"""The formats `c`, one C99 source file and its header without a runtime, and `casadi`, for MPC."""

from __future__ import annotations

import ctypes
import json
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, final

import casadi as ca
import numpy as np
import torch

from residnet.dynamics.c_code import literal
from residnet.dynamics.lowering import in_numbers, lowered
from residnet.dynamics.store import BandTable
from residnet.export.base import (
    Exported,
    Exporter,
    Loaded,
    Numbers,
    in_precision,
    name_of,
    write_card,
)
from residnet.export.c_code import CFunction, c_files, compile_shared, footprint, identifier
from residnet.export.policy import ExportedController
from residnet.export.vessel import ExportedVessel

_WARMUP = """    {p}_real after[{P}_STATES];
    size_t k, good = count;
    for (k = 0; k < {P}_MEMORY; k++) s[k] = 0;
    for (k = 0; k < count && good == count; k++)
        if ({p}_measured(x + {P}_STATES * k, w + {P}_INPUTS * k)) good = k;
    for (k = 0; k < count && good < count; k++) {{
        if ({p}_measured(x + {P}_STATES * k, w + {P}_INPUTS * k)) good = k;
        (void){p}_step(x + {P}_STATES * good, w + {P}_INPUTS * good, s, after, s);
    }}
"""
_BAND = """    static const int steps[{count}] = {{{steps}}};
    static const REAL widths[{count}][{channels}] = {{{widths}}};
    int i, after = 0;
    REAL from, share;
    while (after < {count} && steps[after] <= k) after++;
    for (i = 0; i < {channels}; i++) {{
        if (k <= 0) half[i] = ZERO;
        else if (after == {count})
            half[i] = widths[{last}][i] * ((REAL)k / (REAL)steps[{last}]);
        else {{
            from = after ? widths[after - 1][i] : ZERO;
            share = (REAL)(k - (after ? steps[after - 1] : 0));
            share /= (REAL)(steps[after] - (after ? steps[after - 1] : 0));
            half[i] = from + share * (widths[after][i] - from);
        }}
    }}
"""
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
    exported: Exported, card: Mapping[str, Any], header: str, *, double_only: bool = False
) -> CSource:
    """Return source and header.

    Args:
        card: stands as a comment in the header.
        double_only: whether single precision is not offered.

    Raises:
        ExportError: where there is an operation that is not written in C.
    """
    prefix = identifier(exported.name)
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
    files = c_files(prefix, functions, extra, sizes, about, header, double_only=double_only)
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
    band = _BAND.format(
        count=len(steps),
        last=len(steps) - 1,
        channels=len(banded),
        steps=", ".join(map(str, steps)),
        widths=",\n        ".join(widths),
    )
    return [
        (
            "memory without a past",
            f"void {prefix}_initial_state({real} *s)",
            begin if memory else "    (void)s;\n",
        ),
        (
            "memory that a measured past leaves: count states and inputs, oldest first",
            f"void {prefix}_warmup(const {real} *x, const {real} *w, size_t count, {real} *s)",
            _WARMUP.format(p=prefix, P=upper) if memory else unread,
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
    """An exported C file as a library."""

    def __init__(self, library: Path, exported: Exported, dtype: torch.dtype) -> None:
        self.real: Any = np.float64 if dtype == torch.float64 else np.float32
        self.exported, self.prefix = exported, identifier(exported.name)
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

    def export(self, exported: Exported, file: Path) -> Mapping[str, Any]:
        """Write source, header and card, checked in single and in double precision.

        Where single precision does not determine the track, the file is in double precision alone.
        """
        exported.require_numbers()
        # a header that is asked for names the pair
        file = file.with_suffix(self.suffix) if file.suffix == ".h" else file
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
                written = c_source(exported, told, header.name, double_only=double_only)
                partial.write_text(written.source)
                header.write_text(written.header)
                macro = [f"-D{written.prefix.upper()}_DOUBLE"]
                parity = {}
                for each in exported.precisions[exported.precisions.index(dtype) :]:
                    precision = "double" if each == torch.float64 else "single"
                    library = partial.with_name(f"{precision}.so")
                    compile_shared([partial], library, macro if precision == "double" else [])
                    parity[precision] = exported.check(
                        CompiledModel(library, exported, each),
                        f"the C file in {precision} precision",
                        each,
                    )
                return written, parity

            dtype, (written, parity) = in_precision(exported, attempt)
            if dtype == torch.float64:
                card |= {"dtype": name_of(dtype)}
            card |= {"size": footprint(partial), "parity": parity}
            file.parent.mkdir(parents=True, exist_ok=True)
            file.with_suffix(".h").write_text(written.header)
            write_card(file, card)
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
            file.parent.mkdir(parents=True, exist_ok=True)
            write_card(file, card)
            file.write_bytes(partial.read_bytes())
        return card
