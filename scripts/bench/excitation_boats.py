"""Simulated boats whose logs excite some directions only, and open-loop flights of the same boats.

Each kind of boat is logged in another way: random steps, zigzags, 3-2-1-1, course keeping by a PID
controller, a rudder proportional to the heading, propellers that always run alike, one shaft
speed, small rudder angles. A model identified from the logs is then compared with open-loop flights
whose inputs lie within the logged range of each input. `scripts/bench/excitation.py` runs the
comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

STEP: Final = 0.1
"""Sampling interval in s."""
_SUBSTEPS: Final = 4
_NOISE: Final = {"x": 0.02, "y": 0.02, "psi": 0.0026, "u": 0.02, "v": 0.015, "r": 0.006}
"""Standard deviations of the measurement noise, SI and rad."""


@dataclass
class Boat:
    """A boat of 3 m with one rudder and one or two propellers.

    Attributes:
        parameters: hydrodynamic coefficients by name.
        has_two_propellers: whether each side has a propeller.
        disturbance: standard deviation of the unmeasured yaw acceleration in rad/s^2.
    """

    parameters: dict[str, float]
    has_two_propellers: bool
    disturbance: float
    random: np.random.Generator = field(repr=False)

    def accelerate(
        self, velocities: np.ndarray, rudder: float, shaft: np.ndarray, moment: float
    ) -> np.ndarray:
        """Return u_dot, v_dot, r_dot at velocities [3], rudder angle and shaft speeds [1 or 2]."""
        u, v, r = velocities
        p = self.parameters
        thrusts = p["thrust"] * shaft * np.abs(shaft)
        difference = thrusts[0] - thrusts[-1]
        # the rudder works in the water that the hull and the propeller move
        inflow = u * abs(u) + 0.6 * thrusts.mean()
        return np.array(
            (
                thrusts.mean() - p["drag"] * u - p["drag2"] * u * abs(u) + 0.8 * v * r
                - 0.15 * inflow * rudder**2,
                -(p["sway"] + p["sway_u"] * abs(u)) * v - p["sway_r"] * u * r
                - 0.1 * p["rudder"] * inflow * rudder,
                -(p["yaw"] + p["yaw_u"] * abs(u)) * r - p["munk"] * u * v
                - p["yaw_r2"] * r * abs(r) + p["rudder"] * inflow * rudder
                + p["arm"] * difference + moment,
            )
        )  # fmt: skip


def draw_boat(seed: int, *, has_two_propellers: bool = False, disturbance: float = 0.01) -> Boat:
    """Draw a boat with coefficients that differ by a fifth from boat to boat."""
    random = np.random.default_rng(seed)
    typical = {
        **{"thrust": 0.0098, "drag": 0.12, "drag2": 0.25, "sway": 0.4, "sway_u": 0.6},
        **{"sway_r": 0.25, "yaw": 0.5, "yaw_u": 0.55, "yaw_r2": 0.3, "munk": 0.12},
        **{"rudder": 0.22, "arm": 0.25},
    }
    scattered = {name: v * np.exp(0.2 * random.standard_normal()) for name, v in typical.items()}
    return Boat(scattered, has_two_propellers, disturbance, random)


Command = Callable[[float, np.ndarray], tuple[float, np.ndarray]]
"""Rudder angle and shaft speeds [1 or 2] at a time in s and measured states [6]."""


def sail(boat: Boat, command: Command, duration: float, speed: float = 1.4) -> np.ndarray:
    """Sail a boat; return time, measured pose and velocities, shaft speeds and rudder [T, 8 or 9].

    The rudder turns at most 25 deg/s, and the measured angle is logged.
    """
    random = boat.random
    state = np.array((0.0, 0.0, 0.1 * random.standard_normal(), speed, 0.0, 0.0))
    rudder = 0.0
    moment = 0.0
    noise = np.array(tuple(_NOISE.values()))
    rows = []
    for k in range(round(duration / STEP) + 1):
        measured = state + noise * random.standard_normal(6)
        demanded, shaft = command(k * STEP, measured)
        rows.append((k * STEP, *measured, *shaft, rudder))
        for _ in range(_SUBSTEPS):
            dt = STEP / _SUBSTEPS
            rudder += float(np.clip(demanded - rudder, -0.44 * dt, 0.44 * dt))
            # a first-order random process with a time constant of 4 s
            moment += -moment * dt / 4.0
            moment += boat.disturbance * np.sqrt(2.0 * dt / 4.0) * random.standard_normal()
            state[3:] += dt * boat.accelerate(state[3:], rudder, shaft, moment)
            cos, sin = np.cos(state[2]), np.sin(state[2])
            u, v, r = state[3:]
            state[:3] += dt * np.array((u * cos - v * sin, u * sin + v * cos, r))
    return np.array(rows)


def hold_levels(
    random: np.random.Generator, levels: Callable[[], float], shortest: float, longest: float
) -> Callable[[float], float]:
    """Return a function of ascending time that holds random levels for random durations in s."""
    until = -1.0
    level = 0.0

    def at(t: float) -> float:
        nonlocal until, level
        while t >= until:
            until = max(until, 0.0) + random.uniform(shortest, longest)
            level = levels()
        return level

    return at


def _steps(boat: Boat, lowest: float, highest: float, angle: float, *, alike: bool) -> Command:
    """Return random steps of shaft speeds between limits and of a rudder up to an angle in rad."""
    random = boat.random
    shafts = [
        hold_levels(random, lambda: random.uniform(lowest, highest), 8.0, 20.0)
        for _ in range(2 if boat.has_two_propellers and not alike else 1)
    ]
    rudder = hold_levels(random, lambda: random.uniform(-angle, angle), 2.0, 8.0)

    def command(t: float, _: np.ndarray) -> tuple[float, np.ndarray]:
        speeds = np.array([shaft(t) for shaft in shafts])
        return rudder(t), np.repeat(speeds, 2) if alike and boat.has_two_propellers else speeds

    return command


def _zigzag(boat: Boat) -> Command:
    """Return a zigzag: the rudder reverses when the heading passes an angle."""
    random = boat.random
    angle = np.radians(random.choice((10.0, 15.0, 20.0, 25.0)))
    limit = np.radians(random.choice((10.0, 15.0, 20.0)))
    shaft = hold_levels(random, lambda: random.uniform(7.0, 14.0), 25.0, 45.0)
    side = 1.0

    def command(t: float, measured: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal side
        if side * measured[2] > limit:
            side = -side
        return side * angle, np.array((shaft(t),))

    return command


def _three_two_one_one(boat: Boat) -> Command:
    """Return repeated 3-2-1-1 sequences of the rudder at several shaft speeds."""
    random = boat.random
    shaft = hold_levels(random, lambda: random.uniform(7.0, 14.0), 14.0, 30.0)
    unit = random.uniform(1.2, 2.5)
    angle = np.radians(random.uniform(8.0, 25.0)) * random.choice((-1.0, 1.0))
    pattern = (1, 1, 1, -1, -1, 1, -1, 0, 0)

    def command(t: float, _: np.ndarray) -> tuple[float, np.ndarray]:
        cycle, place = divmod(int(t / unit), len(pattern))
        return pattern[place] * angle * (-1.0) ** cycle, np.array((shaft(t),))

    return command


def _keep_course(boat: Boat, *, course_steps: bool = False) -> Command:
    """Return a PID controller of the heading at one shaft speed, with or without course steps."""
    random = boat.random
    integral = 0.0
    course = hold_levels(random, lambda: random.uniform(-0.6, 0.6), 10.0, 20.0)

    def command(t: float, measured: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal integral
        error = measured[2] - (course(t) if course_steps else 0.0)
        integral += STEP * error
        rudder = -1.2 * error - 0.1 * integral - 1.0 * measured[5]
        return float(np.clip(rudder, -0.5, 0.5)), np.array((12.0,))

    return command


def _mirror(boat: Boat) -> Command:
    """Return a rudder of -1.6 times the heading at one shaft speed."""
    return lambda _, measured: (float(np.clip(-1.6 * measured[2], -0.5, 0.5)), np.array((12.0,)))


KINDS: Final[dict[str, tuple[dict[str, float | bool], Callable[[Boat], Command]]]] = {
    "fair": ({}, lambda boat: _steps(boat, 6.0, 14.0, 0.5, alike=False)),
    "zigzags": ({}, _zigzag),
    "3211": ({}, _three_two_one_one),
    "random": ({"disturbance": 0.03}, lambda boat: _steps(boat, 5.0, 14.0, 0.4, alike=False)),
    "twin": (
        {"has_two_propellers": True},
        lambda boat: _steps(boat, 6.0, 14.0, 0.4, alike=False),
    ),
    "pid": ({"disturbance": 0.06}, _keep_course),
    "pid_calm": ({"disturbance": 0.004}, _keep_course),
    "mirror": ({"disturbance": 0.06}, _mirror),
    "alike": ({"has_two_propellers": True}, lambda boat: _steps(boat, 6.0, 14.0, 0.4, alike=True)),
    "one_speed": ({}, lambda boat: _steps(boat, 12.0, 12.0, 0.45, alike=False)),
    "small_rudder": ({}, lambda boat: _steps(boat, 6.0, 14.0, 0.087, alike=False)),
    "set_points": ({"disturbance": 0.03}, lambda boat: _keep_course(boat, course_steps=True)),
}
"""Kind -> arguments of `draw_boat`, and what the logs command."""
WELL_EXCITED: Final = ("fair", "zigzags", "3211", "random", "twin")
"""Kinds whose logs excite every direction."""


def log_header(boat: Boat) -> list[str]:
    """Return the columns of the tables of a boat."""
    shafts = ["n_port_rps", "n_stbd_rps"] if boat.has_two_propellers else ["n_rps"]
    motion = ["x_m", "y_m", "heading_deg", "u_mps", "v_mps", "yaw_rate_dps"]
    return ["time_s", *motion, *shafts, "delta_deg"]


def write_table(path: Path, boat: Boat, rows: np.ndarray) -> None:
    """Write a table in degrees, the shaft speeds of two propellers with 0.05 1/s of noise."""
    rows = rows.copy()
    header = log_header(boat)
    for column, name in enumerate(header):
        if name.endswith(("_deg", "_dps")):
            rows[:, column] = np.degrees(rows[:, column])
        elif name.startswith("n_") and boat.has_two_propellers:
            rows[:, column] += 0.05 * boat.random.standard_normal(len(rows))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, fmt="%.6g", delimiter=",", header=",".join(header), comments="")


def make_boat(kind: str, seed: int) -> Boat:
    """Draw a boat of a kind."""
    arguments = KINDS[kind][0]
    return draw_boat(
        seed,
        has_two_propellers=bool(arguments.get("has_two_propellers", False)),
        disturbance=float(arguments.get("disturbance", 0.01)),
    )


def write_logs(
    kind: str, seed: int, folder: Path, n_logs: int = 10, duration: float = 120.0
) -> Boat:
    """Write the logs of a boat of a kind; return the boat."""
    boat = make_boat(kind, seed)
    for k in range(n_logs):
        rows = sail(boat, KINDS[kind][1](boat), duration)
        # the first seconds accelerate the boat from a common speed
        rows = rows[round(10.0 / STEP) :]
        rows[:, 0] -= rows[0, 0]
        write_table(folder / f"log_{k:02d}.csv", boat, rows)
    return boat


def open_loop_flights(
    boat: Boat, logs: list[np.ndarray], n_flights: int, duration: float = 60.0
) -> Iterator[np.ndarray]:
    """Sail a boat in open loop, each input within the 1 to 99 % quantiles of its logs.

    Every input steps by itself, also those that the logs held together or in proportion.

    Args:
        logs: tables of the logs in SI units and rad.
    """
    random = boat.random
    inputs = np.concatenate(logs)[:, 7:]
    lowest, highest = np.quantile(inputs, (0.01, 0.99), axis=0)
    for _ in range(n_flights):
        columns = [
            hold_levels(
                random,
                lambda j=j: random.uniform(lowest[j], highest[j]),  # type: ignore[misc]
                *((8.0, 20.0) if j < inputs.shape[1] - 1 else (2.0, 8.0)),
            )
            for j in range(inputs.shape[1])
        ]

        def command(
            t: float, _: np.ndarray, columns: list[Callable[[float], float]] = columns
        ) -> tuple[float, np.ndarray]:
            values = np.array([column(t) for column in columns])
            return float(values[-1]), values[:-1]

        rows = sail(boat, command, duration, speed=float(np.concatenate(logs)[:, 4].mean()))[100:]
        rows[:, 0] -= rows[0, 0]
        yield rows
