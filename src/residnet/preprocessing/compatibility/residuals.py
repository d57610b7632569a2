"""Whitened residuals of sensors and dynamic equations, and their weights."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from residnet.preprocessing.compatibility.sensors import (
    N_STATES,
    PSI,
    U_DOT,
    V_DOT,
    NodeStates,
    R,
    Sensor,
    U,
    V,
    X,
    Y,
    compute_ground_velocity,
    differentiate_ground_velocity,
)

_STUDENT_DOF = 5.0
"""Degrees of freedom of the Student distribution of the measurement noise."""
_MIN_RESIDUAL_NOISE_RATIO = 0.05
"""Smallest assumed ratio of the variance of a sensor's residuals to its noise variance."""


@dataclass
class ResidualGroup:
    """Whitened residuals of one group and their derivatives.

    Attributes:
        noise_name: name of the noise level, such as `jerk 0` or `sensor 2`.
        nodes: node before each residual [N].
        values: whitened residuals [N].
        by_state: state -> derivative [N]; states 0 to 8 are of the node, 9 to 17 of the next node.
        by_error: index of an instrument error -> derivative [N].
        sensor: sensor of a measurement; None for a dynamic equation.
        squares: squared norm [N] over all columns of the sensor, so that the weights of a position
            do not depend on its axes; None for a dynamic equation.
        dimension: number of columns of the sensor.
    """

    noise_name: str
    nodes: np.ndarray
    values: np.ndarray
    by_state: dict[int, np.ndarray]
    by_error: dict[int, np.ndarray] = field(default_factory=dict)
    sensor: Sensor | None = None
    squares: np.ndarray | None = None
    dimension: int = 1

    @property
    def weights(self) -> np.ndarray | float:
        """Weights [N] of the Student distribution."""
        if self.squares is None:
            return 1.0
        return np.asarray((_STUDENT_DOF + self.dimension) / (_STUDENT_DOF + self.squares))

    @property
    def cost(self) -> float:
        """Contribution of one column to minus twice the log-density, without constants."""
        if self.squares is None:
            return float(self.values @ self.values)
        exponent = (_STUDENT_DOF + self.dimension) / self.dimension
        return float(exponent * np.log1p(self.squares / _STUDENT_DOF).sum())

    def scale(self, factor: float, sensor: Sensor | None) -> ResidualGroup:
        """Return the residuals of a sensor, or of a dynamic equation, times a factor."""
        return replace(
            self,
            values=factor * self.values,
            by_state={key: factor * derivative for key, derivative in self.by_state.items()},
            by_error={key: factor * derivative for key, derivative in self.by_error.items()},
            sensor=sensor,
            squares=None if self.squares is None else factor**2 * self.squares,
        )


def sum_by_node(group: ResidualGroup, values: np.ndarray, n_nodes: int) -> np.ndarray:
    """Sum values of the residuals [..., N] by node [..., K].

    A dynamic equation has one value per node but the last.
    """
    if group.sensor is None:
        return values
    if values.ndim == 1:
        return np.bincount(group.nodes, values, n_nodes)
    return np.array([np.bincount(group.nodes, row, n_nodes) for row in values])


def linearize_score(group: ResidualGroup) -> ResidualGroup:
    """Return Gaussian residuals with the information and the scores of a group with weights.

    With the score psi = w r, the information of a residual is E[psi']^2 / E[psi^2] (Huber 1981,
    Robust Statistics, eq. 7.6.2). It is reduced by the autocorrelation of successive scores, which
    are taken for an autoregressive process of first order.
    """
    if group.squares is None:
        return group
    dimension = group.dimension
    numerator = _STUDENT_DOF + dimension
    weights = numerator / (_STUDENT_DOF + group.squares)
    score = weights * group.values
    # Residuals of a fit are smaller than the noise. The noise level is estimated such that the
    # weighted mean square of the noise is one.
    residual_noise_ratio = float((weights * group.squares).mean()) / dimension
    noise_squares = group.squares / max(residual_noise_ratio, _MIN_RESIDUAL_NOISE_RATIO)
    denominator = _STUDENT_DOF + noise_squares
    # means over all columns of a sensor
    slope = numerator / denominator - 2.0 * numerator * noise_squares / (dimension * denominator**2)
    mean_slope = max(float(slope.mean()), 0.1)
    mean_square = float(((numerator / denominator) ** 2 * noise_squares).mean()) / dimension
    centred = score - score.mean()
    energy = max(float(centred @ centred), 1e-300)
    autocorrelation = max(float(centred[1:] @ centred[:-1]) / energy, 0.0)
    information = mean_slope**2 / max(mean_square, 1e-300)
    information *= (1.0 - autocorrelation) / (1.0 + autocorrelation)
    root_information = float(np.sqrt(information))
    return replace(
        group,
        values=root_information / mean_slope * score,
        by_state={key: root_information * derivative for key, derivative in group.by_state.items()},
        by_error={key: root_information * derivative for key, derivative in group.by_error.items()},
        squares=None,
    )


def compute_student_constant(dimension: int) -> float:
    """Return minus twice the logarithm of the Student density's constant, per dimension."""
    half_dof = 0.5 * _STUDENT_DOF
    constant = math.lgamma(half_dof + 0.5 * dimension) - math.lgamma(half_dof)
    return -2.0 * constant / dimension + float(np.log(_STUDENT_DOF * np.pi))


def compute_position_residuals(
    before: NodeStates, after: NodeStates, step: float, north: float, east: float
) -> tuple[list[np.ndarray], list[dict[int, np.ndarray | float]]]:
    """Return the position at the next node minus its integral by Simpson's rule, and derivatives.

    Returns:
        The differences [N] north and east; and for each of them: state (0 to 8 of the node, 9 to 17
        of the next node) -> derivative [N].
    """
    rates = {PSI: R, U: U_DOT, V: V_DOT}
    points = {
        state: np.stack(
            (
                before[state],
                0.5 * (before[state] + after[state]) + step / 8.0 * (before[rate] - after[rate]),
                after[state],
            )
        )
        for state, rate in rates.items()
    }
    velocities = compute_ground_velocity(points, north, east)
    slopes_by_state = differentiate_ground_velocity(points)
    errors: list[np.ndarray] = []
    derivatives: list[dict[int, np.ndarray | float]] = []
    for axis, state in enumerate((X, Y)):
        velocity = velocities[axis]
        integral = velocity[0] + 4.0 * velocity[1] + velocity[2]
        errors.append(after[state] - before[state] - step / 6.0 * integral)
        by_state: dict[int, np.ndarray | float] = {state: -1.0, N_STATES + state: 1.0}
        for velocity_state, rate in rates.items():
            slope = slopes_by_state[velocity_state][axis]
            by_middle = -step / 6.0 * 4.0 * slope[1]
            by_state[velocity_state] = 0.5 * by_middle - step / 6.0 * slope[0]
            by_state[N_STATES + velocity_state] = 0.5 * by_middle - step / 6.0 * slope[2]
            by_state[rate] = step / 8.0 * by_middle
            by_state[N_STATES + rate] = -step / 8.0 * by_middle
        derivatives.append(by_state)
    return errors, derivatives
