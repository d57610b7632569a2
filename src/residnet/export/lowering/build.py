"""From a recorded graph to a program: moves become addresses, the rest becomes instructions."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from residnet.core.errors import ExportError
from residnet.export.lowering.operations import FOLDS, LIKE, MAPS, MOVES
from residnet.export.lowering.program import Cells, Fold, Instruction, Map, Pick, Product
from residnet.export.lowering.program import Program as Program
from residnet.export.lowering.scatters import Scatters
from residnet.export.lowering.simplify import simplify
from residnet.export.lowering.trace import recorded
from residnet.export.lowering.values import (
    Value,
    attribute,
    examples_of,
    kind_of,
    paired,
    wrapped,
)


def lowered(
    step: Callable[..., Any],
    arguments: Sequence[tuple[str, int]],
    results: Sequence[str],
    what: str,
    examples: Sequence[Tensor] | None = None,
) -> Program:
    """Return the program of a step for one row in float64.

    Args:
        step: of tensors [1, size], returns as many tensors as there are `results`.
        arguments: names and sizes.
        results: names.
        what: is lowered, for messages.
        examples: arguments to record with; zeros where not given.

    Raises:
        ExportError: where an operation is not known, by its name.
    """
    given = (
        [torch.zeros(1, size, dtype=torch.float64) for _, size in arguments]
        if examples is None
        else list(examples)
    )
    return _Builder(what).build(recorded(step, given, what), given, arguments, results)


class _Builder(Scatters):
    def __init__(self, what: str) -> None:
        self.what = what
        self.program = Program()
        self.known: dict[tuple[Any, ...], Instruction] = {}

    def build(
        self,
        graph: GraphModule,
        examples: Sequence[Tensor],
        arguments: Sequence[tuple[str, int]],
        results: Sequence[str],
    ) -> Program:
        values: dict[Node, Any] = {}
        given = iter(zip(arguments, examples, strict=True))
        for node in graph.graph.nodes:
            if node.op == "placeholder":
                (name, size), example = next(given)
                block = self.program.argument(name, size)
                values[node] = Value(
                    example, torch.arange(block.start, block.start + size).reshape(example.shape)
                )
            elif node.op == "get_attr":
                values[node] = Value(attribute(graph, str(node.target)))
            elif node.op == "output":
                outputs = torch.utils._pytree.tree_leaves(node.args[0])
                for name, output in zip(results, outputs, strict=True):
                    value = values[output]
                    self.program.results.append(
                        (name, kind_of(value.example.dtype), self.cells(value).reshape(-1).numpy())
                    )
            else:
                values[node] = self.call(node, values)
        simplify(self.program)
        return self.program

    def cells(self, value: Value) -> Tensor:
        """Return the addresses of a value, of a constant too."""
        if value.cells is not None:
            return value.cells
        example = value.example
        block = self.program.constant(
            example.detach().to(torch.float64).numpy(), kind_of(example.dtype)
        )
        return torch.arange(block.start, block.start + block.size).reshape(example.shape)

    def call(self, node: Node, values: dict[Node, Any]) -> Any:
        args: Any = torch.fx.node.map_arg(node.args, lambda n: values[n])
        kwargs: Any = torch.fx.node.map_arg(node.kwargs, lambda n: values[n])
        target: Any = node.target
        if target is operator.getitem:
            return args[0][args[1]]
        name = target._schema.name.removeprefix("aten::").removesuffix("_copy")
        leaves = [
            a for a in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(a, Value)
        ]
        example = target(*examples_of(args), **examples_of(kwargs))
        if name in LIKE or all(value.constant for value in leaves):
            return wrapped(example)
        if name == "_to":
            return self.cast(args[0], example)
        if name in MOVES and self.movable(name, args):
            moved = target(*self.addresses(args, MOVES[name]), **examples_of(kwargs))
            return paired(example, moved)
        lowering = getattr(self, f"do_{name}", None)
        if lowering is not None:
            return lowering(example, *args, **kwargs)
        if name in MAPS and not kwargs:
            return self.map(MAPS[name], example, *args)
        if name in FOLDS:
            return self.fold(FOLDS[name], example, *args, **kwargs)
        raise ExportError(
            f"{self.what}: its step uses torch's operation '{name}', which this format does not"
            " have; export it as torchscript"
        )

    def movable(self, name: str, args: Sequence[Any]) -> bool:
        """Whether all places are known that a move moves from and to."""
        others = [arg for i, arg in enumerate(args) if i not in MOVES[name]]
        return all(
            leaf.constant
            for leaf in torch.utils._pytree.tree_leaves(others)
            if isinstance(leaf, Value)
        )

    def addresses(self, args: Sequence[Any], data: Sequence[int]) -> list[Any]:
        """Return the arguments of a move with addresses in the places of its numbers."""
        return [
            torch.utils._pytree.tree_map(
                lambda a: self.cells(a) if isinstance(a, Value) else a, arg
            )
            if i in data
            else examples_of(arg)
            for i, arg in enumerate(args)
        ]

    def value(self, given: Any) -> Value:
        """Return an argument as a value; a plain number is a constant."""
        if isinstance(given, Value):
            return given
        kind = torch.bool if isinstance(given, bool) else torch.float64
        return Value(torch.tensor(given, dtype=kind))

    def made(self, example: Tensor, make: Callable[[], Instruction], key: tuple[Any, ...]) -> Value:
        """Return what an instruction makes; the same one is carried out once."""
        if key not in self.known:
            self.known[key] = make()
            self.program.instructions.append(self.known[key])
        out = self.known[key].out
        return Value(example, torch.arange(out.start, out.start + out.size).reshape(example.shape))

    def map(self, op: str, example: Tensor, *given: Any) -> Value:
        """Return an operation on each element of values that are brought to one shape."""
        operands = tuple(
            np.ascontiguousarray(cells.numpy())
            for cells in torch.broadcast_tensors(*(self.cells(self.value(a)) for a in given))
        )
        kind = kind_of(example.dtype)
        return self.made(
            example,
            lambda: Map(op, self.program.made(example.numel(), kind), operands),
            (op, kind, *((cells.shape, cells.tobytes()) for cells in operands)),
        )

    def fold(
        self,
        op: str,
        example: Tensor,
        given: Value,
        dim: Any = None,
        keepdim: bool = False,
        **_: Any,
    ) -> Value:
        """Return a reduction over some or all dimensions."""
        cells = self.cells(given)
        every = list(range(cells.dim()))
        over = every if dim is None or dim == [] else [d % cells.dim() for d in _listed(dim)]
        kept = [d for d in every if d not in over]
        rows = cells.permute(*kept, *over).reshape(example.numel(), -1)
        return self.made(
            example,
            lambda: Fold(
                op, self.program.made(example.numel(), kind_of(example.dtype)), rows.numpy()
            ),
            (op, rows.shape, rows.numpy().tobytes()),
        )

    def product(self, left: Tensor, right: Tensor, start: Tensor | None) -> Tensor:
        """Return the cells of left [k] times right [k, n], plus start [n]."""
        out = self.program.made(right.shape[1], "real")
        self.program.instructions.append(
            Product(
                out,
                left.numpy(),
                right.numpy(),
                None if start is None else start.numpy(),
                self.program.zeros(right.numpy()),
            )
        )
        return torch.arange(out.start, out.start + out.size)

    def products(self, example: Tensor, left: Tensor, right: Tensor, start: Tensor | None) -> Value:
        """Return the value of left [m, k] times right [k, n], plus start [m, n]."""
        rows = [
            self.product(left[i], right, None if start is None else start[i])
            for i in range(left.shape[0])
        ]
        return Value(example, torch.stack(rows) if rows else torch.zeros(0, right.shape[1]).long())

    def cast(self, given: Value, example: Tensor) -> Value:
        """Return a value in another type; precisions are not told apart."""
        before, after = kind_of(given.example.dtype), kind_of(example.dtype)
        if before == after:
            return Value(example, self.cells(given))
        if after == "flag":
            return self.map("ne", example, given, 0.0)
        return self.map("trunc" if after == "whole" else "number", example, given)

    # operations with settings of their own

    def do_add(self, example: Tensor, a: Any, b: Any, alpha: float = 1) -> Value:
        return self.map("add", example, a, self.scaled(b, alpha))

    def do_sub(self, example: Tensor, a: Any, b: Any, alpha: float = 1) -> Value:
        return self.map("sub", example, a, self.scaled(b, alpha))

    def do_rsub(self, example: Tensor, a: Any, b: Any, alpha: float = 1) -> Value:
        return self.map("sub", example, b, self.scaled(a, alpha))

    def scaled(self, given: Any, factor: float) -> Any:
        """Return a value times a plain number."""
        if factor == 1:
            return given
        value = self.value(given)
        return self.map("mul", value.example * factor, value, float(factor))

    def do_div(self, example: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> Value:
        ratio = self.map("div", example, a, b)
        return ratio if rounding_mode is None else self.map(rounding_mode, example, ratio)

    def do_pow(self, example: Tensor, a: Any, b: Any) -> Value:
        power = self.value(b)
        if power.constant and power.example.numel() == 1:
            number = float(power.example)
            if number == 0.5:
                return self.map("sqrt", example, a)
            if number == -1.0:
                return self.map("reciprocal", example, a)
            if number in (2.0, 3.0, 4.0):
                square = self.map("mul", example, a, a)
                if number == 2.0:
                    return square
                return self.map("mul", example, square, a if number == 3.0 else square)
        return self.map("pow", example, a, b)

    def do_clamp(self, example: Tensor, given: Value, min: Any = None, max: Any = None) -> Value:
        out = given if min is None else self.map("maximum", example, given, min)
        return out if max is None else self.map("minimum", example, out, max)

    def do_copy(self, example: Tensor, given: Value, source: Value, *_: Any) -> Value:
        cells = self.cells(self.cast(source, source.example.to(example.dtype)))
        return Value(example, cells.expand(example.shape))

    def do_mm(self, example: Tensor, a: Value, b: Value) -> Value:
        return self.products(example, self.cells(a), self.cells(b), None)

    def do_addmm(
        self, example: Tensor, start: Value, a: Value, b: Value, beta: float = 1, alpha: float = 1
    ) -> Value:
        first = self.cells(self.scaled(start, beta)).expand(example.shape).contiguous()
        return self.products(example, self.cells(self.scaled(a, alpha)), self.cells(b), first)

    def do_bmm(self, example: Tensor, a: Value, b: Value) -> Value:
        left, right = self.cells(a), self.cells(b)
        parts = [self.products(example[i], left[i], right[i], None) for i in range(left.shape[0])]
        return Value(example, torch.stack([self.cells(part) for part in parts]))

    def do_max(self, example: Any, given: Value, dim: int, keepdim: bool = False) -> list[Value]:
        return self.extreme("max", example, given, dim)

    def do_min(self, example: Any, given: Value, dim: int, keepdim: bool = False) -> list[Value]:
        return self.extreme("min", example, given, dim)

    def extreme(self, which: str, example: Any, given: Value, dim: int) -> list[Value]:
        """Return the largest or smallest value along a dimension, and its place."""
        return [
            self.fold(f"{which}imum", example[0], given, dim),
            self.fold(f"arg{which}", example[1], given, dim),
        ]

    # moves to places that are known only when the step is run

    def do_index_select(self, example: Tensor, given: Value, dim: int, index: Value) -> Value:
        rows = self.cells(given).movedim(dim, 0)
        parts = [self.pick(rows, at) for at in self.cells(index).reshape(-1)]
        return Value(example, torch.stack(parts).movedim(0, dim))

    def do_index(self, example: Tensor, given: Value, indices: Sequence[Value | None]) -> Value:
        if indices[0] is None or len(indices) > 1:
            raise ExportError(
                f"{self.what}: its step looks up a table by several indices at once, which this"
                " format does not have; export it as torchscript"
            )
        at = self.cells(indices[0])
        parts = [self.pick(self.cells(given), one) for one in at.reshape(-1)]
        return Value(example, torch.stack(parts).reshape(example.shape))

    def do_gather(self, example: Tensor, given: Value, dim: int, index: Value, **_: Any) -> Value:
        table, at = self.cells(given).movedim(dim, -1), self.cells(index).movedim(dim, -1)
        table = table[tuple(slice(size) for size in at.shape[:-1])]
        flat, places = table.reshape(-1, table.shape[-1]), at.reshape(-1, at.shape[-1])
        parts = [
            torch.stack([self.pick(row.unsqueeze(-1), one)[0] for one in wanted])
            for row, wanted in zip(flat, places, strict=True)
        ]
        return Value(example, torch.stack(parts).reshape(at.shape).movedim(-1, dim))

    def pick(self, table: Tensor, row: Tensor) -> Tensor:
        """Return the cells of a row of table [n, ...] that is known when the step is run."""
        flat = table.reshape(table.shape[0], -1)
        kind = self.program.block(int(flat[0, 0])).kind
        out = self.program.made(flat.shape[1], kind)
        where: Cells = row.reshape(1).numpy()
        self.program.instructions.append(Pick(out, flat.contiguous().numpy(), where))
        return torch.arange(out.start, out.start + out.size).reshape(table.shape[1:])


def _listed(dim: int | Sequence[int]) -> Sequence[int]:
    return [dim] if isinstance(dim, int) else dim
