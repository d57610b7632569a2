"""Time free runs, their gradients, an epoch of training and a refit, side by side with others.

- `rollout`: an LSTM on a linear baseline, 200 steps by RK4 at batch 1,024 in single precision,
  compiled and as it is, against the matrix products of its network alone.
- `compiled`: free runs and gradients of 40 steps of 1, 64 and 1,024 rows by LSTMs on a linear
  baseline: as compiled C against TorchScript.
- `device`: the same as compiled C on one core beside TorchScript on a GPU, by the number of rows.
  Left out where there is none.
- `epoch`: 25 teacher-forced batches of 64 windows of 100 samples for an LSTM, with gradients and
  optimiser, against a DataLoader that collates windows and a cell that is stepped.
- `refit`: ten terms in each of three axes, refitted to 12 logs of 100 s at 10 Hz of a boat with
  quadratic damping, through free runs of 20 s that start every 10 s. scipy minimises the same
  errors with the same prior from the same start, by differences of free runs. A first refit may
  compile the free run.

Times are CPU seconds of this process, the least of `--repeats`, so that a busy machine matters
little; one thread, with the memory settings of a run (`keep_freed_memory`). Those of `device` are
by the clock, since a GPU does not count in the former; those of `refit` count the compiler.

    python scripts/bench/rollout.py [--parts rollout compiled device epoch refit]
        [--repeats 5]
"""

from __future__ import annotations

import copy
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import islice

import bench
import large_data
import numpy as np
import torch
from bench import least
from scipy.optimize import least_squares
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.columns import all_but_pose
from residnet.core.processes import retain_freed_memory
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.compiled import CompiledRollout
from residnet.engine.rollout import TRAINING_STEPS, FreeRun, Rollout, trace_rollout
from residnet.heads.base import ZeroHead
from residnet.heads.lstm_config import LstmConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowSampler, WindowStore
from residnet.training.refit import build_problem, refit, simulate
from residnet.training.refit_config import RefitConfig

NAMES = ("u", "v", "r", "tau_x", "tau_n")
_BATCH = 1_024
_STEPS = 200
_SLOPE = 40
_WINDOW = 100
_WINDOWS = 64
_BATCHES = 25
_INPUTS = ("n_port", "n_stbd")
_TERMS = (
    *("u", "v", "r", "u|u|", "v|v|", "r|r|", "u r", "u v"),
    *("n_port|n_port|", "n_stbd|n_stbd|"),
)
Clock = Callable[[], float]
Way = Callable[[Rollout, tuple[Tensor, ...]], FreeRun]
_SCALES = torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64)


def model_of(head: LstmConfig) -> HybridDynamics:
    """Return a head on a linear baseline, without positions."""
    torch.manual_seed(0)
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    baseline = RegressorBaseline([NAMES] * 3, signals.names)
    baseline.theta.data.copy_(-0.5 * torch.eye(3, 5))
    built = head.build(NAMES)
    model = HybridDynamics(signals, baseline, built, 0.05).to(torch.float32).eval()
    model.has_position = False
    model.requires_grad_(False).head.requires_grad_(True)
    return model


def timed(
    run: FreeRun, given: tuple[Tensor, ...], repeats: int, clock: Clock = time.process_time
) -> tuple[float, float]:
    """Return the least times of a free run in us a step, and of a gradient of 40 steps in ms."""
    x0, w, memory = given

    def gradient() -> None:
        run(x0, w[:, :_SLOPE], memory)[0].square().mean().backward()

    with torch.no_grad():
        free = least(partial(run, *given), repeats, clock)
    return 1e6 * free / w.shape[1], 1e3 * least(gradient, repeats, clock)


def _products(f: Tensor, h: Tensor, a: Tensor, b: Tensor, o: Tensor) -> None:
    for _ in range(_STEPS):
        f @ a
        h @ b
        h @ o


def rollouts(repeats: int) -> None:
    """Print the share of the matrix products in a rollout."""
    x0, w = torch.zeros(_BATCH, 6), torch.randn(_BATCH, _STEPS, 2)
    for hidden in (100, 24):
        model = model_of(LstmConfig(hidden_size=hidden, readout=0))
        sizes = ((_BATCH, 5), (_BATCH, hidden), (5, 4 * hidden), (hidden, 4 * hidden), (hidden, 3))
        factors = [torch.randn(size) for size in sizes]
        with torch.no_grad():
            bound = least(partial(_products, *factors), repeats)
            for how, run in (
                ("compiled", trace_rollout(Rollout(model), _STEPS)),
                ("not compiled", Rollout(model)),
            ):
                memory = model.initial_state(_BATCH)
                whole = least(partial(run, x0, w, memory), repeats)
                print(
                    f"rollout, LSTM of {hidden}, batch {_BATCH}, {how}:"
                    f" {1e6 * whole / _STEPS:.0f} us a step,"
                    f" products alone {1e6 * bound / _STEPS:.0f} us: {100 * bound / whole:.0f} %"
                )


WAYS: dict[str, Way] = {
    "TorchScript": lambda roll, given: trace_rollout(roll, TRAINING_STEPS),
    "C": lambda roll, given: CompiledRollout(roll, *(one[:64] for one in given)),
}


def by_rows(
    rows: tuple[int, ...],
    steps: int,
    ways: dict[str, str],
    repeats: int,
    clock: Clock = time.process_time,
) -> None:
    """Print free runs and gradients in several ways, each on its device."""
    for hidden in (24, 100):
        model = model_of(LstmConfig(hidden_size=hidden, readout=0))
        for count in rows:
            told = []
            for name, device in ways.items():
                there = copy.deepcopy(model).to(device)
                given = (torch.randn(count, 6), torch.randn(count, steps, 2))
                x0, w, memory = (one.to(device) for one in (*given, model.initial_state(count)))
                run = WAYS[name](Rollout(there), (x0, w, memory))
                free, slope = timed(run, (x0, w, memory), repeats, clock)
                told.append(
                    f"{name} on {device} {free:.1f} us a step, {1e-3 * free * steps:.1f} ms for"
                    f" {steps}, gradient of {_SLOPE} steps {slope:.1f} ms"
                )
            print(f"LSTM of {hidden}, {count} rows: {'; '.join(told)}", flush=True)


def compiled_runs(repeats: int) -> None:
    """Print what free runs and their gradient cost as compiled C."""
    by_rows((1, 64, _BATCH), _STEPS, {"TorchScript": "cpu", "C": "cpu"}, repeats)


def on_gpu(repeats: int) -> None:
    """Print free runs and gradients on one core and on a GPU, by the number of rows."""
    if not torch.cuda.is_available():
        print("device: no GPU on this machine")
        return

    def clock() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    print(torch.cuda.get_device_name(0))
    rows = (64, 256, 1_024, 4_096, 16_384, 65_536)
    by_rows(rows, _SLOPE, {"C": "cpu", "TorchScript": "cuda"}, repeats, clock)


def _epoch(
    batches: Callable[[], Iterable[Sequence[Tensor]]],
    predict: Callable[[Tensor], Tensor],
    optimiser: torch.optim.Optimizer,
) -> None:
    for seen, truth in batches():
        loss = (truth - predict(seen)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def epochs(repeats: int) -> None:
    """Print how much faster an epoch is than by data loader and loop."""
    random = np.random.default_rng(0)
    data = [
        torch.from_numpy(random.normal(size=(50_000, width)).astype(np.float32)) for width in (5, 3)
    ]
    starts = WindowSampler(torch.arange(len(data[0]) - _WINDOW), _WINDOWS, _BATCHES)
    unfolded = (part.unfold(0, _WINDOW, 1).transpose(1, 2) for part in data)
    loader = DataLoader(TensorDataset(*unfolded), batch_size=_WINDOWS, shuffle=True)

    def windows() -> Iterator[list[Tensor]]:
        for first in starts.draw_epoch(0, 0):
            rows = (first[:, None] + torch.arange(_WINDOW)).reshape(-1)
            yield [part.index_select(0, rows).unflatten(0, (_WINDOWS, _WINDOW)) for part in data]

    def stepped(cell: nn.LSTMCell, out: nn.Linear, seen: Tensor) -> Tensor:
        state = None
        found = []
        for k in range(_WINDOW):
            state = cell(seen[:, k], state)
            found.append(out(state[0]))
        return torch.stack(found, dim=1)

    for hidden in (24, 100):
        head = LstmConfig(hidden_size=hidden).build(NAMES).to(torch.float32).train()
        ours = torch.optim.AdamW(head.parameters())
        cell = nn.LSTMCell(5, hidden)
        out = nn.Linear(hidden, 3)
        usual = torch.optim.AdamW([*cell.parameters(), *out.parameters()])
        own = least(partial(_epoch, windows, head.teacher_forced_residuals, ours), repeats)
        batches = partial(islice, loader, _BATCHES)
        other = least(partial(_epoch, batches, partial(stepped, cell, out), usual), repeats)
        print(
            f"epoch of {_BATCHES} batches, LSTM of {hidden}: {own:.3f} s, by data loader and loop"
            f" {other:.3f} s: {other / own:.1f} times"
        )


def spent() -> float:
    """Return the processor time of this process and of the compilers that it has called, s."""
    return sum(os.times()[:4])


def refits(repeats: int) -> None:
    """Print the times of refits and of scipy's, and the errors that they reach."""
    settings = {
        "grid": {"step": f"{large_data.STEP} s", "held": [*_INPUTS]},
        "derivative": {"kind": "savitzky_golay", "window": "1.1 s", "order": 2},
    }
    config = PrepareConfig.model_validate(settings)
    signals = SignalsConfig(inputs=_INPUTS)
    flown = large_data.simulate(12, 1_000, 1)
    logs = [prepare_log(log, "train", signals.input_columns, config) for log in flown]
    built = signals.build()
    baseline = RegressorBaseline([_TERMS] * 3, built.names)
    model = HybridDynamics(built, baseline, ZeroHead(built.names), large_data.STEP, "rk4")
    model.has_position = False
    known = make_samples(logs, built)
    RegressorsConfig(terms=_TERMS).fit_preferred(baseline, known)
    store = WindowStore.from_logs(logs, torch.float64)
    plan = RefitConfig(horizon=20.0, every=10.0)
    start = baseline.get_free()
    problem = build_problem(model, known, store, plan, _SCALES)
    windows, steps = problem.inputs.shape[:2]
    found = []
    for _ in range(1 + repeats):
        baseline.set_free(start)
        begun = spent()
        notes = refit(model, known, store, plan, _SCALES).notes
        found.append(spent() - begun)
    print(
        f"refit of {len(problem.free)} parameters, {windows} windows of {steps} steps: first"
        f" {found[0]:.2f} s, then {min(found[1:]):.2f} s, {notes['iterations']} iterations, cost"
        f" {notes['cost_before']:.6f} -> {notes['cost_after']:.9f}"
    )
    root = np.linalg.cholesky(problem.precision.numpy()).T
    each = np.sqrt(problem.measured.numel())

    def errors(values: np.ndarray) -> np.ndarray:
        baseline.set_free(torch.from_numpy(values))
        flown = Rollout(model)(problem.x0, problem.inputs, problem.x0[:, :0])[0]
        error = (all_but_pose(flown[:, 1:]) - problem.measured) * problem.weight / each
        return np.append(error.numpy().ravel(), root @ (values - problem.prior_mean.numpy()))

    begun = spent()
    best = least_squares(errors, problem.prior_mean.numpy(), method="lm", x_scale="jac", xtol=1e-4)
    taken = spent() - begun
    baseline.set_free(torch.from_numpy(best.x))
    level = simulate(model, problem)[0]
    print(f"scipy: {taken:.2f} s, {best.nfev} free runs, cost {level:.9f}")


PARTS = {
    "rollout": rollouts,
    "compiled": compiled_runs,
    "device": on_gpu,
    "epoch": epochs,
    "refit": refits,
}


def main() -> None:
    """Print the parts that were asked for."""
    given = bench.options(__doc__, parts=PARTS, repeats=5)
    retain_freed_memory()
    print(f"torch {torch.__version__}, {platform.platform()}, load {os.getloadavg()[0]:.1f}")
    for part in given.parts:
        PARTS[part](given.repeats)


if __name__ == "__main__":
    main()
