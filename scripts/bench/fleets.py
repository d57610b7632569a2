"""How often logs that contradict each other are named, and how often good ones are.

    python scripts/bench/fleets.py [--fleets N] [--seed S] [--shipped SEEDS] [CONTRADICTION...]

The fleets are those of `tests/support/fleets.py`: vessels of two kinds drawn at random, and with
--shipped the shipped vessels, which no limit was chosen on. Limits were chosen on seed 1; report on
others. Printed for each contradiction: how often the log concerned (or the dead record) is named,
how often its cause stands first, and how often a log is named that is as it should be.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from fleets import CONTRADICTIONS, drawn, shipped

from residnet.data.doctor import inspect_together


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=20, help="of each kind, drawn at random")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--shipped", type=int, default=0, help="seeds of the shipped vessels")
    parser.add_argument("--logs", type=int, default=0, help="of each fleet; 0 takes all")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("contradictions", nargs="*", help="all where none is named")
    given = parser.parse_args()
    fleets = [fleet for seed in range(given.shipped) for fleet in shipped(given.seed + seed)]
    for kind in ("boat", "twin") if given.fleets else ():
        fleets += drawn(kind, given.seed, given.fleets)
    if given.logs:
        fleets = [
            replace(one, logs=one.logs[: given.logs], sisters=one.sisters[: given.logs])
            for one in fleets
        ]
    print(f"{'':26s} named  cause  others  seconds a fleet")
    for what in given.contradictions or ("clean", *CONTRADICTIONS):
        hits, causes, others, began, count = 0, 0, 0, time.process_time(), 0
        for number, fleet in enumerate(fleets):
            random = np.random.default_rng([given.seed, number])
            logs, concerned, cause = list(fleet.logs), -1, ""
            if what != "clean":
                if not fleet.sisters and "boat" in what:
                    continue
                logs, at, cause = CONTRADICTIONS[what](fleet, random)
                concerned = -1 if at is None else at
            logs = [log.replace(name=f"log_{i:02d}") for i, log in enumerate(logs)]
            count += 1
            found = inspect_together(logs, fleet.inputs).findings
            loud = [one for one in found if one.level != "note"]
            name = f"log_{concerned:02d}" if concerned >= 0 else fleet.steering
            about = [one for one in loud if one.text.startswith(name)]
            rest = [one for one in loud if not one.text.startswith(name)]
            hits += bool(about)
            causes += any(cause in one.code for one in about[:1])
            others += bool(rest)
            if given.verbose and (rest or not about or not causes):
                print(what, fleet.name, name, "|", *(f"{one.code}: {one.text}" for one in loud),
                      sep="\n    ", file=sys.stderr)  # fmt: skip
        seconds = (time.process_time() - began) / max(count, 1)
        named = f"{hits}/{count}  {causes}/{count}" if what != "clean" else "-      -"
        print(f"{what:26s} {named}  {others}/{count}  {seconds:.2f}", flush=True)


if __name__ == "__main__":
    main()
