"""Linear least squares with standard errors that hold for correlated residuals."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from residnet.core.errors import FitError


class LinearFit(NamedTuple):
    """Coefficients [J, K], their standard errors [J, K], and the condition number of the scaled regressors."""

    coefficients: Tensor
    errors: Tensor
    condition: float


def solve(x: Tensor, y: Tensor, group: Tensor, *, names: tuple[str, ...], ridge: float = 0.0) -> LinearFit:
    """Fit y [N, K] by x [N, J] with a relative ridge penalty (0 = ordinary least squares).

    Columns are scaled to unit root mean square first, so `ridge` is a share of each column's own energy. Standard errors
    are cluster-robust over manoeuvres (`group` [N]): residuals at 10-20 Hz are far from independent, and the textbook
    formula would claim several times the accuracy. With fewer than two manoeuvres they are the textbook ones.

    Raises:
        FitError: with fewer samples than regressors, a regressor that is zero throughout, or regressors that the data
            cannot tell apart.
    """
    n, j = x.shape
    if n <= j:
        raise FitError(f"{n} samples do not determine {j} coefficients ({', '.join(names)}); give longer or more logs")
    scale = x.square().mean(0).sqrt()
    if bool((scale <= 0).any()):
        dead = [name for name, s in zip(names, scale.tolist(), strict=True) if s <= 0]
        raise FitError(f"regressor '{dead[0]}' is zero in all {n} samples; the data do not excite it: leave it out or log it")
    a = x / scale
    gram = a.T @ a / n
    values = torch.linalg.eigvalsh(gram)
    condition = float(torch.sqrt(values[-1] / values[0].clamp(min=1e-300)))
    if condition > 1e9:
        vector = torch.linalg.eigh(gram).eigenvectors[:, 0].abs()
        worst = [names[i] for i in vector.argsort(descending=True)[:2].tolist()]
        raise FitError(
            f"the data cannot tell apart regressors '{worst[0]}' and '{worst[1]}' (condition {condition:.1e}); "
            "leave one out or excite them separately"
        )
    inverse = torch.linalg.inv(gram + ridge * torch.eye(j, dtype=x.dtype))
    coefficients = inverse @ (a.T @ y) / n
    residual = y - a @ coefficients
    errors = torch.empty_like(coefficients)
    for k in range(y.shape[1]):
        score = a * residual[:, k : k + 1]
        present, index = torch.unique(group, return_inverse=True)
        count = int(present.numel())
        if count < 2:
            meat = gram * residual[:, k].square().sum() / (n - j) * n
        else:
            total = torch.zeros(count, j, dtype=x.dtype).index_add_(0, index, score)
            meat = total.T @ total * count / (count - 1)
        errors[:, k] = (inverse @ meat @ inverse).diagonal().clamp(min=0).sqrt() / n
    return LinearFit(coefficients / scale[:, None], errors / scale[:, None], condition)
