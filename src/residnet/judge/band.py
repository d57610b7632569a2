"""Bands: how far the free runs of a model may be off, against the horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.layout import BESIDE, HEADING, MOVING, PLANAR, VELOCITIES
from residnet.dynamics.store import BandTable


def by_channel(states: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return what has bands [L, 2 + n] of states [L, 3 + n], with the radius [L] of position."""
    moving, heading = states[:, VELOCITIES], states[:, HEADING]
    return np.column_stack((moving, heading, position, states[:, BESIDE]))


class BandsConfig(Config):
    """Settings of the bands of free runs.

    A band is calibrated on logs that its model was not fitted on: on the training logs, fold by
    fold, by models that leave the fold out, and on the validation logs by the model itself. Only
    what is fitted in closed form is fitted again; a refit through rollouts takes one step of
    Gauss-Newton for each fold.

    Attributes:
        level: share of the samples that the bands are to hold.
        folds: number of groups that the training logs are left out by.
        every: time between the starts of the runs that calibrate protocols of windows, in s.
        seed: of the division into folds.
    """

    level: float = Field(default=0.9, gt=0.5, lt=1)
    folds: int = Field(default=5, ge=2)
    every: Seconds = Field(default=10.0, gt=0)
    seed: int = Field(default=0, ge=0)


_FLOOR = 0.02
"""Share of the usual mean square below which a measure says nothing more."""
_FURTHEST = 2.5
"""Standard deviations beyond which a measure counts no further."""


def mean_squares(states: np.ndarray, step: float) -> np.ndarray:
    """Return the mean squares so far of what moves, then of its rates [L, 2 n].

    They tell how lively a run is.

    Args:
        states: predicted [L + 1, 3 + n], from the initial state on.
        step: in s.
    """
    nu = states[:, MOVING]
    seen = np.concatenate((nu[1:], np.diff(nu, axis=0) / step), axis=1)
    return np.asarray(np.cumsum(seen**2, axis=0) / np.arange(1, len(seen) + 1)[:, None])


@dataclass(frozen=True)
class Activity:
    """Standardised logarithms of the mean squares of a predicted run.

    Attributes:
        floor: added to each mean square [2 n], squares of SI units.
        centre: mean of the logarithms over the runs that calibrated [2 n].
        spread: their standard deviation [2 n].
    """

    floor: np.ndarray
    centre: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, squares: Sequence[np.ndarray], weight: np.ndarray) -> Activity:
        """Return what standardises the runs of a calibration.

        Args:
            squares: `mean_squares` of each of W runs, [L, 2 n].
            weight: of each run [W].
        """
        share = np.concatenate(
            [np.full(len(own), w) for own, w in zip(squares, weight, strict=True)]
        )
        joined = np.concatenate(squares)
        floor = _FLOOR**2 * np.average(joined, axis=0, weights=share) + 1e-12
        logs = np.log(joined + floor)
        centre = np.average(logs, axis=0, weights=share)
        spread = np.sqrt(np.average((logs - centre) ** 2, axis=0, weights=share))
        return cls(floor, centre, np.maximum(spread, 1e-6))

    def of_run(self, states: np.ndarray, step: float) -> np.ndarray:
        """Return the measures [L, 2 n] of a run with predicted states [L + 1, 3 + n]."""
        return self.standard(mean_squares(states, step))

    def standard(self, squares: np.ndarray) -> np.ndarray:
        """Return mean squares [..., 2 n] standardised."""
        z = (np.log(squares + self.floor) - self.centre) / self.spread
        return np.asarray(np.clip(z, -_FURTHEST, _FURTHEST))


_PER_LOG = 5.0
"""Independent scores that a log holds at most, as far as it has so many runs."""


def run_weights(names: Sequence[str]) -> np.ndarray:
    """Return the weight of each run [W]; those of a log weigh the root of their number together.

    Long logs would otherwise speak for the short ones, whose manoeuvres are often the livelier.
    """
    _, place, count = np.unique(names, return_inverse=True, return_counts=True)
    weight = 1.0 / np.sqrt(count[place])
    return np.asarray(weight / weight.sum())


def quantile(scores: np.ndarray, weight: np.ndarray, level: float) -> np.ndarray:
    """Return the smallest score [...] that at least a share `level` of the weight lies below.

    Args:
        scores: [W, ...]; NaN counts nowhere.
        weight: of each run [W].
        level: between 0 and 1.
    """
    seen = np.isfinite(scores)
    order = np.argsort(np.where(seen, scores, np.inf), axis=0)
    ranked = np.take_along_axis(np.where(seen, scores, np.inf), order, axis=0)
    shaped = weight.reshape(-1, *(1 for _ in scores.shape[1:]))
    share = np.take_along_axis(np.where(seen, shaped, 0.0), order, axis=0)
    below = np.cumsum(share, axis=0)
    below /= np.maximum(below[-1:], 1e-300)
    first = (below >= min(level, 1.0) - 1e-9).argmax(axis=0)
    found = np.take_along_axis(ranked, first[None], axis=0)[0]
    return np.asarray(np.where(seen.any(axis=0), found, np.nan))


def independent(
    inside: np.ndarray, weight: np.ndarray, names: Sequence[str], level: float
) -> float:
    """Return how many independent scores the runs hold, from how logs differ in their coverage.

    Args:
        inside: share of each run's samples that a quantile holds [W]; NaN where nothing is scored.
        weight: of each run [W].
    """
    _, place = np.unique(names, return_inverse=True)
    count = int(place.max()) + 1
    known = np.isfinite(inside)
    total = np.bincount(place, weight * known, count)
    held = np.bincount(place, weight * np.where(known, inside, 0.0), count)
    kept = total > 0
    own, share = held[kept] / total[kept], total[kept] / total.sum()
    if len(own) < 2:
        return 1.0
    mean = float((share * own).sum())
    variance = float((share**2 * (own - mean) ** 2).sum()) * len(own) / (len(own) - 1)
    number = level * (1.0 - level) / max(variance, 1e-12)
    most = min(_PER_LOG * len(own), int(known.sum()))
    return float(np.clip(number, 1.0, most))


def corrected(level: float, number: float) -> float:
    """Return the level whose quantile of so many scores holds a new score at `level`.

    Source: split conformal prediction, the smallest of the (n + 1) level-th scores of n.
    """
    return min(level * (1.0 + 1.0 / number), 1.0)


_MOST = 2.0
"""Largest logarithm of the factor by which liveliness changes a width."""


@dataclass(frozen=True)
class Band:
    """Half widths of the errors of a model's free runs, by channel [c].

    A half width at horizon k is `width[k]` times a factor by how lively the run has been so far.

    Attributes:
        level: share of the samples that it is to hold.
        step: in s.
        steps: horizons of the tables, numbers of steps [G], ascending.
        width: half widths of a run of usual liveliness [G, c], SI and rad.
        plain: half widths that take every run for the same [G, c].
        whole: factors [c] by which a band grows that is to hold a whole run.
        constant: half widths [c] that are the same at all horizons, for comparison.
        unit: root mean square errors of `zero` [c], which scores are given in.
        activity: measures of liveliness; None where the band knows none.
        slope: logarithm of the factor by each measure [2 n, c].
        logs: number of logs that calibrated it.
        number: of independent scores among them.
        cautions: whole sentences about what the band does not promise.
        usual: root mean square [G, c] over the runs that calibrated it of how far unlike models lie
            apart; None where there are none.
        channels: their names.
    """

    level: float
    step: float
    steps: np.ndarray
    width: np.ndarray
    plain: np.ndarray
    whole: np.ndarray
    constant: np.ndarray
    unit: np.ndarray
    activity: Activity
    slope: np.ndarray
    logs: int
    number: float
    cautions: tuple[str, ...] = ()
    usual: np.ndarray | None = None
    channels: tuple[str, ...] = PLANAR.banded

    def half_widths(self, states: np.ndarray, spread: np.ndarray | None = None) -> np.ndarray:
        """Return half widths [L, c] along a run with predicted states [L + 1, 3 + n].

        Beyond the longest calibrated horizon they grow in proportion to time. By what unlike models
        lie farther apart than they usually do, a prediction errs besides: variances add up.

        Args:
            spread: standard deviation between unlike models [L, c]; None where there are none.
        """
        z = self.activity.of_run(states, self.step)
        out = self.tabled(self.width, len(z)) * factor(z, self.slope)
        if spread is None or self.usual is None:
            return np.asarray(out)
        more = disagreement(spread, self.tabled(self.usual, len(z)), self.level, self.channels)
        return np.asarray(np.sqrt(out**2 + more))

    def tabled(self, table: np.ndarray, count: int) -> np.ndarray:
        """Return a table [G, c] at steps 1 to `count`, [count, c]."""
        k = np.arange(1, count + 1)
        found = np.stack([np.interp(k, self.steps, column) for column in table.T], axis=1)
        return np.asarray(found * np.maximum(k / self.steps[-1], 1.0)[:, None])

    @property
    def horizon(self) -> float:
        """The longest calibrated horizon in s."""
        return float(self.steps[-1] * self.step)

    def table(self) -> BandTable:
        """Return what an exported model carries: half widths that take every run for the same."""
        columns = dict(zip(self.channels, self.plain.T.tolist(), strict=True))
        about = {"level": self.level, "logs": self.logs, "cautions": self.cautions}
        return BandTable.model_validate({**about, "steps": self.steps.tolist(), **columns})

    def content(self) -> dict[str, Any]:
        """Return the band as JSON takes it."""

        def named(values: np.ndarray) -> dict[str, Any]:
            return dict(zip(self.channels, values.T.tolist(), strict=True))

        moving = [name for name in self.channels if name not in ("heading", "position")]
        return {
            "level": self.level,
            "step": self.step,
            "horizon": self.horizon,
            "logs": self.logs,
            "independent_scores": self.number,
            "cautions": list(self.cautions),
            "steps": self.steps.tolist(),
            "half_width": named(self.width),
            "half_width_of_any_run": named(self.plain),
            "whole_run_factor": named(self.whole),
            "constant_half_width": named(self.constant),
            "score_unit": named(self.unit),
            "activity": {
                "measures": [*moving, *(f"{name}_dot" for name in moving)],
                "floor": self.activity.floor.tolist(),
                "centre": self.activity.centre.tolist(),
                "spread": self.activity.spread.tolist(),
                "slope": named(self.slope),
            },
            "usual_spread": None if self.usual is None else named(self.usual),
        }

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> Band:
        """Return the band from what `content` gave."""
        channels, activity = tuple(content["half_width"]), content["activity"]

        def table(named: Mapping[str, Any]) -> np.ndarray:
            return np.array([named[channel] for channel in channels]).T

        # files of earlier versions hold no usual spread
        usual = content.get("usual_spread")
        return cls(
            float(content["level"]),
            float(content["step"]),
            np.array(content["steps"]),
            table(content["half_width"]),
            table(content["half_width_of_any_run"]),
            table(content["whole_run_factor"]),
            table(content["constant_half_width"]),
            table(content["score_unit"]),
            Activity(*(np.array(activity[key]) for key in ("floor", "centre", "spread"))),
            table(activity["slope"]),
            int(content["logs"]),
            float(content["independent_scores"]),
            tuple(content["cautions"]),
            table(usual) if usual else None,
            channels,
        )


def disagreement(
    spread: np.ndarray, usual: np.ndarray, level: float, channels: Sequence[str]
) -> np.ndarray:
    """Return the squared half widths [..., c] of what a spread [..., c] has beyond the usual one.

    Args:
        spread: standard deviations between unlike models; that of the position is per axis.
        usual: their root mean square over runs.
        level: share of normal errors that the widths are to hold.
    """
    radial = np.array([name == "position" for name in channels])
    normal = NormalDist().inv_cdf(0.5 + level / 2.0)
    squares = np.where(radial, -2.0 * np.log(1.0 - level), normal**2)
    return np.asarray(squares * np.maximum(spread**2 - usual**2, 0.0))


def factor(z: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the factors [..., c] of half widths at measures of liveliness [..., 2 n]."""
    return np.asarray(np.exp(np.clip(z @ slope, -_MOST, _MOST)))


Bands = Mapping[str, Mapping[str, Band]]
"""Bands by model and protocol."""


def covered(error: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return 1 where an error [..., c] is within its half width, 0 beyond, NaN where unscored."""
    return np.asarray(np.where(np.isfinite(error), error <= width, np.nan))


def interval_score(error: np.ndarray, width: np.ndarray, level: float) -> np.ndarray:
    """Return the interval score [..., c] of half widths, NaN where nothing is scored.

    Source: Gneiting and Raftery (2007), eq. (43): the width, and what lies outside by 2 / (1 -
    level).
    """
    return np.asarray(2.0 * width + 2.0 / (1.0 - level) * np.maximum(error - width, 0.0))


def worst(errors: Sequence[np.ndarray], widths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the largest error of each run in its half widths [W, c]; NaN where unscored."""
    out = np.full((len(errors), errors[0].shape[1]), np.nan)
    for i, (error, width) in enumerate(zip(errors, widths, strict=True)):
        seen = np.isfinite(error)
        ratio = np.where(seen, error / width, -np.inf).max(axis=0)
        out[i] = np.where(seen.any(axis=0), ratio, np.nan)
    return out


SCHEMA = "residnet.bands/1"


def bands_content(run: str, bands: Bands) -> dict[str, Any]:
    """Return the contents of bands.json.

    Args:
        bands: by model and protocol; models without any are left out.
    """
    return {
        "schema": SCHEMA,
        "run": run,
        "models": {
            model: {protocol: band.content() for protocol, band in known.items()}
            for model, known in bands.items()
            if known
        },
    }


def read_bands(content: Mapping[str, Any]) -> dict[str, dict[str, Band]]:
    """Return the bands by model and protocol from the contents of bands.json; none where empty."""
    return {
        model: {protocol: Band.read(band) for protocol, band in known.items()}
        for model, known in content.get("models", {}).items()
    }
