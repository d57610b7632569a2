"""Truth for equations: Odin (document 000 eqs. (6.6)-(6.8), (6.12)-(6.23) with ERRATA H1-H11) and the mass-spring-damper (5.13), in plain NumPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

A, R = (6244.15, -178.46, 0.881043), (85.8316, -1.7935, 0.00533)
KNOTS, SURGE, YAW, LEVER = 1.94, 2.026e-4, 4.78e-5, -3.82
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
    speed, rpm = KNOTS * z["u"], z["rpm"]
    thrust = (A[0] + A[1] * speed + A[2] * speed**2) * (R[0] + R[1] * rpm + R[2] * rpm**2) / 4530
    along, across = 2 * thrust * np.cos(z["nozzle"]), 2 * thrust * np.sin(z["nozzle"])
    return force_rate({**z, "tau_x": along, "tau_y": across, "tau_n": LEVER * across})


def msd_rate(z: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rates of displacement x and velocity w, [2, T]."""
    return np.stack((z["w"], -1.3 * z["w"] + 0.1 * z["tau"] - 0.5 * z["x"]))


def simulate(
    rate: Callable[[Mapping[str, np.ndarray]], np.ndarray], states: tuple[str, ...], inputs: Inputs, seconds: float, step: float, within: int = 5
) -> dict[str, np.ndarray]:
    """States from rest, inputs and the exact rates at the samples, by RK4 with `within` steps to a sample and inputs as functions of time."""
    h = step / within
    # the last stage of a step looks at the input just before the next sample, so that a jump there belongs to the next step
    stage = np.arange(round(seconds / step) * within)[:, None] * h + np.array([0.0, h / 2, h - 1e-12])
    known = {name: signal(stage) for name, signal in inputs.items()}
    x, path = np.zeros(len(states)), []

    def f(x: np.ndarray, k: int, s: int) -> np.ndarray:
        return rate({**dict(zip(states, x, strict=True)), **{name: values[k, s] for name, values in known.items()}})

    for k in range(len(stage)):
        if k % within == 0:
            path.append(x)
        a = f(x, k, 0)
        b = f(x + h / 2 * a, k, 1)
        c = f(x + h / 2 * b, k, 1)
        x = x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c, k, 2))
    t = np.arange(len(path)) * step
    out = {"t": t, **dict(zip(states, np.array(path).T, strict=True)), **{name: signal(t) for name, signal in inputs.items()}}
    return out | {f"{name}_dot": value for name, value in zip(states, rate(out), strict=True)}


def multisine(seed: np.random.Generator, mean: float, amplitude: float, count: int = 4) -> Callable[[np.ndarray], np.ndarray]:
    """A sum of sines with random periods between 5 s and 70 s and random phases."""
    period = np.exp(seed.uniform(np.log(5), np.log(70), count))
    phase, share = seed.uniform(0, 2 * np.pi, count), seed.dirichlet(np.full(count, 3.0))
    return lambda t: mean + amplitude * (share * np.sin(2 * np.pi * np.asarray(t)[..., None] / period + phase)).sum(-1) * np.sqrt(count)


def force_log(number: int, seconds: float = 300.0, step: float = 0.1) -> dict[str, np.ndarray]:
    """A random multi-sine design of forces."""
    seed = np.random.default_rng(number)
    inputs = {"tau_x": multisine(seed, 2000, 4000), "tau_y": multisine(seed, 0, 1500), "tau_n": multisine(seed, 0, 2500)}
    return simulate(force_rate, ("u", "v", "r"), inputs, seconds, step)


def jet_log(number: int, seconds: float = 300.0, step: float = 0.1) -> dict[str, np.ndarray]:
    """A random multi-sine design of motor speed (rpm) and nozzle angle (rad)."""
    seed = np.random.default_rng(1000 + number)
    return simulate(jet_rate, ("u", "v", "r"), {"rpm": multisine(seed, 1000, 500), "nozzle": multisine(seed, 0.0, 0.25)}, seconds, step)


def msd_log(seconds: float = 50.0, step: float = 0.1, delay: float = 0.0) -> dict[str, np.ndarray]:
    """Document 000 section 5.3.1: a square wave of 1 N with a period of 6 pi s; `tau_late` is what acts where the input is delayed."""

    def square(t: np.ndarray) -> np.ndarray:
        return np.where(np.mod(t, 6 * np.pi) < 3 * np.pi, 1.0, -1.0)

    def late(t: np.ndarray) -> np.ndarray:
        return square(np.maximum(np.asarray(t) - delay, 0.0))

    log = simulate(msd_rate, ("x", "w"), {"tau": late}, seconds, step)
    return log | {"tau_late": log["tau"], "tau": square(log["t"])}
