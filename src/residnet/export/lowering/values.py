"""The tensors of a recorded graph while it becomes a program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule

from residnet.export.lowering.program import Kind


@dataclass
class Value:
    """A tensor of the graph.

    Attributes:
        example: what it is at the example arguments; its value where it is constant.
        cells: addresses, shaped as the tensor; None of a constant that nothing has needed yet.
    """

    example: Tensor
    cells: Tensor | None = None

    @property
    def constant(self) -> bool:
        """Whether it is known now, as it is where there is nothing in it."""
        return self.cells is None or self.example.numel() == 0


def kind_of(dtype: torch.dtype) -> Kind:
    """Return the kind of cells that hold this type."""
    if dtype == torch.bool:
        return "flag"
    return "real" if dtype.is_floating_point else "whole"


def attribute(graph: GraphModule, path: str) -> Tensor:
    """Return a constant that a graph holds."""
    found: Any = graph
    for part in path.split("."):
        found = getattr(found, part)
    tensor: Tensor = found.detach()
    return tensor


def examples_of(given: Any) -> Any:
    """Return arguments with the example of each value in its place."""
    return torch.utils._pytree.tree_map(lambda a: a.example if isinstance(a, Value) else a, given)


def wrapped(example: Any) -> Any:
    """Return constants as values."""
    if isinstance(example, Tensor):
        return Value(example)
    return [Value(part) for part in example]


def paired(example: Any, moved: Any) -> Any:
    """Return values with their cells."""
    if isinstance(example, Tensor):
        return Value(example, moved)
    return [Value(part, cells) for part, cells in zip(example, moved, strict=True)]
