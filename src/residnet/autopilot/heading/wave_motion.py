"""Wave-frequency heading motion of a vessel, estimated from the spectrum of yaw rates in logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

_PERIOD_LIMITS: Final = (1.5, 20.0)
"""Range of peak periods in s of the search."""
_BAND: Final = (0.7, 1.8)
"""Wave band relative to the peak frequency, as of simulated wave motion."""
_SEGMENT_TIME: Final = 60.0
"""Length in s of the segments of Welch's method: three of the longest periods."""
_MIN_SEGMENTS: Final = 3
"""Minimum number of segments in a record."""
_MIN_PEAK_RATIO: Final = 5.0
"""Minimum ratio of the density at the peak to that at half of its frequency, and to the noise.

A slow disturbance (Gauss-Markov process) has a density that decreases with the frequency, and white
noise a constant one; neither has a peak.
"""


class WaveMotion(NamedTuple):
    """Wave-frequency heading motion.

    Attributes:
        heading_std: standard deviation of the heading in rad.
        period: peak period in s.
    """

    heading_std: float
    period: float


def estimate_wave_motion(residuals: Sequence[np.ndarray], dt: float) -> WaveMotion | None:
    """Estimate the wave-frequency motion from yaw rates without their response to the rudder.

    Args:
        residuals: measured minus simulated yaw rates [N] in rad/s, one array for each record.
        dt: time step in s.

    Returns:
        The motion of the record with the largest one; None if no spectrum has a peak in the band of
        waves.
    """
    from scipy.signal import welch

    motions = []
    segment = round(_SEGMENT_TIME / dt)
    for residual in residuals:
        if len(residual) < _MIN_SEGMENTS * segment // 2:
            continue
        frequency, density = welch(residual, fs=1.0 / dt, nperseg=segment)
        # a peak needs its band and some of the noise beyond it below the Nyquist frequency
        highest = min(1.0 / _PERIOD_LIMITS[0], frequency[-1] / (1.2 * _BAND[1]))
        is_candidate = (frequency >= 1.0 / _PERIOD_LIMITS[1]) & (frequency <= highest)
        if not is_candidate.any():
            continue
        peak = int(np.argmax(np.where(is_candidate, density, 0.0)))
        peak_frequency = float(frequency[peak])
        is_wave = (frequency >= _BAND[0] * peak_frequency) & (
            frequency <= _BAND[1] * peak_frequency
        )
        floor = float(np.median(density[frequency > _BAND[1] * peak_frequency]))
        density_below_peak = float(np.interp(0.5 * peak_frequency, frequency, density))
        if density[peak] < _MIN_PEAK_RATIO * max(floor, density_below_peak):
            continue
        # the heading is the integral of the yaw rate
        angle_density = (density[is_wave] - floor).clip(min=0.0) / (
            2.0 * np.pi * frequency[is_wave]
        ) ** 2
        variance = float(angle_density.sum() * (frequency[1] - frequency[0]))
        motions.append(WaveMotion(math.sqrt(variance), 1.0 / peak_frequency))
    return max(motions, default=None)
