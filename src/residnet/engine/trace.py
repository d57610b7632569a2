"""Record the step of a module as a graph of torch's core operations.

The graph is the common source of derivatives, compiled code and exports (`engine.lowering`).
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node
from torch.fx.node import map_aggregate
from torch.utils._python_dispatch import TorchDispatchMode

from residnet.core.errors import ExportError

DATA_MOVEMENTS: Final = {
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
SHAPE_ONLY_OPERATIONS: Final = frozenset(
    (
        "full_like", "zeros_like", "ones_like", "empty_like", "new_zeros", "new_ones", "new_full",
        "new_empty",
    )
)  # fmt: skip
"""Operations whose result depends on the shape of their argument only."""


def operation_name(target: Any) -> str:
    """Return the name of an operation of torch without its namespace; empty for others."""
    schema = getattr(target, "_schema", None)
    return schema.name.removeprefix("aten::").removesuffix("_copy") if schema else ""


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
        for rule in filter(None, () if operation_name(func) in DATA_MOVEMENTS else rules):
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
                    f"{operation_name(func)} converts a tensor that varies to a Python number"
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
