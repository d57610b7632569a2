"""Motion of logs whose sensors measure surge, but not sway."""

from __future__ import annotations

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import STATE_NAMES
from residnet.preprocessing.channel_values import nan_std
from residnet.preprocessing.compatibility.estimates import Prior
from residnet.preprocessing.compatibility.hypotheses import MIN_MARGIN, Hypothesis, compare
from residnet.preprocessing.compatibility.reconstruction import reconstruct
from residnet.preprocessing.compatibility.sensors import (
    CURRENT_NAMES,
    DERIVATIVE_OF,
    PSI,
    V_DOT,
    R,
    Sensor,
    U,
    V,
    X,
    Y,
    compute_ground_velocity,
    compute_hermite_weights,
    interpolate_hermite,
)

_NODES_PER_FIX = 4.0
"""Nodes per interval between positions, unless the samples are farther apart."""
_MAX_NODES = 6000
"""Largest number of nodes; a longer log is smoothed, since a node takes 0.1 ms."""
_MAX_SURGE_NOISE = 0.5
"""Largest noise of surge as a share of its standard deviation: beyond, the sensors contradict each
other.
"""
_SURGE_ERRORS = {"surge scale": Prior(0.0, 0.3), **dict.fromkeys(CURRENT_NAMES, Prior(0.0, 1.0))}
"""Errors of a speed log, which measures through the water: its scale [-] and the current [m/s]."""


def reconstruct_without_sway(
    t: np.ndarray,
    fix_times: np.ndarray,
    positions: np.ndarray,
    heading: np.ndarray,
    surge: np.ndarray,
    yaw_rate: np.ndarray | None,
) -> dict[str, np.ndarray] | None:
    """Reconstruct the motion with the derivative of sway from all sensors but sway.

    The random jerk acts in body axes, in which sway varies less than the velocities in earth axes,
    and measured surge and yaw rate determine the remaining motion. An error of surge would become
    one of sway. The log is therefore not reconstructed if its BIC is smaller, by `MIN_MARGIN` or
    more, with a scale error and a current, as of a speed log that measures through the water.
    Nor is it if the other sensors contradict surge: the surge that they reconstruct alone differs
    more from measured surge than from its mean (skill score, Murphy 1988, Monthly Weather Review
    116). Without measured sway a wrong surge leaves no residual: sway and the noise of the
    positions absorb it.

    Args:
        t: times of the samples [T] in s.
        fix_times: times of the positions [F] in s.
        positions: north and east of the vessel's centre [F, 2] in m.
        heading: unwrapped heading [T] in rad; NaN where it was not measured.
        surge: surge velocity over ground [T] in m/s.
        yaw_rate: yaw rate [T] in rad/s; None if it was not measured.

    Returns:
        x, y, psi, u, v, r and v_dot [T] by name; None if the log is too long, or the sensors have
        too few values or contradict each other, or surge has an error.
    """
    sample_interval = float(np.median(np.diff(t)))
    fix_interval = float(np.median(np.diff(fix_times)))
    stride = max(int(fix_interval / _NODES_PER_FIX / sample_interval + 1e-6), 1)
    step = stride * sample_interval
    if (t[-1] - t[0]) / step > _MAX_NODES:
        return None
    other_sensors = [Sensor("position", fix_times, positions), Sensor("heading", t, heading)]
    if yaw_rate is not None:
        other_sensors.append(Sensor("yaw_rate", t, yaw_rate))
    speed_log = Sensor("surge", t, surge, is_through_water=True, scale="surge scale")
    hypotheses = {
        "surge over ground": Hypothesis([*other_sensors, Sensor("surge", t, surge)]),
        "surge of a speed log": Hypothesis([*other_sensors, speed_log], _SURGE_ERRORS),
    }
    try:
        ranking = compare(hypotheses, step)
        without_surge = reconstruct(other_sensors, {}, step)
    except (DataError, np.linalg.LinAlgError):
        return None
    without_error = next(ranked for ranked in ranking if ranked.name == "surge over ground")
    if without_error.margin >= MIN_MARGIN:
        return None
    motion = without_error.reconstruction
    surge_fit = motion.sensors.get("surge")
    if surge_fit is None or surge_fit.noise_std > _MAX_SURGE_NOISE * nan_std(surge):
        return None
    predicted_surge = np.interp(t, without_surge.t, without_surge.states[:, U])
    error = float(np.nanmean((surge - predicted_surge) ** 2)) - surge_fit.noise_std**2
    is_measured = np.isfinite(surge)
    deviation = np.nanmean(surge) - predicted_surge[is_measured]
    if error >= float(np.mean(deviation**2)):
        return None
    # values at the samples by cubic polynomials between nodes
    index = np.clip((t - motion.t[0]) / step, 0.0, len(motion.t) - 1.0)
    before = np.minimum(index.astype(int), len(motion.t) - 2)
    fraction = index - before
    states = motion.states.T
    rates = {state: states[rate] for state, rate in DERIVATIVE_OF.items()}
    rates[X], rates[Y] = compute_ground_velocity(dict(enumerate(states)), 0.0, 0.0)
    weights = compute_hermite_weights(step, fraction)
    sampled = {
        name: interpolate_hermite(
            states[state][before],
            rates[state][before],
            states[state][before + 1],
            rates[state][before + 1],
            weights,
        )
        for name, state in zip(STATE_NAMES, (X, Y, PSI, U, V, R), strict=True)
    }
    sway_acceleration = states[V_DOT]
    sampled["v_dot"] = (1.0 - fraction) * sway_acceleration[before]
    sampled["v_dot"] += fraction * sway_acceleration[before + 1]
    return sampled
