"""Errors of free runs: rows of metrics.json, their intervals, and the limits of a model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from residnet.core.layout import HEADING, POSE, VELOCITIES
from residnet.core.names import VELOCITY
from residnet.data.prepare import Prepared
from residnet.judge.bands import count_bands
from residnet.judge.freerun import Candidate, Errors, FreeRun, integrate
from residnet.judge.verdict import diverged_note

if TYPE_CHECKING:
    import pandas as pd


_LEVEL = 0.95
_RESAMPLES = 10_000
_LOGS = 5
_FEW_LOGS = 3
_LEAST_BLOCKS = 5
_WANTED_BLOCKS = 8


@dataclass(frozen=True)
class Blocks:
    """What is drawn together.

    Attributes:
        labels: number of each window's block, [W], from 0 on.
        of: `logs` where a block is all windows of a log, else `windows`: consecutive windows of one
            log.
        count: number of blocks.
    """

    labels: np.ndarray
    of: str
    count: int

    def row(self) -> dict[str, Any]:
        """Return the blocks as they stand in metrics.json."""
        return {"of": self.of, "count": self.count}


def blocks(logs: Sequence[int] | np.ndarray) -> Blocks | None:
    """Return blocks of windows from the number of the log that each comes from.

    Windows of a log are in time order.

    From five logs on a block is a log: the interval then speaks for other logs, whatever the
    windows of one have in common. Of three or four logs the mean cannot be resampled so; each is
    cut into as few equal runs of consecutive windows as make at least eight blocks, and the
    interval holds only as far as what lies between logs is small against what lies between such
    runs. None, and so no interval, where there are fewer than three logs or five blocks.
    """
    numbers = np.asarray(logs, dtype=int)
    names, sizes = np.unique(numbers, return_counts=True)
    if len(names) >= _LOGS:
        return Blocks(np.searchsorted(names, numbers), "logs", len(names))
    if len(names) < _FEW_LOGS:
        return None
    length = int(sizes.max())
    while length > 1 and sum(math.ceil(size / length) for size in sizes) < _WANTED_BLOCKS:
        length -= 1
    labels, count = np.zeros(len(numbers), dtype=int), 0
    for name, size in zip(names, sizes, strict=True):
        for run in np.array_split(np.flatnonzero(numbers == name), math.ceil(size / length)):
            labels[run] = count
            count += 1
    return Blocks(labels, "windows", count) if count >= _LEAST_BLOCKS else None


def intervals(values: np.ndarray, blocks: Blocks | None) -> list[list[float] | None]:
    """Return 95 % intervals of the means of columns [W, C] over windows, [low, high] of each.

    None where there are no blocks.

    Percentile bootstrap over blocks drawn with replacement, with a fixed seed, at levels widened
    for few blocks as Student's t is against the normal distribution (Hesterberg 2015, The American
    Statistician 69, 371-386, section 5.3): plain percentiles cover some 83 % with five blocks.
    """
    if blocks is None:
        return [None] * values.shape[1]
    sums = np.stack(
        [np.bincount(blocks.labels, column, blocks.count) for column in values.T], axis=1
    )
    draws = _draws(blocks.count)
    means = (draws @ sums) / (draws @ np.bincount(blocks.labels, minlength=blocks.count))[:, None]
    low = tail(blocks.count)
    return [
        [float(lower), float(upper)]
        for lower, upper in np.quantile(means, [low, 1 - low], axis=0).T
    ]


def tail(count: int) -> float:
    """Return the share of resampled means left out at either end, for at least 2 blocks.

    It is 0.025 for many blocks and less for few.
    """
    wide = math.sqrt(count / (count - 1)) * scipy.stats.t.ppf(0.5 + _LEVEL / 2, count - 1)
    return float(scipy.stats.norm.cdf(-wide))


@lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """How often each block is drawn, [resamples, count]."""
    return (
        np.random.default_rng(0)
        .multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
        .astype(float)
    )


def difference(
    model: np.ndarray, reference: np.ndarray, to: str, blocks: Blocks | None
) -> dict[str, Any]:
    """Return the paired difference of two models' mean errors, as in metrics.json.

    Both are over the same windows.

    Args:
        model: error of each window, [W].
        reference: error of the reference model over the same windows, [W].
        to: its name.
        blocks: what is drawn together.

    Returns:
        to; nrmse_mean, the mean of model minus reference (negative where the model is better), with
        its interval ci95 (None where there is none) and excludes_zero; ratio of the means (None
        where the reference has no error) and worse, a ratio above 1.05.
    """
    apart = model - reference
    (interval,) = intervals(apart[:, None], blocks)
    level = float(reference.mean())
    ratio = float(model.mean()) / level if level > 0 else None
    return {
        "to": to,
        "nrmse_mean": float(apart.mean()),
        "ci95": interval,
        "excludes_zero": interval is not None and (interval[0] > 0 or interval[1] < 0),
        "ratio": ratio,
        "worse": ratio is not None and ratio > 1.05,
    }


SCHEMA = "residnet.metrics/1"


def window_errors(run: FreeRun, model: str, logs: Sequence[Prepared]) -> dict[str, np.ndarray]:
    """Return the errors of one model by window.

    rmse and mae [W, 3] of (u, v, r), position_error_end and heading_error_end [W], samples [W].
    """
    found = Errors.of(run.windows, run.predictions[model], logs)
    last = found.error[found.begins + found.counts - 1]
    return {
        "rmse": found.rmse,
        "mae": found.mean(np.abs(found.velocities)),
        "position_error_end": np.hypot(last[:, 0], last[:, 1]),
        "heading_error_end": np.abs(last[:, HEADING]),
        "samples": np.add.reduceat(found.usable.astype(int), found.begins),
    }


def rows(
    run: FreeRun,
    candidates: Sequence[Candidate],
    logs: Sequence[Prepared],
    scales: Mapping[str, float],
    groups: Mapping[str, Sequence[str]],
) -> list[dict[str, Any]]:
    """Return the rows of metrics.json for one protocol and split.

    Every model, over all windows, every kind of manoeuvre and every named group of kinds.

    `difference` compares a model with its reference (`Candidate.reference`) over the same windows;
    None where it has none. Models with a band have its coverage and interval score, too.

    Args:
        run: free runs of all models.
        candidates: the models.
        logs: that the windows belong to.
        scales: what nrmse divides by.
        groups: named sets of kinds of manoeuvre.
    """
    kinds = [logs[window.log].log.manoeuvre for window in run.windows]
    subsets = (
        {"all": sorted(set(kinds))}
        | {kind: [kind] for kind in sorted(set(kinds))}
        | {name: list(members) for name, members in groups.items()}
    )
    errors = {candidate.name: window_errors(run, candidate.name, logs) for candidate in candidates}
    banded = count_bands(run, candidates, logs)
    out = []
    for candidate in candidates:
        diverged = np.array([prediction.diverged for prediction in run.predictions[candidate.name]])
        for name, members in subsets.items():
            chosen = np.array([kind in members for kind in kinds])
            if chosen.any():
                row: dict[str, Any] = {
                    "model": candidate.name,
                    "kind": candidate.kind,
                    "split": run.split,
                    "protocol": run.protocol,
                    "manoeuvre": name,
                }
                part = {key: values[chosen] for key, values in errors[candidate.name].items()}
                drawn = blocks(
                    [window.log for window, taken in zip(run.windows, chosen, strict=True) if taken]
                )
                row |= _summary(part, int(diverged[chosen].sum()), scales, drawn)
                row["difference"] = against(errors, candidate, scales, chosen, drawn)
                if candidate.name in banded:
                    row |= banded[candidate.name].row(chosen)
                out.append(row)
    return out


def nrmse_of_windows(errors: Mapping[str, np.ndarray], scales: Mapping[str, float]) -> np.ndarray:
    """Return the mean over u, v, r of rmse / scale for each window, [W]."""
    return np.asarray((errors["rmse"] / np.array([scales[name] for name in VELOCITY])).mean(1))


def against(
    errors: Mapping[str, Mapping[str, np.ndarray]],
    candidate: Candidate,
    scales: Mapping[str, float],
    chosen: np.ndarray,
    drawn: Blocks | None,
) -> dict[str, Any] | None:
    """Return the paired difference of a model to its reference over chosen windows [W] bool.

    None where it has none among the models.
    """
    if candidate.reference is None or candidate.reference not in errors:
        return None
    own, other = (
        nrmse_of_windows(errors[name], scales)[chosen]
        for name in (candidate.name, candidate.reference)
    )
    return difference(own, other, candidate.reference, drawn)


def _summary(
    errors: Mapping[str, np.ndarray],
    diverged: int,
    scales: Mapping[str, float],
    drawn: Blocks | None,
) -> dict[str, Any]:
    divisor = np.array([scales[name] for name in VELOCITY])
    rmse, mae = errors["rmse"].mean(0), errors["mae"].mean(0)
    nrmse = rmse / divisor
    spread = intervals(
        np.concatenate((errors["rmse"], nrmse_of_windows(errors, scales)[:, None]), axis=1), drawn
    )

    def named(values: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(VELOCITY, values, strict=True)}

    return {
        "windows": int(errors["samples"].size),
        "n": int(errors["samples"].sum()),
        "diverged": diverged,
        "rmse": named(rmse),
        "mae": named(mae),
        "nrmse": named(nrmse) | {"mean": float(nrmse.mean())},
        "rmse_ci95": {name: spread[i] for i, name in enumerate(VELOCITY)},
        "nrmse_mean_ci95": spread[3],
        "ci95_blocks": drawn.row() if drawn is not None else None,
        "position_error_end": float(errors["position_error_end"].mean()),
        "heading_error_end": float(errors["heading_error_end"].mean()),
    }


def find(table: Sequence[Mapping[str, Any]], **wanted: str) -> Mapping[str, Any]:
    """Return the one row of a model, split, protocol and manoeuvre (`all` where not given)."""
    keys = {"manoeuvre": "all"} | wanted
    found = [row for row in table if all(row[key] == value for key, value in keys.items())]
    if len(found) != 1:
        raise KeyError(f"{len(found)} rows with {keys}")
    return found[0]


ZERO = "zero"
_PARTS = 8
_MOST_BANDS = 3
_OF_A_BAND = 5
"""Windows that a band of speeds has where there are so many: fewer logs have no interval."""
_LEAST = 3


def compared(
    run: FreeRun,
    candidates: Sequence[Candidate],
    scales: Mapping[str, float],
    errors: Mapping[str, Mapping[str, np.ndarray]],
) -> dict[str, dict[str, Any]]:
    """Return each model's paired differences to `zero` and to the first baseline.

    Args:
        run: free runs of one protocol.
        candidates: the models.
        scales: of u, v, r.
        errors: of each model by window, see `residnet.judge.metrics.window_errors`.

    Returns:
        By model, then by the name of what it is compared with: a difference as in metrics.json.
    """
    drawn = blocks([window.log for window in run.windows])
    by_window = {
        candidate.name: nrmse_of_windows(errors[candidate.name], scales) for candidate in candidates
    }
    others = [ZERO] if ZERO in by_window else []
    others += [candidate.name for candidate in candidates if candidate.kind == "baseline"][:1]
    return {
        name: {
            other: difference(own, by_window[other], other, drawn)
            for other in others
            if other != name
        }
        for name, own in by_window.items()
    }


def outside(
    run: FreeRun, candidates: Sequence[Candidate], logs: Sequence[Prepared]
) -> dict[str, Any]:
    """Return how much of the windows lies outside the range of the training data.

    Returns:
        `share` of the usable samples with a velocity or an input outside its range, and `channels`:
        the share of each channel that is; empty where no model says its ranges.
    """
    ranges = next((candidate.ranges for candidate in candidates if candidate.ranges), {})
    if not ranges:
        return {}
    rows = [(logs[window.log], slice(window.start, window.stop)) for window in run.windows]
    values = np.concatenate(
        [
            np.concatenate((log.y[part, VELOCITIES], log.w[part]), axis=1)[log.usable[part]]
            for log, part in rows
        ]
    )
    low, high = np.array(list(ranges.values())).T
    beyond = (values < low) | (values > high)
    shares = beyond.mean(0)
    return {
        "share": float(beyond.any(1).mean()),
        "channels": {
            name: float(share) for name, share in zip(ranges, shares, strict=True) if share > 0
        },
    }


def trust(
    run: FreeRun,
    candidates: Sequence[Candidate],
    logs: Sequence[Prepared],
    scales: Mapping[str, float],
    step: float,
) -> dict[str, dict[str, Any]]:
    """Return by model at which horizons and speeds its errors are smaller than those of `zero`.

    Returns:
        By model `horizons` and `speeds`, each a list of entries with `low` and `high` (s after the
        start, or m/s), `windows`, and `difference` to `zero` as in metrics.json. Horizons are
        eighths of the longest window, speeds up to three equal parts of the windows by mean speed.
        Parts of fewer than three windows are left out.
    """
    if ZERO not in run.predictions:
        return {}
    scale = np.array([scales[name] for name in VELOCITY])
    longest = max(window.stop - window.start for window in run.windows)
    edges = np.unique(np.linspace(1, longest, _PARTS + 1).round().astype(int))
    speeds = np.array(
        [
            np.hypot(*logs[w.log].y[w.start : w.stop, VELOCITIES][:, :2].T).mean()
            for w in run.windows
        ]
    )
    numbers = np.array([window.log for window in run.windows])
    by_part = {
        candidate.name: _by_part(run, candidate.name, logs, scale, edges)
        for candidate in candidates
    }
    whole = {name: np.nanmean(values, axis=1) for name, values in by_part.items()}
    out = {}
    for candidate in candidates:
        if candidate.name == ZERO:
            continue
        own, zero = by_part[candidate.name], by_part[ZERO]
        horizons = []
        for part, (begin, end) in enumerate(pairwise(edges.tolist())):
            there = np.isfinite(own[:, part])
            entry = _entry(own[:, part], zero[:, part], numbers, there)
            horizons += [{"low": begin * step, "high": end * step, **e} for e in entry]
        bands = []
        for there in _bands(speeds):
            entry = _entry(whole[candidate.name], whole[ZERO], numbers, there)
            low, high = float(speeds[there].min()), float(speeds[there].max())
            bands += [{"low": low, "high": high, **e} for e in entry]
        out[candidate.name] = {"horizons": horizons, "speeds": bands}
    return out


def _entry(
    own: np.ndarray, zero: np.ndarray, numbers: np.ndarray, there: np.ndarray
) -> list[dict[str, Any]]:
    """The difference over the windows that are there [W] bool; empty where there are too few."""
    if there.sum() < min(_LEAST, len(there)):
        return []
    drawn = blocks(numbers[there])
    return [
        {
            "windows": int(there.sum()),
            "difference": difference(own[there], zero[there], ZERO, drawn),
        }
    ]


def _by_part(
    run: FreeRun, model: str, logs: Sequence[Prepared], scale: np.ndarray, edges: np.ndarray
) -> np.ndarray:
    """Normalised root mean square errors by window and part of its time, [W, parts]; NaN where a
    window does not reach so far or has no usable sample there.
    """
    found, parts = Errors.of(run.windows, run.predictions[model], logs), len(edges) - 1
    part = np.searchsorted(edges, found.place, side="right") - 1
    there = (part >= 0) & (part < parts)
    bins = (np.repeat(np.arange(len(run.windows)), found.counts) * parts + part)[there]

    def sums(values: np.ndarray) -> np.ndarray:
        size = len(run.windows) * parts
        return np.stack([np.bincount(bins, column[there], size) for column in values.T], axis=1)

    count = sums(found.scored.astype(float))
    with np.errstate(divide="ignore", invalid="ignore"):
        out = (np.sqrt(sums(found.velocities**2) / count) / scale).mean(1)
    out[count[:, 0] == 0] = np.nan
    out = out.reshape(-1, parts)
    out[edges[1:] > found.counts[:, None]] = np.nan
    return np.asarray(out)


def _bands(values: np.ndarray) -> list[np.ndarray]:
    """[W] bool of each band that has a window, lowest first; equal values stay together."""
    count = min(max(len(values) // _OF_A_BAND, 1), _MOST_BANDS)
    edges = np.quantile(values, np.arange(1, count) / count)
    place = np.searchsorted(edges, values, side="left")
    return [place == band for band in range(count) if (place == band).any()]


LIMITS_SCHEMA = "residnet.limits/1"
_WORST = 3
_BANDS = 3
_LEAST_WINDOWS = 3
_WIND = "wind_speed"


def limits(
    run: FreeRun,
    candidates: Sequence[Candidate],
    logs: Sequence[Prepared],
    scales: Mapping[str, float],
    step: float,
) -> dict[str, Any]:
    """Return the part of limits.json for one protocol and split.

    It holds `kinematics`, `bands`, `worst`, `compared`, `outside` and `trust`.
    """
    errors = {candidate.name: window_errors(run, candidate.name, logs) for candidate in candidates}
    return {
        "kinematics": kinematics(run, logs, step),
        "bands": bands(run, candidates, logs, scales, errors),
        "worst": {
            name: worst(run, logs, nrmse_of_windows(part, scales), part)
            for name, part in errors.items()
        },
        "compared": compared(run, candidates, scales, errors),
        "outside": outside(run, candidates, logs),
        "trust": trust(run, candidates, logs, scales, step),
    }


def kinematics(run: FreeRun, logs: Sequence[Prepared], step: float) -> dict[str, float]:
    """Return how far integrated measured velocities end from the measured pose.

    They are integrated over each window from its measured pose, as predictions are.

    Returns:
        windows; position_mean, position_rms in m and heading_mean, heading_rms in rad at the ends
        of windows. A model that predicted the measured velocities exactly would have these errors.
    """
    apart = []
    for window in run.windows:
        y = logs[window.log].y[window.start : window.stop]
        apart.append(integrate(y[0, POSE], y[:, VELOCITIES], step)[-1] - y[-1, POSE])
    error = np.array(apart)
    position, heading = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    return {
        "windows": len(error),
        "position_mean": float(position.mean()),
        "position_rms": float(np.sqrt(np.mean(position**2))),
        "heading_mean": float(heading.mean()),
        "heading_rms": float(np.sqrt(np.mean(heading**2))),
    }


def bands(
    run: FreeRun,
    candidates: Sequence[Candidate],
    logs: Sequence[Prepared],
    scales: Mapping[str, float],
    errors: Mapping[str, Mapping[str, np.ndarray]],
) -> list[dict[str, Any]]:
    """Return errors by thirds of the windows in mean speed and in mean true wind speed.

    The wind only where every log has it.

    A band of fewer than three windows is left out, and so is a quantity of which one band remains.
    Each entry: `by` (speed or wind), `low` and `high` in m/s (extremes of the windows' means),
    `windows`, and by model `nrmse_mean` and `difference` as in metrics.json.
    """
    parts = [(logs[window.log], slice(window.start, window.stop)) for window in run.windows]
    quantities = {
        "speed": np.array([np.hypot(log.y[rows, 3], log.y[rows, 4]).mean() for log, rows in parts])
    }
    if all(_WIND in log.log.channels for log, _ in parts):
        quantities["wind"] = np.array([log.log[_WIND][rows].mean() for log, rows in parts])
    out = []
    for name, values in quantities.items():
        if not np.isfinite(values).all():
            continue
        thirds = [chosen for chosen in _bands_limits(values) if chosen.sum() >= _LEAST_WINDOWS]
        for chosen in thirds if len(thirds) > 1 else ():
            drawn = blocks(
                [window.log for window, taken in zip(run.windows, chosen, strict=True) if taken]
            )
            models = {
                candidate.name: {
                    "nrmse_mean": float(
                        nrmse_of_windows(errors[candidate.name], scales)[chosen].mean()
                    ),
                    "difference": against(errors, candidate, scales, chosen, drawn),
                }
                for candidate in candidates
            }
            low, high = float(values[chosen].min()), float(values[chosen].max())
            out.append(
                {
                    "by": name,
                    "low": low,
                    "high": high,
                    "windows": int(chosen.sum()),
                    "models": models,
                }
            )
    return out


def _bands_limits(values: np.ndarray) -> list[np.ndarray]:
    """[W] bool of each third, lowest first; equal values stay together."""
    edges = np.quantile(values, np.arange(1, _BANDS) / _BANDS)
    place = np.searchsorted(edges, values, side="left")
    return [place == band for band in range(_BANDS)]


def worst(
    run: FreeRun, logs: Sequence[Prepared], nrmse: np.ndarray, errors: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Return the three windows with the largest nrmse [W].

    Each with log, manoeuvre, t (start, the log's clock, s), nrmse, rmse and position_error_end.
    """
    out = []
    for i in np.argsort(-nrmse, kind="stable")[:_WORST].tolist():
        log = logs[run.windows[i].log]
        rmse = dict(zip(("u", "v", "r"), errors["rmse"][i].tolist(), strict=True))
        start = float(log.log.t[run.windows[i].start])
        end = float(errors["position_error_end"][i])
        out.append(
            {
                "log": log.log.name,
                "manoeuvre": log.log.manoeuvre,
                "t": start,
                "nrmse": float(nrmse[i]),
                "rmse": rmse,
                "position_error_end": end,
            }
        )
    return out


_LABELS = ("model", "kind", "split", "protocol", "manoeuvre", "selected")
_COUNTS = ("windows", "diverged", "n")
_BY_CHANNEL = ("rmse", "mae", "nrmse")
_ENDS = ("position_error_end", "heading_error_end")


def metrics_content(
    run: str,
    units: Mapping[str, str],
    scales: Mapping[str, float],
    selected: str,
    selected_ensemble: str | None,
    rows: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the contents of metrics.json.

    Args:
        run: name of the run.
        units: unit of each state.
        scales: what nrmse divides by.
        selected: name of the single model that the validation data chose.
        selected_ensemble: name of the best ensemble; None where there is none.
        rows: of all splits, without `selected`.
    """
    marked = [{**row, "selected": row["model"] == selected} for row in rows]
    return {
        "schema": SCHEMA,
        "run": run,
        "channels": dict(units),
        "scales": dict(scales),
        "selected": selected,
        "selected_ensemble": selected_ensemble,
        "rows": marked,
    }


def metrics_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of metrics.json as a table with one column per number.

    Args:
        rows: of metrics.json, as `evaluate` or the file gives them.

    Returns:
        Columns model, kind, split, protocol, manoeuvre (and selected where the rows have it),
        windows, diverged, n, then rmse_u, rmse_v, rmse_r (m/s, m/s, rad/s), the same for mae and
        nrmse with nrmse_mean, note (such as "2/12 diverged", where such windows count with the
        error of `zero`), and position_error_end (m), heading_error_end (rad).
    """
    import pandas as pd

    return pd.DataFrame([_flat(row) for row in rows])


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    out = {name: row[name] for name in (*_LABELS, *_COUNTS) if name in row}
    for name in _BY_CHANNEL:
        out |= {f"{name}_{channel}": value for channel, value in row[name].items()}
    # beside the score, since the diverged windows in it are no errors of the model
    out["note"] = diverged_note(row)
    return out | {name: row[name] for name in _ENDS}
