"""Recursive refit: after an alarm, the sizes of a few changes are estimated log by log.

A change that the monitor names moves all parameters of the baseline together, along one direction:
more mass scales every acceleration, a weaker propeller all of its terms. The directions are found
by least squares from what each change does to the accelerations of the new logs. Their sizes are
then estimated by an extended information filter, which takes one log after the other, free-runs its
windows with the model as it is by then, and adds what they say to what was known.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
import torch
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import UsageError
from residnet.core.layout import MOVING
from residnet.dynamics.hybrid import HybridDynamics
from residnet.identification.changes import Change, ChangedDynamics
from residnet.identification.fitter import FittedModel
from residnet.identification.monitoring import (
    BELIEVED,
    Groups,
    Piece,
    Verdict,
    Watch,
    apart_from,
    innovations,
    parted,
    weighed,
)
from residnet.training.refit import parametric

_MOST = 3
"""Changes that a refit puts into a model at most."""
_RIDGE = 1e-6
"""Of the least squares that find a direction, as a share of each parameter's information."""
_EXPRESSED = 0.7
"""Share of a change's accelerations that the parameters must be able to follow."""
_BRIEF = 1e-4
"""Share of a step over which the accelerations of a change are found."""
_SAMPLES = 4_000
"""Samples that a direction is found from, at most."""


@dataclass(frozen=True)
class Moved:
    """A change that a refit has put into a model.

    Attributes:
        change: the cause that the monitor named.
        size: of the change, in its unit.
        error: standard error of the size.
        after: size after each log, in their order.
    """

    change: Change
    size: float
    error: float
    after: Sequence[float]


@dataclass(frozen=True)
class Refit:
    """What a recursive refit found.

    Attributes:
        model: with the changes put into its baseline; as it was where there are none.
        moved: the changes, in the order in which the monitor named them.
        before: verdict on the logs with the old model.
        verdict: with the new one.
        ended: why no further change was taken, in words.
    """

    model: HybridDynamics
    moved: Sequence[Moved]
    before: Verdict
    verdict: Verdict
    ended: str


def recursive_refit(watch: Watch, logs: Sequence[Sequence[Piece]]) -> Refit:
    """Put the changes that a monitor names into a copy of its model, until it names none.

    Args:
        watch: over the model, which stays as it is.
        logs: windows of the new logs, in the order of time.

    Raises:
        UsageError: where the model's baseline has no parameters that could move.
    """
    baseline = watch.model.baseline
    if not isinstance(baseline, ParametricBaseline):
        raise UsageError(
            f"a recursive refit moves the parameters of one baseline; the model's is of class"
            f" {type(baseline).__name__}, which has none; choose another one with --model"
        )
    groups = [(k, part) for k, log in enumerate(logs) for part in watch.groups(log)]
    before = verdict = _judged(watch, groups)
    model, moved = watch.model, list[Moved]()
    while True:
        first = verdict.suspects[0].change
        ended = _ended(verdict, [one.change for one in moved])
        if not ended:
            _, share = _direction(watch.model, first, groups)
            if share < _EXPRESSED:
                ended = (
                    f"the baseline's terms can follow only {share:.0%} of what '{first.name}' does"
                )
        if ended:
            return Refit(model, moved, before, verdict, ended)
        changes = [*(one.change for one in moved), first]
        filtered = _Filter(watch, changes)
        moved = filtered.through(groups)
        model = filtered.model
        verdict = _judged(watch.over(model), groups)


def refitted(fitted: FittedModel, found: Refit) -> FittedModel:
    """Return the refitted model under a name of its own, with notes on what was put into it.

    Bands that were calibrated for the old model are left out.
    """
    baseline = parametric(found.model)
    known = dict(zip(baseline.free_names(), baseline.free().tolist(), strict=True))
    notes = dict(fitted.notes)
    notes["coefficients"] = [
        {**row, "value": known[row["axis"], row["term"]]}
        for row in fitted.notes.get("coefficients", ())
        if (row["axis"], row["term"]) in known
    ]
    notes["refit_of"] = fitted.name
    notes["refit_changes"] = [
        {"cause": one.change.name, "size": one.size, "standard_error": one.error}
        for one in found.moved
    ]
    spec = fitted.spec.model_copy(update={"name": f"{fitted.name}_refit", "band": None})
    return FittedModel(spec, copy.deepcopy(found.model), notes)


def _judged(watch: Watch, groups: Sequence[tuple[int, Sequence[Piece]]]) -> Verdict:
    sums = [reduce(add, watch.sums(part)) for _, part in groups]
    return watch.judge([log for log, _ in groups], sums)


def _ended(verdict: Verdict, taken: Sequence[Change]) -> str:
    """Return why no further change is taken, empty where one is."""
    first = verdict.suspects[0]
    if not verdict.alarm:
        return (
            f"no cause exceeds the threshold (largest score {verdict.largest:.1f} of"
            f" {verdict.threshold:.1f})"
        )
    if first.change.sensor:
        return (
            f"'{first.change.name}' is named first, which is an error of the data; mend the sensor,"
            " since a refit would put its error into the vessel"
        )
    if first.change in taken:
        return f"'{first.change.name}' is named again, so that its size does not explain the logs"
    if len(taken) >= _MOST:
        return f"{_MOST} changes are in the model; fit it anew from the new logs"
    return ""


def _direction(
    model: HybridDynamics, change: Change, groups: Sequence[tuple[int, Sequence[Piece]]]
) -> tuple[Tensor, float]:
    """Return what a unit of a change adds to the free parameters [P].

    The share of its accelerations that they can follow comes with it.
    """
    pieces = [piece for _, part in groups for piece in part]
    x = torch.from_numpy(np.concatenate([piece.y[:-1] for piece in pieces]))
    w = torch.from_numpy(np.concatenate([piece.w for piece in pieces]))
    every = max(len(x) // _SAMPLES, 1)
    x, w = x[::every], w[::every]
    memory = x.new_zeros(len(x), model.n_state)
    # over a whole step the vessel answers to the change already, which would hide a part of it
    brief = copy.deepcopy(model)
    brief.dt = _BRIEF * model.dt
    with torch.no_grad():
        changed = ChangedDynamics(brief, [change], len(x), w.shape[1])
        gained = changed.step(x, w, memory)[0] - brief.step(x, w, memory)[0]
        wanted = gained[:, MOVING].flatten() / (brief.dt * change.size)
        slopes = parametric(model).sensitivity(model.channels(x, w)).flatten(0, 1)
        # axes count alike, though an acceleration in yaw is no acceleration in surge
        weight = gained[:, MOVING].square().mean(0)
        weight = (weight + 1e-4 * weight.max()).rsqrt().repeat(len(x))
        slopes, wanted = slopes * weight[:, None], wanted * weight
        gram = slopes.T @ slopes
        ridge = torch.diag(_RIDGE * gram.diagonal() + 1e-300)
        found = torch.linalg.solve(gram + ridge, slopes.T @ wanted)
        left = (wanted - slopes @ found).square().sum() / wanted.square().sum()
    return found, 1.0 - float(left)


class _Filter:
    """An extended information filter for the sizes of changes.

    Args:
        changes: Q of them, causes of the watch.
    """

    def __init__(self, watch: Watch, changes: Sequence[Change]) -> None:
        self.watch, self.changes = watch, changes
        self.model = copy.deepcopy(watch.model)
        self.baseline = parametric(self.model)
        self.start = self.baseline.free()
        self.steps = np.array([change.size for change in changes])
        names = [change.name for change in watch.causes]
        self.places = [names.index(change.name) for change in changes]
        self.size = np.zeros(len(changes))
        self.directions = torch.zeros(len(self.start), len(changes), dtype=self.start.dtype)

    def through(self, groups: Sequence[tuple[int, Sequence[Piece]]]) -> list[Moved]:
        """Take the logs one after the other, twice, and return what has become of the sizes.

        The second time the logs are free-run with the sizes that the first time ended with, and
        the directions are those of changes so large.
        """
        for again in (False, True):
            sizes = np.where(np.abs(self.size) > self.steps, self.size, self.steps)
            self.directions = torch.stack(
                [
                    _direction(self.watch.model, replace(change, size=float(size)), groups)[0]
                    for change, size in zip(self.changes, sizes, strict=True)
                ],
                dim=1,
            )
            after, covariance, folds = self._pass(groups, fixed=again)
        scatter = self.watch.scatter
        variance = np.diag(covariance) + scatter.known[self.places]
        # what the model has always got wrong is an estimate too (the jackknife over clean logs)
        apart = (len(folds) - 1) * folds.var(axis=0)
        error = np.sqrt(variance * scatter.inflation + apart)
        return [
            Moved(change, float(self.size[q]), float(error[q]), [float(one[q]) for one in after])
            for q, change in enumerate(self.changes)
        ]

    def _pass(
        self, groups: Sequence[tuple[int, Sequence[Piece]]], *, fixed: bool
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Take the logs one after the other: sizes after each, their covariance, sizes by fold.

        Free runs have the sizes known by then, or, where these are `fixed`, those of the start.
        """
        precision = np.diag((BELIEVED * self.steps) ** -2.0)
        told, size = np.zeros((len(self.watch.usual), len(self.size))), self.size
        after: list[np.ndarray] = []
        for log in dict.fromkeys(number for number, _ in groups):
            self._place(self.size)
            scores, sure = self._log([part for number, part in groups if number == log])
            precision = precision + sure
            told = told + scores + sure @ self.size
            size = np.linalg.solve(precision, told[0])
            after.append(size)
            if not fixed:
                self.size = size
        self.size = size
        self._place(size)
        covariance = np.linalg.inv(precision)
        return after, covariance, told[1:] @ covariance

    def _log(self, parts: Sequence[Sequence[Piece]]) -> tuple[np.ndarray, np.ndarray]:
        """Return scores [1 + F, Q] and information of a log, weighed by how clean logs scatter."""
        score, information = (np.stack(one) for one in zip(*map(self._told, parts), strict=True))
        groups = Groups(np.zeros(len(parts)), score, information)
        told, sure, again = self.watch.scatter.of(self.places).by_log(groups)
        return told[0] / again.mean(), sure[0] / again.mean()

    def _place(self, size: np.ndarray) -> None:
        """Give the model its parameters for changes of some sizes."""
        self.baseline.place(self.start + self.directions @ torch.from_numpy(size))

    def _told(self, part: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray]:
        """Return scores and information about further changes of the sizes, from a few windows.

        Scores [1 + F, Q] are by what all clean logs say is always wrong, then without each fold.
        """
        watch = self.watch
        looks: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in watch.usual]
        for i, parts in enumerate(watch.parts):
            _, known = watch.innovations(part, parts)
            # windows in which a free run ran away have no effects, and tell nothing
            sound = (known != 0.0).any(axis=(1, 2))
            cut = [one for piece in part for one in parted(piece, parts)]
            error, beside = innovations(self.model, cut, watch.others)
            effects = []
            for q, step in enumerate(self.steps):
                self._place(self.size + np.where(np.arange(len(self.size)) == q, step, 0.0))
                effects.append((error - innovations(self.model, cut, [])[0]) / step)
            self._place(self.size)
            every = np.concatenate((np.stack(effects, axis=1), beside), axis=1)
            count, changes = len(part), every.shape[1]
            every = every.reshape(count, parts, changes, -1).swapaxes(1, 2)
            every = every.reshape(count, changes, -1) * sound[:, None, None]
            for look, (always, bias) in zip(looks, watch.usual, strict=True):
                # what clean logs ask for too is no change
                wrong = watch.expected(known, always[i])
                wrong = wrong + np.einsum("q,bqn->bn", bias, known[:, : len(watch.causes)])
                look.append(((error.reshape(count, -1) - wrong) * sound[:, None], every))
        own = [*self.places, *range(len(watch.causes), len(watch.changes))]
        possible = watch.possible[np.ix_(own, own)]
        told = [weighed(look, watch.whiten, possible) for look in looks]
        score, information = apart_from(
            np.stack([one.score for one in told]),
            np.stack([one.information for one in told]),
            len(self.size),
            watch.belief,
        )
        return score, information[0]
