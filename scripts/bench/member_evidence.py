"""Compare rules that choose the members of an ensemble on validation logs, by test errors.

    python scripts/bench/member_evidence.py [--cases twin reversed sway input measured]
        [--seeds S ...] [--networks] [--save FILE]
    python scripts/bench/member_evidence.py --summary FILE ...

Each case has ten training logs, five validation logs and seven test logs of 90 s, of which none is
in two splits. The rules are: equal weights; `point`, which removes a member whose validation error
is so large that it degrades a mean of independent errors, if the mean without it has a smaller
validation error; and `evidence`, which removes members for single velocities by paired one-sided
tests (`identification.member_evidence`).

| case | logs |
|---|---|
| twin | boats with two propellers in gusts, `tests/support/twin_boats.py` |
| reversed | the same, one motor is recorded with the wrong sign |
| sway | the same, with a slow unexplained sway velocity: constant velocity beats a hull |
| input | the same, one input is recorded through a strong nonlinearity |
| measured | stretches of measured logs of a model tanker |

Members are a hull, ridge regression on it, and partial least squares and ridge regression on the
linear baseline, which take seconds. With `--networks` the members are the hull, recurrent networks
on it and recurrent networks with an encoder of the measured past, which are those of the recipe and
of `recurrent.py`; each mean has the hull.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any
from unittest import mock

import bench
import numpy as np
import recipe as draws
from twin_boats import simulate_twin_boats

import residnet
from residnet.core.log import Log
from residnet.evaluation.freerun import FreeRunErrors
from residnet.identification import fit, recipe, settings
from residnet.identification.member_evidence import group_windows, select_members

CASES = ("twin", "reversed", "sway", "input", "measured")
N_LOGS = 22
N_TRAINING = 10
N_FITTED = 15
DURATION = 90.0
_CORRELATION_TIME = 40.0
"""Correlation time of the unexplained sway velocity in s."""
_SWAY_STD = 1.5
"""Its standard deviation, relative to that of the sway velocity."""


def draw_logs(case: str, seed: int) -> list[Log]:
    """Return the logs of a case."""
    random = np.random.default_rng([seed, 5])
    if case == "measured":
        # all stretches are of different files
        with mock.patch.object(draws, "STRETCHES", N_LOGS // 2):
            return draws.of_measured("esso_osaka", DURATION, seed, random)
    sign = -1.0 if case == "reversed" else 1.0
    boats, _ = simulate_twin_boats(seed, 1, N_LOGS, DURATION, starboard_sign=sign)
    changed = []
    for log in boats[0]:
        channels = dict(log.channels)
        if case == "sway":
            channels["v"] = log["v"] + draw_slow_velocity(log, random)
        elif case == "input":
            channels["n_port"] = np.sign(log["n_port"]) * np.abs(log["n_port"]) ** 0.3
        changed.append(log.replace(channels=channels))
    return changed


def draw_slow_velocity(log: Log, random: np.random.Generator) -> np.ndarray:
    """Return a first-order Gauss-Markov process [T]."""
    dt = float(np.median(np.diff(log.t)))
    std = _SWAY_STD * float(np.std(log["v"]))
    values = np.zeros(len(log.t))
    kicks = random.standard_normal(len(values)) * std * np.sqrt(2.0 * dt / _CORRELATION_TIME)
    for k in range(1, len(values)):
        values[k] = values[k - 1] * (1.0 - dt / _CORRELATION_TIME) + kicks[k]
    return values


def make_plan(summary: Any, has_networks: bool) -> dict[str, Any]:
    """Return the plan of the recipe with members that are fitted quickly."""
    plan = recipe.make_portfolio(summary)
    if has_networks:
        network = plan["heads"]["hull_network"]
        heads = {
            "hull_network": network,
            "encoder": {**network, "encoder": "measurements", "margin": 0.5},
        }
    else:
        heads = {
            "plsr": {"kind": "plsr"},
            "ridge": {"kind": "ridge"},
            "hull_ridge": {"kind": "ridge"},
        }
    plan["heads"] = heads
    plan["base_of"] = {name: "hull" for name in heads if name.startswith("hull_")}
    if has_networks:
        plan["base_of"]["encoder"] = "constant_velocity"
    plan["means"] = {}
    plan["training"] = {}
    return plan


def select_by_point_estimates(
    errors: Mapping[str, float], mean_error: Any, names: Sequence[str]
) -> list[str]:
    """Return the members of the rule of version 1: the largest error is removed if it harms."""
    members = list(names)
    while len(members) > 1:
        worst = max(members, key=lambda name: errors[name])
        others = [name for name in members if name != worst]
        count = len(members)
        limit = (2 * count - 1) / (count - 1) ** 2 * sum(errors[name] ** 2 for name in others)
        if errors[worst] ** 2 <= limit or mean_error(others) >= mean_error(members):
            break
        members = others
    return members


def compare_rules(case: str, seed: int, has_networks: bool) -> dict[str, Any]:
    """Fit the members to a draw, and return the test errors of the rules."""
    begin = time.process_time()
    logs = draw_logs(case, seed)
    splits = {
        "train": logs[:N_TRAINING],
        "validation": logs[N_TRAINING:N_FITTED],
        "test": logs[N_FITTED:],
    }
    with (
        mock.patch.object(settings, "make_portfolio", lambda s, **_: make_plan(s, has_networks)),
        # validation logs are evidence only if no member is trained on them
        mock.patch.object(fit, "should_include_validation", return_value=False),
    ):
        models = residnet.fit(splits, bands=None, effort=0.4)
    names = (
        ["hull", "hull_network", "encoder"]
        if has_networks
        else ["hull", "hull_ridge", "plsr", "ridge"]
    )
    evaluation = models.data.evaluation
    scales = evaluation.scales.to_array()
    errors: dict[str, dict[str, FreeRunErrors]] = {}
    windows = {}
    for split in ("validation", "test"):
        evaluated = models.runs[split].evaluation
        run = next(r for r in evaluated.free_runs if r.protocol == evaluation.selection)
        windows[split] = run.windows
        errors[split] = {
            name: FreeRunErrors.from_predictions(run.windows, run.predictions[name], evaluated.logs)
            for name in (*names, "constant_velocity")
        }

    def mean_error(split: str, weights: np.ndarray) -> float:
        """Return the NRMSE of a mean with weights [M, n]."""
        reference = errors[split]["constant_velocity"]
        total = sum(
            weight * errors[split][name].velocity_errors
            for name, weight in zip(names, weights, strict=True)
        )
        rmse = np.sqrt(reference.mean_by_window(total**2)) / scales
        return float(rmse[:, list(reference.dof.active_indices)].mean())

    def equal_weights(members: Sequence[str]) -> np.ndarray:
        is_member = np.array([name in members for name in names])[:, None]
        return np.repeat(is_member / len(members), len(scales), axis=1)

    constant_velocity = errors["validation"]["constant_velocity"]
    selection = select_members(
        [errors["validation"][name].velocity_errors for name in names],
        constant_velocity.velocity_errors,
        lambda values: np.sqrt(constant_velocity.mean_by_window(values**2)),
        group_windows(windows["validation"]),
        constant_velocity.dof.active_indices,
    )
    single = {
        split: {name: float(e.nrmse(scales).mean()) for name, e in errors[split].items()}
        for split in errors
    }
    point = select_by_point_estimates(
        single["validation"],
        lambda members: mean_error("validation", equal_weights(members)),
        names,
    )
    return {
        "case": case,
        "seed": seed,
        "rules": {
            "equal": mean_error("test", equal_weights(names)),
            "point": mean_error("test", equal_weights(point)),
            "evidence": mean_error("test", selection.weights),
        },
        "single": single["test"],
        "point": point,
        "exclusions": [
            [names[e.member], "uvr"[e.velocity], round(e.p_value, 4), e.reference]
            for e in selection.exclusions
        ],
        "cpu": round(time.process_time() - begin, 1),
    }


def summarize(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of geometric mean errors relative to `point`, by case."""
    lines = [
        "| case | draws | `point`, NRMSE | equal / point | evidence / point | largest"
        " | evidence changes |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    cases = dict.fromkeys(record["case"] for record in records)
    for case in (*cases, "all"):
        chosen = [record["rules"] for record in records if case in (record["case"], "all")]
        cells = []
        for rule in ("equal", "evidence"):
            ratios = np.log([rules[rule] / rules["point"] for rules in chosen])
            ratio, error = bench.summarize_log_ratios(ratios)
            cells.append(f"{ratio:.3f} ± {error:.3f}")
        mean = np.mean([rules["point"] for rules in chosen])
        changed = sum(rules["evidence"] != rules["point"] for rules in chosen)
        largest = max(rules["evidence"] / rules["point"] for rules in chosen)
        lines.append(
            f"| {case} | {len(chosen)} | {mean:.3f} | {cells[0]} | {cells[1]} | {largest:.2f} |"
            f" {changed} of {len(chosen)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print a line for each draw, and the table."""
    options = bench.options(
        __doc__, cases=list(CASES), seeds=[11], networks=False, save=None, summary=[""],
    )  # fmt: skip
    records = bench.read_records(options.summary)
    for seed in options.seeds if not any(options.summary) else []:
        for case in options.cases:
            records.append(compare_rules(case, seed, options.networks))
            bench.report_record(records[-1], options.save)
    print(summarize(records))


if __name__ == "__main__":
    main()
