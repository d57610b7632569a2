"""Ablation of the recurrent networks of the recipe: input of the encoder, cell, past, schedule.

    python scripts/bench/recurrent.py [--logs measured|boats|shipped] [--count 4] [--seed S]
        [--minutes 5] [--past 5 10] [--arms NAME ...] [--save FILE]
        [--plain NAME ...]
    python scripts/bench/recurrent.py --summary FILE ...

`--plain` adds networks of `peers.py` with one setting changed each, which depend on no other code
of the project; `plain` has those of the published recipe.

Each draw has three training logs and one validation log, `minutes` long together, and four logs for
the comparison. The hull and all arms are fitted to the same logs, and each arm is compared in the
mean of trajectories that it would belong to: hull + hull_network is the ensemble of the recipe for
short logs. `--past` is the measured past in s that a free run may read; the windows are the same
for every value. The draws of a seed are for choices: report with another seed.
"""

from __future__ import annotations

import time
from typing import Any
from unittest import mock

import bench
import numpy as np
from peers import Comparison, Gru, NetworkSettings
from recipe import SOURCES, STRETCHES, Missed, split

import residnet
from residnet.identification import recipe, settings
from residnet.physics.symmetry import mirror_channels

ARMS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "hull_network": ("hull", {}, {}),
    "hull_encoder": ("hull", {"encoder": "measurements"}, {}),
    "innovations": ("constant_velocity", {}, {}),
    "encoder": ("constant_velocity", {"encoder": "measurements"}, {}),
    "lstm": ("constant_velocity", {"encoder": "measurements", "cell": "lstm"}, {}),
    "encoder_twice": ("constant_velocity", {"encoder": "measurements"}, {"steps": 30}),
    "encoder_margin": ("constant_velocity", {"encoder": "measurements", "margin": 0.5}, {}),
    "hull_margin": ("hull", {"margin": 0.5}, {}),
}
"""Baseline, changed keys of the head and of its training for each arm of the ablation."""
PLAIN: dict[str, dict[str, Any]] = {
    "plain": {},
    "plain_mirror": {"is_mirrored": True},
    "plain_past_5": {"past": 5.0},
    "plain_past_2": {"past": 2.0},
    "plain_full_horizon": {"longest": 1.0},
    "plain_increment": {"gain": "increment"},
    "plain_window_loss": {"loss": "window"},
    "plain_limited": {"is_limited": True},
    "plain_no_average": {"decay": 0.0},
    "plain_joint_clip": {"clips_members": False},
    "plain_fixed_horizon": {"horizons": ((1.0, 1.0),)},
    "plain_lr_1e-3": {"learning_rate": 1e-3},
    "plain_lr_1e-2": {"learning_rate": 1e-2},
    "plain_600": {"n_batches": 600},
    "plain_150": {"n_batches": 150},
    "plain_64_units": {"size": 64},
    "plain_16_units": {"size": 16},
    "plain_one": {"n_members": 1},
    "plain_validated": {"validates": True},
    "plain_coarse": {"coarsening": 2},
    "plain_like_head": {
        "gain": "increment", "loss": "window", "is_limited": True, "decay": 0.0,
        "clips_members": False, "is_mirrored": True,
    },
}  # fmt: skip
"""Changed settings of plain networks; `past` in s, `coarsening` of the step of the others."""
_PLAIN_DEFAULTS = {"longest": 0.6, "clips_members": True}
"""Settings of the published recipe that differ from those of `peers.py`."""
MEANS = (
    ("hull", "hull_network"), ("hull", "hull_encoder"), ("hull", "innovations"),
    ("hull", "encoder"), ("hull", "lstm"), ("hull", "encoder_twice"),
    ("hull", "hull_network", "innovations"), ("hull", "hull_network", "encoder"),
    ("hull", "hull_network", "lstm"), ("hull", "hull_network", "encoder_twice"),
    ("hull", "encoder_margin"), ("hull", "hull_margin"), ("hull", "hull_margin", "encoder_margin"),
    ("hull", "hull_network", "encoder_margin"),
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


def fit_draw(
    splits: dict[str, Any], arms: list[str], past: float, first: float
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, float], Any, tuple[str, ...]]:
    """Fit hull and arms; return errors by model [N, n], first rows of windows, times, the logs."""
    with (
        mock.patch.object(
            settings, "make_portfolio", lambda summary, **_: make_plan(summary, arms)
        ),
        mock.patch.object(recipe, "make_protocols", lambda T: make_protocols(T, past, first)),
    ):
        models = residnet.fit(splits, bands=None)
    names = ["constant_velocity", "hull", *arms]
    free_run_errors = Missed(models, names, "test")
    seconds = {name: float(models[name].fitted_model.notes["seconds"]) for name in arms}
    channels = ("u", "v", "r", *models["hull"].fitted_model.spec.signals.input_columns)
    return (
        dict(zip(names, free_run_errors.each, strict=True)),
        free_run_errors.begins,
        seconds,
        models.data,
        channels,
    )


def fit_plain(name: str, data: Any, channels: tuple[str, ...]) -> tuple[np.ndarray, float]:
    """Fit plain networks to the logs of a draw; return their test errors [N, n] and CPU seconds."""
    options = {**_PLAIN_DEFAULTS, **PLAIN[name]}
    past = options.pop("past", None)
    comparison = Comparison(data, options.pop("coarsening", 1))
    mirror = mirror_channels(channels) if options.get("is_mirrored") else None
    if mirror is not None:
        comparison.scaling.symmetrize(*mirror)
    n_past = comparison.n_past
    if past is not None:
        n_past = min(round(past / (comparison.scaling.factor * comparison.step)), n_past)
    network = Gru(
        n_past,
        comparison.length // comparison.scaling.factor,
        NetworkSettings(**{**options, "is_mirrored": mirror is not None}),
        mirror or ([], []),
    )
    logs = [log for part in ("train", "validation") for log in comparison.splits[part]]
    begin = time.process_time()
    network.fit([comparison.scaling.decimate(log) for log in logs])
    seconds = time.process_time() - begin
    return np.concatenate(comparison.velocity_errors(network, "test")), seconds


def mean_error(errors: np.ndarray, begins: np.ndarray) -> float:
    """Return the mean NRMSE over windows and velocities of errors [N, n], NaN where not scored."""
    is_scored = np.isfinite(errors)
    squares = np.add.reduceat(np.where(is_scored, errors, 0.0) ** 2, begins)
    return float(np.sqrt(squares / np.add.reduceat(is_scored.astype(float), begins)).mean())


def compare_arms(
    splits: dict[str, Any],
    arms: list[str],
    plain: list[str],
    past: float,
    first: float,
) -> dict[str, Any]:
    """Fit all arms, and return the errors of the single models and of the means, and the times."""
    by_name, begins, seconds, data, channels = fit_draw(splits, arms, past, first)
    for name in plain:
        by_name[name], seconds[name] = fit_plain(name, data, channels)
    means = [(name,) for name in by_name]
    means += [members for members in MEANS if set(members) <= set(by_name)]
    means += [(*reference, name) for name in plain for reference in (("hull",), MEANS[0])]
    errors = {
        " + ".join(members): mean_error(
            sum(by_name[name] for name in members) / len(members), begins
        )
        for members in means
        if set(members) <= set(by_name)
    }
    return {"errors": errors, "seconds": seconds}


def summarize(records: list[dict[str, Any]]) -> str:
    """Return geometric means of errors relative to the reference, with paired standard errors."""
    reference = " + ".join(MEANS[0])
    lines = []
    for past in sorted({record["past"] for record in records}):
        chosen = [
            record["errors"]
            for record in records
            if record["past"] == past and reference in record["errors"]
        ]
        if not chosen:
            lines.append(f"past {past:g} s: no draw has {reference}")
            continue
        mean_error = np.mean([errors[reference] for errors in chosen])
        lines.append(f"past {past:g} s, {len(chosen)} draws, {reference}: {mean_error:.3f}")
        for name in dict.fromkeys(name for errors in chosen for name in errors):
            pairs = [(e[name], e[reference]) for e in chosen if name in e]
            ratios = np.log([error / base for error, base in pairs])
            ratio, standard_error = bench.summarize_log_ratios(ratios)
            lines.append(
                f"  {name:44} {ratio:.3f} ± {standard_error:.3f}, better in"
                f" {int((ratios < 0).sum())} of {len(ratios)}, worst {np.exp(ratios.max()):.2f}"
            )
    by_draw: dict[Any, dict[float, float]] = {}
    for record in records:
        if reference not in record["errors"]:
            continue
        draw = (record["name"], record["draw"])
        by_draw.setdefault(draw, {})[record["past"]] = record["errors"][reference]
    pasts = sorted({record["past"] for record in records})
    if len(pasts) > 1:
        paired = [np.log(e[pasts[1]] / e[pasts[0]]) for e in by_draw.values() if len(e) > 1]
        ratio, standard_error = bench.summarize_log_ratios(np.array(paired))
        lines.append(
            f"{reference}: error with a past of {pasts[1]:g} s relative to {pasts[0]:g} s:"
            f" {ratio:.3f} ± {standard_error:.3f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Fit the arms to each draw and print the table, or print the table of stored draws."""
    given = bench.options(
        __doc__, logs="measured", count=4, seed=100, first=0, minutes=5.0, past=[5.0],
        arms=list(ARMS), plain=[""], vessels=[], save=None, summary=[],
    )  # fmt: skip
    records = bench.read_records(given.summary)
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
            plain = [arm for arm in given.plain if arm]
            record = compare_arms(splits, given.arms, plain, past, max(given.past))
            record |= {"name": name, "draw": number, "seed": given.seed, "past": past}
            record["cpu"] = round(time.process_time() - begin, 1)
            records.append(record)
            bench.report_record(record, given.save)
    print(summarize(records))


if __name__ == "__main__":
    main()
