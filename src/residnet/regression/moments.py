"""Sums of squares and products by fold: what closed-form fits and their cross-validation need."""

from __future__ import annotations

import torch
from torch import Tensor


class FoldMoments:
    """Sums over each fold of [1, X, Y]' [1, X, Y], float64: all that closed-form fits and their
    cross-validation need.

    The data are passed once; a fold is left out by subtraction. X is shifted by its overall mean
    before, which keeps the differences well conditioned.
    """

    def __init__(self, sums: Tensor, shift_x: Tensor, shift_y: Tensor) -> None:
        self.sums = sums
        self.shift_x = shift_x
        self.shift_y = shift_y
        self.folds = sums.shape[0]
        self.regressors = shift_x.numel()

    @classmethod
    def gather(cls, x: Tensor, y: Tensor, fold: Tensor, folds: int) -> FoldMoments:
        """From X [N, J], Y [N, K] and the fold of each sample [N]."""
        shift_x, shift_y = x.mean(0), y.mean(0)
        joined = torch.cat((torch.ones_like(y[:, :1]), x - shift_x, y - shift_y), dim=1)
        sums = torch.stack([joined[fold == f].T @ joined[fold == f] for f in range(folds)])
        return cls(sums, shift_x, shift_y)

    def centred(self, total: Tensor) -> tuple[float, Tensor, Tensor, Tensor, Tensor]:
        """(count, mean of X, mean of Y, X'X, X'Y) about the means, from summed moments."""
        j = self.regressors
        n = float(total[0, 0])
        mean = total[0, 1:] / n
        cross = total[1:, 1:] - n * torch.outer(mean, mean)
        return n, mean[:j], mean[j:], cross[:j, :j], cross[:j, j:]

    def all(self) -> tuple[float, Tensor, Tensor, Tensor, Tensor]:
        """`centred` of all folds."""
        return self.centred(self.sums.sum(0))

    def without(self, fold: int) -> tuple[float, Tensor, Tensor, Tensor, Tensor]:
        """`centred` of all folds but one."""
        return self.centred(self.sums.sum(0) - self.sums[fold])

    def squared_error(
        self, fold: int, coefficients: Tensor, mean_x: Tensor, mean_y: Tensor
    ) -> Tensor:
        """Sum of squared errors on one fold [C, K] of candidates y = mean_y + (x - mean_x)
        coefficients [C, J, K].
        """
        j = self.regressors
        s = self.sums[fold]
        intercept = mean_y - torch.einsum("j,cjk->ck", mean_x, coefficients)
        weights = torch.cat((intercept[:, None, :], coefficients), dim=1)
        xx, xy, yy = s[: j + 1, : j + 1], s[: j + 1, j + 1 :], s[j + 1 :, j + 1 :].diagonal()
        quadratic = torch.einsum("cik,ij,cjk->ck", weights, xx, weights)
        return yy - 2 * torch.einsum("cik,ik->ck", weights, xy) + quadratic

    def cross_validate(self, path: list[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
        """Mean squared error [C, K] over left-out folds of candidate coefficients; path: per fold
        (coefficients [C, J, K], mean of X, mean of Y).
        """
        errors = torch.stack([self.squared_error(f, *path[f]) for f in range(self.folds)])
        return errors.sum(0) / self.sums[:, 0, 0].sum()
