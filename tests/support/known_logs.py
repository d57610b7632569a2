"""Logs whose every derivative is known in closed form."""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log


def wavy(step: float = 0.1, seconds: float = 200.0, name: str = "wavy", lag: float = 0.0) -> Log:
    """A weaving vessel: psi, u, v sums of sines; x, y by a fine trapezoid; u, v, r shown `lag` s
    late; one rudder channel.
    """
    fine = np.arange(0.0, seconds, step / 20.0)

    def psi(t: np.ndarray) -> np.ndarray:
        return 0.3 + 1.2 * np.sin(0.05 * t) + 0.1 * np.sin(0.31 * t)

    def r(t: np.ndarray) -> np.ndarray:
        return 0.06 * np.cos(0.05 * t) + 0.031 * np.cos(0.31 * t)

    def u(t: np.ndarray) -> np.ndarray:
        return 2.0 + 0.5 * np.sin(0.11 * t)

    def v(t: np.ndarray) -> np.ndarray:
        return 0.4 * np.sin(0.23 * t + 1.0)

    def integral(rate: np.ndarray) -> np.ndarray:
        return np.append(0.0, np.cumsum(0.5 * (fine[1] - fine[0]) * (rate[1:] + rate[:-1])))[::20]

    c, s = np.cos(psi(fine)), np.sin(psi(fine))
    t = fine[::20]
    channels = {
        "x": integral(c * u(fine) - s * v(fine)),
        "y": integral(s * u(fine) + c * v(fine)),
        "psi": psi(t),
        "u": u(t - lag),
        "v": v(t - lag),
        "r": r(t - lag),
        "delta": 0.5 * np.sin(0.37 * t),
    }
    return Log(name, t, channels)
