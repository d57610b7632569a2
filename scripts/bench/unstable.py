"""Whether the selected model of an unstable boat is as good as the best in hindsight.

    python scripts/bench/unstable.py [--vessels N] [--seed S] [--still]

Hulls with two propellers are drawn that do not hold a straight course: a disturbance doubles in
about a second at full speed. Ten logs of each are fitted by a linear baseline, PLSR, ridge and an
MLP; six others are new trials. Printed for each: how fast a disturbance grows at the highest speed
of the data, in truth and by the selected model, and the position error at the end of the longest
free runs over the new trials, of the selected model and of the best. `--still` leaves gusts out.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from random_vessels import draw, fly, log_of

import residnet
from residnet.core.log import Log
from residnet.judge.soundness import growth_rate, operating_points

_FITTED, _NEW = 10, 6
_HEADS = ("plsr", "ridge", "mlp")


def fleets(seed: int, count: int, still: bool) -> list[tuple[float, list[Log]]]:
    """Return of each boat how fast a disturbance grows, in speeds a length, and its logs."""
    random = np.random.default_rng([seed, 5])
    boats = draw(random, count, shortest=1.0, longest=1.1)

    def between(low: float, high: float) -> np.ndarray:
        return np.exp(random.uniform(np.log(low), np.log(high), count))

    boats = dataclasses.replace(
        boats,
        yaw=between(0.1, 0.4),
        munk=between(2.5, 3.5),
        sway=between(0.5, 1.0),
        drift=between(0.5, 0.8),
        gust=boats.gust * (not still),
    )
    lateral = np.array([[-boats.sway, -boats.drift], [-boats.munk, -boats.yaw]])
    growth = np.linalg.eigvals(lateral.transpose(2, 0, 1)).real.max(axis=1)
    logs: list[list[Log]] = [[] for _ in range(count)]
    step = np.full(count, 0.1)
    for k in range(_FITTED + _NEW):
        flight = fly(boats, "twin", (3, 0, 1, 2)[k % 4], step, random, 600)
        for i in range(count):
            logs[i].append(log_of(boats, "twin", flight, step, i, k, random))
    return list(zip((growth / boats.length).tolist(), logs, strict=True))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vessels", type=int, default=6)
    parser.add_argument("--seed", type=int, default=53)
    parser.add_argument("--still", action="store_true")
    given = parser.parse_args()
    ratios = []
    for number, (growth, logs) in enumerate(fleets(given.seed, given.vessels, given.still)):
        models = residnet.fit(logs[:_FITTED], "regressors", _HEADS)
        evidence, name = models.evidence, models.selected
        new = residnet.prepare(logs[_FITTED:], like=models.data)
        limits = residnet.free_run(models, new, "external").evaluation.limits
        last = limits[evidence.protocol]["horizons"][-1]
        errors = {one: row["position"] for one, row in last["models"].items()}
        best = min(errors, key=lambda one: errors[one])
        ratios.append(errors[name] / errors[best])
        one = models.identified[name]
        model = one.model.double().eval()
        point = [p for p in operating_points(one.spec, model) if p.inside][-1]
        found, true = growth_rate(model, point.x, point.w), growth * point.speed
        print(
            f"boat {number}: at {point.speed:.2f} m/s {true:+.2f} 1/s (doubles in"
            f" {math.log(2.0) / true:.2f} s), by {name} {found:+.2f}; after {last['seconds']:g} s"
            f" {name} {errors[name]:.3g} m, {best} {errors[best]:.3g} m ({ratios[-1]:.3f})",
            flush=True,
        )
    print(f"selected over best: mean {np.mean(ratios):.3f}, largest {max(ratios):.3f}")


if __name__ == "__main__":
    main()
