"""Ridge regression (document 001 section 2.2, correction M4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import Estimator
from residnet.regression.moments import Candidates, Centred, FoldMoments
from residnet.regression.pieces import Regressors
from residnet.regression.solutions import Solution


@final
class Ridge(Estimator):
    """Ridge regression of every output, with an intercept that is not penalised.

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
        self.penalties = tuple(sorted(penalties))
        self.folds = folds
        self.scale = scale
        self.shared = shared
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
        """Return the solution of the least cross-validated error, then the alternatives.

        Without groups there is no cross-validation, and there must be one penalty only. The
        choice of no coefficients has an empty list of penalties. See `Estimator.fit`.
        """
        moments = FoldMoments.checked(x, y, groups, self.folds, names, outputs)
        n = y.shape[1]
        notes: dict[str, Any] = {"terms": x.shape[1]}
        chosen = [0] * n
        if groups is not None:
            folds = [self._path(moments.without(f)) for f in range(moments.folds)]
            error = moments.cross_validate(folds)
            chosen = [int(error.sum(1).argmin())] * n if self.shared else error.argmin(0).tolist()
            notes = {"cross_validated_error": error.tolist()} | notes
        elif len(self.penalties) > 1:
            raise FitError("several penalties, and without groups nothing can choose between them")
        model = self._path(moments.all())
        picks = [chosen]
        picks += [[i] * n for i in range(len(self.penalties))] if self.alternatives else []
        solutions = []
        for pick in picks:
            columns = [model.coefficients[i, :, output] for output, i in enumerate(pick)]
            found = torch.stack(columns, dim=1)
            state = {"coefficients": found, "intercept": moments.intercept(found, model)}
            choice = {"penalty": [self.penalties[i] for i in pick]}
            solutions.append(Solution(choice, state, notes=notes))
        if not self.alternatives:
            return solutions
        nothing = {
            "coefficients": torch.zeros_like(model.coefficients[0]),
            "intercept": y.new_zeros(n),
        }
        return [*solutions, Solution({"penalty": []}, nothing, notes=notes)]

    def _path(self, centred: Centred) -> Candidates:
        """Return the models of all penalties, from one eigendecomposition."""
        n, xx, xy = centred.samples, centred.xx, centred.xy
        scale = torch.ones_like(centred.mean_x)
        if self.scale:
            scale = (xx.diagonal() / n).sqrt()
            scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        values, vectors = torch.linalg.eigh(xx / torch.outer(scale, scale) / n)
        projected = vectors.T @ (xy / scale[:, None]) / n
        shrunk = [
            projected / (values.clamp(min=0.0) + penalty)[:, None] for penalty in self.penalties
        ]
        path = torch.stack([vectors @ part for part in shrunk])
        return Candidates(path / scale[None, :, None], centred.mean_x, centred.mean_y)
