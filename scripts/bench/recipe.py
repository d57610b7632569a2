"""The mean of the standard recipe beside its members, the selected model, and a plain network.

    python scripts/bench/recipe.py [--logs boats|shipped|measured] [--count N]
        [--seed S | --numbered N] [--minutes M ...] [--vessels NAME ...] [--effort E]
        [--without PART ...] [--network] [--peer] [--records FILE] [--keep FOLDER]

Nothing is said to `residnet.fit` but the logs: M minutes for training and validation (three to
one), as long for the test, which takes part in no choice.

    boats     small boats (one propeller and a rudder, or two propellers) that follow paths, with
              noise and gusts
    shipped   shipped vessels: zigzags, random steps and 3-2-1-1, with noise and random forces
    measured  random stretches of the logs below RESIDNET_DATA: a model tanker (wind not given) and
              a 7 m tanker model

Means of fewer members need no fit of their own and stand beside the recipe's. `--without` fits once
more for each part of the training that is named, with the same seeds: `mirror` (no mirrored
windows), `members` (one network in place of several).

`--network` lets networks alone take part where logs are short, as they do of long ones.

`--keep` writes a file for each draw with what every member missed in the free runs of the test logs
and of the validation logs, the latter by a fit that did not see them too. Any weights of a mean can
be judged by it.

`--peer` adds what an hour of PyTorch gives: a GRU that reads two seconds of the past, and another
that runs freely from what the first one leaves, the best of its validations kept; it is judged over
the same windows. A line for each fit; at the end geometric means over the draws.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from random_vessels import KINDS, small_boat_logs

import residnet
from residnet.core.config import validate
from residnet.core.layout import VELOCITIES
from residnet.core.log import Log
from residnet.data.prepare import Prepared
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.identification import fit, settings
from residnet.identification.identified import candidates
from residnet.judge.freerun import Errors, Prediction, free_run
from residnet.judge.protocol import Window, all_windows

CHANNELS = {
    "esso_osaka": {
        "x": ("x_position_mid [m]", "m"),
        "y": ("y_position_mid [m]", "m"),
        "psi": ("psi_hat [rad]", "rad"),
        "u": ("u_velo [m/s]", "m/s"),
        "v": ("vm_velo [m/s]", "m/s"),
        "r": ("r_angvelo [rad/s]", "rad/s"),
        "n": ("n_prop [rps]", "rps"),
        "delta": ("delta_rudder [rad]", "rad"),
    },
    "kvlcc2": {
        "x": ("x", "m"),
        "y": ("y", "m"),
        "psi": ("psi", "rad"),
        "u": ("u", "m/s"),
        "v": ("v", "m/s"),
        "r": ("r", "rad/s"),
        "n": ("rev", "1/s"),
        "delta": {"column": "delta", "unit": "rad", "sign": -1},
    },
}
TIME = {"esso_osaka": ("t [s]", "s"), "kvlcc2": "t"}
SHIPPED: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"step": 0.1, "push": (20.0, 20.0, 20.0), "unit": 3.0},
    "patrol_mss": {"step": 0.1, "push": None, "unit": 3.0},
    "mariner": {"step": 1.0, "push": (2e4, 2e4, 1e6), "unit": 20.0},
    "milliampere": {"step": 0.2, "push": (40.0, 40.0, 60.0), "unit": 5.0},
}
"""Step of the logs in s, largest standard deviations of random forces in N and N m (None where the
vessel has no masses), and a time in s in which the vessel answers."""
TRAINING, STRETCHES, PAST = 3, 4, 2.0
"""Logs of training, logs of training and validation, and seconds that the peer reads."""
Splits = dict[str, list[Log]]


def split(logs: list[Log]) -> Splits:
    """Divide logs into training, validation and test."""
    parts = (slice(None, TRAINING), slice(TRAINING, STRETCHES), slice(STRETCHES, None))
    names = ("train", "validation", "test")
    return {name: logs[part] for name, part in zip(names, parts, strict=True)}


def of_boats(name: str, seconds: float, seed: int, _: np.random.Generator) -> list[Log]:
    """Return logs of a small boat that follows paths."""
    return small_boat_logs(name, seed, 2 * STRETCHES, seconds)


def of_shipped(name: str, seconds: float, _: int, random: np.random.Generator) -> list[Log]:
    """Return logs of a mixture of manoeuvres of a shipped vessel."""
    known = SHIPPED[name]
    noise = float(np.exp(random.uniform(np.log(0.005), np.log(0.05))))
    unit = known["unit"]
    family = {"start": min(unit, 0.1 * seconds), "drive": [0.4, 0.9]}
    push = known["push"] and (random.uniform(0.1, 1.0) * np.array(known["push"])).tolist()
    forces = zip(("force_x", "force_y", "force_n"), push, strict=True) if push else ()
    content = {
        "vessel": name,
        "duration": seconds,
        "step": known["step"],
        "substeps": 2,
        "seed": int(random.integers(2**31)),
        "noise": {"u": noise, "v": noise, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
        "disturbance": dict(forces),
        "trials": [
            {"kind": "zigzag", "count": 4, "heading": ["10 deg", "20 deg"], **family},
            {"kind": "random_steps", "count": 2, "band": [0.05 / unit, 0.5 / unit], **family},
            {"kind": "three_two_one_one", "count": 2, "unit": [0.7 * unit, 2.0 * unit], **family},
        ],
        "identification": {},
        "validation": {},
    }
    config = validate(content, SimulatedTrials, "bench")
    logs = simulate(config.draw(), config)
    return [logs[i] for i in random.permutation(len(logs))]


def of_measured(name: str, seconds: float, _: int, random: np.random.Generator) -> list[Log]:
    """Return stretches of random measured logs; no log is in two of them."""
    folder = Path(os.environ["RESIDNET_DATA"]) / name
    files = sorted(path for path in folder.rglob("*.csv") if "cut" not in path.name)
    chosen = random.permutation(np.array(files, dtype=object)).tolist()[: 2 * STRETCHES]
    out = []
    for log in residnet.read_logs(chosen, channels=CHANNELS[name], time=TIME[name]):
        room = max(float(log.t[-1] - log.t[0]) - seconds, 0.0)
        begin = log.t[0] + random.uniform(0.0, room)
        rows = (log.t >= begin) & (log.t <= begin + seconds)
        channels = {channel: values[rows] for channel, values in log.channels.items()}
        out.append(log.replace(t=log.t[rows], channels=channels))
    return out


SOURCES = {
    "boats": (of_boats, list(KINDS)),
    "shipped": (of_shipped, list(SHIPPED)),
    "measured": (of_measured, list(CHANNELS)),
}


class Network(nn.Module):
    """A GRU in free run, started by another one that reads the past."""

    def __init__(self, inputs: int, size: int = 32) -> None:
        super().__init__()
        self.reader = nn.GRU(3 + inputs, size, batch_first=True)
        self.cell = nn.GRUCell(3 + inputs, size)
        self.out = nn.Linear(size, 3)

    def forward(self, past: Tensor, start: Tensor, ahead: Tensor) -> Tensor:
        """Velocities [B, T, 3] from past [B, P, 3 + m], velocities [B, 3] and inputs [B, T, m]."""
        h = self.reader(past)[1][0]
        nu, out = start, []
        for k in range(ahead.shape[1]):
            h = self.cell(torch.cat((nu, ahead[:, k]), 1), h)
            nu = nu + 0.1 * self.out(h)
            out.append(nu)
        return torch.stack(out, 1)


class Peer:
    """The network with its scales, trained on one data set."""

    def __init__(self, data: residnet.Data, steps: int = 600) -> None:
        self.data = data
        self.past = max(round(PAST / data.prepare.grid.step), 1)
        joined = np.concatenate([self.rows(log) for log in data.logs("train")])
        self.mean = np.nanmean(joined, 0)
        # an input that hardly moves in training may move in the test
        self.spread = np.maximum(np.nanstd(joined, 0), 0.05 * np.abs(self.mean)) + 1e-9
        torch.manual_seed(0)
        self.net = Network(joined.shape[1] - 3)
        length = max(w.stop - w.start for w in self.windows("train"))
        self.train(min(length, 200), steps)

    @staticmethod
    def rows(log: Prepared) -> np.ndarray:
        """Velocities and inputs [T, 3 + m]."""
        return np.concatenate((log.y[:, VELOCITIES], log.w), 1)

    def scaled(self, log: Prepared) -> Tensor:
        """The same in standard deviations."""
        return torch.from_numpy(np.nan_to_num((self.rows(log) - self.mean) / self.spread)).float()

    def windows(self, split: str) -> list[Window]:
        """The windows of the protocol that chooses."""
        protocol = self.data.evaluation.protocols[self.data.evaluation.selection]
        step = self.data.prepare.grid.step
        logs = enumerate(self.data.logs(split))
        return [w for i, log in logs for w in protocol.windows(log, i, step)]

    def train(self, length: int, steps: int) -> None:
        """Free runs of some length from anywhere; the best of the validations is kept."""
        logs = [self.scaled(log) for log in self.data.logs("train")]
        starts = [
            (i, k) for i, log in enumerate(logs) for k in range(self.past, len(log) - length - 1)
        ]
        optimiser = torch.optim.Adam(self.net.parameters(), 3e-3)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        random, best = np.random.default_rng(0), (np.inf, copy.deepcopy(self.net.state_dict()))
        for number in range(steps):
            picked = [starts[i] for i in random.integers(len(starts), size=64)]
            past = torch.stack([logs[i][k - self.past : k] for i, k in picked])
            ahead = torch.stack([logs[i][k : k + length + 1] for i, k in picked])
            nu = self.net(past, ahead[:, 0, :3], ahead[:, :-1, 3:])
            loss = (nu - ahead[:, 1:, :3]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
            optimiser.step()
            falling.step()
            if number % 25 == 24:
                error = self.error("validation")
                if error < best[0]:
                    best = (error, copy.deepcopy(self.net.state_dict()))
        self.net.load_state_dict(best[1])

    @torch.no_grad()
    def error(self, split: str) -> float:
        """Mean NRMSE over the windows of a split, as the rows of metrics.json have it."""
        logs, scales, out = self.data.logs(split), self.data.evaluation.scales.array(), []
        for window in self.windows(split):
            z = self.scaled(logs[window.log])
            begin = max(window.start - self.past, 0)
            past = z[begin : window.start] if window.start > begin else z[:1]
            nu = self.net(
                past[None], z[None, window.start, :3], z[None, window.start : window.stop - 1, 3:]
            )[0].numpy()
            truth = logs[window.log].y[window.start + 1 : window.stop, VELOCITIES]
            apart = nu * self.spread[:3] + self.mean[:3] - truth
            out.append(float((np.sqrt(np.mean(apart**2, 0)) / scales).mean()))
        return float(np.mean(out))


PARTS: dict[str, Callable[[dict[str, Any]], None]] = {
    "mirror": lambda plan: _each(plan["training"], mirror=False),
    "members": lambda plan: _each(plan["heads"], members=1),
    "network": lambda plan: _alone(plan),
}


def _alone(plan: dict[str, Any]) -> None:
    for key in ("heads", "training"):
        plan[key].setdefault("network", plan[key]["hull_network"])
    plan["base_of"]["network"] = "zero"
    plan["means"] = {"mean": ("hull", *plan["heads"])}


def _each(parts: dict[str, dict[str, Any]], **changes: Any) -> None:
    for name in parts:
        parts[name] = {**parts[name], **changes}


def fitted(splits: Splits, effort: float, parts: Sequence[str]) -> Any:
    """Fit the recipe with some parts of it changed."""
    whole = settings.portfolio

    def changed(facts: Any, effort: float) -> dict[str, Any]:
        plan = whole(facts, effort)
        for part in parts:
            PARTS[part](plan)
        return plan

    with mock.patch.object(settings, "portfolio", changed):
        return residnet.fit(splits, effort=effort, bands=None)


def subsets(models: Any) -> dict[str, float]:
    """Return the test error of the mean of each set of members, by their names."""
    evaluation = models.data.evaluation
    found = models.runs["test"].evaluation
    run = next(run for run in found.runs if run.protocol == evaluation.selection)
    members = models["mean"].fitted.notes["members"] if "mean" in models else ["hull"]
    out = {}
    for count in range(1, len(members) + 1):
        for names in combinations(members, count):
            together = zip(*(run.predictions[name] for name in names), strict=True)
            states = [np.mean([one.states for one in group], axis=0) for group in together]
            predictions = [Prediction(one, diverged=False) for one in states]
            errors = Errors.of(run.windows, predictions, found.logs)
            out[" + ".join(names)] = float((errors.rmse / evaluation.scales.array()).mean())
    return out


def missed(models: Any, split: str, *, dense: bool) -> dict[str, np.ndarray]:
    """Return the errors of models [N, n] in the free runs over a split, one window after another.

    Errors are shares of the scales, NaN where they do not count. `window` numbers the windows,
    which overlap where they are `dense`.
    """
    data, found = models.data, models.identified
    config, step, logs = data.evaluation, data.prepare.grid.step, data.logs(split)
    protocol = config.protocols[config.selection]
    windows = all_windows(protocol, logs, step, split, dense=dense)
    judged = [replace(one, members=()) for one in candidates(found.values()) if one.name != "mean"]
    out = {}
    for name, predictions in free_run(judged, windows, logs, step, found.limit).items():
        errors = Errors.of(windows, predictions, logs)
        counted = np.where(errors.scored, errors.velocities, np.nan)
        out[name] = (counted / config.scales.array())[:, errors.live.axes].astype(np.float32)
    out["window"] = np.repeat(np.arange(len(windows)), errors.counts)
    return out


def keep(models: Any, splits: Splits, effort: float, parts: Sequence[str], file: Path) -> None:
    """Write what the members of a fit missed, and what they miss of logs that they did not see."""
    whole = {"test": missed(models, "test", dense=False)}
    whole["validation"] = missed(models, "validation", dense=True)
    if models.identified.seen:
        with mock.patch.object(fit, "final_fit", return_value=False):
            first = fitted(splits, effort, parts)
        whole["seen"] = whole["validation"]
        whole["validation"] = missed(first, "validation", dense=True)
        whole["first"] = missed(first, "test", dense=False)
    arrays = {f"{part}.{name}": one for part, found in whole.items() for name, one in found.items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **arrays)


def judged(
    splits: Splits,
    effort: float,
    peer: bool,
    without: Sequence[str],
    network: bool,
    kept: Path | None,
) -> dict[str, Any]:
    """Fit, and return the test errors by the protocol that chooses."""
    began = time.process_time()
    parts = ["network"] if network else []
    models = fitted(splits, effort, parts)
    seconds = time.process_time() - began
    if kept is not None:
        keep(models, splits, effort, parts, kept)
    rows = residnet.metrics(models, split="test")
    rows = rows[rows.protocol == models.data.evaluation.selection].set_index("model")
    errors = {name: float(row.nrmse_mean) for name, row in rows.iterrows()}
    errors["selected"] = errors[models.selected]
    for part in without:
        other = residnet.metrics(fitted(splits, effort, [*parts, part]), split="test")
        other = other[other.protocol == models.data.evaluation.selection].set_index("model")
        errors[f"mean without {part}"] = float(other.nrmse_mean["mean"])
    return {
        "selected": models.selected,
        "seconds": seconds,
        "test": errors | subsets(models),
        "diverged": {name: int(row.diverged) for name, row in rows.iterrows()},
    } | ({"peer": Peer(models.data).error("test")} if peer else {})


def line(record: dict[str, Any]) -> str:
    """One fit in a line: errors of all models, the selected one marked."""
    parts = [
        f"{'*' if name == record['selected'] else ''}{name} {error:.3f}"
        + (f" ({lost} diverged)" if (lost := record["diverged"].get(name, 0)) else "")
        for name, error in record["test"].items()
    ]
    parts += [f"GRU {record['peer']:.3f}"] if "peer" in record else []
    return f"{record['seconds']:.0f} s: " + ", ".join(parts)


def summary(records: list[dict[str, Any]]) -> str:
    """Ratios of errors to that of the mean: geometric means over the draws."""
    mean = np.array([record["test"]["mean"] for record in records])
    out = [f"{len(records)} fits; mean {mean.mean():.3f}; error of others in that of the mean:"]
    names = [name for name in records[0]["test"] if name != "mean"]
    columns = {name: [r["test"].get(name, np.nan) for r in records] for name in names}
    if "peer" in records[0]:
        columns["GRU"] = [record["peer"] for record in records]
    for name, errors in columns.items():
        ratio = np.log(np.array(errors) / mean)
        spread = np.nanstd(ratio) / np.sqrt(len(ratio))
        better = int((mean <= np.array(errors)).sum())
        out.append(
            f"  {name:40} {np.exp(np.nanmean(ratio)):.3f} +- {spread:.3f}; the mean is no worse in"
            f" {better}"
        )
    return "\n".join(out)


def main() -> None:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--logs", choices=list(SOURCES), default="boats")
    parser.add_argument("--count", type=int, default=8, help="number of draws")
    parser.add_argument("--seed", type=int, default=0, help="of all draws")
    parser.add_argument(
        "--numbered", type=int, help="the first of draws as commit b1b99e7 numbers them; no --seed"
    )
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0])
    parser.add_argument("--vessels", nargs="+", help="of the source; all of it otherwise")
    parser.add_argument("--effort", type=float, default=1.0, help="of the recipe's networks")
    parser.add_argument("--without", nargs="+", default=[], choices=list(PARTS)[:-1])
    parser.add_argument("--network", action="store_true", help="networks alone take part")
    parser.add_argument("--peer", action="store_true", help="train a plain GRU beside")
    parser.add_argument("--records", type=Path, help="file for one line of JSON for each fit")
    parser.add_argument("--keep", type=Path, help="folder for the members' errors of each fit")
    given = parser.parse_args()
    torch.set_num_threads(1)
    source, names = SOURCES[given.logs]
    names = given.vessels or names
    records = []
    for number in range(given.count):
        first = given.numbered
        name = names[(number + (first or 0)) % len(names)]
        minutes = given.minutes[number // len(names) % len(given.minutes)]
        told = [given.seed, number] if first is None else [first + number, 17]
        random = np.random.default_rng(told)
        logs = source(name, 60.0 * minutes / STRETCHES, given.seed + number // 2, random)
        kept = given.keep and given.keep / f"{name}_{minutes:g}_{given.seed}_{number}.npz"
        records.append(
            judged(split(logs), given.effort, given.peer, given.without, given.network, kept)
        )
        print(f"{name}, {minutes:g} min, draw {number}, {line(records[-1])}", flush=True)
        if given.records is not None:
            with given.records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(records[-1]) + "\n")
    print(summary(records))


if __name__ == "__main__":
    main()
