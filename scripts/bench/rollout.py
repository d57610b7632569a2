"""Time free runs, their gradients, an epoch of training and a refit, compared with references.

- `rollout`: an LSTM on a linear baseline, 200 steps by RK4 at batch 1,024 in single precision,
  compiled and not compiled, and the matrix products of its network alone.
- `compiled`: free runs and gradients of 40 steps of 1, 64 and 1,024 rows by LSTMs on a linear
  baseline: as compiled C against TorchScript.
- `device`: the same as compiled C on one core and as TorchScript on a GPU, by the number of rows.
  Omitted without a GPU.
- `epoch`: 25 teacher-forced batches of 64 windows of 100 samples for an LSTM, with gradients and
  optimiser; reference: a DataLoader that collates windows, and a loop over the steps of a cell.
- `refit`: ten terms in each of three axes, refitted to 12 logs of 100 s at 10 Hz of a boat with
  quadratic damping, by free runs of 20 s that start every 10 s. As a reference scipy minimises the
  same errors with the same prior from the same start, with finite differences. The first refit may
  compile the free run.

Times are processor seconds of this process, the smallest of `--repeats`, because the machine may be
busy; one thread, with the memory settings of a run (`retain_freed_memory`). Times of `device` are
by the clock, because processor time does not include a GPU; those of `refit` include the compiler.

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
RunBuilder = Callable[[Rollout, tuple[Tensor, ...]], FreeRun]
_SCALES = torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64)


def make_model(head: LstmConfig) -> HybridDynamics:
    """Return a model of a head and a linear baseline, without positions."""
    torch.manual_seed(0)
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    baseline = RegressorBaseline([NAMES] * 3, signals.names)
    baseline.theta.data.copy_(-0.5 * torch.eye(3, 5))
    built_head = head.build(NAMES)
    model = HybridDynamics(signals, baseline, built_head, 0.05).to(torch.float32).eval()
    model.has_position = False
    model.requires_grad_(False).head.requires_grad_(True)
    return model


def time_run(
    run: FreeRun, arguments: tuple[Tensor, ...], repeats: int, clock: Clock = time.process_time
) -> tuple[float, float]:
    """Return the smallest times of a free run (us per step) and of a gradient of 40 steps (ms)."""
    x0, w, memory = arguments

    def gradient() -> None:
        run(x0, w[:, :_SLOPE], memory)[0].square().mean().backward()

    with torch.no_grad():
        seconds = least(partial(run, *arguments), repeats, clock)
    return 1e6 * seconds / w.shape[1], 1e3 * least(gradient, repeats, clock)


def _products(f: Tensor, h: Tensor, a: Tensor, b: Tensor, o: Tensor) -> None:
    for _ in range(_STEPS):
        f @ a
        h @ b
        h @ o


def print_rollouts(repeats: int) -> None:
    """Print the share of the matrix products in a rollout."""
    x0, w = torch.zeros(_BATCH, 6), torch.randn(_BATCH, _STEPS, 2)
    for hidden in (100, 24):
        model = make_model(LstmConfig(hidden_size=hidden, readout=0, skip="none"))
        sizes = ((_BATCH, 5), (_BATCH, hidden), (5, 4 * hidden), (hidden, 4 * hidden), (hidden, 3))
        factors = [torch.randn(size) for size in sizes]
        with torch.no_grad():
            product_seconds = least(partial(_products, *factors), repeats)
            for label, run in (
                ("compiled", trace_rollout(Rollout(model), _STEPS)),
                ("not compiled", Rollout(model)),
            ):
                memory = model.initial_state(_BATCH)
                seconds = least(partial(run, x0, w, memory), repeats)
                print(
                    f"rollout, LSTM of {hidden}, batch {_BATCH}, {label}:"
                    f" {1e6 * seconds / _STEPS:.0f} us a step,"
                    f" products alone {1e6 * product_seconds / _STEPS:.0f} us:"
                    f" {100 * product_seconds / seconds:.0f} %"
                )


RUN_BUILDERS: dict[str, RunBuilder] = {
    "TorchScript": lambda roll, given: trace_rollout(roll, TRAINING_STEPS),
    "C": lambda roll, given: CompiledRollout(roll, *(one[:64] for one in given)),
}


def print_by_rows(
    rows: tuple[int, ...],
    steps: int,
    device_of_way: dict[str, str],
    repeats: int,
    clock: Clock = time.process_time,
) -> None:
    """Print times of free runs and gradients by number of rows, each on its device."""
    for hidden in (24, 100):
        model = make_model(LstmConfig(hidden_size=hidden, readout=0, skip="none"))
        for count in rows:
            texts = []
            for name, device in device_of_way.items():
                device_model = copy.deepcopy(model).to(device)
                arguments = (torch.randn(count, 6), torch.randn(count, steps, 2))
                x0, w, memory = (
                    tensor.to(device) for tensor in (*arguments, model.initial_state(count))
                )
                run = RUN_BUILDERS[name](Rollout(device_model), (x0, w, memory))
                step_us, gradient_ms = time_run(run, (x0, w, memory), repeats, clock)
                texts.append(
                    f"{name} on {device} {step_us:.1f} us a step,"
                    f" {1e-3 * step_us * steps:.1f} ms for {steps}, gradient of"
                    f" {_SLOPE} steps {gradient_ms:.1f} ms"
                )
            print(f"LSTM of {hidden}, {count} rows: {'; '.join(texts)}", flush=True)


def print_compiled_runs(repeats: int) -> None:
    """Print times of free runs and their gradient as compiled C and TorchScript."""
    print_by_rows((1, 64, _BATCH), _STEPS, {"TorchScript": "cpu", "C": "cpu"}, repeats)


def print_gpu_runs(repeats: int) -> None:
    """Print times of free runs and gradients on one core and on a GPU, by number of rows."""
    if not torch.cuda.is_available():
        print("device: no GPU on this machine")
        return

    def clock() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    print(torch.cuda.get_device_name(0))
    rows = (64, 256, 1_024, 4_096, 16_384, 65_536)
    print_by_rows(rows, _SLOPE, {"C": "cpu", "TorchScript": "cuda"}, repeats, clock)


def _epoch(
    batches: Callable[[], Iterable[Sequence[Tensor]]],
    predict: Callable[[Tensor], Tensor],
    optimiser: torch.optim.Optimizer,
) -> None:
    for inputs, targets in batches():
        loss = (targets - predict(inputs)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def print_epochs(repeats: int) -> None:
    """Print the time of an epoch, and that with a data loader and a loop."""
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

    def predict_stepwise(cell: nn.LSTMCell, readout: nn.Linear, inputs: Tensor) -> Tensor:
        state = None
        outputs = []
        for k in range(_WINDOW):
            state = cell(inputs[:, k], state)
            outputs.append(readout(state[0]))
        return torch.stack(outputs, dim=1)

    for hidden in (24, 100):
        head = LstmConfig(hidden_size=hidden, skip="none").build(NAMES).to(torch.float32).train()
        optimiser = torch.optim.AdamW(head.parameters())
        cell = nn.LSTMCell(5, hidden)
        readout = nn.Linear(hidden, 3)
        loop_optimiser = torch.optim.AdamW([*cell.parameters(), *readout.parameters()])
        seconds = least(partial(_epoch, windows, head.teacher_forced_residuals, optimiser), repeats)
        batches = partial(islice, loader, _BATCHES)
        loop_seconds = least(
            partial(_epoch, batches, partial(predict_stepwise, cell, readout), loop_optimiser),
            repeats,
        )
        print(
            f"epoch of {_BATCHES} batches, LSTM of {hidden}: {seconds:.3f} s, by data loader and"
            f" loop {loop_seconds:.3f} s: {loop_seconds / seconds:.1f} times"
        )


def processor_time() -> float:
    """Return the processor time in s of this process and of the compilers that it called."""
    return sum(os.times()[:4])


def print_refits(repeats: int) -> None:
    """Print times and final errors of refits by residnet and by scipy."""
    settings = {
        "grid": {"step": f"{large_data.STEP} s", "held": [*_INPUTS]},
        "derivative": {"kind": "savitzky_golay", "window": "1.1 s", "order": 2},
    }
    config = PrepareConfig.model_validate(settings)
    signals = SignalsConfig(inputs=_INPUTS)
    simulated_logs = large_data.simulate(12, 1_000, 1)
    logs = [prepare_log(log, "train", signals.input_columns, config) for log in simulated_logs]
    built_signals = signals.build()
    baseline = RegressorBaseline([_TERMS] * 3, built_signals.names)
    model = HybridDynamics(
        built_signals, baseline, ZeroHead(built_signals.names), large_data.STEP, "rk4"
    )
    model.has_position = False
    samples = make_samples(logs, built_signals)
    RegressorsConfig(terms=_TERMS).fit_preferred(baseline, samples)
    store = WindowStore.from_logs(logs, torch.float64)
    refit_config = RefitConfig(horizon=20.0, every=10.0)
    start = baseline.get_free()
    problem = build_problem(model, samples, store, refit_config, _SCALES)
    windows, steps = problem.inputs.shape[:2]
    refit_seconds = []
    for _ in range(1 + repeats):
        baseline.set_free(start)
        start_time = processor_time()
        notes = refit(model, samples, store, refit_config, _SCALES).notes
        refit_seconds.append(processor_time() - start_time)
    print(
        f"refit of {len(problem.free)} parameters, {windows} windows of {steps} steps: first"
        f" {refit_seconds[0]:.2f} s, then {min(refit_seconds[1:]):.2f} s,"
        f" {notes['iterations']} iterations, cost {notes['cost_before']:.6f} ->"
        f" {notes['cost_after']:.9f}"
    )
    root_precision = np.linalg.cholesky(problem.precision.numpy()).T
    residual_scale = np.sqrt(problem.measured.numel())

    def errors(values: np.ndarray) -> np.ndarray:
        baseline.set_free(torch.from_numpy(values))
        simulated_logs = Rollout(model)(problem.x0, problem.inputs, problem.x0[:, :0])[0]
        error = (
            (all_but_pose(simulated_logs[:, 1:]) - problem.measured)
            * problem.weight
            / residual_scale
        )
        return np.append(
            error.numpy().ravel(), root_precision @ (values - problem.prior_mean.numpy())
        )

    start_time = processor_time()
    solution = least_squares(
        errors, problem.prior_mean.numpy(), method="lm", x_scale="jac", xtol=1e-4
    )
    seconds = processor_time() - start_time
    baseline.set_free(torch.from_numpy(solution.x))
    cost = simulate(model, problem)[0]
    print(f"scipy: {seconds:.2f} s, {solution.nfev} free runs, cost {cost:.9f}")


PARTS = {
    "rollout": print_rollouts,
    "compiled": print_compiled_runs,
    "device": print_gpu_runs,
    "epoch": print_epochs,
    "refit": print_refits,
}


def main() -> None:
    """Print the selected parts."""
    options = bench.options(__doc__, parts=PARTS, repeats=5)
    retain_freed_memory()
    print(f"torch {torch.__version__}, {platform.platform()}, load {os.getloadavg()[0]:.1f}")
    for part in options.parts:
        PARTS[part](options.repeats)


if __name__ == "__main__":
    main()
