"""How often logs that contradict each other are named, and how often good ones are.

    python scripts/bench/fleets.py [CONTRADICTION...] [--fleets 20] [--seed 2]

The fleets are those of `tests/support/fleets.py`: so many vessels of each of two kinds drawn at
random. Limits were chosen on seed 1; report on others. Printed for each contradiction: how often
the log concerned (or the dead record) is named, how often its cause stands first, and how often a
log is named that is as it should be.
"""

from __future__ import annotations

import time

import bench
import numpy as np
from fleets import CONTRADICTIONS, drawn

from residnet.data.doctor import inspect_together


def main() -> None:
    """Print the table."""
    given = bench.options(__doc__, contradictions=(), fleets=20, seed=2)
    fleets = [one for kind in ("boat", "twin") for one in drawn(kind, given.seed, given.fleets)]
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
            hits += bool(about)
            causes += any(cause in one.code for one in about[:1])
            others += len(about) < len(loud)
        seconds = (time.process_time() - began) / max(count, 1)
        named = f"{hits}/{count}  {causes}/{count}" if what != "clean" else "-      -"
        print(f"{what:26s} {named}  {others}/{count}  {seconds:.2f}", flush=True)


if __name__ == "__main__":
    main()
