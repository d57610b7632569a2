"""Rows of a regression: samples (strong form), or integrals over short windows (weak form).

Measurement noise affects a regression twice: differentiation amplifies the noise of the left side,
and noise of the regressors biases the coefficients towards zero (attenuation). The weak form
integrates both sides with a test function w that vanishes at the ends of a window,
int w y dt = sum c_j int w f_j dt. Integration by parts, int w x_dot dt = -int w_dot x dt, moves the
derivative from the noisy record to w. If the accelerations are central differences
(`savitzky_golay` over three samples), summation by parts gives the same sums: differentiating the
record first then adds no noise.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import ConfigError, FitError
from residnet.core.stretches import find_run_bounds

_MAX_BLOCK_ELEMENTS = 8_000_000
"""Maximum number of array elements of the windows that are integrated at a time."""
_MIN_VARIANCE = 1e-300
"""Lower bound of a variance in a denominator."""


class RegressionRows(NamedTuple):
    """Rows of a regression.

    Attributes:
        x: terms [N, J].
        y: targets [N, K].
        segment: index of the uninterrupted segment of each row [N], ascending.
    """

    x: np.ndarray
    y: np.ndarray
    segment: np.ndarray


class RowBuilder(Config, ABC):
    """Method that computes the rows of a regression from sampled terms.

    Attributes:
        sequential: whether a row combines neighbouring samples, which needs the sample times.
    """

    sequential: ClassVar[bool] = True

    @abstractmethod
    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        """Compute the rows of the regression.

        Args:
            samples: terms and targets, uniformly sampled within each segment.
            time_step: sampling interval, s.

        Raises:
            ConfigError: if a window has too few samples.
            FitError: if every segment is shorter than a window.
        """


@final
class SampleRows(RowBuilder):
    """Strong form: every sample is a row."""

    sequential: ClassVar[bool] = False
    kind: Literal["least_squares"] = "least_squares"

    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        return samples


@final
class WeakRows(RowBuilder):
    """Weak form: both sides are integrated over windows (Messenger and Bortz 2021).

    The test function is (1 - s^2)^2 with s from -1 to 1 over the window.

    Attributes:
        window: length of a window.
        every: distance between the starts of windows as a share of their length.
    """

    kind: Literal["weak"] = "weak"
    window: Seconds = Field(default=2.0, gt=0.0)
    every: float = Field(default=0.05, gt=0.0, le=1.0)

    def build_rows(self, samples: RegressionRows, time_step: float) -> RegressionRows:
        return integrate_windows(samples, time_step, self.window, self.every)


RowsConfig = Annotated[SampleRows | WeakRows, Field(discriminator="kind")]
"""Configuration of any row builder, selected by `kind`."""


def integrate_windows(
    samples: RegressionRows, time_step: float, window: float, stride_share: float
) -> RegressionRows:
    """Compute weighted sums over windows within each segment.

    The weights sum to one, so that a constant signal is unchanged.

    Args:
        samples: terms and targets, uniformly sampled within each segment.
        time_step: sampling interval, s.
        window: length of a window, s.
        stride_share: distance between the starts of windows as a share of their length.

    Raises:
        ConfigError: if a window has fewer than three samples.
        FitError: if every segment is shorter than a window.
    """
    window_samples = round(window / time_step)
    if window_samples < 3:
        raise ConfigError(
            f"weak form: a window of {window:g} s has {window_samples} samples at an interval of"
            f" {time_step:g} s; set it to {3 * time_step:g} s or longer"
        )
    # the samples lie inside the window: at its ends the test function is zero
    window_coordinate = np.linspace(-1.0, 1.0, window_samples + 2)[1:-1]
    test_function = np.square(1.0 - np.square(window_coordinate))
    test_function /= test_function.sum()
    # first sample of the segment, and the sample after its last one, for every sample [N]
    segment_start, segment_end = find_run_bounds(samples.segment)
    # a window must end within the segment of its first sample
    window_starts = np.flatnonzero(
        np.arange(window_samples, len(segment_end) + window_samples) <= segment_end
    )
    if not window_starts.size:
        raise FitError(
            f"weak form: every uninterrupted segment is shorter than the window of {window:g} s;"
            " shorten the window or give logs with fewer gaps"
        )
    # the stride is counted from the start of each segment
    window_starts = window_starts[
        (window_starts - segment_start[window_starts])
        % max(round(stride_share * window_samples), 1)
        == 0
    ]
    columns = np.concatenate((samples.x, samples.y), axis=1)
    windows_per_block = max(_MAX_BLOCK_ELEMENTS // (window_samples * columns.shape[1]), 1)
    # blocks bound the memory of the windows
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


def label_regular_segments(group: np.ndarray, t: np.ndarray, time_step: float) -> np.ndarray:
    """Return the index of the uninterrupted segment of each sample [N], ascending from 0.

    Args:
        group: index of the manoeuvre of each sample [N], ascending.
        t: time of each sample within its manoeuvre [N], s.
        time_step: sampling interval, s.
    """
    is_break = (np.diff(group) != 0) | (np.abs(np.diff(t) - time_step) > 0.01 * time_step)
    return np.concatenate(([0], np.cumsum(is_break)))


def median_time_step(group: np.ndarray, t: np.ndarray) -> float:
    """Return the median time between neighbouring samples of a manoeuvre, s.

    Args:
        group: index of the manoeuvre of each sample [N], ascending.
        t: time of each sample within its manoeuvre [N], s.

    Raises:
        FitError: if no manoeuvre has two samples at different times.
    """
    time_differences = np.diff(t)[np.diff(group) == 0]
    if not time_differences.size or float(np.median(time_differences)) <= 0:
        raise FitError(
            "no manoeuvre has two samples at different times, so the sampling interval is unknown;"
            " give manoeuvres with several samples"
        )
    return float(np.median(time_differences))


def effective_correlation_length(residual: np.ndarray) -> np.ndarray:
    """Estimate the integrated autocorrelation time of residuals [N, K], counted in rows, [K] >= 1.

    N correlated rows determine a mean as well as N / (this number) independent rows. With the
    autocorrelation rho at lags of 1, 2, ... rows, the estimate is 1 + 2 sum rho. The sum ends
    before the first lag at which rho is not significant (Geyer 1992: initial positive sequence).
    """
    n = len(residual)
    centred = residual - residual.mean(axis=0)
    # autocovariance by the Wiener-Khinchin theorem; padding to 2 n avoids circular correlation
    spectrum = np.abs(np.fft.rfft(centred, 2 * n, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:n]
    rho = covariance / np.maximum(covariance[0], _MIN_VARIANCE)
    # 1 / sqrt(n) is the standard error of rho for white noise; below two of them rho is noise
    positive = np.cumprod(rho > 2.0 / np.sqrt(n), axis=0).astype(bool)
    return np.asarray(np.maximum(2.0 * np.where(positive, rho, 0.0).sum(axis=0) - 1.0, 1.0))
