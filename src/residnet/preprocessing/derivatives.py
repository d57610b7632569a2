"""Rates of change of sampled channels, piece by piece and never across a gap.

Positions and velocities are measured, accelerations hardly ever: they are differentiated here, and
the smoothing that goes with it is stated.
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
    """A rule that smooths and differentiates channels on a uniform grid.

    Where it has no smoother the values stay as they are, and where it has no rate of its own that
    is the difference to the next sample; the last sample of a piece is then invalid.
    """

    def derive(
        self, values: np.ndarray, dt: float, segments: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the smoothed values and their rates.

        A piece is a run of samples with one number >= 0; it is cut further at samples that are not
        finite, and nothing is smoothed across its ends.

        Args:
            values: channels [T, n], SI, angles unwrapped.
            dt: time between samples, s.
            segments: number of each sample's piece [T] int, -1 for samples of none
                (`residnet.preprocessing.masks.segments`).

        Returns:
            smooth [T, n] and rate [T, n] in SI (per second), and valid [T] bool; both arrays are
            NaN where valid is False.

        Raises:
            ConfigError: where a window or cut-off does not go with the step.
        """
        min_samples = self.min_samples(dt)
        smoothed, rates = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
        segment_bounds = find_runs(np.where(np.isfinite(values).all(axis=1), segments, -1))
        for start, stop in zip(*segment_bounds, strict=True):
            segment_slice = slice(start, stop)
            if stop - start >= min_samples:
                smoothed[segment_slice], rates[segment_slice] = self.derive_segment(
                    values[segment_slice], dt
                )
        is_valid = np.isfinite(rates).all(axis=1)
        smoothed[~is_valid], rates[~is_valid] = np.nan, np.nan
        return smoothed, rates, is_valid

    def min_samples(self, dt: float) -> int:
        """Return fewest samples of a piece that the rule can treat.

        Raises:
            ConfigError: where the rule does not go with the step.
        """
        return 2

    def derive_segment(self, values: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed values and rates [T, n] of one piece, NaN where there is no rate."""
        rates = np.full(values.shape, np.nan)
        rates[:-1] = np.diff(values, axis=0)
        return values, rates / dt


@final
class SavitzkyGolay(DerivativeRule):
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

    def n_window_samples(self, dt: float) -> int:
        """Return the samples in the window at a time step in s."""
        return round(self.window / dt) // 2 * 2 + 1

    def min_samples(self, dt: float) -> int:
        if self.n_window_samples(dt) <= self.order:
            min_window = (self.order + 1 | 1) * dt
            raise ConfigError(
                f"savitzky_golay: a window of {self.window:g} s holds {self.n_window_samples(dt)} samples"
                f" of {dt:g} s, order {self.order} needs more; set window to {min_window:g} s or"
                " longer"
            )
        return self.n_window_samples(dt)

    def derive_segment(self, values: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        return fit_local_polynomials(values, self.n_window_samples(dt), self.order, dt)


def fit_local_polynomials(
    values: np.ndarray, window_samples: int, order: int, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return values [T, n] smoothed by polynomials over `window_samples` samples, an odd number, and rates.

    As scipy.signal.savgol_filter, whose import takes longer than most checks of a config. The rates
    are per s for a step in s.
    """
    half_window = window_samples // 2
    vandermonde, pseudo_inverse, vandermonde_slopes = _polynomial_matrices(window_samples, order)
    first_coefficients, last_coefficients = (
        pseudo_inverse @ values[:window_samples],
        pseudo_inverse @ values[-window_samples:],
    )
    results = []
    for evaluation_matrix in (vandermonde, vandermonde_slopes / (half_window * dt)):
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
    """Return powers [size, order + 1] of places from -1 to 1, their inverse and their slopes."""
    vandermonde = np.vander(np.linspace(-1.0, 1.0, window_samples), order + 1, increasing=True)
    vandermonde_slopes = np.zeros_like(vandermonde)
    vandermonde_slopes[:, 1:] = vandermonde[:, :-1] * np.arange(1, order + 1)
    return vandermonde, np.linalg.pinv(vandermonde), vandermonde_slopes


@final
class ForwardDifference(DerivativeRule):
    """The difference to the next sample; values are not smoothed.

    The last sample of a piece is invalid.
    """

    kind: Literal["forward"] = "forward"


DerivativeConfig = Annotated[SavitzkyGolay | ForwardDifference, Field(discriminator="kind")]
"""Any rule for derivatives; its `kind` says which."""
