"""Results of a reconstruction: motion, instrument errors and residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

_MIN_T_STATISTIC = 3.5
"""Smallest ratio of a significant error to its standard error."""
_MAX_GROWTH = 3.0
"""Largest growth of the standard error of an error that the sensors determine."""


class Prior(NamedTuple):
    """Normal prior of an instrument error.

    Attributes:
        mean: expected value.
        std: standard deviation.
    """

    mean: float
    std: float


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated instrument error.

    Attributes:
        value: estimate in SI units.
        statistical_error: larger one of the standard errors from the curvature and from a jackknife
            over sections of the log; clocks also have the error of the grid of nodes.
        change: change of the value if the jerk intensities are ten times larger.
        growth: factor on the standard error if the jerk intensities are a hundred times larger.
        prior_std: standard deviation of the prior.
    """

    value: float
    statistical_error: float
    change: float
    growth: float
    prior_std: float

    @property
    def is_independent_of_smoothness(self) -> bool:
        """Whether less smoothness changes the value by no more than its standard error.

        This is a specification test (Hausman 1978, Econometrica 46).
        """
        return self.growth <= _MAX_GROWTH and abs(self.change) <= self.statistical_error

    @property
    def standard_error(self) -> float:
        """Standard error; it contains the change of the value under less smoothness."""
        growth = 1.0 if self.is_independent_of_smoothness else self.growth
        return float(np.hypot(growth * self.statistical_error, self.change))

    @property
    def is_determined(self) -> bool:
        """Whether sensors determine the error; otherwise the smoothness of the motion does.

        The effect of smoothness is a bias of unknown size, for which there is no interval.
        """
        return self._has_information and self.is_independent_of_smoothness

    @property
    def is_significant(self) -> bool:
        """Whether the error differs from zero by 3.5 standard errors.

        An error can be significant although no sensor determines its size.
        """
        return self._has_information and abs(self.value) > _MIN_T_STATISTIC * self.standard_error

    @property
    def _has_information(self) -> bool:
        """Whether the data narrow the prior to half."""
        return self.standard_error < 0.5 * self.prior_std


@dataclass(frozen=True)
class SensorFit:
    """Residuals of a sensor.

    Attributes:
        noise_std: standard deviation of the noise in the unit of the values.
        autocorrelation: correlation of successive residuals.
        outlier_share: share of residuals beyond five standard deviations.
    """

    noise_std: float
    autocorrelation: float
    outlier_share: float


@dataclass(frozen=True)
class Reconstruction:
    """Reconstructed motion of a log.

    Attributes:
        t: times of the nodes [K] in s.
        states: x, y, psi, u, v, r through the water, and the derivatives of u, v, r, [K, 9].
        errors: name -> estimate.
        sensors: name of a sensor -> its residuals.
        jerk_intensity: power spectral densities of the jerk of u, v, r.
        deviance: minus twice the logarithm of the evidence.
        n_measurements: number of measured values.
    """

    t: np.ndarray
    states: np.ndarray
    errors: dict[str, ErrorEstimate]
    sensors: dict[str, SensorFit]
    jerk_intensity: np.ndarray
    deviance: float
    n_measurements: int

    @property
    def bic(self) -> float:
        """Bayesian information criterion."""
        return self.deviance + len(self.errors) * float(np.log(max(self.n_measurements, 2)))
