"""Lower the step of a module to a CasADi function, from which C and other formats are generated.

Torch records the step of one row as a graph of its core operations (`engine.trace`). A tensor
becomes a CasADi column of its entries in row order, so that data movements become lists of indices.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import casadi as ca
import numpy as np
import torch
from torch import Tensor
from torch.fx import Graph, Node
from torch.fx.node import map_aggregate
from torch.utils import _pytree as tree

from residnet.core.errors import ExportError
from residnet.engine.trace import (
    DATA_MOVEMENTS,
    SHAPE_ONLY_OPERATIONS,
    operation_name,
    record_graph,
)

_MAX_TABLE_ROWS: Final = 64
"""Largest table whose look-up at run time becomes a chain of conditionals.

A chain has derivatives and can be expanded to scalars. A delay line of one second at 50 Hz has 50
rows.
"""


def _is_number(a: Any) -> Any:
    # CasADi simplifies a == a to true, so that it cannot detect NaN
    return ca.logic_or(a <= 0, a > 0)


_ELEMENTWISE_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    **{
        name: getattr(ca, name)
        for name in (
            "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh",
            "atanh", "exp", "expm1", "log", "log1p", "log10", "sqrt", "floor", "ceil", "erf",
            "sign", "atan2", "hypot", "fmod", "copysign", "eq", "ne", "lt", "le", "gt", "ge",
        )
    },
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg, "abs": ca.fabs, "square": lambda a: a * a,
    "reciprocal": lambda a: 1.0 / a, "rsqrt": lambda a: 1.0 / ca.sqrt(a),
    "sigmoid": lambda a: 1.0 / (1.0 + ca.exp(-a)), "relu": lambda a: ca.fmax(a, 0.0),
    "trunc": lambda a: ca.sign(a) * ca.floor(ca.fabs(a)),
    "round": lambda a: ca.floor(a + 0.5), "pow": ca.power,
    "exp2": lambda a: ca.power(2.0, a), "log2": lambda a: ca.log(a) / ca.log(2.0),
    "remainder": lambda a, b: a - b * ca.floor(a / b),
    # comparisons with NaN are false, so that NaN is propagated
    "maximum": lambda a, b: ca.if_else(a < b, b, a),
    "minimum": lambda a, b: ca.if_else(a > b, b, a), "where": lambda c, a, b: ca.if_else(c, a, b),
    "isnan": lambda a: ca.logic_not(_is_number(a)),
    "isinf": lambda a: ca.eq(ca.fabs(a), ca.inf),
    **dict.fromkeys(("logical_not", "bitwise_not"), ca.logic_not),
    **dict.fromkeys(("logical_and", "bitwise_and"), ca.logic_and),
    **dict.fromkeys(("logical_or", "bitwise_or"), ca.logic_or),
    **dict.fromkeys(("logical_xor", "bitwise_xor"), ca.ne),
}  # fmt: skip
"""Elementwise operations, on columns of one length or scalars."""
_REDUCTIONS: Final = {
    "sum": "add", "mean": "add", "amax": "maximum", "amin": "minimum", "prod": "mul",
    "any": "logical_or", "all": "logical_and",
}  # fmt: skip
"""Reductions, with the operation that combines two numbers."""


def lower(
    step: Callable[..., Any],
    arguments: Sequence[tuple[str, int]],
    results: Sequence[str],
    model_name: str,
) -> ca.Function:
    """Lower a step in torch to a CasADi function of one row in float64.

    Args:
        step: function of tensors [1, size] that returns one tensor for each of `results`.
        arguments: names and sizes of the arguments.
        results: names of the results.
        model_name: name of the model, for messages.

    Raises:
        ExportError: if an operation is not supported, or Python branches on values.
    """
    examples = [torch.zeros(1, size, dtype=torch.float64) for _, size in arguments]
    symbols = [ca.MX.sym(name, size) for name, size in arguments]
    graph = record_graph(step, examples, model_name)
    require_deterministic(graph, model_name)
    values = dict(zip(get_placeholders(graph), map(TracedValue, examples, symbols), strict=True))
    results_columns = lower_graph(graph, values, model_name)
    return ca.Function(
        "step", symbols, results_columns, [name for name, _ in arguments], list(results)
    )


def require_deterministic(graph: Graph, model_name: str) -> None:
    """Refuse a step that draws random numbers, such as dropout in training.

    Raises:
        ExportError: if the graph has such an operation.
    """
    for node in graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise ExportError(f"{model_name}: its step draws random numbers ({node.target})")


def get_placeholders(graph: Graph) -> list[Node]:
    return [node for node in graph.nodes if node.op == "placeholder"]


def lower_graph(
    graph: Graph,
    values: dict[Node, Any],
    model_name: str,
    replacement: Callable[[Node, Any], Any] | None = None,
) -> list[Any]:
    """Convert the operations of a graph and return the CasADi columns of its results.

    Args:
        graph: the recorded graph.
        values: values of some nodes; the values of all other nodes are added.
        model_name: name of the model, for messages.
        replacement: function of a node and its arguments that returns a value for the node, or None
            if the operation of the node is to be converted as usual.
    """
    for node in graph.nodes:
        if node in values:
            continue
        if node.op == "get_attr":
            values[node] = TracedValue(
                operator.attrgetter(str(node.target))(graph.owning_module).detach()
            )
        elif node.op == "output":
            return [values[output].column for output in tree.tree_leaves(node.args[0])]
        else:
            args, keyword_arguments = torch.fx.node.map_arg(
                (node.args, node.kwargs), values.__getitem__
            )
            value = replacement(node, args) if replacement else None
            values[node] = (
                _lower_operation(node.target, args, keyword_arguments, model_name)
                if value is None
                else value
            )
    raise AssertionError("the graph has no output node")


def to_scalar_function(function: ca.Function) -> ca.Function:
    """Expand a CasADi function to scalar operations, unless it looks up a long table."""
    instructions = range(function.n_instructions())
    if any(function.instruction_id(k) == ca.OP_GETNONZEROS_PARAM for k in instructions):
        return function
    symbols = [ca.SX.sym(name, function.numel_in(name)) for name in function.name_in()]
    results = ca.cse([*function.call(symbols)])
    return ca.Function("step", symbols, results, function.name_in(), function.name_out())


@dataclass
class TracedValue:
    """A tensor of the graph: its value at the examples, and its CasADi column in row order.

    Attributes:
        example: value at the examples, which defines shape and dtype.
        expression: CasADi column; None for a constant, whose column is made when it is needed.
    """

    example: Tensor
    expression: Any = None

    @property
    def is_constant(self) -> bool:
        """Whether the value does not depend on the arguments of the step."""
        return self.expression is None or self.example.numel() == 0

    @property
    def column(self) -> Any:
        """CasADi column of the entries in row order."""
        if self.expression is None:
            self.expression = ca.MX(ca.DM(self.example.double().reshape(-1).tolist()))
        return self.expression

    @property
    def indices(self) -> Tensor:
        """Position of each entry in the column, in the shape of the tensor."""
        return torch.arange(self.example.numel()).reshape(self.example.shape)


def _select(column: Any, indices: Tensor) -> Any:
    """Return the entries of a column at constant indices, in the order of `indices`."""
    order = indices.reshape(-1).tolist()
    if order == list(range(column.shape[0])):
        return column
    # CasADi returns a row where one entry is selected several times
    return ca.vec(column[order]) if order else ca.MX(0, 1)


def _to_traced_value(value: Any) -> TracedValue:
    """Return a value of the graph; Python numbers become constants."""
    if isinstance(value, TracedValue):
        return value
    dtype = torch.bool if isinstance(value, bool) else torch.float64
    return TracedValue(torch.tensor(value, dtype=dtype))


def lower_elementwise(operation: str, example: Tensor, *values: Any) -> TracedValue:
    """Return an elementwise operation on values broadcast to the shape of the example."""
    columns = []
    for value in map(_to_traced_value, values):
        indices = value.indices.expand(np.broadcast_shapes(value.example.shape, example.shape))
        is_scalar = value.example.numel() == 1
        columns.append(value.column if is_scalar else _select(value.column, indices))
    result = _ELEMENTWISE_OPERATIONS[operation](*columns)
    return TracedValue(
        example,
        result if result.shape[0] == example.numel() else ca.repmat(result, example.numel(), 1),
    )


def _lower_operation(target: Any, args: Any, keyword_arguments: Any, model_name: str) -> Any:
    """Return the result of an operation of torch.

    Raises:
        ExportError: if the operation is not supported.
    """
    if target is operator.getitem:
        return args[0][args[1]]
    name = operation_name(target)
    leaves = [
        leaf
        for leaf in tree.tree_leaves((args, keyword_arguments))
        if isinstance(leaf, TracedValue)
    ]

    def to_examples(part: Any) -> Any:
        return map_aggregate(
            part, lambda leaf: leaf.example if isinstance(leaf, TracedValue) else leaf
        )

    # torch itself computes the shape of the result
    example = target(*to_examples(args), **to_examples(keyword_arguments))
    if name in SHAPE_ONLY_OPERATIONS or all(leaf.is_constant for leaf in leaves):
        return TracedValue(example) if isinstance(example, Tensor) else [*map(TracedValue, example)]
    moved_arguments = DATA_MOVEMENTS.get(name, ())
    other_leaves = [
        leaf
        for i, arg in enumerate(args)
        if i not in moved_arguments
        for leaf in tree.tree_leaves(arg)
    ]
    # torch moves the indices of the entries in the same way, unless the movement depends on values
    if moved_arguments and all(
        leaf.is_constant for leaf in other_leaves if isinstance(leaf, TracedValue)
    ):
        return _lower_data_movement(
            target, args, to_examples, moved_arguments, to_examples(keyword_arguments), example
        )
    if name in _SPECIAL_OPERATIONS:
        return _SPECIAL_OPERATIONS[name](example, *args, **keyword_arguments)
    if name in _ELEMENTWISE_OPERATIONS and not keyword_arguments:
        return lower_elementwise(name, example, *args)
    if name in _REDUCTIONS:
        return _lower_reduction(name, example, *args, **keyword_arguments)
    raise ExportError(
        f"{model_name}: its step uses torch's operation '{name}', which this format does not"
        " support; export it as torchscript"
    )


def _lower_data_movement(
    target: Any,
    args: Any,
    to_examples: Any,
    moved_arguments: Sequence[int],
    keyword_arguments: Any,
    example: Any,
) -> Any:
    """Return the result of a data movement, which torch applies to the indices of the entries.

    Args:
        target: operation of torch.
        args: positional arguments of the operation.
        to_examples: function that replaces traced values in an argument by their example tensors.
        moved_arguments: positions of the arguments whose entries are moved.
        keyword_arguments: keyword arguments of the operation.
        example: result of the operation for the example tensors.
    """
    columns: list[Any] = []
    count = 0

    def to_indices(leaf: Any) -> Any:
        nonlocal count
        if not isinstance(leaf, TracedValue):
            return leaf
        columns.append(leaf.column)
        count += leaf.example.numel()
        return leaf.indices + (count - leaf.example.numel())

    arguments = [
        map_aggregate(arg, to_indices) if i in moved_arguments else to_examples(arg)
        for i, arg in enumerate(args)
    ]
    indices = target(*arguments, **keyword_arguments)
    all_columns = columns[0] if len(columns) == 1 else ca.vertcat(*columns)
    if isinstance(example, Tensor):
        return TracedValue(example, _select(all_columns, indices))
    return [
        TracedValue(element, _select(all_columns, element_indices))
        for element, element_indices in zip(example, indices, strict=True)
    ]


def _reduction_rows(value: TracedValue, dim: Any) -> tuple[Tensor, int]:
    """Return the indices [rows, n] of the entries that a reduction along `dim` combines, and n."""
    indices = value.indices
    dimensions = list(range(indices.dim()))
    requested_dimensions = [dim] if isinstance(dim, int) else dim
    reduced_dimensions = (
        [d % indices.dim() for d in requested_dimensions] if requested_dimensions else dimensions
    )
    reordered = indices.permute(
        *(d for d in dimensions if d not in reduced_dimensions), *reduced_dimensions
    )
    size = 1
    for d in reduced_dimensions:
        size *= indices.shape[d]
    return reordered.reshape(-1, size), size


def _lower_reduction(
    name: str,
    example: Tensor,
    value: TracedValue,
    dim: Any = None,
    keepdim: bool = False,
    **_: Any,
) -> TracedValue:
    """Return a sum, mean, extremum, product or logical combination along dimensions.

    Args:
        name: key of `_REDUCTIONS`.
        example: result at the examples.
        value: tensor that is reduced.
        dim: dimension or dimensions; None for all.
        keepdim: ignored, because `example` has the shape of the result.
    """
    rows, size = _reduction_rows(value, dim)
    if name in ("sum", "mean"):
        # one matrix operation instead of a chain of additions
        total = ca.sum2(ca.reshape(_select(value.column, rows.T), len(rows), size))
        return TracedValue(example, total / size if name == "mean" else total)
    total = _select(value.column, rows[:, 0])
    for k in range(1, size):
        total = _ELEMENTWISE_OPERATIONS[_REDUCTIONS[name]](total, _select(value.column, rows[:, k]))
    return TracedValue(example, total)


def _lower_extremum(
    name: Literal["max", "min"], example: Any, value: TracedValue, dim: int
) -> list[TracedValue]:
    """Return the largest or smallest entries along a dimension, and their positions."""
    rows, size = _reduction_rows(value, dim)
    extremum = _select(value.column, rows[:, 0])
    position = ca.MX(ca.DM.zeros(len(rows), 1))
    for k in range(1, size):
        candidate = _select(value.column, rows[:, k])
        is_better = candidate > extremum if name == "max" else candidate < extremum
        extremum = ca.if_else(is_better, candidate, extremum)
        position = ca.if_else(is_better, k, position)
    return [TracedValue(example[0], extremum), TracedValue(example[1], position)]


def _scale(operand: Any, factor: float) -> Any:
    """Multiply an operand by the argument `alpha` or `beta` of an operation of torch."""
    value = _to_traced_value(operand)
    return (
        operand
        if factor == 1
        else lower_elementwise("mul", value.example * factor, value, float(factor))
    )


def _lower_power(example: Tensor, a: Any, b: Any) -> TracedValue:
    """Return a power; small exponents become products, which are faster and exact at a < 0."""
    power = _to_traced_value(b)
    exponent = float(power.example) if power.is_constant and power.example.numel() == 1 else None
    if exponent in (0.5, -1.0, 2.0):
        return lower_elementwise(
            {0.5: "sqrt", -1.0: "reciprocal", 2.0: "square"}[exponent], example, a
        )
    if exponent in (3.0, 4.0):
        square = lower_elementwise("square", example, a)
        return lower_elementwise("mul", example, square, a if exponent == 3.0 else square)
    return lower_elementwise("pow", example, a, b)


def _lower_division(
    example: Tensor, a: Any, b: Any, rounding_mode: str | None = None
) -> TracedValue:
    """Return a quotient; the rounding mode is the name of an elementwise operation."""
    ratio = lower_elementwise("div", example, a, b)
    return ratio if rounding_mode is None else lower_elementwise(rounding_mode, example, ratio)


def _lower_clamp(
    example: Tensor, value: TracedValue, min: Any = None, max: Any = None
) -> TracedValue:
    """Return a clamped value; maximum and minimum propagate NaN as torch does."""
    clamped = value if min is None else lower_elementwise("maximum", example, value, min)
    return clamped if max is None else lower_elementwise("minimum", example, clamped, max)


def _lower_cast(example: Tensor, value: TracedValue, *_: Any, **_settings: Any) -> TracedValue:
    """Return a value cast to another type; floating-point precisions are not distinguished."""
    source_dtype = value.example.dtype
    target_dtype = example.dtype
    if target_dtype == torch.bool and source_dtype != torch.bool:
        return lower_elementwise("ne", example, value, 0.0)
    if source_dtype.is_floating_point and not target_dtype.is_floating_point:
        return lower_elementwise("trunc", example, value)
    return TracedValue(example, value.column)


def _lower_copy(example: Tensor, value: TracedValue, source: TracedValue, *_: Any) -> TracedValue:
    """Return a source that is broadcast and cast to shape and type of `value`, as `copy_`."""
    return _lower_cast(
        example, lower_elementwise("add", source.example.expand(example.shape), source, 0.0)
    )


def _lower_product(
    example: Tensor,
    a: TracedValue,
    b: TracedValue,
    start: Any = None,
    beta: float = 1,
    alpha: float = 1,
) -> TracedValue:
    """Return beta start + alpha a b for matrices a [m, k] and b [k, n], as `torch.addmm`."""
    (m, k), n = a.example.shape, b.example.shape[1]
    # columns are in row order, and CasADi reshapes by columns: matrices are transposed
    transposed_b = (
        ca.MX(ca.DM(b.example.double().T.tolist())) if b.is_constant else ca.reshape(b.column, n, k)
    )
    product = TracedValue(
        example, ca.vec(ca.mtimes(transposed_b, ca.reshape(_scale(a, alpha).column, k, m)))
    )
    return (
        product
        if start is None
        else lower_elementwise("add", example, product, _scale(start, beta))
    )


def _lower_batched_products(example: Tensor, a: TracedValue, b: TracedValue) -> TracedValue:
    """Return the matrix products of two batches of matrices, as `torch.bmm`."""

    def matrix(value: TracedValue, i: int) -> TracedValue:
        column = None if value.expression is None else _select(value.column, value.indices[i])
        return TracedValue(value.example[i], column)

    parts = [
        _lower_product(example[i], matrix(a, i), matrix(b, i)).column for i in range(len(example))
    ]
    return TracedValue(example, ca.vertcat(*parts))


def _select_row(table: Any, indices: Tensor, position: Any) -> Any:
    """Return the row of a table at a position that is only known at run time.

    Args:
        table: column of the entries.
        indices: indices of the entries of each row [n, k].
        position: CasADi expression of the index of the row; clamped to the table.
    """
    rows, size = indices.shape
    if rows > _MAX_TABLE_ROWS:
        # an index at run time: fast, but without derivatives and not expandable to scalars
        row = ca.fmin(ca.fmax(position, 0.0), rows - 1.0)
        return ca.vec(_select(table, indices).get_nz(False, row * size + ca.DM(list(range(size)))))
    selected = _select(table, indices[0])
    for i in range(1, rows):
        selected = ca.if_else(position >= i, _select(table, indices[i]), selected)
    return selected


def _lower_index_select(
    example: Tensor, table: TracedValue, dim: int, index: TracedValue
) -> TracedValue:
    """Return rows along a dimension, as `torch.index_select`."""
    rows = table.indices.movedim(dim, 0)
    row_indices = rows.reshape(len(rows), -1)
    parts = [
        _select_row(table.column, row_indices, index.column[i])
        for i in range(index.example.numel())
    ]
    order = torch.arange(len(parts) * row_indices.shape[1]).reshape(len(parts), *rows.shape[1:])
    return TracedValue(example, _select(ca.vertcat(*parts), order.movedim(0, dim)))


def _lower_index(
    example: Tensor, table: TracedValue, indices: Sequence[TracedValue | None]
) -> TracedValue:
    """Return `table[index]` for one index tensor along the first dimension."""
    index = indices[0]
    if index is None or len(indices) > 1:
        raise ExportError(
            "a step indexes a tensor by several index tensors at once, which this format does not"
            " support; export it as torchscript"
        )
    return _lower_index_select(example, table, 0, index)


def _lower_gather(
    example: Tensor, value: TracedValue, dim: int, index: TracedValue, **_: Any
) -> TracedValue:
    """Return entries along a dimension at positions of each row, as `torch.gather`."""
    table_indices = value.indices.movedim(dim, -1)
    index_positions = index.indices.movedim(dim, -1)
    table_indices = table_indices[
        tuple(slice(size) for size in index_positions.shape[:-1])
    ].reshape(-1, table_indices.shape[-1])
    parts = [
        _select_row(value.column, row[:, None], index.column[position])
        for row, row_positions in zip(
            table_indices,
            index_positions.reshape(-1, index_positions.shape[-1]).tolist(),
            strict=True,
        )
        for position in row_positions
    ]
    order = torch.arange(len(parts)).reshape(index_positions.shape).movedim(-1, dim)
    return TracedValue(example, _select(ca.vertcat(*parts), order))


_SPECIAL_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "add": lambda e, a, b, alpha=1: lower_elementwise("add", e, a, _scale(b, alpha)),
    "sub": lambda e, a, b, alpha=1: lower_elementwise("sub", e, a, _scale(b, alpha)),
    "rsub": lambda e, a, b, alpha=1: lower_elementwise("sub", e, b, _scale(a, alpha)),
    "div": _lower_division, "pow": _lower_power, "clamp": _lower_clamp, "_to": _lower_cast,
    "copy": _lower_copy,
    "mm": _lower_product, "bmm": _lower_batched_products,
    "addmm": lambda e, start, a, b, beta=1, alpha=1: _lower_product(e, a, b, start, beta, alpha),
    "max": lambda e, x, dim, keepdim=False: _lower_extremum("max", e, x, dim),
    "min": lambda e, x, dim, keepdim=False: _lower_extremum("min", e, x, dim),
    "argmax": lambda e, x, dim=None, keepdim=False: _lower_extremum("max", (e, e), x, dim)[1],
    "argmin": lambda e, x, dim=None, keepdim=False: _lower_extremum("min", (e, e), x, dim)[1],
    "index_select": _lower_index_select, "index": _lower_index, "gather": _lower_gather,
}  # fmt: skip
"""Operations with an individual rule, because of their arguments."""
