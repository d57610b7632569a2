"""Limits of a model: errors by speed and wind, worst windows, consistency of the channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.layout import POSE, VELOCITIES
from residnet.data.prepare import Prepared
from residnet.judge.bootstrap import blocks
from residnet.judge.freerun import Candidate, FreeRun, integrate
from residnet.judge.metrics import against, nrmse_of_windows, window_errors
from residnet.judge.verdict.trust import compared, outside, trust

SCHEMA = "residnet.limits/1"
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
        thirds = [chosen for chosen in _bands(values) if chosen.sum() >= _LEAST_WINDOWS]
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


def _bands(values: np.ndarray) -> list[np.ndarray]:
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
