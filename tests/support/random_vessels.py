"""Vessels drawn at random, of 2 to 100 m, with one propeller and a rudder or with two propellers.

They are simulated together, in units of their own length and speed, by code that shares nothing
with residnet: a hull in surge, sway and yaw, actuators with rate and lag, gusts, noise. None has
the parameters of a shipped vessel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from planted import Ship

from residnet.core.log import Log

_SAMPLES = 1800
_SUBSTEPS = 2
KINDS = ("boat", "twin")


@dataclass(frozen=True)
class Vessels:
    """Parameters of B vessels, [B] each; hydrodynamic ones in units of length and speed."""

    length: np.ndarray
    speed: np.ndarray
    surge: np.ndarray
    drift: np.ndarray
    sway: np.ndarray
    cross: np.ndarray
    rudder_sway: np.ndarray
    yaw: np.ndarray
    yaw_square: np.ndarray
    munk: np.ndarray
    rudder_yaw: np.ndarray
    race: np.ndarray
    brake: np.ndarray
    revolutions: np.ndarray
    gust: np.ndarray


def draw(
    random: np.random.Generator, count: int, shortest: float = 2.0, longest: float = 100.0
) -> Vessels:
    """Draw vessels; their yaw is damped, and they turn in two to five lengths."""

    def between(low: float, high: float) -> np.ndarray:
        return np.exp(random.uniform(np.log(low), np.log(high), count))

    length = between(shortest, longest)
    speed = between(0.12, 0.35) * np.sqrt(9.81 * length)
    return Vessels(
        length=length,
        speed=speed,
        surge=between(0.08, 0.3),
        drift=between(0.4, 0.8),
        sway=between(0.8, 1.6),
        cross=between(0.5, 2.0),
        rudder_sway=between(0.1, 0.3),
        yaw=between(1.0, 2.5),
        yaw_square=between(0.3, 1.5),
        munk=between(0.1, 0.5),
        rudder_yaw=between(1.0, 2.5),
        race=between(0.2, 0.8),
        brake=between(0.05, 0.2),
        # a propeller of 2 to 6 % of the length, with an advance of .5 to 1 of its diameter
        revolutions=speed / (between(0.5, 1.0) * between(0.02, 0.06) * length),
        gust=between(0.002, 0.02),
    )


def random_logs(kind: str, seed: int, count: int) -> list[list[Log]]:
    """Return three logs of each of `count` vessels: a zigzag, random steps, and steps of both."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    vessels = draw(random, count)
    unit = vessels.length / vessels.speed
    step = np.array([0.05, 0.1, 0.2, 0.5, 1.0])
    step = step[np.argmin(np.abs(step[:, None] - unit / 15.0), axis=0)]
    draws = [draw_flight(count, what, random) for what in range(3)]
    flights = simulate_flights([vessels] * 3, kind, step, draws)
    return [
        [log_of(vessels, kind, flight, step, i, k, random) for k, flight in enumerate(flights)]
        for i in range(count)
    ]


def small_boat_logs(kind: str, seed: int, flights: int, seconds: float) -> list[Log]:
    """Return logs of one small boat of 1 to 8 m: paths followed, zigzags and steps in turn.

    Its noise is up to eight times that of `random_logs`, and its path is held by a course
    controller, so that the inputs answer the motion.

    Args:
        kind: one of `KINDS`.
        seed: of the boat, its paths and its noise.
        flights: number of logs.
        seconds: length of each.
    """
    random = np.random.default_rng([seed, KINDS.index(kind), 1])
    vessels = draw(random, 1, longest=8.0, shortest=1.0)
    unit = vessels.length / vessels.speed
    step = np.full(1, 0.1 if unit[0] < 4.0 else 0.2)
    samples = round(seconds / float(step[0]))
    noise = float(np.exp(random.uniform(0.0, np.log(8.0))))
    return [
        log_of(vessels, kind, flight, step, 0, k, random, noise)
        for k, flight in enumerate(
            fly(vessels, kind, (3, 0, 3, 1, 3, 2)[k % 6], step, random, samples)
            for k in range(flights)
        )
    ]


def ship_of(kind: str, log: Log) -> Ship:
    """The description of a host that planted faults need, in proportion to the vessel."""
    length = float(log.meta["length"])
    unit = length / float(log.meta["speed"])
    lag = (max(0.7, 0.15 * unit), max(1.4, 0.3 * unit))
    bias = (np.degrees(0.015 / unit), np.degrees(0.04 / unit))
    names = ("n_port", "n_port", "n_port") if kind == "twin" else ("delta", "delta", "delta")
    arm = (0.2 * length, 0.5 * length)
    return Ship(kind, kind, "0 s", "0 s", {}, lag, arm, bias, (names[0],), names[1], names[2])


@dataclass(frozen=True)
class FlightDraws:
    """Random numbers of a flight of B vessels over K samples, [K, B] each.

    Attributes:
        what: 0 for a zigzag, 1 for steps of the steering, 2 for steps of both, 3 for courses that a
            controller holds.
        heading: initial headings [B] in rad.
        angle: angles of the steering [B] in rad.
        limit: heading changes [B] in rad at which a zigzag reverses.
        side: first side of a zigzag [B].
        turn: changes of the course, or angles of the steering, in rad.
        turn_time: times until the next turn.
        power: settings of the propulsion.
        power_time: times until the next setting.
        gust: standard normal numbers [K, substeps, 3, B].
    """

    what: int
    heading: np.ndarray
    angle: np.ndarray
    limit: np.ndarray
    side: np.ndarray
    turn: np.ndarray
    turn_time: np.ndarray
    power: np.ndarray
    power_time: np.ndarray
    gust: np.ndarray


def draw_flight(
    count: int, what: int, random: np.random.Generator, samples: int = _SAMPLES
) -> FlightDraws:
    """Draw the random numbers of a flight of `count` vessels; see `FlightDraws`."""
    heading = random.uniform(-3.0, 3.0, count)
    angle = random.uniform(0.17, 0.52, count)
    limit = random.uniform(0.17, 0.4, count)
    side = random.choice([-1.0, 1.0], count)
    turn, turn_time, power, power_time = np.zeros((4, samples, count))
    gust = np.zeros((samples, _SUBSTEPS, 3, count))
    for k in range(samples):
        if what == 3:
            turn[k] = random.uniform(-1.6, 1.6, count)
            turn_time[k] = random.uniform(6.0, 18.0, count)
        elif what != 0:
            turn[k] = random.uniform(-0.55, 0.55, count)
            turn_time[k] = random.uniform(2.0, 8.0, count)
        if what in (2, 3):
            power[k] = random.uniform(0.4, 1.1, count)
            power_time[k] = random.uniform(8.0, 20.0, count)
        gust[k] = random.standard_normal((_SUBSTEPS, 3, count))
    return FlightDraws(what, heading, angle, limit, side, turn, turn_time, power, power_time, gust)


def simulate_flights(
    vessels: Sequence[Vessels], kind: str, step: np.ndarray, draws: Sequence[FlightDraws]
) -> list[dict[str, np.ndarray]]:
    """Simulate flights together, which takes little longer than one of them.

    Args:
        vessels: B vessels of each flight.
        kind: one of `KINDS`.
        step: time steps of these vessels [B] in s.
        draws: random numbers of each flight, all of the same number of samples.

    Returns:
        State and actuators [K, B] in units of length and speed, for each flight.
    """
    joined = Vessels(
        **{
            part.name: np.concatenate([getattr(one, part.name) for one in vessels])
            for part in fields(Vessels)
        }
    )

    def join(name: str) -> np.ndarray:
        return np.concatenate([getattr(one, name) for one in draws], axis=-1)

    n_flights = len(draws)
    unit = joined.length / joined.speed
    steps = np.tile(step, n_flights)
    dt = steps / unit / _SUBSTEPS
    what = np.repeat([one.what for one in draws], len(step))
    is_zigzag = what == 0
    is_course = what == 3
    has_power_steps = what >= 2
    psi, angle, limit, sign = map(join, ("heading", "angle", "limit", "side"))
    turns, turn_times, powers, power_times, gust = map(
        join, ("turn", "turn_time", "power", "power_time", "gust")
    )
    x, y, v, r, side, turn, until, powered = np.zeros((8, psi.size))
    u = np.full(psi.size, 0.7)
    drive = np.full(psi.size, 0.8)
    power = np.full(psi.size, 0.8)
    course = psi.copy()
    gusts = np.zeros((3, psi.size))
    names = ("x", "y", "psi", "u", "v", "r", "side", "drive")
    out = np.zeros((len(names), len(turns), psi.size))
    for k in range(len(turns)):
        out[:, k] = (x, y, psi, u, v, r, side, drive)
        now = k * steps / unit
        sign = np.where(is_zigzag & (sign * (psi - course) > limit), -sign, sign)
        is_turning = now >= until
        course = np.where(is_course & is_turning, course + turns[k], course)
        turn = np.where(is_turning, turns[k], turn)
        until = np.where(is_turning, now + turn_times[k], until)
        held_course = np.clip(1.2 * (course - psi) - 0.6 * r, -angle, angle)
        wanted = np.where(is_course, held_course, turn)
        wanted = np.where(is_zigzag, np.where(now > 3.0, sign * angle, 0.0), wanted)
        is_new_power = has_power_steps & (now >= powered)
        power = np.where(is_new_power, powers[k], power)
        powered = np.where(is_new_power, now + power_times[k], powered)
        for substep in range(_SUBSTEPS):
            gusts += dt * (-gusts / 3.0) + np.sqrt(dt) * gust[k, substep] * (joined.gust * 0.8)
            side = side + np.clip(wanted - side, -0.5 * dt, 0.5 * dt)
            drive = drive + dt / 0.3 * (power - drive)
            du, dv, dr = accelerations(joined, kind, (u, v, r), (side, drive), gusts)
            u, v, r = u + dt * du, v + dt * dv, r + dt * dr
            x = x + dt * (u * np.cos(psi) - v * np.sin(psi))
            y = y + dt * (u * np.sin(psi) + v * np.cos(psi))
            psi = psi + dt * r
    return [dict(zip(names, flight, strict=True)) for flight in np.split(out, n_flights, axis=-1)]


def fly(
    vessels: Vessels,
    kind: str,
    what: int,
    step: np.ndarray,
    random: np.random.Generator,
    samples: int = _SAMPLES,
) -> dict[str, np.ndarray]:
    """Return state and actuators [samples, B] of one flight; see `FlightDraws.what`."""
    draws = draw_flight(vessels.length.size, what, random, samples)
    return simulate_flights([vessels], kind, step, [draws])[0]


def accelerations(
    vessels: Vessels,
    kind: str,
    velocities: tuple[np.ndarray, np.ndarray, np.ndarray],
    actuators: tuple[np.ndarray, np.ndarray],
    gusts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the accelerations in surge, sway and yaw in units of length and speed, [B] each.

    Args:
        vessels: parameters of the vessels.
        kind: `twin` for two propellers that steer by their difference, `boat` for a rudder.
        velocities: u, v, r.
        actuators: rudder angle or relative difference of the propellers, and thrust setting.
        gusts: accelerations by gusts [3, B].
    """
    u, v, r = velocities
    side, drive = actuators
    thrust = 1.4 * drive * np.abs(drive) - 0.4 * drive * u
    if kind == "twin":
        steer = 0.8 * drive * side
    else:
        flow = (1.0 - vessels.race) * u * np.abs(u) + vessels.race * drive * np.abs(drive)
        steer = flow * np.sin(side)
    du = vessels.surge * (thrust - u * np.abs(u)) + 0.6 * v * r + gusts[0]
    du = du - vessels.brake * u * np.abs(u) * side**2
    dv = -vessels.sway * np.abs(u) * v - vessels.cross * v * np.abs(v)
    dv = dv - vessels.drift * u * r - vessels.rudder_sway * steer + gusts[1]
    dr = -vessels.yaw * np.abs(u) * r - vessels.yaw_square * r * np.abs(r)
    dr = dr - vessels.munk * u * v + vessels.rudder_yaw * steer + gusts[2]
    return du, dv, dr


def skip_log(rows: int, random: np.random.Generator) -> None:
    """Draw as many random numbers as `log_of` does for a log of some rows."""
    random.uniform()
    random.standard_normal((6, rows))


def log_of(
    vessels: Vessels,
    kind: str,
    flight: dict[str, np.ndarray],
    step: np.ndarray,
    i: int,
    k: int,
    random: np.random.Generator,
    noisy: float = 1.0,
) -> Log:
    count = len(flight["x"])
    length = float(vessels.length[i])
    speed = float(vessels.speed[i])
    scale = {"x": length, "y": length, "psi": 1.0, "u": speed, "v": speed, "r": speed / length}
    accuracy = noisy * random.uniform(0.3, 1.5)
    noise = {"x": 0.005, "y": 0.005, "psi": 0.003, "u": 0.01, "v": 0.01, "r": 0.005}
    channels = {
        name: size * (flight[name][:, i] + accuracy * noise[name] * random.standard_normal(count))
        for name, size in scale.items()
    }
    side = flight["side"][:, i]
    drive = flight["drive"][:, i]
    most = float(vessels.revolutions[i])
    if kind == "twin":
        channels |= {"n_port": most * drive * (1.0 + side), "n_stbd": most * drive * (1.0 - side)}
    else:
        channels |= {"n": most * drive, "delta": side}
    t = float(step[i]) * np.arange(count)
    return Log(f"{kind}_{i}_{k}", t, channels, meta={"length": length, "speed": speed})
