"""Every log is predicted by a model of the others: which logs contradict them, and why.

The model is a least-squares fit of one step: the change of each velocity over a few seconds, from
a polynomial that knows no vessel. Two things tell a log apart from those that the others predict:
what the others' model leaves of it, and how much larger or smaller the parts of that model (hull,
each input) would have to be in it. Both are compared with their spread over the logs that agree,
so that noise, gusts and the polynomial's own faults, which all logs have, accuse none.

A log that stands apart is then predicted with one change after the other: a dead record, another
scale, sign, offset or delay of a channel, a current, another vessel. The likeliest is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from residnet.core.arrays.paged import MAX_SAMPLES_IN_MEMORY
from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.names import VELOCITY_NAMES, azimuth_thrusters, port_starboard_pairs
from residnet.core.stretches import find_runs
from residnet.core.units import unit_confusions
from residnet.preprocessing.channel_values import SIGMA_OF_MAD
from residnet.preprocessing.statistics import MIN_SAMPLES
from residnet.quality.findings import describe_unit_confusion, format_quantity
from residnet.quality.statistics import (
    STEERING_CHANNELS,
    LogStatistics,
    count_reversals,
    interpolate_gaps,
    make_blocks,
)

_RIDGE = 1e-6
"""Of the mean of a diagonal: solves what moves together, and changes the rest by a millionth."""
_MOST_ROWS = 1500
"""Blocks of a log that are looked at: more of them only overlap more."""
_SAMPLES = 20_000
"""Samples of blocks that are looked at at a time, of each of some thirty columns."""
_OVERLAP = 4.0
"""Blocks that overlap each sample; so many of their residuals count as one."""
_FEWEST = 12
"""Blocks below which a log tells nothing."""
_SIMPLER = 0.95
"""Share of the error below which the richer form is taken."""
# Chosen on 80 drawn fleets so that 3 clean ones are accused (scripts/bench/fleets.py --seed 1, 2).
_PARTS, _LEFT, _SCATTERS = 4.8, 1.8, 5.5
_STRETCHES = 4
"""Parts of a log that are predicted from each other where there are too few logs."""
_USUAL_PARTS = 1.3
"""Root mean square of the score test over the parts, for the worst of three velocities, where the
model is right: the mean of the largest of three chi variables over their size."""
_LEAST_SCATTER = 0.1
"""Scatter of the logarithm of what is left that logs of one vessel have at least."""
_ROUNDS = 3
"""Steps of the search for the half of the logs that agrees best."""
_SUSPECTS, _SUSPICIOUS = 8, 0.5
"""Logs that are left out in turn, so that the time grows with the number of logs only, and how
much a log must stand apart before it is."""
_MOST_USUAL = 40
"""Logs, evenly spread, that tell what is usual in a larger fleet: so that a score takes no longer
the more logs there are."""
_MATERIAL = 0.15
"""Share of what there is to predict that must be wrong: smaller differences mislead no fit."""
_ROOM, _SAME = 0.1, 0.02
"""Share of the others' range, or of their size, by which an input may leave it: a polynomial holds
so far beyond its data, and a smaller change moves nothing that counts."""
_SPOILED = 1.6
"""So many times more the model of all leaves of the logs that agree, where others share a fault.

Without one 1.5 at most (`quickstart`, where 13 of 68 logs stand apart from those that agree best; 1
in 48 random fleets); with one it is more in 33 of 36 random fleets where two logs stand apart.
"""
_WIND = ("wind_speed", "wind_dir")


_Sampled = Mapping[str, np.ndarray]
"""Channels of a log at the samples of its blocks, [K, samples of a block] each."""


def _wind(log: _Sampled, names: Sequence[str]) -> list[np.ndarray]:
    """Return the wind's load along and across the vessel; nothing without a wind."""
    if not (set(_WIND) <= set(names) and "psi" in log):
        return []
    pressure = log["wind_speed"] * np.abs(log["wind_speed"])
    side = log["wind_dir"] - log["psi"]
    return [pressure * np.cos(side), pressure * np.sin(side), pressure * np.sin(2.0 * side)]


def _weight(log: _Sampled, moving: Sequence[str]) -> list[np.ndarray]:
    """Return the vertical along the axes of a vessel that dives; nothing on the surface."""
    if "q" not in moving:
        return []
    level = np.cos(log["theta"])
    return [np.sin(log["theta"]), level * np.sin(log["phi"]), level * np.cos(log["phi"])]


def _thrusts(log: _Sampled, driving: Sequence[str]) -> tuple[list[np.ndarray], list[str]]:
    """Return the thrusts of azimuth thrusters along and across the vessel, and all other inputs."""
    turned = azimuth_thrusters(driving)
    along = [log[by] * np.abs(log[by]) * np.exp(1j * log[angle]) for angle, by in turned.items()]
    rest = [name for name in driving if name not in turned and name not in turned.values()]
    return [part for one in along for part in (one.real, one.imag)], rest


def _quadratic(
    log: _Sampled, units: Mapping[str, str], moving: Sequence[str], driving: Sequence[str]
) -> list[np.ndarray]:
    """Return forces of second degree in velocities and revolutions, as a hull in water has.

    They stay right at speeds that the others have not run. Angles have no degree.
    """
    states = [log[name] for name in moving]
    ahead = states[0]
    out = [state * np.abs(state) for state in states]
    out += [a * b for i, a in enumerate(states) for b in states[i + 1 :]]
    out += [np.abs(ahead) * state for state in states[1:]] + _weight(log, moving)
    thrusts, driving = _thrusts(log, driving)
    out += [*thrusts, *(ahead * thrust for thrust in thrusts)]
    angles = [log[name] for name in driving if units[name] == "rad"]
    turns = [log[name] for name in driving if units[name] != "rad"]
    for turn in turns:
        out += [turn * np.abs(turn), ahead * turn]
        out += [np.abs(turn) * state for state in states[1:]] if len(turns) <= 4 else []
    if len(turns) <= 4:
        out += [a * b for i, a in enumerate(turns) for b in turns[i + 1 :]]
    for flow in (ahead, *turns[:4]):
        out += [flow * np.abs(flow) * part for angle in angles for part in (angle, angle**2)]
    return out


def _polynomial(
    log: _Sampled, units: Mapping[str, str], moving: Sequence[str], driving: Sequence[str]
) -> list[np.ndarray]:
    """Return a polynomial in velocities and inputs with constants and linear terms."""
    states, (thrusts, rest) = [log[name] for name in moving], _thrusts(log, driving)
    given = [*thrusts, *(log[name] for name in rest)]
    ahead = states[0]
    out = [np.ones_like(ahead), *states, *(state * np.abs(state) for state in states)]
    out += [a * b for i, a in enumerate(states) for b in states[i + 1 :]] + _weight(log, moving)
    out += given
    # beyond four inputs each enters linearly only
    for i, a in enumerate(given if len(given) <= 4 else ()):
        out += [a * np.abs(a), ahead * a, ahead * np.abs(ahead) * a]
        out += [b * np.abs(b) * a for j, b in enumerate(given) if j != i]
    return out


_Form = Callable[[_Sampled, Mapping[str, str], Sequence[str], Sequence[str]], list[np.ndarray]]


@dataclass
class Rows:
    """The rows of a one-step fit to a log, scaled by the fleet: x [K, k], y [K, n].

    `first` [K] are the samples at which their blocks of `size` samples begin, `noise` [n] is the
    variance that the noise of the velocities gives y, and `known` is false of a log that is too
    short to tell anything.
    """

    x: np.ndarray
    y: np.ndarray
    first: np.ndarray
    size: int
    noise: np.ndarray

    @property
    def known(self) -> bool:
        """Whether there are enough of them."""
        return len(self.y) >= _FEWEST

    def some(self, rows: np.ndarray) -> Rows:
        """Return some of them: indices, or [K] bool."""
        return Rows(self.x[rows], self.y[rows], self.first[rows], self.size, self.noise)

    @cached_property
    def gram(self) -> np.ndarray:
        """x' x."""
        return np.asarray(self.x.T @ self.x)

    @cached_property
    def moments(self) -> np.ndarray:
        """x' y."""
        return np.asarray(self.x.T @ self.y)


def _totals(rows: Sequence[Rows]) -> list[np.ndarray]:
    """Return the sums of x' x and x' y over the rows of some logs."""
    return [np.sum([getattr(one, of) for one in rows], axis=0) for of in ("gram", "moments")]


@dataclass(frozen=True)
class Score:
    """How a log stands to the others.

    Attributes:
        parts: by how many standard errors the parts of the others' model differ in it, at most,
            over what they usually differ by where that is more than one.
        left: what the others' model leaves of it, over what is usual [n].
        scatters: `left` in the scatter of the agreeing logs, at most.
        wrong: share of what there is to predict that the others' model predicts wrongly, at most.
    """

    parts: float
    left: np.ndarray
    scatters: float
    wrong: float

    @property
    def size(self) -> float:
        """Beyond 1 the log contradicts the others."""
        if self.wrong < _MATERIAL:
            return 0.0
        most = float(np.nanmax(self.left, initial=0.0))
        return max(self.parts / _PARTS, min(most / _LEFT, self.scatters / _SCATTERS))


class Model:
    """The fit to some logs: coefficients [k, n], their uncertainty, what is usually left [n]."""

    def __init__(self, gram: np.ndarray, moments: np.ndarray) -> None:
        # of a vessel at rest all is zero
        gram = gram + _RIDGE * (np.trace(gram) / len(gram) or 1.0) * np.eye(len(gram))
        self.inverse = np.linalg.inv(gram)
        self.theta = self.inverse @ moments
        self.usual = np.ones(self.theta.shape[1])

    @classmethod
    def of(cls, rows: Sequence[Rows]) -> Model:
        """Return the fit to the rows of some logs."""
        return cls(*_totals(rows))

    def unsure(self, rows: Rows) -> np.ndarray:
        """Return how much the coefficients' uncertainty adds to the variance [K], as a share."""
        return np.asarray(((rows.x @ self.inverse) * rows.x).sum(1))

    def left(self, rows: Rows) -> np.ndarray:
        """Return the mean square [n] that the model leaves of y."""
        rest = rows.y - rows.x @ self.theta
        return np.asarray((rest**2 / (1.0 + self.unsure(rows))[:, None]).mean(0))

    def rest(self, rows: Rows) -> np.ndarray:
        """Return what the model leaves of y [K, n], in standard deviations of what is usual."""
        spread = np.sqrt((self.usual + rows.noise) * (1.0 + self.unsure(rows))[:, None])
        return np.asarray((rows.y - rows.x @ self.theta) / spread)

    def surprise(self, rows: Rows) -> float:
        """Return minus twice the mean logarithm of the likelihood of a row, constants left out."""
        spread = self.usual.size * np.log1p(self.unsure(rows)).mean()
        return float((self.rest(rows) ** 2).sum(1).mean() + spread)


class Fleet:
    """Logs of one vessel, as they claim, each predicted by a model of the others.

    Args:
        logs: each with an increasing clock, and the same channels.
        inputs: channels that drive the vessel.

    Attributes:
        core: numbers of the logs that agree.
        apart: numbers of those that do not, the worst first.
    """

    def __init__(self, logs: Sequence[LogStatistics], inputs: Sequence[str]) -> None:
        self.logs, self.inputs = list(logs), tuple(inputs)
        self.moving = [name for name in VELOCITY_NAMES if all(name in log for log in logs)]
        if all(name in log for log in logs for name in SIX_DOF_LAYOUT.dynamic_states):
            self.moving = list(SIX_DOF_LAYOUT.velocities)
        self.driving = [name for name in inputs if not name.startswith(("wind", "current"))]
        seconds = [
            make_blocks(log, *self.moving).length * log.sampling_interval
            for log in logs
            if len(log) >= MIN_SAMPLES
        ]
        self.seconds = float(np.median(seconds)) if seconds else 1.0
        self.form: _Form = _polynomial
        plain: dict[_Form, list[Rows]] = {}
        errors: dict[_Form, float] = {}
        for form in (_polynomial, _quadratic):
            self.form = form
            plain[form] = [self._rows(log) for log in self.logs]
            errors[form] = self._take(plain[form])
        if errors[_polynomial] < _SIMPLER * errors[_quadratic]:
            self.form = _polynomial
            self._take(plain[_polynomial])
        self.apart: list[int] = []
        self._rests: dict[int, list[tuple[int, int]]] = {}
        self._settle(list(self.told))
        if len(self.told) > 1:
            self._separate(self.told)
            self._share()

    def _take(self, plain: Sequence[Rows]) -> float:
        """Take the rows of all logs; return what models of the others leave of most of them."""
        self.told = [i for i, one in enumerate(plain) if one.known]
        own = [plain[i] for i in self.told]
        ones = np.ones(1)
        self.scale = np.sqrt(np.mean([np.mean(r.x**2, 0) for r in own], 0)) if own else ones
        self.scale[self.scale == 0.0] = 1.0
        self.spread = np.sqrt(np.mean([np.mean(r.y**2, 0) for r in own], 0)) if own else ones
        self.spread[self.spread == 0.0] = 1.0
        self.rows = [self._scaled(one) for one in plain]
        models = self._others(self.told, self.told) if len(self.told) > 1 else {}
        left = [float(np.sqrt(model.left(self.rows[i])).sum()) for i, model in models.items()]
        return float(np.median(left)) if left else 0.0

    def _rows(self, log: LogStatistics) -> Rows:
        size = (
            max(round(self.seconds / log.sampling_interval), 4)
            if len(log) >= MIN_SAMPLES
            else len(log)
        )
        stride = max(size // int(_OVERLAP), (len(log) - size) // _MOST_ROWS, 1)
        first, parts = np.arange(0, max(len(log) - size, 0), stride), []
        needed = {*self.moving, *self.inputs, "psi", "phi", "theta"}
        # so many blocks at a time that their samples stay in a core's cache
        for some in np.array_split(first, max(first.size * size // _SAMPLES, 1)):
            at = some[:, None] + np.arange(size + 1)
            seen, dt = {n: log[n][at] for n in log if n in needed}, np.diff(log.t[at], axis=1)
            columns = self.form(seen, log.units, self.moving, self.driving)
            columns += _wind(seen, self.inputs)
            parts.append(
                np.stack([0.5 * ((c[:, 1:] + c[:, :-1]) * dt).sum(1) for c in columns], axis=-1)
            )
        x, seconds = np.concatenate(parts), log.t[first + size] - log.t[first]
        y = np.stack([log[n][first + size] - log[n][first] for n in self.moving], axis=-1)
        known = np.isfinite(x).all(1) & np.isfinite(y).all(1)
        known &= seconds <= (size + 3.0) * log.sampling_interval
        noise = np.array([2.0 * log.noise_std(name) ** 2 for name in self.moving])
        return Rows(x[known], y[known], first[known], size, noise)

    def _scaled(self, rows: Rows) -> Rows:
        return Rows(
            rows.x / self.scale,
            rows.y / self.spread,
            rows.first,
            rows.size,
            rows.noise / self.spread**2,
        )

    def of(self, log: LogStatistics) -> Rows:
        """Return the rows of a log, or of a changed one, in the scales of the fleet."""
        return self._scaled(self._rows(log))

    def _without(self, i: int | None, totals: Sequence[np.ndarray], core: Sequence[int]) -> Model:
        """Return the model of a core with such sums, one of its logs left out."""
        gram, moments = totals
        if i is not None and i in core:
            gram, moments = gram - self.rows[i].gram, moments - self.rows[i].moments
        return Model(gram, moments)

    def _others(self, core: Sequence[int], of: Sequence[int]) -> dict[int, Model]:
        """Return for each log the model of the others of a core."""
        totals = _totals([self.rows[j] for j in core])
        return {i: self._without(i, totals, core) for i in of}

    def _beyond_noise(
        self, core: Sequence[int], models: Mapping[int, Model]
    ) -> dict[int, np.ndarray]:
        """Return the mean squares [n] beyond noise that are left of the logs of a core.

        Each is predicted by the others, or, where these are fewer than three, stretch by stretch
        from its own remainder.
        """
        if len(core) > 3:
            left = {i: models[i].left(self.rows[i]) for i in core}
        else:
            left = {i: self._by_stretches(self.rows[i]) for i in core}
        return {i: np.maximum(left[i] - self.rows[i].noise, 0.0) for i in core}

    @staticmethod
    def _by_stretches(rows: Rows) -> np.ndarray:
        """Return the mean square [n] left of a log's quarters by models of its other quarters."""
        pieces = [rows.some(p) for p in np.array_split(np.arange(len(rows.y)), _STRETCHES)]
        others = [[*pieces[:k], *pieces[k + 1 :]] for k in range(len(pieces))]
        left = [Model.of(some).left(one) for some, one in zip(others, pieces, strict=True)]
        return np.asarray(np.mean(left, axis=0))

    def scores(self, core: Sequence[int], of: Sequence[int]) -> dict[int, Score]:
        """Return how logs stand to the others of the core."""
        some = core[:: -(-len(core) // _MOST_USUAL)]
        every = [i for i in dict.fromkeys((*some, *of)) if len(core) > (i in core)]
        models = self._others(core, every)
        left = {i: models[i].left(self.rows[i]) for i in every}
        known = self._beyond_noise(some, models)
        beyond = {
            i: np.median([known[j] for j in some if j != i], axis=0) + self.rows[i].noise
            for i in every
        }
        ratio = {i: np.sqrt(left[i] / beyond[i]) for i in every}
        logs = {i: np.log(np.maximum(one, 1e-6)) for i, one in ratio.items()}
        parts = {i: self._parts(i, models[i], beyond[i]) for i in every}
        inside = [i for i in some if i in ratio]
        # few logs have no scatter to speak of
        middle, scatter, common = np.zeros(1), np.full(1, np.inf), 1.0
        if len(inside) > 4:
            middle = np.median([logs[i] for i in inside], axis=0)
            scatter = np.median([np.abs(logs[i] - middle) for i in inside], axis=0)
            scatter = np.hypot(SIGMA_OF_MAD * scatter, _LEAST_SCATTER)
        if len(inside) > 2:
            # a polynomial that does not fit the vessel differs from log to log by itself
            common = max(1.0, float(np.median([parts[i][0] for i in inside])) / _USUAL_PARTS)
        out = {}
        for i in of:
            excess = float(np.sqrt(np.maximum(left[i] - beyond[i], 0.0)).max())
            scatters = float(((logs[i] - middle) / scatter).max())
            out[i] = Score(parts[i][0] / common, ratio[i], scatters, max(parts[i][1], excess))
        return out

    @cached_property
    def _groups(self) -> list[np.ndarray]:
        """Columns [k] bool that hold no input, and those that hold each."""
        log = self.logs[self.told[0]]
        plain = self._rows(log).x
        groups = []
        for name in self.driving:
            other = self._rows(changed(log, {name: 1.7 * log[name] + 0.1}))
            size = min(len(other.x), len(plain))
            groups.append((np.abs(other.x[:size] - plain[:size]) > 0.0).any(0))
        free = ~np.logical_or.reduce(groups) if groups else np.ones(plain.shape[1], dtype=bool)
        return [free, *groups]

    def by_parts(self, i: int, model: Model) -> np.ndarray:
        """Return what each part of a model contributes to the changes of velocities [n, K, parts].

        It is 0 of a part that contributes next to nothing.
        """
        rows = self.rows[i]
        parts = [rows.x[:, group] @ model.theta[group] for group in self._groups]
        table = np.stack(parts, axis=-1).transpose(1, 0, 2)
        return np.asarray(table * (np.abs(table).max(axis=1, keepdims=True) > 1e-9))

    def _parts(self, i: int, model: Model, beyond: np.ndarray) -> tuple[float, float]:
        """Return by how many standard errors parts of the others' model differ in a log.

        It is the score test of one factor on each part (Rao 1948), root mean square over the parts,
        for the worst velocity; and the share of what there is to predict that such factors change.
        `beyond` is the mean square [n] that is usually left.
        """
        rows, table = self.rows[i], self.by_parts(i, model)
        turned = table.transpose(0, 2, 1)
        score = turned @ (rows.y - rows.x @ model.theta).T[..., None]
        own, seen = turned @ table, turned @ rows.x
        spread = own + seen @ model.inverse @ seen.transpose(0, 2, 1)
        spread = _OVERLAP * np.maximum(beyond, 1e-12)[:, None, None] * spread
        inverse = np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
        size = (score.transpose(0, 2, 1) @ inverse @ score)[:, 0, 0]
        count = table.any(axis=1).sum(axis=1)
        factors = np.linalg.pinv(own, rcond=1e-6, hermitian=True) @ score
        moved = np.sqrt(np.mean((table @ factors) ** 2, axis=1))
        most = np.sqrt(np.maximum(size, 0.0) / np.maximum(count, 1))
        return float(most.max()), float(moved.max())

    def _misfits(self, core: Sequence[int], own: Mapping[int, np.ndarray]) -> dict[int, float]:
        """Return what a core leaves of each log, over what its own quarters leave of each other."""
        models = self._others(core, [i for i in self.told if [i] != core])
        left = {i: model.left(self.rows[i]) for i, model in models.items()}
        return {i: float((left[i] / own[i]).max()) if i in left else 1.0 for i in self.told}

    def _agreeing(self) -> list[int]:
        """Return the half of the logs that agree best.

        Several logs with one fault spoil the model of all, so that none stands apart. It is the
        half with the least sum of misfits, from single logs on (least trimmed squares over logs,
        Rousseeuw and Van Driessen 2006).
        """
        own = {i: np.maximum(self._by_stretches(self.rows[i]), 1e-12) for i in self.told}
        least, best = math.inf, list(self.told)
        for first in self.told[:: -(-len(self.told) // _SUSPECTS)]:
            core = [first]
            for _ in range(_ROUNDS):
                misfits = self._misfits(core, own)
                core = sorted(misfits, key=lambda i: misfits[i])[: len(self.told) // 2 + 1]
            total = sum(misfits[i] for i in core)
            if total < least:
                least, best = total, sorted(core)
        return best

    def _share(self) -> None:
        """Take logs apart with a fault that they share, so that none of them shows it beside all.

        They stand apart from the half that agrees best. So does any log from the edge of what the
        vessel does; but a fault that is shared spoils the model of all for that half.
        """
        whole, kept = self.core, {**vars(self), "rows": [*self.rows]}
        self._separate(self._agreeing())
        of_all = self._beyond_noise(self.core, self._others(whole, self.core))
        ratios = [of_all[i] / np.maximum(self._usually[i], 1e-12) for i in self.core]
        if float(np.median(ratios, axis=0).max()) < _SPOILED**2:
            vars(self).clear()
            vars(self).update(kept)

    def _separate(self, core: list[int]) -> None:
        """Take the logs apart that contradict a core, one after the other, the worst first."""
        self._rests = {}
        self._settle(core)
        while rest := [i for i in self.told if i not in self.core]:
            agreed = [i for i, score in self.scores(self.core, rest).items() if score.size <= 1.0]
            if not agreed:
                break
            self._settle(sorted((*self.core, *agreed)))
        while len(self.core) > max(1, len(self.told) // 2):
            first = self.scores(self.core, self.core)
            # a wrong log spoils the models of all others: the likeliest are left out in turn
            likely = sorted(first, key=lambda i: -first[i].size)[:_SUSPECTS]
            likely = [i for i in likely if first[i].size > _SUSPICIOUS]
            if not likely:
                break
            second = {i: self.scores([j for j in self.core if j != i], [i])[i].size for i in likely}
            worst = max(second, key=lambda i: second[i])
            if second[worst] <= 1.0:
                break
            self.core.remove(worst)
        self._settle(self.core)
        gone = [i for i in self.told if i not in self.core]
        whole = {i: self.rows[i] for i in gone}
        for i in gone:
            # a hand on the wheel for some seconds does not make it another vessel
            rows = self.rows[i]
            begin, end = np.array(self.rests(i), dtype=int).reshape(-1, 2).T
            apart = (rows.first[:, None] + rows.size <= begin) | (rows.first[:, None] >= end)
            kept = rows.some(np.asarray(apart.all(axis=1)))
            self.rows[i] = kept if kept.known else rows
        scores = self.scores(self.core, gone) if gone else {}
        again = [i for i in gone if scores[i].size <= 1.0]
        self.apart = sorted(set(gone) - set(again), key=lambda i: -scores[i].size)
        self.rows = [whole[i] if i in self.apart else one for i, one in enumerate(self.rows)]
        self._settle(sorted((*self.core, *again)))

    def goes_beyond(self, i: int) -> bool:
        """Return whether inputs leave those of the logs that agree, and only there it differs.

        Of a log that lies beyond them from end to end no part tells that it is right.
        """

        def acting(log: LogStatistics) -> np.ndarray:
            thrusts, rest = _thrusts(dict(log.log.channels), self.driving)
            return np.stack([*thrusts, *(log[name] for name in (*rest, *self.moving))])

        others = [acting(self.logs[j]) for j in self.core if j != i]
        low = np.min([np.nanmin(one, axis=1) for one in others], axis=0)
        top = np.max([np.nanmax(one, axis=1) for one in others], axis=0)
        room = np.maximum(_ROOM * (top - low), _SAME * np.maximum(np.abs(low), np.abs(top)))
        here, whole = acting(self.logs[i]), self.rows[i]
        out = (here < (low - room)[:, None]) | (here > (top + room)[:, None])
        led, out = out[: -len(self.moving)].any(axis=0), out.any(axis=0)
        if not led.any() or led.all():
            return False
        # where such inputs led to a motion of which nothing is known, it lasts beyond them
        for start, stop in zip(*find_runs(out), strict=True):
            out[start:stop] = led[start:stop].any()
        count = np.append(0, np.cumsum(out))
        self.rows[i] = whole.some(count[whole.first + whole.size + 1] == count[whole.first])
        agrees = not self.rows[i].known or self.scores(self.core, [i])[i].size <= 1.0
        self.rows[i] = whole
        return agrees

    def _settle(self, core: list[int]) -> None:
        """Take logs for those that agree, and what is usually left of them."""
        models = self._others(core, core) if len(core) > 1 else {}
        self.core, self._usually = [*core], self._beyond_noise(core, models)
        self._whole = _totals([self.rows[j] for j in core])

    def unexplained_rests(
        self, log: LogStatistics, rows: Rows, without: int | None = None, at_zero: bool = False
    ) -> list[tuple[int, int]]:
        """Return first and last samples of rests of all inputs whose motion nothing explains.

        Where they take up more than a fifth of the log there are none: the log is a wrong one.
        They are predicted by the model of the logs that agree, `without` one of them. `at_zero`
        takes rests at exactly 0 only.
        """
        out: list[tuple[int, int]] = []
        given = log.log.stack(self.driving)
        same = (np.diff(given, axis=0) == 0.0).all(1)
        if at_zero:
            same &= (given[1:] == 0.0).all(1)
        starts, stops = find_runs(np.append(same, False))
        long = stops - starts >= rows.size
        rest = self.model(without).rest(rows) if long.any() else np.zeros(0)
        for start, stop in zip(starts[long].tolist(), stops[long].tolist(), strict=True):
            inside = (rows.first >= start) & (rows.first + rows.size <= stop)
            if inside.sum() > 1:
                left = np.sqrt(np.mean(rest[inside] ** 2, axis=0))
                size = np.sqrt(np.mean(rows.y[inside] ** 2, axis=0))
                if ((left > _UNEXPLAINED) & (size > _MATERIAL)).any():
                    out.append((start, stop))
        return out if sum(b - a for a, b in out) <= _RESTS * len(log) else []

    def rests(self, i: int) -> list[tuple[int, int]]:
        """Return the unexplained rests of one of the logs, first and last samples.

        Of a log that contradicts the others nothing explains any part: there only rests at 0 tell.
        """
        if i not in self._rests:
            told = i in self.told and len(self.core) > 1 and bool(self.driving)
            log, rows = self.logs[i], self.rows[i]
            apart = i not in self.core
            self._rests[i] = self.unexplained_rests(log, rows, i, apart) if told else []
        return self._rests[i]

    @cached_property
    def agreed(self) -> bool:
        """Whether most logs agree, so that the others can be told from them."""
        return len(self.core) > len(self.told) / 2.0 and len(self.core) > 1

    def model(self, without: int | None = None) -> Model:
        """Return the model of the logs that agree, one of them left out."""
        model = self._without(without, self._whole, self.core)
        usual = [left for i, left in self._usually.items() if i != without]
        model.usual = np.maximum(np.median(usual, axis=0), 1e-12)
        return model

    def harm(self, i: int) -> float:
        """Return by how much a log changes the predictions of a fit to all, as a share of them."""
        kept = [self.rows[j] for j in self.core if j != i]
        alone, with_it = Model.of(kept), Model.of([*kept, self.rows[i]])
        moved = [one.x @ (alone.theta - with_it.theta) for one in kept]
        return float(np.sqrt(np.mean(np.concatenate(moved) ** 2, axis=0)).max())

    def unexplained(self) -> np.ndarray:
        """Return which share of the change of each velocity [n] the others' model leaves."""
        return np.asarray(np.sqrt(np.median([*self._usually.values()], axis=0)))


def changed(log: LogStatistics, channels: Mapping[str, np.ndarray]) -> LogStatistics:
    """Return a record with some channels changed."""
    whole = {**log.log.channels, **channels}
    return LogStatistics(log.log.replace(channels=whole), log.inputs)


@dataclass(frozen=True)
class Cause:
    """One change under which the others' model explains a log.

    Attributes:
        kind: dead, scale, sign, offset, late, exchanged, heading, current or vessel.
        channel: concerned; empty where there is none.
        size: factor, offset (SI), delay in s, angle in rad, or speed of the current in m/s.
        surprise: of the log, so changed; the least is the likeliest.
        text: in words.
    """

    kind: str
    channel: str
    size: float
    surprise: float
    text: str


_FACTORS = (0.2, 0.33, 0.5, 0.67, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0)
# a change of three numbers for each velocity explains more by chance than one of a single number
_OF_MANY = 2.0
_TOGETHER = 0.9
"""Correlation from which two inputs are moved by one lever: twin rudders, as most ships have."""
_STEPS = (-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0)
_STILL = 1e-3
"""Share of an input's usual spread, or of its size, below which it rests; chosen by hand."""


def resting(fleet: Fleet, i: int, name: str) -> bool:
    """Return whether an input rests in a log though it moves in others."""
    among = [log.std(name) for j, log in enumerate(fleet.logs) if j != i]
    return fleet.logs[i].std(name) <= _STILL * max(float(np.median(among)), 1e-12)


def _with_change(kind: str, values: np.ndarray, t: np.ndarray, size: float) -> np.ndarray:
    """Return a channel [T] of another sign, scale, clock or zero."""
    if kind == "late":
        return np.asarray(np.interp(t - size, t, values))
    return np.asarray(values + size if kind == "offset" else values * size)


def _in_words(kind: str, name: str, unit: str, size: float) -> str:
    would = f"{name} would have to"
    if kind == "sign":
        return f"{would} have the opposite sign"
    if kind == "scale":
        return f"{would} be {size:.3g} times as large{describe_unit_confusion(1.0 / size, unit)}"
    if kind == "late":
        word = "later" if size > 0.0 else "earlier"
        return f"{would} act {abs(size):.2g} s {word}: the clocks differ"
    return f"{would} be larger by {format_quantity(size, unit)}"


def _alike(log: LogStatistics, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return inputs that move together: of one recorder, so that one fault has them all."""
    table = np.atleast_2d(np.corrcoef(np.nan_to_num(log.log.stack([*names]).T)))
    pairs = [[one == f"cmd_{name}" for one in names] for name in names]
    same = (table > _TOGETHER) | np.eye(len(names), dtype=bool) | np.array(pairs)
    return [tuple(np.array(names)[row].tolist()) for row in same]


def causes(fleet: Fleet, i: int) -> list[Cause]:
    """Return what would explain a log by the others' model, the likeliest first."""
    log, model, rows = fleet.logs[i], fleet.model(without=i), fleet.rows[i]
    unsure = model.surprise(rows) - float((model.rest(rows) ** 2).sum(1).mean())
    out: list[Cause] = []
    # what follows from the position has its scale, and no sign of its own
    derived = log.log.meta.get("derived", ())
    alone = [(name,) for name in (*fleet.driving, *fleet.moving) if name not in derived]
    for whole in dict.fromkeys((*alone, *_alike(log, fleet.driving), *([derived] * bool(derived)))):
        name, drives = whole[0], whole[0] in fleet.driving
        said, unit = ("x, y", "m") if derived == whole else (" and ".join(whole), log.units[name])
        spread = float(np.nanmedian([fleet.logs[j].std(name) for j in fleet.core])) or 1.0
        if (name,) == whole and drives and resting(fleet, i, name):
            surprise = _freed(fleet, model, i, name, 0.01 * spread) + unsure
            text = f"the record of {name} is dead: it rests while the vessel answers to it"
            out.append(Cause("dead", name, 0.0, surprise, text))
            continue
        sizes = {"sign": [-1.0]} if derived != whole else {}
        sizes["scale"] = [1.0 / size for size in unit_confusions(unit)]
        if drives:
            sizes["scale"] += _FACTORS
            sizes["late"] = [step * fleet.seconds for step in _STEPS]
            sizes["offset"] = [step * spread for step in _STEPS]
        for kind, tried in (one for one in sizes.items() if one[1]):

            def surprise_of(
                size: float, kind: str = kind, whole: Sequence[str] = whole, drives: bool = drives
            ) -> float:
                new = {one: _with_change(kind, log[one], log.t, size) for one in whole}
                surprise = model.surprise(fleet.of(changed(log, new)))
                # what is predicted has another density where it is scaled
                return surprise - (0.0 if drives else 2.0 * len(whole) * math.log(abs(size)))

            surprise, size = min((surprise_of(size), size) for size in tried)
            if drives and kind != "sign":
                tried = sorted(tried)
                at = tried.index(size)
                ends = tried[max(at - 1, 0)], tried[min(at + 1, len(tried) - 1)]
                near = scipy.optimize.minimize_scalar(
                    surprise_of, bounds=ends, options={"maxiter": 8}
                )
                surprise, size = min((surprise, size), (float(near.fun), float(near.x)))
            text = _in_words(kind, said, unit, size)
            out.append(Cause(kind, name, size, surprise, text))
    for port, stbd in port_starboard_pairs(fleet.driving).items():
        surprise = model.surprise(fleet.of(changed(log, {port: log[stbd], stbd: log[port]})))
        text = f"{port} and {stbd} would have to be exchanged"
        out.append(Cause("exchanged", port, 0.0, surprise, text))
    if {"u", "v"} <= set(fleet.moving):
        out.append(_heading_off(fleet, model, log))
        out += _current(fleet, model, log) if "psi" in log else []
    out.append(_vessel(fleet, model, i, unsure))
    # a change that leaves the log as strange as it was explains nothing
    most = _LEFT**2 * len(fleet.moving) + unsure
    return sorted(out, key=lambda one: (one.kind != "vessel" and one.surprise > most, one.surprise))


def _freed(fleet: Fleet, model: Model, i: int, name: str, step: float) -> float:
    """Return what is left of a log where an input may be anything at any time."""
    log, rows = fleet.logs[i], fleet.rows[i]
    more, less = (fleet.of(changed(log, {name: log[name] + s})) for s in (step, -step))
    along = (more.x - less.x) @ model.theta / np.sqrt(model.usual + rows.noise)
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    rest = model.rest(rows)
    rest = rest - (rest * along).sum(1, keepdims=True) * along
    free = rest.shape[1] - 1
    # one of so many velocities was given away at each block
    return float((rest**2).sum(1).mean()) * (rest.shape[1] / free if free else 1.0)


def _heading_off(fleet: Fleet, model: Model, log: LogStatistics) -> Cause:
    """Return the angle by which ahead is another way than the velocities have it."""

    def surprise(angle: float) -> float:
        turned = (log["u"] + 1j * log["v"]) * np.exp(1j * angle)
        return model.surprise(fleet.of(changed(log, {"u": turned.real, "v": turned.imag})))

    step = math.radians(10.0)
    near = min((step * k for k in range(-17, 19) if k), key=surprise)
    found = scipy.optimize.minimize_scalar(
        surprise, bounds=(near - step, near + step), options={"maxiter": 12}
    )
    angle = float(found.x)
    way = "larger" if angle < 0.0 else "smaller"
    text = (
        f"psi would have to be {way} by {abs(math.degrees(angle)):.3g} deg, or u and v turned by"
        " as much"
    )
    return Cause("heading", "psi", angle, float(found.fun), text)


def _current(fleet: Fleet, model: Model, log: LogStatistics) -> list[Cause]:
    """Return the current that would explain velocities over ground, by search on a grid.

    None where the search ends at slack water.
    """
    usual = float(np.nanmedian([fleet.logs[j].rms_speed for j in fleet.core]))

    def surprise(current: complex) -> float:
        water = (log["u"] + 1j * log["v"]) - current * np.exp(-1j * log["psi"])
        return model.surprise(fleet.of(changed(log, {"u": water.real, "v": water.imag})))

    ways = np.exp(0.25j * np.pi * np.arange(8))
    grid = [share * usual * way for share in (0.1, 0.2, 0.3, 0.4, 0.5) for way in ways]
    least, best = min(((surprise(one), k) for k, one in enumerate(grid)))
    found, step = complex(grid[best]), 0.05 * usual
    while step > 0.01 * usual:
        near = [found + step * way for way in ways]
        lower, k = min((surprise(one), k) for k, one in enumerate(near))
        if lower < least:
            least, found = lower, complex(near[k])
        else:
            step *= 0.5
    if abs(found) < 0.05 * usual:
        return []
    way = math.degrees(math.atan2(found.imag, found.real)) % 360.0
    text = (
        f"it ran in a current of {abs(found):.2g} m/s towards {way:.0f} deg, and u and v are over"
        " ground"
    )
    return [Cause("current", "", abs(found), least, text)]


def _vessel(fleet: Fleet, model: Model, i: int, unsure: float) -> Cause:
    """Return what is left of a log if every part of the model had a size of its own in it."""
    rows, left = fleet.rows[i], 0.0
    spread = np.sqrt((model.usual + rows.noise) * (1.0 + model.unsure(rows))[:, None])
    tables = fleet.by_parts(i, model) / spread.T[..., None]
    for table, rest in zip(tables, model.rest(rows).T, strict=True):
        sizes = np.linalg.lstsq(table, rest, rcond=1e-6)[0]
        left += float(np.mean((rest - table @ sizes) ** 2))
    text = (
        "it is another vessel or another loading, or something acted that was not recorded: no"
        " single change of a channel explains it"
    )
    return Cause("vessel", "", 0.0, _OF_MANY * left + unsure, text)


# Of 92 stretches of KVLCC2's logs none reaches 3.2, of 311 of the tanker's six do, among them all
# three in which the ship accelerates with propeller and rudder at exactly 0.
_UNEXPLAINED, _RESTS = 5.5, 0.2
"""Times what is usual that the others' model must leave of a stretch (root mean square), and the
share of a log up to which such stretches are a hand on the wheel, and not a wrong log."""


def dead_commands(
    learned: Sequence[LogStatistics], further: Sequence[LogStatistics], inputs: Sequence[str]
) -> dict[str, list[tuple[int, int]]]:
    """Return stretches of motion that no recorded input explains while all inputs rest.

    Somebody took over by hand, say, or the record stopped.

    Args:
        learned: logs that the models are made of; each is predicted by a model of the others.
        further: logs that are predicted by the model of those.
        inputs: channels that drive the vessel.

    Returns:
        Name of a log -> first and last samples.
    """
    fit = [log for log in learned if _usable(log, inputs)]
    if not fit or not any(all(name in log for log in fit) for name in VELOCITY_NAMES):
        return {}
    fleet = Fleet(fit, inputs)
    out = {log.name: fleet.rests(i) for i, log in enumerate(fit)}
    for log in further if len(fleet.core) > 1 and fleet.driving else ():
        if _usable(log, inputs) and set(fleet.moving) <= set(log):
            out[log.name] = fleet.unexplained_rests(log, fleet.of(log))
    return {name: found for name, found in out.items() if found}


def _usable(log: LogStatistics, inputs: Sequence[str]) -> bool:
    """Return whether a log has a clock and all inputs, and is not too long to be looked at."""
    return (
        1 < len(log) <= MAX_SAMPLES_IN_MEMORY
        and bool((np.diff(log.t) > 0.0).all())
        and all(name in log for name in inputs)
    )


def nothing_steers(fleet: Fleet) -> tuple[list[str], float]:
    """Return steering records that rest in every log, and the share of yaw left unexplained.

    No name where one of them moves, or what moves explains the yaw. Of one side's propeller and
    the other's, either steers.
    """
    if "r" not in fleet.moving or len(fleet.core) < 2:
        return [], 0.0
    sides = [name for name in fleet.driving if name.endswith(("port", "stbd", "left", "right"))]
    steering = [name for name in fleet.driving if name in STEERING_CHANNELS] or sides
    dead = [
        name
        for name in steering
        if all(
            log.std(name) <= _STILL * max(float(np.nanmax(np.abs(log[name]))), 1e-12)
            for log in fleet.logs
        )
    ]
    left = float(fleet.unexplained()[fleet.moving.index("r")])
    if not dead or left <= _UNSTEERED:
        return [], left
    headings = (
        interpolate_gaps(log.t, log["psi"])
        if "psi" in log
        else np.cumsum(np.nan_to_num(log["r"])) * log.sampling_interval
        for log in fleet.logs
    )
    weaving = [count_reversals(heading, _SWING) >= 2 for heading in headings]
    return (dead, left) if np.mean(weaving) >= _WEAVE else ([], left)


# with all records alive .02 to .31 of the change of r is left, with the steering dead .30 to .71
# (40 fleets of scripts/bench/fleets.py)
_UNSTEERED = 0.3
# a heading that goes so far one way and back was steered, by gusts not more than one in ten logs
# of straight runs; of steered fleets no fewer than three in ten weave
_SWING, _WEAVE = math.radians(20.0), 0.2
