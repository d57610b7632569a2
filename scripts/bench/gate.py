"""Does a gated model fall back to the better of network and physics where there were no data?

Each draw scatters a shipped vessel's parameters and fits a baseline, a network and an ensemble on
gentle trials. Then the vessel runs wilder ones, more thrust and more rudder than any log had, and
the free runs of the baseline, of the residual and of its gate are compared.

    python scripts/bench/gate.py [--draws 4] [--seed 0]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from selection import scattered

from residnet.core.config import validate
from residnet.core.log import Log
from residnet.data.simulated.trials import SimulatedTrials, simulate
from residnet.identification.fit import fit
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings

STEP, SECONDS = 0.1, 40.0
VESSELS: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "example_rudder_boat": {"inputs": ["n", "delta"]},
}
GATED = {"mlp": "mlp_gate", "ridge": "ridge_gate", "mean": "mean_gate"}


def trials(vessel: str, gentle: bool, seed: int, count: int) -> list[Log]:
    """Return logs of gentle trials, or of trials with more thrust and rudder than these have."""
    drive = [0.2, 0.5] if gentle else [0.7, 1.0]
    steer = [0.1, 0.35] if gentle else [0.5, 1.0]
    names = ("zigzag", "three_two_one_one", "random_steps")
    kinds: list[dict[str, Any]] = [
        {"kind": kind, "count": count, "drive": drive, "steer": steer} for kind in names[:2]
    ]
    kinds[0]["heading"] = ["10 deg", "20 deg"]
    content = {
        "vessel": vessel,
        "duration": SECONDS,
        "step": STEP,
        "substeps": 2,
        "seed": seed,
        "noise": {"u": 0.02, "v": 0.02, "r": 0.003},
        "trials": kinds,
        "identification": dict.fromkeys(names[:2], count - 1),
        "validation": {kind: max(count // 4, 1) for kind in names[:2]},
    }
    config = validate(content, SimulatedTrials, "bench")
    return simulate(config.draw(), config)


def settings_for(vessel: str, logs: list[Log], sets: str) -> FitSettings:
    """Return settings of a baseline, a network, a closed form, their mean, and gates of all."""
    spread = {c: float(np.concatenate([log[c] for log in logs]).std()) for c in ("u", "v", "r")}
    content = {
        "prepare": {
            "grid": {"step": STEP},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
            "hold": "mean",
        },
        "signals": VESSELS[vessel],
        "baseline": {"kind": "regressors", "sets": [sets], "ridge": 1e-6},
        "heads": {"mlp": {"kind": "mlp", "hidden": [24]}, "ridge": {"kind": "ridge", "degree": 2}},
        "ensembles": {"mean": ["mlp", "ridge"]},
        "gates": {gate: {"of": name} for name, gate in GATED.items()},
        "training": {
            "mlp": {
                "one_step": {"epochs": 15, "window": 2.0, "batch": 64},
                "multi_step": [{"horizon": 2.0, "epochs": 4, "batch": 64}],
            }
        },
        "bands": None,
        "evaluation": {
            "protocols": {"T20": {"kind": "windows", "length": 19.0}},
            "selection": "T20",
            "scales": spread,
        },
    }
    return validate(content, FitSettings, "bench")


def main() -> None:
    """Run the draws, and print errors outside the data and their ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    ratios: dict[str, list[float]] = {gate: [] for gate in GATED.values()}
    for number in range(given.draws):
        random = np.random.default_rng([given.seed, number])
        vessel, sets = list(VESSELS)[number % 2], ("linear", "fossen")[number // 2 % 2]
        with tempfile.TemporaryDirectory() as folder:
            drawn = str(scattered(vessel, random, Path(folder)))
            gentle = trials(drawn, True, int(random.integers(2**31)), 8)
            wild = trials(drawn, False, int(random.integers(2**31)), 10)
        settings = settings_for(vessel, gentle, sets)
        splits = {
            "train": [*gentle[:6], *gentle[8:14]],
            "validation": [*gentle[6:8], *gentle[14:]],
            "wild": wild,
        }
        prepared = prepare_logs(splits, settings)
        models = fit(prepared, settings)
        for split in ("validation", "wild"):
            error = {
                row["model"]: row["nrmse"]["mean"]
                for row in models.evaluate(prepared[split]).rows
                if row["manoeuvre"] == "all"
            }
            known = ", ".join(f"{n} {error[n]:.3f}" for n in ("baseline", *GATED))
            print(f"draw {number + 1}, {vessel}, {sets}, {split}: {known}", flush=True)
            for name, gate in GATED.items():
                ratio = error[gate] / min(error[name], error["baseline"])
                fade = models[gate].notes["fade"]
                print(f"    {gate}: {error[gate]:.3f}, {ratio:.3f} of the better, fades {fade}")
                if split == "wild":
                    ratios[gate].append(ratio)
    for gate, found in ratios.items():
        print(f"{gate}: mean ratio {np.mean(found):.3f}, worst {max(found):.3f}")


if __name__ == "__main__":
    main()
