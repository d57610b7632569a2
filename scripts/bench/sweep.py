"""Kill a sweep or its workers, and compare it with an undisturbed one; time its workers.

A sweep of `--trials` small fits runs with two workers. It is killed by SIGKILL at two random
moments and resumed with `--resume`. All trials have to be finished in the end, no process may
outlive the one that was killed, and for grid and random search every value has to be that of an
undisturbed sweep. With `--lose` one worker is killed at both moments instead, and the sweep has to
come to its end by itself. Then the undisturbed sweep's throughput is compared with that of one
worker in a process of its own (without the start of the processes, which both have).

    python scripts/bench/sweep.py [--trials 40] [--search grid random] [--runner processes]
        [--seed 0] [--lose] [--throughput] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import optuna
import torch
import yaml

_BASE: dict[str, Any] = {
    "task": "fit",
    "name": "small",
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
    "evaluation": {
        "protocols": {"manoeuvre": {"kind": "manoeuvre"}},
        "selection": "manoeuvre",
        "scales": {"u": 0.35, "v": 0.16, "r": 0.24},
        "splits": ["validation"],
    },
    "bands": None,
    "export": {"models": []},
}


def config(folder: Path, search: str, trials: int, runner: str, workers: int) -> Path:
    """Write a sweep and its base; returns the sweep's file."""
    (folder / "base.yaml").write_text(yaml.safe_dump(_BASE, sort_keys=False))
    points = {"low": 0.5, "high": 1.9, "points": trials}
    content = {
        "task": "sweep",
        "name": f"bench_{search}",
        "base": "base.yaml",
        "space": {
            "prepare.derivative.window": points if search == "grid" else {"low": 0.5, "high": 1.9}
        },
        "search": {"kind": search} | ({} if search == "grid" else {"trials": trials}),
        "objective": {"kind": "free_run", "model": "baseline"},
        "runner": {"kind": runner, "workers": workers},
    }
    path = folder / f"{search}_{workers}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def command(sweep: Path, out: Path, *words: str) -> list[str]:
    """Return the command that runs a sweep."""
    return [sys.executable, "-m", "residnet.cli", "run", str(sweep), "--out", str(out), *words]


def descendants(process: int) -> set[int]:
    """Return a process's children and theirs, by number."""
    found: set[int] = set()
    for line in subprocess.run(
        ["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True
    ).stdout.splitlines():
        number, parent = map(int, line.split())
        if parent == process:
            found |= {number} | descendants(number)
    return found


def alive(process: int) -> bool:
    """Return whether a process runs; one that has ended but was not waited for does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def done(out: Path) -> int:
    """Return how many trials have finished runs."""
    return len(list(out.glob("trials/*/summary.json")))


def killed(sweep: Path, out: Path, trials: int, chance: random.Random) -> tuple[int, int]:
    """Kill a sweep twice and resume it; returns how many processes outlived a kill, and kills."""
    orphans, kills = 0, 0
    for share in sorted(chance.uniform(0.05, 0.9) for _ in range(2)):
        words = ["--resume"] if out.exists() else []
        running = subprocess.Popen(command(sweep, out, *words), stderr=subprocess.DEVNULL)
        while running.poll() is None and done(out) < share * trials:
            time.sleep(chance.uniform(0.01, 0.2))
        if running.poll() is not None:
            continue
        children = descendants(running.pid)
        os.kill(running.pid, signal.SIGKILL)
        running.wait()
        kills += 1
        until = time.monotonic() + 60
        while (left := [one for one in children if alive(one)]) and time.monotonic() < until:
            time.sleep(0.1)
        orphans += len(left)
    words = ["--resume"] if out.exists() else []
    subprocess.run(command(sweep, out, *words), check=True, capture_output=True)
    return orphans, kills


def workers_lost(sweep: Path, out: Path, trials: int, chance: random.Random) -> tuple[int, int]:
    """Run a sweep and kill one of its workers twice; returns the sweep's exit code, and kills."""
    running, kills = subprocess.Popen(command(sweep, out), stderr=subprocess.DEVNULL), 0
    for share in sorted(chance.uniform(0.05, 0.9) for _ in range(2)):
        while running.poll() is None and done(out) < share * trials:
            time.sleep(chance.uniform(0.01, 0.2))
        lines = [
            (one, Path(f"/proc/{one}/cmdline").read_bytes())
            for one in descendants(running.pid)
            if alive(one)
        ]
        workers = [one for one, line in lines if b"spawn_main" in line or b"ray::carry" in line]
        if workers:
            os.kill(chance.choice(workers), signal.SIGKILL)
            kills += 1
    return running.wait(), kills


def values(out: Path) -> list[tuple[Any, ...]]:
    """Return number, state, values and error of every trial."""
    rows = json.loads((out / "sweep.json").read_text())["trials"]
    return [(row["number"], row["state"], row["values"], row["value"]) for row in rows]


def rate(sweep: Path, out: Path, trials: int) -> float:
    """Run a sweep; returns trials per second from the first finished trial to the last."""
    subprocess.run(command(sweep, out), check=True, capture_output=True)
    ends = sorted(file.stat().st_mtime for file in out.glob("trials/*/summary.json"))
    return (trials - 1) / (ends[-1] - ends[0])


def main() -> int:
    """Print what was found; return 1 where a trial, a value or a process is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--search", nargs="+", default=["grid", "random"])
    parser.add_argument("--runner", default="processes", choices=["processes", "ray"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lose", action="store_true", help="kill workers, not the sweep")
    parser.add_argument("--throughput", action="store_true", help="time one worker and two")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    print(f"torch {torch.__version__}, optuna {optuna.__version__}, {platform.platform()}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, seed {given.seed}", flush=True)
    chance, wrong = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for search in given.search:
            sweep = config(folder, search, given.trials, given.runner, 2)
            calm, disturbed = folder / f"{search}_calm", folder / f"{search}_killed"
            two = rate(sweep, calm, given.trials)
            disturb = workers_lost if given.lose else killed
            orphans, kills = disturb(sweep, disturbed, given.trials, chance)
            finished = sum(state == "finished" for _, state, _, _ in values(disturbed))
            same = values(calm) == values(disturbed)
            best = min(value for *_, value in values(disturbed) if value is not None)
            wrong += orphans > 0 or finished != given.trials or not same
            print(
                f"{search} ({given.runner}): {kills} kills, {finished} of {given.trials} finished,"
                f" {orphans} processes left, values {'equal' if same else 'NOT EQUAL'} to the"
                f" undisturbed sweep, best {best:.6f}",
                flush=True,
            )
            if given.throughput:
                alone = config(folder, search, given.trials, given.runner, 1)
                one = rate(alone, folder / f"{search}_one", given.trials)
                print(
                    f"{search}: {two:.3f} trials/s by two workers, {one:.3f} by one:"
                    f" {two / one:.2f} times"
                )
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
