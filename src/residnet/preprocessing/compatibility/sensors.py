"""Measurement models of sensors on a vessel that moves in the horizontal plane.

The states at a node are position, heading, velocities through the water in body axes, and their
derivatives. Between nodes they follow from cubic Hermite interpolation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

X, Y, PSI, U, V, R, U_DOT, V_DOT, R_DOT = range(9)
N_STATES = 9
"""Number of states of a node: pose, velocities and accelerations of a planar vessel."""
COMPLEX_STEP = 1e-20
"""Imaginary step of complex-step derivatives, whose error is of the order of its square."""
DERIVATIVE_OF = {PSI: R, U: U_DOT, V: V_DOT, R: R_DOT}

SensorKind = Literal["position", "heading", "yaw_rate", "surge", "sway", "north", "east", "speed"]
CURRENT_NAMES = ("current_north", "current_east")
"""Names of the components of a steady current in m/s, estimated with the instrument errors."""

Parameters = Mapping[str, complex]
NodeStates = Mapping[int, np.ndarray]
"""State -> values [N] at the node before or after each sample."""
HermiteWeights = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Weights of the value and the rate at the start of a step, and of both at its end."""


@dataclass(frozen=True)
class Sensor:
    """Measurements of one sensor, and the names of its errors.

    Attributes:
        kind: measured quantity. `surge` and `sway` are velocities in body axes, `north` and `east`
            in earth axes.
        t: times [N] in s on the clock of the sensor.
        values: measured values [N, k] in SI units.
        name: name in reports.
        noise_std: standard deviation of the noise; 0 for a first guess from the values.
        min_noise_std: lower bound of `noise_std`, for example from the resolution.
        is_through_water: whether a velocity is relative to the water instead of the ground.
        clock: error that is added to the times; empty for none.
        bias: error that is added to the quantity; empty for none.
        scale: name of the scale error e, with which the sensor shows (1 + e) times the quantity;
            empty for none.
        lever_arm: names of the two errors that are the position of the antenna forward and to
            starboard in m; empty for none.
        factor: unit or sign: ratio of the values to the quantity.
    """

    kind: SensorKind
    t: np.ndarray
    values: np.ndarray
    name: str = ""
    noise_std: float = 0.0
    min_noise_std: float = 1e-9
    is_through_water: bool = False
    clock: str = ""
    bias: str = ""
    scale: str = ""
    lever_arm: tuple[str, ...] = ()
    factor: float = 1.0

    @property
    def error_names(self) -> list[str]:
        """Names of the errors of this sensor, without its clock."""
        return [name for name in (self.bias, self.scale, *self.lever_arm) if name]

    def select_finite(self) -> Sensor:
        """Return the sensor without missing values, with values [N, k] and a name."""
        values = np.asarray(self.values, dtype=np.float64).reshape(len(self.t), -1)
        is_finite = np.isfinite(values).all(axis=1) & np.isfinite(self.t)
        return replace(
            self, t=self.t[is_finite], values=values[is_finite], name=self.name or self.kind
        )

    def subtract(self, predicted: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return predicted minus measured values [N], headings modulo a full circle."""
        difference: np.ndarray = predicted - values
        if self.kind != "heading":
            return difference
        return np.asarray(difference - 2.0 * np.pi * np.round(difference / (2.0 * np.pi)))

    @property
    def measured_states(self) -> tuple[int, ...]:
        """States at the time of a sample on which a measurement depends."""
        if self.kind == "position":
            return (X, Y, PSI)
        if self.kind == "heading":
            return (PSI,)
        if self.kind == "yaw_rate":
            return (R,)
        return (PSI, U, V)

    def select_states(self, *, is_on_nodes: bool) -> tuple[int, ...]:
        """Return the states of a node on which a measurement depends."""
        if is_on_nodes:
            return self.measured_states
        if self.kind == "position":
            return (X, Y, PSI, U, V, R)
        rates = tuple(DERIVATIVE_OF[state] for state in self.measured_states)
        return tuple(sorted({*self.measured_states, *rates}))

    def predict(
        self,
        parameters: Parameters,
        before: NodeStates,
        after: NodeStates,
        weights: HermiteWeights | None,
    ) -> list[np.ndarray]:
        """Predict the measurements from the states of the nodes.

        Args:
            parameters: name of an error -> value.
            before: states at the node before each sample.
            after: states at the node after each sample.
            weights: weights of the interpolation; None if all samples are on their first node.

        Returns:
            One array [N] per column of the values.
        """
        states = interpolate_states(self.measured_states, before, after, weights, parameters)
        return self.measure(parameters, states)

    def measure(self, parameters: Parameters, states: NodeStates) -> list[np.ndarray]:
        """Predict the measurements from the states at the times of the samples.

        Arguments may be complex, so that a caller can differentiate by the complex-step method.

        Args:
            parameters: name of an error -> value.
            states: `measured_states` at the times of the samples.

        Returns:
            One array [N] per column of the values.
        """

        def get(name: str) -> complex:
            return parameters.get(name, 0.0) if name else 0.0

        if self.kind == "position":
            north = states[X]
            east = states[Y]
            if self.lever_arm:
                heading = states[PSI]
                forward, starboard = (get(name) for name in self.lever_arm)
                north = north + forward * np.cos(heading) - starboard * np.sin(heading)
                east = east + forward * np.sin(heading) + starboard * np.cos(heading)
            return [north, east]
        if self.kind == "heading":
            quantity = states[PSI]
        elif self.kind == "yaw_rate":
            quantity = states[R]
        else:
            heading = states[PSI]
            u = states[U]
            v = states[V]
            if not self.is_through_water:
                current_north, current_east = (get(name) for name in CURRENT_NAMES)
                u = u + current_north * np.cos(heading) + current_east * np.sin(heading)
                v = v - current_north * np.sin(heading) + current_east * np.cos(heading)
            quantity = self._select_component(u, v, heading)
        return [self.factor * ((1.0 + get(self.scale)) * quantity + get(self.bias))]

    def _select_component(self, u: np.ndarray, v: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return the measured component of a velocity in body axes."""
        if self.kind == "surge":
            return u
        if self.kind == "sway":
            return v
        if self.kind == "speed":
            # the small constant makes it differentiable at rest
            return np.asarray(np.sqrt(u * u + v * v + 1e-8))
        north = u * np.cos(heading) - v * np.sin(heading)
        east = u * np.sin(heading) + v * np.cos(heading)
        return np.asarray(north if self.kind == "north" else east)


def compute_ground_velocity(
    node: NodeStates, current_north: complex, current_east: complex
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate u and v to north and east, and add the current."""
    cosine = np.cos(node[PSI])
    sine = np.sin(node[PSI])
    north = node[U] * cosine - node[V] * sine + current_north
    return north, node[U] * sine + node[V] * cosine + current_east


def compute_hermite_weights(step: float, fraction: np.ndarray) -> HermiteWeights:
    """Return the weights of the cubic Hermite polynomial at fractions of a step."""
    square = fraction * fraction
    cube = square * fraction
    return (
        2.0 * cube - 3.0 * square + 1.0,
        (cube - 2.0 * square + fraction) * step,
        3.0 * square - 2.0 * cube,
        (cube - square) * step,
    )


def interpolate_hermite(
    start: np.ndarray,
    start_rate: np.ndarray,
    end: np.ndarray,
    end_rate: np.ndarray,
    weights: HermiteWeights,
) -> np.ndarray:
    """Interpolate by the cubic polynomial with given values and rates at both ends of a step."""
    from_start = weights[0] * start
    from_start = from_start + weights[1] * start_rate
    return np.asarray(from_start + weights[2] * end + weights[3] * end_rate)


def interpolate_states(
    names: Sequence[int],
    before: NodeStates,
    after: NodeStates,
    weights: HermiteWeights | None,
    parameters: Parameters,
) -> dict[int, np.ndarray]:
    """Return states at the times of the samples.

    Args:
        names: the states.
        before: states at the node before each sample.
        after: states at the node after each sample.
        weights: weights of the interpolation; None if all samples are on their first node.
        parameters: name of an error -> value, for the current.
    """
    if weights is None:
        return {state: before[state] for state in names}
    states = {}
    if X in names:
        current_north, current_east = (parameters.get(name, 0.0) for name in CURRENT_NAMES)
        rates_before = compute_ground_velocity(before, current_north, current_east)
        rates_after = compute_ground_velocity(after, current_north, current_east)
        for axis, state in enumerate((X, Y)):
            states[state] = interpolate_hermite(
                before[state], rates_before[axis], after[state], rates_after[axis], weights
            )
    for state in names:
        if state in DERIVATIVE_OF:
            rate = DERIVATIVE_OF[state]
            states[state] = interpolate_hermite(
                before[state], before[rate], after[state], after[rate], weights
            )
    return states


def differentiate_interpolation(
    state: int, before: NodeStates, after: NodeStates, weights: HermiteWeights | None
) -> dict[int, np.ndarray | float]:
    """Return the derivatives of an interpolated state by the states of its nodes.

    Args:
        state: the state.
        before: states at the node before each sample.
        after: states at the node after each sample.
        weights: weights of the interpolation; None if all samples are on their first node.

    Returns:
        State (0 to 8 of the node, 9 to 17 of the next node) -> derivative [N].
    """
    if weights is None:
        return {state: 1.0}
    if state in DERIVATIVE_OF:
        rate = DERIVATIVE_OF[state]
        keys = (state, rate, N_STATES + state, N_STATES + rate)
        return dict(zip(keys, weights, strict=True))
    derivatives: dict[int, np.ndarray | float] = {state: weights[0], N_STATES + state: weights[2]}
    axis = (X, Y).index(state)
    for side, node, weight in ((0, before, weights[1]), (1, after, weights[3])):
        for key, slopes in differentiate_ground_velocity(node).items():
            derivatives[side * N_STATES + key] = weight * slopes[axis]
    return derivatives


def differentiate_ground_velocity(node: NodeStates) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the derivatives of the velocity over ground, north and east, by heading, u and v."""
    derivatives = {}
    for state in (PSI, U, V):
        perturbed_states = {key: node[key] for key in (PSI, U, V)}
        perturbed_states[state] = perturbed_states[state] + 1j * COMPLEX_STEP
        north, east = compute_ground_velocity(perturbed_states, 0.0, 0.0)
        derivatives[state] = (np.imag(north) / COMPLEX_STEP, np.imag(east) / COMPLEX_STEP)
    return derivatives
