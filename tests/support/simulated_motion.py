"""Planar motion of unlike boats by kinematics and first-order dynamics, with simulated sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Boat:
    """Dynamics of a boat.

    Attributes:
        speed: mean surge velocity in m/s.
        turn_time: time constant of the yaw rate in s.
        turn_rate: yaw rate at full rudder in rad/s.
        drift: sway velocity over speed times yaw rate, negative to the outside, in s.
        period: mean time between changes of the rudder in s.
    """

    speed: float
    turn_time: float
    turn_rate: float
    drift: float
    period: float


BOATS = {
    "dinghy": Boat(1.8, 0.6, 0.35, -0.3, 4.0),
    "catamaran": Boat(3.0, 1.5, 0.25, -0.7, 8.0),
    "tanker": Boat(1.0, 6.0, 0.05, -3.0, 25.0),
}


@dataclass(frozen=True)
class TrueMotion:
    """Motion on a grid of 0.05 s: pose, and velocities over ground in body axes."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    psi: np.ndarray
    u: np.ndarray
    v: np.ndarray
    r: np.ndarray

    def sample(self, name: str, t: np.ndarray) -> np.ndarray:
        """Return one quantity at other times."""
        return np.asarray(np.interp(t, self.t, getattr(self, name)))


def simulate_motion(
    boat: Boat,
    rng: np.random.Generator,
    duration: float = 120.0,
    current: tuple[float, float] = (0.0, 0.0),
) -> TrueMotion:
    """Simulate random rudder steps and speed changes; u, v are relative to the water."""
    step = 0.05
    t = np.arange(0.0, duration, step)
    n_levels = int(duration / boat.period) + 2
    command = rng.uniform(-1.0, 1.0, n_levels)[(t / boat.period).astype(int)] * boat.turn_rate
    throttle = rng.uniform(0.7, 1.3, n_levels)[(t / boat.period).astype(int)] * boat.speed
    u, v, r = np.zeros((3, t.size))
    u[0] = boat.speed
    acceleration = 0.0
    for k in range(t.size - 1):
        # a second-order yaw response, so that the jerk is finite
        acceleration += (
            step / (0.3 * boat.turn_time) * ((command[k] - r[k]) / boat.turn_time - acceleration)
        )
        r[k + 1] = r[k] + step * acceleration
        u[k + 1] = u[k] + step * (throttle[k] - u[k]) / (3.0 * boat.turn_time)
        v[k + 1] = v[k] + step * (boat.drift * r[k] * u[k] - v[k]) / boat.turn_time
    psi = rng.uniform(-np.pi, np.pi) + np.append(0.0, np.cumsum(0.5 * step * (r[1:] + r[:-1])))
    velocity = (u + 1j * v) * np.exp(1j * psi) + complex(*current)
    position = np.append(0.0, np.cumsum(0.5 * step * (velocity[1:] + velocity[:-1])))
    return TrueMotion(t, position.real, position.imag, psi, u, v, r)
