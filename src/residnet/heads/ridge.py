"""Ridge regression over basis functions (document 001 section 2.2, ERRATA M4), the penalty by
cross-validation from moments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisConfig, BasisHead
from residnet.heads.force import in_space
from residnet.regression.solutions import Solution


class RidgeConfig(BasisConfig):
    """Ridge of each residual; penalties are in units of a standardised column's energy (alpha =
    penalty * samples in scikit-learn's terms).

    Attributes:
        penalties: candidates. By one-step errors each axis takes its own; free runs choose between
            those, one penalty for all axes, and no residual (an empty list in fit.json).
    """

    kind: Literal["ridge"] = "ridge"
    penalties: tuple[float, ...] = Field(
        default=(1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0), min_length=1
    )

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """The module for channels `names`."""
        return in_space(
            self, names, lambda own, channels: RidgeHead(self.model_validate(own), channels)
        )


@final
class RidgeHead(BasisHead):
    """Basis functions with coefficients by ridge regression."""

    def __init__(self, config: RidgeConfig, names: Sequence[str]) -> None:
        super().__init__(config, names)
        self.penalties = tuple(sorted(config.penalties))

    def solutions(self, samples: Samples) -> list[Solution]:
        """Of each axis the penalty of the least cross-validated error; then every penalty for all
        axes, and no residual, where free runs choose.
        """
        moments = self.moments(samples)
        error = moments.cross_validate(
            [self._scaled_path(moments.without(f)) for f in range(self.folds)]
        )
        best = error.argmin(0)
        notes = {"cross_validated_error": error.tolist(), "terms": self.library.count}
        path, mean_x, mean_y = self._scaled_path(moments.all())
        picks = [[int(i) for i in best]] + (
            [[i] * 3 for i in range(len(path))] if self.by_free_run else []
        )
        found = [
            self.solution(
                {"penalty": [self.penalties[i] for i in pick]},
                torch.stack([path[i, :, axis] for axis, i in enumerate(pick)], dim=1),
                mean_x,
                mean_y,
                moments,
                notes,
            )
            for pick in picks
        ]
        return [*found, self.nothing({"penalty": []}, notes)] if self.by_free_run else found

    def _scaled_path(
        self, centred: tuple[float, Tensor, Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients for every penalty [C, J, K] from one eigendecomposition, with the means that
        they refer to.
        """
        n, mean_x, mean_y, xx, xy = centred
        scale = (xx.diagonal() / n).sqrt()
        scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        values, vectors = torch.linalg.eigh(xx / torch.outer(scale, scale) / n)
        projected = vectors.T @ (xy / scale[:, None]) / n
        path = torch.stack(
            [
                vectors @ (projected / (values.clamp(min=0.0) + penalty)[:, None])
                for penalty in self.penalties
            ]
        )
        return path / scale[None, :, None], mean_x, mean_y
