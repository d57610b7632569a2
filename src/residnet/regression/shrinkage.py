"""Ridge regression and partial least squares from moments, cross-validated fold by fold.

Sources: document 001 section 2.2 with correction M4; document 002 section 3.2, corrections J14 to
J17.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.samples import Tally
from residnet.regression.estimator import (
    Data,
    Estimator,
    Regressors,
    Solution,
    fold_numbers,
    pieces,
    require_more,
)

CONSTANT = 1e-9
"""Standard deviation below which, in units of its largest value, a column counts as constant."""
_LEAST_ENERGY = 1e-13
"""Least energy of a latent variable in units of a column's: below it are rounding and columns that
are sums of others, without a meaning.
"""
_EXPLAINED = 1e-13
"""Share of the covariance up to which nothing is left to explain."""
_TINY = 1e-300
"""Least length that a vector is divided by."""
_EACH_ORDER = 8
"""Order up to which every order is offered as an alternative; above, steps of a quarter."""


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

        A column that varies by rounding alone counts as zero, so that it gets no coefficient
        instead of a huge one.
        """
        tally = Tally(x.shape[1])
        for _, part in pieces(x):
            tally.add(part)
        largest = torch.maximum(tally.low.abs(), tally.high.abs())
        constant = tally.std(correction=1) <= CONSTANT * largest
        shift_x, shift_y = tally.mean.masked_fill(constant, 0.0), y.mean(0)
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
        cls, x: Regressors, y: Tensor, groups: Tensor | None, folds: int | None
    ) -> FoldMoments:
        """Return the moments for an estimator, in one fold where `groups` is None.

        Raises:
            FitError: with too few groups, or no more samples than columns.
        """
        fold = fold_numbers(groups, folds) if groups is not None else y.new_zeros(len(x))
        require_more(x, "basis functions")
        return cls.gather(x, y, fold, int(fold.max()) + 1)

    def centred(self, total: Tensor) -> Centred:
        """Return the moments about the means, from summed moments."""
        j = self.regressors
        n = float(total[0, 0])
        mean = total[0, 1:] / n
        cross = total[1:, 1:] - n * torch.outer(mean, mean)
        return Centred(n, mean[:j], mean[j:], cross[:j, :j], cross[:j, j:])

    def squared_error(self, fold: int, coefficients: Tensor, part: Centred) -> Tensor:
        """Return the sums of squared errors on one fold [C, n] of models about a part's means.

        Their coefficients are [C, J, n].
        """
        j = self.regressors
        s = self.sums[fold]
        intercept = part.mean_y - torch.einsum("j,cjk->ck", part.mean_x, coefficients)
        weights = torch.cat((intercept[:, None, :], coefficients), dim=1)
        xx, xy, yy = s[: j + 1, : j + 1], s[: j + 1, j + 1 :], s[j + 1 :, j + 1 :].diagonal()
        quadratic = torch.einsum("cik,ij,cjk->ck", weights, xx, weights)
        return yy - 2 * torch.einsum("cik,ik->ck", weights, xy) + quadratic

    def variance(self) -> Tensor:
        """Return the variance of each output over all samples [n]."""
        j, total = self.regressors, self.sums.sum(0)
        return total[j + 1 :, j + 1 :].diagonal() / total[0, 0]


class _PathEstimator(Estimator):
    """An estimator whose models of all complexities come from moments, with an intercept.

    Args:
        folds: folds of the cross-validation; None for one fold for each group.
        scale: whether columns are scaled to unit variance; else they are only centred.
        alternatives: whether `fit` offers other complexities, and no coefficients at all, beside
            its own choice.
    """

    def __init__(self, *, folds: int | None, scale: bool, alternatives: bool) -> None:
        self.folds = folds
        self.scale = scale
        self.alternatives = alternatives

    @abstractmethod
    def path(self, xx: Tensor, xy: Tensor, samples: float) -> Tensor:
        """Return the coefficients [C, J, n] of C complexities, from moments of scaled columns."""

    @abstractmethod
    def choices(self, errors: Tensor | None, variance: Tensor, count: int) -> list[list[int]]:
        """Return the complexity of each output [n], the preferred ones first.

        Args:
            errors: cross-validated mean squared errors [C, n]; None where there are no folds.
            variance: of each output [n]; infinite for one that is constant but for rounding.
        """

    @abstractmethod
    def named(self, pick: Sequence[int]) -> dict[str, Any]:
        """Return what sets the complexities of the outputs apart; none for an empty list."""

    def notes(self, errors: Tensor, variance: Tensor) -> dict[str, Any]:
        """Return what there is to say about cross-validated errors [C, n]."""
        return {"cross_validated_error": errors.tolist()}

    @final
    def solve(self, data: Data) -> list[Solution]:
        """Return the solution of the least cross-validated error, then the alternatives.

        Without groups there is no cross-validation, and nothing may be left to choose.
        """
        x, y, groups, _, _ = data
        moments = FoldMoments.checked(x, y, groups, self.folds)
        variance = moments.variance()
        varies = variance > (CONSTANT * moments.shift_y).square()
        variance = torch.where(varies, variance, torch.inf)
        notes: dict[str, Any] = {"terms": x.shape[1]}
        n = y.shape[1]
        zero = {"coefficients": y.new_zeros(x.shape[1], n), "intercept": y.new_zeros(n)}
        total = moments.sums.sum(0)
        whole = moments.centred(total)
        found, errors = self._models(whole), None
        if groups is not None:
            parts = [moments.centred(total - one) for one in moments.sums]
            models = [self._models(part) for part in parts]
            count = min(len(model) for model in models)
            squares = [
                moments.squared_error(f, model[:count], part)
                for f, (model, part) in enumerate(zip(models, parts, strict=True))
            ]
            errors = torch.stack(squares).sum(0) / moments.sums[:, 0, 0].sum()
            found = found[:count]
            notes = self.notes(errors, variance) | notes if count else notes
        nothing = Solution(self.named([]), zero, notes=notes)
        if len(found) == 0:
            return [nothing]
        solutions = []
        for pick in self.choices(errors, variance, len(found)):
            columns = torch.stack([found[i, :, output] for output, i in enumerate(pick)], dim=1)
            intercept = whole.mean_y + moments.shift_y - (whole.mean_x + moments.shift_x) @ columns
            state = {"coefficients": columns, "intercept": intercept}
            solutions.append(Solution(self.named(pick), state, notes=notes))
        return [*solutions, nothing] if self.alternatives else solutions

    def _models(self, part: Centred) -> Tensor:
        """Return the coefficients [C, J, n] of all complexities."""
        scale = torch.ones_like(part.mean_x)
        if self.scale:
            scale = (part.xx.diagonal() / part.samples).sqrt()
            scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        xx, xy = part.xx / torch.outer(scale, scale), part.xy / scale[:, None]
        return self.path(xx, xy, part.samples) / scale[None, :, None]


@final
class Ridge(_PathEstimator):
    """Ridge regression of every output, with an intercept that is not penalised.

    The choice of no coefficients has an empty list of penalties.

    Args:
        penalties: candidates, in units of a standardised column's energy: alpha = penalty N in
            scikit-learn's terms.
        folds: folds of the cross-validation that chooses; None for one fold for each group.
        scale: whether columns are scaled to unit variance; else they are only centred.
        shared: whether all outputs share one penalty, that of the least sum of errors; else each
            output takes its own.
        alternatives: whether `fit` offers every penalty for all outputs, and no coefficients at
            all, beside its own choice.
    """

    def __init__(
        self,
        penalties: Sequence[float],
        *,
        folds: int | None = 5,
        scale: bool = True,
        shared: bool = False,
        alternatives: bool = False,
    ) -> None:
        super().__init__(folds=folds, scale=scale, alternatives=alternatives)
        self.penalties = tuple(sorted(penalties))
        self.shared = shared

    def path(self, xx: Tensor, xy: Tensor, samples: float) -> Tensor:
        values, vectors = torch.linalg.eigh(xx / samples)
        projected = vectors.T @ xy / samples
        penalties = torch.tensor(self.penalties, dtype=xy.dtype)
        shrunk = projected / (values.clamp(min=0.0) + penalties[:, None])[..., None]
        path: Tensor = vectors @ shrunk
        return path

    def choices(self, errors: Tensor | None, variance: Tensor, count: int) -> list[list[int]]:
        """Return the penalties of the least error, then each for all outputs."""
        n = variance.numel()
        if errors is None and count > 1:
            raise FitError("several penalties, and without groups nothing can choose between them")
        errors = variance.new_zeros(1, n) if errors is None else errors
        best = [int(errors.sum(1).argmin())] * n if self.shared else errors.argmin(0).tolist()
        return [best, *([i] * n for i in range(count) if self.alternatives)]

    def named(self, pick: Sequence[int]) -> dict[str, Any]:
        return {"penalty": [self.penalties[i] for i in pick]}


@final
class PLSR(_PathEstimator):
    """Partial least squares of all outputs together, with an intercept.

    Outputs that nothing explains get the solution of order 0, without coefficients.

    Args:
        order: number of latent variables; None takes the least cross-validated error, summed over
            the outputs in units of their variances.
        max_order: highest order tried; None for the number of columns.
        folds: folds of the cross-validation; None for one fold for each group.
        scale: whether columns are scaled to unit variance; else they are only centred.
        alternatives: whether `fit` offers other orders, and none, beside its own choice.
    """

    def __init__(
        self,
        order: int | None = None,
        *,
        max_order: int | None = 40,
        folds: int | None = 5,
        scale: bool = True,
        alternatives: bool = False,
    ) -> None:
        super().__init__(folds=folds, scale=scale, alternatives=alternatives)
        self.order = order
        self.max_order = max_order

    def path(self, xx: Tensor, xy: Tensor, samples: float) -> Tensor:
        return pls_path(xx, xy, min(self.order or self.max_order or len(xx), len(xx)))

    def choices(self, errors: Tensor | None, variance: Tensor, count: int) -> list[list[int]]:
        """Return the order given or of the least error, then those worth trying."""
        n, order = variance.numel(), count
        if self.order is not None:
            order = min(self.order, count)
        elif errors is None:
            raise FitError("the order is not given, and without groups nothing can choose it")
        else:
            order = int((errors / variance).mean(1).argmin()) + 1
        orders = [order]
        if self.alternatives:
            # each of the first few, then steps of a quarter
            tried = [1]
            while tried[-1] < count:
                step = tried[-1] * 5 // 4 if tried[-1] >= _EACH_ORDER else tried[-1] + 1
                tried.append(min(step, count))
            orders += tried
        return [[k - 1] * n for k in orders]

    def named(self, pick: Sequence[int]) -> dict[str, Any]:
        return {"order": pick[0] + 1 if pick else 0}

    def notes(self, errors: Tensor, variance: Tensor) -> dict[str, Any]:
        """Return the error by order, mean over outputs in units of their variances."""
        return {"cross_validated_share": (errors / variance).mean(1).tolist()}


def pls_path(
    xx: Tensor, xy: Tensor, orders: int | Tensor, *, joint: bool = True, mask: Tensor | None = None
) -> Tensor:
    """Return coefficients of partial least squares for every order, [A, ..., J, K].

    Kernel algorithm of Dayal and MacGregor (1997), from moments alone. The path ends early where
    nothing is left to explain, or to explain it with.

    Args:
        xx: X'X of centred, scaled columns [..., J, J].
        xy: X'Y [..., J, K].
        orders: number of latent variables; or that of each column of xy, ascending, [K]: a column
            is left alone once its order is reached.
        joint: whether the columns of xy are outputs of one model (PLS2); else each has a model of
            its own (PLS1).
        mask: 1 where a model has a regressor, 0 elsewhere, [J, K].
    """
    rest = xy if mask is None else xy * mask
    least = _EXPLAINED * torch.linalg.vector_norm(rest, dim=(-2, -1) if joint else -2)
    least_energy = _LEAST_ENERGY * float(xx.diagonal(dim1=-2, dim2=-1).max())
    loadings: list[Tensor] = []
    rotations: list[Tensor] = []
    total, path = torch.zeros_like(xy), []
    for step in range(orders if isinstance(orders, int) else int(orders.max())):
        first = 0 if isinstance(orders, int) else int((orders <= step).sum())
        part = rest[..., first:]
        if joint:
            left, singular, _ = torch.linalg.svd(part, full_matrices=False)
            r = w = left[..., :1]
            alive = singular[..., :1] > least
        else:
            norm = torch.linalg.vector_norm(part, dim=-2, keepdim=True)
            r = w = part / norm.clamp(min=_TINY)
            alive = norm > least[..., None, first:]
        for p_old, r_old in zip(loadings, rotations, strict=True):
            r = r - (p_old[..., first:] * w).sum(-2, keepdim=True) * r_old[..., first:]
        image = xx @ r if mask is None else (xx @ r) * mask[..., first:]
        energy = (r * image).sum(-2, keepdim=True)
        alive = alive & (energy > least_energy)
        if not bool(alive.any()):
            break
        safe = torch.where(alive, energy, 1.0)
        share = torch.where(alive, (r * part).sum(-2, keepdim=True) / safe, 0.0)
        p = torch.where(alive, image / safe, 0.0)
        total = torch.cat((total[..., :first], total[..., first:] + r * share), dim=-1)
        rest = torch.cat((rest[..., :first], part - p * (share * energy)), dim=-1)
        fill = torch.zeros_like(xy[..., : 0 if joint else first])
        loadings.append(torch.cat((fill, p), dim=-1))
        rotations.append(torch.cat((fill, r), dim=-1))
        path.append(total)
    return torch.stack(path) if path else xy.new_zeros(0, *xy.shape)
