"""Print what learning brings under stated conditions, from finished runs of the task `autopilot`.

    python scripts/bench/autopilot_margins.py RUN [RUN...] [--policy learned]
    python scripts/bench/autopilot_margins.py --config autopilot_conditions --seeds 10 --seed 43
    python scripts/bench/autopilot_margins.py --draw 10 --logs 3 --seed 43 --out runs/drawn

Each run may have another seed; the last columns hold mean, standard deviation and the range. With
`--seeds`, a config is run first, with so many seeds from `--seed` on. The constants of its peers
are tuned by the first seed and kept; of its policies `--policy` is trained and compared. With
`--draw`, vessels are drawn and trained first, as `residnet autopilot` does: K, T, rate of the
rudder and largest delay at random. `--logs` draws further ones that are known by simulated zigzags
in noise alone.
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


def read(run: Path, name: str) -> Any:
    """Return a file of a finished run."""
    if not (run / name).is_file():
        raise SystemExit(f"{run} holds no {name}: name the folder of a finished run")
    return json.loads((run / name).read_text())


def margins(run: Path, name: str) -> dict[str, float]:
    """Return the figures of one run; those that a run lacks are no numbers."""
    rows = read(run, "metrics.json")["rows"]
    find = {(row["model"], row["protocol"]): row for row in rows}
    judged = [row for row in rows if row["protocol"] == "conditions"]
    costs = {row["model"]: row["cost"]["mean"] for row in judged}
    laws = [row["model"] for row in judged if row["kind"] == "classical"]
    constants = [row["model"] for row in judged if row["kind"] == "constants"]
    own, pd = find[name, "conditions"], find.get(("pd", "conditions"))
    quiet = find[name, "quiet"]
    nominal = find[name, "nominal"]
    cost = costs[name]
    best = min(costs[law] for law in laws)
    off = costs.get(f"{name} network off", math.nan)
    beyond = [policy / law - 1 for policy, law, _ in outside(run, name).values()]
    cpu = run / "cpu.txt"
    return {
        "cost [s]": cost,
        "best classical [s]": best,
        "below it [%]": 100 * (1 - cost / best),
        "below PD [%]": 100 * (1 - cost / costs.get("pd", math.nan)),
        "network off [%]": 100 * (off / cost - 1),
        "constants alone [%]": 100 * (1 - cost / costs[constants[0]]) if constants else math.nan,
        "overshoot 95 % [deg]": DEG * own["overshoot"]["p95"],
        "travel / PD's": own["travel"]["mean"] / pd["travel"]["mean"] if pd else math.nan,
        "swing heading [deg]": DEG * quiet["heading_swing"]["max"],
        "swing rudder [deg]": DEG * quiet["rudder_swing"]["max"],
        "nominal entry [s]": nominal["settling"]["max"],
        "nominal overshoot [deg]": DEG * nominal["overshoot"]["max"],
        "worst beyond [%]": 100 * max(beyond, default=math.nan),
        "diverged": float(sum(row.get("diverged", 0) for row in rows if row["model"] == name)),
        "training [s]": read(run, "controllers.json")["controllers"][name].get("seconds", math.nan),
        "whole run, CPU [s]": float(cpu.read_text()) if cpu.is_file() else math.nan,
    }


def outside(run: Path, name: str) -> dict[str, tuple[float, float, float]]:
    """Return the costs [s] of the policy, the best law and PD by what lies beyond the conditions.

    The law is the one that costs least there, whichever that is.
    """
    costs: dict[str, dict[str, float]] = {}
    laws = set()
    for row in read(run, "metrics.json")["rows"]:
        if row["protocol"].startswith("beyond_"):
            costs.setdefault(row["protocol"], {})[row["model"]] = row["cost"]["mean"]
            laws |= {row["model"]} if row["kind"] == "classical" else set()
    return {
        protocol: (each[name], min(each[law] for law in laws), each.get("pd", math.nan))
        for protocol, each in costs.items()
    }


class Drawn:
    """A vessel: K [1/s], T [s], rate of the rudder [deg/s] and largest delay [s].

    T lies within 2.5 and 40 s, and K T within 0.8 and 3. The rudder needs a tenth to 0.6 of T for
    20 deg, and commands come up to 0.02 to 0.12 of T late.
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
        """Write a zigzag in noise at 10 Hz, with half of the delay, by Euler's rule."""
        dt = 0.1
        fine = 10
        late = round(0.5 * self.delay / (dt / fine))
        r = psi = rudder = 0.0
        side = 1.0
        held = [0.0] * (late + 1)
        rows = []
        for k in range(round(60.0 * self.time / dt)):
            side = -side if side * psi > angle else side
            noise = rng.normal(size=2) * (0.2, 0.15)
            rows.append((k * dt, psi + noise[0], r + noise[1], side * angle))
            for _ in range(fine):
                held.append(side * angle)
                step = self.rate * dt / fine
                rudder += min(max(held[-1 - late] - rudder, -step), step)
                r += dt / fine * (self.gain * rudder - r) / self.time
                psi += dt / fine * r
        names = ("time [s]", "heading [deg]", "yaw rate [deg/s]", "rudder command [deg]")
        pd.DataFrame(rows, columns=list(names)).to_csv(file, index=False)
        return file


def trained(name: str, vessel: Drawn, out: Path, rng: np.random.Generator, *, logs: bool) -> Path:
    """Draft, train and compare for a vessel; returns the folder of the run."""
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
        for one in (conditions["stated"], *conditions["beyond"].values()):
            one["delay"] = ["0 s", f"{vessel.delay:.4g} s"]
        for peer in ("lqr", "ptos"):
            config["peers"][peer]["lag"] = f"{0.75 * vessel.delay:.4g} s"
        file.write_text(yaml.safe_dump(config, sort_keys=False))
    carried_out(file, run)
    return run


def carried_out(file: Path, run: Path) -> None:
    """Carry out a config, and note its processor time beside it."""
    words = ("-m", "residnet", "run", file, "--out", run, "--overwrite")
    seconds, _, _ = called(*words, said=run.with_suffix(".log"))
    (run / "cpu.txt").write_text(f"{seconds:.1f}")


def seeded(config: str, policy: str, seeds: Sequence[int], out: Path) -> list[Path]:
    """Train a config's policy with each seed, its peers tuned by the first; returns the runs."""
    out.mkdir(parents=True, exist_ok=True)
    base = yaml.safe_load((bench.CONFIGS / f"{config}.yaml").read_text())
    base["policies"] = {policy: base["policies"][policy]}
    base.pop("predictive", None)
    tuned = out / "peers.json"
    runs = []
    for seed in seeds:
        file = out / f"seed_{seed}.yaml"
        run = out / f"seed_{seed}"
        runs.append(run)
        if (run / "metrics.json").is_file():
            continue
        peers = json.loads(tuned.read_text()) if tuned.is_file() else base["peers"]
        content = base | {"name": run.name, "seed": seed, "peers": peers}
        file.write_text(yaml.safe_dump(content, sort_keys=False))
        carried_out(file, run)
        told = read(run, "controllers.json")["controllers"]
        tuned.write_text(json.dumps({name: told[name]["config"] for name in peers}))
    return runs


def main() -> None:
    """Print a line for each figure, a column for each run, their spread, and costs outside."""
    given = bench.options(
        __doc__, runs=(), policy="learned", draw=0, logs=0, config="autopilot_conditions",
        seeds=0, seed=0, out="runs/drawn",
    )  # fmt: skip
    runs = [Path(run) for run in given.runs]
    out = Path(given.out)
    rng = np.random.default_rng(given.seed)
    for k in range(given.draw + given.logs):
        vessel = Drawn(rng)
        logs = k >= given.draw
        name = f"{'logs' if logs else 'vessel'}_{k + 1}"
        print(f"{name}: {vessel}", flush=True)
        noise = np.random.default_rng((given.seed, k))
        runs.append(trained(name, vessel, out, noise, logs=logs))
    seeds = range(given.seed, given.seed + given.seeds)
    runs += seeded(given.config, given.policy, seeds, out) if given.seeds else []
    if not runs:
        raise SystemExit("name the folders of finished runs, or give --draw, --logs or --seeds")
    found = [margins(run, given.policy) for run in runs]
    names = [*(run.name for run in runs), "mean", "deviation", "least", "most"]
    print(f"{'':24s}" + "".join(f"{name:>12s}" for name in names))
    for title in found[0]:
        values = np.array([each[title] for each in found])
        deviation = values.std(ddof=1) if len(values) > 1 else math.nan
        shown = [*values, values.mean(), deviation, values.min(), values.max()]
        print(f"{title:24s}" + "".join(f"{value:12.3f}" for value in shown))
    beyond = [outside(run, given.policy) for run in runs]
    for protocol in [one for one in beyond[0] if all(one in each for each in beyond)]:
        costs = np.array([each[protocol] for each in beyond])
        spread = costs.std(axis=0, ddof=1) if len(costs) > 1 else np.full(3, math.nan)
        told = [f"{m:.3f} ({d:.3f})" for m, d in zip(costs.mean(axis=0), spread, strict=True)]
        print(f"{protocol:24s}policy {told[0]}, best law {told[1]}, PD {told[2]} s")


if __name__ == "__main__":
    main()
