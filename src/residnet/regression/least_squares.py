"""Linear least squares with standard errors that hold for correlated residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from residnet.core.errors import FitError


class LinearFit(NamedTuple):
    """Coefficients [J, K], their covariance for each column of y [K, J, J], and the condition
    number of the scaled regressors.
    """

    coefficients: Tensor
    covariance: Tensor
    condition: float

    @property
    def errors(self) -> Tensor:
        """Standard errors of the coefficients [J, K]."""
        return self.covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt().T


def solve(
    x: Tensor, y: Tensor, group: Tensor, *, names: tuple[str, ...], ridge: float = 0.0
) -> LinearFit:
    """Fit y [N, K] by x [N, J] with one penalty; see `solve_path`."""
    return solve_path(x, y, group, names=names, ridges=(ridge,))[0]


def solve_path(
    x: Tensor, y: Tensor, group: Tensor, *, names: tuple[str, ...], ridges: Sequence[float]
) -> list[LinearFit]:
    """Fit y [N, K] by x [N, J] with each of several relative ridge penalties (0 = ordinary least
    squares), from one Gram matrix.

    Columns are scaled to unit root mean square first, so a penalty is a share of each column's own
    energy. Standard errors are cluster-robust over manoeuvres (`group` [N]): residuals at 10-20 Hz
    are far from independent, and the textbook formula would claim several times the accuracy. With
    fewer than two manoeuvres they are the textbook ones.

    Raises:
        FitError: with fewer samples than regressors, a regressor that is zero throughout, or
            regressors that the data cannot tell apart and no penalty decides between.
    """
    n, j = x.shape
    if n <= j:
        raise FitError(
            f"{n} samples do not determine {j} coefficients ({', '.join(names)}); give longer or"
            " more logs"
        )
    scale = x.square().mean(0).sqrt()
    if bool((scale <= 0).any()):
        dead = [name for name, s in zip(names, scale.tolist(), strict=True) if s <= 0]
        raise FitError(
            f"regressor '{dead[0]}' is zero in all {n} samples; the data do not excite it: leave it"
            " out or log it"
        )
    a = x / scale
    gram, cross = a.T @ a / n, a.T @ y / n
    condition = _condition(gram, min(ridges), names)
    out = []
    for ridge in ridges:
        inverse = torch.linalg.inv(gram + ridge * torch.eye(j, dtype=x.dtype))
        coefficients = inverse @ cross
        residual = y - a @ coefficients
        meat = torch.stack(
            [_meat(a, residual[:, k : k + 1], gram, group) for k in range(y.shape[1])]
        )
        covariance = inverse @ meat @ inverse / n**2 / torch.outer(scale, scale)
        out.append(LinearFit(coefficients / scale[:, None], covariance, condition))
    return out


def _condition(gram: Tensor, ridge: float, names: tuple[str, ...]) -> float:
    """Condition number of the scaled regressors; an error where nothing tells two of them apart."""
    values, vectors = torch.linalg.eigh(gram)
    condition = float(torch.sqrt(values[-1] / values[0].clamp(min=1e-300)))
    # what rounding leaves of a zero eigenvalue
    if float(values[0]) + ridge < 10 * len(names) * torch.finfo(gram.dtype).eps * float(values[-1]):
        worst = [names[i] for i in vectors[:, 0].abs().argsort(descending=True)[:2].tolist()]
        raise FitError(
            f"the data cannot tell apart regressors '{worst[0]}' and '{worst[1]}' (condition"
            f" {condition:.1e}); leave one out, excite them separately, or give a ridge penalty"
        )
    return condition


def _meat(a: Tensor, residual: Tensor, gram: Tensor, group: Tensor) -> Tensor:
    """Spread of the score a'e [J, J]: over manoeuvres where there are at least two, else of
    independent residuals [N, 1].
    """
    n, j = a.shape
    present, index = torch.unique(group, return_inverse=True)
    count = int(present.numel())
    if count < 2:
        return gram * residual.square().sum() / (n - j) * n
    total = torch.zeros(count, j, dtype=a.dtype).index_add_(0, index, a * residual)
    return total.T @ total * count / (count - 1)
