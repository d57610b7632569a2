"""The monitor: score tests on the innovations of short free runs, against those of clean logs.

Innovations of windows are whitened by their covariance over clean logs. For each cause the score
test asks whether a small change of that kind explains the last minutes, once wind and current have
taken what they can. How much clean logs scatter in the score sets its scale, so that what the model
has always got wrong raises no alarm.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import Field
from scipy.stats import t as student

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.identification.monitoring.changes import Change, causes, surroundings
from residnet.identification.monitoring.windows import SEEN, Piece, innovations

_SHRINK = 0.1
"""Share of the diagonal in the covariance of innovations."""
_OVERLAP = 3.0
"""Independent looks that a sliding stretch gives while it slides by its own length."""
_LEAST = 0.5
"""Share of the threshold that a score must reach for its cause to be named before others."""
_FEWEST = 5
"""Groups of clean windows below which nothing can be said about false alarms."""
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
        score: of its test, in standard deviations of clean logs.
        size: of the change, in its unit.
        error: standard error of the size.
    """

    change: Change
    score: float
    size: float
    error: float


@dataclass(frozen=True)
class Verdict:
    """What a monitor says after a window.

    Attributes:
        alarm: whether the largest score exceeds the threshold.
        threshold: of the scores.
        suspects: causes, the likeliest first.
        innovation: root mean square of the whitened innovations of each channel; 1 on clean logs.
    """

    alarm: bool
    threshold: float
    suspects: Sequence[Suspect]
    innovation: dict[str, float]


@dataclass(frozen=True)
class _Sums:
    """Scores [Q] and information [Q, Q] of a number of windows, and squares of innovations [n]."""

    score: np.ndarray
    information: np.ndarray
    squares: np.ndarray
    count: int

    def __add__(self, other: _Sums) -> _Sums:
        return _Sums(
            self.score + other.score,
            self.information + other.information,
            self.squares + other.squares,
            self.count + other.count,
        )


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
        self.belief = np.diag([_CURRENT**-2] * 2 + [_PUSH**-2] * 2)
        size = max(round(config.group / config.window), 1)
        groups = [log[i : i + size] for log in clean for i in range(0, len(log), size)]
        if len(groups) < _FEWEST:
            raise DataError(
                f"the clean logs hold {len(groups)} stretches of {config.group:g} s; a monitor"
                f" needs at least {_FEWEST} to know how innovations scatter"
            )
        found = [innovations(self.model, group, self.changes) for group in groups]
        error = np.concatenate([part for part, _ in found])
        second = error.T @ error / len(error)
        covariance = (1.0 - _SHRINK) * second + _SHRINK * np.diag(np.diag(second))
        self.whiten = np.linalg.inv(np.linalg.cholesky(covariance + 1e-18 * np.eye(len(second))))
        self._scale([self._sums(e, effects) for e, effects in found])

    @property
    def changes(self) -> list[Change]:
        """The causes, then what surrounds the vessel."""
        return [*self.causes, *self.others]

    def _scale(self, groups: Sequence[_Sums]) -> None:
        """Take bias and scatter of every cause's score from groups of clean windows."""
        parts = [self._alone(group) for group in groups]
        score = np.array([part[0] for part in parts])
        information = np.array([part[1] for part in parts])
        self.known = information.sum(axis=0)
        self.bias = score.sum(axis=0) / self.known
        apart = score - self.bias * information
        self.scatter = np.maximum(
            (apart**2).sum(axis=0) / self.known * len(groups) / (len(groups) - 1), 1.0
        )
        looks = self.config.false_alarm / self.config.stretch * _OVERLAP * len(self.causes)
        self.threshold = float(student.isf(0.5 / looks, len(groups) - 1))

    def sums(self, pieces: Sequence[Piece]) -> list[_Sums]:
        """Return the scores of each of several windows."""
        error, effects = innovations(self.model, pieces, self.changes)
        return [self._sums(error[i : i + 1], effects[i : i + 1]) for i in range(len(pieces))]

    def _sums(self, error: np.ndarray, effects: np.ndarray) -> _Sums:
        e, a = error @ self.whiten.T, effects @ self.whiten.T
        return _Sums(
            np.einsum("bqn,bn->q", a, e),
            np.einsum("bqn,bpn->qp", a, a),
            (e**2).sum(axis=0),
            len(e),
        )

    def _alone(self, sums: _Sums) -> tuple[np.ndarray, np.ndarray]:
        """Return scores and information of the causes once the surroundings have had their part."""
        count = len(self.causes)
        matrix = sums.information
        own = np.linalg.solve(matrix[count:, count:] + self.belief, matrix[count:, :count])
        score = sums.score[:count] - own.T @ sums.score[count:]
        information = np.diag(matrix[:count, :count] - matrix[:count, count:] @ own)
        return score, np.maximum(information, 1e-300)

    def judge(self, groups: Sequence[_Sums]) -> Verdict:
        """Return the verdict on groups of windows; wind and current are their own in each."""
        parts = [self._alone(group) for group in groups]
        score = np.sum([part[0] for part in parts], axis=0)
        information = np.sum([part[1] for part in parts], axis=0)
        apart = score - self.bias * information
        variance = self.scatter * information * (1.0 + information / self.known)
        z = apart / np.sqrt(variance)
        suspects = [
            Suspect(
                change,
                float(abs(z[i])),
                float(apart[i] / information[i]),
                float(np.sqrt(variance[i]) / information[i]),
            )
            for i, change in enumerate(self.causes)
        ]
        # what explains most of the innovations is named first; what clean logs scatter in decides
        # whether there is an alarm at all
        explained = apart**2 / information
        order = np.argsort(
            -np.where(np.abs(z) > _LEAST * self.threshold, explained, 0.01 * np.abs(z))
        )
        alarm = bool(np.abs(z).max() > self.threshold)
        suspects = [suspects[i] for i in order]
        count = sum(group.count for group in groups)
        squares = np.sum([group.squares for group in groups], axis=0) / count
        by_channel = squares.reshape(-1, len(SEEN)).mean(axis=0)
        innovation = dict(zip(SEEN, np.sqrt(by_channel).tolist(), strict=True))
        return Verdict(alarm, self.threshold, suspects, innovation)


class Watcher:
    """A watch that goes along with measurements, sample by sample.

    Args:
        watch: over a model.
        past: samples before a window that warm a memory up.
    """

    def __init__(self, watch: Watch, past: int) -> None:
        self.watch = watch
        self.past = past
        self.steps = round(watch.config.window / watch.dt)
        self.size = max(round(watch.config.group / watch.config.window), 1)
        self.windows = max(round(watch.config.stretch / watch.config.window), 1)
        self.recent: deque[_Sums] = deque()
        self.closed = True
        self.y: list[np.ndarray] = []
        self.w: list[np.ndarray] = []

    def step(self, y: np.ndarray, w: np.ndarray) -> Verdict | None:
        """Take one sample: measured state [6], and the inputs [m] held over the step after it.

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
            known[self.past :],
            given[self.past : -1],
            known[: self.past],
            given[: self.past],
        )
        # the next window begins where this one ends
        keep = self.past + 1
        self.y, self.w = self.y[-keep:], self.w[-keep:]
        return self.take(self.watch.sums([piece])[0])

    def restart(self) -> None:
        """Begin a new log, whose wind and current are its own."""
        self.y, self.w = [], []
        self.closed = True

    def take(self, sums: _Sums) -> Verdict:
        """Take the scores of a window, and return the verdict on the last stretch."""
        if self.closed or self.recent[-1].count >= self.size:
            self.recent.append(sums)
        else:
            self.recent[-1] = self.recent[-1] + sums
        self.closed = False
        while sum(group.count for group in self.recent) - self.recent[0].count >= self.windows:
            self.recent.popleft()
        return self.watch.judge(self.recent)
