"""`recipe: standard` and a plain recurrent network on five minutes of measured logs.

    python scripts/bench/recipe_measured.py [--count N] [--seed S] [--effort E] [--minutes M]

RESIDNET_DATA names the folder of the measured logs: a model tanker (wind not given) and a 7 m
tanker model. Each draw takes stretches of random logs of one of them, three for training and one
for validation, M minutes in all, and as many minutes of other logs for the test. Nothing is said to
`residnet.fit` but the logs. The peer is what an hour of PyTorch gives: a GRU that reads two seconds
of the past, and another that runs freely from what the first one leaves, the best of its
validations kept. Both are judged over the same windows.
"""

from __future__ import annotations

import argparse
import copy
import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import residnet
from residnet.core.layout import VELOCITIES
from residnet.core.log import Log
from residnet.data.prepare import Prepared
from residnet.judge.protocol import Window

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
_PAST = 2.0
_STRETCHES = 4


class Peer(nn.Module):
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


def cut(log: Log, seconds: float, random: np.random.Generator) -> Log:
    """A stretch of a log that starts anywhere."""
    room = max(float(log.t[-1] - log.t[0]) - seconds, 0.0)
    begin = log.t[0] + random.uniform(0.0, room)
    rows = (log.t >= begin) & (log.t <= begin + seconds)
    return log.replace(t=log.t[rows], channels={k: v[rows] for k, v in log.channels.items()})


def drawn(folder: Path, random: np.random.Generator, minutes: float) -> dict[str, list[Log]]:
    """Stretches of random logs for training, validation and test; no log is in two of them."""
    files = sorted(path for path in folder.rglob("*.csv") if "cut" not in path.name)
    chosen = random.permutation(np.array(files, dtype=object)).tolist()[: 2 * _STRETCHES]
    logs = residnet.read_logs(chosen, channels=CHANNELS[folder.name], time=TIME[folder.name])
    seconds = 60.0 * minutes / _STRETCHES
    parts = [cut(log, seconds, random) for log in logs]
    return {
        "train": parts[: _STRETCHES - 1],
        "validation": parts[_STRETCHES - 1 : _STRETCHES],
        "test": parts[_STRETCHES:],
    }


def windows(data: residnet.Data, split: str) -> list[Window]:
    """The windows of the protocol that chooses."""
    protocol, step = data.evaluation.protocols[data.evaluation.selection], data.prepare.grid.step
    return [w for i, log in enumerate(data.logs(split)) for w in protocol.windows(log, i, step)]


class Trained:
    """The peer with its scales, trained on one data set."""

    def __init__(self, data: residnet.Data, steps: int) -> None:
        self.step = data.prepare.grid.step
        self.past = max(round(_PAST / self.step), 1)
        joined = np.concatenate([self.rows(log) for log in data.logs("train")])
        self.mean = np.nanmean(joined, 0)
        # an input that hardly moves in training may move in the test
        self.spread = np.maximum(np.nanstd(joined, 0), 0.05 * np.abs(self.mean)) + 1e-9
        torch.manual_seed(0)
        self.net = Peer(joined.shape[1] - 3)
        found = windows(data, "train")
        length = max(w.stop - w.start for w in found)
        self.train(data, min(length, 200), steps)

    @staticmethod
    def rows(log: Prepared) -> np.ndarray:
        """Velocities and inputs [T, 3 + m]."""
        return np.concatenate((log.y[:, VELOCITIES], log.w), 1)

    def scaled(self, log: Prepared) -> np.ndarray:
        """The same in standard deviations."""
        return np.nan_to_num((self.rows(log) - self.mean) / self.spread)

    def train(self, data: residnet.Data, length: int, steps: int) -> None:
        """Free runs of some length from anywhere; the best of the validations is kept."""
        logs = [torch.from_numpy(self.scaled(log)).float() for log in data.logs("train")]
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
                error = self.error(data, "validation")
                if error < best[0]:
                    best = (error, copy.deepcopy(self.net.state_dict()))
        self.net.load_state_dict(best[1])

    @torch.no_grad()
    def error(self, data: residnet.Data, split: str) -> float:
        """Mean NRMSE over the windows of a split, as the rows of metrics.json have it."""
        logs, scales, out = data.logs(split), data.evaluation.scales.array(), []
        for window in windows(data, split):
            z = torch.from_numpy(self.scaled(logs[window.log])).float()
            begin = max(window.start - self.past, 0)
            past = z[begin : window.start] if window.start > begin else z[:1]
            nu = self.net(
                past[None], z[None, window.start, :3], z[None, window.start : window.stop - 1, 3:]
            )[0].numpy()
            truth = logs[window.log].y[window.start + 1 : window.stop, VELOCITIES]
            apart = nu * self.spread[:3] + self.mean[:3] - truth
            out.append(float((np.sqrt(np.mean(apart**2, 0)) / scales).mean()))
        return float(np.mean(out))


def compared(
    splits: dict[str, list[Log]], effort: float, steps: int
) -> tuple[float, float, float, str]:
    """Test errors of the selected model, the peer and the best one, and a line about the fit."""
    began = time.process_time()
    models = residnet.fit(splits, effort=effort, bands=None)
    fitted = time.process_time()
    data = models.data
    peer = Trained(data, steps).error(data, "test")
    rows = residnet.metrics(models, split="test")
    rows = rows[rows.protocol == data.evaluation.selection].set_index("model")
    errors = ", ".join(
        f"{'*' if name == models.selected else ''}{name} {row.nrmse_mean:.3f}"
        + (f" ({row.diverged} diverged)" if row.diverged else "")
        for name, row in rows.iterrows()
    )
    spent = f"{fitted - began:.0f} s, peer {time.process_time() - fitted:.0f} s"
    own = float(rows.loc[models.selected].nrmse_mean)
    best = float(rows[rows.kind != "ensemble"].nrmse_mean.min())
    return own, peer, best, f"{data.evaluation.selection} ({spent}): {errors}; GRU {peer:.3f}"


def table(records: Sequence[tuple[float, float, float]]) -> str:
    """The means over the draws."""
    own, peer, best = np.array(records).T
    return (
        f"{len(own)} draws: selected {own.mean():.3f}, GRU {peer.mean():.3f};"
        f" selected no worse in {int((own <= peer).sum())}; best single model in hindsight"
        f" {best.mean():.3f}, on average of the draws selected"
        f" {100 * (own / best - 1).mean():+.1f} %"
    )


def main() -> None:
    """Run the bench and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=6, help="number of draws")
    parser.add_argument("--seed", type=int, default=0, help="of the first draw")
    parser.add_argument("--minutes", type=float, default=5.0, help="of training and validation")
    parser.add_argument("--effort", type=float, default=1.0, help="of the recipe's networks")
    parser.add_argument("--steps", type=int, default=600, help="of the peer's training")
    given = parser.parse_args()
    torch.set_num_threads(1)
    root, records = Path(os.environ["RESIDNET_DATA"]), []
    for number in range(given.seed, given.seed + given.count):
        random = np.random.default_rng([number, 17])
        folder = root / [*CHANNELS][number % len(CHANNELS)]
        logs = drawn(folder, random, given.minutes)
        own, peer, best, said = compared(logs, given.effort, given.steps)
        records.append((own, peer, best))
        print(f"{folder.name} {number} {said}", flush=True)
    print(table(records))


if __name__ == "__main__":
    main()
