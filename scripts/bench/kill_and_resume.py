"""Interrupt a small but complete fit at random moments, resume it, and compare the metrics.

The fit has a refitted baseline, PLSR, an MLP, an LSTM and an ensemble, and exports. Each chain
interrupts it one to four times by SIGKILL, SIGINT or SIGTERM and resumes it with `--resume`. The
rows of metrics.json must be identical to those of an uninterrupted run. The exit code must be 130
after SIGINT and 143 after SIGTERM, and standard error must end with one line that names `--resume`,
without a traceback.

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
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGINT, signal.SIGTERM)


def run_and_interrupt(
    run: Path, *options: str, timeout: float = 600.0, number: int = signal.SIGKILL
) -> tuple[int, str]:
    """Start or resume a run and send a signal; return the exit code and standard error."""
    overrides = [part for override in OVERRIDES for part in ("-s", override)]
    command = [sys.executable, "-m", "residnet", "run", "quickstart", "--out", str(run), *options]
    output_file = run.with_suffix(".txt")
    with output_file.open("w") as stream:
        process = subprocess.Popen([*command, *overrides], stdout=subprocess.DEVNULL, stderr=stream)
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            process.wait(600.0)
    return process.returncode, output_file.read_text(errors="backslashreplace")


def find_faults(code: int, error: str, number: signal.Signals) -> list[str]:
    """Return the faults in exit code and messages of an interrupted run."""
    if code == 0:
        return []  # the run finished before the signal
    texts = []
    last_line = (error.splitlines() or [""])[-1]
    if code != CODES[number]:
        texts.append(f"exit code {code} after {number.name}")
    if "Traceback" in error:
        texts.append(f"traceback after {number.name}: {error[-3000:]}")
    if number != signal.SIGKILL and "--resume" not in last_line:
        texts.append(f"no hint to --resume after {number.name}, but: {last_line}")
    return texts


def read_rows(run: Path) -> str:
    """Return the rows of metrics.json as text with all digits."""
    return json.dumps(json.loads((run / "metrics.json").read_text())["rows"])


def run_chain(run: Path, seconds: float, truth: str, draw: random.Random) -> bool:
    """Interrupt and resume one run; print the events and return whether there was a fault."""
    faults_of_chain = []
    events = []
    for index in range(draw.randint(1, 4)):
        timeout = draw.uniform(0.2, 1.05 * seconds)
        number = draw.choice(SIGNALS)
        options = ["--resume"] if index else []
        code, error = run_and_interrupt(run, *options, timeout=timeout, number=number)
        events.append(f"{number.name} at {timeout:.1f} s" if code else "done before that")
        faults_of_chain += find_faults(code, error, number)
        if code == 0:
            break
    # a finished run can be resumed again
    code, error = run_and_interrupt(run, "--resume")
    if code:
        faults_of_chain.append(f"exit code {code} of the last: {error[-2000:]}")
    elif read_rows(run) != truth:
        faults_of_chain.append("other rows in metrics.json")
    faults_of_chain += [f"{file} is left over" for file in run.rglob("*.partial")]
    print(
        f"{run.name}: {', '.join(events)}: {'; '.join(faults_of_chain) or 'the same rows'}",
        flush=True,
    )
    return bool(faults_of_chain)


def main() -> None:
    """Run the chains and print the tally."""
    options = bench.options(__doc__, chains=20, seed=0)
    with tempfile.TemporaryDirectory(prefix="interrupted-") as name:
        reference_run = Path(name) / "whole"
        start_time = time.monotonic()
        code, error = run_and_interrupt(reference_run)
        if code:
            sys.exit(f"the undisturbed run ends with {code}: {error[-2000:]}")
        seconds = time.monotonic() - start_time
        draw = random.Random(options.seed)
        print(f"undisturbed: {seconds:.0f} s", flush=True)
        n_faulty = sum(
            run_chain(Path(name) / f"chain_{number:02d}", seconds, read_rows(reference_run), draw)
            for number in range(options.chains)
        )
    print(
        f"{options.chains - n_faulty} of {options.chains} chains end with the rows of the"
        " undisturbed run"
    )
    sys.exit(n_faulty > 0)


if __name__ == "__main__":
    main()
