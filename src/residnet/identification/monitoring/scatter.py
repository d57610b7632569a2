"""How scores of clean logs scatter, and what groups of windows say of each cause by that measure.

A group of windows has a score a and an information I for each cause; a / I is the size that it asks
for. Noise gives a the variance s I. No model is right everywhere, so each clean log also asks for a
size of its own, which adds t I^2, part of it shared by the groups of one log (a model of random
effects: R. DerSimonian and N. Laird, 1986). Without t a log with much information, such as a hard
turn, would raise alarms for what the model has always got wrong in hard turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_NOISE = np.geomspace(1.0, 30.0, 25)
"""Variances of the noise, in those of white innovations, that are tried."""
_APART = np.concatenate(([0.0], np.geomspace(1e-4, 1e3, 40)))
"""Variances of sizes, in what a group of middling information tells, that are tried."""
_LEFT_OPEN = 1.0
"""Twice the logarithm of the likelihood by which a larger scatter may fall short of the likeliest.

That is one standard error: clean logs have fitted the model too, and look better than others.
"""
_NOTHING = 1e-12
_AT_ODDS = 1.345
"""Standard deviations by which a log may differ from the others before it counts for less.

It is the usual constant: where errors are normal, 95 % of what they say is kept.
"""
_ROUNDS = 8
"""Of reweighting."""


@dataclass(frozen=True)
class Group:
    """Scores of a group of windows, what surrounds the vessel taken out.

    Attributes:
        log: number of the log that they are of.
        score: of each cause [Q].
        information: about them [Q, Q].
    """

    log: int
    score: np.ndarray
    information: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """Information about each cause alone [Q], never zero."""
        return np.diag(self.information) + _NOTHING


@dataclass(frozen=True)
class Scatter:
    """What clean groups say about the scatter of scores.

    Attributes:
        noise: variance of each score in units of its information [Q].
        apart: variance of the sizes that groups ask for [Q].
        shared: part of it that is common to the groups of one log [Q].
        known: variance of the mean size of all clean logs [Q].
        correlation: of the scores of different causes [Q, Q].
        count: of the groups that told all this.
    """

    noise: np.ndarray
    apart: np.ndarray
    shared: np.ndarray
    known: np.ndarray
    correlation: np.ndarray
    count: int = 10**9

    def variance(self, own: np.ndarray) -> np.ndarray:
        """Return the variance of scores [..., Q] whose information is `own` [..., Q]."""
        return np.asarray(self.noise * own + self.apart * own**2)

    @property
    def inflation(self) -> float:
        """How much larger variances are than they seem, their matrix being an estimate itself.

        Weights from few groups are not the best ones, and flatter what they weigh (R. N. Kackar and
        D. A. Harville, 1984, for the effect; the factors are those of Wishart matrices).
        """
        size = len(self.noise)
        left = max(self.count - size - 1, 1)
        return max((self.count - 1) / left, 1.0) * self.count / (left + 1)

    def together(self, groups: Sequence[Group]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the size of each cause alone [Q], its error, and how much it explains.

        The scores of all causes tell better than each for itself which it is, and that there is
        one. What a cause explains is the square that it takes off all scores. All causes are
        compared on the same scores: neither how well logs agree on the size of one, nor how surely
        clean logs asked for none of it, says that another one is more likely.
        """
        told, weight = [], []
        for log in dict.fromkeys(group.log for group in groups):
            part, sure = 0.0, 0.0
            alike: list[np.ndarray] = []
            for group in groups:
                if group.log == log:
                    variance = self.variance(group.own)
                    deviation = np.sqrt(variance)
                    covariance = self.correlation * np.outer(deviation, deviation)
                    weighed = np.linalg.solve(covariance, group.information)
                    part = part + weighed.T @ group.score
                    sure = sure + np.einsum("pq,pq->q", group.information, weighed)
                    alike.append(self.shared * group.own**2 / variance)
            # groups of one log say in part the same
            again = 1.0 + (len(alike) - 1) * np.mean(alike, axis=0)
            told.append(part / again)
            weight.append(sure / again + _NOTHING)
        size, agreed = _agreed(np.stack(told), np.stack(weight))
        explained = np.sum(told, axis=0) ** 2 / np.sum(weight, axis=0) / self.inflation
        return size, np.sqrt((1.0 / agreed + self.known) * self.inflation), explained


def _agreed(told: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the size [Q] on which logs agree, and the weight behind it (P. J. Huber, 1964).

    A vessel that has changed shows it in all logs. One that is at odds with the others, as a rare
    manoeuvre may be, counts by how far it is and not by the square of that.

    Args:
        told: sizes times weights of the logs [K, Q].
        weight: inverse variances of the sizes [K, Q].
    """
    each, root = told / weight, np.sqrt(weight)
    trusted = np.ones_like(weight)
    size = told.sum(axis=0) / weight.sum(axis=0)
    for _ in range(_ROUNDS):
        apart = np.abs(each - size) * root
        trusted = np.minimum(1.0, _AT_ODDS / np.maximum(apart, 1e-9))
        size = (trusted * told).sum(axis=0) / (trusted * weight).sum(axis=0)
    return size, (trusted * weight).sum(axis=0)


def scattered(groups: Sequence[Group]) -> Scatter:
    """Return how the scores of groups of clean windows scatter about zero."""
    score = np.stack([group.score for group in groups])
    own = np.stack([group.own for group in groups])
    count, size = score.shape
    noise, apart = np.empty(size), np.empty(size)
    for cause in range(size):
        noise[cause], apart[cause] = _likeliest(score[:, cause], own[:, cause])
    alone = Scatter(noise, apart, 0.0 * apart, 0.0 * apart, np.eye(size))
    deviation = np.sqrt(alone.variance(own))
    unit = score / deviation
    second = unit.T @ unit / count
    root = np.sqrt(np.diag(second)) + _NOTHING
    # few groups say little about how scores scatter together
    kept = count / (count + size)
    correlation = kept * second / np.outer(root, root) + (1.0 - kept) * np.eye(size)
    np.fill_diagonal(correlation, 1.0)
    shared = _shared(groups, alone)
    whole = Scatter(noise, apart, shared, 0.0 * apart, correlation)
    return Scatter(noise, apart, shared, 1.0 / _told(groups, whole)[1], correlation, count)


def _told(groups: Sequence[Group], scatter: Scatter) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighed sum of sizes [Q] and the sum of weights, the inverse variance."""
    told, weight = np.zeros(len(scatter.noise)), np.full(len(scatter.noise), _NOTHING)
    for log in dict.fromkeys(group.log for group in groups):
        part, sure = 0.0, 0.0
        for group in groups:
            if group.log == log:
                alone = scatter.variance(group.own) - scatter.shared * group.own**2
                part = part + group.own * group.score / alone
                sure = sure + group.own**2 / alone
        told += part / (1.0 + scatter.shared * sure)
        weight += sure / (1.0 + scatter.shared * sure)
    return told, weight


def _likeliest(score: np.ndarray, own: np.ndarray) -> tuple[float, float]:
    """Return the variances of noise and sizes that scores [G] ask for, one standard error above."""
    apart = _APART / np.median(own)
    variance = (
        _NOISE[:, None, None] * own[None, None, :] + apart[None, :, None] * own[None, None, :] ** 2
    )
    scatter = np.log(variance).sum(axis=2)
    unlikely = scatter + (score**2 / variance).sum(axis=2)
    # few logs leave open how much others scatter
    possible = unlikely <= unlikely.min() + _LEFT_OPEN
    i, j = np.unravel_index(int(np.where(possible, scatter, -np.inf).argmax()), unlikely.shape)
    return float(_NOISE[i]), float(apart[j])


def _shared(groups: Sequence[Group], scatter: Scatter) -> np.ndarray:
    """Return the variance of sizes [Q] that the groups of one log share.

    Where no clean log holds two groups nothing tells, and all is taken to be shared.
    """
    told, weight = np.zeros(len(scatter.noise)), np.zeros(len(scatter.noise))
    for i, one in enumerate(groups):
        for other in groups[:i]:
            if other.log == one.log:
                variance = scatter.variance(one.own) * scatter.variance(other.own)
                product = one.own * other.own
                told += product * one.score * other.score / variance
                weight += product**2 / variance
    if not weight.any():
        return scatter.apart
    return np.clip(told / np.maximum(weight, 1e-300), 0.0, scatter.apart)
