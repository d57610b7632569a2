"""Whether a verdict of "good" holds on trials that nobody has seen.

    python scripts/bench/verdicts.py [--vessels 60] [--seed 11]

Vessels are drawn at random (`tests/support/fleets.py`); twenty logs of each are fitted by a linear
baseline, PLSR and an MLP, and as many others as were tested on are new trials. Printed for each
vessel: the level, and for each horizon that the verdict rates good whether the
errors of position and heading on the new trials lie within the interval that the verdict states.
Then the shares over all vessels.
"""

from __future__ import annotations

import math
import time
from typing import Any

import bench
from fleets import drawn

import residnet
from residnet.evaluation.verdict import GOOD_LEVEL, known_horizons, rate_horizon, rate_model

_FITTED = 20
_NEW = 8


def judged(models: residnet.Models, new: Any) -> tuple[list[int], str]:
    """Return where errors called good lie: below the interval (-1), within or above; and a line."""
    evidence = models.evidence
    own = evidence.selected
    found = residnet.free_run(models, residnet.prepare(new, settings_from=models.data), "external")
    seen = {
        row.seconds: row for row in found.evaluation.limits_by_protocol[evidence.protocol].horizons
    }
    places = []
    texts = []
    for _, row in known_horizons(evidence):
        if rate_horizon(evidence, row) != GOOD_LEVEL or row.seconds not in seen:
            continue
        fresh = seen[row.seconds].models[own].by_name
        for of in ("position", "heading"):
            low, high = row.models[own].intervals[of] or (0.0, math.inf)
            places.append(int(fresh[of] > high) - int(fresh[of] < low))
            texts.append(f"{of} {fresh[of]:.3g} of {low:.3g} to {high:.3g}")
    return places, f"{rate_model(evidence):12s} {'; '.join(texts)}"


def main() -> None:
    """Print the table."""
    given = bench.options(__doc__, vessels=60, seed=11)
    found: list[int] = []
    called = 0
    for kind in ("boat", "twin"):
        most = _FITTED + _NEW
        for fleet in drawn(kind, given.seed, given.vessels // 2, most, most):
            began = time.process_time()
            models = residnet.fit(fleet.logs[:_FITTED], "regressors", ("plsr", "mlp"))
            new = fleet.logs[_FITTED:][: len(models.data.logs("test"))]
            places, text = judged(models, new)
            found += places
            called += bool(places)
            took = time.process_time() - began
            print(f"{fleet.name:8s} {models.predictor_name:14s} {text}  ({took:.0f} s)", flush=True)
    print(
        f"called good: {called} vessels; of {len(found)} errors {found.count(0)} within the"
        f" interval, {found.count(1)} above"
    )


if __name__ == "__main__":
    main()
