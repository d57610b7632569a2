"""How far `recipe: standard` is from the best of its models in hindsight, on boats drawn at random.

    python scripts/bench/recipe.py [--count N] [--minutes M] [--seed S] [--effort E]
        [--records FILE]

Each fit is of one small boat (one propeller and a rudder, or two propellers) that follows paths
and does a few manoeuvres, with noise and gusts: M minutes for training and validation, as long for
the test. For each fit a line; at the end the mean test error of the selected model, of the best
model in hindsight, and how many selected models diverged. Test logs take no part in any choice.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from random_vessels import KINDS, small_boat_logs

from residnet.core.config import validate
from residnet.core.log import Log
from residnet.identification.fit import fit
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings
from residnet.judge.metrics import find

INPUTS = {"boat": ["n", "delta"], "twin": ["n_port", "n_stbd"]}
_LENGTH = 20.0
_FLIGHTS = 10


def settings_for(kind: str, splits: dict[str, list[Log]], effort: float = 1.0) -> FitSettings:
    """The settings of a fit that says nothing but what the logs are."""
    test = splits["test"]
    step = float(np.median(np.diff(test[0].t)))
    spread = {c: float(np.concatenate([log[c] for log in test]).std()) for c in ("u", "v", "r")}
    windows = {"kind": "windows", "first": 2.0, "history": 2.0}
    content = {
        "recipe": "standard",
        "effort": effort,
        # bands choose nothing
        "bands": None,
        "prepare": {
            "grid": {"step": step},
            "derivative": {"kind": "savitzky_golay", "window": 11 * step, "order": 2},
        },
        "signals": {"inputs": INPUTS[kind]},
        "integrator": "semi_implicit_euler",
        "evaluation": {
            "protocols": {
                "T20": {**windows, "length": _LENGTH},
                "T5": {**windows, "length": _LENGTH / 4},
            },
            "selection": "T20",
            "scales": spread,
        },
    }
    return validate(content, FitSettings, "bench")


def splits_of(kind: str, seed: int, minutes: float) -> dict[str, list[Log]]:
    """Logs for training, validation (three to one) and the test, as long as both together."""
    seconds = 60.0 * minutes / _FLIGHTS * 2.0
    logs = small_boat_logs(kind, seed, _FLIGHTS, seconds)
    return {"train": logs[:4], "validation": logs[4:5], "test": logs[5:]}


def one(kind: str, seed: int, minutes: float, effort: float = 1.0) -> dict[str, Any]:
    """Fit the recipe to one boat and return what the comparison needs."""
    started = time.process_time()
    splits = splits_of(kind, seed, minutes)
    settings = settings_for(kind, splits, effort)
    return judged_fit(splits, settings) | {
        "kind": kind,
        "seed": seed,
        "seconds": time.process_time() - started,
    }


def judged_fit(splits: dict[str, list[Log]], settings: FitSettings) -> dict[str, Any]:
    """Fit, select, and return test errors of all models by both protocols."""
    logs = prepare_logs(splits, settings)
    models = fit(logs, settings)
    judged = {split: models.evaluate(logs[split]) for split in ("train", "validation", "test")}
    chosen = models.select(judged)
    rows = judged["test"].rows
    errors = {}
    for name in models:
        parts = [find(rows, model=name, protocol=p) for p in settings.evaluation.protocols]
        errors[name] = [part["nrmse"]["mean"] for part in parts]
        errors[name].append(sum(part["diverged"] for part in parts))
    return {
        "selected": chosen.selected,
        "reason": chosen.reason,
        "test": errors,
        "validation": {entry.name: entry.error for entry in chosen.contenders},
        "sound": [entry.name for entry in chosen.contenders if entry.sound],
        "priors": {name: models[name].notes.get("prior") for name in ("baseline", "hull")},
        "seconds_of": {name: models[name].notes.get("seconds") for name in models},
    }


def line(record: dict[str, Any]) -> str:
    """One fit in a line: errors of all models, the selected one marked."""
    parts = [
        f"{'*' if name == record['selected'] else ''}{name} {e[0]:.3f}/{e[1]:.3f}"
        + (f" ({e[2]} diverged)" if e[2] else "")
        for name, e in record["test"].items()
    ]
    return f"{record['kind']} {record['seed']} {record['seconds']:.0f} s: " + ", ".join(parts)


def summary(records: list[dict[str, Any]]) -> str:
    """The table of a bench."""
    chosen = np.array([record["test"][record["selected"]] for record in records])
    single = [{k: v for k, v in r["test"].items() if k != "tied"} for r in records]
    best = np.array([min(e[0] for e in models.values() if not e[2]) for models in single])
    least = np.array(
        [
            r["test"][min(s, key=lambda n: r["validation"][n])][0]
            for r, s in zip(records, single, strict=True)
        ]
    )
    tied = np.array([r["test"].get("tied", r["test"][r["selected"]])[0] for r in records])
    count: dict[str, int] = {}
    for record in records:
        count[record["selected"]] = count.get(record["selected"], 0) + 1
    out = [
        f"{len(records)} fits; selected: {', '.join(f'{k} {v}' for k, v in count.items())}",
        f"selected models that diverged in a test window: {int((chosen[:, 2] > 0).sum())}",
        f"mean test error of the selected model {chosen[:, 0].mean():.4f}",
        f"of the best model in hindsight        {best.mean():.4f}:"
        f" selected {100 * (chosen[:, 0].mean() / best.mean() - 1):+.1f} % (at most +10)",
        f"of the least validation error         {least.mean():.4f}",
        f"of the mean of the tied models        {tied.mean():.4f}",
    ]
    for name in records[0]["test"]:
        there = [r["test"][name][0] for r in records if name in r["test"]]
        out.append(f"  {name:24s} {np.mean(there):.4f} in {len(there)} fits")
    return "\n".join(out)


def main() -> None:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=20, help="number of fits")
    parser.add_argument("--minutes", type=float, default=10.0, help="of training and validation")
    parser.add_argument("--seed", type=int, default=0, help="of the first boat")
    parser.add_argument("--effort", type=float, default=1.0, help="of the networks' trainings")
    parser.add_argument("--records", type=Path, help="file for one line of JSON for each fit")
    given = parser.parse_args()
    torch.set_num_threads(1)
    records = []
    for number in range(given.count):
        seed = given.seed + number // 2
        records.append(one(KINDS[number % 2], seed, given.minutes, given.effort))
        print(line(records[-1]), flush=True)
        if given.records is not None:
            with given.records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(records[-1]) + "\n")
    print(summary(records))


if __name__ == "__main__":
    main()
