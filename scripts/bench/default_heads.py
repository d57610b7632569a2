"""Compare PLSR, MLP and LSTM heads at default settings on logs of drawn vessels.

    python scripts/bench/default_heads.py [--vessels ship_1 ship_2 ship_3 catamaran_1 ...]
        [--logs 30] [--heads plsr mlp lstm] [--seeds 0] [--noise 1] [--csv FILE]

The physics of this file is independent of residnet: a ship with one propeller and one rudder, a
catamaran with two propellers and a double-ended ferry with two azimuth thrusters, integrated by the
classical Runge-Kutta method. Parameters, manoeuvres, disturbances and sensor noise are drawn from
the number in the name of the vessel; odd numbers log measured actuators, even ones commands.
Vessels with the numbers 101 to 199 were used to develop the default training; results are reported
for others.

Models are fitted to `--logs` logs (of which `prepare` selects three fifths for training and one
fifth for validation) and compared on as many others. Every row of the output is one model: position
error at the end of the free runs of the other logs, normalised RMSE of the velocities, ratio of the
position error to the one of PLSR, training time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import bench
import numpy as np
import pandas as pd
from numpy.typing import NDArray

import residnet
from residnet.core.log import Log

Array = NDArray[np.float64]
LOG_DURATION = 100.0
SAMPLE_INTERVAL = 0.1
SUBSTEPS = 2
"""Runge-Kutta steps in a sample interval."""
DEFAULT_VESSELS = ("ship_1", "ship_2", "ship_3", "catamaran_1", "catamaran_2", "ferry_1")


@dataclass(frozen=True)
class Plant:
    """Equations of motion of a drawn vessel.

    Attributes:
        input_names: channels of the logs that drive the vessel.
        lower, upper: limits of the inputs, SI.
        rate: largest rates of change of the inputs, SI.
        lag: time constants of the first-order actuator response, s.
        inertia: inertia matrix with added mass [3, 3].
        force: surge force, sway force and yaw moment at velocities [3] and actuator states.
        speed: approach speed in m/s; yaw rates scale with speed / length.
        length: length in m.
        cruise: inputs of the approach.
    """

    input_names: tuple[str, ...]
    lower: Array
    upper: Array
    rate: Array
    lag: Array
    inertia: Array
    force: Callable[[Array, Array], Array]
    speed: float
    length: float
    cruise: Array


def draw_ship(random: np.random.Generator) -> Plant:  # noqa: PLR0915 (one draw per parameter)
    """Draw a ship with one propeller and one rudder after the MMG model (Yasukawa 2015)."""
    length = float(random.uniform(6.0, 25.0))
    # Froude numbers of 0.25 to 0.35
    speed = float(random.uniform(0.8, 1.1) * math.sqrt(length))
    draught = 0.06 * length
    density = 1025.0
    vary = lambda value, share=0.2: value * (1.0 + share * random.uniform(-1.0, 1.0))  # noqa: E731
    mass_unit = 0.5 * density * length**2 * draught
    mass = vary(0.2)
    added_x = vary(0.022)
    added_y = vary(0.223)
    added_n = vary(0.011)
    inertia_z = mass * 0.25**2
    centre = random.uniform(-0.01, 0.03)
    inertia = np.array(
        [
            [mass + added_x, 0.0, 0.0],
            [0.0, mass + added_y, mass * centre],
            [0.0, mass * centre, inertia_z + mass * centre**2 + added_n],
        ]
    )
    resistance = vary(0.022)
    hull_x = [vary(-0.04), vary(0.002), vary(0.011), vary(0.771)]
    hull_y = [vary(-0.315), vary(0.083), vary(-1.607), vary(0.379), vary(-0.391), vary(0.008)]
    hull_n = [vary(-0.137), vary(-0.055), vary(-0.03), vary(-0.294), vary(0.055), vary(-0.013)]
    diameter = 0.045 * length
    k_0 = vary(0.293)
    k_1 = vary(-0.275, 0.1)
    k_2 = vary(-0.139, 0.1)
    wake = vary(0.35)
    thrust_deduction = 0.22
    rudder_area = vary(0.02) * length * draught
    lift_slope = vary(2.75)
    rudder_x = -0.5
    steering_loss = vary(0.39)
    force_increase = vary(0.31)
    lever_increase = vary(-0.46, 0.1)
    flow_straightening = vary(0.5)
    race = vary(0.5)

    def propeller_thrust(surge: float, n: float) -> float:
        inflow = (1.0 - wake) * surge
        forward = k_0 * abs(n) * n * diameter**4 + k_1 * inflow * abs(n) * diameter**3
        return density * (1.0 - thrust_deduction) * (forward + k_2 * inflow**2 * diameter**2)

    n_cruise = next(
        n
        for n in np.linspace(0.1, 60.0, 6000)
        if propeller_thrust(speed, n) > resistance * 0.5 * density * length * draught * speed**2
    )

    def force(nu: Array, actuators: Array) -> Array:
        u, v, r = nu
        n, delta = actuators
        total = math.sqrt(u**2 + v**2) + 1e-6
        vd = v / total
        rd = r * length / total
        pressure = 0.5 * density * length * draught * total**2
        x_h = pressure * (
            -resistance * u * abs(u) / total**2
            + hull_x[0] * vd**2 + hull_x[1] * vd * rd + hull_x[2] * rd**2 + hull_x[3] * vd**4
        )  # fmt: skip
        cubic = (vd, rd, vd**3, vd**2 * rd, vd * rd**2, rd**3)
        y_h = pressure * sum(a * b for a, b in zip(hull_y, cubic, strict=True))
        n_h = pressure * length * sum(a * b for a, b in zip(hull_n, cubic, strict=True))
        thrust = propeller_thrust(u, n)
        slip = max(0.0, 8.0 * thrust / (math.pi * density * diameter**2))
        u_r = (1.0 - wake) * 1.1 * math.sqrt(max(u, 0.0) ** 2 + race * slip) + 0.05
        # the flow at the rudder, 0.9 half lengths aft, opposes the yaw rate
        v_r = -flow_straightening * (v - 0.9 * length * r)
        normal = 0.5 * density * rudder_area * lift_slope * (u_r**2 + v_r**2)
        normal *= math.sin(delta - math.atan2(v_r, u_r))
        x_r = -(1.0 - steering_loss) * normal * math.sin(delta)
        y_r = -(1.0 + force_increase) * normal * math.cos(delta)
        n_r = -(rudder_x + force_increase * lever_increase) * length * normal * math.cos(delta)
        mass_si = mass * mass_unit
        lever = mass_si * centre * length
        coriolis = np.array(
            [
                (mass_si + added_y * mass_unit) * v * r + lever * r**2,
                -(mass_si + added_x * mass_unit) * u * r,
                -lever * u * r,
            ]
        )
        return coriolis + np.array([x_h + thrust + x_r, y_h + y_r, n_h + n_r])

    units = np.array([1.0, 1.0, length])
    return Plant(
        ("n", "delta"),
        np.array([0.3 * n_cruise, math.radians(-35.0)]),
        np.array([1.3 * n_cruise, math.radians(35.0)]),
        np.array([0.2 * n_cruise, math.radians(vary(6.0, 0.4))]),
        np.array([vary(1.0), 0.15]),
        inertia * mass_unit * units[:, None] * units[None, :],
        force,
        speed,
        length,
        np.array([n_cruise, 0.0]),
    )


def draw_catamaran(random: np.random.Generator) -> Plant:
    """Draw an unmanned catamaran with two fixed propellers and quadratic damping."""
    length = float(random.uniform(3.0, 8.0))
    speed = float(random.uniform(1.5, 2.5))
    mass = 20.0 * length**2 * random.uniform(0.7, 1.3)
    vary = lambda value, share=0.25: value * (1.0 + share * random.uniform(-1.0, 1.0))  # noqa: E731
    inertia_z = mass * (0.25 * length) ** 2
    added = (vary(0.08) * mass, vary(0.7) * mass, vary(0.5) * inertia_z)
    centre = vary(0.03, 0.9) * length
    drag = mass * vary(0.09) * speed
    linear = np.array([0.25 * drag, vary(0.35) * mass, vary(0.6) * inertia_z])
    quadratic = np.array([0.75 * drag / speed, vary(0.6) * mass, vary(0.9) * inertia_z])
    cross = vary(0.25) * mass * length * 0.1
    munk = vary(0.2)
    beam = 0.2 * length * random.uniform(0.8, 1.2)
    n_cruise = vary(10.0)
    thrust_gain = drag * speed / (2.0 * n_cruise**2) / 0.75
    inflow_loss = 0.25 * thrust_gain * n_cruise / speed
    astern = vary(0.6)
    inertia = np.array(
        [
            [mass + added[0], 0.0, 0.0],
            [0.0, mass + added[1], mass * centre],
            [0.0, mass * centre, inertia_z + mass * centre**2 + added[2]],
        ]
    )

    def force(nu: Array, actuators: Array) -> Array:
        u, v, r = nu
        thrusts = []
        for n, sign in zip(actuators, (1.0, -1.0), strict=True):
            gain = thrust_gain if n >= 0.0 else astern * thrust_gain
            # the inflow of a turning hull differs between the two propellers
            inflow = u + sign * beam * r
            thrusts.append(gain * n * abs(n) - inflow_loss * abs(n) * inflow)
        damping = linear * nu + quadratic * np.abs(nu) * nu
        damping[1] += cross * abs(r) * v + cross * abs(v) * r
        damping[2] += cross * abs(v) * r + 0.5 * cross * abs(r) * v
        coriolis = np.array(
            [
                (mass + added[1]) * v * r + mass * centre * r**2,
                -(mass + added[0]) * u * r,
                -mass * centre * u * r - munk * (added[1] - added[0]) * u * v,
            ]
        )
        surge = thrusts[0] + thrusts[1]
        return coriolis - damping + np.array([surge, 0.0, beam * (thrusts[0] - thrusts[1])])

    return Plant(
        ("n_port", "n_stbd"),
        np.full(2, -0.8 * n_cruise),
        np.full(2, 1.4 * n_cruise),
        np.full(2, vary(6.0) * n_cruise),
        np.full(2, vary(0.3)),
        inertia,
        force,
        speed,
        length,
        np.full(2, n_cruise),
    )


def draw_ferry(random: np.random.Generator) -> Plant:
    """Draw a double-ended ferry with an azimuth thruster at each end."""
    length = float(random.uniform(5.0, 14.0))
    speed = float(random.uniform(0.5, 0.7) * math.sqrt(length))
    mass = 60.0 * length**2 * random.uniform(0.8, 1.2)
    vary = lambda value, share=0.25: value * (1.0 + share * random.uniform(-1.0, 1.0))  # noqa: E731
    inertia_z = mass * (0.28 * length) ** 2
    added = (vary(0.1) * mass, vary(0.8) * mass, vary(0.5) * inertia_z)
    drag = mass * vary(0.06) * speed
    linear = np.array([0.3 * drag, vary(0.12) * mass, vary(0.2) * inertia_z])
    quadratic = np.array([0.7 * drag / speed, vary(0.35) * mass, vary(0.8) * inertia_z])
    cross = vary(0.2) * mass
    n_cruise = vary(8.0)
    thrust_gain = drag * speed / (2.0 * n_cruise**2) / 0.7
    inflow_loss = 0.3 * thrust_gain * n_cruise / speed
    arms = np.array([vary(0.4, 0.1), -vary(0.4, 0.1)]) * length
    inertia = np.diag([mass + added[0], mass + added[1], inertia_z + added[2]])

    def force(nu: Array, actuators: Array) -> Array:
        u, v, r = nu
        total = np.zeros(3)
        for k, arm in enumerate(arms):
            n = actuators[2 * k]
            angle = actuators[2 * k + 1]
            inflow = u * math.cos(angle) + (v + arm * r) * math.sin(angle)
            thrust = thrust_gain * n * abs(n) - inflow_loss * abs(n) * inflow
            side = thrust * math.sin(angle)
            total += np.array([thrust * math.cos(angle), side, arm * side])
        damping = linear * nu + quadratic * np.abs(nu) * nu
        damping[1] += cross * abs(r) * v
        damping[2] += 0.3 * cross * abs(v) * r
        coriolis = np.array(
            [
                (mass + added[1]) * v * r,
                -(mass + added[0]) * u * r,
                -0.3 * (added[1] - added[0]) * u * v,
            ]
        )
        return coriolis - damping + total

    angle_limit = math.radians(50.0)
    angle_rate = math.radians(vary(25.0))
    return Plant(
        ("n_fore", "azimuth_fore", "n_aft", "azimuth_aft"),
        np.array([0.2 * n_cruise, -angle_limit, 0.2 * n_cruise, -angle_limit]),
        np.array([1.4 * n_cruise, angle_limit, 1.4 * n_cruise, angle_limit]),
        np.array([2.0 * n_cruise, angle_rate, 2.0 * n_cruise, angle_rate]),
        np.array([vary(0.5), vary(0.4), vary(0.5), vary(0.4)]),
        inertia,
        force,
        speed,
        length,
        np.array([n_cruise, 0.0, n_cruise, 0.0]),
    )


DRAWS: dict[str, Callable[[np.random.Generator], Plant]] = {
    "ship": draw_ship,
    "catamaran": draw_catamaran,
    "ferry": draw_ferry,
}


def draw_commands(plant: Plant, random: np.random.Generator, kind: str, n_samples: int) -> Array:
    """Draw commands [T, m]: steps of random height, a zigzag in time, or speed changes.

    The duration of a step is several times length / speed, in which a vessel responds.
    """
    response_time = plant.length / plant.speed
    commands = np.empty((n_samples, len(plant.input_names)))
    level = plant.cruise * random.uniform(0.7, 1.2)
    sample = 0
    sign = random.choice((-1.0, 1.0))
    amplitude = random.uniform(0.3, 1.0)
    while sample < n_samples:
        duration = response_time * random.uniform(0.8, 4.0)
        end = sample + max(5, round(duration / SAMPLE_INTERVAL))
        if kind == "random_steps":
            level = random.uniform(plant.lower, plant.upper)
            amplitude = random.uniform(0.0, 1.0)
        elif kind == "speed_changes":
            level = plant.cruise * random.uniform(0.4, 1.3)
            amplitude = random.uniform(0.0, 0.15)
        sign = -sign
        commands[sample:end] = add_steering(plant, level, sign * amplitude)
        sample = end
    return np.clip(commands, plant.lower, plant.upper)


def add_steering(plant: Plant, level: Array, steering: float) -> Array:
    """Return inputs [m] with a steering command between -1 and 1 added to `level`."""
    inputs = level.copy()
    for k, name in enumerate(plant.input_names):
        if name in ("delta", "azimuth_aft"):
            inputs[k] = steering * plant.upper[k] * (1.0 if name == "delta" else -1.0)
        elif name == "azimuth_fore":
            inputs[k] = 0.6 * steering * plant.upper[k]
        elif name in ("n_port", "n_stbd"):
            inputs[k] += 0.6 * plant.cruise[k] * steering * (1.0 if name == "n_port" else -1.0)
    return inputs


def simulate_log(
    plant: Plant,
    random: np.random.Generator,
    kind: str,
    name: str,
    noise: float,
    logs_actuators: bool,
) -> Log:
    """Simulate a log with a slow random disturbance and sensor noise.

    Args:
        noise: factor of disturbance and sensor noise.
        logs_actuators: whether the inputs of the log are measured positions of the actuators
            instead of commands.
    """
    n_samples = round(LOG_DURATION / SAMPLE_INTERVAL) + 1
    commands = draw_commands(plant, random, kind, n_samples)
    inverse_inertia = np.linalg.inv(plant.inertia)
    yaw_unit = plant.speed / plant.length
    # disturbance: a first-order Gauss-Markov process with a time constant of 5 length / speed
    disturbance_scale = noise * 0.001 * plant.speed * yaw_unit * np.array([1.0, 1.0, yaw_unit])
    disturbance_scale[2] /= plant.speed
    disturbance_decay = math.exp(-SAMPLE_INTERVAL * yaw_unit / 5.0)
    disturbance = disturbance_scale * random.normal(size=3)
    # surge, sway, yaw rate, north, east, heading, actuator states
    state = np.concatenate(
        ([0.9 * plant.speed, 0.0, 0.0, 0.0, 0.0, random.uniform(-3.0, 3.0)], commands[0])
    )

    def derivative(state: Array, command: Array) -> Array:
        u, v, r = nu = state[:3]
        heading = state[5]
        actuators = state[6:]
        change = np.clip((command - actuators) / plant.lag, -plant.rate, plant.rate)
        acceleration = inverse_inertia @ plant.force(nu, actuators) + disturbance
        sine = math.sin(heading)
        cosine = math.cos(heading)
        position_rate = [u * cosine - v * sine, u * sine + v * cosine, r]
        return np.concatenate((acceleration, position_rate, change))

    states = np.empty((n_samples, state.size))
    step = SAMPLE_INTERVAL / SUBSTEPS
    for k in range(n_samples):
        states[k] = state
        for _ in range(SUBSTEPS):
            k_1 = derivative(state, commands[k])
            k_2 = derivative(state + 0.5 * step * k_1, commands[k])
            k_3 = derivative(state + 0.5 * step * k_2, commands[k])
            k_4 = derivative(state + step * k_3, commands[k])
            state = state + step / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4)
        disturbance = disturbance_decay * disturbance + math.sqrt(
            1.0 - disturbance_decay**2
        ) * disturbance_scale * random.normal(size=3)
    sensor_noise = noise * np.array([0.01, 0.01, math.radians(0.1), 0.1, 0.1, math.radians(0.2)])
    measured = states[:, :6] + sensor_noise * random.normal(size=(n_samples, 6))
    # logged commands do not show the response of the actuators
    inputs = states[:, 6:] if logs_actuators else commands
    channels = {
        **dict(zip(("u", "v", "r", "x", "y", "psi"), measured.T.copy(), strict=True)),
        **dict(zip(plant.input_names, inputs.T.copy(), strict=True)),
    }
    return Log(name, SAMPLE_INTERVAL * np.arange(n_samples), channels, manoeuvre=kind)


def draw_logs(vessel: str, count: int, noise: float = 1.0) -> list[Log]:
    """Draw a vessel by its name, such as `ship_1`, and simulate its logs."""
    kind, _, number = vessel.partition("_")
    random = np.random.default_rng([int(number), *map(ord, kind)])
    plant = DRAWS[kind](random)
    logs_actuators = int(number) % 2 == 1
    manoeuvres = ("zigzag", "random_steps", "speed_changes")
    return [
        simulate_log(
            plant, random, manoeuvres[k % 3], f"{manoeuvres[k % 3]}_{k:02d}", noise, logs_actuators
        )
        for k in range(count)
    ]


def compare_heads(
    vessel: str, count: int, heads: Sequence[str], seed: int, noise: float
) -> pd.DataFrame:
    """Fit the heads at default settings on a linear baseline, and return a row per model.

    Models are fitted to the first half of the logs and compared on the second half.
    """
    logs = draw_logs(vessel, 2 * count, noise)
    data = residnet.prepare(logs[:count])
    # a fifth of the logs, the test split, has too few windows to compare position errors
    unseen = residnet.prepare(logs[count:], settings_from=data)
    models = residnet.fit(data, heads=list(heads), seed=seed, bands=None)
    table = residnet.metrics(models, unseen)
    table = table[table.protocol == models.settings.evaluation.selection].set_index("model")
    reference = float(table.position_error_end.get("plsr", math.nan))
    rows = [
        {
            "vessel": vessel,
            "seed": seed,
            "model": name,
            "protocol": row.protocol,
            "position": row.position_error_end,
            "nrmse": row.nrmse_mean,
            "to_plsr": row.position_error_end / reference,
            "diverged": row.diverged,
            "seconds": models[name].notes.get("seconds", 0.0),
        }
        for name, row in table.iterrows()
    ]
    return pd.DataFrame(rows)


def main() -> None:
    """Print a table of the models of each vessel."""
    args = bench.options(
        __doc__,
        vessels=list(DEFAULT_VESSELS),
        logs=30,
        heads=["plsr", "mlp", "lstm"],
        seeds=[0],
        noise=1.0,
        csv=None,
    )
    tables = []
    for vessel in args.vessels:
        for seed in args.seeds:
            tables.append(compare_heads(vessel, args.logs, args.heads, seed, args.noise))
            print(tables[-1].round(3).to_string(index=False), flush=True)
    if args.csv is not None:
        pd.concat(tables).to_csv(Path(args.csv), index=False)


if __name__ == "__main__":
    main()
