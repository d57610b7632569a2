"""Kernel ridge regression (document 001 section 3.2, corrections M4, M5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import Estimator, column_names, fold_numbers, require_data
from residnet.regression.kernel.functions import Kernel
from residnet.regression.kernel.path import Path
from residnet.regression.pieces import Regressors, whole
from residnet.regression.solutions import Solution

Scoring = Callable[[Sequence[Path]], Tensor]
"""Errors [settings, penalties, n] of fits, one path for each setting of the kernel."""


class _Pick(NamedTuple):
    """The kernel's setting and the penalty of each output, by number."""

    settings: tuple[int, ...]
    penalties: tuple[int, ...]


@final
class KernelRidge(Estimator):
    """Kernel ridge regression of every output, without intercept.

    A solution's state is that of the kernel module, and `effective` [n], the effective number of
    parameters of each output, which is the trace of the smoother.

    Args:
        kernel: module of the kernel, with the settings that are tried.
        penalties: candidates for each sample: the document's lambda (scikit-learn's alpha) is
            penalty * samples.
        folds: folds of the cross-validation; None for one fold for each group.
        scoring: errors by which each output chooses its setting and penalty; None for the
            cross-validated ones.
        alternatives: whether `fit` offers every setting and penalty for all outputs together, with
            the neighbours of each, and no function at all, beside its own choice.
    """

    def __init__(
        self,
        kernel: Kernel,
        penalties: Sequence[float],
        *,
        folds: int | None = 5,
        scoring: Scoring | None = None,
        alternatives: bool = False,
    ) -> None:
        self.kernel = kernel
        self.penalties = tuple(sorted(penalties))
        self.folds = folds
        self.scoring = scoring
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
        """Return the solution of the least error of each output, then the alternatives.

        See `Estimator.fit`.

        Raises:
            FitError: with fewer groups than folds.
        """
        x = whole(x)
        require_data(x, y, column_names(x, names, "x"), column_names(y, outputs, "y"))
        fold = fold_numbers(groups, self.folds)
        folds, count = int(fold.max()) + 1, len(self.penalties)
        absolute = [penalty * len(x) for penalty in self.penalties]
        with torch.no_grad():
            paths = self.kernel.paths(x, y, fold, folds, absolute)
        errors = torch.stack([path.errors for path in paths])
        notes: dict[str, Any] = {"cross_validated_error": errors.tolist(), "samples": len(x)}
        judged = errors
        if self.scoring is not None:
            judged = self.scoring(paths)
            notes["recursion_error"] = judged.tolist()
        least, best = torch.nan_to_num(judged, nan=torch.inf).flatten(0, 1).min(0)
        if not bool(torch.isfinite(least).all()):
            raise FitError(
                "kernel ridge regression: no setting has finite errors; give larger `penalties`"
            )
        preferred = _Pick(tuple((best // count).tolist()), tuple((best % count).tolist()))
        if not self.alternatives:
            return [self._solution(paths, preferred, notes)]
        n = y.shape[1]
        picks = [preferred]
        picks += [_Pick((i,) * n, (j,) * n) for i in range(len(paths)) for j in range(count)]
        zero = self.kernel.zero_state() | {"effective": y.new_zeros(n)}
        nothing = Solution({"penalty": []}, zero, notes=notes)
        return [*(self._solution(paths, pick, notes) for pick in picks), nothing]

    def _solution(self, paths: Sequence[Path], pick: _Pick, notes: dict[str, Any]) -> Solution:
        """Return the solution of one setting and penalty for each output."""
        parts = list(enumerate(zip(pick.settings, pick.penalties, strict=True)))
        columns = [paths[i].coefficients[j, :, output] for output, (i, j) in parts]
        effective = torch.stack([paths[i].effective[j] for _, (i, j) in parts])
        setting, state = self.kernel.selected(
            [paths[i] for i in pick.settings], torch.stack(columns, dim=1)
        )

        def neighbours() -> list[Solution]:
            near = []
            for output, (_, j) in parts:
                for other in (j - 1, j + 1):
                    if 0 <= other < len(self.penalties):
                        before, after = pick.penalties[:output], pick.penalties[output + 1 :]
                        near.append(pick._replace(penalties=(*before, other, *after)))
            return [self._solution(paths, other, notes) for other in near]

        return Solution(
            setting | {"penalty": [self.penalties[j] for j in pick.penalties]},
            state | {"effective": effective},
            notes=notes | {"effective_parameters": effective.tolist()},
            neighbours=neighbours if self.alternatives else None,
        )
