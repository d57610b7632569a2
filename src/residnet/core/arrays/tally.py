"""Mean, spread and range of columns that come in pieces."""

from __future__ import annotations

import torch
from torch import Tensor


class Tally:
    """What columns [N, J] are like, from pieces of their rows.

    Attributes:
        count: rows so far.
        mean: of each column [J].
        square: sum of squares about the mean [J].
        low: least value [J].
        high: largest value [J].
    """

    def __init__(self, columns: int) -> None:
        self.count = 0
        self.mean = torch.zeros(columns, dtype=torch.float64)
        self.square = torch.zeros(columns, dtype=torch.float64)
        self.low = torch.full((columns,), torch.inf, dtype=torch.float64)
        self.high = torch.full((columns,), -torch.inf, dtype=torch.float64)

    def add(self, rows: Tensor) -> None:
        """Count rows [M, J] in, M at least 1."""
        few, mean = len(rows), rows.mean(0)
        spread = rows.var(0, correction=0) * few
        if self.count == 0:
            self.mean, self.square = mean, spread
        else:
            # the rule for joining two variances keeps their digits
            both, away = self.count + few, mean - self.mean
            self.square = self.square + spread + away.square() * self.count * few / both
            self.mean = self.mean + away * few / both
        self.count += few
        self.low = torch.minimum(self.low, rows.amin(0))
        self.high = torch.maximum(self.high, rows.amax(0))

    def std(self, correction: int = 0) -> Tensor:
        """Return the standard deviation of each column [J]."""
        return (self.square / max(self.count - correction, 1)).sqrt()
