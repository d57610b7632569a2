"""Compare an epoch of training with the usual data loader and loop.

25 teacher-forced batches of 64 windows of 100 samples for an LSTM, with gradients and optimiser,
against a Dataset whose DataLoader collates windows and a cell that is called step by step. Both
have the same network, data and loss. `rollout.py` times free runs and the gradient through them.

Times are CPU seconds of this process, the least of `--repeats`, so that a busy machine matters
little; one thread, with the memory settings of a run (`keep_freed_memory`).

    python scripts/bench/training.py [--repeats 5]
"""

from __future__ import annotations

import argparse
import os
import platform

import numpy as np
import torch
from rollout import NAMES, least
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from residnet.core.processes import keep_freed_memory
from residnet.data.windows import WindowBatches
from residnet.heads.base import ResidualHead
from residnet.heads.lstm import LstmConfig

_WINDOW, _WINDOWS, _BATCHES = 100, 64, 25


class Windows(Dataset[tuple[Tensor, Tensor]]):
    """Windows as a Dataset returns them, one at a time."""

    def __init__(self, z: np.ndarray, target: np.ndarray) -> None:
        self.z, self.target = z, target

    def __len__(self) -> int:
        return len(self.z) - _WINDOW

    def __getitem__(self, start: int) -> tuple[Tensor, Tensor]:
        stop = start + _WINDOW
        return torch.from_numpy(self.z[start:stop]), torch.from_numpy(self.target[start:stop])


def epochs(repeats: int) -> None:
    """Print how much faster an epoch is than by data loader and loop."""
    random = np.random.default_rng(0)
    z = random.normal(size=(50_000, 5)).astype(np.float32)
    target = random.normal(size=(50_000, 3)).astype(np.float32)
    for hidden in (24, 100):
        head = LstmConfig(hidden_size=hidden).build(NAMES).to(torch.float32).train()
        ours = torch.optim.AdamW(head.parameters())
        batches = WindowBatches(torch.arange(len(z) - _WINDOW), _WINDOWS, _BATCHES)

        def epoch(
            head: ResidualHead = head,
            optimiser: torch.optim.Optimizer = ours,
            batches: WindowBatches = batches,
            data: tuple[Tensor, Tensor] = (torch.from_numpy(z), torch.from_numpy(target)),
        ) -> None:
            for starts in batches.epoch(0, 0):
                rows = (starts[:, None] + torch.arange(_WINDOW)).reshape(-1)
                seen, truth = (
                    part.index_select(0, rows).unflatten(0, (_WINDOWS, _WINDOW)) for part in data
                )
                loss = (truth - head.sequence(seen)).square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()

        cell, out = nn.LSTMCell(5, hidden), nn.Linear(hidden, 3)
        usual = torch.optim.AdamW([*cell.parameters(), *out.parameters()])
        loader = DataLoader(Windows(z, target), batch_size=_WINDOWS, shuffle=True)

        def usual_epoch(
            cell: nn.LSTMCell = cell,
            out: nn.Linear = out,
            optimiser: torch.optim.Optimizer = usual,
            loader: DataLoader[tuple[Tensor, Tensor]] = loader,
        ) -> None:
            for number, (seen, truth) in enumerate(loader):
                if number == _BATCHES:
                    break
                state, found = None, []
                for k in range(_WINDOW):
                    state = cell(seen[:, k], state)
                    found.append(out(state[0]))
                loss = (truth - torch.stack(found, dim=1)).square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()

        own, other = least(epoch, repeats), least(usual_epoch, repeats)
        print(
            f"epoch of {_BATCHES} batches, LSTM of {hidden}: {own:.3f} s, by data loader and loop"
            f" {other:.3f} s: {other / own:.1f} times"
        )


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    print(f"torch {torch.__version__}, {platform.platform()}, load {os.getloadavg()[0]:.1f}")
    epochs(given.repeats)


if __name__ == "__main__":
    main()
