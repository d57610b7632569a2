"""Partial least squares whose order and basis functions a surface analysis chooses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import torch
from torch import Tensor

from residnet.regression.estimator import Estimator, fold_numbers
from residnet.regression.moments import CONSTANT, FoldMoments
from residnet.regression.pieces import Regressors, whole
from residnet.regression.pls_path import pls_path
from residnet.regression.solutions import Solution
from residnet.regression.surface import Surface, surface


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

    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Return the chosen solution; its `choice` has the order and the number of terms kept.

        See `Estimator.fit`.

        Raises:
            FitError: with fewer than two groups or basis functions, or one that is constant.
        """
        x = whole(x)
        found = self.surface(x, y, groups, names=names, outputs=outputs)
        return [self.chosen(found, x, y, groups)]

    def surface(
        self,
        x: Tensor,
        y: Tensor,
        groups: Tensor | None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> Surface:
        """Return the errors of all models; arguments and errors as of `fit`."""
        fold_numbers(groups, None)
        moments = FoldMoments.checked(x, y, groups, None, names, outputs)
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
        state = {
            "coefficients": coefficients,
            "intercept": y.mean(0) - x.mean(0) @ coefficients,
        }
        return Solution(choice, state)
