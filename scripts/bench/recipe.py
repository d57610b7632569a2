"""The mean of the standard recipe beside its members, the selected model, and a plain network.

    python scripts/bench/recipe.py [--logs boats|shipped|measured] [--count 8]
        [--seed S | --numbered N] [--minutes M ...] [--vessels NAME ...] [--effort E]
        [--without PART ...] [--network] [--peer] [--weights]

Nothing is said to `residnet.fit` but the logs: M minutes for training and validation (three to
one), as long for the test, which takes part in no choice. Logs are of small boats that follow paths
in gusts, of shipped vessels (zigzags, random steps and 3-2-1-1, with random forces), or stretches
of those below RESIDNET_DATA: of a model tanker (wind not given) and a 7 m tanker model; with
--numbered N they are drawn as commit b1b99e7 did, from its Nth on.

Means of fewer members need no fit of their own. `--without` fits once more for each part of the
training: `mirror` (no mirrored windows), `members` (one network in place of several). `--network`
lets networks alone take part where logs are short. `--weights` weighs the members by their errors
on the validation log, in a fit that did not see it. `--peer` adds a GRU that reads two seconds of
the past, and another that runs freely from what the first one leaves, the best of its validations
kept. A line for each fit; at the end geometric means over the draws.
"""

from __future__ import annotations

import copy
import os
import time
from argparse import Namespace
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import bench
import numpy as np
import torch
from random_vessels import KINDS, small_boat_logs
from scipy.optimize import nnls
from torch import Tensor, nn

import residnet
from residnet.core.config import load_mapping
from residnet.core.layout import VELOCITIES
from residnet.core.log import Log
from residnet.evaluation.freerun import FreeRunErrors
from residnet.evaluation.protocol import Window
from residnet.identification import fit, settings
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.preprocessing.prepare import PreparedLog

SHIPPED: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"step": 0.1, "push": (20.0, 20.0, 20.0), "unit": 3.0},
    "patrol_mss": {"step": 0.1, "push": None, "unit": 3.0},
    "mariner": {"step": 1.0, "push": (2e4, 2e4, 1e6), "unit": 20.0},
    "milliampere": {"step": 0.2, "push": (40.0, 40.0, 60.0), "unit": 5.0},
}
"""Step of the logs in s, largest standard deviations of random forces in N and N m (None where the
vessel has no masses), and a time in s in which the vessel answers."""
TRAINING = 3
STRETCHES = 4
PAST = 2.0
"""Logs of training, logs of training and validation, and seconds that the peer reads."""
Splits = dict[str, list[Log]]


def split(logs: list[Log]) -> Splits:
    """Divide logs into training, validation and test."""
    fitted = {"train": logs[:TRAINING], "validation": logs[TRAINING:STRETCHES]}
    return {**fitted, "test": logs[STRETCHES:]}


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
    config = bench.programme(
        name,
        int(random.integers(2**31)),
        [
            {"kind": "zigzag", "count": 4, "heading": ["10 deg", "20 deg"], **family},
            {"kind": "random_steps", "count": 2, "band": [0.05 / unit, 0.5 / unit], **family},
            {"kind": "three_two_one_one", "count": 2, "unit": [0.7 * unit, 2.0 * unit], **family},
        ],
        duration=seconds,
        step=known["step"],
        noise={"u": noise, "v": noise, "r": f"{random.uniform(0.05, 0.5)} deg/s"},
        disturbance=dict(forces),
    )
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)
    return [logs[i] for i in random.permutation(len(logs))]


def of_measured(name: str, seconds: float, _: int, random: np.random.Generator) -> list[Log]:
    """Return stretches of random measured logs; no log is in two of them."""
    folder = Path(os.environ["RESIDNET_DATA"]) / name
    files = sorted(path for path in folder.rglob("*.csv") if "cut" not in path.name)
    chosen = random.permutation(np.array(files, dtype=object)).tolist()[: 2 * STRETCHES]
    reader = load_mapping(bench.CONFIGS / f"{name}.yaml")["data"]["reader"]
    channels = {key: one for key, one in reader["channels"].items() if not key.startswith("wind")}
    out = []
    for log in residnet.read_logs(chosen, channels=channels, time=reader["time"]):
        room = max(float(log.t[-1] - log.t[0]) - seconds, 0.0)
        begin = log.t[0] + random.uniform(0.0, room)
        rows = (log.t >= begin) & (log.t <= begin + seconds)
        kept = {channel: values[rows] for channel, values in log.channels.items()}
        out.append(log.replace(t=log.t[rows], channels=kept))
    return out


SOURCES = {
    "boats": (of_boats, list(KINDS)),
    "shipped": (of_shipped, list(SHIPPED)),
    "measured": (of_measured, ["esso_osaka", "kvlcc2"]),
}


class Peer(nn.Module):
    """A GRU in free run, started by another one that reads the past, trained on one data set."""

    def __init__(self, data: residnet.Dataset, size: int = 32) -> None:
        super().__init__()
        self.data = data
        self.past = max(round(PAST / data.prepare.grid.step), 1)
        joined = np.concatenate([self.rows(log) for log in data.logs("train")])
        self.mean = np.nanmean(joined, 0)
        # an input that hardly moves in training may move in the test
        self.spread = np.maximum(np.nanstd(joined, 0), 0.05 * np.abs(self.mean)) + 1e-9
        torch.manual_seed(0)
        self.reader = nn.GRU(joined.shape[1], size, batch_first=True)
        self.cell = nn.GRUCell(joined.shape[1], size)
        self.out = nn.Linear(size, 3)
        self.fit(min(max(w.stop - w.start for w in self.windows("train")), 200))

    def forward(self, past: Tensor, start: Tensor, ahead: Tensor) -> Tensor:
        """Velocities [B, T, 3] from past [B, P, 3 + m], velocities [B, 3] and inputs [B, T, m]."""
        h = self.reader(past)[1][0]
        nu, out = start, []
        for k in range(ahead.shape[1]):
            h = self.cell(torch.cat((nu, ahead[:, k]), 1), h)
            nu = nu + 0.1 * self.out(h)
            out.append(nu)
        return torch.stack(out, 1)

    @staticmethod
    def rows(log: PreparedLog) -> np.ndarray:
        """Velocities and inputs [T, 3 + m]."""
        return np.concatenate((log.y[:, VELOCITIES], log.w), 1)

    def scaled(self, log: PreparedLog) -> Tensor:
        """The same in standard deviations."""
        return torch.from_numpy(np.nan_to_num((self.rows(log) - self.mean) / self.spread)).float()

    def windows(self, split: str) -> list[Window]:
        """The windows of the protocol that chooses."""
        protocol = self.data.evaluation.protocols[self.data.evaluation.selection]
        step = self.data.prepare.grid.step
        logs = enumerate(self.data.logs(split))
        return [w for i, log in logs for w in protocol.make_windows(log, i, step)]

    def fit(self, length: int, steps: int = 600) -> None:
        """Free runs of some length from anywhere; the best of the validations is kept."""
        logs = [self.scaled(log) for log in self.data.logs("train")]
        starts = [
            (i, k) for i, log in enumerate(logs) for k in range(self.past, len(log) - length - 1)
        ]
        optimiser = torch.optim.Adam(self.parameters(), 3e-3)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        random = np.random.default_rng(0)
        best = (np.inf, copy.deepcopy(self.state_dict()))
        for number in range(steps):
            picked = [starts[i] for i in random.integers(len(starts), size=64)]
            past = torch.stack([logs[i][k - self.past : k] for i, k in picked])
            ahead = torch.stack([logs[i][k : k + length + 1] for i, k in picked])
            nu = self(past, ahead[:, 0, :3], ahead[:, :-1, 3:])
            loss = (nu - ahead[:, 1:, :3]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            optimiser.step()
            falling.step()
            if number % 25 == 24:
                error = self.error("validation")
                if error < best[0]:
                    best = (error, copy.deepcopy(self.state_dict()))
        self.load_state_dict(best[1])

    @torch.no_grad()
    def error(self, split: str) -> float:
        """Mean NRMSE over the windows of a split, as the rows of metrics.json have it."""
        logs = self.data.logs(split)
        scales = self.data.evaluation.scales.to_array()
        out = []
        for window in self.windows(split):
            z = self.scaled(logs[window.log_index])
            begin = max(window.start - self.past, 0)
            past = z[begin : window.start] if window.start > begin else z[:1]
            ahead = z[None, window.start : window.stop - 1, 3:]
            nu = self(past[None], z[None, window.start, :3], ahead)[0].numpy()
            truth = logs[window.log_index].y[window.start + 1 : window.stop, VELOCITIES]
            apart = nu * self.spread[:3] + self.mean[:3] - truth
            out.append(float((np.sqrt(np.mean(apart**2, 0)) / scales).mean()))
        return float(np.mean(out))


def change(plan: dict[str, Any], part: str) -> None:
    """Let networks alone take part in the plan of the recipe, or leave out a part of training."""
    recurrent_heads = {
        name: config for name, config in plan["heads"].items() if config["kind"] == "recurrent"
    }
    if part == "network":
        plan["heads"].setdefault("network", plan["heads"]["hull_network"])
        plan["base_of"]["network"] = "constant_velocity"
        plan["means"] = {"ensemble": ("hull", *recurrent_heads, "network")}
    elif part == "mirror":
        plan["training"] = {name: {"mirror": False} for name in recurrent_heads}
    else:
        for name, config in recurrent_heads.items():
            plan["heads"][name] = {**config, "members": 1}


def fitted(splits: Splits, effort: float, parts: Sequence[str]) -> Any:
    """Fit the recipe with some parts of it changed."""
    whole = settings.make_portfolio

    def changed(facts: Any, **options: Any) -> dict[str, Any]:
        plan = whole(facts, **options)
        for part in parts:
            change(plan, part)
        return plan

    with mock.patch.object(settings, "make_portfolio", changed):
        return residnet.fit(splits, effort=effort, bands=None)


class Missed:
    """What the members of a mean miss in the free runs over a split, in shares of the scales.

    Attributes:
        each: errors [K, N, n] of the K members, the samples of all windows one after the other; NaN
            where they do not count.
        begins: first sample of each window.
    """

    def __init__(self, models: residnet.Models, names: Sequence[str], split: str) -> None:
        evaluation = models.data.evaluation
        found = models.runs[split].evaluation
        run = next(run for run in found.free_runs if run.protocol == evaluation.selection)
        errors = [
            FreeRunErrors.from_predictions(run.windows, run.predictions[name], found.logs)
            for name in names
        ]
        every = [np.where(one.is_scored, one.velocity_errors, np.nan) for one in errors]
        axes = list(errors[0].dof.active_indices)
        self.each = (np.stack(every) / evaluation.scales.to_array())[..., axes]
        self.begins = errors[0].window_starts

    def error(self, weights: np.ndarray) -> float:
        """Return the mean NRMSE over windows and axes of a mean with weights [K]."""
        together = np.tensordot(weights, self.each, 1)
        known = np.isfinite(together)
        squares = np.add.reduceat(np.where(known, together, 0.0) ** 2, self.begins)
        return float(np.sqrt(squares / np.add.reduceat(known.astype(float), self.begins)).mean())

    def weights(self) -> dict[str, np.ndarray]:
        """Return weights [K] that follow from these errors."""
        every = self.each.reshape(len(self.each), -1).T
        every = every[np.isfinite(every).all(axis=1)]
        # that they add up to one weighs more than all errors
        sure = 1e3 * float(np.linalg.norm(every))
        rows = np.vstack((every, np.full(every.shape[1], sure)))
        found = {
            "weighed by inverse squares": 1.0 / (every**2).mean(axis=0),
            "weighed by least squares": nnls(rows, np.append(np.zeros(len(every)), sure))[0],
        }
        return {name: weights / weights.sum() for name, weights in found.items()}


def means(models: residnet.Models, first: residnet.Models | None) -> dict[str, float]:
    """Return the test errors of the means of fewer members, and of weighed ones."""
    names = models["ensemble"].fitted_model.notes["members"] if "ensemble" in models else ["hull"]
    test = Missed(models, names, "test")
    out = {}
    for count in range(1, len(names) + 1):
        for some in combinations(names, count):
            out[" + ".join(some)] = test.error(np.array([(n in some) / count for n in names]))
    if first is not None:
        learned = Missed(first, names, "validation").weights()
        out |= {name: test.error(weights) for name, weights in learned.items()}
    return out


def judged(splits: Splits, given: Namespace) -> dict[str, Any]:
    """Fit, and return the test errors by the protocol that chooses."""
    began = time.process_time()
    parts = ["network"] if given.network else []
    models = fitted(splits, given.effort, parts)
    seconds = time.process_time() - began
    first = None
    if given.weights:
        with mock.patch.object(fit, "final_fit", return_value=False):
            first = fitted(splits, given.effort, parts)

    def table(of: residnet.Models) -> Any:
        rows = residnet.metrics(of, split="test")
        return rows[rows.protocol == of.data.evaluation.selection].set_index("model")

    rows = table(models)
    errors = {name: float(row.nrmse_mean) for name, row in rows.iterrows()}
    errors["selected"] = errors[models.selected]
    for part in given.without:
        other = table(fitted(splits, given.effort, [*parts, part]))
        errors[f"ensemble without {part}"] = float(other.nrmse_mean["ensemble"])
    errors |= means(models, first)
    if given.peer:
        errors["GRU"] = Peer(models.data).error("test")
    lost = {name: int(row.diverged) for name, row in rows.iterrows() if row.diverged}
    return {"selected": models.selected, "seconds": seconds, "test": errors, "diverged": lost}


def line(record: dict[str, Any]) -> str:
    """Return one fit in a line: errors of all models, the selected one marked."""
    parts = [
        f"{'*' if name == record['selected'] else ''}{name} {error:.3f}"
        + (f" ({record['diverged'][name]} diverged)" if name in record["diverged"] else "")
        for name, error in record["test"].items()
    ]
    return f"{record['seconds']:.0f} s: " + ", ".join(parts)


def summary(records: list[dict[str, Any]]) -> str:
    """Return ratios of the ensemble's errors to those of others: geometric means over the draws."""
    mean = np.array([record["test"]["ensemble"] for record in records])
    out = [
        f"{len(records)} fits; ensemble {mean.mean():.3f}; error of others in that of the ensemble:"
    ]
    for name in (name for name in records[0]["test"] if name != "ensemble"):
        errors = np.array([record["test"].get(name, np.nan) for record in records])
        ratio = np.log(errors / mean)
        spread = np.nanstd(ratio) / np.sqrt(len(ratio))
        better = int((mean <= errors).sum())
        out.append(
            f"  {name:40} {np.exp(np.nanmean(ratio)):.3f} +- {spread:.3f}; the ensemble is no"
            f" worse in"
            f" {better}"
        )
    return "\n".join(out)


def main() -> None:
    """Print a line for each draw, and the table."""
    given = bench.options(
        __doc__, logs="boats", count=8, seed=0, numbered=-1, minutes=[5.0], vessels=[], effort=1.0,
        without=[], network=False, peer=False, weights=False,
    )  # fmt: skip
    source, names = SOURCES[given.logs]
    names = given.vessels or names
    first = max(given.numbered, 0)
    records = []
    for number in range(given.count):
        name = names[(number + first) % len(names)]
        minutes = given.minutes[number // len(names) % len(given.minutes)]
        told = [given.seed, number] if given.numbered < 0 else [first + number, 17]
        random = np.random.default_rng(told)
        logs = source(name, 60.0 * minutes / STRETCHES, given.seed + number // 2, random)
        records.append(judged(split(logs), given))
        print(f"{name}, {minutes:g} min, draw {number}, {line(records[-1])}", flush=True)
    print(summary(records))


if __name__ == "__main__":
    main()
