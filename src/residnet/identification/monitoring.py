"""The monitor: score tests on the innovations of short free runs, against those of clean logs.

Windows are free-run as a whole and in parts, each from its measured start. What the model has
always got wrong is taken out of their innovations, which are then whitened by their covariance over
clean logs. For each cause the score test asks whether a small change of that kind explains the last
minutes, once wind and current have taken what they can. How much clean logs differ in the sizes
that they ask for sets its scale. The scores of all causes together say how well each alone explains
them.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import HEADING, MOVING, Live
from residnet.data.prepare import Prepared
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec
from residnet.identification.changes import Change, ChangedDynamics, causes, shown, surroundings
from residnet.physics.symmetry import live_of


def seen_of(live: Live) -> dict[str, int]:
    """Return what innovations are taken of, and its columns in states."""
    seen = {name: live.states.index(name) for name in live.channels}
    return seen | ({"heading": HEADING} if live.turns else {})


_PAST = 5.0
"""Time in s before a window that warms a memory up."""
_BLOCKS = 5
"""Parts of a window whose means count."""


@dataclass(frozen=True)
class Piece:
    """A measured window of K steps.

    Attributes:
        y: states [K + 1, 3 + n].
        w: inputs held over each step [K, m].
        past_y: states before it that warm a memory up [P, 3 + n].
        past_w: inputs before it [P, m].
    """

    y: np.ndarray
    w: np.ndarray
    past_y: np.ndarray
    past_w: np.ndarray


def innovations(
    model: HybridDynamics, pieces: Sequence[Piece], changes: Sequence[Change]
) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations [B, k] and what a unit of each change adds to them [B, C, k].

    Args:
        model: float64, in evaluation mode.
        pieces: B windows of one length, with pasts of one length.
        changes: C of them.
    """
    y = torch.from_numpy(np.stack([piece.y for piece in pieces]))
    w = torch.from_numpy(np.stack([piece.w for piece in pieces]))
    none = Change("none", "", "", 1.0)
    all_changes = [none, *changes]
    rows, steps, count = len(pieces), w.shape[1], len(all_changes)
    blocks = min(_BLOCKS, steps)
    mean = torch.zeros(blocks, steps, dtype=torch.float64)
    edges = np.linspace(0, steps, blocks + 1).round().astype(int)
    for block, (first, last) in enumerate(pairwise(edges.tolist())):
        mean[block, first:last] = 1.0 / (last - first)
    with torch.no_grad():
        memory = model.warmup(
            torch.from_numpy(np.stack([piece.past_y for piece in pieces])),
            torch.from_numpy(np.stack([piece.past_w for piece in pieces])),
        )
        begin = (y[:, 1] - y[:, 0])[:, MOVING] / model.dt
        x0 = torch.cat(
            [y[:, 0] + shown(one.sensor, y[:, 0], begin, one.size) for one in all_changes]
        )
        changed = ChangedDynamics(model, all_changes, rows, w.shape[2])
        path, _, _ = compiled(Rollout(changed), steps)(
            x0, w.repeat(count, 1, 1), memory.repeat(count, 1)
        )
    path = path.reshape(count, rows, steps + 1, -1)
    # what a sensor shows is taken of the prediction: noise of the measurement is in the error too
    rate = mean @ path[0].diff(dim=1)[..., MOVING] / model.dt
    path = mean @ path[:, :, 1:]
    columns = [*seen_of(live_of(model.signals.names)).values()]
    error = _seen(mean @ y[:, 1:] - path[0], columns)
    effects = [
        _seen(
            path[number + 1] - path[0]
            if not change.sensor
            else shown(change.sensor, path[0], rate, change.size) - (path[number + 1] - path[0]),
            columns,
        )
        / change.size
        for number, change in enumerate(changes)
    ]
    if not effects:
        return error.numpy(), np.zeros((len(error), 0, error.shape[1]))
    return error.numpy(), torch.stack(effects, dim=1).numpy()


def parted(piece: Piece, parts: int) -> list[Piece]:
    """Return the equal parts of a window, each with what went before it; a rest is left out."""
    past, steps = len(piece.past_y), len(piece.w) // parts
    y = np.concatenate((piece.past_y, piece.y))
    w = np.concatenate((piece.past_w, piece.w))
    return [
        Piece(
            y[past + k : past + k + steps + 1],
            w[past + k : past + k + steps],
            y[k : past + k],
            w[k : past + k],
        )
        for k in range(0, parts * steps, steps)
    ]


def _seen(states: Tensor, columns: Sequence[int]) -> Tensor:
    """Return columns [c] of differences of states [B, k, 3 + n] as innovations [B, k c]."""
    return states[..., list(columns)].flatten(1)


def pieces(log: Prepared, steps: int, past: int) -> list[Piece]:
    """Return the windows of a log, back to back, whose samples can all be trusted.

    Args:
        log: prepared as those of the fit.
        past: samples before a window that warm a memory up; the first windows go without.
    """
    out, start = [], past
    while start + steps < len(log):
        rows = slice(start - past, start + steps + 1)
        trusted = log.usable[rows] & (log.piece[rows] == log.piece[start]) & (log.piece[start] >= 0)
        if not trusted.all():
            # the next window begins behind the last sample that is not to be trusted
            start = rows.start + int(np.flatnonzero(~trusted)[-1]) + 1 + past
            continue
        out.append(
            Piece(
                log.y[start : start + steps + 1],
                log.w[start : start + steps],
                log.y[start - past : start],
                log.w[start - past : start],
            )
        )
        start += steps
    return out


def past_of(model: HybridDynamics) -> int:
    """Return the samples before a window that warm a model's memory up; 0 where it has none."""
    return round(_PAST / model.dt) if model.n_state else 0


_SHRINK = 0.1
"""Share of the diagonal in the covariance of innovations."""
BELIEVED = 15.0
"""Standard deviation of what a model has always got wrong, in the causes' own small sizes."""


@dataclass(frozen=True)
class Sums:
    """Scores [Q] and information [Q, Q] of a number of windows, and squares of innovations [n]."""

    score: np.ndarray
    information: np.ndarray
    squares: np.ndarray
    count: int

    def __add__(self, other: Sums) -> Sums:
        parts = zip(vars(self).values(), vars(other).values(), strict=True)
        return Sums(*(one + another for one, another in parts))


def weighed(
    found: Sequence[tuple[np.ndarray, np.ndarray]], whiten: Sequence[np.ndarray], belief: np.ndarray
) -> Sums:
    """Return the sums over windows that were looked at as a whole, then in parts.

    A window that no change of a size thought possible explains tells of a manoeuvre that the model
    does not know. It counts by the inverse of what it leaves unexplained.

    Args:
        found: innovations [B, parts n] and effects [B, C, parts n] for each look.
        whiten: matrix [n, n] of each look.
        belief: precision of the sizes of the changes [C, C].
    """
    looks, number = [], 0
    for (error, effects), matrix in zip(found, whiten, strict=True):
        size, (windows, count, values) = len(matrix), effects.shape
        e = (error.reshape(windows, -1, size) @ matrix.T).reshape(windows, values)
        a = (effects.reshape(windows, count, -1, size) @ matrix.T).reshape(effects.shape)
        looks.append((np.einsum("bqn,bn->bq", a, e), a @ a.swapaxes(1, 2), e**2))
        number += values
    scores, informations, squares = zip(*looks, strict=True)
    score, information = np.sum(scores, axis=0), np.sum(informations, axis=0)
    own = np.linalg.solve(information + belief, score[..., None])[..., 0]
    left = np.sum([one.sum(axis=1) for one in squares], axis=0) - (score * own).sum(axis=1)
    weight = 1.0 / np.maximum(left / number, 1.0)
    return Sums(
        weight @ score,
        np.tensordot(weight, information, 1),
        squares[0].sum(axis=0),
        len(squares[0]),
    )


def apart_from(
    score: np.ndarray, information: np.ndarray, count: int, belief: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return scores [..., Q] and information [..., Q, Q] once others have taken what they can.

    Args:
        score: of Q changes, then of what surrounds the vessel [..., Q + n].
        information: about them [..., Q + n, Q + n].
        count: Q.
        belief: precision of the sizes of what surrounds the vessel [n, n].
    """
    known, beside = information[..., :count, :count], information[..., count:, :count]
    own = np.linalg.solve(information[..., count:, count:] + belief, beside)
    left = known - information[..., :count, count:] @ own
    taken = np.einsum("...np,...n->...p", own, score[..., count:])
    return score[..., :count] - taken, left + 1e-300 * np.eye(count)


def always_wrong(
    error: np.ndarray, effects: np.ndarray, causes: Sequence[Change], channels: int
) -> np.ndarray:
    """Return what a model has always got wrong: a size [Q, 4] of each cause for each channel.

    Channels may disagree: a model whose form is wrong has no single set of sizes that mends it.

    Args:
        error: innovations [B, n] of clean logs.
        effects: of a unit of each change [B, C, n], the causes first.
        causes: Q of them.
        channels: number of channels that innovations are taken of.
    """
    count = len(causes)
    # sensors are taken to be right: how they are wrong looks like the motion itself
    believed = np.array([0.0 if one.sensor else one.size * BELIEVED for one in causes])
    out = np.zeros((count, channels))
    for channel in range(channels):
        e = error[:, channel::channels].ravel()
        a = effects[:, :count, channel::channels].swapaxes(1, 2).reshape(len(e), count) * believed
        matrix = a.T @ a + np.mean(e**2) * np.eye(count)
        out[:, channel] = believed * np.linalg.solve(matrix, a.T @ e)
    return out


def whitening(error: np.ndarray, parts: int) -> np.ndarray:
    """Return the matrix [n, n] that makes innovations [B, parts n] of clean logs uncorrelated."""
    # windows that ran away were made nothing of
    error = error[(error != 0.0).any(axis=1)]
    error = error.reshape(len(error) * parts, -1)
    second = error.T @ error / len(error)
    covariance = (1.0 - _SHRINK) * second + _SHRINK * np.diag(np.diag(second))
    found: np.ndarray = np.linalg.inv(np.linalg.cholesky(covariance + 1e-18 * np.eye(len(second))))
    return found


_NOISE = np.geomspace(1.0, 30.0, 25)
"""Variances of the noise, in those of white innovations, that are tried."""
_APART = np.concatenate(([0.0], np.geomspace(1e-4, 1e3, 40)))
"""Variances of sizes, in what a group of middling information tells, that are tried."""
_LEFT_OPEN = 1.0
"""Twice the logarithm of the likelihood by which a larger scatter may fall short of the likeliest.

That is one standard error: clean logs have fitted the model too, and look better than others.
"""
_NOTHING = 1e-12
"""Keeps quotients of information defined where there is none."""
_AT_ODDS = 1.345
"""Standard deviations by which a log may differ from the others before it counts for less.

It is the usual constant: where errors are normal, 95 % of what they say is kept.
"""
_ROUNDS = 8
"""Of reweighting."""


@dataclass(frozen=True)
class Groups:
    """Scores of G groups of windows, what surrounds the vessel taken out.

    Attributes:
        log: number of the log that each is of [G].
        score: of each cause [G, Q]; [G, F, Q] where there are several readings of it.
        information: about them [G, Q, Q].
    """

    log: np.ndarray
    score: np.ndarray
    information: np.ndarray

    def __getitem__(self, chosen: np.ndarray | slice) -> Groups:
        return Groups(self.log[chosen], self.score[chosen], self.information[chosen])

    @property
    def own(self) -> np.ndarray:
        """Information about each cause alone [G, Q], never zero."""
        return np.diagonal(self.information, axis1=1, axis2=2) + _NOTHING

    def without(self, bias: np.ndarray) -> Groups:
        """Return the groups without what sizes [Q], such as clean logs ask for, say of them."""
        return replace(self, score=self.score - self.information @ bias)

    def by_log(self, values: np.ndarray) -> np.ndarray:
        """Return the sums of values [G, ...] over the groups of each log [K, ...]."""
        logs = dict.fromkeys(self.log.tolist())
        return np.stack([values[self.log == log].sum(axis=0) for log in logs])


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
        wider: how many times as far scores of clean stretches lie as all this says.
    """

    noise: np.ndarray
    apart: np.ndarray
    shared: np.ndarray
    known: np.ndarray
    correlation: np.ndarray
    count: int
    wider: float = 1.0

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

    def of(self, causes: Sequence[int]) -> Scatter:
        """Return what is known of some causes alone, by their numbers."""
        some = list(causes)
        of_each = {
            name: getattr(self, name)[some] for name in ("noise", "apart", "shared", "known")
        }
        return replace(self, correlation=self.correlation[np.ix_(some, some)], **of_each)

    def by_log(self, groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return scores [K, ..., Q] and information [K, Q, Q] of each log, weighed by the scatter.

        Groups of one log say in part the same: how many times over [K, Q] comes with them.
        """
        own = groups.own
        variance = self.variance(own)
        deviation = np.sqrt(variance)
        covariance = self.correlation * deviation[:, :, None] * deviation[:, None, :]
        gain = np.linalg.solve(covariance, groups.information).swapaxes(1, 2)
        told = groups.by_log(np.einsum("gqp,g...p->g...q", gain, groups.score))
        sure = groups.by_log(gain @ groups.information)
        count = groups.by_log(np.ones_like(own))
        alike = groups.by_log(self.shared * own**2 / variance) / count
        return told, sure, 1.0 + (count - 1.0) * alike

    def together(self, groups: Groups) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the size of each cause alone [Q], its error, and how much it explains.

        The scores of all causes tell better than each for itself which it is, and that there is
        one. What a cause explains is the square that it takes off all scores. All causes are
        compared on the same scores: neither how well logs agree on the size of one, nor how surely
        clean logs asked for none of it, says that another one is more likely.
        """
        told, sure, again = self.by_log(groups)
        told, weight = told / again, np.diagonal(sure, axis1=1, axis2=2) / again + _NOTHING
        size, agreed = _agreed(told, weight)
        inflation = self.inflation * self.wider**2
        explained = told.sum(axis=0) ** 2 / weight.sum(axis=0) / inflation
        return size, np.sqrt((1.0 / agreed + self.known) * inflation), explained


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


def scattered(groups: Groups) -> Scatter:
    """Return how the scores of groups of clean windows scatter about zero."""
    score, own = groups.score, groups.own
    count, size = score.shape
    noise, apart = np.array([_likeliest(*one) for one in zip(score.T, own.T, strict=True)]).T
    variance = noise * own + apart * own**2
    unit = score / np.sqrt(variance)
    second = unit.T @ unit / count
    root = np.sqrt(np.diag(second)) + _NOTHING
    # few groups say little about how scores scatter together
    kept = count / (count + size)
    correlation = kept * second / np.outer(root, root) + (1.0 - kept) * np.eye(size)
    np.fill_diagonal(correlation, 1.0)
    # what pairs of groups of one log have in common; where no log holds two, all is taken for it
    common, weight = (
        (groups.by_log(one) ** 2 - groups.by_log(one**2)).sum(axis=0)
        for one in (own * score / variance, own**2 / variance)
    )
    shared = np.clip(common / np.maximum(weight, 1e-300), 0.0, apart) if weight.any() else apart
    sure = groups.by_log(own**2 / (variance - shared * own**2))
    known = 1.0 / (_NOTHING + (sure / (1.0 + shared * sure)).sum(axis=0))
    return Scatter(noise, apart, shared, known, correlation, count)


def wider(groups: Groups, fold: np.ndarray, size: int) -> float:
    """Return how many times as far scores of clean stretches lie as other clean logs say.

    Wind, waves and what a model does not know differ from log to log and last for minutes, so what
    groups say of a whole stretch is put to the test on logs that were left out.

    Args:
        groups: of clean windows in the order of time.
        fold: number of each; those of a number are left out together [G].
        size: groups of a stretch.
    """
    found = []
    for k in np.unique(fold):
        own, scatter = np.flatnonzero(fold == k), scattered(groups[fold != k])
        for first in range(0, len(own), size):
            mean, error, _ = scatter.together(groups[own[first : first + size]])
            found.append(mean / error)
    return max(1.0, float(np.sqrt(np.mean(np.square(found)))))


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


_OVERLAP = 3.0
"""Independent looks that a sliding stretch gives while it slides by its own length."""
_FOLDS = 5
"""Parts of the clean windows whose scores are scaled by what the others say."""
_FEWEST = 5
"""Groups of clean windows below which nothing can be said about false alarms."""
_PARTS = 5
"""Parts that a window is also looked at in, each from its own measured start."""
_LEAST_PART = 10
"""Steps of a part below which windows are looked at as a whole only."""
_FAR, _TURN = 3.0, 2.0 * np.pi
"""Innovation beyond which a free run ran away: in largest clean velocities; turns of heading."""
_MOST_LOST = 0.5
"""Share of clean windows that may run away."""
_CURRENT, _PUSH = 0.5, 0.05
"""Standard deviations of a current in m/s and of a push in m/s^2 that are thought possible."""


class MonitorConfig(Config):
    """Settings of a monitor.

    Attributes:
        window: length of the free runs whose ends are compared, in s.
        stretch: time that is looked back over, in s.
        false_alarm: mean time between false alarms, in s.
        group: length of the stretches of clean logs whose scatter sets the scale, in s.
    """

    window: Seconds = Field(default=10.0, gt=0)
    stretch: Seconds = Field(default=300.0, gt=0)
    false_alarm: Seconds = Field(default=36_000.0, gt=0)
    group: Seconds = Field(default=60.0, gt=0)


@dataclass(frozen=True)
class Suspect:
    """A cause, how well it explains the last minutes, and how large it would be.

    Attributes:
        change: the cause.
        score: of its test by the scores of all causes, in standard deviations of clean logs.
        size: of the change, in its unit.
        error: standard error of the size.
        explains: square that it alone takes off the scores of all causes.
    """

    change: Change
    score: float
    size: float
    error: float
    explains: float


@dataclass(frozen=True)
class Verdict:
    """What a monitor says after a window.

    Attributes:
        alarm: whether the largest score exceeds the threshold; of a watcher also where it has not
            fallen clearly below it since it did.
        threshold: of the scores.
        suspects: causes, the one that explains most first.
        innovation: root mean square of the whitened innovations of each channel; 1 on clean logs.
    """

    alarm: bool
    threshold: float
    suspects: Sequence[Suspect]
    innovation: dict[str, float]

    @property
    def largest(self) -> float:
        """The largest score of any cause."""
        return max(suspect.score for suspect in self.suspects)


_Innovations = tuple[np.ndarray, np.ndarray]


class Watch:
    """What is known of clean logs, and the tests against it.

    Args:
        clean: windows of clean logs, those of one log together; all of one length.

    Raises:
        DataError: where the clean logs are too few.
    """

    def __init__(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        clean: Sequence[Sequence[Piece]],
        config: MonitorConfig,
    ) -> None:
        self.model = model.to(torch.float64).eval()
        self.config = config
        self.causes = causes(spec.signals)
        self.seen = seen_of(spec.signals.live)
        self.others = surroundings()
        outside = [_CURRENT**-2] * 2 + [_PUSH**-2] * 2
        self.belief = np.diag(outside)
        believed = [(BELIEVED * one.size) ** -2 for one in self.causes]
        self.possible = np.diag([*believed, *outside])
        self.steps, self.past = round(config.window / spec.dt), past_of(model)
        cut = [(k, part) for k, log in enumerate(clean) for part in self.groups(log)]
        if len(cut) < _FEWEST:
            raise DataError(
                f"the clean logs hold {len(cut)} stretches of {config.group:g} s; a monitor"
                f" needs at least {_FEWEST} to know how innovations scatter"
            )
        log = np.array([k for k, _ in cut])
        most = np.max([np.abs(p.y).max(axis=0) for _, part in cut for p in part], axis=0)
        most[HEADING] = _TURN
        self.limit = _FAR * most[[*self.seen.values()]]
        self.parts = [1, _PARTS] if self.steps >= _LEAST_PART * _PARTS else [1]
        found = [[self.innovations(part, parts) for parts in self.parts] for _, part in cut]
        lost = np.concatenate([(group[0][0] == 0.0).all(axis=1) for group in found])
        if lost.mean() > _MOST_LOST:
            raise DataError(
                f"model {spec.name}: free runs of {config.window:g} s run away in {lost.sum()} of"
                f" {len(lost)} clean windows; watch with another model, or with a shorter window"
            )
        always = self._wrong(found)
        self.whiten = [
            whitening(
                np.concatenate([own[i][0] - self.expected(own[i][1], always[i]) for own in found]),
                parts,
            )
            for i, parts in enumerate(self.parts)
        ]

        def learned(always: list[np.ndarray], kept: np.ndarray) -> tuple[np.ndarray, Groups]:
            """Return the sizes [Q] that groups ask for together, and all groups without these."""
            groups = self._groups(log, [self._sums(one, always) for one in found])
            # two causes that are wrong alike, such as damping and gain, must not look like one
            matrix = groups.information[kept].sum(axis=0) + np.diag(believed)
            bias = np.linalg.solve(matrix, groups.score[kept].sum(axis=0))
            return bias, groups.without(bias)

        self.usual = [(always, learned(always, log >= 0)[0])]
        # groups of one log are alike
        fold = (log if len(set(log)) >= _FOLDS else np.arange(len(found))) % _FOLDS
        held = []
        # scores scatter more where others say what is always wrong, as they do in service
        for k in range(_FOLDS):
            always = self._wrong([one for one, own in zip(found, fold, strict=True) if own != k])
            bias, groups = learned(always, fold != k)
            self.usual.append((always, bias))
            held.append(vars(groups[fold == k]).values())
        apart = Groups(*(np.concatenate(parts) for parts in zip(*held, strict=True)))
        size = max(round(config.stretch / config.group), 1)
        self.scatter = replace(scattered(apart), wider=wider(apart, np.sort(fold), size))
        looks = config.false_alarm / config.stretch * _OVERLAP * len(self.causes)
        self.threshold = float(scipy.stats.t.isf(0.5 / looks, len(found) - 1))

    def _wrong(self, found: Sequence[Sequence[_Innovations]]) -> list[np.ndarray]:
        """Return what the model has always got wrong, by innovations of groups of clean windows."""
        out = []
        for look in zip(*found, strict=True):
            error, effects = map(np.concatenate, zip(*look, strict=True))
            out.append(always_wrong(error, effects, self.causes, len(self.seen)))
        return out

    @classmethod
    def of(
        cls,
        spec: ModelSpec,
        model: HybridDynamics,
        clean: Sequence[Prepared],
        config: MonitorConfig,
    ) -> Watch:
        """Return the watch over a model by its clean logs, prepared as those of the fit."""
        steps, past = round(config.window / spec.dt), past_of(model)
        return cls(spec, model, [pieces(log, steps, past) for log in clean], config)

    def windows(self, log: Prepared) -> list[Piece]:
        """Return the windows of a new log.

        Raises:
            DataError: where it holds none.
        """
        found = pieces(log, self.steps, self.past)
        if not found:
            raise DataError(
                f"log {log.log.name}: holds no window of {self.config.window:g} s without a break;"
                " shorten the window or leave the log out"
            )
        return found

    @property
    def changes(self) -> list[Change]:
        """The causes, then what surrounds the vessel."""
        return [*self.causes, *self.others]

    def groups(self, log: Sequence[Piece]) -> list[Sequence[Piece]]:
        """Return the windows of a log in groups whose wind and current are taken to be constant."""
        each = max(round(self.config.group / self.config.window), 1)
        return [log[i : i + each] for i in range(0, len(log), each)]

    def over(self, model: HybridDynamics) -> Watch:
        """Return the same watch over another model, judged by what clean logs were of this one."""
        out = copy.copy(self)
        out.model = model
        return out

    def sums(self, pieces: Sequence[Piece]) -> list[Sums]:
        """Return the scores of each of several windows."""
        found = [self.innovations(pieces, parts) for parts in self.parts]
        return [
            self._sums(
                [(error[i : i + 1], effects[i : i + 1]) for error, effects in found],
                self.usual[0][0],
            )
            for i in range(len(pieces))
        ]

    def innovations(self, pieces: Sequence[Piece], parts: int) -> _Innovations:
        """Return innovations [B, parts n] and effects [B, C, parts n] of windows cut into parts."""
        cut = [part for piece in pieces for part in parted(piece, parts)]
        error, effects = innovations(self.model, cut, self.changes)
        count = len(pieces)
        by_change = effects.reshape(count, parts, len(self.changes), -1).swapaxes(1, 2)
        error, effects = error.reshape(count, -1), by_change.reshape(count, len(self.changes), -1)
        most = np.tile(self.limit, error.shape[1] // len(self.limit))
        size = np.array([change.size for change in self.changes])[:, None]
        # comparisons with what is no number are false
        sound = (np.abs(error) <= most).all(axis=1)
        lost = np.asarray(~(sound & (np.abs(effects * size) <= most).all(axis=(1, 2))))
        error[lost], effects[lost] = 0.0, 0.0
        return error, effects

    def expected(self, effects: np.ndarray, always: np.ndarray) -> np.ndarray:
        """Return what innovations [B, n] are of clean logs, by their effects [B, C, n].

        Args:
            always: what the model has always got wrong in this look [Q, 4].
        """
        share = np.tile(always, effects.shape[2] // len(self.seen))
        return np.asarray((effects[:, : len(self.causes)] * share).sum(axis=1))

    def _sums(self, found: Sequence[_Innovations], always: Sequence[np.ndarray]) -> Sums:
        """Return the sums of the same windows as a whole and in parts."""
        left = [
            (error - self.expected(effects, wrong), effects)
            for (error, effects), wrong in zip(found, always, strict=True)
        ]
        return weighed(left, self.whiten, self.possible)

    def _groups(self, logs: Sequence[int] | np.ndarray, sums: Sequence[Sums]) -> Groups:
        """Return scores and information of the causes once the surroundings have had their part."""
        score, information = (
            np.stack([getattr(one, name) for one in sums]) for name in ("score", "information")
        )
        return Groups(
            np.asarray(logs), *apart_from(score, information, len(self.causes), self.belief)
        )

    def judge(self, logs: Sequence[int], sums: Sequence[Sums]) -> Verdict:
        """Return the verdict on groups of windows; wind and current are their own in each.

        Args:
            logs: number of the log that each group is of.
        """
        groups = self._groups(logs, sums).without(self.usual[0][1])
        size, error, explains = self.scatter.together(groups)
        suspects = [
            Suspect(change, float(abs(a) / b), float(a), float(b), float(c))
            for change, a, b, c in zip(self.causes, size, error, explains, strict=True)
        ]
        alarm = max(suspect.score for suspect in suspects) > self.threshold
        suspects.sort(key=lambda suspect: -suspect.explains)
        count = sum(one.count for one in sums)
        squares = np.sum([one.squares for one in sums], axis=0) / count
        by_channel = squares.reshape(-1, len(self.seen)).mean(axis=0)
        innovation = dict(zip(self.seen, np.sqrt(by_channel).tolist(), strict=True))
        return Verdict(alarm, self.threshold, suspects, innovation)


_DEADBAND = 1.0
"""Standard deviations by which scores fall below the threshold before an alarm ends."""


class Watcher:
    """A watch that goes along with measurements, sample by sample.

    A score that wavers about the threshold is one alarm: it ends where all scores lie clearly below
    the threshold.

    Args:
        watch: what is known of clean logs.
    """

    def __init__(self, watch: Watch) -> None:
        self.watch, self.past, self.steps = watch, watch.past, watch.steps
        self.size = max(round(watch.config.group / watch.config.window), 1)
        self.windows = max(round(watch.config.stretch / watch.config.window), 1)
        self.recent: deque[tuple[int, Sums]] = deque()
        self.log = 0
        self.closed = True
        self.alarmed = False
        self.y: list[np.ndarray] = []
        self.w: list[np.ndarray] = []

    def step(self, y: np.ndarray, w: np.ndarray) -> Verdict | None:
        """Take one sample: measured state [3 + n], and the inputs [m] held over the step after it.

        Returns:
            The verdict where a window is complete, else None. A sample that is no measurement ends
            the window that it lies in.
        """
        if not (np.isfinite(y).all() and np.isfinite(w).all()):
            self.restart()
            return None
        self.y.append(np.asarray(y, dtype=float))
        self.w.append(np.asarray(w, dtype=float))
        if len(self.y) < self.past + self.steps + 1:
            return None
        known, given = np.stack(self.y), np.stack(self.w)
        piece = Piece(
            known[self.past :], given[self.past : -1], known[: self.past], given[: self.past]
        )
        # the next window begins where this one ends
        keep = self.past + 1
        self.y, self.w = self.y[-keep:], self.w[-keep:]
        return self.take(self.watch.sums([piece])[0])

    def restart(self) -> None:
        """Begin a new log, whose wind and current are its own."""
        self.y, self.w = [], []
        self.log += 1
        self.closed = True

    def take(self, sums: Sums) -> Verdict:
        """Take the scores of a window, and return the verdict on the last stretch."""
        if self.closed or self.recent[-1][1].count >= self.size:
            self.recent.append((self.log, sums))
        else:
            self.recent[-1] = (self.log, self.recent[-1][1] + sums)
        self.closed = False
        counts = [group.count for _, group in self.recent]
        while sum(counts) - counts[0] >= self.windows:
            self.recent.popleft()
            counts.pop(0)
        verdict = self.watch.judge([log for log, _ in self.recent], [one for _, one in self.recent])
        lasts = self.alarmed and verdict.largest > verdict.threshold - _DEADBAND
        self.alarmed = verdict.alarm or lasts
        return replace(verdict, alarm=self.alarmed)
