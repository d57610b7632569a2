"""The search for a sparse solution on one QR factor: forward, backward, and swaps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple, final

import numpy as np
from scipy.special import gammaln

_ALIKE = 1e-11
"""Length of a unit column beside the chosen ones below which it adds nothing that rounding does
not.
"""
_PARALLEL = 1e-12
"""One less the squared cosine of two columns up to which they count as one."""
_POSITIVE = 3.0
"""Difference of the criterion from which one term more counts as evident: between positive and
strong evidence (Kass and Raftery 1995).
"""
_GAIN = 1e-6
"""Least gain of the criterion for which columns are swapped."""
_BLOCK = 4_000_000
"""Numbers held at once by the batched swaps."""
_PAIR_CANDIDATES = 40
"""Candidates, best single ones first, of which pairs are tried."""
_BEAM = 6
"""Sets of columns of one size that are followed side by side."""
_PATIENCE = 2
"""Sizes without a gain of the criterion after which these ways end."""


class Criterion(NamedTuple):
    """The extended BIC of k terms out of `candidates`.

    An error below `precision` of the target is no better than none.
    """

    samples: float
    candidates: int
    gamma: float
    energy: float
    precision: float

    def value(self, rss: np.ndarray | float, terms: int) -> np.ndarray:
        """Return the criterion of models with `terms` terms and residual sums of squares `rss`."""
        share = np.maximum(np.asarray(rss), 0.0) / self.energy + self.precision**2
        room = max(self.candidates, terms)
        ways = gammaln(room + 1) - gammaln(terms + 1) - gammaln(room - terms + 1)
        return np.asarray(
            self.samples * np.log(share) + terms * np.log(self.samples) + 2.0 * self.gamma * ways
        )

    def exact(self, rss: float) -> bool:
        """Return whether a fit is as good as arithmetic allows."""
        return rss <= (2.0 * self.precision) ** 2 * self.energy


class LeftOver(NamedTuple):
    """The remainder of all columns [R, J] and of the target [R] beside chosen columns."""

    columns: np.ndarray
    target: np.ndarray


def coefficients(r: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares coefficients [p] of columns [R, p], and their triangle's inverse.

    The rows of the inverse [p, p] give standard errors.
    """
    q, triangle = np.linalg.qr(r)
    inverse = np.linalg.inv(triangle) if triangle.size else triangle
    return inverse @ (q.T @ y), inverse


@final
class Search:
    """A search of one target [R] in columns of unit length [R, J]."""

    def __init__(self, r: np.ndarray, y: np.ndarray, rule: Criterion, max_terms: int) -> None:
        self.r = r
        self.y = y
        self.rule = rule
        self.max_terms = min(max_terms, r.shape[1])

    def rss(self, chosen: Sequence[int]) -> float:
        """Return the residual sum of squares of the chosen columns."""
        q = np.linalg.qr(self.r[:, list(chosen)])[0]
        left = self.y - q @ (q.T @ self.y)
        # once more: what the first projection rounded away
        left = left - q @ (q.T @ left)
        return float(left @ left)

    def value(self, chosen: Sequence[int]) -> float:
        """Return the criterion of the chosen columns."""
        return float(self.rule.value(self.rss(chosen), len(chosen)))

    def left_over(self, chosen: Sequence[int]) -> LeftOver:
        """Return what the chosen columns leave."""
        q = np.linalg.qr(self.r[:, list(chosen)])[0]
        columns, target = self.r, self.y
        for _ in range(2):
            columns, target = columns - q @ (q.T @ columns), target - q @ (q.T @ target)
        return LeftOver(columns, target)

    def start(self) -> tuple[float, list[int]]:
        """Return criterion and columns of the best of three ways.

        Forward and back again; unless that is exact, several ways forward side by side, and back
        from all columns where there are enough samples.
        """
        ways = [self.backward(self.forward())]
        if self.rule.exact(self.rss(ways[0][1])):
            return ways[0]
        ways.append(self.beam())
        if self.rule.samples > 4 * self.r.shape[1]:
            ways.append(self.backward(list(range(self.r.shape[1]))))
        return min(ways)

    def forward(self) -> list[int]:
        """Return columns in the order of orthogonal forward regression.

        It ends when the fit is exact or `max_terms` are chosen.

        Each step takes the column that lessens the error most beside those chosen, and takes its
        direction out of all others, twice, so that nearly collinear columns keep their digits.
        """
        columns, target = self.r.copy(), self.y.copy()
        chosen: list[int] = []
        for _ in range(self.max_terms):
            square = np.square(columns).sum(axis=0)
            usable = square > _ALIKE**2
            usable[chosen] = False
            if not usable.any():
                break
            gain = np.where(
                usable, np.square(columns.T @ target) / np.where(usable, square, 1.0), -1.0
            )
            best = int(gain.argmax())
            chosen.append(best)
            q = columns[:, best] / np.sqrt(square[best])
            for _ in range(2):
                columns -= np.outer(q, q @ columns)
            target = target - q * (q @ target)
            # a model this good is trimmed better from a few terms more
            if float(target @ target) <= self.rule.precision**2 * self.rule.energy:
                break
        return chosen

    def beam(self) -> tuple[float, list[int]]:
        """Return the best criterion on several ways forward side by side, and its columns.

        Each size keeps the best sets of the size before with one column more. A single way takes a
        column that stands for two true ones and seldom finds back.
        """
        best: tuple[float, list[int]] = (float(self.rule.value(float(self.y @ self.y), 0)), [])
        sets, idle = np.zeros((1, 0), dtype=int), 0
        while sets.shape[1] < self.max_terms and idle < _PATIENCE:
            columns, target = _projected(self.r, self.y, sets)
            gains = _single_gains(columns, target, sets)
            left = np.square(target).sum(axis=1)[:, None] - gains
            left[gains < 0.0] = np.inf
            order = np.argsort(left, axis=None)[: 4 * _BEAM]
            order = order[np.isfinite(left.ravel()[order])]
            if not order.size:
                break
            rows, added = np.unravel_index(order, left.shape)
            grown = np.sort(np.concatenate((sets[rows], added[:, None]), axis=1), axis=1)
            _, first = np.unique(grown, axis=0, return_index=True)
            sets = grown[np.sort(first)[:_BEAM]]
            value = self.value(sets[0].tolist())
            idle = idle + 1
            if value < best[0]:
                best, idle = (value, sets[0].tolist()), 0
            if self.rule.exact(self.rss(sets[0].tolist())):
                break
        return best

    def backward(self, chosen: list[int]) -> tuple[float, list[int]]:
        """Return the best criterion on the way from the chosen columns to none, and its columns.

        The least useful one is dropped at a time (a tenth at a time while many).
        """
        chosen = list(chosen)
        best: tuple[float, list[int]] = (float(self.rule.value(float(self.y @ self.y), 0)), [])
        rss = self.rss(chosen)
        while chosen:
            value = float(self.rule.value(rss, len(chosen)))
            if value < best[0] and len(chosen) <= self.max_terms:
                best = (value, sorted(chosen))
            estimate, inverse = coefficients(self.r[:, chosen], self.y)
            cost = np.square(estimate) / np.square(inverse).sum(axis=1)
            drop = np.argsort(cost)[
                : max(len(chosen) // 10 if len(chosen) > self.max_terms else 1, 1)
            ]
            chosen = [c for i, c in enumerate(chosen) if i not in drop]
            rss = rss + float(cost[drop[0]]) if drop.size == 1 else self.rss(chosen)
        return best

    def refine(self, chosen: list[int], swaps: int) -> list[int]:
        """Return the columns after swaps, until none betters the criterion.

        Each swaps k chosen columns for k others, k - 1 or (k = 0) one more; every gain is trimmed
        backward.
        """
        value = self.value(chosen)
        again = True
        while again and chosen:
            again = False
            for out, into in ((1, 1), (0, 1), (2, 1), (2, 2), (3, 2)):
                # an exact fit can only become shorter
                if out > min(swaps, len(chosen)) or (
                    into >= out and self.rule.exact(self.rss(chosen))
                ):
                    continue
                found = self._swapped(chosen, out, into)
                if found is not None and found[0] < value - _GAIN:
                    value, chosen = min(found, self.backward(found[1]))
                    again = True
                    break
        return chosen

    def trimmed(self, chosen: list[int]) -> list[int]:
        """Return the columns without those, least useful first, for which there is no evidence.

        Among many candidates one target in some dozens has a column that fits its noise well enough
        for the criterion alone.
        """
        chosen, value = list(chosen), self.value(chosen)
        while chosen and not self.rule.exact(self.rss(chosen)):
            estimate, inverse = coefficients(self.r[:, chosen], self.y)
            least = int((np.square(estimate) / np.square(inverse).sum(axis=1)).argmin())
            fewer = chosen[:least] + chosen[least + 1 :]
            without = self.value(fewer)
            if without > value + _POSITIVE:
                break
            chosen, value = fewer, without
        return chosen

    def _swapped(self, chosen: list[int], out: int, into: int) -> tuple[float, list[int]] | None:
        """Return the best swap of `out` chosen columns for `into` others, judged exactly."""
        gone = list(combinations(chosen, out))
        kept = np.array([[c for c in chosen if c not in away] for away in gone], dtype=int).reshape(
            len(gone), len(chosen) - out
        )
        found: list[tuple[float, tuple[int, ...], tuple[int, ...]]] = []
        step = max(_BLOCK // (self.r.size + 1), 1)
        for first in range(0, len(kept), step):
            block = kept[first : first + step]
            columns, target = _projected(self.r, self.y, block)
            rss = np.square(target).sum(axis=1)
            gains_of_sets = _single_gains(columns, target, block)
            for m, gains in enumerate(gains_of_sets):
                best, added = (
                    _best_single(gains) if into == 1 else _best_pair(columns[m], target[m], gains)
                )
                found.append((float(rss[m]) - best, tuple(block[m]), added))
        found.sort()
        judged = [
            (self.value([*stay, *added]), sorted([*map(int, stay), *added]))
            for _, stay, added in found[:6]
            if added
        ]
        return min(judged) if judged else None


def swap_table(r: np.ndarray, y: np.ndarray, chosen: list[int]) -> np.ndarray:
    """Return sums of squares [p, J] with each chosen column replaced by each other one.

    They are infinite where it adds nothing.
    """
    if not chosen:
        return np.zeros((0, r.shape[1]))
    kept = np.array([[c for c in chosen if c != gone] for gone in chosen], dtype=int).reshape(
        len(chosen), -1
    )
    columns, target = _projected(r, y, kept)
    gains = _single_gains(columns, target, kept)
    return np.where(gains >= 0, np.square(target).sum(axis=1)[:, None] - gains, np.inf)


def _projected(r: np.ndarray, y: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all columns [M, R, J] and the target [M, R] beside each of M sets of columns."""
    if kept.shape[1] == 0:
        return np.repeat(r[None], len(kept), axis=0), np.repeat(y[None], len(kept), axis=0)
    q = np.linalg.qr(r.T[kept].transpose(0, 2, 1))[0]
    turned = q.transpose(0, 2, 1)
    target = y - (q @ (turned @ y)[..., None])[..., 0]
    return r - q @ (turned @ r), target - (q @ (turned @ target[..., None]))[..., 0]


def _single_gains(columns: np.ndarray, target: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return what each column [M, J] takes from the error; -1 where it adds nothing."""
    square = np.square(columns).sum(axis=1)
    usable = square > _ALIKE**2
    np.put_along_axis(usable, kept, False, axis=1)
    along = (target[:, None, :] @ columns)[:, 0]
    return np.where(usable, np.square(along) / np.where(usable, square, 1.0), -1.0)


def _best_single(gains: np.ndarray) -> tuple[float, tuple[int, ...]]:
    best = int(gains.argmax())
    return float(gains[best]), (best,) if gains[best] >= 0 else ()


def _best_pair(
    columns: np.ndarray, target: np.ndarray, gains: np.ndarray
) -> tuple[float, tuple[int, ...]]:
    """Return the pair of columns that takes most from the error, among the best single ones."""
    tried = np.argsort(gains)[::-1][:_PAIR_CANDIDATES]
    tried = tried[gains[tried] >= 0]
    if tried.size < 2:
        return -np.inf, ()
    unit = columns[:, tried] / np.linalg.norm(columns[:, tried], axis=0)
    along = target @ unit
    angle = unit.T @ unit
    room = 1.0 - np.square(angle)
    np.fill_diagonal(room, 0.0)
    usable = room > _PARALLEL
    both = (
        np.square(along)[:, None] + np.square(along)[None, :] - 2.0 * angle * np.outer(along, along)
    )
    gain = np.where(usable, both / np.where(usable, room, 1.0), -np.inf)
    i, j = np.unravel_index(int(gain.argmax()), gain.shape)
    return float(gain[i, j]), (int(tried[i]), int(tried[j])) if np.isfinite(gain[i, j]) else ()
