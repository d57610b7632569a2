"""Partial least squares regression over basis functions (document 002 section 3.2, ERRATA J14-J17),
from moments alone.
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
from residnet.regression.plsr import pls_path
from residnet.regression.solutions import Solution


def _ladder(highest: int) -> list[int]:
    """Orders worth a free run: each of the first eight, then steps of a quarter."""
    orders = [1]
    while orders[-1] < highest:
        orders.append(min(max(orders[-1] + 1, orders[-1] * 5 // 4), highest))
    return orders


class PlsrConfig(BasisConfig):
    """PLSR of the three residuals together.

    Attributes:
        order: number of latent variables; None chooses it as `choose` says (by one-step errors: the
            sum over axes, each in units of its variance).
        max_order: highest order tried.
    """

    kind: Literal["plsr"] = "plsr"
    order: int | None = Field(default=None, ge=1)
    max_order: int = Field(default=40, ge=1)

    def build(self, names: Sequence[str]) -> ClosedFormHead:
        """The module for channels `names`."""
        return in_space(
            self, names, lambda own, channels: PlsrHead(self.model_validate(own), channels)
        )


@final
class PlsrHead(BasisHead):
    """Basis functions with coefficients by PLSR."""

    def __init__(self, config: PlsrConfig, names: Sequence[str]) -> None:
        super().__init__(config, names)
        self.order = config.order or 0
        self.max_order = config.max_order

    def solutions(self, samples: Samples) -> list[Solution]:
        """The order given, or that of the least cross-validated error; then a ladder of orders and
        none where free runs choose.
        """
        moments = self.moments(samples)
        highest = (
            min(self.max_order, self.library.count)
            if self.order == 0
            else min(self.order, self.library.count)
        )
        folds = [self._scaled_path(moments.without(f), highest) for f in range(self.folds)]
        shortest = min(int(path.shape[0]) for path, _, _ in folds)
        if shortest == 0:
            # a residual without variance
            return [self.nothing({"order": 0}, {"terms": self.library.count})]
        error = moments.cross_validate([(path[:shortest], mx, my) for path, mx, my in folds])
        variance = samples.target.var(0, correction=0).clamp(min=1e-300)
        score = (error / variance).mean(-1)
        notes = {"cross_validated_share": score.tolist(), "terms": self.library.count}
        path, mean_x, mean_y = self._scaled_path(moments.all(), shortest)
        order = min(self.order or int(score.argmin()) + 1, len(path))
        found = [
            self.solution({"order": k}, path[k - 1], mean_x, mean_y, moments, notes)
            for k in (order, *_ladder(len(path)))
        ]
        return (
            [*found, self.nothing({"order": 0}, notes)]
            if self.by_free_run and not self.order
            else found[:1]
        )

    @staticmethod
    def _scaled_path(
        centred: tuple[float, Tensor, Tensor, Tensor, Tensor], orders: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Path of coefficients in unscaled columns [A, J, K], with the means that they refer to."""
        n, mean_x, mean_y, xx, xy = centred
        scale_x = (xx.diagonal() / (n - 1)).sqrt()
        scale_x = torch.where(scale_x > 0, scale_x, torch.ones_like(scale_x))
        path = pls_path(xx / torch.outer(scale_x, scale_x), xy / scale_x[:, None], orders)
        return path / scale_x[None, :, None], mean_x, mean_y
