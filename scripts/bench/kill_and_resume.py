"""Interrupt a small but complete fit at random moments, resume it, and compare the metrics.

The fit has a refitted baseline, PLSR, an MLP, an LSTM and an ensemble; every third chain
exports it too. Each chain stops it several times by SIGKILL, SIGINT or SIGTERM and resumes it
with `--resume`. The rows of metrics.json have to be bit for bit those of an undisturbed run. After
SIGINT the exit code has to be 130, after SIGTERM 143, and standard error has to end with one line
that names `--resume` and to hold no traceback.

Most attempts are forks of this process, which has imported everything; a share of them are fresh
processes, whose imports are interrupted too.

    python scripts/bench/kill_and_resume.py [--chains 20] [--most 4] [--seed 0] [--fresh 0.2]
        [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from forks import Ending, attempt, command

# imported before the forks, which then begin at once
import residnet.report.still
import residnet.tasks.fit

_SCHEDULE = {
    "steps": 3,
    "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 3, "batch": 16}],
    "start_noise": 0.1,
}
CONFIG: dict[str, Any] = {
    "task": "fit",
    "name": "interrupted",
    "data": {
        "kind": "simulated",
        "vessel": "wam_v_cal",
        "duration": 15,
        "substeps": 1,
        "step": 0.1,
        "trials": [
            {"kind": "zigzag", "count": 5, "heading": ["20 deg"], "start": 1},
            {"kind": "three_two_one_one", "count": 2, "start": 1},
        ],
        "identification": {"zigzag": 4, "three_two_one_one": 1},
        "validation": {"zigzag": 1, "three_two_one_one": 0},
    },
    "prepare": {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
    },
    "signals": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]},
    "refit": {"baseline": {"horizon": 2.0, "every": 2.0, "iterations": 3}},
    "heads": {
        "plsr": {"kind": "plsr"},
        "mlp": {"kind": "mlp", "hidden": [6], "dropout": 0.1},
        "lstm": {"kind": "lstm", "hidden_size": 6, "dropout": 0.1},
    },
    "ensembles": {"mean": ["plsr", "lstm"]},
    "training": {"mlp": _SCHEDULE, "lstm": _SCHEDULE},
    "evaluation": {
        "protocols": {
            "manoeuvre": {"kind": "manoeuvre"},
            "T5": {"kind": "windows", "length": 5, "first": 2, "history": 1},
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


def faults(stopped: Ending, number: int) -> list[str]:
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


@dataclass(frozen=True)
class Chains:
    """What all chains have in common.

    Attributes:
        folder: of their run folders.
        seconds: of the undisturbed run.
        truth: its rows.
        most: interruptions of one chain at most.
        fresh: share of attempts in a process of their own.
    """

    folder: Path
    seconds: float
    truth: str
    most: int
    fresh: float

    def run(self, chain: int, draw: random.Random) -> list[str]:
        """Interrupt and resume one run; returns what went wrong."""
        run = self.folder / f"chain_{chain:02d}"
        words = _words(self.folder, run, report=chain % 3 == 0)
        found, told = [], []
        for place in range(draw.randint(1, self.most)):
            after, number = draw.uniform(0.2, 1.05 * self.seconds), draw.choice(SIGNALS)
            fresh = draw.random() < self.fresh
            if fresh and draw.random() < 0.5:
                after = draw.uniform(0.3, 4.0)  # while it imports
            given = [*words, *(["--resume"] if place else [])]
            stopped = attempt(
                given if fresh else command(*given),
                self.folder / f"{run.name}.{place}.txt",
                stop=(after, number),
            )
            told.append(f"{signal.Signals(number).name} at {after:.1f} s{' (fresh)' * fresh}")
            found += faults(stopped, number)
            if stopped.code == 0:
                told[-1] = "done before that"
                break
        # a resumed run that is done says so again
        last = attempt(command(*words, "--resume"), self.folder / f"{run.name}.last.txt")
        if last.code != 0:
            found.append(f"exit code {last.code} of the last: {last.error[-2000:]}")
        elif rows(run) != self.truth:
            found.append("other rows in metrics.json")
        found += [f"{file} is left over" for file in run.rglob("*.partial")]
        print(f"{run.name}: {', '.join(told)}: {'; '.join(found) or 'the same rows'}", flush=True)
        return found


def _words(folder: Path, run: Path, *, report: bool) -> list[str]:
    """Return the arguments of the command line; a fit without its report is a config of its own."""
    name = "config.yaml" if report else "no_export.yaml"
    return ["run", str(folder / name), "--out", str(run)]


def main() -> None:
    """Run the chains and print the tally."""
    residnet.report.still.DPI = 20  # most of the time would go into the pictures
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--chains", type=int, default=20)
    parser.add_argument("--most", type=int, default=4, help="interruptions of one chain at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fresh", type=float, default=0.2, help="share of fresh processes")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    folder = given.out or Path(tempfile.mkdtemp(prefix="interrupted-"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG, sort_keys=False))
    small = {**CONFIG, "export": {"models": []}}
    (folder / "no_export.yaml").write_text(yaml.safe_dump(small, sort_keys=False))
    words = _words(folder, folder / "whole", report=False)
    whole = attempt(command(*words), folder / "whole.txt")
    if whole.code != 0:
        sys.exit(f"the undisturbed run ends with {whole.code}: {whole.error[-2000:]}")
    print(f"undisturbed: {whole.seconds:.0f} s, in {folder}", flush=True)
    chains = Chains(folder, whole.seconds, rows(folder / "whole"), given.most, given.fresh)
    draw = random.Random(given.seed)
    bad = sum(bool(chains.run(number, draw)) for number in range(given.chains))
    print(f"{given.chains - bad} of {given.chains} chains end with the rows of the undisturbed run")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
