"""A fixed-interval smoother along one axis whose position and rate come at any times, or never.

A triple integrator driven by white jerk is filtered forwards and smoothed backwards (Rauch, Tung
and Striebel, 1965). The intensity of the jerk, and with it the noise, is the one under which the
measurements are likeliest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_LEVELS = 10.0 ** (0.5 * np.arange(-8, 5))
"""Jerk in units of the noise over the cube of the usual interval between positions."""
_TRIED = 4000
"""Samples from which the intensity of the jerk is found."""


class Track(NamedTuple):
    """Smoothed motion along axes that are measured together.

    Attributes:
        position: [T, A].
        rate: [T, A].
        spread: standard deviation of the position at each sample [T].
    """

    position: np.ndarray
    rate: np.ndarray
    spread: np.ndarray


def smooth_track(t: np.ndarray, position: np.ndarray, rate: np.ndarray, ratio: float) -> Track:
    """Return the smoothed motion at every time.

    Args:
        t: times [T] in s, increasing.
        position: measured [T, A]; a row of NaN where there is no measurement.
        rate: the same of the rate of change [T, A].
        ratio: noise of the rate over that of the position, 1/s.
    """
    seen = np.isfinite(position).all(axis=1)
    usual = float(np.median(np.diff(t[seen]))) if seen.sum() > 1 else 1.0
    jerks = _LEVELS / usual**3
    head = slice(0, min(t.size, _TRIED))
    tried = _Filter(t[head], position[head], rate[head], ratio, jerks)
    level = int(np.argmin(tried.cost))
    whole = _Filter(t, position, rate, ratio, jerks[level : level + 1])
    return whole.smoothed()


class _Filter:
    """The filter at several intensities of jerk at once; noise of the position 1.

    Args:
        t: times [T].
        position: measured [T, A].
        rate: measured [T, A].
        ratio: noise of the rate.
        jerks: intensities [K].
    """

    def __init__(
        self,
        t: np.ndarray,
        position: np.ndarray,
        rate: np.ndarray,
        ratio: float,
        jerks: np.ndarray,
    ) -> None:
        count, axes, size = jerks.size, position.shape[1], t.size
        self._steps = _transitions(np.diff(t, prepend=t[0]))
        driven = jerks[:, None, None] ** 2 * _driven(np.diff(t, prepend=t[0]))[:, None]
        first = int(np.argmax(np.isfinite(position).all(axis=1)))
        x = np.zeros((count, 3, axes))
        x[:, 0] = position[first]
        # nothing is known of rate and acceleration at the start
        wide = np.ptp(position[np.isfinite(position).all(axis=1)], axis=0).max(initial=0.0) + 1.0
        p = np.tile(np.diag([wide**2, wide**2, wide**2]).astype(float), (count, 1, 1))
        self._before = np.empty((size, count, 3, axes)), np.empty((size, count, 3, 3))
        self._after = np.empty((size, count, 3, axes)), np.empty((size, count, 3, 3))
        misfit, spread, seen = np.zeros(count), np.zeros(count), 0
        measured = ((0, position, 1.0), (1, rate, max(ratio, 1e-6) ** 2))
        known = [np.isfinite(values).all(axis=1) for _, values, _ in measured]
        for k in range(size):
            if k:
                x = self._steps[k] @ x
                p = self._steps[k] @ p @ self._steps[k].T + driven[k]
            self._before[0][k], self._before[1][k] = x, p
            for (row, values, noise), there in zip(measured, known, strict=True):
                if not there[k]:
                    continue
                innovation = p[:, row, row] + noise
                gain = p[:, :, row] / innovation[:, None]
                miss = values[k] - x[:, row]
                x = x + gain[:, :, None] * miss[:, None, :]
                p = p - gain[:, :, None] * p[:, row, None, :]
                misfit += (miss**2).sum(axis=1) / innovation
                spread += axes * np.log(innovation)
                seen += axes
            self._after[0][k], self._after[1][k] = x, p
        self._noise = np.sqrt(np.maximum(misfit / max(seen, 1), 1e-30))
        # the noise itself is the one that suits each intensity best
        self.cost = seen * np.log(self._noise**2) + spread

    def smoothed(self) -> Track:
        """Return the track of the first intensity, smoothed backwards."""
        xb, pb = self._before[0][:, 0], self._before[1][:, 0]
        xa, pa = self._after[0][:, 0], self._after[1][:, 0]
        gains = np.zeros_like(pa)
        gains[:-1] = pa[:-1] @ self._steps[1:].transpose(0, 2, 1) @ np.linalg.pinv(pb[1:])
        x, p = xa.copy(), pa.copy()
        for k in range(len(x) - 2, -1, -1):
            x[k] += gains[k] @ (x[k + 1] - xb[k + 1])
            p[k] += gains[k] @ (p[k + 1] - pb[k + 1]) @ gains[k].T
        spread = self._noise[0] * np.sqrt(np.maximum(p[:, 0, 0], 0.0))
        return Track(x[:, 0], x[:, 1], spread)


def _transitions(dt: np.ndarray) -> np.ndarray:
    """Return the transition over each step, [T, 3, 3]."""
    out = np.tile(np.eye(3), (dt.size, 1, 1))
    out[:, 0, 1] = out[:, 1, 2] = dt
    out[:, 0, 2] = dt**2 / 2
    return out


def _driven(dt: np.ndarray) -> np.ndarray:
    """Return the covariance that white jerk of unit intensity adds over each step, [T, 3, 3]."""
    a, b, c, d, e = dt**5 / 20, dt**4 / 8, dt**3 / 6, dt**3 / 3, dt**2 / 2
    return np.stack(
        (
            np.stack((a, b, c), axis=-1),
            np.stack((b, d, e), axis=-1),
            np.stack((c, e, dt), axis=-1),
        ),
        axis=-2,
    )
