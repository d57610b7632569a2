"""Time a step of each export format and of the eager model, on one thread.

    python scripts/bench/export.py [--models plsr mlp lstm] [--rounds 5] [--no-aoti]

Prints one table: CPU time of a step, its share of the eager step of the model alone, and the first
call in steps and in ms. All formats also check their inputs, which the model alone does not. C is
timed in a C loop, TorchScript in Python and in C++ (with the executor settings of its card). The
formats are timed in turn, and the fastest of the rounds is used, so that other programs on the
machine have little effect on the ratios.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench
import exported_models
import numpy as np
import torch

from residnet.engine.c_code import find_compiler
from residnet.export import get_exporter, vessel
from residnet.export.c import CasadiModel
from residnet.export.guard import GuardedDynamics
from residnet.export.onnx_file import OnnxModel
from residnet.export.torchscript import AotiModel
from residnet.export.vessel import ExportedVessel

HERE = Path(__file__).parent
SIZES = {
    "mlp": {"hidden": (64, 64), "skip": "none"},
    "lstm": {"hidden_size": 64, "skip": "none"},
}


def time_step(step: Callable[[], Any], count: int = 200) -> tuple[float, float]:
    """Return the first call and the median step in us of processor time."""
    times = []
    for _ in range(count):
        start_time = time.thread_time()
        step()
        times.append(1e6 * (time.thread_time() - start_time))
    return times[0], statistics.median(times[count // 4 :])


def run_timer_program(command: list[str]) -> tuple[float, float]:
    """Run a program that prints the first call and the step in us; return these."""
    completed = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(completed.stdout.split()[0]), float(completed.stdout.split()[1])


def build_c_loop(folder: Path) -> Path:
    """Build the program that calls the step of the C file in a loop."""
    call = [find_compiler(), "-O3", "-std=c99", "-I.", "boat.c", str(HERE / "export_loop.c")]
    subprocess.run([*call, "-o", "loop", "-lm"], cwd=folder, check=True)
    return folder / "loop"


def build_cpp_loop(folder: Path) -> Path:
    """Build the C++ program that times TorchScript."""
    from torch.utils.cpp_extension import include_paths, library_paths

    program = folder / "cpp_loop"
    libraries = library_paths()
    call = [
        "g++",
        "-O2",
        "-std=c++20",
        str(HERE / "export_loop.cpp"),
        "-o",
        str(program),
    ]
    call += [f"-I{path}" for path in include_paths()]
    call += [part for path in libraries for part in (f"-L{path}", f"-Wl,-rpath,{path}")]
    call += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"]
    subprocess.run([*call, "-ltorch", "-ltorch_cpu", "-lc10"], check=True)
    return program


Timer = Callable[[], tuple[float, float]]
"""Times a format: first call and step in us."""


def build_timers(variant: str, folder: Path, cpp: Path, aoti: bool) -> dict[str, Timer]:
    """Return the timer of each format, the eager model first."""
    exported_models.VARIANTS[variant] |= SIZES.get(variant, {})
    spec, model = exported_models.built(variant)
    exported = ExportedVessel(spec, model)
    formats = ["torchscript", "c", "onnx", "casadi", *(["aoti"] if aoti else [])]
    files = {}
    for name in formats:
        exporter = get_exporter(name)
        files[name] = folder / f"boat{exporter.suffix}"
        print(f"  {variant}: {name}", file=sys.stderr, flush=True)
        exporter.export(exported, files[name])
    model = model.float()
    x, w = torch.tensor([[0.0, 0, 0, 1, 0, 0]]), torch.tensor([[9.0, 9, 3, 1]])
    s = model.initial_state(1)
    arrays = [part[0].numpy() for part in (x, w, s)]
    guarded = GuardedDynamics(model, spec).eval()
    scripted = torch.jit.load(str(files["torchscript"]))
    torch._C._jit_set_profiling_executor(False)
    torch._C._set_graph_executor_optimize(False)
    session = OnnxModel(files["onnx"], exported).session
    feed = {name: part.numpy() for name, part in (("x", x), ("w", w), ("s", s))}
    feed = {i.name: feed[i.name] for i in session.get_inputs()}
    function = CasadiModel(files["casadi"]).function
    doubles = [np.asarray(part, dtype=float) for part in arrays]
    loop = build_c_loop(folder)
    program = [str(cpp), str(files["torchscript"]), "4", "400"]
    timers: dict[str, Timer] = {
        "eager": lambda: time_step(lambda: model.step(x, w, s)),
        "eager, checked inputs": lambda: time_step(lambda: guarded.flagged_step(x, w, s)),
        "torchscript, Python": lambda: time_step(lambda: scripted.step(x, w, s)),
        "onnxruntime": lambda: time_step(lambda: session.run(None, feed)),
        "casadi": lambda: time_step(lambda: function(*doubles)),
        "c, C loop": lambda: run_timer_program([str(loop)]),
        "torchscript, C++": lambda: run_timer_program(program),
    }
    if aoti:
        package = AotiModel(files["aoti"]).package
        timers["aoti"] = lambda: time_step(lambda: package(x, w, s))
    return timers


def run_timers(timers: dict[str, Timer], rounds: int) -> dict[str, tuple[float, float]]:
    """Return the first call and the fastest step of each format, timed in turn."""
    times: dict[str, tuple[float, float]] = {}
    for _ in range(rounds):
        for name, timer in timers.items():
            first, step = timer()
            # only the first call of all is a first call
            previous = times.get(name, (first, step))
            times[name] = previous[0], min(previous[1], step)
    return times


def main() -> None:
    options = bench.options(__doc__, models=["plsr", "mlp", "lstm"], rounds=5, no_aoti=False)
    vessel.PARITY_STEPS = 50
    with tempfile.TemporaryDirectory() as name:
        cpp = build_cpp_loop(Path(name))
        head = f"{'model':8}{'format':24}{'step us':>10}{'of eager':>10}{'first call':>14}"
        print(head + f"{'ms':>8}", flush=True)
        for variant in options.models:
            folder = Path(name) / variant
            folder.mkdir()
            timers = build_timers(variant, folder, cpp, not options.no_aoti)
            with torch.inference_mode():
                times = run_timers(timers, options.rounds)
            eager = times["eager"][1]
            for file_format, (first, step) in times.items():
                print(
                    f"{variant:8}{file_format:24}{step:10.2f}{step / eager:10.4f}"
                    f"{first / step:8.0f} steps{first / 1e3:8.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
