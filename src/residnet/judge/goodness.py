"""Goodness of fit of one-step predictions (document 000, appendix E); how far repeats differ."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from residnet.core.frames import wrap_array
from residnet.core.layout import HEADING, POSE, POSITION
from residnet.core.names import ACCELERATION
from residnet.data.prepare import Prepared
from residnet.judge.metrics import LEVEL, tail
from residnet.judge.protocol import ProtocolConfig, Window

_COMMAND, _START, _SEARCH = 0.05, 0.25, 0.5
"""How much two runs of a pair differ at most: in commands, share of their range, and at the start,
in scales. Starts are tried every `_SEARCH` seconds. Chosen by hand: closer ones leave few pairs.
"""


@dataclass(frozen=True)
class Pair:
    """A pair of repeated runs: a window, and the stretch of a log that repeats it.

    `mismatch` is that of the commands, as a share of their range.
    """

    first: Window
    log: int
    start: int
    mismatch: float


def repeatability(
    protocol: ProtocolConfig,
    logs: Sequence[Prepared],
    commands: int,
    scales: Mapping[str, float],
    step: float,
) -> dict[str, Any]:
    """Return the part of limits.json about repeated manoeuvres.

    Every window of the protocol is compared with every stretch of equal length of the logs after
    its own, and of its own after the window, at starts every 0.5 s. A stretch repeats a window
    where the root mean square difference of every command stays below 5 % of the command's range
    over all logs, and each initial velocity differs by less than a quarter of its scale; the best
    stretch of a log counts.

    Args:
        logs: on one grid.
        commands: number of columns of the inputs that are commanded.
        step: of the grid in s.

    Returns:
        tolerances; pairs, logs (how many take part); where there are pairs, means over them of the
        root mean square differences of what moves (SI), of position and heading at the end (m,
        rad; seen from the start of each run), `nrmse` (mean over these of difference / scale), and
        the same by kind of manoeuvre. Two independent runs differ by sqrt(2) times what each is off
        their expectation.
    """
    moving = logs[0].live.moving
    divisor = np.array([scales.get(name, 1.0) for name in moving])
    live = [moving.index(name) for name in scales]
    found = list(find_pairs(protocol, logs, commands, divisor, step))
    out: dict[str, Any] = {
        "tolerance": {
            "command_share_of_range": _COMMAND,
            "start": {name: _START * float(scales[name]) for name in scales},
        },
        "pairs": len(found),
        "logs": len({pair.first.log for pair in found} | {pair.log for pair in found}),
    }
    if found:
        apart = np.array([_apart(pair, logs) for pair in found])
        kinds = np.array([logs[pair.first.log].log.manoeuvre for pair in found])
        by_kind = {
            str(kind): {"pairs": int((kinds == kind).sum())}
            | _mean(apart[kinds == kind], moving, divisor, live)
            for kind in np.unique(kinds)
        }
        out |= _mean(apart, moving, divisor, live) | {"manoeuvres": by_kind}
    return out


def find_pairs(
    protocol: ProtocolConfig,
    logs: Sequence[Prepared],
    commands: int,
    scales: np.ndarray,
    step: float,
) -> Iterator[Pair]:
    """Return pairs of repeated runs; scales [n] are of what moves.

    Each window of the protocol with at most one stretch of each log from its own on. Without
    commands nothing says that two runs were to be the same, and there are none.
    """
    if commands == 0:
        return
    every = max(round(_SEARCH / step), 1)
    known = [log.recorded[log.piece >= 0, :commands] for log in logs]
    spread = np.concatenate(known).max(0) - np.concatenate(known).min(0)
    spread[spread == 0] = 1.0
    coarse = [np.nan_to_num(log.recorded[::every, :commands]) / spread for log in logs]
    for number, log in enumerate(logs):
        for window in protocol.windows(log, number, step):
            length = window.stop - window.start
            given = (
                np.nan_to_num(log.recorded[window.start : window.stop : every, :commands]) / spread
            )
            for other in range(number, len(logs)):
                starts = np.arange(0, len(logs[other]) - length + 1, every)
                if len(starts) == 0:
                    continue
                miss = mismatch(given, coarse[other])[: len(starts)]
                there = logs[other]
                apart = np.abs(there.smooth[starts, there.live.columns] - window.nu)
                fits = (
                    (miss < _COMMAND)
                    # an unbroken, usable stretch with nearly the initial velocities of the window
                    & (there.piece[starts] >= 0)
                    & (there.piece[starts] == there.piece[starts + length - 1])
                    & there.usable[starts]
                    & (apart < _START * scales).all(1)
                )
                if other == number:
                    fits &= starts >= window.stop
                if fits.any():
                    best = int(np.argmin(np.where(fits, miss, np.inf)))
                    yield Pair(window, other, int(starts[best]), float(miss[best]))


def mismatch(given: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the difference of a stretch [L, m] to every stretch of a series, [T - L + 1].

    It is the root mean square, the largest over the columns of the series [T, m].
    """
    if len(series) < len(given):
        return np.zeros(0)
    length, out = len(given), []
    middle = series.mean(0)
    for a, b in zip((given - middle).T, (series - middle).T, strict=True):
        energy = np.concatenate(([0.0], np.cumsum(b**2)))
        square = (
            energy[length:]
            - energy[:-length]
            - 2 * scipy.signal.correlate(b, a, mode="valid")
            + np.sum(a**2)
        )
        out.append(np.sqrt(np.maximum(square, 0.0) / length))
    return np.asarray(np.max(out, axis=0))


def _apart(pair: Pair, logs: Sequence[Prepared]) -> list[float]:
    """Differences of two runs: root mean square of u, v (samples usable in both) and the rest of
    what moves, then position and heading at the end.
    """
    first, second = logs[pair.first.log], logs[pair.log]
    a = slice(pair.first.start, pair.first.stop)
    b = slice(pair.start, pair.start + a.stop - a.start)
    columns = first.live.columns
    nu = first.y[a, columns] - second.y[b, columns]
    good = first.usable[a] & second.usable[b]
    end_a, end_b = _end(first.y[a]), _end(second.y[b])
    parts = (*nu[good, :2].T, *nu[:, 2:].T)
    rms = [float(np.sqrt(np.mean(part**2))) for part in parts]
    apart = end_a - end_b
    return [*rms, float(np.hypot(*apart[POSITION])), float(abs(wrap_array(apart[HEADING])))]


def _end(y: np.ndarray) -> np.ndarray:
    """The pose [3] at the end of a run [T, 3 + n] in the axes of its start."""
    north, east, turned = y[-1, POSE] - y[0, POSE]
    c, s = np.cos(y[0, HEADING]), np.sin(y[0, HEADING])
    return np.array([c * north + s * east, c * east - s * north, turned])


def _mean(
    apart: np.ndarray, moving: Sequence[str], scales: np.ndarray, live: list[int]
) -> dict[str, float]:
    mean = dict(zip((*moving, "position", "heading"), apart.mean(0).tolist(), strict=True))
    shares = (apart[:, : len(moving)].mean(0) / scales)[live]
    return mean | {"nrmse": float(shares.mean())}


_RESAMPLES = 2_000
"""Of the blocks: their 2.5 % tail then holds fifty."""
_MANY = 500
"""From so many blocks on the mean of a resample is normal, and is not drawn."""
_WIDEST = 1.5
"""Most that an interval is widened by; chosen by hand: of few blocks the factor is noise itself."""
_SCREEN = 2.0
"""Standard deviations of a correlation that is no more than noise (Politis and White 2004, section
3.2: c = 2 for log base 10).
"""

Pieces = Sequence[np.ndarray]


@dataclass(frozen=True)
class Memory:
    """The memory of a series: how far it remembers.

    Attributes:
        block: length of blocks for a bootstrap of its mean, in samples.
        variance: its long-run variance, n times the variance of its mean.
        effective: number of independent samples whose mean varies as much, at most n.
    """

    block: int
    variance: float
    effective: float


@dataclass(frozen=True)
class Interval:
    """A mean with a 95 % interval, the blocks' length in samples, and their number."""

    mean: float
    low: float
    high: float
    block: int
    blocks: float


def autocovariance(pieces: Pieces, lags: int) -> np.ndarray:
    """Return autocovariances at lags 0 .. `lags`, [lags + 1], about the mean of all pieces.

    Products are within pieces, over the number n of all samples.
    """
    joined = np.concatenate(list(pieces))
    mean, out = joined.mean(), np.zeros(lags + 1)
    for piece in pieces:
        centred = piece - mean
        spectrum = np.abs(np.fft.rfft(centred, 2 * len(centred))) ** 2
        reach = min(lags + 1, len(centred))
        out[:reach] += np.fft.irfft(spectrum, 2 * len(centred))[:reach]
    return out / len(joined)


def memory(pieces: Pieces) -> Memory:
    """Return block length and long-run variance chosen from the data, for fixed blocks.

    Politis and White 2004, Econometric Reviews 23, 53-70; corrected by Patton, Politis and White
    2009, 28, 372-375.

    The flat-top window of the autocovariances R(k) reaches to twice the lag m from which on
    correlations are no more than noise; with g = sum R(k) and G = sum |k| R(k) under it, the block
    is (3 G^2 / (2 g^2) n)^(1/3), at most min(3 sqrt(n), n / 3).
    """
    n = sum(len(piece) for piece in pieces)
    run = max(5, math.ceil(math.sqrt(math.log10(n)))) if n > 1 else 5
    most = math.ceil(math.sqrt(n)) + run
    covariance = autocovariance(pieces, most + run)
    if covariance[0] <= 1e-300:
        return Memory(1, 0.0, float(n))
    noise = np.abs(covariance[1:] / covariance[0]) < _SCREEN * math.sqrt(math.log10(n) / n)
    quiet = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(noise, run).all(axis=1))
    loud = np.flatnonzero(~noise)
    last = int(quiet[0]) if quiet.size else int(loud[-1]) + 1
    reach = min(2 * max(last, 1), most)
    lag = np.arange(1, reach + 1)
    kept = np.minimum(1.0, 2.0 * (1.0 - lag / reach)) * covariance[1 : reach + 1]
    # a window that is flat may sum to less than nothing
    variance = max(float(covariance[0] + 2 * kept.sum()), 0.05 * float(covariance[0]))
    spread = 2 * float((lag * kept).sum())
    longest = max(min(3 * math.sqrt(n), n / 3), 1.0)
    block = math.ceil(min(max((1.5 * spread**2 / variance**2 * n) ** (1 / 3), 1.0), longest))
    return Memory(block, variance, min(n * float(covariance[0]) / variance, float(n)))


def block_interval(pieces: Pieces) -> Interval:
    """Return the mean of all samples with its 95 % interval by a moving-block bootstrap.

    The block length is that of `memory`.

    Percentiles about the mean, at levels widened for few blocks as Student's t is (see
    `residnet.judge.metrics`), and by what blocks of finite length miss: the ratio of the standard
    error from the long-run variance to that of the bootstrap, where it is above one (at most 1.5).
    The interval speaks for more data of the same kind, not for other kinds of manoeuvre.
    """
    found = memory(pieces)
    n = sum(len(piece) for piece in pieces)
    mean = float(np.concatenate(list(pieces)).mean())
    sums, sizes = _blocks(pieces, found.block)
    held = n / float(sizes.mean())
    if found.variance == 0 and n >= 2:
        return Interval(mean, mean, mean, found.block, held)
    if held < 2:
        return Interval(mean, -math.inf, math.inf, found.block, held)
    level, drawn = tail(max(math.floor(held), 2)), math.ceil(held)
    if held > _MANY:
        # of a ratio of sums, by its linear part
        error = float(np.std(sums - sizes * (sums.sum() / sizes.sum())) / sizes.mean()) / math.sqrt(
            held
        )
        low = error * float(scipy.stats.norm.ppf(level))
        high = -low
    else:
        draws = np.random.default_rng(0).integers(0, len(sums), size=(_RESAMPLES, drawn))
        means = sums[draws].sum(axis=1) / sizes[draws].sum(axis=1)
        apart = means - means.mean()
        error = float(apart.std())
        low, high = np.quantile(apart, [level, 1 - level])
    wide = min(max(math.sqrt(found.variance / n) / error, 1.0), _WIDEST) if error > 0 else 1.0
    return Interval(mean, mean + wide * float(low), mean + wide * float(high), found.block, held)


def _blocks(pieces: Pieces, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums and lengths of all blocks of `length` samples; a shorter piece is a block."""
    sums, sizes = [], []
    for piece in pieces:
        size = min(length, len(piece))
        total = np.concatenate(([0.0], np.cumsum(piece)))
        sums.append(total[size:] - total[:-size])
        sizes.append(np.full(len(sums[-1]), float(size)))
    return np.concatenate(sums), np.concatenate(sizes)


def independent_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of the mean as document 000 Listing 9.1 prints it.

    Student's t times the standard error of independent samples.

    The resampling of the listing moves only the centre, by noise (correction E8); here it is the
    mean itself. Far too narrow for correlated values.
    """
    n = len(values)
    half = (
        float(scipy.stats.t.ppf(0.5 + LEVEL / 2, n - 1) * values.std(ddof=1)) / math.sqrt(n)
        if n > 1
        else math.inf
    )
    return float(values.mean()) - half, float(values.mean()) + half


def ljung_box(pieces: Pieces, lags: int) -> tuple[float, float]:
    """Return the statistic of Ljung and Box (1978) and its chance in white noise.

    The statistic is n (n + 2) sum rho_k^2 / (n - k) over lags 1 .. `lags`; the chance is that of a
    larger one.
    """
    n = sum(len(piece) for piece in pieces)
    covariance = autocovariance(pieces, lags)
    if covariance[0] <= 1e-300:
        return 0.0, 1.0
    correlation = covariance[1:] / covariance[0]
    statistic = float(n * (n + 2) * (correlation**2 / (n - np.arange(1, lags + 1))).sum())
    return statistic, float(scipy.stats.chi2.sf(statistic, lags))


SCHEMA = "residnet.goodness/1"
LAGS = 20
"""Lags of the whiteness test."""


@dataclass(frozen=True)
class OneStep:
    """Predicted beside measured accelerations along measured states, stretch by stretch.

    Attributes:
        model: its name.
        kind: zero, baseline, head or ensemble.
        parameters: number of fitted parameters of each axis.
        residuals: measured minus predicted acceleration, [T, n] of each piece.
        reference: name of the model that it is compared with; None for none.
    """

    model: str
    kind: str
    parameters: Sequence[float]
    residuals: Sequence[np.ndarray]
    reference: str | None = None


def measures(
    residual: np.ndarray, target: np.ndarray, parameters: float, variance: float
) -> dict[str, float | None]:
    """Return RMSE (9.11), R^2 (9.15), adjusted R^2 (9.16), C_p (9.12), AIC (9.13), BIC (9.14).

    Sums of squares stand in the place of means.

    Args:
        residual: measured minus predicted, [m].
        target: measured, [m].
        variance: of the noise, sigma^2, by `noise_variance` of the richest model that is compared:
            from each model's own the criteria tell nothing apart.

    Returns:
        rmse, r2, r2_adjusted, cp, aic, bic; None where the target does not vary, the noise
        vanishes, or m does not exceed d + 1.
    """
    m, rss = len(residual), float(residual @ residual)
    total = float(((target - target.mean()) ** 2).sum())
    r2 = 1 - rss / total if total > 0 else None
    noisy = variance > 0
    return {
        "rmse": math.sqrt(rss / m),
        "r2": r2,
        "r2_adjusted": (
            1 - (1 - r2) * (m - 1) / (m - parameters - 1)
            if r2 is not None and m > parameters + 1
            else None
        ),
        "cp": (rss + 2 * parameters * variance) / m,
        "aic": (rss + 2 * parameters * variance) / (m * variance) if noisy else None,
        "bic": (rss + math.log(m) * parameters * variance) / (m * variance) if noisy else None,
    }


def noise_variance(residual: np.ndarray, parameters: float) -> float:
    """Return sigma^2 = RSS / (m - d - 1) (9.17, correction E1).

    Infinite where there are no more samples than that.
    """
    left = len(residual) - parameters - 1
    return float(residual @ residual) / left if left > 0 else math.inf


def table(
    models: Sequence[OneStep],
    targets: Sequence[np.ndarray],
    step: float,
    axes: Iterable[tuple[int, str]] = tuple(enumerate(ACCELERATION)),
) -> list[dict[str, Any]]:
    """Return a row for each model and axis.

    Args:
        models: one-step residuals over the same pieces.
        targets: measured accelerations, [T, n] of each piece.
        step: time between samples, s.
        axes: number and name of each acceleration that is looked at.
    """
    by_name = {model.model: model for model in models}
    out = []
    for axis, name in axes:
        target = np.concatenate([piece[:, axis] for piece in targets])
        series = {model.model: [piece[:, axis] for piece in model.residuals] for model in models}
        joined = {key: np.concatenate(pieces) for key, pieces in series.items()}
        variance = min(
            noise_variance(joined[model.model], model.parameters[axis]) for model in models
        )
        for model in models:
            row = {
                "model": model.model,
                "kind": model.kind,
                "axis": name,
                "samples": len(target),
                "parameters": float(model.parameters[axis]),
            }
            row |= measures(
                joined[model.model],
                target,
                model.parameters[axis],
                variance if math.isfinite(variance) else 0.0,
            )
            row |= _series(series[model.model], step)
            if model.reference in by_name:
                row["difference"] = paired(
                    series[model.model], series[str(model.reference)], str(model.reference)
                )
            out.append(row)
    return out


def _series(pieces: Sequence[np.ndarray], step: float) -> dict[str, Any]:
    """Mean absolute residual with both intervals, and what the residuals remember."""
    sizes = [np.abs(piece) for piece in pieces]
    level = block_interval(sizes)
    lags = min(LAGS, max(sum(map(len, pieces)) // 5, 1))
    covariance = autocovariance(pieces, lags)
    statistic, chance = ljung_box(pieces, lags)
    offset = block_interval(pieces)
    return {
        "mae": level.mean,
        "mae_ci95": _bounds(level.low, level.high),
        "mae_ci95_independent": _bounds(*independent_interval(np.concatenate(sizes))),
        "block_seconds": level.block * step,
        "mean": offset.mean,
        "mean_ci95": _bounds(offset.low, offset.high),
        "effective": memory(pieces).effective,
        "autocorrelation": (
            (covariance[1:] / covariance[0]).tolist() if covariance[0] > 0 else [0.0] * lags
        ),
        "ljung_box": statistic,
        "white_p": chance,
    }


def paired(
    pieces: Sequence[np.ndarray], reference: Sequence[np.ndarray], to: str
) -> dict[str, Any]:
    """Return the difference of two models' mean absolute residuals, with its interval.

    Over the same samples, by blocks; negative where the model is better.

    Args:
        pieces: residuals of the model, piece by piece.
        reference: residuals of the other at the same samples.
    """
    found = block_interval([np.abs(a) - np.abs(b) for a, b in zip(pieces, reference, strict=True)])
    level = float(np.abs(np.concatenate(list(reference))).mean())
    bounds = _bounds(found.low, found.high)
    return {
        "to": to,
        "mae": found.mean,
        "ci95": bounds,
        "excludes_zero": bounds is not None and (bounds[0] > 0 or bounds[1] < 0),
        "ratio": (level + found.mean) / level if level > 0 else None,
    }


def _bounds(low: float, high: float) -> list[float] | None:
    return [low, high] if math.isfinite(low) and math.isfinite(high) else None


def content(run: str, splits: Mapping[str, list[dict[str, Any]]], step: float) -> dict[str, Any]:
    """Return the contents of goodness.json."""
    return {"schema": SCHEMA, "run": run, "lags": LAGS, "step": step, "splits": dict(splits)}
