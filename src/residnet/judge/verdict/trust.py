"""How far a model can be trusted: against `zero` and the baseline, by horizon, by speed.

The criterion is that the errors of a model are smaller than those of `zero`, which holds the
velocities that it starts from, and that the 95 % interval of the paired difference says so too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from residnet.core.layout import VELOCITIES, YAW_RATE
from residnet.core.names import VELOCITY
from residnet.data.prepare import Prepared
from residnet.judge.bootstrap import blocks, difference
from residnet.judge.freerun import Candidate, FreeRun
from residnet.judge.metrics import nrmse_of_windows

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
    out = np.full((len(run.windows), len(edges) - 1), np.nan)
    for row, (window, prediction) in enumerate(
        zip(run.windows, run.predictions[model], strict=True)
    ):
        log, rows = logs[window.log], slice(window.start, window.stop)
        square = (prediction.states - log.y[rows])[:, VELOCITIES] ** 2
        square[~log.usable[rows], : YAW_RATE - VELOCITIES.start] = np.nan
        for part, (begin, end) in enumerate(pairwise(edges.tolist())):
            if end <= len(square) and log.usable[rows][begin:end].any():
                rmse = np.sqrt(np.nanmean(square[begin:end], axis=0))
                out[row, part] = (rmse / scale).mean()
    return out


def _bands(values: np.ndarray) -> list[np.ndarray]:
    """[W] bool of each band that has a window, lowest first; equal values stay together."""
    count = min(max(len(values) // _OF_A_BAND, 1), _MOST_BANDS)
    edges = np.quantile(values, np.arange(1, count) / count)
    place = np.searchsorted(edges, values, side="left")
    return [place == band for band in range(count) if (place == band).any()]
