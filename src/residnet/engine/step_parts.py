"""Split a step into a scalar CasADi function, matrix products and a part that all rows share.

Loops over the matrix products are faster than their scalar operations, and the shared part is
evaluated once for all rows and steps of a rollout.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn
from torch.fx import Graph, GraphModule, Node

from residnet.engine.lowering import (
    TracedValue,
    get_placeholders,
    lower_elementwise,
    lower_graph,
    require_deterministic,
)
from residnet.engine.trace import SHAPE_ONLY_OPERATIONS, operation_name, record_graph


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
    require_deterministic(graph, model_name)
    shared_part = _extract_shared_part(graph, [example for _, example in rows], shared)
    columns = [ca.MX.sym(name, example.shape[1]) for name, example in rows]
    theta = ca.MX.sym(
        "theta", sum(shared_part.tensors[k].numel() for k in shared_part.theta_indices)
    )
    values: dict[Node, Any] = {
        placeholder: TracedValue(example, column)
        for placeholder, (_, example), column in zip(
            get_placeholders(graph), rows, columns, strict=False
        )
    }
    values |= shared_part.bind_to(theta)
    extraction = _ProductExtraction(shared_part)
    outputs = lower_graph(graph, values, model_name, extraction.replace_operation)
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
                values[node] = TracedValue(example, theta[offset : offset + example.numel()])
                offset += example.numel()
            else:
                values[node] = TracedValue(example)
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
    placeholders = get_placeholders(graph)
    shared_placeholders = placeholders[len(row_examples) :]
    shared_nodes: dict[Node, None] = dict.fromkeys(shared_placeholders)
    # constants are neither shared nor of a row, so that they do not decide what a node is
    constant_nodes: dict[Node, None] = {}
    for node in graph.nodes:
        inputs = node.all_input_nodes
        if node.op == "get_attr" or (
            node.op == "call_function" and operation_name(node.target) in SHAPE_ONLY_OPERATIONS
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

    def replace_operation(self, node: Node, args: Any) -> TracedValue | None:
        """Return the symbol that replaces the result of a node; None for other operations."""
        if (matrix := self._shared_part.matrix_of(node)) is not None:
            return self._replace_product(matrix, args)
        if node.target is torch.ops.aten.detach.default and not args[0].is_constant:
            symbol = ca.MX.sym(f"detached_{len(self.detached)}", args[0].column.numel())
            self.detached.append((symbol, args[0].column))
            return TracedValue(args[0].example, symbol)
        activation = operation_name(node.target)
        if activation not in ACTIVATIONS or args[0].is_constant:
            return None
        n_units = args[0].column.numel()
        if n_units < _MIN_UNITS:
            return None
        product = RowProduct(1, n_units, n_units, activation=activation)
        symbol = self._append(product, args[0].column)
        return TracedValue(getattr(torch, activation)(args[0].example), symbol)

    def _replace_product(self, matrix: Node, args: Any) -> TracedValue:
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
        value = TracedValue(example, ca.vertcat(*symbols))
        if bias is None:
            return value
        return lower_elementwise("add", example + bias.example, value, bias)

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


def _extract_subgraph(
    graph: Graph,
    inputs: Sequence[Node],
    results: Sequence[Node],
    constants: Mapping[Node, Any] = MappingProxyType({}),
) -> GraphModule:
    """Return the subgraph that computes some nodes from others.

    Args:
        graph: the recorded graph.
        inputs: nodes that become arguments.
        results: nodes that become results.
        constants: values of nodes that become buffers.
    """
    subgraph = Graph()
    owner = nn.Module()
    copies: dict[Node, Node] = {}

    def copy_node(node: Node) -> Node:
        if node not in copies:
            if node in constants:
                name = f"constant_{len(copies)}"
                owner.register_buffer(name, constants[node])
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
