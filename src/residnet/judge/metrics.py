"""The one metrics table: rows of metrics.json from free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.layout import HEADING, SURGE, SWAY, YAW_RATE
from residnet.core.names import VELOCITY
from residnet.data.prepare import Prepared
from residnet.judge.bands.coverage import count_bands
from residnet.judge.bootstrap import Blocks, blocks, difference, intervals
from residnet.judge.freerun import Candidate, FreeRun

SCHEMA = "residnet.metrics/1"


def window_errors(run: FreeRun, model: str, logs: Sequence[Prepared]) -> dict[str, np.ndarray]:
    """Return the errors of one model by window.

    rmse and mae [W, 3] of (u, v, r), position_error_end and heading_error_end [W], samples [W].

    u and v are scored over usable samples; r, which no position sensor disturbs, over all.
    """
    rmse, mae, position, heading, count = [], [], [], [], []
    for window, prediction in zip(run.windows, run.predictions[model], strict=True):
        log = logs[window.log]
        measured = log.y[window.start : window.stop]
        good = log.usable[window.start : window.stop]
        error = prediction.states - measured
        parts = (error[good, SURGE], error[good, SWAY], error[:, YAW_RATE])
        rmse.append([float(np.sqrt(np.mean(e**2))) for e in parts])
        mae.append([float(np.mean(np.abs(e))) for e in parts])
        position.append(float(np.hypot(error[-1, 0], error[-1, 1])))
        heading.append(float(abs(error[-1, HEADING])))
        count.append(int(good.sum()))
    return {
        "rmse": np.array(rmse),
        "mae": np.array(mae),
        "position_error_end": np.array(position),
        "heading_error_end": np.array(heading),
        "samples": np.array(count),
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
