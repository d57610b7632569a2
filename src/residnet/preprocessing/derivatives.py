"""Differentiate sampled channels within contiguous segments.

Accelerations are rarely measured. They are computed from velocities by differentiation with a
configured amount of smoothing.
"""

from __future__ import annotations

from abc import ABC
from functools import cache
from typing import Annotated, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError
from residnet.core.stretches import find_runs


class DerivativeRule(Config, ABC):
    """Base class of rules that smooth and differentiate channels on a uniform grid.

    The default does not smooth and takes the forward difference, so that the last sample of a
    segment is invalid.
    """

    def derive(
        self, values: np.ndarray, dt: float, segments: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return smoothed values and their derivatives.

        Samples that are not finite split a segment further. Nothing is smoothed across the ends of
        a segment.

        Args:
            values: channels [T, n], SI, angles unwrapped.
            dt: time step in s.
            segments: segment number of each sample [T] int, -1 outside of segments
                (`residnet.preprocessing.masks.number_log_segments`).

        Returns:
            Smoothed values [T, n], derivatives [T, n] in SI units per second, and validity [T]
            bool; both arrays are NaN at invalid samples.

        Raises:
            ConfigError: if the window is too short for the time step.
        """
        min_samples = self.min_samples(dt)
        smoothed = np.full(values.shape, np.nan)
        rates = np.full(values.shape, np.nan)
        # a missing sample ends a segment: polynomials must not bridge it
        segment_bounds = find_runs(np.where(np.isfinite(values).all(axis=1), segments, -1))
        for start, stop in zip(*segment_bounds, strict=True):
            segment_slice = slice(start, stop)
            if stop - start >= min_samples:
                smoothed[segment_slice], rates[segment_slice] = self.derive_segment(
                    values[segment_slice], dt
                )
        is_valid = np.isfinite(rates).all(axis=1)
        smoothed[~is_valid] = np.nan
        rates[~is_valid] = np.nan
        return smoothed, rates, is_valid

    def min_samples(self, dt: float) -> int:
        """Return the smallest number of samples of a segment that the rule can differentiate.

        Raises:
            ConfigError: if the window is too short for the time step.
        """
        return 2

    def derive_segment(self, values: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return smoothed values and derivatives [T, n] of one segment, NaN if undefined."""
        rates = np.full(values.shape, np.nan)
        rates[:-1] = np.diff(values, axis=0)
        return values, rates / dt


@final
class SavitzkyGolay(DerivativeRule):
    """Savitzky-Golay filter: local polynomials in a moving window.

    The window is rounded up to an odd number of samples. Near the ends of a segment the polynomial
    of the nearest full window is evaluated. A segment that is shorter than the window is invalid.

    Attributes:
        window: length of the window in s.
        order: degree of the polynomials.
    """

    kind: Literal["savitzky_golay"] = "savitzky_golay"
    window: Seconds = Field(default=1.5, gt=0.0)
    order: int = Field(default=2, ge=1)

    def n_window_samples(self, dt: float) -> int:
        """Return the number of samples in the window at a time step in s."""
        return round(self.window / dt) // 2 * 2 + 1

    def min_samples(self, dt: float) -> int:
        if self.n_window_samples(dt) <= self.order:
            min_window = (self.order + 1 | 1) * dt
            raise ConfigError(
                f"savitzky_golay: a window of {self.window:g} s holds {self.n_window_samples(dt)}"
                f" samples of {dt:g} s, order {self.order} needs more; set window to {min_window:g}"
                " s or longer"
            )
        return self.n_window_samples(dt)

    def derive_segment(self, values: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        return fit_local_polynomials(values, self.n_window_samples(dt), self.order, dt)


def fit_local_polynomials(
    values: np.ndarray, window_samples: int, order: int, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth and differentiate values by local polynomials (Savitzky and Golay 1964).

    The result equals scipy.signal.savgol_filter, whose import takes longer than the check of a
    config.

    Args:
        values: values to smooth [T, n].
        window_samples: window length in samples, odd.
        order: degree of the polynomials.
        dt: time step in s.

    Returns:
        Smoothed values and derivatives [T, n].
    """
    half_window = window_samples // 2
    vandermonde, pseudo_inverse, vandermonde_slopes = _polynomial_matrices(window_samples, order)
    # the first and the last window also give the values near the ends
    first_coefficients = pseudo_inverse @ values[:window_samples]
    last_coefficients = pseudo_inverse @ values[-window_samples:]
    results = []
    for evaluation_matrix in (vandermonde, vandermonde_slopes / (half_window * dt)):
        # inside a segment the filter is a convolution with the weights of the centre of the window
        weights = evaluation_matrix[half_window] @ pseudo_inverse
        inner_values = [np.correlate(column, weights, "valid") for column in values.T]
        boundary_values = (
            evaluation_matrix[:half_window] @ first_coefficients,
            evaluation_matrix[half_window + 1 :] @ last_coefficients,
        )
        results.append(
            np.concatenate((boundary_values[0], np.stack(inner_values, axis=1), boundary_values[1]))
        )
    return results[0], results[1]


@cache
def _polynomial_matrices(
    window_samples: int, order: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Vandermonde matrix on [-1, 1], its pseudo-inverse and its derivative."""
    vandermonde = np.vander(np.linspace(-1.0, 1.0, window_samples), order + 1, increasing=True)
    vandermonde_slopes = np.zeros_like(vandermonde)
    vandermonde_slopes[:, 1:] = vandermonde[:, :-1] * np.arange(1, order + 1)
    return vandermonde, np.linalg.pinv(vandermonde), vandermonde_slopes


@final
class ForwardDifference(DerivativeRule):
    """Forward difference without smoothing.

    The last sample of a segment is invalid.
    """

    kind: Literal["forward"] = "forward"


DerivativeConfig = Annotated[SavitzkyGolay | ForwardDifference, Field(discriminator="kind")]
"""Rule for derivatives, selected by its `kind`."""
