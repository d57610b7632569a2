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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import Field
from scipy.stats import t as student

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import VELOCITIES
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.identification.monitoring.changes import Change, causes, surroundings
from residnet.identification.monitoring.innovations import (
    BELIEVED,
    Sums,
    always_wrong,
    apart_from,
    run_away,
    weighed,
    whitening,
)
from residnet.identification.monitoring.scatter import Group, scattered
from residnet.identification.monitoring.windows import SEEN, Piece, innovations, parted

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
        spec: of the model.
        model: that is watched.
        clean: windows of clean logs, those of one log together; all of one length.
        config: settings.

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
        self.dt = spec.dt
        self.causes = causes(spec.signals)
        self.others = surroundings()
        outside = [_CURRENT**-2] * 2 + [_PUSH**-2] * 2
        self.belief = np.diag(outside)
        self.possible = np.diag([*((BELIEVED * one.size) ** -2 for one in self.causes), *outside])
        cut = [(k, part) for k, log in enumerate(clean) for part in self.groups(log)]
        groups, of = [group for _, group in cut], np.array([log for log, _ in cut])
        if len(groups) < _FEWEST:
            raise DataError(
                f"the clean logs hold {len(groups)} stretches of {config.group:g} s; a monitor"
                f" needs at least {_FEWEST} to know how innovations scatter"
            )
        fastest = np.max(
            [np.abs(p.y[:, VELOCITIES]).max(axis=0) for log in clean for p in log], axis=0
        )
        self.limit = _FAR * np.append(fastest, _TURN)
        self.parts = [1, _PARTS] if round(config.window / spec.dt) >= _LEAST_PART * _PARTS else [1]
        found = [[self.innovations(group, parts) for parts in self.parts] for group in groups]
        lost = np.concatenate([(group[0][0] == 0.0).all(axis=1) for group in found])
        if lost.mean() > _MOST_LOST:
            raise DataError(
                f"model {spec.name}: free runs of {config.window:g} s run away in {lost.sum()} of"
                f" {len(lost)} clean windows; watch with another model, or with a shorter window"
            )
        self.always = self._wrong(found)
        self.whiten = [
            whitening(
                np.concatenate([group[i][0] - self.expected(group[i][1], i) for group in found]),
                parts,
            )
            for i, parts in enumerate(self.parts)
        ]
        known = self.always
        # groups of one log are alike
        fold = (of if len(set(of)) >= _FOLDS else np.arange(len(found))) % _FOLDS
        self.bias = self._bias([self._sums(group) for group in found])
        apart: list[Group] = []
        self.by_fold: list[tuple[list[np.ndarray], np.ndarray]] = []
        # scores scatter more where others say what is always wrong, as they do in service
        for k in range(_FOLDS):
            self.always = self._wrong(
                [one for one, own in zip(found, fold, strict=True) if own != k]
            )
            others = [self._sums(one) for one in found]
            bias = self._bias([one for one, own in zip(others, fold, strict=True) if own != k])
            self.by_fold.append((self.always, bias))
            for i in np.flatnonzero(fold == k):
                apart.append(self._group(int(of[i]), others[i], bias))
        self.always = known
        self.scatter = scattered(apart)
        looks = config.false_alarm / config.stretch * _OVERLAP * len(self.causes)
        self.threshold = float(student.isf(0.5 / looks, len(apart) - 1))

    def _wrong(self, found: Sequence[Sequence[_Innovations]]) -> list[np.ndarray]:
        """Return what the model has always got wrong, by innovations of groups of clean windows."""
        return [
            always_wrong(
                np.concatenate([group[i][0] for group in found]),
                np.concatenate([group[i][1] for group in found]),
                self.causes,
            )
            for i in range(len(self.parts))
        ]

    def _bias(self, groups: Sequence[Sums]) -> np.ndarray:
        """Return the sizes [Q] of all causes together that clean logs ask for."""
        parts = [self._alone(group) for group in groups]
        matrix = np.sum([part[1] for part in parts], axis=0)
        believed = np.diag([change.size**-2 / BELIEVED**2 for change in self.causes])
        # two causes that are wrong alike, such as damping and gain, must not look like one of them
        score = np.sum([part[0] for part in parts], axis=0)
        return np.asarray(np.linalg.solve(matrix + believed, score))

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
            self._sums([(error[i : i + 1], effects[i : i + 1]) for error, effects in found])
            for i in range(len(pieces))
        ]

    def innovations(self, pieces: Sequence[Piece], parts: int) -> _Innovations:
        """Return innovations [B, parts n] and effects [B, C, parts n] of windows cut into parts."""
        cut = [part for piece in pieces for part in parted(piece, parts)]
        error, effects = innovations(self.model, cut, self.changes)
        count = len(pieces)
        by_change = effects.reshape(count, parts, len(self.changes), -1).swapaxes(1, 2)
        error, effects = error.reshape(count, -1), by_change.reshape(count, len(self.changes), -1)
        lost = run_away(error, effects, self.changes, self.limit)
        error[lost], effects[lost] = 0.0, 0.0
        return error, effects

    def expected(self, effects: np.ndarray, i: int, always: np.ndarray | None = None) -> np.ndarray:
        """Return what innovations [B, n] are of clean logs, by their effects [B, C, n].

        Args:
            effects: of a unit of each change.
            i: number of the look: whole windows, or their parts.
            always: what the model has always got wrong [Q, 4]; by all clean logs where None.
        """
        wrong = self.always[i] if always is None else always
        share = np.tile(wrong, effects.shape[2] // len(SEEN))
        return np.asarray((effects[:, : len(self.causes)] * share).sum(axis=1))

    def _sums(self, found: Sequence[_Innovations]) -> Sums:
        """Return the sums of the same windows as a whole and in parts."""
        left = [
            (error - self.expected(effects, i), effects) for i, (error, effects) in enumerate(found)
        ]
        return weighed(left, self.whiten, self.possible)

    def _alone(self, sums: Sums) -> tuple[np.ndarray, np.ndarray]:
        """Return scores and information of the causes once the surroundings have had their part."""
        return apart_from(sums, len(self.causes), self.belief)

    def _group(self, log: int, sums: Sums, bias: np.ndarray) -> Group:
        """Return scores and information of a group, what clean logs always ask for taken out."""
        score, information = self._alone(sums)
        return Group(log, score - information @ bias, information)

    def judge(self, logs: Sequence[int], sums: Sequence[Sums]) -> Verdict:
        """Return the verdict on groups of windows; wind and current are their own in each.

        Args:
            logs: number of the log that each group is of.
            sums: of the groups.
        """
        groups = [self._group(log, one, self.bias) for log, one in zip(logs, sums, strict=True)]
        size, error, explains = self.scatter.together(groups)
        suspects = [
            Suspect(change, float(abs(a) / b), float(a), float(b), float(c))
            for change, a, b, c in zip(self.causes, size, error, explains, strict=True)
        ]
        alarm = max(suspect.score for suspect in suspects) > self.threshold
        suspects.sort(key=lambda suspect: -suspect.explains)
        count = sum(one.count for one in sums)
        squares = np.sum([one.squares for one in sums], axis=0) / count
        by_channel = squares.reshape(-1, len(SEEN)).mean(axis=0)
        innovation = dict(zip(SEEN, np.sqrt(by_channel).tolist(), strict=True))
        return Verdict(alarm, self.threshold, suspects, innovation)
