"""Ablation of the recurrent networks of the recipe: input of the encoder, cell, past, schedule.

    python scripts/bench/recurrent.py [--logs measured|boats|shipped] [--count 4] [--seed S]
        [--minutes 5] [--past 5 10] [--arms NAME ...] [--save FILE]
    python scripts/bench/recurrent.py --summary FILE ...

Each draw has three training logs and one validation log, `minutes` long together, and four logs for
the comparison. The hull and all arms are fitted to the same logs, and each arm is compared in the
mean of trajectories that it would belong to: hull + hull_network is the ensemble of the recipe for
short logs. `--past` is the measured past in s that a free run may read; the windows are the same
for every value. The draws of a seed are for choices: report with another seed.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any
from unittest import mock

import bench
import numpy as np
from recipe import SOURCES, STRETCHES, Missed, split

import residnet
from residnet.identification import recipe, settings

ARMS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "hull_network": ("hull", {}, {}),
    "hull_encoder": ("hull", {"encoder": "measurements"}, {}),
    "innovations": ("constant_velocity", {}, {}),
    "encoder": ("constant_velocity", {"encoder": "measurements"}, {}),
    "lstm": ("constant_velocity", {"encoder": "measurements", "cell": "lstm"}, {}),
    "encoder_twice": ("constant_velocity", {"encoder": "measurements"}, {"steps": 30}),
}
"""Baseline, changed keys of the head and of its training for each arm of the ablation."""
MEANS = (
    ("hull", "hull_network"), ("hull", "hull_encoder"), ("hull", "innovations"),
    ("hull", "encoder"), ("hull", "lstm"), ("hull", "encoder_twice"),
    ("hull", "hull_network", "innovations"), ("hull", "hull_network", "encoder"),
    ("hull", "hull_network", "lstm"), ("hull", "hull_network", "encoder_twice"),
    ("hull", "hull_encoder", "encoder"), ("hull", "hull_network", "innovations", "encoder"),
)  # fmt: skip
"""Means of trajectories that are compared; the first is the reference."""


def make_plan(summary: Any, arms: list[str]) -> dict[str, Any]:
    """Return the plan of the recipe with the arms as its only heads."""
    plan = recipe.make_portfolio(summary)
    network = plan["heads"]["hull_network"]
    plan["heads"] = {name: {**network, **ARMS[name][1]} for name in arms}
    plan["base_of"] = {name: ARMS[name][0] for name in arms}
    plan["training"] = {name: ARMS[name][2] for name in arms if ARMS[name][2]}
    plan["means"] = {}
    return plan


def make_protocols(length: float, past: float, first: float) -> dict[str, Any]:
    """Return the protocol of the comparison: windows from `first` on with a measured past, s."""
    return {
        f"T{length:g}": {
            "kind": "windows",
            "length": f"{length:g} s",
            "first": f"{first:g} s",
            "history": f"{past:g} s",
        }
    }


def compare_arms(
    splits: dict[str, Any], arms: list[str], past: float, first: float
) -> dict[str, Any]:
    """Fit all arms, and return the errors of the single models and of the means, and the times."""
    with (
        mock.patch.object(settings, "make_portfolio", lambda summary: make_plan(summary, arms)),
        mock.patch.object(recipe, "make_protocols", lambda T: make_protocols(T, past, first)),
    ):
        models = residnet.fit(splits, bands=None)
    names = ["hull", *arms]
    free_run_errors = Missed(models, names, "test")
    errors = {}
    for members in [*((name,) for name in names), *MEANS]:
        if set(members) <= set(names):
            weights = np.array([(name in members) / len(members) for name in names])
            errors[" + ".join(members)] = free_run_errors.error(weights)
    seconds = {name: float(models[name].fitted_model.notes["seconds"]) for name in arms}
    return {"errors": errors, "seconds": seconds}


def summarize(records: list[dict[str, Any]]) -> str:
    """Return geometric means of errors relative to the reference, with paired standard errors."""
    reference = " + ".join(MEANS[0])
    lines = []
    for past in sorted({record["past"] for record in records}):
        chosen = [record["errors"] for record in records if record["past"] == past]
        mean_error = np.mean([errors[reference] for errors in chosen])
        lines.append(f"past {past:g} s, {len(chosen)} draws, {reference}: {mean_error:.3f}")
        for name in dict.fromkeys(name for errors in chosen for name in errors):
            pairs = [(e[name], e[reference]) for e in chosen if name in e]
            ratios = np.log([error / base for error, base in pairs])
            standard_error = ratios.std(ddof=1) / np.sqrt(len(ratios)) if len(ratios) > 1 else 0.0
            lines.append(
                f"  {name:44} {np.exp(ratios.mean()):.3f} ± {standard_error:.3f}, better in"
                f" {int((ratios < 0).sum())} of {len(ratios)}, worst {np.exp(ratios.max()):.2f}"
            )
    by_draw: dict[Any, dict[float, float]] = {}
    for record in records:
        draw = (record["name"], record["draw"])
        by_draw.setdefault(draw, {})[record["past"]] = record["errors"][reference]
    pasts = sorted({record["past"] for record in records})
    if len(pasts) > 1:
        paired = [np.log(e[pasts[1]] / e[pasts[0]]) for e in by_draw.values() if len(e) > 1]
        lines.append(
            f"{reference}: error with a past of {pasts[1]:g} s relative to {pasts[0]:g} s:"
            f" {np.exp(np.mean(paired)):.3f} ± {np.std(paired, ddof=1) / len(paired) ** 0.5:.3f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Fit the arms to each draw and print the table, or print the table of stored draws."""
    given = bench.options(
        __doc__, logs="measured", count=4, seed=100, first=0, minutes=5.0, past=[5.0],
        arms=list(ARMS), vessels=[], save=None, summary=[],
    )  # fmt: skip
    records: list[dict[str, Any]] = []
    for file in given.summary:
        records += [json.loads(line) for line in Path(file).read_text().splitlines()]
    source, names = SOURCES[given.logs]
    names = given.vessels or names
    for number in range(given.first, given.first + given.count if not given.summary else 0):
        name = names[number % len(names)]
        random = np.random.default_rng([given.seed, number])
        splits = split(
            source(name, 60.0 * given.minutes / STRETCHES, given.seed + number // 2, random)
        )
        for past in given.past:
            begin = time.process_time()
            record = compare_arms(splits, given.arms, past, max(given.past))
            record |= {"name": name, "draw": number, "seed": given.seed, "past": past}
            record["cpu"] = round(time.process_time() - begin, 1)
            records.append(record)
            print(json.dumps(record), flush=True)
            if given.save:
                with Path(given.save).open("a") as file:
                    file.write(json.dumps(record) + "\n")
    print(summarize(records))


if __name__ == "__main__":
    main()
