"""Agreement of two channels, and integrals of channels over blocks of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

MIN_SAMPLES = 50
"""Smallest number of samples for a comparison of channels."""
CHUNK_SAMPLES = 40_000
"""Samples per chunk, so that some ten columns fit into the cache of a core."""
_MAX_LAG_SAMPLES = 20_000
"""Largest number of samples, evenly spread, for the estimate of a lag."""


@dataclass(frozen=True)
class OverlappingBlocks:
    """Overlapping blocks of a log over which equations of motion are integrated.

    Integrated equations need no derivatives of noisy channels, and the noise averages out.

    Attributes:
        t: times of the log [T] in s.
        starts: first sample of each block [K].
        length: number of samples in a block.
    """

    t: np.ndarray
    starts: np.ndarray
    length: int

    def compute_changes(self, values: np.ndarray, shift: ArrayLike = 0) -> np.ndarray:
        """Return the changes of values over the blocks.

        Args:
            values: values at the samples [T, ...].
            shift: number of samples by which the blocks are moved to earlier times; scalar or [S].

        Returns:
            Changes [K, ...], or [K, S, ...] for several shifts.
        """
        starts = np.subtract.outer(self.starts, shift)
        return np.asarray(values[starts + self.length] - values[starts])

    def are_clear_of(self, invalid: np.ndarray, shift: ArrayLike = 0) -> np.ndarray:
        """Return which shifted blocks have no invalid samples [T, ...], as [K, ...] bool."""
        cumulative_invalid = np.zeros((len(invalid) + 1, *invalid.shape[1:]), dtype=int)
        np.cumsum(invalid, axis=0, out=cumulative_invalid[1:])
        starts = np.subtract.outer(self.starts, shift)
        return np.asarray(
            cumulative_invalid[starts + self.length + 1] == cumulative_invalid[starts]
        )

    def make_integrator(self, columns: np.ndarray) -> Callable[[ArrayLike], np.ndarray]:
        """Create a function that integrates columns over the blocks.

        Args:
            columns: values at the samples [T, ...].

        Returns:
            Function of the shift as for `compute_changes`; the integral over a block with NaN is
            NaN.
        """
        is_missing = ~np.isfinite(columns)
        cumulative_integral = np.zeros(columns.shape)
        has_missing = bool(is_missing.any())
        finite_values = np.where(is_missing, 0.0, columns) if has_missing else columns
        half_time_steps = 0.5 * np.diff(self.t).reshape(-1, *(1 for _ in columns.shape[1:]))
        np.cumsum(
            half_time_steps * (finite_values[1:] + finite_values[:-1]),
            axis=0,
            out=cumulative_integral[1:],
        )

        def integrate(shift: ArrayLike) -> np.ndarray:
            is_clear = self.are_clear_of(is_missing, shift) if has_missing else True
            return np.where(is_clear, self.compute_changes(cumulative_integral, shift), np.nan)

        return integrate


class ChannelAgreement(NamedTuple):
    """Agreement of a channel with a reference.

    Attributes:
        correlation: largest correlation coefficient over all lags.
        gain: regression coefficient through the origin at that lag.
        lag: lag in s, positive if the channel is late.
        reference_std: standard deviation of the reference.
    """

    correlation: float
    gain: float
    lag: float
    reference_std: float


def estimate_agreement(
    reference: np.ndarray, measured: np.ndarray, step: float
) -> ChannelAgreement | None:
    """Estimate correlation, gain and lag of a channel by cross-correlation at lags up to 3 s.

    Args:
        reference: reference channel [T].
        measured: channel [T] that is compared with it.
        step: sampling interval in s.

    Returns:
        None if fewer than 50 samples are available at all lags, or a channel is constant.
    """
    max_lag = max(round(3.0 / step), 10)
    if reference.size < 2 * max_lag + MIN_SAMPLES:
        return None
    # all lags use the same samples, so that their correlations are comparable
    # differences of cumulative counts tell whether a window of lags has missing values
    cumulative_missing = np.append(0, np.cumsum(~np.isfinite(measured)))
    is_complete = cumulative_missing[2 * max_lag + 1 :] == cumulative_missing[: -2 * max_lag - 1]
    compared_indices = (
        np.flatnonzero(np.isfinite(reference[max_lag:-max_lag]) & is_complete) + max_lag
    )
    if compared_indices.size < MIN_SAMPLES:
        return None
    compared_indices = compared_indices[:: -(-compared_indices.size // _MAX_LAG_SAMPLES)]
    reference_values = reference[compared_indices]
    lags = np.arange(-max_lag, max_lag + 1)
    reference_std = float(reference_values.std())
    measured_std = np.empty(lags.size)
    correlations = np.empty(lags.size)
    for lag_chunk in np.array_split(lags, -(-lags.size * compared_indices.size // CHUNK_SAMPLES)):
        lagged_values = measured[compared_indices + lag_chunk[:, None]]
        measured_std[lag_chunk + max_lag] = lagged_values.std(axis=1)
        correlations[lag_chunk + max_lag] = lagged_values @ (
            reference_values - reference_values.mean()
        )
    if reference_std == 0.0 or measured_std.min() <= 1e-12 * np.nanmax(np.abs(measured)):
        return None
    correlations /= compared_indices.size * reference_std * measured_std
    best_index = int(np.argmax(np.abs(correlations)))
    # a parabola through the peak and its neighbours refines the lag below one sample
    subsample_shift = 0.0
    if 0 < best_index < 2 * max_lag:
        left_value, peak, right_value = np.abs(correlations[best_index - 1 : best_index + 2])
        curvature = left_value - 2.0 * peak + right_value
        subsample_shift = 0.5 * (left_value - right_value) / curvature if curvature < 0.0 else 0.0
    gain = float(
        reference_values
        @ measured[compared_indices + lags[best_index]]
        / (reference_values @ reference_values)
    )
    return ChannelAgreement(
        float(correlations[best_index]),
        gain,
        (best_index - max_lag + subsample_shift) * step,
        reference_std,
    )
