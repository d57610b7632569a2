"""Goodness of fit of one-step predictions, by model and axis (document 000 appendix E).

As corrected in corrections E1 to E9.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core.names import ACCELERATION
from residnet.judge.residual_series import (
    autocovariance,
    block_interval,
    independent_interval,
    ljung_box,
    memory,
)

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
        residuals: measured minus predicted acceleration, [T, 3] of each piece.
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
        parameters: number of parameters d.
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
    models: Sequence[OneStep], targets: Sequence[np.ndarray], step: float
) -> list[dict[str, Any]]:
    """Return a row for each model and axis.

    Args:
        models: one-step residuals over the same pieces.
        targets: measured accelerations, [T, 3] of each piece.
        step: time between samples, s.
    """
    by_name = {model.model: model for model in models}
    out = []
    for axis, name in enumerate(ACCELERATION):
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
        to: its name.
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
