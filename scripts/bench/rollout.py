"""Time free runs and their gradients: against their matrix products, and as compiled C.

- `rollout`: an LSTM on a linear baseline, 200 steps by RK4 at batch 1,024 in single precision,
  compiled as free runs of that length are, and as it is, against the matrix products of its
  network alone, which no implementation can do without.
- `ahead`: free runs of 64 rows, and the gradient of 64 windows of 40 steps, by networks of 24 units
  on a linear baseline: what no state decides found for many steps at once, against step by step.
- `compiled`: free runs of 1, 64 and 1,024 rows, and the gradient of 64 windows of 40 steps, by
  LSTMs on a linear baseline: as compiled C against TorchScript with what it finds ahead.
- `device`: free runs and gradients of 40 steps as compiled C on one core beside TorchScript on a
  GPU, by the number of rows, and from how many on the GPU pays. Left out where there is none.

Times are CPU seconds of this process, the least of `--repeats`, so that a busy machine matters
little; one thread, with the memory settings of a run (`keep_freed_memory`). Those of `device` are
by the clock, since a GPU does not count in the former.

    python scripts/bench/rollout.py [--parts rollout ahead compiled device] [--repeats 5]
"""

from __future__ import annotations

import argparse
import copy
import os
import platform
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.processes import keep_freed_memory
from residnet.dynamics.compiled import CompiledRollout
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import MANY, FreeRun, Playback, Rollout, Source, scripted
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig
from residnet.physics.signals import SignalsConfig

NAMES = ("u", "v", "r", "tau_x", "tau_n")
_BATCH, _STEPS = 1_024, 200


def least(
    work: Callable[[], object], repeats: int, clock: Callable[[], float] = time.process_time
) -> float:
    """Return the least time of some work in s, after one call that warms up."""
    work()
    found = []
    for _ in range(repeats):
        begun = clock()
        work()
        found.append(clock() - begun)
    return min(found)


def model_of(head: MlpConfig | LstmConfig) -> HybridDynamics:
    """Return a head on a linear baseline."""
    torch.manual_seed(0)
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    baseline = RegressorBaseline([NAMES] * 3, signals.names)
    baseline.theta.data.copy_(-0.5 * torch.eye(3, 5))
    built = head.build(NAMES)
    return HybridDynamics(signals, baseline, built, 0.05).to(torch.float32).eval()


def rollouts(repeats: int) -> None:
    """Print the share of the matrix products in a rollout."""
    x0, w = torch.zeros(_BATCH, 6), torch.randn(_BATCH, _STEPS, 2)
    for hidden in (100, 24):
        model = model_of(LstmConfig(hidden_size=hidden))
        model.positions = False
        f, h = torch.randn(_BATCH, 5), torch.randn(_BATCH, hidden)
        w_input, w_hidden = torch.randn(5, 4 * hidden), torch.randn(hidden, 4 * hidden)
        out = torch.randn(hidden, 3)

        def products(
            f: Tensor = f, h: Tensor = h, a: Tensor = w_input, b: Tensor = w_hidden, o: Tensor = out
        ) -> None:
            for _ in range(_STEPS):
                f @ a
                h @ b
                h @ o

        with torch.no_grad():
            bound = least(products, repeats)
            for how, run in (
                ("compiled", scripted(Rollout(model), _STEPS)),
                ("not compiled", Rollout(model)),
            ):
                memory = model.initial_state(_BATCH)
                whole = least(partial(run, x0, w, memory), repeats)
                print(
                    f"rollout, LSTM of {hidden}, batch {_BATCH}, {how}:"
                    f" {1e6 * whole / _STEPS:.0f} us a step,"
                    f" products alone {1e6 * bound / _STEPS:.0f} us: {100 * bound / whole:.0f} %"
                )


class StepByStep(Source):
    """A source that gives inputs back as they are, and says so at every step only."""

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs w [B, m], unchanged."""
        return w, memory


def ahead(repeats: int) -> None:
    """Print what it saves to find ahead what no state decides."""
    rows, steps, window = 64, 200, 40
    inputs = ("tau_x", "tau_n")
    x0, w = torch.zeros(rows, 6), torch.randn(rows, steps, 2)
    for name, head in (
        ("MLP", MlpConfig(hidden=(24, 24))),
        ("LSTM", LstmConfig(hidden_size=24)),
        ("LSTM of inputs", LstmConfig(hidden_size=24, memory=inputs, readout=32)),
    ):
        model = model_of(head)
        model.positions = False
        found = []
        for source in (StepByStep(), Playback()):
            run = scripted(Rollout(model, source), MANY)
            memory = model.initial_state(rows)

            def gradient(run: FreeRun = run, memory: Tensor = memory) -> None:
                run(x0, w[:, :window], memory)[0].square().mean().backward()

            model.requires_grad_(False)
            free = least(partial(run, x0, w, memory), repeats)
            model.head.requires_grad_(True)
            found.append((1e6 * free / steps, 1e3 * least(gradient, repeats)))
        (before, slope_before), (after, slope) = found
        print(
            f"{name}, {rows} rows: {before:.0f} us a step, found ahead {after:.0f} us"
            f" ({before / after:.1f} times less); gradient of {window} steps {slope_before:.1f} ms,"
            f" found ahead {slope:.1f} ms ({slope_before / slope:.1f} times less)"
        )


def compiled_runs(repeats: int) -> None:
    """Print what free runs and their gradient cost as compiled C."""
    steps, window = 200, 40
    for hidden in (24, 100):
        model = model_of(LstmConfig(hidden_size=hidden)).requires_grad_(False)
        model.positions = False
        x0, w = torch.randn(_BATCH, 6), torch.randn(_BATCH, steps, 2)
        memory, told = model.initial_state(_BATCH), []
        with torch.no_grad():
            runs = (scripted(Rollout(model), MANY), CompiledRollout(Rollout(model), x0, w, memory))
            for rows in (1, 64, _BATCH):
                given = (x0[:rows], w[:rows], memory[:rows])
                each = [1e6 * least(partial(run, *given), repeats) / steps for run in runs]
                told.append(f"{rows} rows {each[0]:.0f} us a step, in C {each[1]:.1f} us")
        model.head.requires_grad_(True)
        given = (x0[:64], w[:64, :window], memory[:64])
        found = []
        for run in (scripted(Rollout(model), MANY), CompiledRollout(Rollout(model), *given)):

            def gradient(run: FreeRun = run, given: tuple[Tensor, ...] = given) -> None:
                run(*given)[0].square().mean().backward()

            found.append(1e3 * least(gradient, repeats))
        told.append(f"gradient of {window} steps {found[0]:.1f} ms, in C {found[1]:.1f} ms")
        print(f"compiled, LSTM of {hidden}: {'; '.join(told)}")


def on_gpu(repeats: int) -> None:
    """Print free runs and gradients on one core and on a GPU, by the number of rows."""
    if not torch.cuda.is_available():
        print("device: no GPU on this machine")
        return
    steps, rows = 40, (64, 256, 1_024, 4_096, 16_384, 65_536)
    print(f"device: one core beside {torch.cuda.get_device_name(0)}, {steps} steps")

    def clock() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    for hidden in (24, 100):
        model = model_of(LstmConfig(hidden_size=hidden)).requires_grad_(False)
        model.positions = False
        model.head.requires_grad_(True)
        pays: dict[str, int] = {}
        for count in rows:
            found: dict[str, dict[str, float]] = {}
            for device in ("cpu", "cuda"):
                there = copy.deepcopy(model).to(device)
                given = tuple(
                    one.to(device)
                    for one in (
                        torch.randn(count, 6),
                        torch.randn(count, steps, 2),
                        model.initial_state(count),
                    )
                )
                runner = Rollout(there)
                run: FreeRun = (
                    CompiledRollout(runner, *(one[:64] for one in given))
                    if device == "cpu"
                    else scripted(runner, MANY)
                )

                def gradient(run: FreeRun = run, given: tuple[Tensor, ...] = given) -> None:
                    run(*given)[0].square().mean().backward()

                with torch.no_grad():
                    free = least(partial(run, *given), repeats, clock)
                found[device] = {"free run": free, "gradient": least(gradient, repeats, clock)}
            told = []
            for what, core in found["cpu"].items():
                gpu = found["cuda"][what]
                told.append(f"{what} {1e3 * core:.1f} ms, on the GPU {1e3 * gpu:.1f} ms")
                if gpu < core:
                    pays.setdefault(what, count)
            print(f"device, LSTM of {hidden}, {count} rows: {'; '.join(told)}")
        for what in ("free run", "gradient"):
            at = f"from {pays[what]} rows" if what in pays else f"at none of up to {rows[-1]} rows"
            print(f"device, LSTM of {hidden}: for a {what} the GPU pays {at}")


PARTS = {"rollout": rollouts, "ahead": ahead, "compiled": compiled_runs, "device": on_gpu}


def main() -> None:
    """Print the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    print(f"torch {torch.__version__}, {platform.platform()}, load {os.getloadavg()[0]:.1f}")
    for part in given.parts:
        PARTS[part](given.repeats)


if __name__ == "__main__":
    main()
