"""Fly an exported policy on Nomoto's model in C++ and in Python: the same track, and how long a
step takes.

python examples/autopilot_cpp/compare.py RUN/exports/policy.pt BUILD/autopilot [--seconds 40]
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


def fly(
    policy: Any, gain: float, constant: float, speed: float, dt: float, heading: float, steps: int
) -> tuple[list[tuple[float, float, float]], float]:
    """Heading, yaw rate and rudder by step, and the median time of a step in microseconds."""
    track, taken, psi, r = [], [], 0.0, 0.0
    decay = math.exp(-dt / constant)
    y, reference = torch.zeros(1, 3), torch.full((1, 1), heading)
    y[0, 1] = speed
    with torch.inference_mode():
        memory = policy.initial_state(y)
        for _ in range(steps):
            y[0, 0], y[0, 2] = psi, r
            begin = time.perf_counter()
            command, memory, _ = policy.step(y, reference, memory)
            delta = float(command)
            taken.append(1e6 * (time.perf_counter() - begin))
            track.append((psi, r, delta))
            steady = gain * delta
            psi += steady * dt + (r - steady) * constant * (1.0 - decay)
            r = steady + (r - steady) * decay
    return track, statistics.median(taken[10:])


def eager(policy: Any) -> Any:
    """The policy without compilation: the same operations, called one by one from Python."""
    from residnet.control.heading.policy import HeadingPolicy
    from residnet.control.heading.turning import Turning
    from residnet.export.autopilot import ExportedPolicy, Limits

    card = policy["card"]
    state = policy["state"]
    turning = card["turning"]
    own = HeadingPolicy(
        ("psi", "u", "r"),
        turning=Turning(turning["K"], turning["T"], turning["speed"]),
        limit=card["command"][0]["limit"],
        dt=card["dt"],
        rate=card["command"][0]["rate"],
        hidden=card["hidden"],
        observer=card["observer"],
    )
    own.load_state_dict(state)
    limits = [tuple(entry["range"]) for entry in card["measured"]]
    return ExportedPolicy(
        own.eval().requires_grad_(False),
        Limits(*limits),
        "hold" if "held" in card["fault"] else "amidships",
    ).eval()


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", type=Path)
    parser.add_argument("program", type=Path)
    parser.add_argument("--heading", type=float, default=30.0, help="degrees")
    parser.add_argument("--seconds", type=float, default=40.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    from safetensors.torch import load_file

    extra = {"card.json": ""}
    compiled = torch.jit.load(str(given.policy), _extra_files=extra)
    card = json.loads(extra["card.json"])
    weights = given.policy.parent.parent / "models" / card["policy"] / "weights.safetensors"
    plain = eager({"card": card, "state": load_file(weights)})
    k, t, speed, dt = (
        card["turning"]["K"],
        card["turning"]["T"],
        card["turning"]["speed"],
        card["dt"],
    )
    heading, steps = math.radians(given.heading), round(given.seconds / dt)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "track.csv"
        words = [
            str(given.program),
            str(given.policy),
            str(file),
            *(repr(v) for v in (k, t, speed, dt, heading, given.seconds)),
        ]
        print(subprocess.run(words, capture_output=True, text=True, check=True).stdout.rstrip())
        with file.open() as lines:
            theirs = [
                (float(row["psi"]), float(row["r"]), float(row["delta"]))
                for row in csv.DictReader(lines)
            ]
    for name, policy in (("eager Python", plain), ("TorchScript in Python", compiled)):
        mine, median = fly(policy, k, t, speed, dt, heading, steps)
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
