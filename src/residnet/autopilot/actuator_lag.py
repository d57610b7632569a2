"""Lag of actuators fitted with a force residual, by variable projection.

For each candidate lag the regression is linear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
import torch
from torch import Tensor

from residnet.autopilot.motion import ActuatorLag
from residnet.core.errors import FitError

_LEAST, _MOST = np.array([0.1, 0.1, 0.0]), np.array([30.0, 3.0, 2.0])


def followed(command: Tensor, lag: ActuatorLag, dt: float, runs: Sequence[int] = ()) -> Tensor:
    """Return the force [N, c] that follows a command [N, c] sampled every dt seconds.

    The command is straight between samples and at rest before.

    `runs` are the lengths of several runs that stand one after another, each at rest before; empty
    for one.
    """
    if len(runs) > 1:
        return torch.cat([followed(part, lag, dt) for part in command.split(list(runs))])
    u = _delayed(command.numpy(), lag.delay, dt)
    w, z = lag.frequency, lag.damping
    # exact for inputs that are straight lines between samples: one matrix exponential of the state,
    # the input and its slope
    a = np.zeros((4, 4))
    a[0, 1] = 1.0
    a[1] = [-w * w, -2 * z * w, w * w, 0.0]
    a[2, 3] = 1.0
    e = scipy.linalg.expm(a * dt)
    step, held, slope = e[:2, :2], e[:2, 2], e[:2, 3] / dt
    # x[k+1] = S x[k] + (h - g) u[k] + g u[k+1]; y = x[0] as a transfer function of order two
    trace, determinant = np.trace(step), np.linalg.det(step)
    g, b = slope, held - slope
    # y = C (zI - S)^-1 (b + g z) u with C = [1, 0]: (z - s22) (b0 + g0 z) + s12 (b1 + g1 z)
    s12, s22 = step[0, 1], step[1, 1]
    numerator = [g[0], b[0] - s22 * g[0] + s12 * g[1], -s22 * b[0] + s12 * b[1]]
    return torch.from_numpy(scipy.signal.lfilter(numerator, [1.0, -trace, determinant], u, axis=0))


def _delayed(u: np.ndarray, delay: float, dt: float) -> np.ndarray:
    """u [N, c] `delay` seconds later, straight between samples, at rest before."""
    k, share = int(delay / dt), delay / dt % 1.0
    early = np.concatenate((np.zeros((k + 1, u.shape[1])), u))
    out: np.ndarray = (1 - share) * early[1 : len(u) + 1] + share * early[: len(u)]
    return out


def fit_lag(
    command: Tensor,
    needed: Tensor,
    basis: Tensor,
    dt: float,
    use: Tensor | None = None,
    runs: Sequence[int] = (),
) -> ActuatorLag:
    """Return the lag under which F_believed + basis explains the followed command best.

    Args:
        command: tau_c [N, 3], uniform in time, from rest on.
        needed: F_believed(nu_dot, nu) [N, 3].
        basis: regressors [N, J], without the constant.
        dt: sampling interval in s.
        use: samples to count [N] bool; None for all.
        runs: lengths of the runs that stand one after another; empty for one.

    Raises:
        FitError: where the command does not vary, or the search ends at a bound.
    """
    if bool((command.std(0) == 0).all()):
        raise FitError(
            "the command is constant: no lag shows in it; give a run with changing commands"
        )
    keep = torch.ones(len(command), dtype=torch.bool) if use is None else use
    x = basis[keep] - basis[keep].mean(0)
    q, r = torch.linalg.qr(x / x.std(0).clamp(min=1e-300))
    q = q[:, r.diagonal().abs() > 1e-9 * r.diagonal().abs().max()]

    def unexplained(y: Tensor) -> Tensor:
        y = y - y.mean(0)
        left: Tensor = y - q @ (q.T @ y)
        return left

    def miss(p: np.ndarray) -> np.ndarray:
        lag = ActuatorLag(frequency=float(p[0]), damping=float(p[1]), delay=float(p[2]))
        force = followed(command, lag, dt, runs)[keep]
        # in units of the followed force itself: a lag that lets nothing through would leave nothing
        # to explain
        out: np.ndarray = (
            (unexplained(force - needed[keep]) / force.std(0).clamp(min=1e-300)).numpy().ravel()
        )
        return out

    # a search may end beside the lag: at a bound, or in a hollow of its own
    searches = [
        scipy.optimize.least_squares(
            miss,
            np.array([frequency, 0.8, delay]),
            bounds=(_LEAST, _MOST),
            x_scale=[1.0, 0.3, 0.1],
            diff_step=[1e-4] * 3,
            max_nfev=60,
        )
        for frequency in (1.0, 3.0, 8.0)
        for delay in (0.05, 0.5)
    ]
    found = min(searches, key=lambda one: float(one.cost))
    return _lag_within_bounds(found.x)


def _lag_within_bounds(p: np.ndarray) -> ActuatorLag:
    """Return the lag of frequency, damping and delay [3]; FitError where one ends at a bound."""
    inside = [
        low * 1.02 < value < high * 0.98 or (low == 0.0 and value < 0.98 * high)
        for value, low, high in zip(p, _LEAST, _MOST, strict=True)
    ]
    names = ("frequency", "damping", "delay")
    at_bound = [name for name, fine in zip(names, inside, strict=True) if not fine]
    if at_bound:
        raise FitError(
            f"the lag's {at_bound[0]} ends at the bound of its search ({p[0]:.3g} rad/s,"
            f" {p[1]:.3g}, {p[2]:.3g} s): the data show no lag; give a run in which the command"
            " changes faster"
        )
    return ActuatorLag(frequency=float(p[0]), damping=float(p[1]), delay=float(p[2]))
