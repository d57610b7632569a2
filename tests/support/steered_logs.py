"""Logs of Nomoto's equation with a rudder in open loop, by a relay or by a controller."""

from __future__ import annotations

from typing import Literal

import numpy as np

from residnet.core.log import Log

Steering = Literal["steps", "zigzag", "controller", "set_points"]


def steered_log(
    steering: Steering, seed: int, duration: float = 300.0, disturbance: float = 0.01
) -> Log:
    """Return a log of r_dot = (0.7 delta - r) / 0.8 s + d with measurement noise, 10 Hz."""
    random = np.random.default_rng(seed)
    dt = 0.1
    psi = 0.05 * random.standard_normal()
    rate = moment = rudder = course = integral = 0.0
    side = 1.0
    rows = []
    courses = []
    for k in range(round(duration / dt)):
        if k % 60 == 0:
            course = random.uniform(-0.5, 0.5)
        error = psi - (course if steering == "set_points" else 0.0)
        integral += dt * error
        if steering == "zigzag":
            side = -side if side * psi > 0.3 else side
            rudder = 0.3 * side
        elif steering == "steps":
            rudder = random.uniform(-0.3, 0.3) if k % 40 == 0 else rudder
        else:
            rudder = float(np.clip(-1.2 * error - 0.1 * integral - 0.8 * rate, -0.5, 0.5))
        rows.append((psi, rate, rudder))
        courses.append(course)
        moment += -moment * dt / 4.0 + 0.7 * disturbance * np.sqrt(dt) * random.standard_normal()
        rate += dt * ((0.7 * rudder - rate) / 0.8 + moment)
        psi += dt * rate
    psi_values, rates, rudders = np.array(rows).T
    noise = random.standard_normal((3, len(rows)))
    x = np.cumsum(2.0 * np.cos(psi_values)) * dt
    y = np.cumsum(2.0 * np.sin(psi_values)) * dt
    channels = {
        "x": x,
        "y": y,
        "psi": psi_values + 0.003 * noise[0],
        "u": 2.0 + 0.02 * noise[1],
        "v": -0.3 * rates,
        "r": rates + 0.005 * noise[2],
        "delta": rudders,
    }
    if steering == "set_points":
        channels["psi_d"] = np.array(courses)
    return Log(f"{steering}_{seed}", dt * np.arange(len(rows)), channels)
