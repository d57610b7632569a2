"""The central claim of document 001 in kind: one random manoeuvre against one zigzag to learn from.

    python scripts/bench/random_manoeuvres.py [--vessels NAME ...] [--seeds 3] [--seed 1]

For each vessel and seed, two logs of 150 s train and one more is for validation: random steps of
rudder and propeller; the same 20/20 zigzag each time, first to port or first to starboard; or three
unlike zigzags. The models are the document's, kernel ridge on velocities and commands, and nothing
is believed beforehand. Printed are geometric means of what they miss in free runs of ten seconds
along manoeuvres that none has seen, over what `constant_velocity` misses.
"""

from __future__ import annotations

from typing import Any

import bench
import numpy as np
import pandas as pd

import residnet

NOISE = {"u": 0.02, "v": 0.02, "r": "0.2 deg/s"}
PENALTIES = [1e-6, 1e-4, 1e-2, 1e-1, 1.0, 10.0]
KERNELS: dict[str, Any] = {
    "p1": {"kind": "polynomial", "degree": 1},
    "p2": {"kind": "polynomial", "degree": 2},
    "rbf": {"kind": "rbf", "sigma": [1.0, 3.0, 10.0, 30.0, 100.0]},
}
HEADS = {
    name: {"kind": "kernel", "margin": 0.5, "penalties": PENALTIES, "kernel": kernel}
    for name, kernel in KERNELS.items()
}


def steps(seed: int) -> dict[str, Any]:
    """Return random steps of both commands."""
    return {
        "kind": "random_steps",
        "seed": seed,
        "drive": 0.55,
        "drive_amplitude": 0.4,
        "steer_amplitude": 0.8,
        "band": [0.02, 0.2],
    }


def zigzag(drive: float, steer: float, degrees: float) -> dict[str, Any]:
    """Return a zigzag that goes on to the end of the flight."""
    return {
        "kind": "zigzag",
        "drive": drive,
        "steer": steer,
        "heading": f"{degrees:g} deg",
        "reversals": 1000,
    }


def drawn(random: np.random.Generator) -> dict[str, Any]:
    """Return a zigzag at random."""
    drive, steer = random.uniform((0.3, 0.3), (0.9, 0.9))
    return zigzag(drive, steer, float(random.choice([10, 20, 30])))


def flown(vessel: str, seed: int, duration: float, *manoeuvres: dict[str, Any]) -> list[Any]:
    """Return the logs of sensors, whose names hold the seed."""
    trials = residnet.simulate(
        vessel, [*manoeuvres], duration=duration, noise=NOISE, seed=seed, step=0.1
    )
    return [log.replace(name=f"{log.name}_{seed}") for log in trials.logs]


def case(vessel: str, seed: int) -> dict[tuple[str, str, str], float]:
    """Return errors over those of zero by (learned from, model, judged on)."""
    random = np.random.default_rng(seed)
    to_judge = [
        *(steps(100 * seed + 50 + k) for k in range(4)),
        *(drawn(random) for _ in range(4)),
        *({"kind": "turning_circle", "drive": 0.6, "steer": s} for s in (-0.7, 0.3, 0.6)),
    ]
    judged = flown(vessel, seed + 500, 60.0, *to_judge)
    learned = {
        "random steps": [steps(100 * seed + k) for k in range(3)],
        "one zigzag": [zigzag(0.6, steer, 20.0) for steer in (0.6, -0.6, 0.6)],
        "zigzags": [zigzag(*of) for of in ((0.4, 0.4, 10.0), (0.8, -0.8, 20.0), (0.6, 0.6, 30.0))],
    }
    spread = {name: float(np.std(np.concatenate([log[name] for log in judged]))) for name in "uvr"}
    out: dict[tuple[str, str, str], float] = {}
    for name, (*first, last) in learned.items():
        logs = {
            "train": flown(vessel, seed, 150.0, *first),
            "validation": flown(vessel, seed + 200, 150.0, last),
            "test": judged,
        }
        models = residnet.fit(residnet.prepare(logs), {"kind": "still"}, HEADS)
        table = residnet.metrics(models, split="test", manoeuvre=None)
        table = table[table["protocol"] == min(table["protocol"])]
        error = sum(table[f"rmse_{axis}"] / spread[axis] for axis in "uvr")
        found = error.set_axis(pd.MultiIndex.from_frame(table[["model", "manoeuvre"]]))
        for model, judged_on in found.index:
            if model in HEADS:
                out[name, model, judged_on] = (
                    found[model, judged_on] / found["constant_velocity", judged_on]
                )
    return out


def main() -> None:
    """Print the table."""
    vessels = ["wam_v_cal", "example_rudder_boat", "mariner"]
    given = bench.options(__doc__, vessels=vessels, seeds=3, seed=1)
    found = [case(vessel, given.seed + k) for vessel in given.vessels for k in range(given.seeds)]
    print(f"{'learned from':14}{'model':8}{'judged on':16}error / zero's (least, most)")
    for key in found[0]:
        each = np.array([one[key] for one in found if key in one])
        print(
            f"{key[0]:14}{key[1]:8}{key[2]:16}{np.exp(np.log(each).mean()):.2f}"
            f" ({each.min():.2f}, {each.max():.2f})"
        )


if __name__ == "__main__":
    main()
