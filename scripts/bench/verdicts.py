"""Whether a verdict of "good" holds on trials that nobody has seen.

    python scripts/bench/verdicts.py [--vessels N] [--seed S]

Vessels are drawn at random (`tests/support/fleets.py`); twenty logs of each are fitted by a linear
baseline, PLSR and an MLP, and as many others as were tested on are new trials. Printed for each
vessel: the level, up to when the verdict says "good", and for each horizon up to there whether the
errors of position and heading on the new trials lie within the interval that the verdict states.
Then the shares over all vessels, and how many models are called good that are worse than twice the
noise floor and, by half, than the best of the portfolio on the new trials.
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
from residnet.judge.verdict import good_until, horizons, level

_FITTED, _NEW = 20, 8
_HEADS = ("plsr", "mlp")
_OF = ("position", "heading")


def judged(models: residnet.Models, new: Any) -> tuple[list[int], bool, str]:
    """Return where each error called good lies, whether a bad model is called so, and a line.

    It lies below the interval (-1), within (0) or above (1).
    """
    evidence = models.evidence
    own, until = evidence.selected, good_until(evidence)
    stated = {entry["seconds"]: entry for entry in horizons(evidence)}
    found = residnet.free_run(models, residnet.prepare(new, like=models.data), "external")
    seen = {
        entry["seconds"]: entry for entry in found.evaluation.limits[evidence.protocol]["horizons"]
    }
    places, flattered, texts = [], False, []
    for seconds, entry in stated.items():
        if seconds > until:
            continue
        fresh = seen[seconds]["models"]
        for of in _OF:
            low, high = entry["models"][own]["intervals"][of]
            error = fresh[own][of]
            places.append(int(error > high) - int(error < low))
            best = min(one[of] for name, one in fresh.items() if name != own)
            flattered |= error > 2.0 * seen[seconds]["floor"][of] and error > 1.5 * best
            texts.append(f"{of} {error:.3g} of {low:.3g} to {high:.3g}")
    return places, flattered, f"{level(evidence):12s} {until:6.4g} s  {'; '.join(texts)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vessels", type=int, default=60)
    parser.add_argument("--seed", type=int, default=11)
    given = parser.parse_args()
    found: list[int] = []
    flatteries = called = 0
    for kind in ("boat", "twin"):
        count = given.vessels // 2
        for fleet in drawn(kind, given.seed, count, _FITTED + _NEW, _FITTED + _NEW):
            began = time.process_time()
            models = residnet.fit(fleet.logs[:_FITTED], "regressors", _HEADS)
            new = fleet.logs[_FITTED:][: len(models.data.logs("test"))]
            places, flattered, text = judged(models, new)
            found += places
            called += bool(places)
            flatteries += flattered
            print(
                f"{fleet.name:8s} {models.predictor:14s} {text}"
                f"{'  FLATTERED' * flattered}  ({time.process_time() - began:.0f} s)",
                flush=True,
            )
    print(
        f"called good: {called} vessels; of {len(found)} errors {found.count(0)} within the"
        f" interval, {found.count(1)} above; flattered {flatteries}"
    )


if __name__ == "__main__":
    main()
