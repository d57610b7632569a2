"""Least squares: linear, with standard errors that hold for correlated residuals, and damped."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import (
    Coefficient,
    Data,
    Estimator,
    Regressors,
    Solution,
    fold_numbers,
    pieces,
    require_more,
    whole,
)

_COLLINEAR = 1e-9
"""Share of the largest singular value below which centred columns count as collinear."""
_NAMED = 0.1
"""Share of the largest load from which a column is named among collinear ones."""
_ROUNDING = 10
"""What rounding leaves of a zero eigenvalue, in units of columns times machine precision."""
_TINY = 1e-300
"""Least eigenvalue that a condition number is divided by."""
_PENALTIES = 40
"""Number of penalties on scikit-learn's own path of the elastic net."""
_ITERATIONS = 3000
"""Most rounds of coordinate descent for one penalty."""
_TOLERANCE = 1e-4
"""Gap to the optimum at which coordinate descent ends."""
_LEAST_DAMPING, _ATTEMPTS = 1e-8, 8
"""Damping that changes no digit of a step that matters, and dampings tried before a point counts as
the minimum."""

Point = TypeVar("Point")


@final
class LeastSquares(Estimator):
    """Ordinary least squares without intercept, or with relative ridge penalties.

    Columns are scaled to unit root mean square first, so a penalty is a share of each column's own
    energy. Standard errors are cluster-robust over groups: residuals at 10-20 Hz are far from
    independent, and the textbook formula would claim several times the accuracy. With fewer than
    two groups they are the textbook ones.

    Args:
        penalties: relative ridge penalties, 0 for ordinary least squares; of several `fit` returns
            one solution each, from one Gram matrix.
    """

    def __init__(self, penalties: Sequence[float] = (0.0,)) -> None:
        self.penalties = tuple(penalties)

    def solve(self, data: Data) -> list[Solution]:
        x, y, groups, names, outputs = data
        n, j = x.shape
        require_more(x, f"coefficients ({', '.join(names)})")
        scale = _sum(x, lambda _, part: part.square().sum(0)).div(n).sqrt()
        if bool((scale <= 0).any()):
            dead = [name for name, s in zip(names, scale.tolist(), strict=True) if s <= 0]
            raise FitError(
                f"regressor '{dead[0]}' is zero in all {n} samples; the data do not excite it:"
                " leave it out or log it"
            )
        gram = _sum(x, lambda _, part: (part / scale).T @ (part / scale)) / n
        cross = _sum(x, lambda rows, part: (part / scale).T @ y[rows]) / n
        values, vectors = torch.linalg.eigh(gram)
        condition = float(torch.sqrt(values[-1] / values[0].clamp(min=_TINY)))
        rounding = _ROUNDING * len(names) * torch.finfo(gram.dtype).eps * float(values[-1])
        if float(values[0]) + min(self.penalties) < rounding:
            worst = [names[i] for i in vectors[:, 0].abs().argsort(descending=True)[:2].tolist()]
            raise FitError(
                f"the data cannot tell apart regressors '{worst[0]}' and '{worst[1]}' (condition"
                f" {condition:.1e}); leave one out, excite them separately, or give a ridge penalty"
            )
        solutions = []
        for penalty in self.penalties:
            inverse = torch.linalg.inv(gram + penalty * torch.eye(j, dtype=y.dtype))
            coefficients = inverse @ cross
            score = _score_spreads(x, y, scale, coefficients, gram, groups)
            covariance = inverse @ score @ inverse / n**2 / torch.outer(scale, scale)
            found = Solution(
                {"ridge": penalty} if len(self.penalties) > 1 else {},
                {"coefficients": coefficients / scale[:, None]},
                notes={"condition": condition},
                covariance=covariance,
            )
            estimates, errors = found.coefficients.tolist(), found.errors.tolist()
            table = tuple(
                Coefficient(output, name, estimates[j][k], errors[j][k])
                for k, output in enumerate(outputs)
                for j, name in enumerate(names)
            )
            solutions.append(replace(found, table=table))
        return solutions


@final
class CentredLeastSquares(Estimator):
    """Ordinary least squares with an intercept, from a QR factorisation of the centred columns.

    A QR factor keeps the digits of nearly collinear columns that a Gram matrix loses.
    """

    def solve(self, data: Data) -> list[Solution]:
        x, y, names = whole(data.x), data.y, data.names
        require_more(x, "basis functions")
        mean_x, mean_y = x.mean(0), y.mean(0)
        e, f = x - mean_x, y - mean_y
        _, singular, right = torch.linalg.svd(e, full_matrices=False)
        if float(singular[-1]) <= _COLLINEAR * float(singular[0]):
            loads = right[-1].abs()
            which = (loads > _NAMED * loads.max()).nonzero()[:, 0].tolist()
            raise FitError(
                f"basis functions {', '.join(names[j] for j in which)} are collinear over these"
                " samples; leave one out, or use ridge or plsr"
            )
        coefficients = torch.linalg.lstsq(e, f).solution
        state = {"coefficients": coefficients, "intercept": mean_y - mean_x @ coefficients}
        return [Solution({}, state, notes={"condition": float(singular[0] / singular[-1])})]


@final
class ElasticNet(Estimator):
    """The elastic net of each output by itself, with an intercept; its penalty by cross-validation.

    Columns are taken as they are: scale them before.

    Args:
        l1_ratio: share of the absolute penalty, above 0; 1 is LASSO.
        folds: folds of the cross-validation; None for one fold for each group.
    """

    def __init__(self, l1_ratio: float = 1.0, *, folds: int | None = None) -> None:
        self.l1_ratio = l1_ratio
        self.folds = folds

    def solve(self, data: Data) -> list[Solution]:
        # scikit-learn takes a second to import
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.linear_model import ElasticNetCV

        x, y = whole(data.x), data.y
        fold = fold_numbers(data.groups, self.folds)
        parts = [
            ((fold != k).nonzero()[:, 0].numpy(), (fold == k).nonzero()[:, 0].numpy())
            for k in range(int(fold.max()) + 1)
        ]
        coefficients, intercepts, penalties = [], [], []
        for output in range(y.shape[1]):
            model = ElasticNetCV(
                l1_ratio=self.l1_ratio,
                cv=parts,
                alphas=_PENALTIES,
                max_iter=_ITERATIONS,
                tol=_TOLERANCE,
            )
            with warnings.catch_warnings():
                # the smallest penalties of the path need not converge: cross-validation leaves
                # them behind
                warnings.simplefilter("ignore", ConvergenceWarning)
                model.fit(x.numpy(), y[:, output].numpy())
            coefficients.append(torch.from_numpy(model.coef_))
            intercepts.append(float(model.intercept_))
            penalties.append(float(model.alpha_))
        state = {
            "coefficients": torch.stack(coefficients, dim=1),
            "intercept": torch.tensor(intercepts, dtype=y.dtype),
        }
        return [Solution({"alpha": penalties}, state)]


def _score_spreads(
    x: Regressors,
    y: Tensor,
    scale: Tensor,
    coefficients: Tensor,
    gram: Tensor,
    groups: Tensor | None,
) -> Tensor:
    """Return the spread of the score a'e of each output [n, J, J], for columns a = x / scale.

    It is taken over groups where there are at least two, else as of independent residuals.
    """
    samples, j = x.shape
    outputs = y.shape[1]
    present, index = (
        torch.unique(groups, return_inverse=True) if groups is not None else (y[:0, 0], None)
    )
    count = int(present.numel())
    if index is None or count < 2:
        left = _sum(x, lambda rows, part: (y[rows] - part / scale @ coefficients).square().sum(0))
        return gram * (left / (samples - j) * samples)[:, None, None]
    total = torch.zeros(outputs, count, j, dtype=y.dtype)
    for rows, part in pieces(x):
        a = part / scale
        residual = y[rows] - a @ coefficients
        for k in range(outputs):
            total[k].index_add_(0, index[rows], a * residual[:, [k]])
    return total.transpose(1, 2) @ total * count / (count - 1)


def _sum(x: Regressors, of: Callable[[slice, Tensor], Tensor]) -> Tensor:
    """Return the sum of what each piece of regressors gives."""
    parts = iter(pieces(x))
    rows, part = next(parts)
    total = of(rows, part)
    for rows, part in parts:
        total = total + of(rows, part)
    return total


@dataclass(frozen=True)
class Descent(Generic[Point]):
    """Where a descent ended, and how many steps it took."""

    point: Point
    steps: int


def descend(
    begin: Point,
    near: Callable[[Point], tuple[float, Callable[[float], tuple[float, Point]]]],
    iterations: int,
    *,
    gain: float,
    damping: float = 1e-3,
) -> Descent[Point]:
    """Descend to a minimum by Levenberg's and Marquardt's method.

    Args:
        begin: where the descent begins, whatever a point is.
        near: linearises the problem at a point. It gives the cost there, and what a step with a
            damping leads to: the cost at its end, and the point itself.
        iterations: most steps.
        gain: share of the cost that a step must gain for another one.
        damping: of the first step, in units of the Hessian's diagonal; a tenth after a step that
            gains, ten times after one that does not. 0 for Gauss-Newton as long as that gains.
    """
    point, steps = begin, 0
    while steps < iterations:
        cost, trial = near(point)
        for _ in range(_ATTEMPTS):
            reached, moved = trial(damping)
            if math.isfinite(reached) and reached < cost:
                break
            damping = max(10.0 * damping, _LEAST_DAMPING)
        else:
            break
        point, steps, damping = moved, steps + 1, max(damping / 10.0, min(damping, _LEAST_DAMPING))
        if cost - reached < gain * abs(cost):
            break
    return Descent(point, steps)
