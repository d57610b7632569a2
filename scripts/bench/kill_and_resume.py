"""Interrupt a small but complete fit at random moments, resume it, and compare the metrics.

The fit has a refitted baseline, PLSR, an MLP, an LSTM and an ensemble, and exports. Each chain
stops it one to four times by SIGKILL, SIGINT or SIGTERM and resumes it with `--resume`. The rows of
metrics.json have to be bit for bit those of an undisturbed run. After SIGINT the exit code has to
be 130, after SIGTERM 143, and standard error has to end with one line that names `--resume` and to
hold no traceback.

    python scripts/bench/kill_and_resume.py [--chains 20] [--seed 0]
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bench

_NETWORK = (
    "{steps: 3, one_step: {epochs: 2, window: 2 s, batch: 16}, start_noise: 0.1,"
    " multi_step: [{horizon: 1 s, epochs: 3, batch: 16}]}"
)
OVERRIDES = (
    "data.duration=15 s",
    "data.substeps=1",
    "data.step=0.1 s",
    "data.trials=[{kind: zigzag, count: 5, heading: [20 deg], start: 1 s},"
    " {kind: three_two_one_one, count: 2, start: 1 s}]",
    "data.identification={zigzag: 4, three_two_one_one: 1}",
    "data.validation={zigzag: 1, three_two_one_one: 0}",
    "prepare.grid.step=0.1 s",
    "prepare.derivative={kind: savitzky_golay, window: 1.1 s, order: 2}",
    "baseline={kind: regressors, terms: [u, v, r, tau_x, tau_n]}",
    "refit={baseline: {horizon: 2 s, every: 2 s, iterations: 3}}",
    "heads={plsr: {kind: plsr}, mlp: {kind: mlp, hidden: [6], dropout: 0.1},"
    " lstm: {kind: lstm, hidden_size: 6, dropout: 0.1}}",
    "ensembles={mean: [plsr, lstm]}",
    f"training={{mlp: {_NETWORK}, lstm: {_NETWORK}}}",
    "evaluation.protocols={manoeuvre: {kind: manoeuvre},"
    " T5: {kind: windows, length: 5 s, first: 2 s, history: 1 s}}",
    "export.models=[lstm]",
)
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGINT: 130, signal.SIGTERM: 143}
DRAWN = (signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGINT, signal.SIGTERM)


def attempt(
    run: Path, *words: str, after: float = 600.0, number: int = signal.SIGKILL
) -> tuple[int, str]:
    """Begin a run or go on with it, and send a signal; return the exit code and what was said."""
    overrides = [word for override in OVERRIDES for word in ("-s", override)]
    command = [sys.executable, "-m", "residnet", "run", "quickstart", "--out", str(run), *words]
    said = run.with_suffix(".txt")
    with said.open("w") as stream:
        process = subprocess.Popen([*command, *overrides], stdout=subprocess.DEVNULL, stderr=stream)
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            process.wait(600.0)
    return process.returncode, said.read_text(errors="backslashreplace")


def faults(code: int, error: str, number: signal.Signals) -> list[str]:
    """Return what is wrong with how a run ended that a signal was sent to."""
    if code == 0:
        return []  # it was done before the signal came
    found = []
    last = (error.splitlines() or [""])[-1]
    if code != CODES[number]:
        found.append(f"exit code {code} after {number.name}")
    if "Traceback" in error:
        found.append(f"traceback after {number.name}: {error[-3000:]}")
    if number != signal.SIGKILL and "--resume" not in last:
        found.append(f"no hint to --resume after {number.name}, but: {last}")
    return found


def rows(run: Path) -> str:
    """Return the rows of metrics.json as text, which shows every bit."""
    return json.dumps(json.loads((run / "metrics.json").read_text())["rows"])


def chain(run: Path, seconds: float, truth: str, draw: random.Random) -> bool:
    """Interrupt and resume one run; print what was done and tell whether something was wrong."""
    found = []
    told = []
    for place in range(draw.randint(1, 4)):
        after = draw.uniform(0.2, 1.05 * seconds)
        number = draw.choice(DRAWN)
        words = ["--resume"] if place else []
        code, error = attempt(run, *words, after=after, number=number)
        told.append(f"{number.name} at {after:.1f} s" if code else "done before that")
        found += faults(code, error, number)
        if code == 0:
            break
    # a resumed run that is done says so again
    code, error = attempt(run, "--resume")
    if code:
        found.append(f"exit code {code} of the last: {error[-2000:]}")
    elif rows(run) != truth:
        found.append("other rows in metrics.json")
    found += [f"{file} is left over" for file in run.rglob("*.partial")]
    print(f"{run.name}: {', '.join(told)}: {'; '.join(found) or 'the same rows'}", flush=True)
    return bool(found)


def main() -> None:
    """Run the chains and print the tally."""
    given = bench.options(__doc__, chains=20, seed=0)
    with tempfile.TemporaryDirectory(prefix="interrupted-") as name:
        whole = Path(name) / "whole"
        begun = time.monotonic()
        code, error = attempt(whole)
        if code:
            sys.exit(f"the undisturbed run ends with {code}: {error[-2000:]}")
        seconds = time.monotonic() - begun
        draw = random.Random(given.seed)
        print(f"undisturbed: {seconds:.0f} s", flush=True)
        bad = sum(
            chain(Path(name) / f"chain_{number:02d}", seconds, rows(whole), draw)
            for number in range(given.chains)
        )
    print(f"{given.chains - bad} of {given.chains} chains end with the rows of the undisturbed run")
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
