"""Estimate the lag of actuators together with a regression of the residual force.

The method is variable projection: for each candidate lag the regression is linear and is solved in
closed form, so that only the three numbers of the lag are searched.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
import torch
from torch import Tensor

from residnet.autopilot.motion_config import ActuatorLag
from residnet.core.errors import FitError

_LOWER_BOUNDS = np.array([0.1, 0.1, 0.0])
"""Lower bounds of the search for frequency [rad/s], damping [-] and delay [s]."""
_UPPER_BOUNDS = np.array([30.0, 3.0, 2.0])
"""Upper bounds; an estimate at a bound means that the data do not determine the lag."""


def simulate_lagged_force(
    command: Tensor, lag: ActuatorLag, dt: float, run_lengths: Sequence[int] = ()
) -> Tensor:
    """Simulate the force [N, c] of actuators with a lag, for a sampled force command.

    The command is interpolated linearly between samples. Force and command are zero before the
    first sample.

    Args:
        command: commanded force [N, c].
        lag: second-order lag with a delay.
        dt: sampling interval in s.
        run_lengths: numbers of samples of several consecutive runs, each of which starts from zero;
            empty for a single run.
    """
    if len(run_lengths) > 1:
        runs = command.split(list(run_lengths))
        return torch.cat([simulate_lagged_force(run, lag, dt) for run in runs])
    u = _delay_command(command.numpy(), lag.delay, dt)
    omega = lag.frequency
    zeta = lag.damping
    # exact for a piecewise linear input: one matrix exponential of the state, the input and its
    # slope
    a = np.zeros((4, 4))
    a[0, 1] = 1.0
    a[1] = [-omega * omega, -2 * zeta * omega, omega * omega, 0.0]
    a[2, 3] = 1.0
    exponential = scipy.linalg.expm(a * dt)
    transition = exponential[:2, :2]
    response_to_level = exponential[:2, 2]
    response_to_slope = exponential[:2, 3] / dt
    # x[k+1] = S x[k] + (h - g) u[k] + g u[k+1] with y = x[0]; as a transfer function of order two,
    # y = C (zI - S)^-1 (b + g z) u with C = [1, 0]: (z - s22) (b0 + g0 z) + s12 (b1 + g1 z)
    g = response_to_slope
    b = response_to_level - response_to_slope
    s12 = transition[0, 1]
    s22 = transition[1, 1]
    numerator = [g[0], b[0] - s22 * g[0] + s12 * g[1], -s22 * b[0] + s12 * b[1]]
    denominator = [1.0, -np.trace(transition), np.linalg.det(transition)]
    return torch.from_numpy(scipy.signal.lfilter(numerator, denominator, u, axis=0))


def _delay_command(u: np.ndarray, delay: float, dt: float) -> np.ndarray:
    """Delay a command [N, c] by `delay` seconds, with linear interpolation and zeros in front."""
    n_full_steps = int(delay / dt)
    fraction = delay / dt % 1.0
    padded = np.concatenate((np.zeros((n_full_steps + 1, u.shape[1])), u))
    delayed: np.ndarray = (1 - fraction) * padded[1 : len(u) + 1] + fraction * padded[: len(u)]
    return delayed


def fit_lag(
    command: Tensor,
    required_force: Tensor,
    basis: Tensor,
    dt: float,
    use: Tensor | None = None,
    run_lengths: Sequence[int] = (),
) -> ActuatorLag:
    """Fit the lag for which required force and regressors best explain the lagged command.

    Args:
        command: tau_c [N, 3] on a uniform time grid, zero before the first sample.
        required_force: F_believed(nu_dot, nu) [N, 3].
        basis: regressors [N, J], without the constant.
        dt: sampling interval in s.
        use: samples to include, [N] bool; None for all.
        run_lengths: numbers of samples of several consecutive runs; empty for a single run.

    Raises:
        FitError: if the command does not vary, or the search ends at a bound.
    """
    if bool((command.std(0) == 0).all()):
        raise FitError(
            "the command is constant: no lag shows in it; give a run with changing commands"
        )
    is_used = torch.ones(len(command), dtype=torch.bool) if use is None else use
    # an orthonormal basis of the regressors; collinear ones are dropped
    x = basis[is_used] - basis[is_used].mean(0)
    q, r = torch.linalg.qr(x / x.std(0).clamp(min=1e-300))
    q = q[:, r.diagonal().abs() > 1e-9 * r.diagonal().abs().max()]

    def project_out_regressors(y: Tensor) -> Tensor:
        y = y - y.mean(0)
        residual: Tensor = y - q @ (q.T @ y)
        return residual

    def scaled_residuals(parameters: np.ndarray) -> np.ndarray:
        lag = _to_lag(parameters)
        force = simulate_lagged_force(command, lag, dt, run_lengths)[is_used]
        # relative to the lagged force: a lag that suppresses the whole command would otherwise
        # have no residual
        residual = project_out_regressors(force - required_force[is_used])
        scaled: np.ndarray = (residual / force.std(0).clamp(min=1e-300)).numpy().ravel()
        return scaled

    # several starts, because a search can end at a bound or in a local minimum
    solutions = [
        scipy.optimize.least_squares(
            scaled_residuals,
            np.array([frequency, 0.8, delay]),
            bounds=(_LOWER_BOUNDS, _UPPER_BOUNDS),
            x_scale=[1.0, 0.3, 0.1],
            diff_step=[1e-4] * 3,
            max_nfev=60,
        )
        for frequency in (1.0, 3.0, 8.0)
        for delay in (0.05, 0.5)
    ]
    best_solution = min(solutions, key=lambda solution: float(solution.cost))
    _require_inside_bounds(best_solution.x)
    return _to_lag(best_solution.x)


def _to_lag(parameters: np.ndarray) -> ActuatorLag:
    frequency, damping, delay = parameters.tolist()
    return ActuatorLag(frequency=frequency, damping=damping, delay=delay)


def _require_inside_bounds(parameters: np.ndarray) -> None:
    """Check that frequency, damping and delay [3] are not at a bound of the search.

    Raises:
        FitError: if one is; the data then do not determine the lag.
    """
    bounds = zip(parameters, _LOWER_BOUNDS, _UPPER_BOUNDS, strict=True)
    is_inside = [
        lower * 1.02 < value < upper * 0.98 or (lower == 0.0 and value < 0.98 * upper)
        for value, lower, upper in bounds
    ]
    names = ("frequency", "damping", "delay")
    names_at_bound = [name for name, inside in zip(names, is_inside, strict=True) if not inside]
    if names_at_bound:
        raise FitError(
            f"the lag's {names_at_bound[0]} ends at the bound of its search ({parameters[0]:.3g}"
            f" rad/s, {parameters[1]:.3g}, {parameters[2]:.3g} s): the data show no lag; give a run"
            " in which the command changes faster"
        )
