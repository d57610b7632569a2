"""A module's step as a CasADi function: every format that is no graph of torch is made from it.

Torch records the step for one row as a graph of its core operations. A tensor becomes a column of
its numbers in row order, so that whatever only moves numbers becomes a list of places.
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

_MOVES: Final = {
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
"""Operations that only move numbers, with the places of the arguments whose numbers are moved."""
_LIKE: Final = frozenset(
    (
        "full_like", "zeros_like", "ones_like", "empty_like", "new_zeros", "new_ones", "new_full",
        "new_empty",
    )
)  # fmt: skip
"""Operations whose result depends on the shape of their argument alone."""
_SHORT: Final = 64
"""Rows up to which a look-up is a chain of choices, which has derivatives and can be expanded: the
commands of a second under way at 50 Hz are so many.
"""


def _number(a: Any) -> Any:
    # CasADi takes a == a to be true
    return ca.logic_or(a <= 0, a > 0)


_ELEMENTWISE: Final[dict[str, Callable[..., Any]]] = {
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
    # comparisons with what is no number are false, so that it stays what it is
    "maximum": lambda a, b: ca.if_else(a < b, b, a),
    "minimum": lambda a, b: ca.if_else(a > b, b, a), "where": lambda c, a, b: ca.if_else(c, a, b),
    "isnan": lambda a: ca.logic_not(_number(a)),
    "isinf": lambda a: ca.eq(ca.fabs(a), ca.inf),
    **dict.fromkeys(("logical_not", "bitwise_not"), ca.logic_not),
    **dict.fromkeys(("logical_and", "bitwise_and"), ca.logic_and),
    **dict.fromkeys(("logical_or", "bitwise_or"), ca.logic_or),
    **dict.fromkeys(("logical_xor", "bitwise_xor"), ca.ne),
}  # fmt: skip
"""Operations on each element, on columns of one length or single numbers."""
_FOLDS: Final = {
    "sum": "add", "mean": "add", "amax": "maximum", "amin": "minimum", "prod": "mul",
    "any": "logical_or", "all": "logical_and",
}  # fmt: skip
"""Reductions, with the operation that joins two numbers."""


def lowered(
    step: Callable[..., Any],
    arguments: Sequence[tuple[str, int]],
    results: Sequence[str],
    what: str,
) -> ca.Function:
    """Return the CasADi function of a step for one row in float64.

    Args:
        step: of tensors [1, size], returns as many tensors as there are `results`.
        arguments: names and sizes.
        results: names.
        what: is lowered, for messages.

    Raises:
        ExportError: where an operation is not known, by its name, or Python decides by values.
    """
    examples = [torch.zeros(1, size, dtype=torch.float64) for _, size in arguments]
    columns = [ca.MX.sym(name, size) for name, size in arguments]
    graph = recorded(step, examples, what)
    values = dict(zip(_placeholders(graph), map(_Value, examples, columns), strict=True))
    found = _columns(graph, values, what)
    return ca.Function("step", columns, found, [name for name, _ in arguments], list(results))


def _placeholders(graph: Graph) -> list[Node]:
    return [node for node in graph.nodes if node.op == "placeholder"]


def _columns(
    graph: Graph,
    values: dict[Node, Any],
    what: str,
    instead: Callable[[Node, Any], Any] | None = None,
) -> list[Any]:
    """Return the columns of a graph's results.

    Args:
        graph: recorded.
        values: what is known of nodes already, to which all others are added.
        what: is lowered, for messages.
        instead: takes a node and its arguments, and returns its value, None for the usual one.
    """
    for node in graph.nodes:
        if node in values:
            continue
        if node.op == "get_attr":
            values[node] = _Value(
                operator.attrgetter(str(node.target))(graph.owning_module).detach()
            )
        elif node.op == "output":
            return [values[output].column for output in tree.tree_leaves(node.args[0])]
        else:
            args, settings = torch.fx.node.map_arg((node.args, node.kwargs), values.__getitem__)
            value = instead(node, args) if instead else None
            values[node] = _called(node.target, args, settings, what) if value is None else value
    raise AssertionError("a graph without results")


@dataclass(frozen=True)
class Product:
    """A product of numbers of each row with a matrix that all rows share, or a curve of each.

    Attributes:
        rows: times that each row is multiplied with the matrix, with other numbers each time.
        taken, given: numbers of a row, and of the result; the matrix is [taken, given].
        place: number of what holds the matrix among the results of `Parts.prepare`.
        member: number of the matrix in there, where several lie side by side.
        curve: the operation that takes the place of a product, with no matrix.
    """

    rows: int
    taken: int
    given: int
    place: int = -1
    member: int = 0
    curve: str = ""

    @property
    def numbers(self) -> int:
        """Numbers of the matrix."""
        return 0 if self.curve else self.taken * self.given


@dataclass(frozen=True)
class Parts:
    """A step, taken apart into what rows share, products with matrices, and all the rest.

    Attributes:
        function: of the arguments of a row, of `theta`, of `product_<k>`, the results of the
            products, and of `detached_<k>`, what the step detaches. It gives `factor_<k>`, what is
            multiplied, then the results of the step, then `detached_<k>_value`. A factor depends on
            no product but those before it.
        prepare: takes the shared numbers, and gives what follows from them alone.
        plain: numbers of what `prepare` gives whose entries make `theta`, one after the other.
        products: in the order in which they are found.
    """

    function: ca.Function
    prepare: GraphModule
    plain: Sequence[int]
    products: Sequence[Product]


_LEAST: Final = 64
"""Least numbers of a matrix whose products are loops; smaller ones are written out."""
CURVES: Final = ("tanh", "sigmoid")
"""Operations that are loops over a layer's units, and whose slopes follow from their values."""
_UNITS: Final = 8
"""Least units of a layer whose curves are loops."""


def in_parts(
    step: Callable[..., Any],
    rows: Sequence[tuple[str, Tensor]],
    shared: Sequence[Tensor],
    results: Sequence[str],
    what: str,
) -> Parts:
    """Return a step in parts; see `Parts`.

    Args:
        step: of the rows' arguments, then of the shared numbers; in float64.
        rows: names and examples [1, size] of the rows' arguments.
        shared: numbers of any shape that all rows share.
        results: names of what the step returns.
        what: is lowered, for messages.

    Raises:
        ExportError: as of `lowered`.
    """
    graph = recorded(step, [*(example for _, example in rows), *shared], what)
    places = _placeholders(graph)
    alone: dict[Node, None] = dict.fromkeys(places[len(rows) :])
    constant: dict[Node, None] = {}
    for node in graph.nodes:
        given = node.all_input_nodes
        if node.op == "get_attr" or (node.op == "call_function" and _name(node.target) in _LIKE):
            constant[node] = None
        elif node.op == "call_function":
            if all(one in constant for one in given):
                constant[node] = None
            elif all(one in alone or one in constant for one in given):
                alone[node] = None

    def matrix(node: Node) -> Node | None:
        """Return the shared matrix that rows are multiplied with."""
        if node in alone or node.target not in _PRODUCTS or node.kwargs:
            return None
        a, b = node.args[-2:]
        inside = isinstance(b, Node) and b in alone and a not in alone
        return b if isinstance(b, Node) and inside and b.meta["size"] >= _LEAST else None

    edge = [node for node in alone if any(user not in alone for user in node.users)]
    found_constant = _subgraph(graph, places, list(constant))
    with torch.no_grad():
        known = found_constant(*(example for _, example in rows), *shared)
        prepare = _subgraph(
            graph, places[len(rows) :], edge, dict(zip(constant, known, strict=True))
        )
        prepared = prepare(*shared)
    for node, example in zip(edge, prepared, strict=True):
        node.meta["size"] = example.numel()
    plain = [
        k
        for k, node in enumerate(edge)
        if any(user not in alone and matrix(user) is not node for user in node.users)
    ]
    columns = [ca.MX.sym(name, example.shape[1]) for name, example in rows]
    theta = ca.MX.sym("theta", sum(prepared[k].numel() for k in plain))
    values: dict[Node, Any] = {
        place: _Value(example, column)
        for place, (_, example), column in zip(places, rows, columns, strict=False)
    }
    # what shared numbers make of themselves is not evaluated here
    values.update(dict.fromkeys(alone))
    begin = 0
    for k, (node, example) in enumerate(zip(edge, prepared, strict=True)):
        if k in plain:
            values[node] = _Value(example, theta[begin : begin + example.numel()])
            begin += example.numel()
        else:
            values[node] = _Value(example)
    symbols: list[Any] = []
    factors: list[Any] = []
    products: list[Product] = []
    apart: list[tuple[Any, Any]] = []

    def instead(node: Node, args: Any) -> _Value | None:
        if (shared_matrix := matrix(node)) is not None:
            bias, a, b = (None, *args) if len(args) == 2 else args
            example = a.example @ b.example
            (times, taken), given = a.example.shape[-2:], b.example.shape[-1]
            first, count = len(products), b.example.numel() // (taken * given)
            for member in range(count):
                made = Product(times, taken, given, edge.index(shared_matrix), member)
                symbols.append(ca.MX.sym(f"product_{len(products)}", times * given))
                factors.append(a.column[member * times * taken : (member + 1) * times * taken])
                products.append(made)
            found = _Value(example, ca.vertcat(*symbols[first:]))
            return found if bias is None else _each("add", example + bias.example, found, bias)
        curve = _name(node.target)
        if curve in CURVES and not args[0].constant and args[0].column.numel() >= _UNITS:
            count = args[0].column.numel()
            symbols.append(ca.MX.sym(f"product_{len(products)}", count))
            factors.append(args[0].column)
            products.append(Product(1, count, count, curve=curve))
            return _Value(getattr(torch, curve)(args[0].example), symbols[-1])
        if node.target is torch.ops.aten.detach.default and not args[0].constant:
            symbol = ca.MX.sym(f"detached_{len(apart)}", args[0].column.numel())
            apart.append((symbol, args[0].column))
            return _Value(args[0].example, symbol)
        return None

    told = _columns(graph, values, what, instead)
    found = [*factors, *told, *(column for _, column in apart)]
    for k, one in [(k, one) for k, one in enumerate(products) if one.curve]:
        used = np.flatnonzero(ca.which_depends(ca.veccat(*found), symbols[k])).tolist()
        if len(used) < one.taken:
            # a curve of more than what is looked at, as of all gates of a network at once
            wanted, whole = ca.MX.sym(symbols[k].name(), len(used)), ca.MX.zeros(one.taken)
            whole[used] = wanted
            found = ca.substitute(found, [symbols[k]], [whole])
            found[k] = found[k][used]
            symbols[k], products[k] = wanted, Product(1, len(used), len(used), curve=one.curve)
    names = [f"detached_{k}" for k in range(len(apart))]
    return Parts(
        ca.Function(
            "step",
            [*columns, theta, *symbols, *(symbol for symbol, _ in apart)],
            found,
            [
                *(name for name, _ in rows),
                "theta",
                *(f"product_{k}" for k in range(len(products))),
                *names,
            ],
            [
                *(f"factor_{k}" for k in range(len(products))),
                *results,
                *(f"{name}_value" for name in names),
            ],
        ),
        prepare,
        plain,
        products,
    )


_PRODUCTS: Final = tuple(getattr(torch.ops.aten, name).default for name in ("mm", "addmm", "bmm"))


def _name(target: Any) -> str:
    """Return the name of an operation of torch, as tables here have it."""
    schema = getattr(target, "_schema", None)
    return schema.name.removeprefix("aten::").removesuffix("_copy") if schema else ""


def _subgraph(
    graph: Graph,
    given: Sequence[Node],
    results: Sequence[Node],
    constant: Mapping[Node, Any] = MappingProxyType({}),
) -> GraphModule:
    """Return the part of a graph that makes some of its nodes from others, and constants."""
    part, owner = Graph(), nn.Module()
    copies: dict[Node, Node] = {}

    def copied(node: Node) -> Node:
        if node not in copies:
            if node in constant:
                name = f"constant_{len(copies)}"
                owner.register_buffer(name, constant[node])
                copies[node] = part.get_attr(name)
            elif node.op == "get_attr":
                name = f"constant_{len(copies)}"
                owner.register_buffer(
                    name, operator.attrgetter(str(node.target))(graph.owning_module).detach()
                )
                copies[node] = part.get_attr(name)
            else:
                copies[node] = part.node_copy(node, copied)
        return copies[node]

    for node in given:
        copies[node] = part.placeholder(node.name)
    part.output(tuple(copied(node) for node in results))
    return GraphModule(owner, part)


def in_numbers(function: ca.Function) -> ca.Function:
    """Return a function of single numbers, where no look-up in a long table keeps it from that."""
    looks_up = range(function.n_instructions())
    if any(function.instruction_id(k) == ca.OP_GETNONZEROS_PARAM for k in looks_up):
        return function
    symbols = [ca.SX.sym(name, function.numel_in(name)) for name in function.name_in()]
    found = ca.cse([*function.call(symbols)])
    return ca.Function("step", symbols, found, function.name_in(), function.name_out())


def recorded(step: Callable[..., Any], examples: Sequence[Tensor], what: str) -> Graph:
    """Return the graph of the operations of torch that a step makes of examples.

    Its owning module has its constants.

    Raises:
        ExportError: where Python decides by values.
    """
    from torch.func import functionalize

    wrapped = functionalize(lambda *given: step(*given), remove="mutations")
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            return _Recorder().graph_of(wrapped, examples)
    except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
        first = str(error).strip().splitlines()
        raise ExportError(
            f"{what}: its step cannot be recorded as a fixed sequence of operations"
            f" ({first[0] if first else type(error).__name__}); write it with operations on tensors"
            " alone, torch.where instead of `if`"
        ) from error


class _Recorder(TorchDispatchMode):
    """Writes down the core operations that are carried out within it.

    `make_fx` of torch does so too, and imports torch's compiler, which takes 2 s.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return whether torch's compiler is told to leave this alone, and imported for that."""
        return False

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        # `core_aten_decompositions` adds those that each operation has itself, in 60 ms
        from torch._decomp import _core_aten_decompositions_post_autograd

        self._rules: Any = _core_aten_decompositions_post_autograd()
        self._owner = GraphModule({}, Graph())
        self._graph = Graph(self._owner)
        # numbers are kept, so that none is taken for another that had its place in memory
        self._nodes: dict[int, tuple[Node, Tensor]] = {}
        self._varying: set[Node] = set()

    def graph_of(self, step: Callable[..., Any], examples: Sequence[Tensor]) -> Graph:
        """Return the graph of a step."""
        for k, example in enumerate(examples):
            self._nodes[id(example)] = self._graph.placeholder(f"given_{k}"), example
        self._varying.update(node for node, _ in self._nodes.values())
        with self:
            found = step(*examples)
        self._graph.output(map_aggregate(found, self._node))
        self._graph.eliminate_dead_code()
        return self._graph

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = kwargs or {}
        # what only moves numbers is kept: torch's rules would hide a detach, and import sympy
        rules = (self._rules.get(func), func.decompose)
        for rule in filter(None, () if _name(func) in _MOVES else rules):
            with self:
                found = rule(*args, **given)
            if found is not NotImplemented:
                return found
        node = self._graph.call_function(func, *map_aggregate((args, given), self._node))
        if not self._varying.isdisjoint(node.all_input_nodes):
            self._varying.add(node)
            if torch.Tag.data_dependent_output in func.tags:
                raise RuntimeError(f"{_name(func)} takes a number out of what varies")
        found = func(*args, **given)
        self._told(node, found)
        return found

    def _told(self, node: Node, found: Any) -> None:
        """Remember what a node has made."""
        if isinstance(found, Tensor):
            self._nodes[id(found)] = node, found
        elif isinstance(found, list | tuple):
            for k, part in enumerate(found):
                member = self._graph.call_function(operator.getitem, (node, k))
                self._varying |= {member} if node in self._varying else set()
                self._told(member, part)

    def _node(self, value: Any) -> Any:
        """Return the node of a tensor, anything else as it is."""
        if not isinstance(value, Tensor):
            return value
        if id(value) not in self._nodes:
            name = f"constant_{len(self._nodes)}"
            self._owner.register_buffer(name, value)
            self._nodes[id(value)] = self._graph.get_attr(name), value
        return self._nodes[id(value)][0]


@dataclass
class _Value:
    """A tensor of the graph: what it is at the examples, and its numbers in row order.

    There is no column of what is the same whatever is given.
    """

    example: Tensor
    given: Any = None

    @property
    def constant(self) -> bool:
        return self.given is None or self.example.numel() == 0

    @property
    def column(self) -> Any:
        if self.given is None:
            self.given = ca.MX(ca.DM(self.example.double().reshape(-1).tolist()))
            return self.given
        return self.given

    @property
    def places(self) -> Tensor:
        return torch.arange(self.example.numel()).reshape(self.example.shape)


def _taken(column: Any, places: Tensor) -> Any:
    """Return the numbers of a column at known places."""
    wanted = places.reshape(-1).tolist()
    if wanted == list(range(column.shape[0])):
        return column
    # a single number that is taken many times makes a row
    return ca.vec(column[wanted]) if wanted else ca.MX(0, 1)


def _value(given: Any) -> _Value:
    if isinstance(given, _Value):
        return given
    kind = torch.bool if isinstance(given, bool) else torch.float64
    return _Value(torch.tensor(given, dtype=kind))


def _each(op: str, example: Tensor, *given: Any) -> _Value:
    """Return an operation on each element of values that are brought to one shape."""
    columns = []
    for value in map(_value, given):
        places = value.places.expand(np.broadcast_shapes(value.example.shape, example.shape))
        alone = value.example.numel() == 1
        columns.append(value.column if alone else _taken(value.column, places))
    out = _ELEMENTWISE[op](*columns)
    return _Value(
        example, out if out.shape[0] == example.numel() else ca.repmat(out, example.numel(), 1)
    )


def _called(target: Any, args: Any, settings: Any, what: str) -> Any:
    if target is operator.getitem:
        return args[0][args[1]]
    name = _name(target)
    leaves = [leaf for leaf in tree.tree_leaves((args, settings)) if isinstance(leaf, _Value)]

    def plain(part: Any) -> Any:
        return map_aggregate(part, lambda leaf: leaf.example if isinstance(leaf, _Value) else leaf)

    example = target(*plain(args), **plain(settings))
    if name in _LIKE or all(leaf.constant for leaf in leaves):
        return _Value(example) if isinstance(example, Tensor) else [*map(_Value, example)]
    moved = _MOVES.get(name, ())
    others = [
        leaf for i, arg in enumerate(args) if i not in moved for leaf in tree.tree_leaves(arg)
    ]
    if moved and all(leaf.constant for leaf in others if isinstance(leaf, _Value)):
        return _moved(target, args, plain, moved, plain(settings), example)
    if name in _SPECIAL:
        return _SPECIAL[name](example, *args, **settings)
    if name in _ELEMENTWISE and not settings:
        return _each(name, example, *args)
    if name in _FOLDS:
        return _folded(name, example, *args, **settings)
    raise ExportError(
        f"{what}: its step uses torch's operation '{name}', which this format does not have; export"
        " it as torchscript"
    )


def _moved(
    target: Any, args: Any, plain: Any, moved: Sequence[int], settings: Any, example: Any
) -> Any:
    """Return what an operation moves, by letting it move the places of the numbers instead."""
    columns: list[Any] = []
    count = 0

    def placed(leaf: Any) -> Any:
        nonlocal count
        if not isinstance(leaf, _Value):
            return leaf
        columns.append(leaf.column)
        count += leaf.example.numel()
        return leaf.places + (count - leaf.example.numel())

    given = [map_aggregate(arg, placed) if i in moved else plain(arg) for i, arg in enumerate(args)]
    places = target(*given, **settings)
    whole = columns[0] if len(columns) == 1 else ca.vertcat(*columns)
    if isinstance(example, Tensor):
        return _Value(example, _taken(whole, places))
    return [_Value(one, _taken(whole, at)) for one, at in zip(example, places, strict=True)]


def _rows(given: _Value, dim: Any) -> tuple[Tensor, int]:
    """Return the places [rows, n] of the numbers that a reduction over dimensions joins."""
    places = given.places
    every = list(range(places.dim()))
    listed = [dim] if isinstance(dim, int) else dim
    over = [d % places.dim() for d in listed] if listed else every
    moved = places.permute(*(d for d in every if d not in over), *over)
    size = 1
    for d in over:
        size *= places.shape[d]
    return moved.reshape(-1, size), size


def _folded(
    name: str, example: Tensor, given: _Value, dim: Any = None, keepdim: bool = False, **_: Any
) -> _Value:
    rows, size = _rows(given, dim)
    if name in ("sum", "mean"):
        total = ca.sum2(ca.reshape(_taken(given.column, rows.T), len(rows), size))
        return _Value(example, total / size if name == "mean" else total)
    total = _taken(given.column, rows[:, 0])
    for k in range(1, size):
        total = _ELEMENTWISE[_FOLDS[name]](total, _taken(given.column, rows[:, k]))
    return _Value(example, total)


def _extreme(name: Literal["max", "min"], example: Any, given: _Value, dim: int) -> list[_Value]:
    """Return the largest or smallest numbers along a dimension, and their places."""
    rows, size = _rows(given, dim)
    best, place = _taken(given.column, rows[:, 0]), ca.MX(ca.DM.zeros(len(rows), 1))
    for k in range(1, size):
        other = _taken(given.column, rows[:, k])
        better = other > best if name == "max" else other < best
        best, place = ca.if_else(better, other, best), ca.if_else(better, k, place)
    return [_Value(example[0], best), _Value(example[1], place)]


def _scaled(given: Any, factor: float) -> Any:
    value = _value(given)
    return given if factor == 1 else _each("mul", value.example * factor, value, float(factor))


def _power(example: Tensor, a: Any, b: Any) -> _Value:
    power = _value(b)
    known = float(power.example) if power.constant and power.example.numel() == 1 else None
    if known in (0.5, -1.0, 2.0):
        return _each({0.5: "sqrt", -1.0: "reciprocal", 2.0: "square"}[known], example, a)
    if known in (3.0, 4.0):
        square = _each("square", example, a)
        return _each("mul", example, square, a if known == 3.0 else square)
    return _each("pow", example, a, b)


def _divided(example: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> _Value:
    ratio = _each("div", example, a, b)
    return ratio if rounding_mode is None else _each(rounding_mode, example, ratio)


def _clamped(example: Tensor, given: _Value, min: Any = None, max: Any = None) -> _Value:
    out = given if min is None else _each("maximum", example, given, min)
    return out if max is None else _each("minimum", example, out, max)


def _cast(example: Tensor, given: _Value, *_: Any, **settings: Any) -> _Value:
    """Return a value in another type; precisions are not told apart."""
    before, after = given.example.dtype, example.dtype
    if after == torch.bool and before != torch.bool:
        return _each("ne", example, given, 0.0)
    if before.is_floating_point and not after.is_floating_point:
        return _each("trunc", example, given)
    return _Value(example, given.column)


def _copied(example: Tensor, given: _Value, source: _Value, *_: Any) -> _Value:
    return _cast(example, _each("add", source.example.expand(example.shape), source, 0.0))


def _product(
    example: Tensor, a: _Value, b: _Value, start: Any = None, beta: float = 1, alpha: float = 1
) -> _Value:
    (m, k), n = a.example.shape, b.example.shape[1]
    # columns are stored in row order, so that they are the transposed matrices
    right = (
        ca.MX(ca.DM(b.example.double().T.tolist())) if b.constant else ca.reshape(b.column, n, k)
    )
    out = _Value(example, ca.vec(ca.mtimes(right, ca.reshape(_scaled(a, alpha).column, k, m))))
    return out if start is None else _each("add", example, out, _scaled(start, beta))


def _products(example: Tensor, a: _Value, b: _Value) -> _Value:
    def part(value: _Value, i: int) -> _Value:
        column = None if value.given is None else _taken(value.column, value.places[i])
        return _Value(value.example[i], column)

    parts = [_product(example[i], part(a, i), part(b, i)).column for i in range(len(example))]
    return _Value(example, ca.vertcat(*parts))


def _picked(table: Any, places: Tensor, at: Any) -> Any:
    """Return the row of a table, whose numbers are at `places` [n, k], that is known at run time.

    What lies beyond the table is held to its ends.
    """
    rows, size = places.shape
    if rows > _SHORT:
        row = ca.fmin(ca.fmax(at, 0.0), rows - 1.0)
        return ca.vec(_taken(table, places).get_nz(False, row * size + ca.DM(list(range(size)))))
    out = _taken(table, places[0])
    for i in range(1, rows):
        out = ca.if_else(at >= i, _taken(table, places[i]), out)
    return out


def _looked_up(example: Tensor, given: _Value, dim: int, index: _Value) -> _Value:
    """Return rows along a dimension; the index is that of torch's `index_select`."""
    rows = given.places.movedim(dim, 0)
    flat = rows.reshape(len(rows), -1)
    parts = [_picked(given.column, flat, index.column[i]) for i in range(index.example.numel())]
    order = torch.arange(len(parts) * flat.shape[1]).reshape(len(parts), *rows.shape[1:])
    return _Value(example, _taken(ca.vertcat(*parts), order.movedim(0, dim)))


def _indexed(example: Tensor, given: _Value, indices: Sequence[_Value | None]) -> _Value:
    first = indices[0]
    if first is None or len(indices) > 1:
        raise ExportError(
            "a step looks up a table by several indices at once, which this format does not have;"
            " export it as torchscript"
        )
    return _looked_up(example, given, 0, first)


def _gathered(example: Tensor, given: _Value, dim: int, index: _Value, **_: Any) -> _Value:
    table, at = given.places.movedim(dim, -1), index.places.movedim(dim, -1)
    table = table[tuple(slice(size) for size in at.shape[:-1])].reshape(-1, table.shape[-1])
    parts = [
        _picked(given.column, row[:, None], index.column[place])
        for row, wanted in zip(table, at.reshape(-1, at.shape[-1]).tolist(), strict=True)
        for place in wanted
    ]
    order = torch.arange(len(parts)).reshape(at.shape).movedim(-1, dim)
    return _Value(example, _taken(ca.vertcat(*parts), order))


_SPECIAL: Final[dict[str, Callable[..., Any]]] = {
    "add": lambda e, a, b, alpha=1: _each("add", e, a, _scaled(b, alpha)),
    "sub": lambda e, a, b, alpha=1: _each("sub", e, a, _scaled(b, alpha)),
    "rsub": lambda e, a, b, alpha=1: _each("sub", e, b, _scaled(a, alpha)),
    "div": _divided, "pow": _power, "clamp": _clamped, "_to": _cast, "copy": _copied,
    "mm": _product, "bmm": _products,
    "addmm": lambda e, start, a, b, beta=1, alpha=1: _product(e, a, b, start, beta, alpha),
    "max": lambda e, given, dim, keepdim=False: _extreme("max", e, given, dim),
    "min": lambda e, given, dim, keepdim=False: _extreme("min", e, given, dim),
    "argmax": lambda e, given, dim=None, keepdim=False: _extreme("max", (e, e), given, dim)[1],
    "argmin": lambda e, given, dim=None, keepdim=False: _extreme("min", (e, e), given, dim)[1],
    "index_select": _looked_up, "index": _indexed, "gather": _gathered,
}  # fmt: skip
"""Operations with settings of their own."""
