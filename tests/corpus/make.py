"""Makes the truth of the corpus: two trips of a boat of 2 m by equations of its own.

`python tests/corpus/make.py [CASE...]` writes it, and into the folder of each new case what the
sensors say, to be put into its layout; the layouts that are there stay as they were written.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
STEP = 0.02
EVERY = 10
LENGTH = 100.0
COMMANDS = {1: (1, 12.0), 2: (2, 9.0)}
"""Trip -> seed of its commands, and their longest hold in s."""


def trip(number: int) -> pd.DataFrame:
    """Return the truth of a trip each 0.02 s: pose, velocities, roll, shaft in 1/s, rudder."""
    seed, longest = COMMANDS[number]
    random = np.random.default_rng(seed)
    t = np.arange(0.0, LENGTH, STEP)

    def steps(low: float, high: float) -> np.ndarray:
        at = np.cumsum(random.uniform(3.0, longest, 60))
        return random.uniform(low, high, 61)[np.searchsorted(at, t)]

    n = steps(8.0, 25.0)
    delta = np.radians(steps(-25.0, 25.0))
    state = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    rows = []
    for i in range(t.size):
        rows.append(state)
        _, _, psi, u, v, r, phi, p = state
        rate = np.array(
            [
                u * np.cos(psi) - v * np.sin(psi),
                u * np.sin(psi) + v * np.cos(psi),
                r,
                0.0022 * n[i] ** 2 - 0.18 * u - 0.22 * u * abs(u) + 0.6 * v * r,
                -0.55 * u * r - 0.9 * v - 0.5 * v * abs(v) + 0.1 * u**2 * delta[i],
                0.75 * u**2 * delta[i] - 0.9 * r - 0.6 * r * abs(r) - 0.12 * u * v,
                p,
                -6.0 * phi - 1.1 * p - 0.9 * u * r,
            ]
        )
        state = state + STEP * rate
    names = ("x", "y", "psi", "u", "v", "r", "phi", "p")
    table = pd.DataFrame(np.array(rows), columns=names)
    return table.assign(n=n, delta=delta, t=t)


def seen(number: int, every: int = EVERY) -> pd.DataFrame:
    """Return what sensors say each `every` steps, in deg and rpm."""
    true = trip(number)[::every].reset_index(drop=True)
    random = np.random.default_rng(70 + number)

    def noisy(name: str, size: float) -> np.ndarray:
        return np.asarray(true[name] + size * random.normal(size=len(true)))

    return pd.DataFrame(
        {
            "t": true.t,
            **{name: noisy(name, 0.005).round(3) for name in ("x", "y")},
            "heading": (np.degrees(noisy("psi", 0.001)) % 360.0).round(2),
            **{name: noisy(name, 0.005).round(3) for name in ("u", "v")},
            "rate": np.degrees(noisy("r", 0.001)).round(3),
            "roll": np.degrees(noisy("phi", 0.001)).round(2),
            "roll rate": np.degrees(noisy("p", 0.001)).round(2),
            "rudder": np.degrees(true.delta).round(1),
            "rpm": (60.0 * true.n).round(),
        }
    )


if __name__ == "__main__":
    for number in COMMANDS:
        trip(number)[::5].round(6).to_csv(HERE / f"truth_{number}.csv", index=False)
        for folder in sys.argv[1:]:
            (HERE / folder).mkdir(exist_ok=True)
            seen(number).to_csv(HERE / folder / f"run{number}.csv", index=False)
