"""Bands: prediction intervals of the errors of free runs as functions of the horizon."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.layout import DYNAMIC_STATES, EXTRA_STATES, HEADING, PLANAR_LAYOUT, VELOCITIES
from residnet.evaluation.records import (
    Activity,
    BandRow,
    BandsFile,
    ByChannel,
    CurveByChannel,
    DistanceEffect,
)

if TYPE_CHECKING:
    from residnet.dynamics.store import BandTable


def band_channels(states: np.ndarray, position_radius: np.ndarray) -> np.ndarray:
    """Return the channels of a band [L, 2 + n] from states [L, 3 + n] and a position radius [L]."""
    velocities = states[:, VELOCITIES]
    heading = states[:, HEADING]
    return np.column_stack((velocities, heading, position_radius, states[:, EXTRA_STATES]))


class BandsConfig(Config):
    """Settings of the prediction intervals of free runs.

    Intervals are calibrated on logs that the model was not fitted to: on the training logs by
    K-fold cross-validation, and on the validation logs by the model itself. Only closed-form models
    are fitted again; a refit through rollouts takes one Gauss-Newton step per fold.

    Attributes:
        level: nominal coverage by sample of each channel; two channels are both covered with a
            probability of at least 2 `level` - 1 (Bonferroni).
        folds: number of folds of the training logs.
        every: time between the starts of the calibration runs of window protocols, in s.
        seed: seed of the division into folds.
    """

    level: float = Field(default=0.95, gt=0.5, lt=1)
    folds: int = Field(default=5, ge=2)
    every: Seconds = Field(default=10.0, gt=0)
    seed: int = Field(default=0, ge=0)


_MIN_MEAN_SQUARE_SHARE = 0.02
"""Floor of the intensity measures, relative to the root mean square over all runs."""
_MAX_STANDARD_SCORE = 2.5
"""Limit of the standardised intensity measures, which bounds the extrapolation of widths."""


def running_mean_squares(states: np.ndarray, step: float) -> np.ndarray:
    """Return mean squares of the velocities and their derivatives up to each step, [L, 2 n].

    They measure the intensity of the motion.

    Args:
        states: predicted states [L + 1, 3 + n], including the initial state.
        step: time step in s.
    """
    nu = states[:, DYNAMIC_STATES]
    velocities_and_rates = np.concatenate((nu[1:], np.diff(nu, axis=0) / step), axis=1)
    return np.asarray(
        np.cumsum(velocities_and_rates**2, axis=0)
        / np.arange(1, len(velocities_and_rates) + 1)[:, None]
    )


@dataclass(frozen=True)
class MotionIntensity:
    """Standardises logarithms of the mean squares of a run, which measure its intensity.

    Attributes:
        floor: constant added to each mean square [2 n], squares of SI units.
        log_mean: mean of the logarithms over the calibration runs [2 n].
        log_std: standard deviation of the logarithms [2 n].
    """

    floor: np.ndarray
    log_mean: np.ndarray
    log_std: np.ndarray

    @classmethod
    def from_runs(cls, squares: Sequence[np.ndarray], weights: np.ndarray) -> MotionIntensity:
        """Return the statistics of the runs of a calibration.

        Args:
            squares: `running_mean_squares` of each of W runs, [L, 2 n].
            weights: weight of each run [W].
        """
        sample_weights = np.concatenate(
            [
                np.full(len(run_squares), run_weight)
                for run_squares, run_weight in zip(squares, weights, strict=True)
            ]
        )
        pooled_squares = np.concatenate(squares)
        floor = (
            _MIN_MEAN_SQUARE_SHARE**2 * np.average(pooled_squares, axis=0, weights=sample_weights)
            + 1e-12
        )
        log_squares = np.log(pooled_squares + floor)
        log_mean = np.average(log_squares, axis=0, weights=sample_weights)
        log_std = np.sqrt(np.average((log_squares - log_mean) ** 2, axis=0, weights=sample_weights))
        return cls(floor, log_mean, np.maximum(log_std, 1e-6))

    def standardize_run(self, states: np.ndarray, step: float) -> np.ndarray:
        """Return the measures [L, 2 n] of a run with predicted states [L + 1, 3 + n]."""
        return self.standardize(running_mean_squares(states, step))

    def standardize(self, squares: np.ndarray) -> np.ndarray:
        """Return mean squares [..., 2 n] standardised."""
        z = (np.log(squares + self.floor) - self.log_mean) / self.log_std
        return np.asarray(np.clip(z, -_MAX_STANDARD_SCORE, _MAX_STANDARD_SCORE))


_MAX_SCORES_PER_LOG = 5.0
"""Largest effective number of independent scores of one log."""


def compute_run_weights(log_names: Sequence[str]) -> np.ndarray:
    """Return the weight of each run [W].

    The runs of a log share a total weight of the square root of their number. Otherwise long logs
    would dominate short ones, which often hold stronger manoeuvres.
    """
    _, log_indices, runs_per_log = np.unique(log_names, return_inverse=True, return_counts=True)
    # a compromise: equal runs would favour long logs, equal logs would waste their information
    weights = 1.0 / np.sqrt(runs_per_log[log_indices])
    return np.asarray(weights / weights.sum())


def weighted_quantile(scores: np.ndarray, weights: np.ndarray, level: float) -> np.ndarray:
    """Return the smallest score [...] at or below which at least a share `level` of the weight is.

    Args:
        scores: scores of W runs [W, ...]; NaN is ignored.
        weights: weight of each run [W].
        level: level of the quantile, between 0 and 1.
    """
    is_scored = np.isfinite(scores)
    ranking = np.argsort(np.where(is_scored, scores, np.inf), axis=0)
    sorted_scores = np.take_along_axis(np.where(is_scored, scores, np.inf), ranking, axis=0)
    broadcast_weights = weights.reshape(-1, *(1 for _ in scores.shape[1:]))
    sorted_weights = np.take_along_axis(
        np.where(is_scored, broadcast_weights, 0.0), ranking, axis=0
    )
    cumulative_weights = np.cumsum(sorted_weights, axis=0)
    cumulative_weights /= np.maximum(cumulative_weights[-1:], 1e-300)
    # the tolerance is for rounding in the cumulative sum
    first_indices = (cumulative_weights >= min(level, 1.0) - 1e-9).argmax(axis=0)
    quantiles = np.take_along_axis(sorted_scores, first_indices[None], axis=0)[0]
    return np.asarray(np.where(is_scored.any(axis=0), quantiles, np.nan))


def effective_sample_size(
    coverage: np.ndarray, weights: np.ndarray, log_names: Sequence[str], level: float
) -> float:
    """Return the effective number of independent scores, from the variance of coverage over logs.

    Args:
        coverage: share of each run's samples below a quantile [W]; NaN for unscored runs.
        weights: weight of each run [W].
        log_names: log of each run.
        level: level of the quantile.
    """
    _, log_indices = np.unique(log_names, return_inverse=True)
    n_logs = int(log_indices.max()) + 1
    is_scored = np.isfinite(coverage)
    log_weights = np.bincount(log_indices, weights * is_scored, n_logs)
    covered_weights = np.bincount(log_indices, weights * np.where(is_scored, coverage, 0.0), n_logs)
    has_weight = log_weights > 0
    log_coverage = covered_weights[has_weight] / log_weights[has_weight]
    log_shares = log_weights[has_weight] / log_weights.sum()
    if len(log_coverage) < 2:
        return 1.0
    mean_coverage = float((log_shares * log_coverage).sum())
    variance = (
        float((log_shares**2 * (log_coverage - mean_coverage) ** 2).sum())
        * len(log_coverage)
        / (len(log_coverage) - 1)
    )
    # independent samples would have the binomial variance level (1 - level) / n
    effective_count = level * (1.0 - level) / max(variance, 1e-12)
    max_count = min(_MAX_SCORES_PER_LOG * len(log_coverage), int(is_scored.sum()))
    return float(np.clip(effective_count, 1.0, max_count))


def conformal_level(level: float, n_scores: float) -> float:
    """Return the level of the quantile of `n_scores` scores that covers a new score at `level`.

    Source: split conformal prediction, the smallest of the (n + 1) level-th scores of n.
    """
    return min(level * (1.0 + 1.0 / n_scores), 1.0)


MAX_LOG_FACTOR = 2.0
"""Largest logarithm of the factor by which intensity or distance changes a width."""


@dataclass(frozen=True)
class Band:
    """Prediction intervals of the errors of a model's free runs, by channel [c].

    The half width at horizon k is `width[k]` times a factor that depends on the intensity of the
    motion up to k.

    Attributes:
        level: nominal coverage by sample.
        step: time step in s.
        steps: horizons of the tables in time steps [G], ascending.
        half_width: half widths of a run of typical intensity [G, c], SI and rad.
        unconditional_width: half widths that ignore the intensity [G, c]; they also hold for
            commands of another kind, see `residnet.identification.command_variance`.
        simultaneous_factor: factors [c] on the half widths so that they cover whole runs.
        constant_width: half widths [c] that are constant over the horizon, for comparison.
        score_unit: root mean square constant-velocity errors [c], the unit of interval scores.
        intensity: statistics of the intensity measures; None if the widths ignore it.
        slope: log factor per standardised intensity measure [2 n, c].
        n_logs: number of logs that calibrated the intervals.
        n_scores: equivalent number of independent calibration scores.
        cautions: sentences on the limits of the intervals.
        typical_spread: root mean square standard deviation between ensemble members [G, c] over the
            calibration runs; None without an ensemble.
        channels: names of the channels.
        distance_threshold: running mean of the log distance to the training data above which a
            width increases; infinite if the calibration runs have no distance.
        largest_distance: largest such mean at the end of a calibration run; infinite if unknown.
        distance_slope: slope of the log width above the threshold [c]; None if no run over logs of
            a kind of manoeuvre that is not in the training data determines it.
    """

    level: float
    step: float
    steps: np.ndarray
    half_width: np.ndarray
    unconditional_width: np.ndarray
    simultaneous_factor: np.ndarray
    constant_width: np.ndarray
    score_unit: np.ndarray
    intensity: MotionIntensity
    slope: np.ndarray
    n_logs: int
    n_scores: float
    cautions: tuple[str, ...] = ()
    typical_spread: np.ndarray | None = None
    channels: tuple[str, ...] = PLANAR_LAYOUT.band_channels
    distance_threshold: float = math.inf
    largest_distance: float = math.inf
    distance_slope: np.ndarray | None = None

    def half_widths(
        self,
        states: np.ndarray,
        spread: np.ndarray | None = None,
        distance: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return half widths [L, c] along a run with predicted states [L + 1, 3 + n].

        Beyond the longest calibrated horizon they grow in proportion to time. A disagreement of the
        ensemble members above its typical value adds to the variance, and a distance to the
        training data that is unusual for the calibration runs multiplies the width.

        Args:
            states: predicted states, including the initial state.
            spread: standard deviation between ensemble members [L, c]; None without an ensemble.
            distance: running mean of the log distance to the training data [L]; None if unknown.
        """
        half_widths = self._widths_near_training_data(states, spread)
        if distance is None or self.distance_slope is None:
            return half_widths
        return np.asarray(half_widths * self.distance_factors(distance))

    def distance_factors(self, distance: np.ndarray) -> np.ndarray:
        """Return the factors [L, c] on half widths at log distances [L] to the training data."""
        if self.distance_slope is None:
            return np.ones((len(distance), len(self.channels)))
        excess = np.maximum(distance - self.distance_threshold, 0.0)
        return np.asarray(np.exp(np.minimum(np.outer(excess, self.distance_slope), MAX_LOG_FACTOR)))

    def _widths_near_training_data(
        self, states: np.ndarray, spread: np.ndarray | None
    ) -> np.ndarray:
        """Return half widths [L, c] without the factor of the distance to the training data."""
        intensities = self.intensity.standardize_run(states, self.step)
        half_widths = self.interpolate(self.half_width, len(intensities)) * width_factors(
            intensities, self.slope
        )
        if spread is None or self.typical_spread is None:
            return np.asarray(half_widths)
        disagreement_variance = excess_disagreement(
            spread,
            self.interpolate(self.typical_spread, len(intensities)),
            self.level,
            self.channels,
        )
        return np.asarray(np.sqrt(half_widths**2 + disagreement_variance))

    def interpolate(self, values: np.ndarray, n_steps: int) -> np.ndarray:
        """Return a table [G, c] at steps 1 to `n_steps`, [n_steps, c]."""
        steps = np.arange(1, n_steps + 1)
        interpolated = np.stack(
            [np.interp(steps, self.steps, column) for column in values.T], axis=1
        )
        # beyond the calibration errors are assumed to grow in proportion to time
        return np.asarray(interpolated * np.maximum(steps / self.steps[-1], 1.0)[:, None])

    @property
    def horizon(self) -> float:
        """The longest calibrated horizon in s."""
        return float(self.steps[-1] * self.step)

    def to_table(self) -> BandTable:
        """Return the table of an exported model: half widths that ignore the intensity."""
        # imported here because it imports PyTorch, which readers of configs and reports do not need
        from residnet.dynamics.store import BandTable

        columns = dict(zip(self.channels, self.unconditional_width.T.tolist(), strict=True))
        metadata = {"level": self.level, "logs": self.n_logs, "cautions": self.cautions}
        return BandTable.model_validate({**metadata, "steps": self.steps.tolist(), **columns})

    def to_record(self) -> BandRow:
        """Return the entry of bands.json."""

        def map_curves(by_channel: np.ndarray) -> CurveByChannel:
            return {
                name: tuple(values)
                for name, values in zip(self.channels, by_channel.T.tolist(), strict=True)
            }

        def map_values(by_channel: np.ndarray) -> ByChannel:
            return dict(zip(self.channels, by_channel.tolist(), strict=True))

        dynamic_states = [name for name in self.channels if name not in ("heading", "position")]
        return BandRow(
            level=self.level,
            step=self.step,
            horizon=self.horizon,
            logs=self.n_logs,
            independent_scores=self.n_scores,
            cautions=self.cautions,
            steps=tuple(self.steps.tolist()),
            half_width=map_curves(self.half_width),
            half_width_of_any_run=map_curves(self.unconditional_width),
            whole_run_factor=map_values(self.simultaneous_factor),
            constant_half_width=map_values(self.constant_width),
            score_unit=map_values(self.score_unit),
            activity=Activity(
                measures=(*dynamic_states, *(f"{name}_dot" for name in dynamic_states)),
                floor=tuple(self.intensity.floor.tolist()),
                centre=tuple(self.intensity.log_mean.tolist()),
                spread=tuple(self.intensity.log_std.tolist()),
                slope=map_curves(self.slope),
            ),
            usual_spread=None if self.typical_spread is None else map_curves(self.typical_spread),
            distance=DistanceEffect(
                threshold=self.distance_threshold,
                largest=self.largest_distance,
                slope=None if self.distance_slope is None else map_values(self.distance_slope),
            )
            if math.isfinite(self.distance_threshold)
            else None,
        )

    @classmethod
    def from_record(cls, row: BandRow) -> Band:
        """Return the band from its entry of bands.json."""
        channels = tuple(row.half_width)

        def table(by_channel: CurveByChannel | ByChannel) -> np.ndarray:
            return np.array([by_channel[channel] for channel in channels]).T

        return cls(
            level=row.level,
            step=row.step,
            steps=np.array(row.steps),
            half_width=table(row.half_width),
            unconditional_width=table(row.half_width_of_any_run),
            simultaneous_factor=table(row.whole_run_factor),
            constant_width=table(row.constant_half_width),
            score_unit=table(row.score_unit),
            intensity=MotionIntensity(
                np.array(row.activity.floor),
                np.array(row.activity.centre),
                np.array(row.activity.spread),
            ),
            slope=table(row.activity.slope),
            n_logs=row.logs,
            n_scores=row.independent_scores,
            cautions=row.cautions,
            typical_spread=None if row.usual_spread is None else table(row.usual_spread),
            channels=channels,
            distance_threshold=math.inf if row.distance is None else row.distance.threshold,
            largest_distance=math.inf if row.distance is None else row.distance.largest,
            distance_slope=table(row.distance.slope)
            if row.distance is not None and row.distance.slope is not None
            else None,
        )


def excess_disagreement(
    spread: np.ndarray, typical_spread: np.ndarray, level: float, channels: Sequence[str]
) -> np.ndarray:
    """Return the squared half widths [..., c] due to a spread [..., c] above the typical one.

    Args:
        spread: standard deviations between ensemble members; per axis for the position.
        typical_spread: root mean square standard deviation over the calibration runs.
        level: nominal coverage of normal errors.
    """
    is_radial = np.array([name == "position" for name in channels])
    normal_quantile = NormalDist().inv_cdf(0.5 + level / 2.0)
    # the radius of two normal coordinates has a Rayleigh distribution with this quantile
    squared_quantiles = np.where(is_radial, -2.0 * np.log(1.0 - level), normal_quantile**2)
    return np.asarray(squared_quantiles * np.maximum(spread**2 - typical_spread**2, 0.0))


def width_factors(intensities: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the factors [..., c] on half widths for intensity measures [..., 2 n]."""
    return np.asarray(np.exp(np.clip(intensities @ slope, -MAX_LOG_FACTOR, MAX_LOG_FACTOR)))


BandsByModel = Mapping[str, Mapping[str, Band]]
"""Bands by model and protocol."""


def is_covered(error: np.ndarray, half_width: np.ndarray) -> np.ndarray:
    """Return 1 where an error [..., c] is within its half width, 0 beyond, NaN where unscored."""
    return np.asarray(np.where(np.isfinite(error), error <= half_width, np.nan))


def interval_score(error: np.ndarray, half_width: np.ndarray, level: float) -> np.ndarray:
    """Return the interval score [..., c] of half widths, NaN where nothing is scored.

    Source: Gneiting and Raftery (2007), eq. (43): the width plus 2 / (1 - level) times the excess
    of the error.
    """
    return np.asarray(2.0 * half_width + 2.0 / (1.0 - level) * np.maximum(error - half_width, 0.0))


def largest_error_ratios(errors: Sequence[np.ndarray], widths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the largest ratio of error to half width of each run [W, c]; NaN where unscored."""
    ratios = np.full((len(errors), errors[0].shape[1]), np.nan)
    for i, (error, width) in enumerate(zip(errors, widths, strict=True)):
        is_scored = np.isfinite(error)
        ratio = np.where(is_scored, error / width, -np.inf).max(axis=0)
        ratios[i] = np.where(is_scored.any(axis=0), ratio, np.nan)
    return ratios


SCHEMA: Final = "residnet.bands/1"


def build_bands_file(run: str, bands: BandsByModel) -> BandsFile:
    """Return the contents of bands.json.

    Args:
        run: name of the run.
        bands: bands by model and protocol; models without bands are omitted.
    """

    models = {
        model: {protocol: band.to_record() for protocol, band in bands_by_protocol.items()}
        for model, bands_by_protocol in bands.items()
        if bands_by_protocol
    }
    return BandsFile(schema=SCHEMA, run=run, models=models)


def read_bands(run: Path, model: str) -> dict[str, Band]:
    """Read the bands of a model by protocol from bands.json; empty if the run has none.

    Raises:
        UsageError: if the file cannot be read.
    """
    file = BandsFile.read_optional(run, "bands.json")
    rows = {} if file is None else file.models.get(model, {})
    return {protocol: Band.from_record(row) for protocol, row in rows.items()}
