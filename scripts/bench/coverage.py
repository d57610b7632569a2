"""Coverage of the 95 % intervals of instrument errors on boats that no limit was chosen on.

    python scripts/bench/coverage.py [--draws 50] [--seed 900] [--boats NAME ...]

Each draw simulates a boat of unlike dynamics for 100 s and measures it by sensors with errors drawn
at random. Printed for each boat and error: how often it is determined by the sensors, the share of
intervals that contain the truth, and the root mean square of the deviations over their standard
errors. Then the same over all boats, and how often an error that is zero is significant.
"""

from __future__ import annotations

import bench
import numpy as np
from simulated_motion import Boat, TrueMotion, simulate_motion

from residnet.preprocessing.compatibility.estimates import ErrorEstimate, Prior
from residnet.preprocessing.compatibility.reconstruction import reconstruct
from residnet.preprocessing.compatibility.sensors import Sensor

BOATS = {
    "skiff": (Boat(5.0, 0.9, 0.45, -0.25, 5.0), 0.3),
    "workboat": (Boat(2.2, 2.5, 0.15, -1.2, 11.0), 0.5),
    "coaster": (Boat(6.0, 8.0, 0.03, -5.0, 30.0), 1.0),
}
"""Name -> dynamics and step between nodes in s."""
_ERROR_STDS = {
    "forward": (2.0, 1.0),
    "starboard": (2.0, 1.0),
    "heading offset": (0.5, 0.03),
    "rate bias": (0.05, 0.01),
    "rate scale": (0.3, 0.03),
    "rate clock": (1.0, 0.2),
    "surge scale": (0.3, 0.03),
    "sway scale": (0.3, 0.1),
    "velocity clock": (1.0, 0.2),
}
"""Error -> standard deviations of the prior and of the drawn errors."""
_NOISE_STDS = {"position": 0.05, "heading": 0.01, "yaw_rate": 0.005, "velocity": 0.03}
_DURATION = 100.0
_INTERVAL = 0.25


def measure(motion: TrueMotion, rng: np.random.Generator, errors: dict[str, float]) -> list[Sensor]:
    """Return noisy sensors with instrument errors."""
    t = np.arange(2.0, _DURATION - 2.0, _INTERVAL)
    psi = motion.sample("psi", t)
    lever_arm = (errors["forward"] + 1j * errors["starboard"]) * np.exp(1j * psi)
    position = np.stack(
        (motion.sample("x", t) + lever_arm.real, motion.sample("y", t) + lever_arm.imag), axis=1
    )

    def add_noise(values: np.ndarray, sensor: str) -> np.ndarray:
        return values + rng.normal(0.0, _NOISE_STDS[sensor], values.shape)

    rate = motion.sample("r", t + errors["rate clock"])
    rate = (1.0 + errors["rate scale"]) * rate + errors["rate bias"]
    velocity_times = t + errors["velocity clock"]
    surge = (1.0 + errors["surge scale"]) * motion.sample("u", velocity_times)
    sway = (1.0 + errors["sway scale"]) * motion.sample("v", velocity_times)
    heading = psi + errors["heading offset"]
    return [
        Sensor("position", t, add_noise(position, "position"), lever_arm=("forward", "starboard")),
        Sensor("heading", t, add_noise(heading, "heading"), bias="heading offset"),
        Sensor(
            "yaw_rate",
            t,
            add_noise(rate, "yaw_rate"),
            bias="rate bias",
            scale="rate scale",
            clock="rate clock",
        ),
        Sensor(
            "surge", t, add_noise(surge, "velocity"), scale="surge scale", clock="velocity clock"
        ),
        Sensor("sway", t, add_noise(sway, "velocity"), scale="sway scale", clock="velocity clock"),
    ]


def estimate_draw(
    boat: str, seed: int, *, is_clean: bool
) -> tuple[dict[str, ErrorEstimate], dict[str, float]]:
    """Return the estimated and the true errors of a random run."""
    rng = np.random.default_rng([seed, [*BOATS].index(boat)])
    dynamics, step = BOATS[boat]
    motion = simulate_motion(dynamics, rng, duration=_DURATION)
    errors = {
        name: 0.0 if is_clean else float(rng.normal(0.0, std))
        for name, (_, std) in _ERROR_STDS.items()
    }
    priors = {name: Prior(0.0, std) for name, (std, _) in _ERROR_STDS.items()}
    return reconstruct(measure(motion, rng, errors), priors, step).errors, errors


def main() -> None:
    """Print the coverage of each error."""
    arguments = bench.options(__doc__, draws=50, seed=900, boats=[""])
    boats = [name for name in arguments.boats if name] or [*BOATS]
    scores: dict[str, dict[str, list[float]]] = {
        name: {boat: [] for boat in boats} for name in _ERROR_STDS
    }
    n_significant = 0
    n_clean = 0
    for boat in boats:
        for draw in range(arguments.draws):
            # every fifth draw is clean
            is_clean = draw % 5 == 4
            estimates, errors = estimate_draw(boat, arguments.seed + draw, is_clean=is_clean)
            n_clean += len(errors) * is_clean
            n_significant += is_clean * sum(error.is_significant for error in estimates.values())
            for name, error in estimates.items():
                if error.is_determined:
                    deviation = (error.value - errors[name]) / error.standard_error
                    scores[name][boat].append(deviation)
    print(f"{'':16s}" + "".join(f"{boat:>22s}" for boat in (*boats, "all")))
    for name, by_boat in scores.items():
        samples = [*by_boat.values(), [score for scores in by_boat.values() for score in scores]]
        cells = "".join(f"{_describe(np.array(sample)):>22s}" for sample in samples)
        print(f"{name:16s}{cells}")
    print(f"significant although zero: {n_significant} of {n_clean}")


def _describe(scores: np.ndarray) -> str:
    """Return coverage, RMS score and number of determined errors."""
    if not scores.size:
        return "-"
    coverage = float((np.abs(scores) < 1.96).mean())
    return f"{coverage:.2f} ({np.sqrt(np.mean(scores**2)):.2f}, {scores.size})"


if __name__ == "__main__":
    main()
