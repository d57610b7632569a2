"""Measurement models of sensors on a vessel that moves in the horizontal plane.

The states at a node are position, heading, velocities through the water in body axes, and their
derivatives. Between nodes they follow from cubic Hermite interpolation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

X, Y, PSI, U, V, R, U_DOT, V_DOT, R_DOT = range(9)
N_STATES = 9
"""Number of states of a node: pose, velocities and accelerations of a planar vessel."""
DERIVATIVE_OF = {PSI: R, U: U_DOT, V: V_DOT, R: R_DOT}

SensorKind = Literal[
    "position", "heading", "yaw_rate", "surge", "sway", "north", "east", "speed", "course", "drift"
]
ANGULAR_KINDS = ("heading", "course", "drift")
CURRENT_NAMES = ("current_north", "current_east")
"""Names of the components of a steady current in m/s, estimated with the instrument errors."""

Parameters = Mapping[str, complex]
NodeStates = Mapping[int, np.ndarray]
"""State -> values [N] at the node before or after each sample."""


@dataclass(frozen=True)
class Sensor:
    """Measurements of one sensor, and the names of its errors.

    Attributes:
        kind: measured quantity. `surge` and `sway` are velocities in body axes, `north` and `east`
            in earth axes, `course` the direction of the velocity over ground, `drift` the angle
            from the velocity to the bow, positive to starboard.
        t: times [N] in s on the clock of the sensor.
        values: measured values [N, k] in SI units.
        name: name in reports.
        noise_std: standard deviation of the noise; 0 for a first guess from the values.
        min_noise_std: lower bound of `noise_std`, for example from the resolution.
        is_noise_known: whether the standard deviation is not estimated.
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
    is_noise_known: bool = False
    is_through_water: bool = False
    clock: str = ""
    bias: str = ""
    scale: str = ""
    lever_arm: tuple[str, ...] = ()
    factor: float = 1.0

    @property
    def is_angular(self) -> bool:
        """Whether differences are taken modulo a full circle."""
        return self.kind in ANGULAR_KINDS

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
        """Return predicted minus measured values [N], angles modulo a full circle."""
        difference: np.ndarray = predicted - values
        if not self.is_angular:
            return difference
        angle = difference / self.factor
        return np.asarray((angle - 2.0 * np.pi * np.round(angle / (2.0 * np.pi))) * self.factor)

    def select_states(self, *, is_on_nodes: bool) -> tuple[int, ...]:
        """Return the states of a node on which a measurement depends."""
        if self.kind == "position":
            return (X, Y, PSI) if is_on_nodes else (X, Y, PSI, U, V, R)
        if self.kind == "heading":
            return (PSI,) if is_on_nodes else (PSI, R)
        if self.kind == "yaw_rate":
            return (R,) if is_on_nodes else (R, R_DOT)
        return (PSI, U, V) if is_on_nodes else (PSI, U, V, R, U_DOT, V_DOT)

    def predict(
        self,
        parameters: Parameters,
        before: NodeStates,
        after: NodeStates,
        step: float,
        fraction: np.ndarray | None,
    ) -> list[np.ndarray]:
        """Predict the measurements from the states.

        Arguments may be complex, so that a caller can differentiate by the complex-step method.

        Args:
            parameters: name of an error -> value.
            before: states at the node before each sample.
            after: states at the node after each sample.
            step: time between nodes in s.
            fraction: position of each sample between its nodes, 0 to 1; None if all samples are on
                their first node.

        Returns:
            One array [N] per column of the values.
        """
        # once for all states: the weights cost as much as an interpolation
        weights = None if fraction is None else compute_hermite_weights(step, fraction)

        def interpolate(state: int) -> np.ndarray:
            rate = DERIVATIVE_OF[state]
            if weights is None:
                return before[state]
            return interpolate_hermite(
                before[state], before[rate], after[state], after[rate], weights
            )

        def get(name: str) -> complex:
            return parameters.get(name, 0.0) if name else 0.0

        current_north, current_east = (get(name) for name in CURRENT_NAMES)
        # the states of a yaw-rate sensor contain no heading, and its value needs none
        heading = interpolate(PSI) if self.kind != "yaw_rate" else before[R]
        if self.kind == "position":
            north = before[X]
            east = before[Y]
            if weights is not None:
                rates = [
                    compute_ground_velocity(node, current_north, current_east)
                    for node in (before, after)
                ]
                north, east = (
                    interpolate_hermite(
                        before[state], rates[0][k], after[state], rates[1][k], weights
                    )
                    for k, state in enumerate((X, Y))
                )
            if self.lever_arm:
                forward, starboard = (get(name) for name in self.lever_arm)
                north = north + forward * np.cos(heading) - starboard * np.sin(heading)
                east = east + forward * np.sin(heading) + starboard * np.cos(heading)
            return [north, east]
        if self.kind == "heading":
            quantity = heading
        elif self.kind == "yaw_rate":
            quantity = interpolate(R)
        else:
            u = interpolate(U)
            v = interpolate(V)
            if not self.is_through_water:
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
        if self.kind == "drift":
            return -compute_angle(u, v)
        north = u * np.cos(heading) - v * np.sin(heading)
        east = u * np.sin(heading) + v * np.cos(heading)
        if self.kind == "course":
            return compute_angle(north, east)
        return np.asarray(north if self.kind == "north" else east)


def compute_angle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return atan2(y, x), with a complex step if an argument has one."""
    angle = np.arctan2(np.real(y), np.real(x))
    if not (np.iscomplexobj(x) or np.iscomplexobj(y)):
        return np.asarray(angle)
    squared_norm = np.real(x) ** 2 + np.real(y) ** 2 + 1e-12
    derivative = (np.real(x) * np.imag(y) - np.real(y) * np.imag(x)) / squared_norm
    return np.asarray(angle + 1j * derivative)


def compute_ground_velocity(
    node: NodeStates, current_north: complex, current_east: complex
) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity over ground, north and east."""
    cosine = np.cos(node[PSI])
    sine = np.sin(node[PSI])
    north = node[U] * cosine - node[V] * sine + current_north
    return north, node[U] * sine + node[V] * cosine + current_east


HermiteWeights = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Weights of the value and the rate at the start of a step, and of both at its end."""


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
