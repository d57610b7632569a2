"""Does a verdict of "good" hold in open loop, and does `outside` flag what logs did not excite?

    python scripts/bench/excitation.py [--kinds pid alike ...] [--seed 101] [--out DIR]
    python scripts/bench/excitation.py --domain-only [--kinds pid alike ...] [--seed 101]

For each kind of boat of `excitation_boats.py`, logs are written, drafted by `residnet new` and
fitted by `residnet run`. The predictor then predicts windows of 10 s of new logs of the same kind,
and of open-loop flights whose inputs step by themselves within the logged range of each. Printed
for each kind: the level, the states of the inputs, the share of steps flagged as outside in both
sets, and of the open-loop windows inside the domain (less than a tenth of the steps flagged) the
share whose error of position, of heading, or of either exceeds its prediction interval. Runs that
`--out` holds are used again. `--domain-only` fits no models: it prints the flags of the operating
domain alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import bench
import excitation_boats as boats
import numpy as np
import torch
import yaml

import residnet
from residnet.dynamics.domain import DomainCheck
from residnet.dynamics.store import ModelSpec, load_model, resolve_model_name
from residnet.export.guard import GuardedDynamics
from residnet.identification.domain import estimate_domain
from residnet.preprocessing.prepare import compute_training_ranges
from residnet.report.run_reader import RunFiles
from residnet.report.sections.verdict import verdict_level

_HORIZON = 10.0
_HISTORY = 2.0
_N_NEW_LOGS = 4
_N_FLIGHTS = 40


def run_residnet(*arguments: str, folder: Path) -> str:
    """Run a command of residnet in a folder; return what it printed."""
    command = [sys.executable, "-m", "residnet", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def read_table(path: Path) -> np.ndarray:
    """Read a table of a boat in SI units and rad [T, c]."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    table[:, [3, 6, -1]] = np.radians(table[:, [3, 6, -1]])
    table[:, 3] = np.unwrap(table[:, 3])
    return table


def input_columns(spec: ModelSpec, header: list[str]) -> list[int]:
    """Return the column of each input of a model in the tables of a boat."""
    names = [name.removesuffix("_rps").removesuffix("_deg") for name in header]
    return [names.index(name) for name in spec.signals.input_columns]


def make_domain_check(
    dataset: residnet.Dataset, header: list[str]
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of a table that flags samples outside domain and ranges of the logs [T].

    The logs of validation belong to the training of the short logs of these boats.
    """
    signals = dataset.signals
    column_names = [name.removesuffix("_rps").removesuffix("_deg") for name in header]
    columns = [column_names.index(name) for name in signals.input_columns]
    training_logs = [*dataset.logs("train"), *dataset.logs("validation")]
    domain = estimate_domain(training_logs, signals, dataset.prepare.grid.step)
    lower, upper = compute_training_ranges(training_logs)
    names = (*signals.dof.dynamic_states, *signals.input_columns)
    margins = np.array([domain.range_margins.get(name, 0.0) for name in names])
    check = DomainCheck(domain, signals.dof.state_names, signals.input_columns, torch.float64)

    def flag_samples(table: np.ndarray) -> np.ndarray:
        w = table[:, columns]
        if dataset.prepare.hold == "mean":
            w = np.concatenate((0.5 * (w[1:] + w[:-1]), w[-1:]))
        values = np.column_stack((table[:, 4:7], w))
        is_in_range = ((values >= lower - margins) & (values <= upper + margins)).all(axis=1)
        is_in_domain = check(torch.from_numpy(table[:, 1:7]), torch.from_numpy(w)).numpy()
        return np.asarray(~(is_in_range & is_in_domain))

    return flag_samples


def prepare_draft(folder: Path) -> residnet.Dataset:
    """Return the logs of a drafted config, prepared as its fit prepares them."""
    config = yaml.safe_load((folder / "boat.yaml").read_text())
    config["data"]["split"]["root"] = str(folder / config["data"]["split"]["root"])
    signals = dict(config["signals"])
    preparation = config["prepare"]
    return residnet.prepare(
        config["data"],
        signals.pop("inputs"),
        step=preparation["grid"]["step"],
        held_channels=preparation["grid"].get("held"),
        derivative=preparation["derivative"],
        hold=preparation["hold"],
        **signals,
    )


def judge(
    spec: ModelSpec, guarded: GuardedDynamics, table: np.ndarray, columns: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the flags of all steps of measured samples, and of windows inside whether they fail.

    Returns:
        Flags [T], and for each window inside the domain whether its errors of position and heading
        at the end exceed their prediction intervals [W, 2].
    """
    y = torch.from_numpy(table[:, 1:7])
    w = torch.from_numpy(table[:, columns])
    w = torch.cat((0.5 * (w[1:] + w[:-1]), w[-1:])) if spec.hold == "mean" else w
    with torch.no_grad():
        flags = guarded.replace_bad_inputs(y, w, torch.zeros(len(y), guarded.n_state).to(y))[3]
    steps = round(_HORIZON / spec.dt)
    past = round(_HISTORY / spec.dt)
    assert spec.band is not None
    widths = {
        name: float(np.interp(steps, spec.band.steps, getattr(spec.band, name)))
        for name in ("heading", "position")
    }
    starts = np.arange(past, len(table) - steps - 5, steps)
    # one noisy sample is a worse initial state than a local line
    lags = np.arange(-5, 6)
    x = torch.from_numpy(
        np.stack([np.polyfit(lags, table[start + lags, 1:7], 1)[1] for start in starts])
    )
    n_outside = torch.zeros(len(starts))
    with torch.no_grad():
        s = guarded.warmup(
            torch.stack([y[start - past : start] for start in starts]),
            torch.stack([w[start - past : start] for start in starts]),
        )
        for k in range(steps):
            x, s, outside = guarded.flagged_step(x, w[starts + k], s)
            n_outside += outside
    error = x.numpy() - table[starts + steps, 1:7]
    position_error = np.hypot(error[:, 0], error[:, 1])
    heading_error = np.abs((error[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    has_failed = np.column_stack(
        (position_error > widths["position"], heading_error > widths["heading"])
    )
    is_inside = n_outside.numpy() <= 0.1 * steps
    return flags.numpy(), has_failed[is_inside]


def main() -> None:
    """Print the table."""
    options = bench.options(
        __doc__,
        kinds=dict.fromkeys(boats.KINDS),
        seed=101,
        effort=0.1,
        out="",
        domain_only=False,
    )
    root = Path(options.out or tempfile.mkdtemp())
    print("kind         seed level        flagged: same kind, open loop; beyond the interval:")
    for number, kind in enumerate(options.kinds):
        began = time.process_time()
        seed = options.seed + number
        folder = root / f"{kind}_{seed}"
        boat = boats.write_logs(kind, seed, folder / "log")
        logs = [read_table(path) for path in sorted((folder / "log").glob("*.csv"))]
        if options.domain_only:
            run_residnet("new", "log", "--out", "boat.yaml", "--overwrite", folder=folder)
            flag_samples = make_domain_check(prepare_draft(folder), boats.log_header(boat))
            tables = [
                [
                    boats.sail(boat, boats.KINDS[kind][1](boat), 100.0)[100:]
                    for _ in range(_N_NEW_LOGS)
                ],
                list(boats.open_loop_flights(boat, logs, _N_FLIGHTS)),
            ]
            shares = []
            for part in tables:
                for k, rows in enumerate(part):
                    # written and read, so that the noise of the sensors is that of the logs
                    boats.write_table(folder / "new" / f"{k}.csv", boat, rows)
                    part[k] = read_table(folder / "new" / f"{k}.csv")
                flags = [flag_samples(table) for table in part]
                shares.append(np.concatenate(flags).mean())
            print(f"{kind:12s} {seed:4d} {shares[0]:6.1%} {shares[1]:6.1%}", flush=True)
            continue
        if not (folder / "run" / "report.html").exists():
            run_residnet("new", "log", "--out", "boat.yaml", folder=folder)
            run_residnet(
                "run", "boat.yaml", "-s", f"effort={options.effort}", "--out", "run", folder=folder
            )
        run = RunFiles(folder / "run")
        spec, model = load_model(run.path / "models" / resolve_model_name(run.path, "predictor"))
        guarded = GuardedDynamics(model.double(), spec).double().eval()
        columns = input_columns(spec, boats.log_header(boat))
        fresh = []
        for k in range(_N_NEW_LOGS):
            rows = boats.sail(boat, boats.KINDS[kind][1](boat), 100.0)[100:]
            boats.write_table(folder / "fresh" / f"{k}.csv", boat, rows)
            fresh.append(judge(spec, guarded, read_table(folder / "fresh" / f"{k}.csv"), columns))
        flown = []
        for k, rows in enumerate(boats.open_loop_flights(boat, logs, _N_FLIGHTS)):
            boats.write_table(folder / "open" / f"{k}.csv", boat, rows)
            flown.append(judge(spec, guarded, read_table(folder / "open" / f"{k}.csv"), columns))
        shares = [np.concatenate([flags for flags, _ in part]).mean() for part in (fresh, flown)]
        failed = np.concatenate([failures for _, failures in flown])
        excitation = json.loads((run.path / "excitation.json").read_text())
        states = ", ".join(f"{row['name']} {row['state']}" for row in excitation["inputs"])
        beyond = "none inside"
        if len(failed):
            position, heading = failed.mean(axis=0)
            either = failed.any(axis=1).mean()
            beyond = f"{position:.0%}, {heading:.0%}, either {either:.0%} of {len(failed)}"
        print(
            f"{kind:12s} {seed:4d} {verdict_level(run):12s} {shares[0]:6.1%} {shares[1]:6.1%}"
            f"   {beyond:30s} {states} ({time.process_time() - began:.0f} s)",
            flush=True,
        )


if __name__ == "__main__":
    main()
