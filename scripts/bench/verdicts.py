"""Do levels and prediction intervals of the verdict hold on new trials of the vessel?

    python scripts/bench/verdicts.py [--vessels 60] [--seed 11] [--first 0] [--last 60]

Vessels are drawn at random (`tests/support/fleets.py`); twenty logs of each are fitted by a linear
baseline, PLSR and an MLP. As many logs as were tested on are new trials. The logs of each vessel
are permuted first: the k-th log of all drawn vessels is the same kind of manoeuvre, so that
otherwise all vessels would share one comparison of kinds. For every horizon that the
verdict rates good or limited, the mean errors of position and heading on the new trials are
compared with the prediction intervals and with the errors of constant velocity. Printed for each
vessel: the level at the main horizon, and every violation. Then the shares over all vessels.
`--first` and `--last` select some of the vessels, so that a long run can be divided. A vessel whose
fit ends with an error is counted as failed.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

import bench
import numpy as np
from fleets import drawn

import residnet
from residnet.core.errors import ResidnetError
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.evaluation.verdict import (
    GOOD_LEVEL,
    LIMITED_LEVEL,
    known_horizons,
    rate_horizon,
    rate_model,
)

_N_FITTED = 20
_N_NEW = 8
_LENGTH_OF_FLEETS = _N_FITTED + _N_NEW


@dataclass
class Comparison:
    """Comparison of a verdict with new trials.

    Attributes:
        level: level at the main horizon.
        n_within: errors within their prediction intervals.
        n_above: errors above their prediction intervals.
        n_below: errors below their prediction intervals.
        n_horizons: horizons that are rated good or limited.
        n_joint: horizons with no error above its prediction interval.
        worse: horizons of a level at which constant velocity has a smaller error.
        texts: the violations.
    """

    level: str
    n_within: int = 0
    n_above: int = 0
    n_below: int = 0
    n_horizons: int = 0
    n_joint: int = 0
    worse: list[str] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)


def compare_with_new_trials(models: residnet.Models, new: Any) -> Comparison:
    """Compare the verdict on fitted models with their free runs over new logs."""
    evidence = models.evidence
    comparison = Comparison(rate_model(evidence))
    dataset = residnet.prepare(new, settings_from=models.data)
    evaluation = residnet.free_run(models, dataset, "external").evaluation
    for protocol, row in known_horizons(evidence):
        level = rate_horizon(evidence, row)
        new_rows = {
            new_row.seconds: new_row for new_row in evaluation.limits_by_protocol[protocol].horizons
        }
        if level not in (GOOD_LEVEL, LIMITED_LEVEL) or row.seconds not in new_rows:
            continue
        comparison.n_horizons += 1
        new_row = new_rows[row.seconds]
        errors = new_row.models[evidence.selected].by_name
        reference_errors = new_row.models[CONSTANT_VELOCITY].by_name
        is_joint = True
        for name in ("position", "heading"):
            low, high = row.models[evidence.selected].intervals[name] or (0.0, math.inf)
            is_joint &= errors[name] <= high
            comparison.n_above += errors[name] > high
            comparison.n_below += errors[name] < low
            comparison.n_within += low <= errors[name] <= high
            label = f"{name} {row.seconds:.3g} s ({level}): {errors[name]:.3g}"
            if not low <= errors[name] <= high:
                comparison.texts.append(f"{label} of {low:.3g} to {high:.3g}")
            if errors[name] >= reference_errors[name]:
                comparison.worse.append(level)
                comparison.texts.append(f"{label}, constant velocity {reference_errors[name]:.3g}")
        comparison.n_joint += is_joint
    return comparison


def main() -> None:
    """Print the table."""
    options = bench.options(__doc__, vessels=60, seed=11, first=0, last=10_000)
    comparisons: list[Comparison] = []
    n_failed = 0
    numbers = range(options.vessels)[options.first : options.last]
    for kind, first in (("boat", 0), ("twin", options.vessels // 2)):
        count = options.vessels // 2
        chosen = [number - first for number in numbers if first <= number < first + count]
        if not chosen:
            continue
        fleets = drawn(kind, options.seed, count, _LENGTH_OF_FLEETS, _LENGTH_OF_FLEETS)
        for i in chosen:
            fleet = fleets[i]
            began = time.process_time()
            order = np.random.default_rng([options.seed, first, i]).permutation(_LENGTH_OF_FLEETS)
            logs = [fleet.logs[j] for j in order]
            try:
                models = residnet.fit(logs[:_N_FITTED], "regressors", ("plsr", "mlp"))
                new = logs[_N_FITTED:][: len(models.data.logs("test"))]
                comparison = compare_with_new_trials(models, new)
            except ResidnetError as error:
                n_failed += 1
                print(f"{fleet.name:8s} failed: {error}", flush=True)
                continue
            comparisons.append(comparison)
            took = time.process_time() - began
            print(
                f"{fleet.name:8s} {models.predictor_name:8s} {comparison.level:16s}"
                f" {comparison.n_within} {comparison.n_above} {comparison.n_below}"
                f" {comparison.n_joint}/{comparison.n_horizons} {'; '.join(comparison.texts)}"
                f"  ({took:.0f} s)",
                flush=True,
            )
    n_errors = sum(c.n_within + c.n_above + c.n_below for c in comparisons)
    n_horizons = sum(c.n_horizons for c in comparisons)
    levels = [c.level for c in comparisons]
    print(
        f"{len(comparisons)} vessels, {n_failed} failed: {levels.count(GOOD_LEVEL)} good,"
        f" {levels.count(LIMITED_LEVEL)} limited; of {n_errors} errors"
        f" {sum(c.n_within for c in comparisons)} within the interval,"
        f" {sum(c.n_above for c in comparisons)} above; of {n_horizons} horizons"
        f" {sum(c.n_joint for c in comparisons)} with both errors below the upper limits;"
        f" {sum(len(c.worse) for c in comparisons)} errors larger than those of constant velocity"
    )


if __name__ == "__main__":
    main()
