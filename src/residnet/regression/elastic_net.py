"""LASSO and elastic net, by scikit-learn."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from residnet.regression.estimator import Estimator, column_names, fold_numbers, require_data
from residnet.regression.pieces import Regressors, whole
from residnet.regression.solutions import Solution

_PENALTIES = 40
"""Number of penalties on scikit-learn's own path."""
_ITERATIONS = 3000
"""Most rounds of coordinate descent for one penalty."""
_TOLERANCE = 1e-4
"""Gap to the optimum at which coordinate descent ends."""


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

    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Return the solution with the penalties of the least error; see `Estimator.fit`."""
        # scikit-learn takes a second to import
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.linear_model import ElasticNetCV

        x = whole(x)
        require_data(x, y, column_names(x, names, "x"), column_names(y, outputs, "y"))
        fold = fold_numbers(groups, self.folds)
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
