"""Regressors of many samples, computed piece by piece instead of all at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import final

import torch
from torch import Tensor

from residnet.core.arrays import paged
from residnet.core.arrays.paged import forget, row_pieces


@final
class Pieces:
    """A matrix of regressors [N, J] whose rows are computed where they are needed.

    Args:
        of: gives regressors [M, J] at channels [M, nz].
        source: channels [N, nz].
        columns: which of the regressors are meant, J of them.
    """

    def __init__(
        self, of: Callable[[Tensor], Tensor], source: Tensor, columns: Sequence[int]
    ) -> None:
        self.of = of
        self.source = source
        self.columns = list(columns)
        self.shape = (source.shape[0], len(self.columns))

    def __len__(self) -> int:
        return self.shape[0]

    def take(self, columns: Sequence[int]) -> Pieces:
        """Return some of the regressors, by their place among these."""
        return Pieces(self.of, self.source, [self.columns[j] for j in columns])

    def __iter__(self) -> Iterator[tuple[slice, Tensor]]:
        """Yield rows and the regressors there."""
        for part in row_pieces(len(self)):
            yield part, self.of(self.source[part])[:, self.columns]
            forget()


Regressors = Tensor | Pieces


def regressors(
    of: Callable[[Tensor], Tensor], source: Tensor, columns: Sequence[int]
) -> Regressors:
    """Return regressors at channels [N, nz]: a tensor, or pieces where there are many samples."""
    if len(source) > paged.LARGE:
        return Pieces(of, source, columns)
    values = of(source)
    return values if list(columns) == list(range(values.shape[1])) else values[:, list(columns)]


def pieces(x: Regressors) -> Iterator[tuple[slice, Tensor]]:
    """Yield rows and the regressors there."""
    if isinstance(x, Pieces):
        yield from x
    else:
        for part in row_pieces(len(x)):
            yield part, x[part]


def chosen(x: Regressors, columns: Sequence[int]) -> Regressors:
    """Return some columns of regressors."""
    return x.take(columns) if isinstance(x, Pieces) else x[:, list(columns)]


def whole(x: Regressors) -> Tensor:
    """Return all regressors [N, J] in memory, for methods that need them at once."""
    return torch.cat([part for _, part in x]) if isinstance(x, Pieces) else x
