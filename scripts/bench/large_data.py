"""Memory and time of fits on many samples: logs of a simulated boat, fitted by heads of each kind.

    python scripts/bench/large_data.py [--samples 1000000 10000000] [--heads plsr ridge mlp]
        [--in-memory]
    python scripts/bench/large_data.py --inspected 1000
    python scripts/bench/large_data.py --rows 1000000

The logs (1,000, 10 Hz, twin propellers, random steps of both, sensor noise) are written as
canonical Parquet files; four logs of 10,000 samples for validation and test stand beside them. Each
head is fitted by a run of its own, in a process of its own: PLSR, ridge, and an MLP for 100 steps
of training. With --in-memory each fit is made a second time with all arrays in memory, as those of
few samples are, and the rates are compared.

With --inspected so many logs of 600 rows are written as csv and looked at together by `residnet
inspect`; with --rows a csv of so many rows by `inspect` and by `new`, and it is imported in this
process beside pandas.read_csv. Processor times include the start.
"""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import bench
import numpy as np
import pandas as pd
import torch
import yaml

import residnet
from residnet.core.config import validate_config
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig

STEP = 0.1
LOGS = 1000
_STEPS = {"steps": 100, "one_step": {"epochs": 1, "window": "2 s"}, "multi_step": []}
HEADS: dict[str, dict[str, Any]] = {
    "plsr": {"heads": {"plsr": {"kind": "plsr", "choose": "one_step"}}},
    "ridge": {"heads": {"ridge": {"kind": "ridge", "choose": "one_step"}}},
    "mlp": {
        "heads": {"mlp": {"kind": "mlp", "hidden": [32, 32], "skip": "none"}},
        "training": {"mlp": _STEPS},
    },
}
_IN_MEMORY = """
import runpy, torch
from residnet.core.arrays import paged
paged.on_disk = lambda values: values
paged.rows = lambda count, *shape, dtype=torch.float64: torch.zeros(count, *shape, dtype=dtype)
paged.row_pieces = lambda count: iter([slice(0, count)])
runpy.run_module("residnet", run_name="__main__")
"""
"""Runs residnet with all arrays in memory, and none gone through in pieces."""


def simulate(count: int, length: int, seed: int) -> list[Log]:
    """Return logs of a small boat with quadratic damping, all flown side by side."""
    generator = np.random.default_rng(seed)
    hold = 60
    drives = generator.uniform(-20.0, 100.0, (length // hold + 1, count, 2))
    n = np.repeat(drives, hold, axis=0)[:length]
    x = np.zeros((count, 6))
    path = np.empty((length, count, 6))
    for k in range(length):
        path[k] = x
        u, v, r = x[:, 3:].T
        port, stbd = (n[k] * np.abs(n[k]) * 1e-4).T
        rates = np.stack(
            (
                0.8 * (port + stbd) + v * r - 0.4 * u - 0.3 * u * np.abs(u),
                -0.7 * u * r - 1.1 * v - 0.9 * v * np.abs(v),
                1.2 * (port - stbd) - 1.3 * r - 0.5 * r * np.abs(r) - 0.2 * u * v,
            ),
            axis=1,
        )
        nu = x[:, 3:] + STEP * rates
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        pose = np.stack((nu[:, 0] * c - nu[:, 1] * s, nu[:, 0] * s + nu[:, 1] * c, nu[:, 2]), 1)
        x = np.concatenate((x[:, :3] + STEP * pose, nu), axis=1)
    path[..., 3:] += generator.normal(0.0, 0.01, path[..., 3:].shape)
    t = STEP * np.arange(length)
    names = ("x", "y", "psi", "u", "v", "r")
    return [
        Log(
            f"random_{seed}_{i:04d}",
            t,
            {name: path[:, i, j].copy() for j, name in enumerate(names)}
            | {"n_port": n[:, i, 0].copy(), "n_stbd": n[:, i, 1].copy()},
            manoeuvre="random_steps",
        )
        for i in range(count)
    ]


def write_logs(folder: Path, samples: int) -> None:
    """Write the training logs, and two each for validation and test."""
    for split, logs, length, seed in (
        ("train", LOGS, samples // LOGS, 1),
        ("validation", 2, 10_000, 2),
        ("test", 2, 10_000, 3),
    ):
        (folder / split).mkdir(parents=True)
        for first in range(0, logs, 100):
            for log in simulate(min(100, logs - first), length, 1000 * seed + first):
                log.save(folder / split / f"{log.name}.parquet")


def config(folder: Path, head: str) -> Path:
    """Write the config of a fit of one head and return its file."""
    content = {
        "task": "fit",
        "name": f"large_{head}",
        "data": {
            "kind": "measured",
            "reader": {"kind": "canonical"},
            "split": {
                "root": str(folder),
                **{s: [f"{s}/*.parquet"] for s in ("train", "validation", "test")},
            },
        },
        "prepare": {
            "grid": {"step": f"{STEP} s", "held": ["n_port", "n_stbd"]},
            "derivative": {"kind": "savitzky_golay", "window": "1.1 s", "order": 2},
        },
        "signals": {"inputs": ["n_port", "n_stbd"]},
        "baseline": {"kind": "regressors", "sets": ["linear"], "drive": ["n_port"],
                     "steer": ["n_stbd"]},
        **HEADS[head],
        "evaluation": {
            "splits": ["validation", "test"],
            "protocols": {"T30": {"kind": "windows", "length": "30 s"}},
            "selection": "T30",
            "scales": {"u": 0.5, "v": 0.1, "r": 0.3},
        },
    }  # fmt: skip
    file = folder / f"{head}.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


_ALONE = """
import os, subprocess, sys, time
started = time.monotonic()
with open(sys.argv[1], "w") as stream:
    process = subprocess.Popen(sys.argv[2:], stdout=stream, stderr=subprocess.STDOUT)
    _, status, usage = os.wait4(process.pid, 0)
code, processor = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
print(code, processor, time.monotonic() - started, 1024 * usage.ru_maxrss)
"""
"""Carries out a command from a small process: one that this large one starts has its peak too."""


def called(*words: object, said: Path, most: int = 0) -> tuple[float, float, float]:
    """Run Python; return s of the processor and of the clock, and the largest memory in bytes.

    Raises:
        RuntimeError: where it ends with a code above `most`, with the end of what it said.
    """
    call = [sys.executable, "-c", _ALONE, str(said), sys.executable, *map(str, words)]
    code, *found = subprocess.run(call, capture_output=True, check=True).stdout.split()
    if not 0 <= int(code) <= most:
        raise RuntimeError("\n".join(said.read_text().splitlines()[-12:]))
    processor, clock, peak = map(float, found)
    return processor, clock, peak


def write_csv(folder: Path, logs: list[Log]) -> None:
    """Write logs as tables whose columns have units."""
    folder.mkdir(parents=True)
    for log in logs:
        columns = {f"{name} [{unit}]": log[name] for name, unit in log.units.items()}
        table = pd.DataFrame({"t [s]": log.t, **columns})
        table.to_csv(folder / f"{log.name}.csv", index=False, float_format="%.6g")


def looked_at(folder: Path, commands: tuple[str, ...], count: int, what: str) -> None:
    """Print what commands need for a folder of tables."""
    for command in commands:
        further = ["--defaults", "--out", folder / "drafted.yaml"] if command == "new" else []
        words = ("-m", "residnet", command, folder, "--quiet", *further)
        # a fault that is found is no failure
        seconds, _, peak = called(*words, said=folder.with_suffix(".log"), most=1)
        each = f"{1e3 * seconds / count:.1f} ms a log, " if what == "logs" else ""
        print(
            f"{command} on {count} {what}: {seconds:.1f} s of processor time, {each}"
            f"{peak / 1e6:.0f} MB",
            flush=True,
        )


def imported(file: Path) -> None:
    """Print the time of an import to a canonical log beside pandas.read_csv of the same file."""
    names = [name for name in pd.read_csv(file, nrows=0).columns if name != "t [s]"]
    channels = {n.split()[0]: {"column": n, "unit": n.split("[")[1][:-1]} for n in names}
    content = {"kind": "csv", "time": {"column": "t [s]", "unit": "s"}, "channels": channels}
    reader = validate_config(content, ReaderConfig, "bench").build()
    plain = bench.least(lambda: pd.read_csv(file), 3)
    ours = bench.least(lambda: reader.read(file), 3)
    print(f"pandas.read_csv {plain:.2f} s, import {ours:.2f} s, ratio {ours / plain:.2f}")


def main() -> None:
    """Print the table."""
    given = bench.options(
        __doc__, samples=[1_000_000, 10_000_000], heads=HEADS, in_memory=False,
        inspected=0, rows=0,
    )  # fmt: skip
    print(f"residnet {residnet.__version__}, torch {torch.__version__}, {platform.machine()}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.inspected:
            write_csv(folder / "logs", simulate(given.inspected, 600, 5))
            looked_at(folder / "logs", ("inspect",), given.inspected, "logs")
            return
        if given.rows:
            write_csv(folder / "rows", simulate(1, given.rows, 6))
            imported(next((folder / "rows").iterdir()))
            looked_at(folder / "rows", ("inspect", "new"), given.rows, "rows")
            return
    print(f"{'samples':>11}{'head':>8}{'peak GB':>9}{'seconds':>9}{'samples/s':>11}")
    for samples in given.samples:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "logs"
            write_logs(folder, samples)
            for head in given.heads:
                rates = []
                for in_memory in (False, True)[: 1 + given.in_memory]:
                    out = Path(name) / f"run_{head}_{in_memory}"
                    way = ["-c", _IN_MEMORY] if in_memory else ["-m", "residnet"]
                    words = (*way, "run", config(folder, head), "--out", out, "--workers", 1)
                    _, seconds, peak = called(*words, said=out.with_suffix(".log"))
                    rates.append(samples / seconds)
                    print(
                        f"{samples:11}{head:>8}{peak / 1e9:9.2f}{seconds:9.1f}{rates[-1]:11.0f}",
                        "in memory" if in_memory else "",
                        flush=True,
                    )
                if given.in_memory:
                    ratio = rates[0] / rates[1]
                    print(f"{'':11}{head:>8} rate from files / in memory: {ratio:.2f}")


if __name__ == "__main__":
    main()
