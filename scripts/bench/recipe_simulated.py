"""`recipe: standard` on the shipped vessels: the selected model and the best one in hindsight.

    python scripts/bench/recipe_simulated.py [--count N] [--seed S] [--minutes 5 10 40]
        [--vessels NAME...] [--effort E]

Each draw takes a vessel, a noise, random forces, and zigzags, random steps and 3-2-1-1 manoeuvres
of M minutes in all for training and validation (three to one), and as many for the test. Nothing is
said to `residnet.fit` but the logs. Vessels and minutes go round. Test logs take part in no choice.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch

import residnet
from residnet.core.config import validate
from residnet.core.log import Log
from residnet.data.simulated.trials import SimulatedTrials, simulate

VESSELS: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"step": 0.1, "push": (20.0, 20.0, 20.0), "unit": 3.0},
    "patrol_mss": {"step": 0.1, "push": None, "unit": 3.0},
    "mariner": {"step": 1.0, "push": (2e4, 2e4, 1e6), "unit": 20.0},
    "milliampere": {"step": 0.2, "push": (40.0, 40.0, 60.0), "unit": 5.0},
}
"""Step of the logs in s, largest standard deviations of random forces in N and N m (None where the
vessel has no masses), and a time in s in which the vessel answers."""
_FLIGHTS = 4


def drawn(vessel: str, minutes: float, random: np.random.Generator) -> dict[str, list[Log]]:
    """Logs for training, validation and test, of a mixture of manoeuvres."""
    known = VESSELS[vessel]
    seconds = 60.0 * minutes / _FLIGHTS
    noise = float(np.exp(random.uniform(np.log(0.005), np.log(0.05))))
    unit = known["unit"]
    family = {"start": min(unit, 0.1 * seconds), "drive": [0.4, 0.9]}
    push = known["push"] and (random.uniform(0.1, 1.0) * np.array(known["push"])).tolist()
    content = {
        "vessel": vessel,
        "duration": seconds,
        "step": known["step"],
        "substeps": 2,
        "seed": int(random.integers(2**31)),
        "noise": {"u": noise, "v": noise, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
        "disturbance": dict(zip(("force_x", "force_y", "force_n"), push, strict=True))
        if push
        else {},
        "trials": [
            {"kind": "zigzag", "count": 4, "heading": ["10 deg", "20 deg"], **family},
            {"kind": "random_steps", "count": 2, "band": [0.05 / unit, 0.5 / unit], **family},
            {"kind": "three_two_one_one", "count": 2, "unit": [0.7 * unit, 2.0 * unit], **family},
        ],
        "identification": {},
        "validation": {},
    }
    config = validate(content, SimulatedTrials, "bench")
    logs = simulate(config.draw(), config)
    # the last of four is for the validation
    order = random.permutation(len(logs))
    parts = [logs[i] for i in order]
    return {
        "train": parts[: _FLIGHTS - 1],
        "validation": parts[_FLIGHTS - 1 : _FLIGHTS],
        "test": parts[_FLIGHTS:],
    }


def judged(logs: dict[str, list[Log]], effort: float) -> tuple[float, float, int, str]:
    """Test errors of the selected model and of the best, windows lost, and a line of all models."""
    models = residnet.fit(logs, effort=effort, bands=None)
    rows = residnet.metrics(models, split="test")
    rows = rows[rows.protocol == models.data.evaluation.selection].set_index("model")
    single = rows[rows.kind != "ensemble"]
    best = float(single[single.diverged == 0].nrmse_mean.min())
    chosen = rows.loc[models.selected]
    errors = ", ".join(
        f"{'*' if name == models.selected else ''}{name} {row.nrmse_mean:.3f}"
        + (f" ({row.diverged} diverged)" if row.diverged else "")
        for name, row in rows.iterrows()
    )
    return float(chosen.nrmse_mean), best, int(chosen.diverged), errors


def main() -> None:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=20, help="number of draws")
    parser.add_argument("--seed", type=int, default=0, help="of all draws")
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0, 10.0, 40.0])
    parser.add_argument("--vessels", nargs="+", default=list(VESSELS), choices=list(VESSELS))
    parser.add_argument("--effort", type=float, default=1.0, help="of the recipe's networks")
    given = parser.parse_args()
    torch.set_num_threads(1)
    records = []
    for number in range(given.count):
        began = time.process_time()
        vessel = given.vessels[number % len(given.vessels)]
        minutes = given.minutes[number // len(given.vessels) % len(given.minutes)]
        random = np.random.default_rng([given.seed, number])
        own, best, lost, line = judged(drawn(vessel, minutes, random), given.effort)
        records.append((own, best, lost))
        spent = time.process_time() - began
        print(f"{vessel}, {minutes:g} min, draw {number} ({spent:.0f} s): {line}", flush=True)
    own, best, lost = np.array(records).T
    print(
        f"{len(records)} draws: selected {own.mean():.4f}, best in hindsight {best.mean():.4f}"
        f" ({100 * (own.mean() / best.mean() - 1):+.1f} %, at most +10); on average of the draws"
        f" {100 * (own / best - 1).mean():+.1f} %; selected models that diverged:"
        f" {int((lost > 0).sum())}"
    )


if __name__ == "__main__":
    main()
