"""Operations that put numbers to places, as gradients need them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.export.lowering.values import Value


class Scatters(ABC):
    """Lowerings of `scatter_add` and `index_put`."""

    @abstractmethod
    def cells(self, value: Value) -> Tensor:
        """Return the addresses of a value."""

    @abstractmethod
    def map(self, op: str, example: Tensor, *given: Any) -> Value:
        """Return an operation on each element."""

    def do_scatter_add(
        self, example: Tensor, given: Value, dim: int, index: Value, source: Value
    ) -> Value:
        """Return `given` with numbers added at places along a dimension, known or not."""
        along = dim % example.dim()
        shape = [1] * example.dim()
        shape[along] = example.shape[along]
        places = Value(torch.arange(example.shape[along]).reshape(shape))
        for k in range(index.example.shape[along]):
            at, part = (
                Value(value.example.narrow(along, k, 1), self.cells(value).narrow(along, k, 1))
                for value in (index, source)
            )
            here = self.map("eq", places.example == at.example, places, at)
            kept = torch.where(here.example, part.example, 0.0)
            given = self.map("add", example, given, self.map("where", kept, here, part, 0.0))
        return given

    def do_index_put(
        self,
        example: Tensor,
        given: Value,
        indices: Sequence[Value | None],
        values: Value,
        accumulate: bool = False,
    ) -> Value:
        """Return `given` with numbers put or added at known places.

        Raises:
            ExportError: where the places are known only when the step is run.
        """
        if not all(index is None or index.constant for index in indices):
            raise ExportError(
                "a step puts numbers to places that are known only when it runs, which this format"
                " does not have; export it as torchscript"
            )
        chosen = tuple(slice(None) if index is None else index.example for index in indices)
        numbers = torch.arange(example.numel()).reshape(example.shape)[chosen]
        source = self.cells(values).expand(numbers.shape).reshape(-1).tolist()
        left = list(zip(numbers.reshape(-1).tolist(), source, strict=True))
        if not accumulate:
            cells = self.cells(given).clone()
            for place, address in left:
                cells.view(-1)[place] = address
            return Value(example, cells)
        nothing = int(self.cells(Value(torch.zeros(1, dtype=torch.float64)))[0])
        while left:
            cells, later, taken = torch.full((example.numel(),), nothing), [], set[int]()
            for place, address in left:
                if place in taken:
                    later.append((place, address))
                else:
                    taken.add(place)
                    cells[place] = address
            given = self.map("add", example, given, Value(example, cells.reshape(example.shape)))
            left = later
        return given
