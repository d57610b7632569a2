"""Interrupt a small but complete fit at random moments, resume it, and compare the metrics.

The fit has a refitted baseline, PLSR, an MLP, an LSTM and an ensemble, and ends with report and
export. Each chain stops it several times by SIGKILL, SIGINT or SIGTERM and resumes it with
`--resume`. The rows of metrics.json have to be bit for bit those of an undisturbed run. After
SIGINT the exit code has to be 130, after SIGTERM 143, and standard error has to end with one line
that names `--resume` and to hold no traceback.

    python scripts/bench/kill_and_resume.py [--chains 20] [--most 4] [--seed 0] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

_SCHEDULE = {
    "steps": 3,
    "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 5, "batch": 16}],
    "start_noise": 0.1,
}
CONFIG: dict[str, Any] = {
    "task": "fit",
    "name": "interrupted",
    "data": {
        "kind": "simulated",
        "vessel": "wam_v_cal",
        "duration": 30,
        "substeps": 1,
        "step": 0.1,
        "trials": [
            {"kind": "constant", "drive": [0.4, 0.9], "steer": [-0.4, 0.0, 0.4]},
            {"kind": "zigzag", "count": 5, "heading": ["20 deg"], "start": 3},
            {"kind": "acceleration_deceleration", "count": 3},
            {"kind": "three_two_one_one", "count": 3, "start": 3},
        ],
        "identification": {"zigzag": 4, "acceleration_deceleration": 2, "three_two_one_one": 2},
        "validation": {"zigzag": 1, "acceleration_deceleration": 0, "three_two_one_one": 0},
    },
    "prepare": {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
    },
    "signals": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]},
    "refit": {"baseline": {"horizon": 2.0, "iterations": 3}},
    "heads": {
        "plsr": {"kind": "plsr"},
        "mlp": {"kind": "mlp", "hidden": [6], "dropout": 0.1},
        "lstm": {"kind": "lstm", "hidden_size": 6, "dropout": 0.1},
    },
    "ensembles": {"mean": ["plsr", "lstm"]},
    "training": {"mlp": {**_SCHEDULE, "average": 0.9}, "lstm": _SCHEDULE},
    "evaluation": {
        "protocols": {
            "manoeuvre": {"kind": "manoeuvre"},
            "T10": {"kind": "windows", "length": 10, "first": 2, "history": 1},
        },
        "selection": "manoeuvre",
        "scales": {"u": 0.35, "v": 0.16, "r": 0.24},
    },
    "export": {"models": ["lstm"]},
}
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGINT, signal.SIGTERM)
CODES = {
    signal.SIGKILL: {-signal.SIGKILL},
    signal.SIGINT: {130},
    signal.SIGTERM: {143},
}
LIMIT = 600
"""Seconds after which an attempt hangs."""


@dataclass(frozen=True)
class Attempt:
    """A run that was started, and how it ended.

    Attributes:
        code: its exit code, negative for the signal that ended it.
        seconds: that it took.
        error: what it wrote to standard error.
    """

    code: int
    seconds: float
    error: str


def attempt(
    words: list[str], file: Path, after: float | None = None, number: int = signal.SIGKILL
) -> Attempt:
    """Run the command line, and send it a signal after some seconds; None leaves it in peace."""
    started = time.monotonic()
    with file.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "residnet", *words],
            stdout=subprocess.DEVNULL,
            stderr=stream,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        try:
            process.wait(LIMIT if after is None else after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        try:
            code = process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
    error = file.read_text(errors="backslashreplace")
    return Attempt(code, time.monotonic() - started, error)


def faults(stopped: Attempt, number: int) -> list[str]:
    """Return what is wrong with how a run ended that a signal was sent to."""
    if stopped.code == 0:
        return []  # it was done before the signal came
    found = []
    name = signal.Signals(number).name
    if stopped.code not in CODES[signal.Signals(number)]:
        found.append(f"exit code {stopped.code} after {name}")
    if "Traceback" in stopped.error:
        found.append(f"traceback after {name}: {stopped.error[-3000:]}")
    last = (stopped.error.splitlines() or [""])[-1]
    if number != signal.SIGKILL and "--resume" not in last:
        found.append(f"no hint to --resume after {name}, but: {last}")
    return found


def rows(run: Path) -> str:
    """Return the rows of metrics.json as text, which shows every bit."""
    return json.dumps(json.loads((run / "metrics.json").read_text())["rows"])


def chain(folder: Path, whole: Attempt, truth: str, draw: random.Random, most: int) -> list[str]:
    """Interrupt and resume one run; returns what went wrong."""
    words = ["run", str(folder.parent / "config.yaml"), "--out", str(folder)]
    found, told = [], []
    for place in range(draw.randint(1, most)):
        after, number = draw.uniform(0.5, 1.05 * whole.seconds), draw.choice(SIGNALS)
        stopped = attempt(
            [*words, *(["--resume"] if place else [])],
            folder.parent / f"{folder.name}.{place}.txt",
            after,
            number,
        )
        told.append(f"{signal.Signals(number).name} at {after:.1f} s")
        found += faults(stopped, number)
        if stopped.code == 0:
            break
    # a resumed run that is done says so again
    last = attempt([*words, "--resume"], folder.parent / f"{folder.name}.last.txt")
    if last.code != 0:
        found.append(f"exit code {last.code} of the last: {last.error[-2000:]}")
    elif rows(folder) != truth:
        found.append("other rows in metrics.json")
    found += [f"{file} is left over" for file in folder.rglob("*.partial")]
    print(f"{folder.name}: {', '.join(told)}: {'; '.join(found) or 'the same rows'}", flush=True)
    return found


def main() -> None:
    """Run the chains and print the tally."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--chains", type=int, default=20)
    parser.add_argument("--most", type=int, default=4, help="interruptions of one chain at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    folder = given.out or Path(tempfile.mkdtemp(prefix="interrupted-"))
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump(CONFIG, sort_keys=False))
    whole = attempt(["run", str(config), "--out", str(folder / "whole")], folder / "whole.txt")
    if whole.code != 0:
        sys.exit(f"the undisturbed run ends with {whole.code}: {whole.error[-2000:]}")
    print(f"undisturbed: {whole.seconds:.0f} s, in {folder}", flush=True)
    truth, draw = rows(folder / "whole"), random.Random(given.seed)
    bad = sum(
        bool(chain(folder / f"chain_{number:02d}", whole, truth, draw, given.most))
        for number in range(given.chains)
    )
    print(f"{given.chains - bad} of {given.chains} chains end with the rows of the undisturbed run")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
