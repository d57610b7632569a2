"""Sums of squares and products by fold: what closed-form fits and their cross-validation need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from residnet.core.arrays.tally import Tally
from residnet.core.errors import FitError
from residnet.regression.estimator import column_names, fold_numbers, require_data
from residnet.regression.pieces import Regressors, pieces

CONSTANT = 1e-9
"""Standard deviation below which, in units of its largest value, a column counts as constant."""


class Centred(NamedTuple):
    """Moments about the means of a part of the samples.

    Attributes:
        samples: number of samples.
        mean_x: mean of x [J], less the shift of the moments.
        mean_y: mean of y [n], less the shift of the moments.
        xx: X'X about the means [J, J].
        xy: X'Y about the means [J, n].
    """

    samples: float
    mean_x: Tensor
    mean_y: Tensor
    xx: Tensor
    xy: Tensor


class Candidates(NamedTuple):
    """Models y = mean_y + (x - mean_x) coefficients of C complexities.

    Attributes:
        coefficients: of each complexity [C, J, n].
        mean_x: mean of x [J], less the shift of the moments.
        mean_y: mean of y [n], less the shift of the moments.
    """

    coefficients: Tensor
    mean_x: Tensor
    mean_y: Tensor


class FoldMoments:
    """Sums over each fold of [1, X, Y]' [1, X, Y], float64.

    The data are passed once; a fold is left out by subtraction. X is shifted by its overall mean
    before, which keeps the differences well conditioned.

    Args:
        sums: sums of each fold [F, 1 + J + n, 1 + J + n].
        shift_x: what was taken from x before [J].
        shift_y: what was taken from y before [n].
    """

    def __init__(self, sums: Tensor, shift_x: Tensor, shift_y: Tensor) -> None:
        self.sums = sums
        self.shift_x = shift_x
        self.shift_y = shift_y
        self.folds = sums.shape[0]
        self.regressors = shift_x.numel()

    @classmethod
    def gather(cls, x: Regressors, y: Tensor, fold: Tensor, folds: int) -> FoldMoments:
        """Return the moments of x [N, J] and y [N, n], with the fold of each sample [N].

        A column that varies by rounding alone counts as zero.
        """
        shift_x, constant = _means(x)
        shift_y = y.mean(0)
        width = 1 + shift_x.numel() + shift_y.numel()
        sums = torch.zeros(folds, width, width, dtype=y.dtype)
        for rows, part in pieces(x):
            there, of = y[rows], fold[rows]
            part = part.masked_fill(constant, 0.0)
            joined = torch.cat((torch.ones_like(there[:, :1]), part - shift_x, there - shift_y), 1)
            sums += torch.stack([joined[of == f].T @ joined[of == f] for f in range(folds)])
        return cls(sums, shift_x, shift_y)

    @classmethod
    def checked(
        cls,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None,
        folds: int | None,
        names: Sequence[str],
        outputs: Sequence[str],
    ) -> FoldMoments:
        """Return the moments for an estimator, in one fold where `groups` is None.

        A column that varies by rounding alone counts as zero, so that it gets no coefficient
        instead of a huge one.

        Raises:
            FitError: with values that are not finite, too few groups, or no more samples than
                columns.
        """
        require_data(x, y, column_names(x, names, "x"), column_names(y, outputs, "y"))
        fold = fold_numbers(groups, folds) if groups is not None else y.new_zeros(len(x))
        if len(x) <= x.shape[1]:
            raise FitError(
                f"{len(x)} samples do not determine {x.shape[1]} basis functions; give more data or"
                " fewer terms"
            )
        return cls.gather(x, y, fold, int(fold.max()) + 1)

    def centred(self, total: Tensor) -> Centred:
        """Return the moments about the means, from summed moments."""
        j = self.regressors
        n = float(total[0, 0])
        mean = total[0, 1:] / n
        cross = total[1:, 1:] - n * torch.outer(mean, mean)
        return Centred(n, mean[:j], mean[j:], cross[:j, :j], cross[:j, j:])

    def all(self) -> Centred:
        """Return the moments of all folds about their means."""
        return self.centred(self.sums.sum(0))

    def without(self, fold: int) -> Centred:
        """Return the moments of all folds but one about their means."""
        return self.centred(self.sums.sum(0) - self.sums[fold])

    def intercept(self, coefficients: Tensor, model: Candidates) -> Tensor:
        """Return the intercept [n] that goes with coefficients [J, n] and the means of a model."""
        return model.mean_y + self.shift_y - (model.mean_x + self.shift_x) @ coefficients

    def squared_error(self, fold: int, model: Candidates) -> Tensor:
        """Return the sums of squared errors of candidates on one fold [C, n]."""
        j = self.regressors
        s = self.sums[fold]
        coefficients = model.coefficients
        intercept = model.mean_y - torch.einsum("j,cjk->ck", model.mean_x, coefficients)
        weights = torch.cat((intercept[:, None, :], coefficients), dim=1)
        xx, xy, yy = s[: j + 1, : j + 1], s[: j + 1, j + 1 :], s[j + 1 :, j + 1 :].diagonal()
        quadratic = torch.einsum("cik,ij,cjk->ck", weights, xx, weights)
        return yy - 2 * torch.einsum("cik,ik->ck", weights, xy) + quadratic

    def cross_validate(self, models: Sequence[Candidates]) -> Tensor:
        """Return mean squared errors over left-out folds [C, n], from the models without each."""
        errors = torch.stack([self.squared_error(f, models[f]) for f in range(self.folds)])
        return errors.sum(0) / self.sums[:, 0, 0].sum()

    def variance(self) -> Tensor:
        """Return the variance of each output over all samples [n]."""
        j, total = self.regressors, self.sums.sum(0)
        return total[j + 1 :, j + 1 :].diagonal() / total[0, 0]


def _means(x: Regressors) -> tuple[Tensor, Tensor]:
    """Return the mean of each column [J], zero for those that vary by rounding alone, and which
    these are [J].
    """
    tally = Tally(x.shape[1])
    for _, part in pieces(x):
        tally.add(part)
    largest = torch.maximum(tally.low.abs(), tally.high.abs())
    constant = tally.std(correction=1) <= CONSTANT * largest
    return tally.mean.masked_fill(constant, 0.0), constant
