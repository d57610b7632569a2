"""Rates of change of sampled channels, piece by piece and never across a gap.

Positions and velocities are measured, accelerations hardly ever: they are differentiated here, and
the smoothing that goes with it is stated.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, final

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Hertz, Seconds
from residnet.core.errors import ConfigError
from residnet.core.stretches import stretches


class Derivative(Config, ABC):
    """A rule that smooths and differentiates channels on a uniform grid."""

    def derive(
        self, values: np.ndarray, step: float, pieces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the smoothed values and their rates.

        A piece is a run of samples with one number >= 0; it is cut further at samples that are not
        finite, and nothing is smoothed across its ends.

        Args:
            values: channels [T, n], SI, angles unwrapped.
            step: time between samples, s.
            pieces: number of each sample's piece [T] int, -1 for samples of none
                (`residnet.data.masks.segments`).

        Returns:
            smooth [T, n] and rate [T, n] in SI (per second), and valid [T] bool; both arrays are
            NaN where valid is False.

        Raises:
            ConfigError: where a window or cut-off does not go with the step.
        """
        self._check(step)
        smooth, rate = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
        for start, stop in _runs(values, pieces):
            part = slice(start, stop)
            if stop - start >= self._shortest(step):
                smooth[part], rate[part] = self._piece(values[part], step)
        valid = np.isfinite(rate).all(axis=1) & (pieces >= 0)
        smooth[~valid], rate[~valid] = np.nan, np.nan
        return smooth, rate, valid

    def _check(self, step: float) -> None:
        """Raises ConfigError where the rule does not go with the step."""

    @abstractmethod
    def _shortest(self, step: float) -> int:
        """Return fewest samples of a piece that the rule can treat."""

    @abstractmethod
    def _piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed values and rates of one piece, NaN where the rule has no rate."""


@final
class SavitzkyGolay(Derivative):
    """Savitzky-Golay smoothing: polynomials fitted to a moving window.

    The window is made an odd number of samples, rounded up.

    Near the ends of a piece the polynomial of the last full window is evaluated; a piece shorter
    than the window is invalid.

    Attributes:
        window: length of the window in s.
        order: of the polynomials.
    """

    kind: Literal["savitzky_golay"] = "savitzky_golay"
    window: Seconds = Field(default=1.5, gt=0.0)
    order: int = Field(default=2, ge=1)

    def samples(self, step: float) -> int:
        """Return the samples in the window at a time step in s."""
        return round(self.window / step) // 2 * 2 + 1

    def _check(self, step: float) -> None:
        if self.samples(step) <= self.order:
            needed = (self.order + 1 | 1) * step
            raise ConfigError(
                f"savitzky_golay: a window of {self.window:g} s holds {self.samples(step)} samples"
                f" of {step:g} s, order {self.order} needs more; set window to {needed:g} s or"
                " longer"
            )

    def _shortest(self, step: float) -> int:
        return self.samples(step)

    def _piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        size, half = self.samples(step), self.samples(step) // 2
        # as scipy.signal.savgol_filter, whose import takes longer than most checks
        powers = np.vander(np.linspace(-1.0, 1.0, size), self.order + 1, increasing=True)
        fit = np.linalg.pinv(powers)
        slopes = np.zeros_like(powers)
        slopes[:, 1:] = powers[:, :-1] * np.arange(1, self.order + 1)
        first, last = fit @ values[:size], fit @ values[-size:]
        out = []
        span = half * step
        for rows, middle in ((powers, fit[0]), (slopes / span, fit[1] / span)):
            inner = [np.correlate(column, middle, "valid") for column in values.T]
            ends = rows[:half] @ first, rows[half + 1 :] @ last
            out.append(np.concatenate((ends[0], np.stack(inner, axis=1), ends[1])))
        return out[0], out[1]


@final
class BackwardDifference(Derivative):
    """The difference to the sample before; values are not smoothed.

    The first sample of a piece is invalid.
    """

    kind: Literal["backward"] = "backward"

    def _shortest(self, step: float) -> int:
        return 2

    def _piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        rate = np.full(values.shape, np.nan)
        rate[1:] = np.diff(values, axis=0) / step
        return values, rate


@final
class ForwardDifference(Derivative):
    """The difference to the next sample; values are not smoothed.

    The last sample of a piece is invalid.
    """

    kind: Literal["forward"] = "forward"

    def _shortest(self, step: float) -> int:
        return 2

    def _piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        return values, _forward(values, step)


@final
class Butterworth(Derivative):
    """A Butterworth low-pass run forward and backward (zero phase), then the forward difference.

    Attributes:
        order: of the filter, for one of the two passes.
        cutoff: frequency of half gain in Hz.

    Source: document 000, section 7.3; correction H27.

    The two passes square the magnitude: the gain at `cutoff` is 1/2, not 1/sqrt(2). The document's
    normalised cut-off is a share of the Nyquist frequency: its 0.1 at 20 Hz is 1 Hz here. The last
    sample of a piece is invalid, as is a piece no longer than the filter's padding.
    """

    kind: Literal["butterworth"] = "butterworth"
    order: int = Field(default=2, ge=1, le=8)
    cutoff: Hertz = Field(gt=0.0)

    def _check(self, step: float) -> None:
        if self.cutoff >= 0.5 / step:
            raise ConfigError(
                f"butterworth: cutoff {self.cutoff:g} Hz is not below the Nyquist frequency"
                f" {0.5 / step:g} Hz of a step of {step:g} s; lower it"
            )

    def _shortest(self, step: float) -> int:
        return self._padding + 2

    @property
    def _padding(self) -> int:
        return 3 * (self.order + 1)

    def _piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        from scipy.signal import butter, filtfilt

        b, a = butter(self.order, self.cutoff, fs=1.0 / step)
        smooth = filtfilt(b, a, values, axis=0, padlen=self._padding)
        return smooth, _forward(smooth, step)


DerivativeConfig = Annotated[
    SavitzkyGolay | BackwardDifference | ForwardDifference | Butterworth,
    Field(discriminator="kind"),
]
"""Any rule for derivatives; its `kind` says which."""


def _forward(values: np.ndarray, step: float) -> np.ndarray:
    rate = np.full(values.shape, np.nan)
    rate[:-1] = np.diff(values, axis=0) / step
    return rate


def _runs(values: np.ndarray, pieces: np.ndarray) -> list[tuple[int, int]]:
    """Return the first index and the index past the last of every contiguous, finite run."""
    number = np.where(np.isfinite(values).all(axis=1), pieces, -1)
    starts, stops = stretches(number)
    return list(zip(starts.tolist(), stops.tolist(), strict=True))
