"""Fly an exported policy on Nomoto's model in C++ and in Python: the same track, and how long a
step takes.

python examples/autopilot_cpp/compare.py RUN/exports/policy.pt BUILD/autopilot [--seconds 40]
    [--delay 0.2] [--noise 0.1]
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
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch


class Conditions(NamedTuple):
    """K [1/s], T [s] and speed of the vessel, step [s], delay [s], noise [rad] and [rad/s]."""

    gain: float
    time: float
    speed: float
    dt: float
    delay: float
    noise_psi: float
    noise_r: float


def even_noise() -> Iterator[float]:
    """Even noise of unit variance, as `autopilot.cpp` draws it."""
    mask = 2**64 - 1
    state = 1
    while True:
        state = (state + 0x9E3779B97F4A7C15) & mask
        z = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        z ^= z >> 31
        yield ((z >> 11) / 2**53 - 0.5) * math.sqrt(12.0)


def fly(
    policy: Any, given: Conditions, heading: float, steps: int
) -> tuple[list[tuple[float, float, float]], float]:
    """Heading, yaw rate and rudder by step, and the median time of a step in microseconds."""
    track = []
    taken = []
    psi = 0.0
    r = 0.0
    dt = given.dt
    drawn = even_noise()
    late = deque([0.0] * round(given.delay / dt))
    decay = math.exp(-dt / given.time)
    y = torch.zeros(1, 3)
    reference = torch.full((1, 1), heading)
    y[0, 1] = given.speed
    with torch.inference_mode():
        memory = policy.initial_state(y)
        for _ in range(steps):
            y[0, 0] = psi + given.noise_psi * next(drawn)
            y[0, 2] = r + given.noise_r * next(drawn)
            begin = time.perf_counter()
            command, memory, _ = policy.step(y, reference, memory)
            delta = float(command)
            taken.append(1e6 * (time.perf_counter() - begin))
            track.append((psi, r, delta))
            late.append(delta)
            steady = given.gain * late.popleft()
            psi += steady * dt + (r - steady) * given.time * (1.0 - decay)
            r = steady + (r - steady) * decay
    return track, statistics.median(taken[10:])


def eager(folder: Path, card: dict[str, Any]) -> Any:
    """The policy without compilation: the same operations, called one by one from Python."""
    from residnet.autopilot.export import guard_policy
    from residnet.autopilot.heading.controllers import (
        NetworkPolicySpec,
        ObserverPolicySpec,
        load_recurrent,
    )

    kinds = {"observed": ObserverPolicySpec, "network": NetworkPolicySpec}
    policy = load_recurrent(folder, kinds[card["kind"]])
    policy.set_step(card["dt"])
    return guard_policy(policy, "hold" if "held" in card["fault"] else "amidships")


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", type=Path)
    parser.add_argument("program", type=Path)
    parser.add_argument("--heading", type=float, default=30.0, help="degrees")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--delay", type=float, default=0.2, help="of the commands in s")
    parser.add_argument("--noise", type=float, default=0.1, help="degrees, degrees a second")
    given = parser.parse_args()
    torch.set_num_threads(1)
    extra = {"card.json": ""}
    compiled = torch.jit.load(str(given.policy), _extra_files=extra)
    card = json.loads(extra["card.json"])
    plain = eager(given.policy.parent.parent / "models" / card["policy"], card)
    turning = card["turning"]
    noise = math.radians(given.noise)
    flown = Conditions(
        turning["K"], turning["T"], turning["speed"], card["dt"], given.delay, noise, noise
    )
    dt = flown.dt
    heading = math.radians(given.heading)
    steps = round(given.seconds / dt)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "track.csv"
        words = [
            str(given.program),
            str(given.policy),
            str(file),
            *map(repr, (*flown[:4], heading, given.seconds, *flown[4:])),
        ]
        print(subprocess.run(words, capture_output=True, text=True, check=True).stdout.rstrip())
        with file.open() as lines:
            theirs = [
                (float(row["psi"]), float(row["r"]), float(row["delta"]))
                for row in csv.DictReader(lines)
            ]
    for name, policy in (("eager Python", plain), ("TorchScript in Python", compiled)):
        mine, median = fly(policy, flown, heading, steps)
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
