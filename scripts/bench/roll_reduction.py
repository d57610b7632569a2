"""Roll reduction of the patrol vessel by rudder and fins in waves, classical and learned.

    python scripts/bench/roll_reduction.py [--stage tune train judge] [--epochs 10]

`tune` tunes the classical combinations by differential evolution: heading control alone, with
rudder roll damping, with fin PD, and with both. `train` trains the constants of the last one (its
best classical form) and a recurrent policy that starts from it, both by the same trainer. `judge`
prints the roll reduction in per cent and the RMS heading error by sea state and direction of the
waves, over 12 new realisations of 100 s each. The reduction is that of the RMS roll relative to
heading control alone with fins amidships.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import bench
import torch

from residnet.autopilot.roll import (
    GAIN_NAMES,
    HEADINGS_DEG,
    PATROL_BOX,
    SEA_STATES,
    RollPolicy,
    RollSimulation,
    RollWeights,
    list_seas,
)
from residnet.autopilot.training.roll import RollTraining, train_roll_policy, tune_roll_law
from residnet.physics.vessel import load_vessel

COMBINATIONS = {
    "heading": GAIN_NAMES[:3],
    "rudder": GAIN_NAMES[:5],
    "fins": (*GAIN_NAMES[:3], *GAIN_NAMES[5:]),
    "both": GAIN_NAMES,
}
"""Tuned constants of each classical combination."""
LIMITS = math.radians(20.0), math.radians(25.0)
"""Limits of rudder and fins in rad."""
UNITS = 12
ROWS = 12


def simulation(duration: float = 80.0) -> RollSimulation:
    return RollSimulation(load_vessel("patrol_fins").build(), PATROL_BOX, duration=duration)


def law(gains: dict[str, float], units: int = 0, *, is_trained: bool = False) -> RollPolicy:
    values = {name: torch.tensor([gains[name]]) for name in GAIN_NAMES}
    return RollPolicy(values, LIMITS, units, 0.1, is_trained=is_trained)


def tune(folder: Path, seed: int, generations: int, _: int) -> None:
    """Tune all combinations and write their constants."""
    courses = simulation()
    tuned: dict[str, Any] = {}
    for name, constants in COMBINATIONS.items():
        started = time.perf_counter()
        gains, cost = tune_roll_law(
            courses, list_seas(), LIMITS, constants, generations=generations, seed=seed
        )
        tuned[name] = gains
        seconds = time.perf_counter() - started
        print(f"tuned {name}: cost {cost:.4f}, {seconds:.0f} s; {gains}", flush=True)
        (folder / "tuned.json").write_text(json.dumps(tuned))


def train(folder: Path, seed: int, _: int, epochs: int) -> None:
    """Train the constants of the best law, then the recurrent policy, and write both."""
    tuned = json.loads((folder / "tuned.json").read_text())
    courses = simulation()
    settings = RollTraining(epochs=epochs)
    for name, units in (("trained_law", 0), ("learned", UNITS)):
        torch.manual_seed(seed)
        start = tuned.get("trained_law", tuned["both"])
        policy = law(start, units, is_trained=True)
        notes = train_roll_policy(name, policy, courses, list_seas(), settings, seed=seed)
        if units == 0:
            tuned[name] = policy.gain_values()
            (folder / "tuned.json").write_text(json.dumps(tuned))
        else:
            torch.save(policy.state_dict(), folder / "policy.pt")
        costs = f"{notes['start_validation']:.4f} -> {notes['best_validation']:.4f}"
        print(f"{name}: cost {costs}; {policy.gain_values()}", flush=True)


def judge(folder: Path, seed: int, *_: int) -> None:
    """Print the tables."""
    tuned = json.loads((folder / "tuned.json").read_text())
    policies = {name: law(gains) for name, gains in tuned.items()}
    if (folder / "policy.pt").exists():
        policies["learned"] = law(tuned["trained_law"], UNITS)
        policies["learned"].load_state_dict(torch.load(folder / "policy.pt", weights_only=True))
    courses = simulation(120.0)
    inputs, heights = courses.sample_inputs(list_seas(), ROWS, seed + 99)
    rms: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    for name, policy in policies.items():
        with torch.no_grad():
            runs = courses.simulate(policy, inputs)
            cost = float(runs.costs(heights, RollWeights()).mean())
        roll, heading = (
            values.square().mean(1).reshape(-1, ROWS).mean(1).sqrt().rad2deg()
            for values in (runs.roll, runs.heading)
        )
        rms[name] = roll, heading
        print(
            f"{name:8s} cost {cost:.4f}; RMS over all seas: roll {roll.square().mean().sqrt():.2f}"
            f" deg, heading {heading.square().mean().sqrt():.3f} deg"
        )
    print("\nsea  waves   roll without   reduction %               heading error deg (RMS)")
    names = [name for name in rms if name != "heading"]
    print(f"state  deg      RMS deg   {'  '.join(f'{n:>8s}' for n in names + list(rms))}")
    seas = list_seas()
    for i, sea in enumerate(seas):
        base = float(rms["heading"][0][i])
        reductions = [100.0 * (1.0 - float(rms[name][0][i]) / base) for name in names]
        errors = [float(rms[name][1][i]) for name in rms]
        print(
            f"{sea.state:5d} {sea.heading_deg:4.0f} {base:12.2f}   "
            + "  ".join(f"{value:8.1f}" for value in reductions)
            + "  "
            + "  ".join(f"{value:8.3f}" for value in errors)
        )
    n_headings = len(HEADINGS_DEG)
    for k, state in enumerate(SEA_STATES):
        rows = slice(k * n_headings, (k + 1) * n_headings)
        total = {name: roll[rows].square().mean().sqrt() for name, (roll, _) in rms.items()}
        text = ", ".join(f"{n} {100 * (1 - total[n] / total['heading']):.1f} %" for n in names)
        print(f"sea state {state}, all headings: roll reduction {text}")


STAGES = {"tune": tune, "train": train, "judge": judge}


def main() -> None:
    """Run the stages in order."""
    given = bench.options(
        __doc__, stage=STAGES, folder="runs/roll_reduction", seed=0, generations=14, epochs=10
    )
    folder = Path(given.folder)
    folder.mkdir(parents=True, exist_ok=True)
    for stage in given.stage:
        STAGES[stage](folder, given.seed, given.generations, given.epochs)


if __name__ == "__main__":
    main()
