"""How often logs that contradict each other are named, and how often good ones are.

    python scripts/bench/fleets.py [CONTRADICTION...] [--fleets 20] [--seed 2]

The fleets are those of `tests/support/fleets.py`: so many vessels of each of two kinds drawn at
random. Limits were chosen on seed 1; report on others. Printed for each contradiction, in one log
or shared by a third of them: how many of the logs concerned (or dead records) are named, for how
many the cause stands first, and in how many fleets a log is named that is as it should be.
"""

from __future__ import annotations

import time

import bench
import numpy as np
from fleets import CONTRADICTIONS, SHARED, drawn

from residnet.quality import inspect_log_set


def main() -> None:
    """Print the table."""
    given = bench.options(__doc__, contradictions=(), fleets=20, seed=2)
    fleets = [one for kind in ("boat", "twin") for one in drawn(kind, given.seed, given.fleets)]
    print(f"{'':26s} named  cause  others  seconds a fleet")
    planted = {**CONTRADICTIONS, **SHARED}
    for what in given.contradictions or ("clean", *planted):
        hits = 0
        causes = 0
        total = 0
        others = 0
        began = time.process_time()
        count = 0
        for number, fleet in enumerate(fleets):
            random = np.random.default_rng([given.seed, number])
            logs = list(fleet.logs)
            concerned = ()
            cause = "none"
            if what == "exchanged sides" and fleet.steering == "delta":
                continue
            if what != "clean":
                logs, concerned, cause = planted[what](fleet, random)
            logs = [log.replace(name=f"log_{i:02d}") for i, log in enumerate(logs)]
            found = inspect_log_set(logs, fleet.inputs).findings
            loud = [one for one in found if one.level != "note"]
            names = [f"log_{i:02d}" for i in concerned] or [fleet.steering]
            about = [[one for one in loud if one.text.startswith(name)] for name in names]
            count = count + 1
            total = total + len(names)
            hits += sum(map(bool, about))
            causes += sum(cause in first.code for first, *_ in filter(None, about))
            others += any(not one.text.startswith((*names,)) for one in loud)
        seconds = (time.process_time() - began) / max(count, 1)
        named = f"{hits}/{total}  {causes}/{total}" if what != "clean" else "-      -"
        print(f"{what:26s} {named}  {others}/{count}  {seconds:.2f}", flush=True)


if __name__ == "__main__":
    main()
