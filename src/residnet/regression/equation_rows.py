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
from residnet.core.stretches import stretch_bounds

_BLOCK = 8_000_000
"""Numbers of windows held at a time."""
_TINY = 1e-300
"""Least variance or size that is divided by."""


class Rows(NamedTuple):
    """The terms [N, J], targets [N, K] and stretches [N] of a regression.

    A stretch of unbroken samples has a number, ascending.
    """

    x: np.ndarray
    y: np.ndarray
    stretch: np.ndarray


class RowBuilder(Config, ABC):
    """A way to make rows of a regression from sampled terms.

    Attributes:
        sequential: whether rows are made of neighbouring samples, so that times must be known.
    """

    sequential: ClassVar[bool] = True

    @abstractmethod
    def rows(self, sampled: Rows, step: float) -> Rows:
        """Return the rows of the regression.

        Args:
            sampled: terms and targets at samples `step` seconds apart within each stretch.
            step: time between samples, s.

        Raises:
            ConfigError: where a window holds too few samples.
            FitError: where no stretch is as long as it must be.
        """


@final
class SampleRows(RowBuilder):
    """The samples themselves as rows."""

    sequential: ClassVar[bool] = False
    kind: Literal["least_squares"] = "least_squares"

    def rows(self, sampled: Rows, step: float) -> Rows:
        return sampled


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

    def rows(self, sampled: Rows, step: float) -> Rows:
        return integrated(sampled, step, self.window, self.every)


RowsConfig = Annotated[SampleRows | WeakRows, Field(discriminator="kind")]
"""Any way to make rows; its `kind` says which."""


def integrated(sampled: Rows, step: float, window: float, every: float) -> Rows:
    """Return weighted sums over windows of `window` seconds within each stretch.

    They are scaled so that a constant keeps its value.

    Raises:
        ConfigError: where a window holds fewer than three samples.
        FitError: where no stretch is as long as a window.
    """
    size = round(window / step)
    if size < 3:
        raise ConfigError(
            f"weak form: a window of {window:g} s holds {size} samples of {step:g} s; set it to"
            f" {3 * step:g} s or longer"
        )
    place = np.linspace(-1.0, 1.0, size + 2)[1:-1]
    weight = np.square(1.0 - np.square(place))
    weight /= weight.sum()
    begins, ends = stretch_bounds(sampled.stretch)
    first = np.flatnonzero(np.arange(size, len(ends) + size) <= ends)
    if not first.size:
        raise FitError(
            f"weak form: no unbroken stretch of samples is {window:g} s long; shorten the window or"
            " give logs with fewer gaps"
        )
    # windows every so many samples, counted from the start of each stretch
    first = first[(first - begins[first]) % max(round(every * size), 1) == 0]
    joined = np.concatenate((sampled.x, sampled.y), axis=1)
    size_of_block = max(_BLOCK // (size * joined.shape[1]), 1)
    parts = []
    view = np.lib.stride_tricks.sliding_window_view(joined, size, axis=0)
    for begin in range(0, first.size, size_of_block):
        parts.append(view[first[begin : begin + size_of_block]] @ weight)
    out = np.concatenate(parts)
    return Rows(out[:, : sampled.x.shape[1]], out[:, sampled.x.shape[1] :], sampled.stretch[first])


def unbroken_stretches(group: np.ndarray, t: np.ndarray, step: float) -> np.ndarray:
    """Return the number of the unbroken stretch of each sample [N], ascending from 0.

    Args:
        group: manoeuvre of each sample [N], ascending.
        t: time of each sample within its manoeuvre [N], s.
        step: time between neighbouring samples, s.
    """
    broken = (np.diff(group) != 0) | (np.abs(np.diff(t) - step) > 0.01 * step)
    return np.concatenate(([0], np.cumsum(broken)))


def step_of(group: np.ndarray, t: np.ndarray) -> float:
    """Return the time between samples: the median distance of neighbours in one manoeuvre, s.

    Raises:
        FitError: where no manoeuvre has two samples.
    """
    apart = np.diff(t)[np.diff(group) == 0]
    if not apart.size or float(np.median(apart)) <= 0:
        raise FitError(
            "no manoeuvre has two samples at different times; the step between samples is not known"
        )
    return float(np.median(apart))


def correlation_time(residual: np.ndarray) -> np.ndarray:
    """Return how many neighbouring rows tell as much as one independent row, [K], at least 1.

    1 + 2 sum rho over the first lags until rho is negative (initial positive sequence).
    """
    n = len(residual)
    centred = residual - residual.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:n]
    rho = covariance / np.maximum(covariance[0], _TINY)
    # noise of an estimate of zero: what is less than two of its deviations ends the sum
    positive = np.cumprod(rho > 2.0 / np.sqrt(n), axis=0).astype(bool)
    return np.asarray(np.maximum(2.0 * np.where(positive, rho, 0.0).sum(axis=0) - 1.0, 1.0))
