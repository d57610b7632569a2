"""Surface analysis: PLSR by model order and number of basis functions.

The weakest basis functions are removed one by one (document 002 section 4.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import Data, Estimator, Solution, fold_numbers, whole
from residnet.regression.shrinkage import CONSTANT, FoldMoments, pls_path


@dataclass(frozen=True)
class Surface:
    """The errors over orders and numbers of basis functions, for each output by itself.

    Attributes:
        error: mean squared error [K, A, J + 1] of output k with a + 1 latent variables and j basis
            functions; NaN where there is no such model (fewer basis functions than latent
            variables, or fewer than two).
        standard_error: of that mean over the folds, [K, A, J + 1]; NaN with one fold.
        removal: basis functions in the order of their removal, [K, A, J], -1 after the last one
            that was removed.
    """

    error: Tensor
    standard_error: Tensor
    removal: Tensor

    def kept(self, output: int, order: int, count: int) -> list[int]:
        """Return the `count` basis functions left for an output at model order `order` (from 1)."""
        gone = self.removal[output, order - 1, : self.removal.shape[2] - count].tolist()
        return [j for j in range(self.removal.shape[2]) if j not in gone]

    def least(self, output: int) -> tuple[int, int]:
        """Return (order, count) of the least error of one output: the document's choice.

        It is optimistic where its folds also judge the result.
        """
        flat = torch.nan_to_num(self.error[output], nan=torch.inf).flatten()
        a, j = divmod(int(flat.argmin()), self.error.shape[2])
        return a + 1, j

    def simplest(self, output: int) -> tuple[int, int]:
        """Return the lowest (order, count) within one standard error of the least.

        Of the lowest order it has the most basis functions.

        The least cross-validated error of some 450 models is partly luck, and high orders on few
        near-collinear columns explode elsewhere (Breiman's one-standard-error rule; a low order
        shrinks, removing basis functions does not).
        """
        order, count = self.least(output)
        limit = self.error[output, order - 1, count] + torch.nan_to_num(
            self.standard_error[output, order - 1, count]
        )
        fine = torch.nan_to_num(self.error[output], nan=torch.inf) <= limit
        lowest = int(fine.any(1).nonzero()[0, 0])
        return lowest + 1, int(fine[lowest].nonzero()[-1, 0])


def surface(moments: FoldMoments, test: Sequence[int] = (), orders: int | None = None) -> Surface:
    """Return all models of the surface from moments alone, in one batch.

    At every model order the basis function with the least |coefficient| on standardised columns is
    removed, until the order or two are left.

    Args:
        moments: sums by fold of basis functions [N, J] and outputs [N, K].
        test: folds that judge the models; these are fitted, and choose what to remove, on the
            others. Empty: cross-validation over all folds.
        orders: highest model order; None for the number of basis functions.

    Raises:
        FitError: where a basis function is constant, or fewer than two are given.
    """
    problems = _Problems.gather(moments, test)
    k, j = problems.covariance.shape[2], problems.gram.shape[1]
    a = min(orders or j, j)
    axis = torch.arange(k).repeat(a)
    order = torch.arange(1, a + 1).repeat_interleave(k)
    mask = torch.ones(j, a * k, dtype=torch.float64)
    error, standard_error = (
        torch.full((j + 1, a * k), torch.nan, dtype=torch.float64) for _ in range(2)
    )
    removal = torch.full((j, a * k), -1, dtype=torch.long)
    for count in range(j, 1, -1):
        # columns are sorted by order: those that may still have `count` basis functions come first
        active = int((order <= count).sum())
        path = pls_path(
            problems.gram,
            problems.covariance[:, :, axis[:active]],
            order[:active],
            joint=False,
            mask=mask[:, :active],
        )
        coefficients = path[-1] if len(path) else torch.zeros_like(problems.covariance[:, :, axis])
        error[count, :active], standard_error[count, :active] = problems.errors(
            coefficients, axis[:active]
        )
        size = coefficients[0].abs().masked_fill(mask[:, :active] == 0, torch.inf)
        weakest = size.argmin(0)
        further = torch.arange(active)[order[:active].clamp(min=2) < count]
        removal[j - count, further] = weakest[further]
        mask[weakest[further], further] = 0.0
    return Surface(
        *(
            part.reshape(-1, a, k).permute(2, 1, 0).contiguous()
            for part in (error, standard_error, removal)
        )
    )


@dataclass(frozen=True)
class _Problems:
    """The standardised normal equations.

    The first is fitted on all that may be used, the others on that less one fold each.

    gram [P, J, J], covariance [P, J, K], scale and mean of the columns [P, J], mean of the outputs
    [P, K]; `judged` are the sums [P', 1 + J + K, 1 + J + K] that the last P' problems are judged
    on.
    """

    gram: Tensor
    covariance: Tensor
    scale: Tensor
    mean_x: Tensor
    mean_y: Tensor
    judged: Tensor

    @classmethod
    def gather(cls, moments: FoldMoments, test: Sequence[int]) -> _Problems:
        """Return the problems of moments by fold, judged on the folds `test` or on each in turn."""
        total = moments.sums.sum(0)
        apart = moments.sums[list(test)].sum(0) if test else total * 0.0
        used = [total - apart] + (
            [] if test else [total - moments.sums[f] for f in range(moments.folds)]
        )
        judged = apart.unsqueeze(0) if test else moments.sums
        centred = [moments.centred(part) for part in used]
        if centred[0][3].shape[0] < 2:
            raise FitError("a surface needs at least two basis functions")
        n = torch.tensor([part[0] for part in centred], dtype=torch.float64)
        xx, xy = (
            torch.stack([part[3] for part in centred]),
            torch.stack([part[4] for part in centred]),
        )
        scale = (xx.diagonal(dim1=1, dim2=2) / (n[:, None] - 1)).clamp(min=0).sqrt()
        size = (
            total[1 : 1 + moments.regressors, 1 : 1 + moments.regressors].diagonal() / total[0, 0]
        ).sqrt() + moments.shift_x.abs()
        if bool((constant := scale <= CONSTANT * size).any()):
            raise FitError(
                f"basis function number {int(constant.any(0).nonzero()[0, 0])} is constant; leave"
                " it out (the intercept is there)"
            )
        gram = xx / (scale[:, :, None] * scale[:, None, :])
        return cls(
            gram,
            xy / scale[:, :, None],
            scale,
            torch.stack([p[1] for p in centred]),
            torch.stack([p[2] for p in centred]),
            judged,
        )

    def errors(self, coefficients: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean squared error [C] where judged, and its standard error over folds [C]."""
        count, j = len(self.judged), self.gram.shape[1]
        slope = coefficients[-count:] / self.scale[-count:, :, None]
        intercept = self.mean_y[-count:][:, axis] - (self.mean_x[-count:, :, None] * slope).sum(1)
        weights = torch.cat((intercept[:, None], slope), dim=1)
        xx, xy, yy = (
            self.judged[:, : j + 1, : j + 1],
            self.judged[:, : j + 1, j + 1 :],
            self.judged[:, j + 1 :, j + 1 :],
        )
        squares = (
            (weights * (xx @ weights)).sum(1)
            - 2 * (weights * xy[:, :, axis]).sum(1)
            + yy.diagonal(dim1=1, dim2=2)[:, axis]
        )
        n = self.judged[:, 0, 0]
        by_fold = squares / n[:, None]
        standard_error = (
            by_fold.std(0) / count**0.5 if count > 1 else torch.full_like(by_fold[0], torch.nan)
        )
        return squares.sum(0) / n.sum(), standard_error


@final
class SurfacePLSR(Estimator):
    """PLSR of each output by itself, chosen by surface analysis (document 002 section 4.5.1).

    Args:
        choose: `simplest`, the one-standard-error rule; or `least`, the bare minimum of the error.
        test: groups whose samples judge the models and fit none, as the document has it; empty for
            cross-validation over all groups.
    """

    def __init__(
        self, choose: Literal["simplest", "least"] = "simplest", *, test: Sequence[int] = ()
    ) -> None:
        self.choose = choose
        self.test = tuple(test)

    def solve(self, data: Data) -> list[Solution]:
        """Return the chosen solution; its `choice` has the order and the number of terms kept."""
        x = whole(data.x)
        found = self.surface(x, data.y, data.groups)
        return [self.chosen(found, x, data.y, data.groups)]

    def surface(self, x: Tensor, y: Tensor, groups: Tensor | None) -> Surface:
        """Return the errors of all models.

        Raises:
            FitError: with fewer than two groups or basis functions, or one that is constant.
        """
        fold_numbers(groups, None)
        moments = FoldMoments.checked(x, y, groups, None)
        return surface(moments, test=self.test)

    def chosen(self, found: Surface, x: Tensor, y: Tensor, groups: Tensor | None) -> Solution:
        """Return the solution that the surface of `x` and `y` leads to."""
        if groups is not None and self.test:
            train = ~torch.isin(groups, torch.tensor(self.test))
            x, y = x[train], y[train]
        outputs = range(y.shape[1])
        pick = found.simplest if self.choose == "simplest" else found.least
        std_x, std_y = x.std(0), y.std(0)
        varies = (std_y > CONSTANT * y.abs().amax(0)).tolist()
        # an output that is constant but for rounding needs no basis function
        picks = [pick(output) if varies[output] else (0, 0) for output in outputs]
        coefficients = y.new_zeros(x.shape[1], y.shape[1])
        for output, (order, count) in zip(outputs, picks, strict=True):
            if order == 0:
                continue
            kept = found.kept(output, order, count)
            e = (x[:, kept] - x[:, kept].mean(0)) / std_x[kept]
            f = (y[:, [output]] - y[:, output].mean()) / std_y[output]
            best = pls_path(e.T @ e, e.T @ f, order)[-1, :, 0]
            coefficients[kept, output] = best / std_x[kept] * std_y[output]
        choice = {"order": [order for order, _ in picks], "terms": [count for _, count in picks]}
        state = {"coefficients": coefficients, "intercept": y.mean(0) - x.mean(0) @ coefficients}
        return Solution(choice, state)
