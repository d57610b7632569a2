"""Rows of a regression: samples, or integrals over short windows.

Noise enters an equation twice: through the derivative on its left, which differentiation amplifies,
and through the regressors on its right, which pull coefficients towards zero. Integrating both
sides against a test function w that vanishes at the ends of a window, int w y dt = sum c_j int w
f_j dt, takes the derivative off the noisy record (by parts, int w x_dot dt = -int w_dot x dt).
Where accelerations are central differences (`savitzky_golay` over three samples) summing them is
the same as summing by parts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError, FitError
from residnet.core.stretches import find_run_bounds

_MAX_BLOCK_NUMBERS = 8_000_000
"""Numbers of windows held at a time."""
_MIN_VARIANCE = 1e-300
"""Least variance or size that is divided by."""


class RegressionRows(NamedTuple):
    """The terms [N, J], targets [N, K] and stretches [N] of a regression.

    A stretch of unbroken samples has a number, ascending.
    """

    x: np.ndarray
    y: np.ndarray
    segment: np.ndarray


class RowBuilder(Config, ABC):
    """A way to make rows of a regression from sampled terms.

    Attributes:
        sequential: whether rows are made of neighbouring samples, so that times must be known.
    """

    sequential: ClassVar[bool] = True

    @abstractmethod
    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        """Return the rows of the regression.

        Args:
            samples: terms and targets at samples `time_step` seconds apart within each stretch.
            time_step: time between samples, s.

        Raises:
            ConfigError: where a window holds too few samples.
            FitError: where no stretch is as long as it must be.
        """


@final
class SampleRows(RowBuilder):
    """The samples themselves as rows."""

    sequential: ClassVar[bool] = False
    kind: Literal["least_squares"] = "least_squares"

    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        return samples


@final
class WeakRows(RowBuilder):
    """The weak form: both sides integrated over windows (Bortz, Messenger and others, 2021).

    The weight is (1 - s^2)^2, s from -1 to 1.

    Attributes:
        window: length of a window.
        every: distance between windows as a share of their length.
    """

    kind: Literal["weak"] = "weak"
    window: Seconds = Field(default=2.0, gt=0.0)
    every: float = Field(default=0.05, gt=0.0, le=1.0)

    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        return integrate_windows(samples, time_step, self.window, self.every)


RowsConfig = Annotated[SampleRows | WeakRows, Field(discriminator="kind")]
"""Any way to make rows; its `kind` says which."""


def integrate_windows(
    samples: RegressionRows, time_step: float, window: float, stride_share: float
) -> RegressionRows:
    """Return weighted sums over windows of `window` seconds within each stretch.

    They are scaled so that a constant keeps its value.

    Raises:
        ConfigError: where a window holds fewer than three samples.
        FitError: where no stretch is as long as a window.
    """
    window_samples = round(window / time_step)
    if window_samples < 3:
        raise ConfigError(
            f"weak form: a window of {window:g} s holds {window_samples} samples of {time_step:g} s; set it to"
            f" {3 * time_step:g} s or longer"
        )
    window_coordinate = np.linspace(-1.0, 1.0, window_samples + 2)[1:-1]
    test_function = np.square(1.0 - np.square(window_coordinate))
    test_function /= test_function.sum()
    segment_starts, segment_ends = find_run_bounds(samples.segment)
    window_starts = np.flatnonzero(
        np.arange(window_samples, len(segment_ends) + window_samples) <= segment_ends
    )
    if not window_starts.size:
        raise FitError(
            f"weak form: no unbroken stretch of samples is {window:g} s long; shorten the window or"
            " give logs with fewer gaps"
        )
    # windows every so many samples, counted from the start of each stretch
    window_starts = window_starts[
        (window_starts - segment_starts[window_starts])
        % max(round(stride_share * window_samples), 1)
        == 0
    ]
    columns = np.concatenate((samples.x, samples.y), axis=1)
    windows_per_block = max(_MAX_BLOCK_NUMBERS // (window_samples * columns.shape[1]), 1)
    block_sums = []
    windows = np.lib.stride_tricks.sliding_window_view(columns, window_samples, axis=0)
    for block_start in range(0, window_starts.size, windows_per_block):
        block_sums.append(
            windows[window_starts[block_start : block_start + windows_per_block]] @ test_function
        )
    window_sums = np.concatenate(block_sums)
    return RegressionRows(
        window_sums[:, : samples.x.shape[1]],
        window_sums[:, samples.x.shape[1] :],
        samples.segment[window_starts],
    )


def number_regular_segments(group: np.ndarray, t: np.ndarray, time_step: float) -> np.ndarray:
    """Return the number of the unbroken stretch of each sample [N], ascending from 0.

    Args:
        group: manoeuvre of each sample [N], ascending.
        t: time of each sample within its manoeuvre [N], s.
        time_step: time between neighbouring samples, s.
    """
    is_break = (np.diff(group) != 0) | (np.abs(np.diff(t) - time_step) > 0.01 * time_step)
    return np.concatenate(([0], np.cumsum(is_break)))


def median_time_step(group: np.ndarray, t: np.ndarray) -> float:
    """Return the time between samples: the median distance of neighbours in one manoeuvre, s.

    Raises:
        FitError: where no manoeuvre has two samples.
    """
    time_differences = np.diff(t)[np.diff(group) == 0]
    if not time_differences.size or float(np.median(time_differences)) <= 0:
        raise FitError(
            "no manoeuvre has two samples at different times; the step between samples is not known"
        )
    return float(np.median(time_differences))


def effective_correlation_length(residual: np.ndarray) -> np.ndarray:
    """Return how many neighbouring rows tell as much as one independent row, [K], at least 1.

    1 + 2 sum rho over the first lags until rho is negative (initial positive sequence).
    """
    n = len(residual)
    centred = residual - residual.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:n]
    rho = covariance / np.maximum(covariance[0], _MIN_VARIANCE)
    # noise of an estimate of zero: what is less than two of its deviations ends the sum
    positive = np.cumprod(rho > 2.0 / np.sqrt(n), axis=0).astype(bool)
    return np.asarray(np.maximum(2.0 * np.where(positive, rho, 0.0).sum(axis=0) - 1.0, 1.0))
