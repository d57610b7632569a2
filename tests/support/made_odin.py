"""Truth for equations in plain NumPy: Odin and the mass-spring-damper (5.13) of document 000.

Odin has (6.6)-(6.8) and (6.12)-(6.23) with corrections H1 to H11.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

A, R = (6244.15, -178.46, 0.881043), (85.8316, -1.7935, 0.00533)
KNOTS = 1.94
SURGE = 2.026e-4
YAW = 4.78e-5
LEVER = -3.82
FORCE_TRUTH = {
    "u_dot": {"tau_x": SURGE, "v r": 1.0, "u": -0.0101, "u |u|": -0.0492},
    "v_dot": {"tau_y": SURGE, "u r": -1.0, "v": -0.045, "v |v|": -0.4052},
    "r_dot": {"tau_n": YAW, "v": -0.0612, "r": -0.0612, "r |r|": -0.1422},
}
MSD_TRUTH = {"tau": 0.1, "w": -1.3, "x": -0.5}
Inputs = Mapping[str, Callable[[np.ndarray], np.ndarray]]


def _thrust_terms(angle: str, gain: float) -> dict[str, float]:
    """Coefficients of g(rpm, u) sin or cos of the nozzle, from the two parabolas of (6.16)."""
    out = {}
    for i, a in enumerate(A):
        for j, c in enumerate(R):
            parts = [("", "u", "u^2")[i], ("", "rpm", "rpm^2")[j], f"{angle}(nozzle)"]
            out[" ".join(part for part in parts if part)] = gain * 2 * a * KNOTS**i * c / 4530
    return out


JET_TRUTH = {
    "u_dot": {**_thrust_terms("cos", SURGE), "v r": 1.0, "u": -0.0101, "u |u|": -0.0492},
    "v_dot": {**_thrust_terms("sin", SURGE), "u r": -1.0, "v": -0.045, "v |v|": -0.4052},
    "r_dot": {**_thrust_terms("sin", LEVER * YAW), "v": -0.0612, "r": -0.0612, "r |r|": -0.1422},
}


def force_rate(z: Mapping[str, np.ndarray]) -> np.ndarray:
    """Accelerations [3, T]."""
    u, v, r = z["u"], z["v"], z["r"]
    return np.stack(
        (
            SURGE * z["tau_x"] + v * r - 0.0101 * u - 0.0492 * np.abs(u) * u,
            SURGE * z["tau_y"] - u * r - 0.045 * v - 0.4052 * np.abs(v) * v,
            YAW * z["tau_n"] - 0.0612 * (v + r) - 0.1422 * np.abs(r) * r,
        )
    )


def jet_rate(z: Mapping[str, np.ndarray]) -> np.ndarray:
    """Accelerations [3, T]."""
    speed = KNOTS * z["u"]
    rpm = z["rpm"]
    thrust = (A[0] + A[1] * speed + A[2] * speed**2) * (R[0] + R[1] * rpm + R[2] * rpm**2) / 4530
    along = 2 * thrust * np.cos(z["nozzle"])
    across = 2 * thrust * np.sin(z["nozzle"])
    return force_rate({**z, "tau_x": along, "tau_y": across, "tau_n": LEVER * across})


def msd_rate(z: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rates of displacement x and velocity w, [2, T]."""
    return np.stack((z["w"], -1.3 * z["w"] + 0.1 * z["tau"] - 0.5 * z["x"]))


def simulate(
    rate: Callable[[Mapping[str, np.ndarray]], np.ndarray],
    states: tuple[str, ...],
    designs: Sequence[Inputs],
    seconds: float,
    step: float,
    within: int = 1,
) -> list[dict[str, np.ndarray]]:
    """Logs of several designs at once: states from rest, inputs and the exact rates at the samples.

    RK4 with `within` steps to a sample and inputs as functions of time; a jump at a sample belongs
    to the step that begins there.
    """
    h = step / within
    stage = np.arange(round(seconds / step) * within)[:, None] * h + np.array(
        [0.0, h / 2, h - 1e-12]
    )
    known = {
        name: np.stack([design[name](stage) for design in designs], axis=-1) for name in designs[0]
    }
    x = np.zeros((len(states), len(designs)))
    path = []

    def f(x: np.ndarray, k: int, s: int) -> np.ndarray:
        return rate(
            {
                **dict(zip(states, x, strict=True)),
                **{name: values[k, s] for name, values in known.items()},
            }
        )

    for k in range(len(stage)):
        if k % within == 0:
            path.append(x)
        a = f(x, k, 0)
        b = f(x + h / 2 * a, k, 1)
        c = f(x + h / 2 * b, k, 1)
        x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c, k, 2))
    t = np.arange(len(path)) * step
    logs = []
    for number, design in enumerate(designs):
        log = {
            "t": t,
            **dict(zip(states, np.array(path)[..., number].T, strict=True)),
            **{name: signal(t) for name, signal in design.items()},
        }
        logs.append(
            log | {f"{name}_dot": value for name, value in zip(states, rate(log), strict=True)}
        )
    return logs


def multisine(
    seed: np.random.Generator,
    mean: float,
    amplitude: float,
    periods: tuple[float, float] = (5.0, 70.0),
    count: int = 4,
) -> Callable[[np.ndarray], np.ndarray]:
    """A sum of sines with random periods (in s), phases and shares."""
    period = np.exp(seed.uniform(np.log(periods[0]), np.log(periods[1]), count))
    phase = seed.uniform(0, 2 * np.pi, count)
    share = seed.dirichlet(np.full(count, 3.0))
    return lambda t: (
        mean
        + amplitude
        * (share * np.sin(2 * np.pi * np.asarray(t)[..., None] / period + phase)).sum(-1)
        * np.sqrt(count)
    )


def force_logs(
    count: int,
    seconds: float = 300.0,
    step: float = 0.1,
    periods: tuple[float, float] = (5.0, 70.0),
    first: int = 0,
) -> list[dict[str, np.ndarray]]:
    """Random multi-sine designs of forces."""
    designs = []
    for number in range(first, first + count):
        seed = np.random.default_rng(number)
        ranges = {"tau_x": (2000, 4000), "tau_y": (0, 1500), "tau_n": (0, 2500)}
        designs.append(
            {
                name: multisine(seed, mean, amplitude, periods)
                for name, (mean, amplitude) in ranges.items()
            }
        )
    return simulate(force_rate, ("u", "v", "r"), designs, seconds, step)


def jet_logs(count: int, seconds: float = 300.0, step: float = 0.1) -> list[dict[str, np.ndarray]]:
    """Random multi-sine designs of motor speed (rpm) and nozzle angle (rad)."""
    seeds = [np.random.default_rng(1000 + number) for number in range(count)]
    designs = [
        {"rpm": multisine(seed, 1000, 500), "nozzle": multisine(seed, 0.0, 0.25)} for seed in seeds
    ]
    return simulate(jet_rate, ("u", "v", "r"), designs, seconds, step)


def step_log(
    number: int, seconds: float = 300.0, step: float = 0.1, every: float = 10.0
) -> dict[str, np.ndarray]:
    """Forces that jump to random levels every so many seconds."""
    seed = np.random.default_rng(number)
    count = round(seconds / every)
    levels = {
        "tau_x": seed.uniform(-2000, 6000, count),
        "tau_y": seed.uniform(-1500, 1500, count),
        "tau_n": seed.uniform(-2500, 2500, count),
    }

    def held(values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        return lambda t: values[np.minimum((np.asarray(t) + 1e-9) // every, count - 1).astype(int)]

    design = {name: held(values) for name, values in levels.items()}
    return simulate(force_rate, ("u", "v", "r"), [design], seconds, step, within=2)[0]


def msd_log(seconds: float = 50.0, step: float = 0.1, delay: float = 0.0) -> dict[str, np.ndarray]:
    """Document 000 section 5.3.1: a square wave of 1 N with a period of 6 pi s; `tau_late` is what
    acts where the input is delayed.
    """

    def square(t: np.ndarray) -> np.ndarray:
        return np.where(np.mod(t, 6 * np.pi) < 3 * np.pi, 1.0, -1.0)

    def late(t: np.ndarray) -> np.ndarray:
        return square(np.maximum(np.asarray(t) - delay, 0.0))

    log = simulate(msd_rate, ("x", "w"), [{"tau": late}], seconds, step, within=5)[0]
    return log | {"tau_late": log["tau"], "tau": square(log["t"])}
