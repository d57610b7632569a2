"""Lower the step of a module to a CasADi function, from which C and other formats are generated.

Torch records the step of one row as a graph of its core operations. A tensor becomes a CasADi
column of its entries in row order, so that data movements become lists of indices.
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn
from torch.fx import Graph, GraphModule, Node
from torch.fx.node import map_aggregate
from torch.utils import _pytree as tree
from torch.utils._python_dispatch import TorchDispatchMode

from residnet.core.errors import ExportError

_DATA_MOVEMENT: Final = {
    **dict.fromkeys(
        (
            "alias", "clone", "detach", "lift_fresh_copy", "view", "_unsafe_view", "reshape",
            "permute", "t", "transpose", "expand", "select", "slice", "unsqueeze", "squeeze",
            "index_select", "index", "gather", "flip", "roll", "repeat", "unbind", "split",
            "split_with_sizes", "chunk", "diagonal", "unfold", "contiguous", "cat", "stack",
        ),
        (0,),
    ),
    "slice_scatter": (0, 1), "select_scatter": (0, 1), "index_copy": (0, 3),
}  # fmt: skip
"""Operations that only move entries of tensors, with the positions of the tensors among their
arguments.
"""
_SHAPE_ONLY: Final = frozenset(
    (
        "full_like", "zeros_like", "ones_like", "empty_like", "new_zeros", "new_ones", "new_full",
        "new_empty",
    )
)  # fmt: skip
"""Operations whose result depends on the shape of their argument only."""
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
    _require_deterministic(graph, model_name)
    values = dict(zip(_get_placeholders(graph), map(_TracedValue, examples, symbols), strict=True))
    results_columns = _lower_graph(graph, values, model_name)
    return ca.Function(
        "step", symbols, results_columns, [name for name, _ in arguments], list(results)
    )


def _require_deterministic(graph: Graph, model_name: str) -> None:
    """Refuse a step that draws random numbers, such as dropout in training.

    Raises:
        ExportError: if the graph has such an operation.
    """
    for node in graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise ExportError(f"{model_name}: its step draws random numbers ({node.target})")


def _get_placeholders(graph: Graph) -> list[Node]:
    return [node for node in graph.nodes if node.op == "placeholder"]


def _lower_graph(
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
            values[node] = _TracedValue(
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


@dataclass(frozen=True)
class RowProduct:
    """A product of vectors of each row with a matrix that all rows share, or an activation.

    Attributes:
        n_repeats: number of vectors of a row that are multiplied with the matrix.
        n_inputs: length of a vector.
        n_outputs: length of a product; the matrix is [n_inputs, n_outputs].
        matrix_index: index of the tensor with the matrix in the results of `StepParts.prepare`.
        matrix_member: index of the matrix in this tensor, where it holds several.
        activation: name of the elementwise function in place of a product; empty for a product.
    """

    n_repeats: int
    n_inputs: int
    n_outputs: int
    matrix_index: int = -1
    matrix_member: int = 0
    activation: str = ""

    @property
    def matrix_size(self) -> int:
        """Number of entries of the matrix."""
        return 0 if self.activation else self.n_inputs * self.n_outputs


@dataclass(frozen=True)
class StepParts:
    """A step split into computations that rows share, matrix products, and the remainder.

    Attributes:
        function: the remainder. Its arguments are the arguments of a row, `theta`, the results
            `product_<k>` of the products, and the values `detached_<k>` that the step detaches. It
            returns the factors `factor_<k>` of the products, then the results of the step, then
            `detached_<k>_value`. A factor depends on previous products alone.
        prepare: computes what depends on shared tensors alone, from these tensors.
        theta_indices: results of `prepare` whose entries are concatenated to `theta`.
        products: the products, in order of execution.
    """

    function: ca.Function
    prepare: GraphModule
    theta_indices: Sequence[int]
    products: Sequence[RowProduct]


_MIN_MATRIX_SIZE: Final = 64
"""Smallest matrix, in entries, whose products become loops; smaller ones are unrolled."""
ACTIVATIONS: Final = ("tanh", "sigmoid")
"""Activation functions that become loops over units; their derivatives follow from their values."""
_MIN_UNITS: Final = 8
"""Smallest layer, in units, whose activations become loops."""


def split_step(
    step: Callable[..., Any],
    rows: Sequence[tuple[str, Tensor]],
    shared: Sequence[Tensor],
    results: Sequence[str],
    model_name: str,
) -> StepParts:
    """Split a step into the parts of `StepParts`.

    Args:
        step: function of the arguments of a row, then of the shared tensors; float64.
        rows: names and examples [1, size] of the arguments of a row.
        shared: tensors of any shape that all rows share.
        results: names of the results of the step.
        model_name: name of the model, for messages.

    Raises:
        ExportError: if an operation is not supported, or Python branches on values.
    """
    graph = record_graph(step, [*(example for _, example in rows), *shared], model_name)
    _require_deterministic(graph, model_name)
    shared_part = _extract_shared_part(graph, [example for _, example in rows], shared)
    columns = [ca.MX.sym(name, example.shape[1]) for name, example in rows]
    theta = ca.MX.sym(
        "theta", sum(shared_part.tensors[k].numel() for k in shared_part.theta_indices)
    )
    values: dict[Node, Any] = {
        placeholder: _TracedValue(example, column)
        for placeholder, (_, example), column in zip(
            _get_placeholders(graph), rows, columns, strict=False
        )
    }
    values |= shared_part.bind_to(theta)
    extraction = _ProductExtraction(shared_part)
    outputs = _lower_graph(graph, values, model_name, extraction.replace_operation)
    detached_columns = [column for _, column in extraction.detached]
    results_columns = extraction.drop_unused_units(
        [*extraction.factors, *outputs, *detached_columns]
    )
    n_products = len(extraction.products)
    detached_names = [f"detached_{k}" for k in range(len(extraction.detached))]
    argument_names = [
        *(name for name, _ in rows),
        "theta",
        *(f"product_{k}" for k in range(n_products)),
        *detached_names,
    ]
    result_names = [
        *(f"factor_{k}" for k in range(n_products)),
        *results,
        *(f"{name}_value" for name in detached_names),
    ]
    detached_symbols = [symbol for symbol, _ in extraction.detached]
    function = ca.Function(
        "step",
        [*columns, theta, *extraction.symbols, *detached_symbols],
        results_columns,
        argument_names,
        result_names,
    )
    return StepParts(function, shared_part.prepare, shared_part.theta_indices, extraction.products)


@dataclass(frozen=True)
class _SharedPart:
    """The part of a graph that depends on shared tensors alone.

    Attributes:
        nodes: nodes of this part.
        boundary: shared nodes whose values nodes outside this part use.
        prepare: computes the values of `boundary` from the shared tensors.
        tensors: values of `boundary` at the examples.
        theta_indices: indices in `boundary` of the values that are concatenated to `theta`: all but
            the matrices of products, which are stored as tables.
    """

    nodes: Mapping[Node, None]
    boundary: Sequence[Node]
    prepare: GraphModule
    tensors: Sequence[Tensor]
    theta_indices: Sequence[int]

    def matrix_of(self, node: Node) -> Node | None:
        """Return the matrix of this part that a node multiplies rows with; None for other nodes."""
        return _find_shared_matrix(node, self.nodes)

    def bind_to(self, theta: Any) -> dict[Node, Any]:
        """Return the values of the shared nodes as entries of the CasADi symbol `theta`."""
        # `prepare` computes the nodes inside this part; they have no value in a step
        values: dict[Node, Any] = dict.fromkeys(self.nodes)
        offset = 0
        for k, (node, example) in enumerate(zip(self.boundary, self.tensors, strict=True)):
            if k in self.theta_indices:
                values[node] = _TracedValue(example, theta[offset : offset + example.numel()])
                offset += example.numel()
            else:
                values[node] = _TracedValue(example)
        return values


def _find_shared_matrix(node: Node, shared_nodes: Mapping[Node, None]) -> Node | None:
    """Return the shared matrix that a node multiplies rows with; None for other nodes."""
    if node in shared_nodes or node.target not in _MATRIX_PRODUCTS or node.kwargs:
        return None
    a, b = node.args[-2:]
    is_shared = isinstance(b, Node) and b in shared_nodes and a not in shared_nodes
    return b if isinstance(b, Node) and is_shared and b.meta["size"] >= _MIN_MATRIX_SIZE else None


def _extract_shared_part(
    graph: Graph, row_examples: Sequence[Tensor], shared: Sequence[Tensor]
) -> _SharedPart:
    """Separate the nodes that depend on shared tensors alone from the nodes of a row.

    Args:
        graph: the recorded step; the size of each boundary node is added to its `meta`.
        row_examples: examples of the arguments of a row, which come first in the graph.
        shared: the shared tensors.
    """
    placeholders = _get_placeholders(graph)
    shared_placeholders = placeholders[len(row_examples) :]
    shared_nodes: dict[Node, None] = dict.fromkeys(shared_placeholders)
    # constants depend on nothing: they must not make a node of a row a shared one, or vice versa
    constant_nodes: dict[Node, None] = {}
    for node in graph.nodes:
        inputs = node.all_input_nodes
        if node.op == "get_attr" or (
            node.op == "call_function" and _operation_name(node.target) in _SHAPE_ONLY
        ):
            constant_nodes[node] = None
        elif node.op == "call_function":
            if all(source in constant_nodes for source in inputs):
                constant_nodes[node] = None
            elif all(source in shared_nodes or source in constant_nodes for source in inputs):
                shared_nodes[node] = None
    boundary = [
        node for node in shared_nodes if any(user not in shared_nodes for user in node.users)
    ]
    constant_graph = _extract_subgraph(graph, placeholders, list(constant_nodes))
    with torch.no_grad():
        constants = constant_graph(*row_examples, *shared)
        prepare = _extract_subgraph(
            graph,
            shared_placeholders,
            boundary,
            dict(zip(constant_nodes, constants, strict=True)),
        )
        tensors = prepare(*shared)
    for node, example in zip(boundary, tensors, strict=True):
        node.meta["size"] = example.numel()
    theta_indices = [
        k
        for k, node in enumerate(boundary)
        if any(
            user not in shared_nodes and _find_shared_matrix(user, shared_nodes) is not node
            for user in node.users
        )
    ]
    return _SharedPart(shared_nodes, boundary, prepare, tensors, theta_indices)


class _ProductExtraction:
    """Replaces matrix products, activations and detached values by symbols.

    It is used while a graph is converted. The remaining step is a small function of scalars, and a
    caller computes the replaced values with loops.

    Attributes:
        symbols: symbols of the results of the products, in order of execution.
        factors: columns that are multiplied, or that the activation is applied to.
        products: shapes of the products.
        detached: symbol and column of each detached value.
    """

    def __init__(self, shared_part: _SharedPart) -> None:
        self._shared_part = shared_part
        self.symbols: list[Any] = []
        self.factors: list[Any] = []
        self.products: list[RowProduct] = []
        self.detached: list[tuple[Any, Any]] = []

    def replace_operation(self, node: Node, args: Any) -> _TracedValue | None:
        """Return the symbol that replaces the result of a node; None for other operations."""
        if (matrix := self._shared_part.matrix_of(node)) is not None:
            return self._replace_product(matrix, args)
        if node.target is torch.ops.aten.detach.default and not args[0].is_constant:
            symbol = ca.MX.sym(f"detached_{len(self.detached)}", args[0].column.numel())
            self.detached.append((symbol, args[0].column))
            return _TracedValue(args[0].example, symbol)
        activation = _operation_name(node.target)
        if activation not in ACTIVATIONS or args[0].is_constant:
            return None
        n_units = args[0].column.numel()
        if n_units < _MIN_UNITS:
            return None
        product = RowProduct(1, n_units, n_units, activation=activation)
        symbol = self._append(product, args[0].column)
        return _TracedValue(getattr(torch, activation)(args[0].example), symbol)

    def _replace_product(self, matrix: Node, args: Any) -> _TracedValue:
        """Return the symbol of a product of rows with a shared matrix, plus its bias."""
        bias, a, b = (None, *args) if len(args) == 2 else args
        example = a.example @ b.example
        (n_repeats, n_inputs) = a.example.shape[-2:]
        n_outputs = b.example.shape[-1]
        matrix_index = self._shared_part.boundary.index(matrix)
        # a batched product (bmm) has several matrices in one tensor
        n_matrices = b.example.numel() // (n_inputs * n_outputs)
        n_factors = n_repeats * n_inputs
        symbols = [
            self._append(
                RowProduct(n_repeats, n_inputs, n_outputs, matrix_index, member),
                a.column[member * n_factors : (member + 1) * n_factors],
            )
            for member in range(n_matrices)
        ]
        value = _TracedValue(example, ca.vertcat(*symbols))
        if bias is None:
            return value
        return _lower_elementwise("add", example + bias.example, value, bias)

    def _append(self, product: RowProduct, factor: Any) -> Any:
        """Append a product and return the symbol of its result."""
        symbol = ca.MX.sym(f"product_{len(self.products)}", product.n_repeats * product.n_outputs)
        self.symbols.append(symbol)
        self.factors.append(factor)
        self.products.append(product)
        return symbol

    def drop_unused_units(self, columns: list[Any]) -> list[Any]:
        """Remove the units of activations that no column depends on.

        Networks evaluate more units than they use, for example all gates at once.

        Args:
            columns: all results of the step; the factors of the products come first.

        Returns:
            The columns as functions of the reduced symbols.
        """
        for k, product in enumerate(list(self.products)):
            if not product.activation:
                continue
            is_used = ca.which_depends(ca.veccat(*columns), self.symbols[k])
            used_units = np.flatnonzero(is_used).tolist()
            if len(used_units) == product.n_inputs:
                continue
            reduced = ca.MX.sym(self.symbols[k].name(), len(used_units))
            expanded = ca.MX.zeros(product.n_inputs)
            expanded[used_units] = reduced
            columns = ca.substitute(columns, [self.symbols[k]], [expanded])
            columns[k] = columns[k][used_units]
            self.symbols[k] = reduced
            self.products[k] = RowProduct(
                1, len(used_units), len(used_units), activation=product.activation
            )
        return columns


_MATRIX_PRODUCTS: Final = tuple(
    getattr(torch.ops.aten, name).default for name in ("mm", "addmm", "bmm")
)


def _operation_name(target: Any) -> str:
    """Return the name of an operation of torch without its namespace; empty for others."""
    schema = getattr(target, "_schema", None)
    return schema.name.removeprefix("aten::").removesuffix("_copy") if schema else ""


def _extract_subgraph(
    graph: Graph,
    inputs: Sequence[Node],
    results: Sequence[Node],
    constant: Mapping[Node, Any] = MappingProxyType({}),
) -> GraphModule:
    """Return the subgraph that computes some nodes from others.

    Args:
        graph: the recorded graph.
        inputs: nodes that become arguments.
        results: nodes that become results.
        constant: values of nodes that become buffers.
    """
    subgraph = Graph()
    owner = nn.Module()
    copies: dict[Node, Node] = {}

    def copy_node(node: Node) -> Node:
        if node not in copies:
            if node in constant:
                name = f"constant_{len(copies)}"
                owner.register_buffer(name, constant[node])
                copies[node] = subgraph.get_attr(name)
            elif node.op == "get_attr":
                name = f"constant_{len(copies)}"
                owner.register_buffer(
                    name, operator.attrgetter(str(node.target))(graph.owning_module).detach()
                )
                copies[node] = subgraph.get_attr(name)
            else:
                copies[node] = subgraph.node_copy(node, copy_node)
        return copies[node]

    for node in inputs:
        copies[node] = subgraph.placeholder(node.name)
    subgraph.output(tuple(copy_node(node) for node in results))
    return GraphModule(owner, subgraph)


def to_scalar_function(function: ca.Function) -> ca.Function:
    """Expand a CasADi function to scalar operations, unless it looks up a long table."""
    instructions = range(function.n_instructions())
    if any(function.instruction_id(k) == ca.OP_GETNONZEROS_PARAM for k in instructions):
        return function
    symbols = [ca.SX.sym(name, function.numel_in(name)) for name in function.name_in()]
    results = ca.cse([*function.call(symbols)])
    return ca.Function("step", symbols, results, function.name_in(), function.name_out())


def record_graph(step: Callable[..., Any], examples: Sequence[Tensor], model_name: str) -> Graph:
    """Record the operations of a step on examples as a graph.

    The constants of the graph are buffers of the module that owns it.

    Raises:
        ExportError: if Python branches on values.
    """
    from torch.func import functionalize

    # in-place operations become out-of-place ones, so that each node has one value
    wrapped = functionalize(lambda *arguments: step(*arguments), remove="mutations")
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            return _Recorder().record(wrapped, examples)
    except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
        message_lines = str(error).strip().splitlines()
        reason = message_lines[0] if message_lines else type(error).__name__
        raise ExportError(
            f"{model_name}: its step cannot be recorded as a fixed sequence of operations"
            f" ({reason}); write it with operations on tensors alone, torch.where instead of `if`"
        ) from error


class _Recorder(TorchDispatchMode):
    """Records the core operations of torch that run in its context.

    `make_fx` does the same, but imports torch's compiler, which takes 2 s.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return False: otherwise torch imports its compiler to disable it here."""
        return False

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        # `core_aten_decompositions` also collects those of each operation, which takes 60 ms
        from torch._decomp import _core_aten_decompositions_post_autograd

        self._rules: Any = _core_aten_decompositions_post_autograd()
        self._owner = GraphModule({}, Graph())
        self._graph = Graph(self._owner)
        # the tensors are stored too: Python may reuse the id of a deleted one
        self._nodes: dict[int, tuple[Node, Tensor]] = {}
        self._varying: set[Node] = set()

    def record(self, step: Callable[..., Any], examples: Sequence[Tensor]) -> Graph:
        """Record the operations of a step on example arguments as a graph without dead code."""
        for k, example in enumerate(examples):
            self._nodes[id(example)] = self._graph.placeholder(f"given_{k}"), example
        self._varying.update(node for node, _ in self._nodes.values())
        with self:
            results = step(*examples)
        self._graph.output(map_aggregate(results, self._node_of))
        self._graph.eliminate_dead_code()
        return self._graph

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        keyword_arguments = kwargs or {}
        # data movements are not decomposed: torch's rules would hide a detach and import sympy
        rules = (self._rules.get(func), func.decompose)
        for rule in filter(None, () if _operation_name(func) in _DATA_MOVEMENT else rules):
            with self:
                # with the mode active the rule's own operations are recorded
                result = rule(*args, **keyword_arguments)
            if result is not NotImplemented:
                return result
        node = self._graph.call_function(
            func, *map_aggregate((args, keyword_arguments), self._node_of)
        )
        if not self._varying.isdisjoint(node.all_input_nodes):
            self._varying.add(node)
            if torch.Tag.data_dependent_output in func.tags:
                raise RuntimeError(
                    f"{_operation_name(func)} converts a tensor that varies to a Python number"
                )
        result = func(*args, **keyword_arguments)
        self._register(node, result)
        return result

    def _register(self, node: Node, result: Any) -> None:
        """Record that the tensors of a result are computed by a node."""
        if isinstance(result, Tensor):
            self._nodes[id(result)] = node, result
        elif isinstance(result, list | tuple):
            for k, element in enumerate(result):
                # operations such as split return several tensors: each is an item of the node's
                # result
                element_node = self._graph.call_function(operator.getitem, (node, k))
                self._varying |= {element_node} if node in self._varying else set()
                self._register(element_node, element)

    def _node_of(self, value: Any) -> Any:
        """Return the node of a tensor; other values are returned unchanged."""
        if not isinstance(value, Tensor):
            return value
        if id(value) not in self._nodes:
            name = f"constant_{len(self._nodes)}"
            self._owner.register_buffer(name, value)
            self._nodes[id(value)] = self._graph.get_attr(name), value
        return self._nodes[id(value)][0]


@dataclass
class _TracedValue:
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


def _to_traced_value(value: Any) -> _TracedValue:
    """Return a value of the graph; Python numbers become constants."""
    if isinstance(value, _TracedValue):
        return value
    dtype = torch.bool if isinstance(value, bool) else torch.float64
    return _TracedValue(torch.tensor(value, dtype=dtype))


def _lower_elementwise(operation: str, example: Tensor, *values: Any) -> _TracedValue:
    """Return an elementwise operation on values broadcast to the shape of the example."""
    columns = []
    for value in map(_to_traced_value, values):
        indices = value.indices.expand(np.broadcast_shapes(value.example.shape, example.shape))
        is_scalar = value.example.numel() == 1
        columns.append(value.column if is_scalar else _select(value.column, indices))
    result = _ELEMENTWISE_OPERATIONS[operation](*columns)
    return _TracedValue(
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
    name = _operation_name(target)
    leaves = [
        leaf
        for leaf in tree.tree_leaves((args, keyword_arguments))
        if isinstance(leaf, _TracedValue)
    ]

    def to_examples(part: Any) -> Any:
        return map_aggregate(
            part, lambda leaf: leaf.example if isinstance(leaf, _TracedValue) else leaf
        )

    # torch itself computes the shape of the result
    example = target(*to_examples(args), **to_examples(keyword_arguments))
    if name in _SHAPE_ONLY or all(leaf.is_constant for leaf in leaves):
        return (
            _TracedValue(example) if isinstance(example, Tensor) else [*map(_TracedValue, example)]
        )
    moved_arguments = _DATA_MOVEMENT.get(name, ())
    other_leaves = [
        leaf
        for i, arg in enumerate(args)
        if i not in moved_arguments
        for leaf in tree.tree_leaves(arg)
    ]
    # the same movement of the indices gives the entries of the result, unless it depends on values
    if moved_arguments and all(
        leaf.is_constant for leaf in other_leaves if isinstance(leaf, _TracedValue)
    ):
        return _lower_data_movement(
            target, args, to_examples, moved_arguments, to_examples(keyword_arguments), example
        )
    if name in _SPECIAL_OPERATIONS:
        return _SPECIAL_OPERATIONS[name](example, *args, **keyword_arguments)
    if name in _ELEMENTWISE_OPERATIONS and not keyword_arguments:
        return _lower_elementwise(name, example, *args)
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
        if not isinstance(leaf, _TracedValue):
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
        return _TracedValue(example, _select(all_columns, indices))
    return [
        _TracedValue(element, _select(all_columns, element_indices))
        for element, element_indices in zip(example, indices, strict=True)
    ]


def _reduction_rows(value: _TracedValue, dim: Any) -> tuple[Tensor, int]:
    """Return the indices [rows, n] of the entries that a reduction along `dim` combines, and n."""
    indices = value.indices
    dimensions = list(range(indices.dim()))
    requested = [dim] if isinstance(dim, int) else dim
    reduced = [d % indices.dim() for d in requested] if requested else dimensions
    reordered = indices.permute(*(d for d in dimensions if d not in reduced), *reduced)
    size = 1
    for d in reduced:
        size *= indices.shape[d]
    return reordered.reshape(-1, size), size


def _lower_reduction(
    name: str,
    example: Tensor,
    value: _TracedValue,
    dim: Any = None,
    keepdim: bool = False,
    **_: Any,
) -> _TracedValue:
    """Return a sum, mean, extremum, product or logical combination along dimensions.

    Args:
        name: key of `_REDUCTIONS`.
        example: result at the examples.
        value: tensor that is reduced.
        dim: dimension or dimensions; None for all.
        keepdim: ignored, because the shape of `example` has the answer.
    """
    rows, size = _reduction_rows(value, dim)
    if name in ("sum", "mean"):
        # one matrix operation instead of a chain of additions
        total = ca.sum2(ca.reshape(_select(value.column, rows.T), len(rows), size))
        return _TracedValue(example, total / size if name == "mean" else total)
    total = _select(value.column, rows[:, 0])
    for k in range(1, size):
        total = _ELEMENTWISE_OPERATIONS[_REDUCTIONS[name]](total, _select(value.column, rows[:, k]))
    return _TracedValue(example, total)


def _lower_extremum(
    name: Literal["max", "min"], example: Any, value: _TracedValue, dim: int
) -> list[_TracedValue]:
    """Return the largest or smallest entries along a dimension, and their positions."""
    rows, size = _reduction_rows(value, dim)
    extremum = _select(value.column, rows[:, 0])
    position = ca.MX(ca.DM.zeros(len(rows), 1))
    for k in range(1, size):
        candidate = _select(value.column, rows[:, k])
        is_better = candidate > extremum if name == "max" else candidate < extremum
        extremum = ca.if_else(is_better, candidate, extremum)
        position = ca.if_else(is_better, k, position)
    return [_TracedValue(example[0], extremum), _TracedValue(example[1], position)]


def _scale(operand: Any, factor: float) -> Any:
    """Multiply an operand by the argument `alpha` or `beta` of an operation of torch."""
    value = _to_traced_value(operand)
    return (
        operand
        if factor == 1
        else _lower_elementwise("mul", value.example * factor, value, float(factor))
    )


def _lower_power(example: Tensor, a: Any, b: Any) -> _TracedValue:
    """Return a power; small exponents become products, which are faster and exact at a < 0."""
    power = _to_traced_value(b)
    exponent = float(power.example) if power.is_constant and power.example.numel() == 1 else None
    if exponent in (0.5, -1.0, 2.0):
        return _lower_elementwise(
            {0.5: "sqrt", -1.0: "reciprocal", 2.0: "square"}[exponent], example, a
        )
    if exponent in (3.0, 4.0):
        square = _lower_elementwise("square", example, a)
        return _lower_elementwise("mul", example, square, a if exponent == 3.0 else square)
    return _lower_elementwise("pow", example, a, b)


def _lower_division(
    example: Tensor, a: Any, b: Any, rounding_mode: str | None = None
) -> _TracedValue:
    """Return a quotient; the rounding mode is the name of an elementwise operation."""
    ratio = _lower_elementwise("div", example, a, b)
    return ratio if rounding_mode is None else _lower_elementwise(rounding_mode, example, ratio)


def _lower_clamp(
    example: Tensor, value: _TracedValue, min: Any = None, max: Any = None
) -> _TracedValue:
    """Return a clamped value; maximum and minimum propagate NaN as torch does."""
    clamped = value if min is None else _lower_elementwise("maximum", example, value, min)
    return clamped if max is None else _lower_elementwise("minimum", example, clamped, max)


def _lower_cast(example: Tensor, value: _TracedValue, *_: Any, **_settings: Any) -> _TracedValue:
    """Return a value cast to another type; floating-point precisions are not distinguished."""
    source_dtype = value.example.dtype
    target_dtype = example.dtype
    if target_dtype == torch.bool and source_dtype != torch.bool:
        return _lower_elementwise("ne", example, value, 0.0)
    if source_dtype.is_floating_point and not target_dtype.is_floating_point:
        return _lower_elementwise("trunc", example, value)
    return _TracedValue(example, value.column)


def _lower_copy(
    example: Tensor, value: _TracedValue, source: _TracedValue, *_: Any
) -> _TracedValue:
    """Return a source that is broadcast and cast to shape and type of `value`, as `copy_`."""
    return _lower_cast(
        example, _lower_elementwise("add", source.example.expand(example.shape), source, 0.0)
    )


def _lower_product(
    example: Tensor,
    a: _TracedValue,
    b: _TracedValue,
    start: Any = None,
    beta: float = 1,
    alpha: float = 1,
) -> _TracedValue:
    """Return beta start + alpha a b for matrices a [m, k] and b [k, n], as `torch.addmm`."""
    (m, k), n = a.example.shape, b.example.shape[1]
    # columns are in row order, and CasADi reshapes by columns: matrices are transposed
    transposed_b = (
        ca.MX(ca.DM(b.example.double().T.tolist())) if b.is_constant else ca.reshape(b.column, n, k)
    )
    product = _TracedValue(
        example, ca.vec(ca.mtimes(transposed_b, ca.reshape(_scale(a, alpha).column, k, m)))
    )
    return (
        product
        if start is None
        else _lower_elementwise("add", example, product, _scale(start, beta))
    )


def _lower_batched_products(example: Tensor, a: _TracedValue, b: _TracedValue) -> _TracedValue:
    """Return the matrix products of two batches of matrices, as `torch.bmm`."""

    def matrix(value: _TracedValue, i: int) -> _TracedValue:
        column = None if value.expression is None else _select(value.column, value.indices[i])
        return _TracedValue(value.example[i], column)

    parts = [
        _lower_product(example[i], matrix(a, i), matrix(b, i)).column for i in range(len(example))
    ]
    return _TracedValue(example, ca.vertcat(*parts))


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
    example: Tensor, table: _TracedValue, dim: int, index: _TracedValue
) -> _TracedValue:
    """Return rows along a dimension, as `torch.index_select`."""
    rows = table.indices.movedim(dim, 0)
    row_indices = rows.reshape(len(rows), -1)
    parts = [
        _select_row(table.column, row_indices, index.column[i])
        for i in range(index.example.numel())
    ]
    order = torch.arange(len(parts) * row_indices.shape[1]).reshape(len(parts), *rows.shape[1:])
    return _TracedValue(example, _select(ca.vertcat(*parts), order.movedim(0, dim)))


def _lower_index(
    example: Tensor, table: _TracedValue, indices: Sequence[_TracedValue | None]
) -> _TracedValue:
    """Return `table[index]` for one index tensor along the first dimension."""
    index = indices[0]
    if index is None or len(indices) > 1:
        raise ExportError(
            "a step indexes a tensor by several index tensors at once, which this format does not"
            " support; export it as torchscript"
        )
    return _lower_index_select(example, table, 0, index)


def _lower_gather(
    example: Tensor, value: _TracedValue, dim: int, index: _TracedValue, **_: Any
) -> _TracedValue:
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
    return _TracedValue(example, _select(ca.vertcat(*parts), order))


_SPECIAL_OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "add": lambda e, a, b, alpha=1: _lower_elementwise("add", e, a, _scale(b, alpha)),
    "sub": lambda e, a, b, alpha=1: _lower_elementwise("sub", e, a, _scale(b, alpha)),
    "rsub": lambda e, a, b, alpha=1: _lower_elementwise("sub", e, b, _scale(a, alpha)),
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
