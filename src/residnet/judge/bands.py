"""Bands from errors of free runs over logs that the model was not fitted on, and how they fared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from residnet.core.layout import ALIVE, BESIDE, HEADING, PLANAR, POSITION, VELOCITIES, Live
from residnet.data.prepare import Prepared
from residnet.judge.band import (
    Activity,
    Band,
    by_channel,
    corrected,
    covered,
    disagreement,
    factor,
    independent,
    interval_score,
    mean_squares,
    quantile,
    run_weights,
    worst,
)
from residnet.judge.freerun import Errors, Prediction
from residnet.judge.protocol import Window

_MASKED = tuple(PLANAR.banded.index(name) for name in ("u", "v", "position"))
"""Channels that are scored over usable samples alone."""


@dataclass(frozen=True)
class RunErrors:
    """What a free run of L samples after the first got wrong, and how it moved.

    Attributes:
        log: name of the log.
        manoeuvre: its kind.
        error: absolute errors [L, c] by channel, NaN where they are not scored.
        states: predicted [L + 1, 3 + n], from the initial state on.
        spread: standard deviation between unlike models [L, c]; None where there are none.
        live: what moves, by which channels are.
    """

    log: str
    manoeuvre: str
    error: np.ndarray
    states: np.ndarray
    spread: np.ndarray | None = None
    live: Live = ALIVE

    def within(self, band: Band) -> np.ndarray:
        """Return the half widths [L, c] that a band gives the run."""
        return band.half_widths(self.states, self.spread)

    def __len__(self) -> int:
        return len(self.error)


def run_errors(
    windows: Sequence[Window],
    predictions: Sequence[Prediction],
    logs: Sequence[Prepared],
    found: Errors | None = None,
) -> list[RunErrors]:
    """Return the errors of one model's free runs over W windows, their first samples left out."""
    found = Errors.of(windows, predictions, logs) if found is None else found
    channels = by_channel(np.abs(found.error), np.hypot(*found.error[:, POSITION].T))
    channels[np.ix_(~found.usable, np.array(_MASKED))] = np.nan
    live = found.live
    moved = {*live.channels, *["heading"] * live.turns, *["position"] * live.moves}
    channels[:, [name not in moved for name in live.layout.banded]] = np.nan
    parts = np.split(channels, found.begins[1:])
    return [
        RunErrors(
            log.log.name, log.log.manoeuvre, error[1:], prediction.states, prediction.spread, live
        )
        for log, error, prediction in zip(
            (logs[window.log] for window in windows), parts, predictions, strict=True
        )
    ]


@dataclass(frozen=True)
class BandCounts:
    """Sums over the scored samples of each of W windows, by channel [W, c].

    Attributes:
        channels: names.
        scored: number of samples.
        inside: how many of them the band holds.
        whole: 1 where the band of whole runs holds the window, NaN where nothing is scored.
        score: sum of the interval scores, in the units of the band.
        constant: the same of a band of one width.
    """

    channels: tuple[str, ...]
    scored: np.ndarray
    inside: np.ndarray
    whole: np.ndarray
    score: np.ndarray
    constant: np.ndarray

    def row(self, chosen: np.ndarray) -> dict[str, Any]:
        """Return what a row of metrics.json says of chosen windows [W] bool."""
        count = self.scored[chosen].sum(axis=0)
        seen = count > 0

        def mean(sums: np.ndarray) -> np.ndarray:
            return np.asarray(sums[chosen].sum(axis=0)[seen] / count[seen])

        inside = mean(self.inside)
        names = [name for name, known in zip(self.channels, seen, strict=True) if known]
        return {
            "band_coverage": {
                **dict(zip(names, map(float, inside), strict=True)),
                "mean": float(inside.mean()),
                "whole": float(np.nanmean(self.whole[chosen])),
            },
            "band_score": float(mean(self.score).mean()),
            "band_score_constant": float(mean(self.constant).mean()),
        }


def counted(runs: Sequence[RunErrors], band: Band) -> BandCounts:
    """Return how a band fared over free runs of its model."""
    errors = [own.error for own in runs]
    widths = [own.within(band) for own in runs]
    largest = worst(errors, widths)

    def scores(given: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack(
            [
                np.nansum(interval_score(error, width, band.level), axis=0) / band.unit
                for error, width in zip(errors, given, strict=True)
            ]
        )

    return BandCounts(
        band.channels,
        np.stack([np.isfinite(error).sum(axis=0) for error in errors]),
        np.stack(
            [(error <= width).sum(axis=0) for error, width in zip(errors, widths, strict=True)]
        ),
        np.where(np.isnan(largest), np.nan, largest <= band.whole),
        scores(widths),
        scores([np.broadcast_to(band.constant, error.shape) for error in errors]),
    )


def limits(states: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits [L + 1, 3 + n] of predicted states.

    The initial state is given, and has no width. Limits of x and y are those of the box about the
    circle that holds the position.

    Args:
        states: predicted [L + 1, 3 + n], from the initial state on.
        width: half widths [L, c] after it.
    """
    reach = np.zeros_like(states)
    reach[1:, VELOCITIES] = width[:, :3]
    reach[1:, HEADING] = width[:, 3]
    reach[1:, POSITION] = width[:, 4:5]
    reach[1:, BESIDE] = width[:, 5:]
    return states - reach, states + reach


FEWEST_LOGS = 9
"""Logs below which no band can promise 90 % whatever errors are distributed like."""
_POINTS = 100
"""Horizons that half widths are kept at."""
_SMOOTHED = 0.11
"""Share of the horizon over which widths are smoothed."""
_RIDGE = 0.02
"""Pull of the slopes to zero, against measures of unit variance."""
_ROUNDS = 2
"""Turns of shape and slopes, each given the other; chosen by hand."""
_FOLDS = 5
"""Groups of logs whose errors are scaled by what the others say."""
_THINNED = 3
"""Of so many horizons one says how liveliness acts."""
_STEPS = 8
"""Of Newton's method; chosen by hand: near the end each doubles the digits."""


@dataclass(frozen=True)
class _Runs:
    """Errors [W, G, c] of W runs at G horizons, and measures [W, G, 2 n] of how lively they are."""

    names: Sequence[str]
    weight: np.ndarray
    steps: np.ndarray
    error: np.ndarray
    measures: np.ndarray
    activity: Activity

    def where(self, chosen: np.ndarray) -> _Runs:
        """Return those runs that are chosen [W] bool."""
        return replace(
            self,
            names=[name for name, wanted in zip(self.names, chosen, strict=True) if wanted],
            weight=self.weight[chosen] / self.weight[chosen].sum(),
            error=self.error[chosen],
            measures=self.measures[chosen],
        )


def calibrate(runs: Sequence[RunErrors], level: float, step: float, unit: np.ndarray) -> Band:
    """Return the band that holds a share `level` of the errors of runs to come.

    Args:
        runs: over logs that the model was not fitted on, under one protocol; at least one.
        level: wanted.
        step: of the runs in s.
        unit: that scores are given in, [c].
    """
    whole_error = _at_horizons(runs, step)
    names, weight, channels = whole_error.names, whole_error.weight, runs[0].live.layout.banded
    given = whole_error
    usual: np.ndarray | None = None
    spreads = [run.spread for run in runs if run.spread is not None]
    if len(spreads) == len(runs):
        spread = _at(spreads, given.steps)
        usual = _rms(spread, given)
        # what the disagreement of models explains is no error that the rest of the band must hold
        explained = np.nan_to_num(disagreement(spread, usual, level, channels))
        given = replace(given, error=np.sqrt(np.maximum(given.error**2 - explained, 0.0)))
    shape, slope = _scale(given)
    scale = _scales_of_others(given)
    inside = np.nanmean(covered(given.error, _quantiles(given, scale, level) * scale), axis=(1, 2))
    number = independent(inside, weight, names, level)
    raised = corrected(level, number)
    quantiles = _quantiles(given, scale, raised)
    # a channel that no velocity moves is not scored, and its band has no width
    width = np.nan_to_num(shape * quantiles)
    same = _shape(whole_error, np.zeros_like(slope))
    plain = same * _quantiles(whole_error, np.broadcast_to(same, given.error.shape), raised)
    plain = np.nan_to_num(plain)
    flat = whole_error.error.reshape(-1, len(channels))
    band = Band(
        level,
        step,
        given.steps,
        width,
        plain,
        np.ones(len(channels)),
        np.nan_to_num(quantile(flat, np.repeat(weight, given.error.shape[1]), raised)),
        unit,
        given.activity,
        slope,
        len(set(names)),
        number,
        usual=usual,
        channels=channels,
    )
    largest = worst([run.error for run in runs], [run.within(band) for run in runs])
    # as far as the runs of other logs know the scale
    seen = shape * factor(given.measures, slope)
    largest *= _largest(given.error, scale * quantiles) / _largest(given.error, seen * quantiles)
    whole = np.nan_to_num(quantile(largest, weight, raised), nan=1.0)
    return replace(band, whole=whole, cautions=few(band.logs))


def _at(rows: Sequence[np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Return rows [L, c] of each run at some steps [W, G, c]; NaN beyond its end."""
    out = np.full((len(rows), len(steps), rows[0].shape[1]), np.nan)
    for one, row in zip(out, rows, strict=True):
        reached = steps[steps <= len(row)] - 1
        one[: len(reached)] = row[reached]
    return out


def _rms(values: np.ndarray, given: _Runs) -> np.ndarray:
    """Return the root mean square [G, c] of values [W, G, c] over runs, smoothed over horizons."""
    weight = np.where(np.isfinite(values), given.weight[:, None, None], 0.0)
    total = weight.sum(axis=0)
    sums = np.where(total > 0, (weight * np.nan_to_num(values) ** 2).sum(axis=0), np.nan)
    return np.asarray(np.sqrt(_smooth(sums / np.where(total > 0, total, 1.0), given.steps)))


def _largest(error: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the largest error in half widths of each run [W, c], over horizons."""
    ratio = np.where(np.isfinite(error) & (width > 0.0), error / np.maximum(width, 1e-300), 0.0)
    return np.asarray(np.maximum(ratio.max(axis=1), 1e-12))


def _scale(given: _Runs) -> tuple[np.ndarray, np.ndarray]:
    """Return shape [G, c] and slopes [2 n, c] of the errors of runs."""
    slope = np.zeros((given.measures.shape[2], given.error.shape[2]))
    for _ in range(_ROUNDS):
        slope = _slopes(given, _shape(given, slope), slope)
    return _shape(given, slope), slope


def _scales_of_others(given: _Runs) -> np.ndarray:
    """Return the scale [W, G, c] of every run's errors as the runs of other logs have it.

    A scale that has seen a run would take its errors for smaller than those of runs to come.
    """
    _, place = np.unique(given.names, return_inverse=True)
    fold = place % _FOLDS
    out = np.empty_like(given.error)
    for k in np.unique(fold):
        own = fold == k
        others = given.where(~own) if (~own).any() else given
        shape, slope = _scale(others)
        out[own] = shape * factor(given.measures[own], slope)
    return out


def few(logs: int) -> tuple[str, ...]:
    """Return what to say where logs are too few for a promise."""
    if logs >= FEWEST_LOGS:
        return ()
    counted = f"{logs} logs calibrate" if logs > 1 else "One log calibrates"
    return (
        f"{counted} this band; below {FEWEST_LOGS} no method can promise 90 % for every"
        " distribution of errors.",
    )


def _at_horizons(runs: Sequence[RunErrors], step: float) -> _Runs:
    """Return the errors and measures of runs at the horizons that a band is kept at."""
    longest = max(map(len, runs))
    steps = np.unique(np.linspace(1, longest, min(_POINTS, longest)).round().astype(int))
    names = [run.log for run in runs]
    weight = run_weights(names)
    squares = [mean_squares(run.states, step) for run in runs]
    activity = Activity.of(squares, weight)
    error, measures = _at([run.error for run in runs], steps), _at(squares, steps)
    measures = np.nan_to_num(activity.standard(measures))
    return _Runs(names, weight, steps, error, measures, activity)


def _shape(given: _Runs, slope: np.ndarray) -> np.ndarray:
    """Return the root mean square [G, c] of errors over what liveliness explains, smoothed."""
    root = _rms(given.error / factor(given.measures, slope), given)
    return np.asarray(np.maximum(root, 1e-12 + 1e-6 * np.nan_to_num(root).max(axis=0)))


def _quantiles(given: _Runs, scale: np.ndarray, level: float) -> np.ndarray:
    """Return the quantile [G, c] of errors over a scale [W, G, c], smoothed over horizons."""
    return _smooth(quantile(given.error / scale, given.weight, level), given.steps)


def _smooth(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return moving means [G, c] over neighbouring horizons; gaps are filled from beside them."""
    reach = 0.5 * _SMOOTHED * steps[-1]
    # the first steps, where errors begin, are smoothed over what lies as near as the start itself
    near = np.minimum(reach, steps - 1 + 0.5)
    close = np.abs(steps[:, None] - steps[None, :]) <= near[:, None]
    known = np.isfinite(values)
    count = close @ known.astype(float)
    mean = (close @ np.where(known, values, 0.0)) / np.maximum(count, 1.0)
    for column, good in zip(mean.T, (count > 0).T, strict=True):
        column[:] = np.interp(steps, steps[good], column[good]) if good.any() else np.nan
    return np.asarray(mean)


def _slopes(given: _Runs, shape: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return by how much liveliness raises the logarithm of the errors [2 n, c].

    Errors over the shape are taken for gamma distributed with a logarithmic link; Newton's method.
    """
    out = slope.copy()
    rows = slice(None, None, _THINNED)
    error, z, shape = given.error[:, rows], given.measures[:, rows], shape[rows]
    weight = given.weight[:, None] / error.shape[1]
    pull, flat = _RIDGE * np.eye(z.shape[2]), z.reshape(-1, z.shape[2])
    for channel in range(error.shape[2]):
        ratio = error[:, :, channel] / shape[:, channel]
        seen = np.isfinite(ratio)
        y, w = np.where(seen, ratio, 0.0), np.where(seen, weight, 0.0)
        if not seen.any():
            continue
        own = out[:, channel].copy()
        for _ in range(_STEPS):
            mean = np.exp(np.clip(z @ own, -20.0, 20.0))
            mean *= (w * y).sum() / max((w * mean).sum(), 1e-300)
            part = w * y / np.maximum(mean, 1e-300)
            gradient = flat.T @ (part - w).ravel() - pull @ own
            hessian = flat.T @ (part.reshape(-1, 1) * flat) + pull
            own = own + np.clip(np.linalg.solve(hessian, gradient), -1.0, 1.0)
        out[:, channel] = own
    return out
