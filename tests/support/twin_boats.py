"""Simulated boats with two propellers, of which one may be reversed or weaker than the other.

The simulation shares no code with residnet: surge, sway and yaw of a hull with quadratic drag,
propellers whose thrust decreases with the inflow and astern, a lag of the motors, gusts and noise.
All boats are integrated together.
"""

from __future__ import annotations

import numpy as np

from residnet.core.log import Log

_STEP = 0.1
_SUBSTEPS = 4
_STATES = ("x", "y", "psi", "u", "v", "r")


def simulate_twin_boats(
    seed: int,
    n_boats: int,
    n_logs: int = 4,
    duration: float = 75.0,
    *,
    starboard_sign: float = 1.0,
    weakest: float = 1.0,
    strongest: float = 1.0,
) -> tuple[list[list[Log]], np.ndarray]:
    """Return logs of boats drawn at random, and the relative strength of their propellers.

    Args:
        seed: of the boats, their commands, gusts and noise.
        n_boats: number B of boats.
        n_logs: number of logs of each boat.
        duration: length of each log in s.
        starboard_sign: -1 for a motor whose recorded revolutions have the wrong sign.
        weakest: smallest thrust of a starboard propeller as a multiple of the port one.
        strongest: largest such multiple.

    Returns:
        Logs by boat, and the multiples [B].
    """
    random = np.random.default_rng(seed)

    def draw(low: float, high: float) -> np.ndarray:
        return np.exp(random.uniform(np.log(low), np.log(high), n_boats))

    length = draw(1.0, 6.0)
    speed = draw(0.15, 0.35) * np.sqrt(9.81 * length)
    boats = {
        "unit_time": length / speed,
        "surge": draw(0.2, 0.6),
        "sway": draw(0.8, 1.6),
        "yaw": draw(1.0, 2.5),
        "munk": draw(0.1, 0.4),
        "lever": draw(0.5, 1.5),
        "astern": draw(0.5, 0.9),
        "inflow": draw(0.1, 0.4),
        "lag": draw(0.1, 0.4),
        "gust": draw(0.004, 0.02),
        "strength": draw(weakest, strongest),
    }
    revolutions = draw(10.0, 60.0)
    noise = draw(0.003, 0.015) * np.array([0.5, 0.5, 0.3, 1.0, 1.0, 1.0])[:, None]
    scales = np.array([length, length, np.ones(n_boats), speed, speed, speed / length])
    logs: list[list[Log]] = [[] for _ in range(n_boats)]
    for log_number in range(n_logs):
        states = _integrate(boats, random, round(duration / _STEP))
        measured = scales * (states[:, :6] + noise * random.standard_normal(states[:, :6].shape))
        for boat_number, boat_logs in enumerate(logs):
            channels = {name: measured[:, k, boat_number] for k, name in enumerate(_STATES)}
            shaft_speeds = revolutions[boat_number] * states[:, 6:, boat_number]
            channels["n_port"] = shaft_speeds[:, 0]
            channels["n_stbd"] = starboard_sign * shaft_speeds[:, 1]
            t = _STEP * np.arange(len(states))
            boat_logs.append(Log(f"boat_{boat_number}_{log_number}", t, channels))
    return logs, boats["strength"]


def _integrate(
    boats: dict[str, np.ndarray], random: np.random.Generator, n_steps: int
) -> np.ndarray:
    """Return pose, velocities and revolutions [T, 8, B] in units of length and speed."""
    n_boats = len(boats["surge"])
    step = _STEP / boats["unit_time"]
    dt = step / _SUBSTEPS
    pose = np.zeros((3, n_boats))
    u, v, r = np.zeros((3, n_boats))
    revolutions = np.zeros((2, n_boats))
    command = np.zeros((2, n_boats))
    next_change = np.zeros(n_boats)
    gusts = np.zeros((3, n_boats))
    strength = np.stack((np.ones(n_boats), boats["strength"]))
    rows = np.empty((n_steps, 8, n_boats))
    for k in range(n_steps):
        rows[k] = np.concatenate((pose, [u, v, r], revolutions))
        is_due = k * step >= next_change
        # a quarter of the commands is astern
        drive = random.choice([1.0, 1.0, 1.0, -0.6], n_boats) * random.uniform(0.3, 1.0, n_boats)
        difference = random.uniform(-0.4, 0.4, n_boats)
        command = np.where(is_due, [drive + difference, drive - difference], command)
        duration = random.uniform(1.0, 5.0, n_boats)
        next_change = np.where(is_due, k * step + duration, next_change)
        for _ in range(_SUBSTEPS):
            kicks = random.standard_normal((3, n_boats))
            gusts = gusts - gusts * dt / 3.0 + boats["gust"] * np.sqrt(dt) * kicks
            revolutions = revolutions + dt / boats["lag"] * (command - revolutions)
            efficiency = np.where(revolutions > 0.0, 1.0, boats["astern"])
            thrust = (
                strength * np.abs(revolutions) * (efficiency * revolutions - boats["inflow"] * u)
            )
            u_dot = boats["surge"] * (thrust.mean(0) - u * np.abs(u)) + 0.5 * v * r + gusts[0]
            v_dot = -boats["sway"] * (0.3 + np.abs(u) + np.abs(v)) * v - 0.6 * u * r + gusts[1]
            moment = boats["lever"] * (thrust[0] - thrust[1]) / 2.0
            damping = boats["yaw"] * (0.3 + np.abs(u) + 0.5 * np.abs(r))
            r_dot = moment - damping * r - boats["munk"] * u * v + gusts[2]
            u, v, r = u + dt * u_dot, v + dt * v_dot, r + dt * r_dot
            north_rate = u * np.cos(pose[2]) - v * np.sin(pose[2])
            east_rate = u * np.sin(pose[2]) + v * np.cos(pose[2])
            pose = pose + dt * np.stack((north_rate, east_rate, r))
    return rows
