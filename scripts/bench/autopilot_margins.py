"""Compare learned policies with classical laws in finished runs of the task `autopilot`.

    python scripts/bench/autopilot_margins.py RUN [RUN...] [--policy learned]
    python scripts/bench/autopilot_margins.py --config autopilot_conditions --seeds 10 --seed 43
    python scripts/bench/autopilot_margins.py --draw 10 --logs 3 --seed 43 --out runs/drawn
    python scripts/bench/autopilot_margins.py --draw 4 --first 4 --seed 43   # vessel 4 only

Runs may have different seeds; the last columns are mean, standard deviation and range. With
`--seeds`, a config is run first with this number of seeds from `--seed` on. The constants of its
peers are tuned with the first seed and used for the others; of its policies `--policy` is trained
and compared. With `--draw`, vessels are drawn and trained first, as `residnet autopilot` does:
random K, T, rate of the rudder and largest delay. `--logs` draws further vessels of which only
simulated zigzags with noise are available. With `--first`, the vessels before it are drawn, but
not trained. Finished runs in `--out` are used again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bench
import numpy as np
import pandas as pd
import yaml
from large_data import called

from residnet.autopilot.tasks.design import draft_autopilot_config

DEG = 180.0 / math.pi


def read_run_file(run: Path, name: str) -> Any:
    """Return a file of a finished run."""
    if not (run / name).is_file():
        raise SystemExit(f"{run} holds no {name}: name the folder of a finished run")
    return json.loads((run / name).read_text())


def compute_margins(run: Path, name: str) -> dict[str, float]:
    """Return the figures of one run; NaN for missing ones.

    The best classical law of the conditions, and of calm water, is the one with the smallest cost.
    """
    rows = read_run_file(run, "metrics.json")["rows"]
    row_by_test = {(row["model"], row["protocol"]): row for row in rows}
    condition_rows = [row for row in rows if row["protocol"] == "conditions"]
    costs = {row["model"]: row["cost"]["mean"] for row in condition_rows}
    laws = [row["model"] for row in condition_rows if row["kind"] == "classical"]
    constants = [row["model"] for row in condition_rows if row["kind"] == "constants"]
    policy_row = row_by_test[name, "conditions"]
    pd_row = row_by_test.get(("pd", "conditions"))
    quiet_row = row_by_test[name, "quiet"]
    nominal_row = row_by_test[name, "nominal"]
    cost = costs[name]
    best_cost = min(costs[law] for law in laws)
    network_off_cost = costs.get(f"{name} network off", math.nan)
    outside_costs = compute_outside_costs(run, name)
    relative_costs = [policy / law - 1 for policy, law, _ in outside_costs.values()]
    # drafted configs state waves; calm water is then a further condition
    calm_cost, best_calm_cost, _ = outside_costs.get("beyond_calm", (math.nan,) * 3)
    cpu_file = run / "cpu.txt"
    return {
        "cost [s]": cost,
        "best classical [s]": best_cost,
        "below it [%]": 100 * (1 - cost / best_cost),
        "calm: below best [%]": 100 * (1 - calm_cost / best_calm_cost),
        "below PD [%]": 100 * (1 - cost / costs.get("pd", math.nan)),
        "network off [%]": 100 * (network_off_cost / cost - 1),
        "constants alone [%]": 100 * (1 - cost / costs[constants[0]]) if constants else math.nan,
        "overshoot 95 % [deg]": DEG * policy_row["overshoot"]["p95"],
        "travel / PD's": policy_row["travel"]["mean"] / pd_row["travel"]["mean"]
        if pd_row
        else math.nan,
        "swing heading [deg]": DEG * quiet_row["heading_swing"]["max"],
        "swing rudder [deg]": DEG * quiet_row["rudder_swing"]["max"],
        "nominal entry [s]": nominal_row["settling"]["max"],
        "nominal overshoot [deg]": DEG * nominal_row["overshoot"]["max"],
        "worst beyond [%]": 100 * max(relative_costs, default=math.nan),
        "diverged": float(sum(row.get("diverged", 0) for row in rows if row["model"] == name)),
        "training [s]": read_run_file(run, "controllers.json")["controllers"][name].get(
            "seconds", math.nan
        ),
        "whole run, CPU [s]": float(cpu_file.read_text()) if cpu_file.is_file() else math.nan,
    }


def compute_outside_costs(run: Path, name: str) -> dict[str, tuple[float, float, float]]:
    """Return the costs in s of the policy, the best law and PD by further conditions.

    The best law of each condition is the one with the smallest cost.
    """
    costs: dict[str, dict[str, float]] = {}
    laws = set()
    for row in read_run_file(run, "metrics.json")["rows"]:
        if row["protocol"].startswith("beyond_"):
            costs.setdefault(row["protocol"], {})[row["model"]] = row["cost"]["mean"]
            laws |= {row["model"]} if row["kind"] == "classical" else set()
    return {
        protocol: (
            costs_by_model[name],
            min(costs_by_model[law] for law in laws),
            costs_by_model.get("pd", math.nan),
        )
        for protocol, costs_by_model in costs.items()
    }


class DrawnVessel:
    """A vessel: K [1/s], T [s], rate of the rudder [deg/s] and largest delay [s].

    T is between 2.5 and 40 s, and K T between 0.8 and 3. The rudder needs 0.1 T to 0.6 T for 20
    deg; the largest delay of commands is between 0.02 T and 0.12 T.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.time = float(np.exp(rng.uniform(math.log(2.5), math.log(40.0))))
        self.gain = float(rng.uniform(0.8, 3.0)) / self.time
        self.rate = 20.0 / (self.time * float(rng.uniform(0.1, 0.6)))
        self.delay = self.time * float(rng.uniform(0.02, 0.12))

    def __str__(self) -> str:
        return (
            f"K {self.gain:.4g} 1/s, T {self.time:.4g} s, rudder {self.rate:.3g} deg/s, delay"
            f" {self.delay:.2g} s"
        )

    def zigzag(self, file: Path, angle: float, rng: np.random.Generator) -> Path:
        """Write a noisy zigzag at 10 Hz with half of the delay, integrated by Euler's method."""
        dt = 0.1
        n_substeps = 10
        n_delay_steps = round(0.5 * self.delay / (dt / n_substeps))
        r = psi = rudder = 0.0
        side = 1.0
        commands = [0.0] * (n_delay_steps + 1)
        rows = []
        for k in range(round(60.0 * self.time / dt)):
            side = -side if side * psi > angle else side
            noise = rng.normal(size=2) * (0.2, 0.15)
            rows.append((k * dt, psi + noise[0], r + noise[1], side * angle))
            for _ in range(n_substeps):
                commands.append(side * angle)
                step = self.rate * dt / n_substeps
                rudder += min(max(commands[-1 - n_delay_steps] - rudder, -step), step)
                r += dt / n_substeps * (self.gain * rudder - r) / self.time
                psi += dt / n_substeps * r
        names = ("time [s]", "heading [deg]", "yaw rate [deg/s]", "rudder command [deg]")
        pd.DataFrame(rows, columns=list(names)).to_csv(file, index=False)
        return file


def train_for_vessel(
    name: str, vessel: DrawnVessel, out: Path, rng: np.random.Generator, *, logs: bool
) -> Path:
    """Draft a config for a vessel and run it; return the folder of the run."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{name}.yaml"
    run = out / name
    if (run / "metrics.json").is_file():
        return run
    if logs:
        source = [str(vessel.zigzag(out / f"{name}_{a}.csv", a, rng)) for a in (10, 20)]
        draft_autopilot_config(source, file, overwrite=True)
    else:
        source = [f"{vessel.gain:.6g},{vessel.time:.6g}"]
        draft_autopilot_config(source, file, rate=f"{vessel.rate:.4g} deg/s", overwrite=True)
        config = yaml.safe_load(file.read_text())
        conditions = config["conditions"]
        for condition in (conditions["stated"], *conditions["beyond"].values()):
            condition["delay"] = ["0 s", f"{vessel.delay:.4g} s"]
        for peer in ("lqr", "ptos"):
            config["peers"][peer]["lag"] = f"{0.75 * vessel.delay:.4g} s"
        file.write_text(yaml.safe_dump(config, sort_keys=False))
    run_config(file, run)
    return run


def run_config(file: Path, run: Path) -> None:
    """Run a config, and write its processor time into the run folder."""
    arguments = ("-m", "residnet", "run", file, "--out", run, "--overwrite")
    seconds, _, _ = called(*arguments, said=run.with_suffix(".log"))
    (run / "cpu.txt").write_text(f"{seconds:.1f}")


def run_seeds(config: str, policy: str, seeds: Sequence[int], out: Path) -> list[Path]:
    """Train the policy of a config with each seed; peers are tuned with the first one only."""
    out.mkdir(parents=True, exist_ok=True)
    base = yaml.safe_load((bench.CONFIGS / f"{config}.yaml").read_text())
    base["policies"] = {policy: base["policies"][policy]}
    base.pop("predictive", None)
    tuned_file = out / "peers.json"
    runs = []
    for seed in seeds:
        file = out / f"seed_{seed}.yaml"
        run = out / f"seed_{seed}"
        runs.append(run)
        if (run / "metrics.json").is_file():
            continue
        peers = json.loads(tuned_file.read_text()) if tuned_file.is_file() else base["peers"]
        content = base | {"name": run.name, "seed": seed, "peers": peers}
        file.write_text(yaml.safe_dump(content, sort_keys=False))
        run_config(file, run)
        controllers = read_run_file(run, "controllers.json")["controllers"]
        tuned_file.write_text(json.dumps({name: controllers[name]["config"] for name in peers}))
    return runs


def main() -> None:
    """Print the figures of all runs with their statistics, and costs under further conditions."""
    options = bench.options(
        __doc__, runs=(), policy="learned", draw=0, logs=0, first=1,
        config="autopilot_conditions", seeds=0, seed=0, out="runs/drawn",
    )  # fmt: skip
    runs = [Path(run) for run in options.runs]
    out = Path(options.out)
    rng = np.random.default_rng(options.seed)
    for k in range(options.draw + options.logs):
        vessel = DrawnVessel(rng)
        if k + 1 < options.first:
            continue
        logs = k >= options.draw
        name = f"{'logs' if logs else 'vessel'}_{k + 1}"
        print(f"{name}: {vessel}", flush=True)
        noise = np.random.default_rng((options.seed, k))
        runs.append(train_for_vessel(name, vessel, out, noise, logs=logs))
    seeds = range(options.seed, options.seed + options.seeds)
    runs += run_seeds(options.config, options.policy, seeds, out) if options.seeds else []
    if not runs:
        raise SystemExit("name the folders of finished runs, or give --draw, --logs or --seeds")
    figures_of_runs = [compute_margins(run, options.policy) for run in runs]
    names = [*(run.name for run in runs), "mean", "deviation", "least", "most"]
    print(f"{'':24s}" + "".join(f"{name:>12s}" for name in names))
    for title in figures_of_runs[0]:
        values = np.array([figures[title] for figures in figures_of_runs])
        deviation = values.std(ddof=1) if len(values) > 1 else math.nan
        cells = [*values, values.mean(), deviation, values.min(), values.max()]
        print(f"{title:24s}" + "".join(f"{value:12.3f}" for value in cells))
    outside_costs = [compute_outside_costs(run, options.policy) for run in runs]
    for protocol in [
        name for name in outside_costs[0] if all(name in figures for figures in outside_costs)
    ]:
        costs = np.array([figures[protocol] for figures in outside_costs])
        deviations = costs.std(axis=0, ddof=1) if len(costs) > 1 else np.full(3, math.nan)
        texts = [f"{m:.3f} ({d:.3f})" for m, d in zip(costs.mean(axis=0), deviations, strict=True)]
        print(f"{protocol:24s}policy {texts[0]}, best law {texts[1]}, PD {texts[2]} s")


if __name__ == "__main__":
    main()
