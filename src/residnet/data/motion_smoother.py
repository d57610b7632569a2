"""A fixed-interval smoother of pose, velocity and acceleration along each earth axis.

All three are measured with known noise and brought into one motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.errors import DataError

_JERKS = tuple(10.0 ** (0.5 * k) for k in range(-6, 3))


def smooth_motion(seen: np.ndarray, noise: Sequence[float], dt: float) -> np.ndarray:
    """Return the smoothed motion [N, 9] from x, y, psi, u, v, r, u_dot, v_dot, r_dot [N, 9], SI.

    Each axis is a triple integrator driven by white jerk, north and east in the earth with the
    smoothed heading; the intensity of the jerk is the one under which the measurements are
    likeliest. A Rauch-Tung-Striebel smoother with constant gains: the past and the future of a
    sample count alike, so nothing lags.

    Args:
        seen: measured, the heading unwrapped; a quantity without a measurement has an infinite
            noise.
        noise: standard deviations of the nine.
        dt: sampling interval in s.

    Raises:
        DataError: where a value is not finite.
    """
    if not np.isfinite(seen).all():
        row, column = (int(part[0]) for part in np.nonzero(~np.isfinite(seen)))
        raise DataError(
            f"measured motion: column {column} is not finite at sample {row}; mask or fill the gap"
            " first"
        )
    spread = np.maximum(np.asarray(noise, dtype=np.float64), 1e-9)
    heading = _axis(seen[:, [2, 5, 8]], spread[[2, 5, 8]], dt)
    psi, r = heading[:, 0], heading[:, 1]
    c, s = np.cos(psi), np.sin(psi)
    u, v = seen[:, 3], seen[:, 4]
    along, across = seen[:, 6] - r * v, seen[:, 7] + r * u
    north = _axis(
        np.stack((seen[:, 0], c * u - s * v, c * along - s * across), axis=1), spread[[0, 3, 6]], dt
    )
    east = _axis(
        np.stack((seen[:, 1], s * u + c * v, s * along + c * across), axis=1), spread[[1, 4, 7]], dt
    )
    u, v = c * north[:, 1] + s * east[:, 1], c * east[:, 1] - s * north[:, 1]
    along, across = c * north[:, 2] + s * east[:, 2], c * east[:, 2] - s * north[:, 2]
    out: np.ndarray = np.stack(
        (north[:, 0], east[:, 0], psi, u, v, r, along + r * v, across - r * u, heading[:, 2]),
        axis=1,
    )
    return out


def _axis(z: np.ndarray, spread: np.ndarray, dt: float) -> np.ndarray:
    """Return the smoothed position, velocity and acceleration [N, 3]."""
    step = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    driven = np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
    known = np.isfinite(spread)
    h, noise = np.eye(3)[known], np.diag(spread[known] ** 2)
    z = z[:, known]
    best: tuple[float, np.ndarray] | None = None
    for jerk in _JERKS:
        before = _riccati(step, jerk**2 * driven, h, noise)
        innovation = h @ before @ h.T + noise
        gain = before @ h.T @ np.linalg.inv(innovation)
        after = before - gain @ h @ before
        filtered, cost = _filter(z, step, h, gain, innovation)
        if best is None or cost < best[0]:
            best = cost, _backwards(filtered, step, after @ step.T @ np.linalg.inv(before))
    assert best is not None
    return best[1]


def _riccati(step: np.ndarray, driven: np.ndarray, h: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the covariance of the prediction that the filter settles at."""
    from scipy.linalg import solve_discrete_are

    out: np.ndarray = solve_discrete_are(step.T, h.T, driven, noise)
    return out


def _filter(
    z: np.ndarray, step: np.ndarray, h: np.ndarray, gain: np.ndarray, innovation: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the filtered states [N, 3], and minus twice the mean log-likelihood."""
    x = np.zeros(3)
    x[: h.shape[1]] = h.T @ z[0]
    out, misses = np.empty((len(z), 3)), np.empty_like(z)
    for k, row in enumerate(z):
        x = step @ x if k else x
        misses[k] = row - h @ x
        x = x + gain @ misses[k]
        out[k] = x
    weighed = (misses @ np.linalg.inv(innovation) * misses).sum(1)
    return out, float(weighed[100:].mean() + np.linalg.slogdet(innovation)[1])


def _backwards(filtered: np.ndarray, step: np.ndarray, gain: np.ndarray) -> np.ndarray:
    out = filtered.copy()
    for k in range(len(out) - 2, -1, -1):
        out[k] += gain @ (out[k + 1] - step @ filtered[k])
    return out
