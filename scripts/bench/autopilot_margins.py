"""Print what learning brings under stated conditions, from finished runs of the task `autopilot`.

Each run may have another seed; the last columns hold mean, standard deviation and the range.

    residnet run autopilot_conditions -s seed=7 --out runs/conditions_7
    python scripts/bench/autopilot_margins.py runs/conditions_7

With `--seeds`, a config is run first, with so many seeds from `--seed` on. The constants of its
peers are tuned by the first seed and kept; of its policies `--policy` is trained and compared.

    python scripts/bench/autopilot_margins.py --config autopilot_conditions --seeds 10 --seed 43

With `--draw`, vessels are drawn and trained first, as `residnet autopilot` does: K, T, rate of the
rudder and largest delay at random. `--logs` draws further ones that are known by simulated zigzags
in noise alone.

    python scripts/bench/autopilot_margins.py --draw 10 --logs 3 --seed 43 --out runs/drawn
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pandas as pd
import yaml

DEG = 180.0 / math.pi
COLUMNS = (
    "cost [s]",
    "best classical [s]",
    "below it [%]",
    "below PD [%]",
    "network off [%]",
    "constants alone [%]",
    "overshoot 95 % [deg]",
    "travel / PD's",
    "swing heading [deg]",
    "swing rudder [deg]",
    "nominal entry [s]",
    "nominal overshoot [deg]",
    "worst beyond [%]",
    "diverged",
    "training [s]",
    "whole run, CPU [s]",
)


def margins(run: Path, name: str) -> list[float]:
    """The figures of one run in the order of `COLUMNS`; those that a run lacks are no numbers."""
    if not (run / "metrics.json").is_file():
        raise SystemExit(f"{run} holds no metrics.json: name the folder of a finished run")
    rows: list[dict[str, Any]] = json.loads((run / "metrics.json").read_text())["rows"]
    find = {(row["model"], row["protocol"]): row for row in rows}
    own = find[(name, "conditions")]
    cost = own["cost"]["mean"]
    judged = [row for row in rows if row["protocol"] == "conditions"]
    classical = [row for row in judged if row["kind"] == "classical"]
    best = min(row["cost"]["mean"] for row in classical)

    def other(model: str) -> float:
        row = find.get((model, "conditions"))
        return math.nan if row is None else float(row["cost"]["mean"])

    beyond = []
    for protocol in {row["protocol"] for row in rows if row["protocol"].startswith("beyond_")}:
        least = min(find[(row["model"], protocol)]["cost"]["mean"] for row in classical)
        beyond.append(100 * (find[(name, protocol)]["cost"]["mean"] / least - 1))
    constants = [row["model"] for row in judged if row["kind"] == "constants"]
    told = json.loads((run / "controllers.json").read_text())["controllers"]
    cpu = run / "cpu.txt"
    quiet, nominal = find[(name, "quiet")], find[(name, "nominal")]
    pd = find.get(("pd", "conditions"))
    return [
        cost,
        best,
        100 * (1 - cost / best),
        100 * (1 - cost / other("pd")),
        100 * (other(f"{name} network off") / cost - 1),
        100 * (1 - cost / other(constants[0])) if constants else math.nan,
        DEG * own["overshoot"]["p95"],
        own["travel"]["mean"] / pd["travel"]["mean"] if pd else math.nan,
        DEG * quiet["heading_swing"]["max"],
        DEG * quiet["rudder_swing"]["max"],
        nominal["settling"]["max"],
        DEG * nominal["overshoot"]["max"],
        max(beyond, default=math.nan),
        float(sum(row["diverged"] for row in rows if row["model"] == name and "diverged" in row)),
        told[name].get("seconds", math.nan),
        float(cpu.read_text()) if cpu.is_file() else math.nan,
    ]


def outside(run: Path, name: str) -> dict[str, tuple[float, float, float]]:
    """Return the costs [s] of the policy, the best law and PD by what lies beyond the conditions.

    The law is the one that costs least there, whichever that is.
    """
    costs: dict[str, dict[str, float]] = {}
    laws = set()
    for row in json.loads((run / "metrics.json").read_text())["rows"]:
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
        dt, fine = 0.1, 10
        late = round(0.5 * self.delay / (dt / fine))
        r = psi = rudder = 0.0
        side, held, rows = 1.0, [0.0] * (late + 1), []
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
    from residnet.tasks.own_autopilot import draft_autopilot

    out.mkdir(parents=True, exist_ok=True)
    file, run = out / f"{name}.yaml", out / name
    if not (run / "metrics.json").is_file():
        if logs:
            source = [str(vessel.zigzag(out / f"{name}_{a}.csv", a, rng)) for a in (10, 20)]
            draft_autopilot(source, file, overwrite=True)
        else:
            source = [f"{vessel.gain:.6g},{vessel.time:.6g}"]
            draft_autopilot(source, file, rate=f"{vessel.rate:.4g} deg/s", overwrite=True)
            config = yaml.safe_load(file.read_text())
            conditions = config["conditions"]
            for one in (conditions["stated"], *conditions["beyond"].values()):
                one["delay"] = ["0 s", f"{vessel.delay:.4g} s"]
            for peer in ("lqr", "ptos"):
                config["peers"][peer]["lag"] = f"{0.75 * vessel.delay:.4g} s"
            file.write_text(yaml.safe_dump(config, sort_keys=False))
        timed(file, run)
    return run


def timed(file: Path, run: Path) -> None:
    """Carry out a config, tell what it says, and note its processor time beside it."""
    from residnet.core.processes import spread
    from residnet.core.progress import Progress, listen
    from residnet.tasks.registry import load_task

    def told(progress: Progress) -> None:
        if progress.message:
            print(progress.message, file=sys.stderr, flush=True)

    begun = time.process_time()
    with listen(told), spread():
        load_task(file, []).run(source=file, out=run, overwrite=True)
    (run / "cpu.txt").write_text(f"{time.process_time() - begun:.1f}")


def seeded(config: str, policy: str, seeds: range, out: Path) -> list[Path]:
    """Train a config's policy with each seed, its peers tuned by the first; returns the runs."""
    from residnet.tasks.registry import config_file

    out.mkdir(parents=True, exist_ok=True)
    base = yaml.safe_load(config_file(Path(config)).read_text())
    base["policies"] = {policy: base["policies"][policy]}
    base.pop("predictive", None)
    tuned, runs = out / "peers.json", []
    for seed in seeds:
        file, run = out / f"seed_{seed}.yaml", out / f"seed_{seed}"
        runs.append(run)
        if (run / "metrics.json").is_file():
            continue
        peers = json.loads(tuned.read_text()) if tuned.is_file() else base["peers"]
        content = base | {"name": run.name, "seed": seed, "peers": peers}
        file.write_text(yaml.safe_dump(content, sort_keys=False))
        timed(file, run)
        told = json.loads((run / "controllers.json").read_text())["controllers"]
        tuned.write_text(json.dumps({name: told[name]["config"] for name in peers}))
    return runs


def main() -> None:
    """Print a line for each figure, a column for each run, their spread, and costs outside."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--policy", default="learned")
    parser.add_argument("--draw", type=int, default=0, help="vessels to draw and train")
    parser.add_argument("--logs", type=int, default=0, help="the same, known by logs alone")
    parser.add_argument("--config", default="autopilot_conditions", help="that --seeds runs")
    parser.add_argument("--seeds", type=int, default=0, help="seeds to run the config with")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn, or the first one")
    parser.add_argument("--out", type=Path, default=Path("runs/drawn"))
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    for k in range(given.draw + given.logs):
        vessel, logs = Drawn(rng), k >= given.draw
        name = f"{'logs' if logs else 'vessel'}_{k + 1}"
        print(f"{name}: {vessel}", flush=True)
        run = trained(name, vessel, given.out, np.random.default_rng((given.seed, k)), logs=logs)
        given.runs.append(run)
        values = margins(run, given.policy)
        print("  " + ", ".join(f"{t} {v:.3g}" for t, v in zip(COLUMNS, values, strict=True)))
    seeds = range(given.seed, given.seed + given.seeds)
    if given.seeds:
        given.runs += seeded(given.config, given.policy, seeds, given.out)
    if not given.runs:
        parser.error("name the folders of finished runs, or give --draw or --seeds")
    found = np.array([margins(run, given.policy) for run in given.runs])
    names = [*(run.name for run in given.runs), "mean", "deviation", "least", "most"]
    print(f"{'':24s}" + "".join(f"{name:>12s}" for name in names))
    for title, values in zip(COLUMNS, found.T, strict=True):
        deviation = values.std(ddof=1) if len(values) > 1 else math.nan
        shown = [*values, values.mean(), deviation, values.min(), values.max()]
        print(f"{title:24s}" + "".join(f"{value:12.3f}" for value in shown))
    beyond = [outside(run, given.policy) for run in given.runs]
    for protocol in [one for one in beyond[0] if all(one in each for each in beyond)]:
        costs = np.array([each[protocol] for each in beyond])
        spread = costs.std(axis=0, ddof=1) if len(costs) > 1 else np.full(3, math.nan)
        told = [f"{m:.3f} ({d:.3f})" for m, d in zip(costs.mean(axis=0), spread, strict=True)]
        print(f"{protocol:24s}policy {told[0]}, best law {told[1]}, PD {told[2]} s")


if __name__ == "__main__":
    main()
