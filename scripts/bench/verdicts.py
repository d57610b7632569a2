"""Whether a verdict of "good" holds on trials that nobody has seen.

    python scripts/bench/verdicts.py [--vessels N] [--seed S] [--effort E]

Vessels are drawn at random (`tests/support/fleets.py`), twelve logs of each are fitted by the
standard recipe, and eight others are new trials. Printed for each vessel: the level, up to when the
verdict says "good", and for each horizon up to there whether the errors of position and heading on
the new trials lie within the interval that the verdict states. Then the shares over all vessels,
and how many models are called good that are worse than twice the noise floor and, by half, than the
best of the portfolio on the new trials.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from fleets import drawn

import residnet
from residnet.judge.verdict import good_until, level

_FITTED, _NEW = 12, 8
_OF = ("position", "heading")


def judged(models: residnet.Models, new: Any) -> tuple[list[bool], bool, str]:
    """Return what holds of each error called good, whether a bad model is, and a line on it."""
    evidence = models.evidence
    own, until = evidence.selected, good_until(evidence)
    stated = {entry["seconds"]: entry for entry in evidence.limits["horizons"]}
    found = residnet.free_run(models, residnet.prepare(new, like=models.data), "external")
    seen = {
        entry["seconds"]: entry for entry in found.evaluation.limits[evidence.protocol]["horizons"]
    }
    holds, flattered, texts = [], False, []
    for seconds, entry in stated.items():
        if seconds > until or seconds not in seen:
            continue
        fresh = seen[seconds]["models"]
        for of in _OF:
            low, high = entry["models"][own]["intervals"][of]
            error = fresh[own][of]
            holds.append(low <= error <= high)
            best = min(one[of] for name, one in fresh.items() if name != own)
            flattered |= error > 2.0 * seen[seconds]["floor"][of] and error > 1.5 * best
            texts.append(f"{of} {error:.3g} of {low:.3g} to {high:.3g}")
    return holds, flattered, f"{level(evidence):12s} {until:6.4g} s  {'; '.join(texts)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vessels", type=int, default=60)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--effort", type=float, default=0.1)
    given = parser.parse_args()
    all_holds: list[bool] = []
    flatteries = called = 0
    for kind in ("boat", "twin"):
        count = given.vessels // 2
        for fleet in drawn(kind, given.seed, count, _FITTED + _NEW, _FITTED + _NEW):
            began = time.process_time()
            models = residnet.fit(fleet.logs[:_FITTED], effort=given.effort)
            holds, flattered, text = judged(models, fleet.logs[_FITTED:])
            all_holds += holds
            called += bool(holds)
            flatteries += flattered
            print(
                f"{fleet.name:8s} {models.predictor:14s} {text}"
                f"{'  FLATTERED' * flattered}  ({time.process_time() - began:.0f} s)",
                flush=True,
            )
    print(
        f"called good: {called} vessels; within the interval {sum(all_holds)} of"
        f" {len(all_holds)} errors; flattered {flatteries}"
    )


if __name__ == "__main__":
    main()
