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
from residnet.core.stretches import stretches


class Derivative(Config, ABC):
    """A rule that smooths and differentiates channels on a uniform grid.

    Where it has no smoother the values stay as they are, and where it has no rate of its own that
    is the difference to the next sample; the last sample of a piece is then invalid.
    """

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
        shortest = self.shortest(step)
        smooth, rate = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
        runs = stretches(np.where(np.isfinite(values).all(axis=1), pieces, -1))
        for start, stop in zip(*runs, strict=True):
            part = slice(start, stop)
            if stop - start >= shortest:
                smooth[part], rate[part] = self.piece(values[part], step)
        valid = np.isfinite(rate).all(axis=1)
        smooth[~valid], rate[~valid] = np.nan, np.nan
        return smooth, rate, valid

    def shortest(self, step: float) -> int:
        """Return fewest samples of a piece that the rule can treat.

        Raises:
            ConfigError: where the rule does not go with the step.
        """
        return 2

    def piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed values and rates [T, n] of one piece, NaN where there is no rate."""
        rate = np.full(values.shape, np.nan)
        rate[:-1] = np.diff(values, axis=0)
        return values, rate / step


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

    def shortest(self, step: float) -> int:
        if self.samples(step) <= self.order:
            needed = (self.order + 1 | 1) * step
            raise ConfigError(
                f"savitzky_golay: a window of {self.window:g} s holds {self.samples(step)} samples"
                f" of {step:g} s, order {self.order} needs more; set window to {needed:g} s or"
                " longer"
            )
        return self.samples(step)

    def piece(self, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        return local_polynomials(values, self.samples(step), self.order, step)


def local_polynomials(
    values: np.ndarray, size: int, order: int, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return values [T, n] smoothed by polynomials over `size` samples, an odd number, and rates.

    As scipy.signal.savgol_filter, whose import takes longer than most checks of a config. The rates
    are per s for a step in s.
    """
    half = size // 2
    powers, fit, slopes = _fitting(size, order)
    first, last = fit @ values[:size], fit @ values[-size:]
    out = []
    for rows in (powers, slopes / (half * step)):
        weights = rows[half] @ fit
        inner = [np.correlate(column, weights, "valid") for column in values.T]
        ends = rows[:half] @ first, rows[half + 1 :] @ last
        out.append(np.concatenate((ends[0], np.stack(inner, axis=1), ends[1])))
    return out[0], out[1]


@cache
def _fitting(size: int, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return powers [size, order + 1] of places from -1 to 1, their inverse and their slopes."""
    powers = np.vander(np.linspace(-1.0, 1.0, size), order + 1, increasing=True)
    slopes = np.zeros_like(powers)
    slopes[:, 1:] = powers[:, :-1] * np.arange(1, order + 1)
    return powers, np.linalg.pinv(powers), slopes


@final
class ForwardDifference(Derivative):
    """The difference to the next sample; values are not smoothed.

    The last sample of a piece is invalid.
    """

    kind: Literal["forward"] = "forward"


DerivativeConfig = Annotated[SavitzkyGolay | ForwardDifference, Field(discriminator="kind")]
"""Any rule for derivatives; its `kind` says which."""
