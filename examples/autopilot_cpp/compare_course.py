"""Fly an exported course (policy and guidance in one module) on Nomoto's model in C++ and in
Python: the same track, and how long a step takes.

python examples/autopilot_cpp/compare_course.py RUN/exports/policy_enter.pt BUILD/course [--seconds
250]
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

COLUMNS = ("x", "y", "psi", "r", "delta")


def measured(x: float, y: float, psi: float, speed: float, r: float) -> torch.Tensor:
    """What the controller sees [1, 6]."""
    return torch.tensor([[x, y, psi, speed, 0.0, r]], dtype=torch.float64)


def fly(module: Any, card: dict[str, Any], seconds: float) -> tuple[list[tuple[float, ...]], float]:
    """`COLUMNS` by step until the course ends, and the median time of a step in microseconds."""
    k = card["turning"]["K"]
    constant = card["turning"]["T"]
    speed = card["turning"]["speed"]
    dt = card["dt"]
    x, y, psi, r = card["start"]["north"], card["start"]["east"], card["start"]["heading"], 0.0
    decay = math.exp(-dt / constant)
    half = math.exp(-0.5 * dt / constant)
    track = []
    taken = []
    with torch.inference_mode():
        memory = module.initial_state(measured(x, y, psi, speed, r))
        for _ in range(round(seconds / dt)):
            seen = measured(x, y, psi, speed, r)
            begin = time.perf_counter()
            command, memory, _, arrived = module.step(seen, memory)
            delta = float(command)
            taken.append(1e6 * (time.perf_counter() - begin))
            track.append((x, y, psi, r, delta))
            if bool(arrived):
                break
            steady = k * delta
            middle = psi + steady * 0.5 * dt + (r - steady) * constant * (1.0 - half)
            after = psi + steady * dt + (r - steady) * constant * (1.0 - decay)
            x += speed * dt / 6.0 * (math.cos(psi) + 4.0 * math.cos(middle) + math.cos(after))
            y += speed * dt / 6.0 * (math.sin(psi) + 4.0 * math.sin(middle) + math.sin(after))
            psi, r = after, steady + (r - steady) * decay
    return track, statistics.median(taken[10:])


def eager(run: Path, card: dict[str, Any]) -> Any:
    """Policy and guidance of a course run without compilation, planned again: the same operations,
    called one by one from Python.
    """
    from residnet.autopilot.export import GuardedCoursePolicy
    from residnet.autopilot.tasks.course.config import CourseTaskConfig
    from residnet.autopilot.tasks.course.execute import (
        load_policy,
        open_autopilot_run,
        plan_with_guidance,
    )
    from residnet.core.config import load_config
    from residnet.runs.folder import RunFolder

    folder = RunFolder.open(run)
    config = load_config(folder.resolved_config, [], CourseTaskConfig)
    known = open_autopilot_run(config, folder)
    _, guidance = plan_with_guidance(config, known, card["protocol"])
    return GuardedCoursePolicy(load_policy(known, config.policy), guidance, config.safe).eval()


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("course", type=Path)
    parser.add_argument("program", type=Path)
    parser.add_argument("--seconds", type=float, default=250.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    extra = {"card.json": ""}
    module = torch.jit.load(str(given.course), _extra_files=extra)
    card = json.loads(extra["card.json"])
    turning = card["turning"]
    start = card["start"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "track.csv"
        numbers = (
            turning["K"],
            turning["T"],
            turning["speed"],
            card["dt"],
            start["north"],
            start["east"],
            start["heading"],
            given.seconds,
        )
        words = [
            str(given.program),
            str(given.course),
            str(file),
            *(repr(number) for number in numbers),
        ]
        print(subprocess.run(words, capture_output=True, text=True, check=True).stdout.rstrip())
        with file.open() as lines:
            theirs = [tuple(float(row[name]) for name in COLUMNS) for row in csv.DictReader(lines)]
    for name, own in (
        ("eager Python", eager(given.course.parent.parent, card)),
        ("TorchScript in Python", module),
    ):
        mine, median = fly(own, card, given.seconds)
        if len(mine) != len(theirs):
            raise SystemExit(f"{name} took {len(mine)} steps, the C++ program {len(theirs)}")
        worst = max(
            abs(a - b)
            for one, other in zip(mine, theirs, strict=True)
            for a, b in zip(one, other, strict=True)
        )
        print(
            f"{name}: median step {median:.1f} us, largest difference of the track from the C++"
            f" program {worst:.2g}"
        )


if __name__ == "__main__":
    main()
