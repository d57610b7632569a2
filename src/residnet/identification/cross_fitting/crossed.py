"""Errors over all folds of the logs, which tell models apart that a few validation logs do not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from residnet.data.prepare import Prepared
from residnet.identification.models import FittedModel
from residnet.judge.config import EvaluationConfig
from residnet.judge.freerun import FreeRun
from residnet.judge.verdict.selection import Blocks, blocks_of, log_errors, shares

_MADE_GOOD = 0.5
"""Share of its baseline's error below which a model is no longer judged by that baseline."""


@dataclass(frozen=True)
class Crossed:
    """Errors of models over parts of the logs that each of them was fitted without.

    Attributes:
        blocks: of the training and validation logs together.
        shares: what each block contributes to the mean NRMSE, [B], by model.
        starts: log and first sample of each window, by which runs are known to be the same.
    """

    blocks: Blocks
    shares: dict[str, np.ndarray]
    starts: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, run: FreeRun, logs: Sequence[Prepared], config: EvaluationConfig) -> Crossed:
        """Return the errors of free runs over logs that were left out."""
        blocks, labels = blocks_of(run)
        scales, count = config.scales.named(), len(blocks.weights)
        found = {name: shares(run, name, logs, scales, labels, count) for name in run.predictions}
        return cls(blocks, found, tuple((window.log, window.start) for window in run.windows))

    def renamed(self, names: Mapping[str, str]) -> Crossed:
        """Return the errors of some models, by names of their own."""
        found = {new: self.shares[old] for old, new in names.items()}
        return Crossed(self.blocks, found, self.starts)

    def joined(self, other: Crossed | None) -> Crossed | None:
        """Return both together; None where they are not over the same windows."""
        if other is None or other.starts != self.starts:
            return None
        return Crossed(self.blocks, {**self.shares, **other.shares}, self.starts)


@dataclass(frozen=True)
class Judged:
    """How models err over folds of the logs and on the validation logs.

    Attributes:
        errors: mean NRMSE over the folds, by model.
        scores: what the blocks of folds [F] and of validation logs [B] contribute to the mean
            logarithm of the error, [F + B] by model. The latter add up to zero: they say how
            uncertain the ratio to another model is.
        direct: what the blocks of the validation logs alone contribute, [B] by model.
        blocks: of folds, with those of the validation logs behind them.
    """

    errors: dict[str, float]
    scores: dict[str, np.ndarray]
    direct: dict[str, np.ndarray]
    blocks: Blocks


def with_crossed(
    own: Mapping[str, np.ndarray],
    blocks: Blocks,
    crossed: Crossed,
    fitted: Mapping[str, FittedModel],
) -> Judged | None:
    """Return errors of all models over folds and validation logs; None where they lack.

    A baseline is judged over all folds, and so is one with an unknown force. What else stands on
    it is too expensive to be fitted for each fold: it is judged by its baseline's error over the
    folds, times the ratio of its error to the baseline's on the validation logs. That ratio spreads
    less than either of the two errors, as both run over the same windows (a ratio estimator, as in
    sampling from surveys: W. G. Cochran, 1977, chapter 6). A difference would not do: folds of
    other manoeuvres may be easier than the validation logs.

    A network that takes more than half of the error off its baseline has little left of it: how
    well the network does elsewhere does not follow from how badly the baseline does there. In the
    baseline's place stands the model whose error on the validation logs is nearest to its own.

    Args:
        own: shares over the validation logs, [B] by model.
        blocks: of the validation logs.
        crossed: errors over the folds, `zero` and all baselines among them.
        fitted: the models.
    """
    known = [name for name in crossed.shares if name in own]
    here = log_errors(own, blocks.weights)
    there = log_errors({name: crossed.shares[name] for name in known}, crossed.blocks.weights)
    out = Judged({}, {}, here, crossed.blocks.beside(blocks))
    for name, entry in fitted.items():
        others = [
            _root(fitted[member], fitted, crossed) for member in entry.notes.get("members", (name,))
        ]
        if any(other not in known for other in others):
            return None
        if own[name].sum() < _MADE_GOOD * np.mean([own[other].sum() for other in others]):
            others = [_nearest(name, known, own)]
        over_folds = float(np.mean([crossed.shares[other].sum() for other in others]))
        beside = float(np.mean([own[other].sum() for other in others]))
        ratio = float(own[name].sum()) / beside if beside > 0.0 else 1.0
        out.errors[name] = ratio * over_folds
        rest = here[name] - np.mean([here[other] for other in others], axis=0)
        out.scores[name] = np.concatenate(
            (
                np.mean([there[other] for other in others], axis=0)
                + crossed.blocks.weights * rest.sum(),
                rest - blocks.weights * rest.sum(),
            )
        )
    return out


def _nearest(name: str, known: Sequence[str], own: Mapping[str, np.ndarray]) -> str:
    """Return which of the known models errs most nearly as much as another one, in proportion."""

    def apart(other: str) -> float:
        least = np.finfo(float).tiny
        pair = (max(float(own[one].sum()), least) for one in (name, other))
        return abs(float(np.diff(np.log(list(pair)))[0]))

    return min(known, key=apart)


def _root(entry: FittedModel, fitted: Mapping[str, FittedModel], crossed: Crossed) -> str:
    """Return the name of the model over folds that a model is or stands on."""
    below = entry.notes.get("of") or entry.notes.get("baseline")
    if entry.name in crossed.shares or below is None or below == entry.name:
        return entry.name
    return _root(fitted[below], fitted, crossed)
