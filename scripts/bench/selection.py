"""How good the choice among models is on small data: simulated fits, judged in hindsight.

    python scripts/bench/selection.py [--count 200] [--seed 0] [--records FILE]

Each fit draws a vessel (the parameters of a shipped one, scattered), manoeuvres, lengths of logs,
noise and disturbances, a handful of logs to fit and to validate, and eight further logs to test.
The candidates are `zero`, two baselines, two closed-form heads and a small network. The table
compares the selected model's test error with the best sound model in hindsight and with the model
of the lowest validation error, sound or not.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from residnet.core.config import validate
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.data.simulated.trials import SimulatedTrials, simulate
from residnet.identification.fit import fit
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings
from residnet.judge.metrics import find

TEST_LOGS = 8
FITS_OF_A_VESSEL = 4

VESSELS: dict[str, dict[str, Any]] = {
    "example_rudder_boat": {
        "inputs": ["n", "delta"],
        "seconds": (20.0, 40.0),
        "step": 0.25,
        "scattered": ("added_mass", "damping"),
        "force": (60.0, 60.0, 150.0),
    },
    "wam_v_cal": {
        "inputs": ["n_port", "n_stbd"],
        "seconds": (18.0, 36.0),
        "step": 0.2,
        "scattered": ("added_mass", "damping"),
        "force": (25.0, 25.0, 30.0),
    },
    "milliampere": {
        "inputs": ["acting_tau_x", "acting_tau_n"],
        "seconds": (20.0, 40.0),
        "step": 0.25,
        "scattered": ("mass", "damping"),
        "force": (40.0, 40.0, 60.0),
    },
    "mariner": {
        "inputs": ["delta"],
        "seconds": (150.0, 300.0),
        "step": 1.5,
        "scattered": ("coefficients",),
        "force": (5e4, 5e4, 2e6),
    },
}
"""What is particular to each vessel: inputs, range of log lengths, step, sections of its file that
are scattered, and the standard deviations of its largest random forces."""


def scattered(
    name: str, random: np.random.Generator, folder: Path, sections: Sequence[str] = ()
) -> Path:
    """Write a vessel's file with parameters of some sections scattered by about a fifth."""
    vessels = Path(__file__).resolve().parents[2] / "configs" / "vessels"
    content = yaml.safe_load((vessels / f"{name}.yaml").read_text(encoding="utf-8"))

    def moved(part: Any) -> Any:
        if isinstance(part, dict):
            return {key: value if key in _WORDS else moved(value) for key, value in part.items()}
        return float(part * np.exp(0.2 * random.standard_normal()))

    for section in sections or VESSELS[name]["scattered"]:
        content[section] = moved(content[section])
    content["name"] = "scattered"
    path = folder / "scattered.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


_WORDS = ("unit", "source")


def drawn_logs(name: str, random: np.random.Generator) -> list[Log]:
    """Fly the trials of several fits with one scattered vessel, in random order."""
    vessel, count = VESSELS[name], FITS_OF_A_VESSEL * (TEST_LOGS + 11)
    longest = vessel["seconds"][1]
    start = 0.05 * longest
    speed = float(np.exp(random.uniform(np.log(0.005), np.log(0.1))))
    force = random.uniform(0.0, 1.0) * np.array(vessel["force"])
    family = {"count": count // 3 + 1, "start": start}
    drive = (0.3, 0.9)
    with tempfile.TemporaryDirectory() as folder:
        config = SimulatedTrials.model_validate(
            {
                "vessel": str(scattered(name, random, Path(folder))),
                "duration": longest,
                "step": vessel["step"],
                "substeps": 1,
                "seed": int(random.integers(2**31)),
                "noise": {"u": speed, "v": speed, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
                "disturbance": {
                    **dict(zip(("force_x", "force_y", "force_n"), force.tolist(), strict=True)),
                    "correlation": 0.1 * longest,
                },
                "trials": [
                    {"kind": "zigzag", "heading": ["10 deg", "20 deg"], "drive": drive, **family},
                    {
                        "kind": "three_two_one_one",
                        "unit": (0.05 * longest, 0.1 * longest),
                        "drive": drive,
                        **family,
                    },
                    {
                        "kind": "random_steps",
                        "band": (1.0 / longest, 10.0 / longest),
                        "drive": (0.4, 0.7),
                        **family,
                    },
                ],
                "identification": {},
                "validation": {},
            }
        )
        logs = simulate(config.draw(), config)
    return [logs[i] for i in random.permutation(len(logs))]


def cut(log: Log, seconds: float) -> Log:
    """The first seconds of a log."""
    count = max(int(np.searchsorted(log.t, log.t[0] + seconds)), 2)
    channels = {channel: values[:count] for channel, values in log.channels.items()}
    masks = {reason: mask[:count] for reason, mask in log.masks.items()}
    return log.replace(t=log.t[:count], channels=channels, masks=masks)


def drawn_fit(name: str, logs: list[Log], random: np.random.Generator) -> dict[str, Any]:
    """Fit and judge the models on some of the logs; returns what the comparison needs."""
    vessel = VESSELS[name]
    train, validation = int(random.integers(2, 7)), int(random.integers(1, 6))
    seconds = random.uniform(*vessel["seconds"])
    split = {
        "test": logs[:TEST_LOGS],
        "train": [cut(log, seconds) for log in logs[TEST_LOGS:][:train]],
        "validation": [cut(log, seconds) for log in logs[TEST_LOGS + train :][:validation]],
    }
    settings = validate(settings_for(name, split["train"], random), FitSettings, "bench")
    prepared = prepare_logs(split, settings)
    models = fit(prepared, settings)
    judged = {part: models.evaluate(prepared[part]) for part in ("train", "validation", "test")}
    chosen = models.select(judged)
    record = chosen.content()
    for row, contender in zip(record["models"], chosen.contenders, strict=True):
        found = find(judged["test"].rows, model=row["model"], protocol="manoeuvre")
        row["test"] = float(found["nrmse"]["mean"])
        row["test_diverged"] = int(found["diverged"])
        row["scores"] = contender.scores.tolist()
        findings = models.findings.get(row["model"], [])
        row["reported"] = [finding.check for finding in findings if finding.ok is False]
    weights = chosen.blocks.weights.tolist()
    return record | {"vessel": name, "logs": [train, validation], "weights": weights}


def settings_for(name: str, train: list[Log], random: np.random.Generator) -> dict[str, Any]:
    """Settings of a fit of all kinds of models, small enough for seconds."""
    vessel = VESSELS[name]
    step, inputs = vessel["step"], vessel["inputs"]
    spread = {c: float(np.concatenate([log[c] for log in train]).std()) for c in ("u", "v", "r")}
    channels = ["u", "v", "r", *inputs]
    damping = ["u|u|", "v|v|", "r|r|", "u v", "u r", "v r"]
    return {
        "seed": int(random.integers(1000)),
        "prepare": {
            "grid": {"step": step},
            "derivative": {"kind": "savitzky_golay", "window": 7 * step, "order": 2},
        },
        "signals": {"inputs": inputs},
        "integrator": "heun",
        "baseline": {"kind": "regressors", "terms": ["1", *channels]},
        "baselines": {"quadratic": {"kind": "regressors", "terms": ["1", *channels, *damping]}},
        "heads": {
            "ridge": {"kind": "ridge", "penalties": [1e-3, 1e-1]},
            "kernel": {
                "kind": "kernel",
                "kernel": {"kind": "rbf", "sigma": [9.0]},
                "choose": "one_step",
                "penalties": [1e-4, 1e-2],
            },
            "mlp": {"kind": "mlp", "hidden": [16]},
        },
        "training": {
            "mlp": {
                "steps": 20,
                "validate_every": 2,
                "one_step": {
                    "epochs": int(random.integers(3, 9)),
                    "window": 10 * step,
                    "batch": 32,
                    "learning_rate": float(random.choice([3e-3, 1e-2, 3e-2])),
                },
            }
        },
        "evaluation": {
            "protocols": {"manoeuvre": {"kind": "manoeuvre", "initial": 2 * step}},
            "selection": "manoeuvre",
            "scales": spread,
        },
    }


def fits(count: int, seed: int) -> Iterator[dict[str, Any]]:
    """Draw fits, the vessels in turn; one that the data do not determine is drawn again."""
    made, vessel = 0, 0
    while made < count:
        random = np.random.default_rng([seed, vessel])
        name = list(VESSELS)[vessel % len(VESSELS)]
        vessel += 1
        logs = drawn_logs(name, random)
        part = len(logs) // FITS_OF_A_VESSEL
        for place in range(FITS_OF_A_VESSEL):
            if made == count:
                return
            started = time.process_time()
            try:
                record = drawn_fit(name, logs[place * part : (place + 1) * part], random)
            except ResidnetError as error:
                print(f"not counted: {name}: {error}", file=sys.stderr)
                continue
            made += 1
            yield record | {"seconds": time.process_time() - started}


def summary(records: list[dict[str, Any]]) -> str:
    """The table of a bench, from the record of each fit."""
    diverging, unsound, errors = 0, 0, []
    kinds: dict[str, int] = {}
    for record in records:
        models = {row["model"]: row for row in record["models"]}
        chosen = models[record["selected"]]
        sound = [row for row in models.values() if row["sound"] and row["model"] != "zero"]
        steady = [row for row in models.values() if not row["diverged"]]
        unsound += not sound
        diverging += bool(chosen["diverged"])
        best = min(row["test"] for row in sound or steady)
        lowest = min(models.values(), key=lambda row: row["nrmse_mean"])
        errors.append((chosen["test"], best, lowest["test"]))
        kinds[chosen["model"]] = kinds.get(chosen["model"], 0) + 1
    mean = np.array(errors).mean(0)
    return "\n".join(
        (
            f"{len(records)} fits; selected: "
            + ", ".join(f"{name} {times}" for name, times in sorted(kinds.items())),
            f"diverging models selected: {diverging}",
            f"fits without a sound model but zero: {unsound} (the best steady one stands in below)",
            f"mean test NRMSE of the selected model            {mean[0]:.4f}",
            f"of the best sound model in hindsight             {mean[1]:.4f}"
            f"   selected {100 * (mean[0] / mean[1] - 1):+.1f} % (at most +10)",
            f"of the model with the lowest validation error    {mean[2]:.4f}"
            f"   selected {100 * (mean[0] / mean[2] - 1):+.1f} % (at most +3)",
            f"longest fit: {max(record['seconds'] for record in records):.1f} s of processor time",
        )
    )


def main() -> None:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="number of fits")
    parser.add_argument("--seed", type=int, default=0, help="of vessels, logs and networks")
    parser.add_argument("--records", type=Path, help="file for one line of JSON for each fit")
    given = parser.parse_args()
    torch.set_num_threads(1)
    records = []
    for record in fits(given.count, given.seed):
        records.append(record)
        print(f"{len(records)}/{given.count}: {record['vessel']}: {record['reason']}", flush=True)
        if given.records is not None:
            with given.records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
    print(summary(records))


if __name__ == "__main__":
    main()
