"""Exports models drawn at random in every format, and plays each file beside the model.

    python scripts/bench/export_draws.py [--count 40] [--seed 0] [--aoti 10] [--steps 2000]

A draw is a frame of inputs (rudder, twin propellers, azimuth thrusters, water jets, forces; with
wind or without), a baseline of any kind that the frame allows, fitted on simulated trials, a head
of any kind with settings drawn at random (or none, or the mean of several), an integrator, and at
times an unknown force. Each format either holds it, and then follows the model, from a memory that
a measured past has warmed up, through inputs that jump within the training range and at times leave
it; or it refuses in one line and leaves no file. `--aoti N` compiles every Nth draw ahead of time
too, which takes most of the time.

A line for each draw, and below it who refuses and what is wrong; then the worst difference of each
format as a share of a state's range, and how many models it held and refused, by reason. The exit
code is 1 where a format was wrong: another exception, a message of several lines, a file left
behind, or a difference above 1e-5 in single and 1e-12 in double precision.
"""

from __future__ import annotations

import argparse
import collections
import re
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))
from drawn_models import Draw, Model, recording
from playback import DOUBLE_ALONE, Recording, shares

from residnet.core.errors import ResidnetError
from residnet.dynamics.store import ModelSpec


def left_behind(folder: Path) -> list[str]:
    """Return the files of a format that refused."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def judged(
    made: Model,
    given: Recording,
    aoti: bool,
    worst: dict[str, float],
    said: collections.Counter[str],
) -> list[str]:
    """Return what is wrong with the formats of one model, and note how they did."""
    spec, model = made
    wrong = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for found in shares(spec, model, given, aoti, folder):
            kind = found.way.split(",")[0]
            if found.refused:
                said[f"{kind}: {reason(found.refused)}"] += 1
                print(f"  {found.way} refuses: {found.refused}", flush=True)
                if "\n" in found.refused:
                    wrong.append(f"{found.way}: refuses in several lines: {found.refused!r}")
                left = left_behind(folder / kind)
                if left and found.refused != DOUBLE_ALONE:
                    wrong.append(f"{found.way}: refuses and leaves {left}")
                continue
            said[f"{found.way}: held"] += 1
            worst[found.way] = max(worst.get(found.way, 0.0), found.share)
            if found.bad:
                wrong.append(
                    f"{found.way}: {found.state} differs by {found.share:.3g} of its range"
                )
    return wrong


def reason(message: str) -> str:
    """Return a message without its numbers, so that like reasons are counted together."""
    return re.sub(r"[-+]?[0-9][-+.0-9e]*", "#", message)[:150]


def parts_of(spec: ModelSpec) -> str:
    """Return what a model is made of, in a line."""
    head = (
        {}
        if spec.head is None
        else spec.head.model_dump(exclude_defaults=True, exclude={"features"})
    )
    kind = "none" if spec.head is None else spec.head.kind
    if spec.members:
        return "mean of " + " and ".join(parts_of(member) for member in spec.members)
    unknown = ", unknown force" if spec.disturbance else ""
    return f"{spec.baseline.kind} + {kind} {head}, {spec.integrator}{unknown}"


def main() -> int:
    """Draw, export and play; print what is wrong and a table; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of the one draw to look at")
    parser.add_argument("--aoti", type=int, default=10, metavar="N", help="every Nth draw; 0: none")
    parser.add_argument("--steps", type=int, default=2000)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    worst: dict[str, float] = {}
    said: collections.Counter[str] = collections.Counter()
    wrong = 0
    for number in range(given.count) if given.only is None else [given.only]:
        draw = Draw([given.seed, number])
        try:
            frame, wind, made = draw.model()
        except ResidnetError as error:
            said[f"not drawn: {reason(str(error))}"] += 1
            continue
        log = recording(frame, wind, made[0], given.steps, draw.random)
        print(f"{number}: {log.name}: {parts_of(made[0])}", flush=True)
        try:
            faults = judged(made, log, given.aoti > 0 and number % given.aoti == 0, worst, said)
        except Exception:  # what no user may see is what is looked for
            faults = [traceback.format_exc()]
        for fault in faults:
            print(f"  WRONG {fault}", flush=True)
        wrong += len(faults)
    for way, share in sorted(worst.items()):
        print(f"{way:14}{said[f'{way}: held']:5} held, worst {share:.1e} of a state's range")
    for text, count in sorted(said.items()):
        if not text.endswith(": held"):
            print(f"{count:5}  {text}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
