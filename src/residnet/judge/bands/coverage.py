"""How bands fared over free runs: rows of metrics.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from residnet.core.layout import HEADING, POSITION, VELOCITIES
from residnet.data.prepare import Prepared
from residnet.judge.bands.band import Band, interval_score, worst
from residnet.judge.bands.channels import CHANNELS
from residnet.judge.bands.errors import run_errors
from residnet.judge.freerun import Candidate, FreeRun

_FITTED = ("baseline", "head")
"""Kinds of the models whose spread is compared with the bands."""


@dataclass(frozen=True)
class BandCounts:
    """Sums over the scored samples of each of W windows, by channel [W, 5].

    Attributes:
        scored: number of samples.
        inside: how many of them the band holds.
        whole: 1 where the band of whole runs holds the window, NaN where nothing is scored.
        score: sum of the interval scores, in the units of the band.
        constant: the same of a band of one width.
        spread: the same of the spread of the run's models; None where there are too few.
    """

    scored: np.ndarray
    inside: np.ndarray
    whole: np.ndarray
    score: np.ndarray
    constant: np.ndarray
    spread: np.ndarray | None

    def row(self, chosen: np.ndarray) -> dict[str, Any]:
        """Return what a row of metrics.json says of chosen windows [W] bool."""
        count = self.scored[chosen].sum(axis=0)
        seen = count > 0

        def mean(sums: np.ndarray) -> np.ndarray:
            return np.asarray(sums[chosen].sum(axis=0)[seen] / count[seen])

        inside = mean(self.inside)
        names = [name for name, known in zip(CHANNELS, seen, strict=True) if known]
        return {
            "band_coverage": {
                **dict(zip(names, map(float, inside), strict=True)),
                "mean": float(inside.mean()),
                "whole": float(np.nanmean(self.whole[chosen])),
            },
            "band_score": float(mean(self.score).mean()),
            "band_score_constant": float(mean(self.constant).mean()),
            "band_score_spread": None if self.spread is None else float(mean(self.spread).mean()),
        }


def count_bands(
    run: FreeRun, candidates: Sequence[Candidate], logs: Sequence[Prepared]
) -> dict[str, BandCounts]:
    """Return how the bands fared over the windows of one protocol, by model.

    Args:
        run: free runs of all models.
        candidates: the models; those without a band under this protocol are left out.
        logs: that the windows belong to.
    """
    fitted = [c.name for c in candidates if c.kind in _FITTED]
    spreads = _spreads(run, fitted) if len(fitted) > 1 else None
    return {
        candidate.name: _counted(run, candidate.name, logs, candidate.bands[run.protocol], spreads)
        for candidate in candidates
        if run.protocol in candidate.bands
    }


def _counted(
    run: FreeRun,
    model: str,
    logs: Sequence[Prepared],
    band: Band,
    spreads: Sequence[np.ndarray] | None,
) -> BandCounts:
    runs = run_errors(run.windows, run.predictions[model], logs)
    errors = [own.error for own in runs]
    widths = [band.half_widths(own.states) for own in runs]
    largest = worst(errors, widths)

    def scores(given: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack(
            [
                np.nansum(interval_score(error, width, band.level), axis=0) / band.unit
                for error, width in zip(errors, given, strict=True)
            ]
        )

    spread = None
    if spreads is not None:
        normal, radial = _reach(band.level)
        reach = np.array([normal] * 4 + [radial])
        spread = scores([reach * own for own in spreads])
    return BandCounts(
        np.stack([np.isfinite(error).sum(axis=0) for error in errors]),
        np.stack(
            [(error <= width).sum(axis=0) for error, width in zip(errors, widths, strict=True)]
        ),
        np.where(np.isnan(largest), np.nan, largest <= band.whole),
        scores(widths),
        scores([np.broadcast_to(band.constant, error.shape) for error in errors]),
        spread,
    )


def _reach(level: float) -> tuple[float, float]:
    """Return the standard deviations that hold normal errors at a level, of one axis and of two."""
    return NormalDist().inv_cdf(0.5 + level / 2.0), float(np.sqrt(-2.0 * np.log(1.0 - level)))


def _spreads(run: FreeRun, models: Sequence[str]) -> list[np.ndarray]:
    """Return the standard deviation [L, 5] between models along each window.

    That of the position is per axis, mean over both.
    """
    out = []
    for i in range(len(run.windows)):
        states = np.stack([run.predictions[model][i].states[1:] for model in models])
        spread = states.std(axis=0, ddof=1)
        position = np.sqrt(0.5 * (spread[:, POSITION] ** 2).sum(axis=1))
        out.append(np.column_stack((spread[:, VELOCITIES], spread[:, HEADING], position)))
    return out


def limits(states: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits [L + 1, 6] of predicted states [L + 1, 6].

    The initial state is given, and has no width. Limits of x and y are those of the box about the
    circle that holds the position.

    Args:
        states: predicted x, y, psi, u, v, r, from the initial state on.
        width: half widths [L, 5] after it.
    """
    reach = np.zeros_like(states)
    reach[1:, VELOCITIES] = width[:, :3]
    reach[1:, HEADING] = width[:, 3]
    reach[1:, POSITION] = width[:, 4:5]
    return states - reach, states + reach
