"""A policy as a C99 source file and header: what a controller calls once per step."""

from __future__ import annotations

import copy
import ctypes
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from residnet.control.heading.keeper import HeadingKeeper
from residnet.core.errors import ExportError
from residnet.export.autopilot import MEASURED, ExportedPolicy, check_parity, for_export
from residnet.export.c.compiled import compile_shared
from residnet.export.c.source import CFunction, c_file, h_file, identifier
from residnet.export.lowering.build import lowered
from residnet.export.lowering.program import Program


class CompiledPolicy:
    """A policy's C file as a library, with the methods of the module that it came from.

    Args:
        library: compiled.
        prefix: of its names.
        programs: of its functions `initial_state` and `step`, for the sizes of their results.
        double: whether it was compiled in double precision.
    """

    def __init__(
        self, library: Path, prefix: str, programs: Mapping[str, Program], double: bool
    ) -> None:
        self._loaded, self._prefix, self._programs = ctypes.CDLL(str(library)), prefix, programs
        self._real: Any = np.float64 if double else np.float32

    def _call(self, name: str, given: Sequence[Tensor]) -> list[Tensor]:
        """Return the results of a function for one row, in their order."""
        program = self._programs[name]
        arrays = [np.ascontiguousarray(part[0].numpy(), self._real) for part in given]
        out: dict[str, np.ndarray] = {}
        back = None
        for result, kind, cells in program.results:
            if kind == "flag" and back is None and cells.size == 1:
                back = result
            else:
                out[result] = np.zeros(cells.size, self._real if kind == "real" else np.int32)
        function = getattr(self._loaded, f"{self._prefix}_{name}")
        pointers = [array.ctypes.data for array in (*arrays, *out.values())]
        function.argtypes = [ctypes.c_void_p] * len(pointers)
        function.restype = ctypes.c_int if back is not None else None
        flag = function(*pointers)
        return [
            torch.tensor([bool(flag)])
            if result == back
            else torch.from_numpy(out[result].astype(bool if kind == "flag" else self._real))[None]
            for result, kind, _ in program.results
        ]

    def initial_state(self, y: Tensor) -> Tensor:
        """Return the memory [1, n] at the first measurement y [1, k]."""
        return self._call("initial_state", [y])[0]

    def step(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Return command, memory and flags for one row."""
        return tuple(self._call("step", given))


def export_policy(
    name: str,
    module: nn.Module,
    arguments: Sequence[tuple[str, int]],
    results: Sequence[str],
    card: Mapping[str, Any],
    file: Path,
    check: Callable[[Any], float],
    *,
    double: bool = False,
) -> None:
    """Write a policy's source, header and card once the compiled file has been checked.

    Args:
        name: of the policy.
        module: with `initial_state(y)` and `step`, in evaluation mode.
        arguments: names and sizes of the arguments of `step`; the measurement `y` stands first.
        results: names of the results of `step`: command, memory, then flags.
        card: stands in the header too.
        file: the .c file.
        check: compares what behaves like the module with it; raises ExportError.
        double: whether the file is in double precision alone, as the module is; otherwise it is in
            single precision unless its user defines otherwise.
    """
    prefix, what = identifier(name), f"policy {name}"
    module = copy.deepcopy(module).eval()
    inner: Any = module
    dtype = torch.float64 if double else torch.float32
    examples = [torch.zeros(1, size, dtype=dtype) for _, size in arguments]
    programs = {
        "initial_state": lowered(
            lambda y: inner.initial_state(y), arguments[:1], ["s"], what, examples[:1]
        ),
        "step": lowered(lambda *given: inner.step(*given), arguments, results, what, examples),
    }
    functions = [
        CFunction(
            "initial_state",
            "memory at the first measurement",
            programs["initial_state"],
        ),
        CFunction(
            "step",
            f"{', '.join(results[:2])} once per step; returns 1 where a measurement, the reference"
            "\n * or the memory was wrong, else 0; results may go where arguments came from",
            programs["step"],
        ),
    ]
    sizes: dict[str, tuple[int | str, str]] = {
        f"SIZE_{argument.upper()}": (size, f"entries of {argument}") for argument, size in arguments
    }
    sizes["DT"] = (repr(float(card["dt"])), "step in s")
    header = file.with_suffix(".h").name
    source_text = c_file(prefix, functions, [], header)
    header_text = h_file(
        prefix,
        functions,
        [],
        sizes,
        f"{name}: a policy, written by residnet. All arrays are the caller's.\n\n"
        + json.dumps(card, indent=1),
        double_only=double,
    )
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / file.name
        source.write_text(source_text)
        (Path(folder) / header).write_text(header_text)
        library = compile_shared([source], Path(folder) / "policy.so")
        parity = check(CompiledPolicy(library, prefix, programs, double))
    stored = {**card, "format": "c", "parity": {**card["parity"], "share_of_limit": parity}}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.with_suffix(".h").write_text(header_text)
    file.with_suffix(".card.json").write_text(json.dumps(stored, indent=1) + "\n")
    file.write_text(source_text)


def export_autopilot_as_c(
    name: str,
    policy: HeadingKeeper,
    file: Path,
    *,
    safe: Literal["hold", "amidships"],
    card: Mapping[str, Any],
) -> None:
    """Write a heading policy as C with the checks of its inputs inside.

    The file is in double precision alone where single precision does not reproduce the policy.

    Args:
        name: of the policy.
        policy: at the step that it shall run with.
        file: the .c file.
        safe: command while inputs are wrong: the last one, or rudder amidships.
        card: of the policy's TorchScript file.

    Raises:
        ExportError: where the C file does not reproduce the policy.
    """
    single, double = for_export(policy, safe), for_export(policy, safe).double()
    try:
        _export_heading(name, single, card, file, double=False)
    except ExportError:
        # some laws with a rudder rate answer a rounding in the seventh digit by one in the third
        _export_heading(name, double, {**card, "dtype": "float64"}, file, double=True)


def _export_heading(
    name: str, module: ExportedPolicy, card: Mapping[str, Any], file: Path, *, double: bool
) -> None:
    """Write a heading policy as C in one precision."""
    export_policy(
        name,
        module,
        [("y", len(MEASURED)), ("reference", 1), ("s", module.memory_low.numel())],
        ["command", "s_after", "fault"],
        card,
        file,
        lambda exported: check_parity(name, module, exported),
        double=double,
    )
