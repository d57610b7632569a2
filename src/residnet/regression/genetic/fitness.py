"""Fitness of a generation: coefficients by least squares, and errors on both kinds of samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from residnet.regression.expressions.algebra import Algebra, Columns, Product

Terms = tuple[Product, ...]
_SINGULAR = 1e-13
"""Share of a term's energy that must be left beside the terms before it; below it the Gram matrix
counts as singular (section 5.1.2).
"""
_TINY = 1e-300
"""Least mean square of a target that errors are divided by."""
_LEAST_SCALE = 1e-100
"""Root mean square of a term below which it is not used."""
_ROWS = 40_000_000
"""Numbers in the cache of columns before it is emptied."""
_CHUNK = 3_000_000
"""Numbers in one batch of columns."""


class Fitness:
    """The errors of individuals on training and validation samples.

    They are mean square errors over the target's mean square on each.

    Each distinct set of terms is fitted once in the whole search. A generation's new sets go
    through together: columns of the terms that they share are computed once, then Gram matrices,
    Cholesky factors and residuals are batched (document 000 eqs. (5.4)-(5.6)).
    """

    def __init__(
        self,
        algebra: Algebra,
        data: Mapping[str, np.ndarray],
        target: np.ndarray,
        train: np.ndarray,
        prune: float,
    ) -> None:
        """From channels [N], the target [N], which samples [N] train, and the share of the target's
        energy below which a term is pruned.
        """
        order = np.argsort(~train, kind="stable")
        self.columns = Columns(
            algebra,
            {name: np.asarray(data[name], dtype=np.float64)[order] for name in algebra.channels},
        )
        self.count = int(train.sum())
        y = torch.from_numpy(np.asarray(target, dtype=np.float64)[order])
        self.y, self.y_validation = y[: self.count], y[self.count :]
        self.energy = [
            max(float(part.square().mean()), _TINY) for part in (self.y, self.y_validation)
        ]
        self.prune = prune
        self.fitted = 0
        self._known: dict[Terms, tuple[float, float, Terms]] = {}
        self._empty()

    def of(self, individuals: Sequence[Terms | None]) -> list[tuple[float, float, Terms]]:
        """Return (training error, validation error, terms that are left) of each.

        Errors are infinite where there are no terms, or they are not independent.
        """
        new = [
            terms
            for terms in dict.fromkeys(individuals)
            if terms is not None and terms not in self._known
        ]
        if new:
            self._fit(new)
        nothing = (np.inf, np.inf, ())
        return [nothing if terms is None else self._known[terms] for terms in individuals]

    def _empty(self) -> None:
        self._rows: dict[Product, int] = {}
        self._values = torch.zeros(0, len(self.y) + len(self.y_validation), dtype=torch.float64)
        self._usable = torch.zeros(0, dtype=torch.bool)

    def _fit(self, sets: Sequence[Terms]) -> None:
        self._cache({product for terms in sets for product in terms})
        by_width: dict[int, list[Terms]] = {}
        for terms in sets:
            if not terms or not bool(self._usable[[self._rows[p] for p in terms]].all()):
                self._known[terms] = (np.inf, np.inf, ())
            else:
                by_width.setdefault(len(terms), []).append(terms)
        for width, group in by_width.items():
            step = max(1, _CHUNK // (width * self._values.shape[1]))
            for start in range(0, len(group), step):
                self._batch(group[start : start + step])
        self.fitted += len(sets)

    def _cache(self, wanted: set[Product]) -> None:
        """Keep columns of unit mean square over the training samples."""
        if (len(self._rows) + len(wanted)) * self._values.shape[1] > _ROWS:
            self._empty()
        new = sorted(wanted - self._rows.keys())
        if not new:
            return
        values = self.columns.of(new)
        with np.errstate(over="ignore", invalid="ignore"):
            scale = np.sqrt(np.square(values[:, : self.count]).mean(axis=1))
        good = np.isfinite(scale) & (scale > _LEAST_SCALE) & np.isfinite(values).all(axis=1)
        values = np.where(good[:, None], values, 0.0) / np.where(good, scale, 1.0)[:, None]
        self._rows |= {product: len(self._rows) + i for i, product in enumerate(new)}
        self._values = torch.cat((self._values, torch.from_numpy(values)))
        self._usable = torch.cat((self._usable, torch.from_numpy(good)))

    def _batch(self, group: Sequence[Terms]) -> None:
        """Fit sets of as many terms each."""
        columns = self._values[torch.tensor([[self._rows[p] for p in terms] for terms in group])]
        x, x_validation = columns[..., : self.count], columns[..., self.count :]
        gram = x @ x.transpose(1, 2) / self.count
        factor, info = torch.linalg.cholesky_ex(gram)
        right = (x @ self.y / self.count)[..., None]
        good = (info == 0) & (factor.diagonal(dim1=1, dim2=2).square().amin(dim=1) > _SINGULAR)
        factor = torch.where(
            good[:, None, None], factor, torch.eye(gram.shape[1], dtype=gram.dtype)
        )
        if self.prune > 0:
            self._pruned(
                group, good, torch.linalg.solve_triangular(factor, right, upper=False)[..., 0]
            )
        coefficients = torch.cholesky_solve(right, factor).transpose(1, 2)
        train = (self.y - (coefficients @ x)[:, 0]).square().mean(dim=1) / self.energy[0]
        validation = (self.y_validation - (coefficients @ x_validation)[:, 0]).square().mean(
            dim=1
        ) / self.energy[1]
        for terms, fine, a, b in zip(
            group, good.tolist(), train.tolist(), validation.tolist(), strict=True
        ):
            if not fine:
                self._known[terms] = (np.inf, np.inf, ())
            elif terms not in self._known:
                self._known[terms] = (a, b, terms)

    def _pruned(self, group: Sequence[Terms], good: Tensor, parts: Tensor) -> None:
        """Drop the terms that explain too little beside those before them, and fit the rest.

        This is orthogonal least squares.
        """
        keep = parts.square() / self.energy[0] >= self.prune
        rest = {}
        for terms, fine, kept in zip(group, good.tolist(), keep.tolist(), strict=True):
            fewer = tuple(p for p, k in zip(terms, kept, strict=True) if k)
            if fine and fewer and len(fewer) < len(terms):
                rest[terms] = fewer
        threshold, self.prune = self.prune, 0.0
        found = self.of(list(rest.values()))
        self.prune = threshold
        self._known |= dict(zip(rest, found, strict=True))
