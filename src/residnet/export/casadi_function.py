"""The format `casadi`: the model's step as a CasADi function with exact derivatives, for MPC."""

from __future__ import annotations

import copy
import importlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch

from residnet.core.errors import ExportError
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.card import make_card
from residnet.export.contract import Numbers, accepted, checked, require_numbers, warmed
from residnet.export.guard import GuardedDynamics
from residnet.export.lowering.build import lowered
from residnet.export.lowering.program import Fold, Map, Pick, Product, Program
from residnet.export.packages import require_package

_RESULTS = ("x_after", "s_after", "outside")
_UNARY = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh",
    "exp", "expm1", "log", "log1p", "log10", "sqrt", "floor", "ceil", "erf", "sign",
)  # fmt: skip
"""Functions that CasADi knows by the same name."""
_NUMBER = {"ne": "isnan", "eq": "number?"}
"""What comparisons of a value with itself ask, which CasADi takes to be known."""


def symbolic(program: Program, casadi: Any, what: str) -> Any:
    """Return a program as a CasADi function of its arguments.

    Raises:
        ExportError: where an operation has no counterpart.
    """
    sx = casadi.SX
    operations = _operations(casadi)
    cells: dict[int, Any] = {}
    arguments = []
    for block in program.arguments:
        symbol = sx.sym(block.name, block.size)
        arguments.append(symbol)
        cells.update({block.start + i: symbol[i] for i in range(block.size)})

    def cell(address: int) -> Any:
        if address not in cells:
            value = program.value(address)
            cells[address] = sx(value)
        return cells[address]

    def apply(op: str, *operands: Any) -> Any:
        if op not in operations:
            raise ExportError(
                f"{what}: its step uses the operation '{op}', which CasADi does not have; export it"
                " as c or onnx"
            )
        return operations[op](*operands)

    for instruction in program.instructions:
        start = instruction.out.start
        if isinstance(instruction, Map):
            rows = zip(*(part.reshape(-1).tolist() for part in instruction.operands), strict=True)
            for i, row in enumerate(rows):
                if program.needed[start + i]:
                    op = _NUMBER.get(instruction.op, instruction.op)
                    same = len(row) == 2 and row[0] == row[1]
                    cells[start + i] = (
                        apply(op, cell(row[0]))
                        if same and op != instruction.op
                        else apply(instruction.op, *(cell(a) for a in row))
                    )
        elif isinstance(instruction, Product):
            # what meets zeros alone has not been made
            left = casadi.vertcat(
                *(cell(int(a)) if program.needed[a] else sx(0) for a in instruction.left)
            )
            weights = np.array(
                [[program.value(int(a)) for a in row] for row in instruction.right], dtype=object
            )
            known = all(value is not None for value in weights.flat)
            right = (
                casadi.DM(weights.astype(float))
                if known
                else casadi.vertcat(
                    *(casadi.horzcat(*(cell(int(a)) for a in row)) for row in instruction.right)
                )
            )
            out = casadi.mtimes(right.T, left)
            for j in range(instruction.out.size):
                begin = 0 if instruction.start is None else cell(int(instruction.start[j]))
                cells[start + j] = out[j] + begin
        elif isinstance(instruction, Fold):
            for i, row in enumerate(instruction.operand):
                cells[start + i] = _folded(instruction.op, [cell(int(a)) for a in row], apply)
        else:
            _pick(instruction, cell, cells, casadi)
    results = [
        casadi.vertcat(*(cell(int(a)) for a in part)) if part.size else sx(0, 1)
        for _, _, part in program.results
    ]
    names = [block.name for block in program.arguments]
    return casadi.Function("step", arguments, results, names, [n for n, _, _ in program.results])


def _folded(op: str, row: Sequence[Any], apply: Callable[..., Any]) -> Any:
    """Return the reduction of a row."""
    if op.startswith("arg"):
        best, place = row[0], 0.0
        for i, value in enumerate(row[1:], start=1):
            better = apply("gt" if op == "argmax" else "lt", value, best)
            best, place = apply("where", better, value, best), apply("where", better, i, place)
        return place
    total = row[0]
    for value in row[1:]:
        total = apply("add" if op == "mean" else op, total, value)
    return total / len(row) if op == "mean" else total


def _pick(
    instruction: Pick, cell: Callable[[int], Any], cells: dict[int, Any], casadi: Any
) -> None:
    """Set the cells of a row that is known when the function is called."""
    rows = instruction.table.shape[0]
    at = cell(int(instruction.row[0]))
    for j in range(instruction.out.size):
        out = cell(int(instruction.table[0, j]))
        for i in range(1, rows):
            out = casadi.if_else(at >= i, cell(int(instruction.table[i, j])), out)
        cells[instruction.out.start + j] = out


def _operations(casadi: Any) -> dict[str, Callable[..., Any]]:
    """Return the operations on single expressions, by their names in programs."""
    return {
        **{name: getattr(casadi, name) for name in _UNARY},
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "neg": lambda a: -a,
        "abs": casadi.fabs,
        "square": lambda a: a * a,
        "reciprocal": lambda a: 1.0 / a,
        "rsqrt": lambda a: 1.0 / casadi.sqrt(a),
        "sigmoid": lambda a: 1.0 / (1.0 + casadi.exp(-a)),
        "relu": lambda a: casadi.fmax(a, 0.0),
        "trunc": lambda a: casadi.if_else(a < 0, casadi.ceil(a), casadi.floor(a)),
        "round": lambda a: casadi.floor(a + 0.5),
        "pow": casadi.power,
        "atan2": casadi.atan2,
        "hypot": casadi.hypot,
        "fmod": casadi.fmod,
        "remainder": lambda a, b: a - b * casadi.floor(a / b),
        "copysign": casadi.copysign,
        # comparisons with what is no number are false, so that it stays what it is
        "maximum": lambda a, b: casadi.if_else(a <= b, b, a),
        "minimum": lambda a, b: casadi.if_else(a >= b, b, a),
        "where": casadi.if_else,
        "eq": lambda a, b: casadi.eq(a, b),
        "ne": lambda a, b: casadi.ne(a, b),
        "lt": lambda a, b: a < b,
        "le": lambda a, b: a <= b,
        "gt": lambda a, b: a > b,
        "ge": lambda a, b: a >= b,
        "and": casadi.logic_and,
        "or": casadi.logic_or,
        "not": casadi.logic_not,
        "isnan": lambda a: casadi.logic_not(casadi.logic_or(a <= 0, a > 0)),
        "number?": lambda a: casadi.logic_or(a <= 0, a > 0),
        "isinf": lambda a: casadi.eq(casadi.fabs(a), casadi.inf),
        "number": lambda a: a,
    }


class CasadiModel:
    """A written function, loaded back."""

    def __init__(self, file: Path, spec: ModelSpec, model: HybridDynamics) -> None:
        casadi = importlib.import_module("casadi")
        self.function: Any = casadi.Function.load(str(file))
        self.memory = model.n_state
        self.measured = accepted(spec, model)

    def step(self, x: Numbers, w: Numbers, s: Numbers) -> tuple[Numbers, Numbers, bool]:
        """Return state, memory and flag one step later."""
        after, memory, outside = (np.asarray(part).reshape(-1) for part in self.function(x, w, s))
        return after, memory, bool(outside[0])

    def warmup(self, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory that a measured past leaves."""
        return warmed(self.measured, self.step, y, w, np.zeros(self.memory))


@final
class CasadiExporter(Exporter):
    """A CasADi function of state, inputs and memory, in double precision."""

    name: ClassVar[str] = "casadi"
    suffix: ClassVar[str] = ".casadi"
    about: ClassVar[str] = "The model's step as a CasADi function with exact derivatives, for MPC."

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the function, and its card beside it."""
        require_package("casadi", "format casadi")
        casadi = importlib.import_module("casadi")
        require_numbers(spec, model)
        model = copy.deepcopy(model).double().eval().requires_grad_(False)
        guarded = GuardedDynamics(model, spec).double().eval()
        sizes = [("x", len(STATE)), ("w", len(spec.signals.columns)), ("s", model.n_state)]
        what = f"model {spec.name}"
        program = lowered(lambda x, w, s: guarded.flagged_step(x, w, s), sizes, _RESULTS, what)
        with tempfile.TemporaryDirectory() as name:
            partial = Path(name) / file.name
            symbolic(program, casadi, what).save(str(partial))
            stepped = CasadiModel(partial, spec, model)
            card = make_card(spec, model, rows, {}) | {
                "format": "casadi",
                "dtype": "float64",
                "parity": checked(spec, model, stepped, "the CasADi function", torch.float64),
                "safety": "The file holds expressions only.",
            }
            file.parent.mkdir(parents=True, exist_ok=True)
            file.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")
            file.write_bytes(partial.read_bytes())
        return card
