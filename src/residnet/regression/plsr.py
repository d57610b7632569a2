"""Partial least squares regression (document 002 section 3.2, corrections J14 to J17)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import Estimator
from residnet.regression.moments import CONSTANT, Candidates, Centred, FoldMoments
from residnet.regression.nipals import nipals
from residnet.regression.pieces import Regressors, whole
from residnet.regression.pls_path import pls_path
from residnet.regression.solutions import Solution

_EACH_ORDER = 8
"""Order up to which every order is offered as an alternative; above, steps of a quarter."""


@final
class PLSR(Estimator):
    """Partial least squares of all outputs together, with an intercept.

    Args:
        order: number of latent variables; None takes the least cross-validated error, summed over
            the outputs in units of their variances.
        max_order: highest order tried; None for the number of columns.
        folds: folds of the cross-validation; None for one fold for each group.
        scale: whether columns are scaled to unit variance; else they are only centred.
        algorithm: `kernel`, from moments alone (Dayal and MacGregor 1997); or `nipals`, as document
            002 prints it (section 3.3.1), whose order is chosen by the kernel algorithm.
        alternatives: whether `fit` offers other orders, and none, beside its own choice.
    """

    def __init__(
        self,
        order: int | None = None,
        *,
        max_order: int | None = 40,
        folds: int | None = 5,
        scale: bool = True,
        algorithm: Literal["kernel", "nipals"] = "kernel",
        alternatives: bool = False,
    ) -> None:
        self.order = order
        self.max_order = max_order
        self.folds = folds
        self.scale = scale
        self.algorithm = algorithm
        self.alternatives = alternatives

    def fit(
        self,
        x: Regressors,
        y: Tensor,
        groups: Tensor | None = None,
        *,
        names: Sequence[str] = (),
        outputs: Sequence[str] = (),
    ) -> list[Solution]:
        """Return the solution of the order given or chosen, then the alternatives.

        Without groups there is no cross-validation, and the order must be given. Outputs that
        nothing explains get the solution of order 0, without coefficients. See `Estimator.fit`.
        """
        moments = FoldMoments.checked(x, y, groups, self.folds, names, outputs)
        highest = min(self.order or self.max_order or x.shape[1], x.shape[1])
        notes: dict[str, Any] = {"terms": x.shape[1]}
        order = highest
        if groups is not None:
            folds = [self._path(moments.without(f), highest) for f in range(moments.folds)]
            highest = min(len(fold.coefficients) for fold in folds)
            if highest == 0:
                return [_zero(x, y, notes)]
            share = _relative_errors(moments, folds, highest)
            notes = {"cross_validated_share": share.tolist()} | notes
            order = self.order or int(share.argmin()) + 1
        elif self.order is None:
            raise FitError("the order is not given, and without groups nothing can choose it")
        model = self._path(moments.all(), highest)
        if self.algorithm == "nipals":
            model = model._replace(coefficients=self._nipals(whole(x), y, min(order, highest)))
        found = model.coefficients
        if len(found) == 0:
            return [_zero(x, y, notes)]
        orders = [min(order, len(found))]
        orders += _ladder(len(found)) if self.alternatives else []
        solutions = [
            Solution(
                {"order": k},
                {
                    "coefficients": found[k - 1],
                    "intercept": moments.intercept(found[k - 1], model),
                },
                notes=notes,
            )
            for k in orders
        ]
        return [*solutions, _zero(x, y, notes)] if self.alternatives else solutions

    def _path(self, centred: Centred, orders: int) -> Candidates:
        """Return the models of all orders, from moments about the means."""
        xx, xy = centred.xx, centred.xy
        scale = torch.ones_like(centred.mean_x)
        if self.scale:
            scale = (xx.diagonal() / (centred.samples - 1)).sqrt()
            scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        path = pls_path(xx / torch.outer(scale, scale), xy / scale[:, None], orders)
        return Candidates(path / scale[None, :, None], centred.mean_x, centred.mean_y)

    def _nipals(self, x: Tensor, y: Tensor, orders: int) -> Tensor:
        """Return the coefficients of all orders [A, J, n] by the printed algorithm."""
        e, f = x - x.mean(0), y - y.mean(0)
        scale = e.std(0) if self.scale else torch.ones_like(e[0])
        scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        return nipals(e / scale, f, orders) / scale[None, :, None]


def _relative_errors(moments: FoldMoments, folds: Sequence[Candidates], orders: int) -> Tensor:
    """Return cross-validated errors by order, mean over outputs in units of their variances [A]."""
    shortened = [fold._replace(coefficients=fold.coefficients[:orders]) for fold in folds]
    error, variance = moments.cross_validate(shortened), moments.variance()
    # an output that is constant but for rounding has no say
    varies = variance > (CONSTANT * moments.shift_y).square()
    return (error / torch.where(varies, variance, torch.inf)).mean(-1)


def _ladder(highest: int) -> list[int]:
    """Return orders worth trying: each of the first few, then steps of a quarter."""
    orders = [1]
    while orders[-1] < highest:
        step = orders[-1] * 5 // 4 if orders[-1] >= _EACH_ORDER else orders[-1] + 1
        orders.append(min(step, highest))
    return orders


def _zero(x: Regressors, y: Tensor, notes: dict[str, Any]) -> Solution:
    """Return the solution that is zero everywhere: it leaves the known part as it is."""
    state = {
        "coefficients": y.new_zeros(x.shape[1], y.shape[1]),
        "intercept": y.new_zeros(y.shape[1]),
    }
    return Solution({"order": 0}, state, notes=notes)
