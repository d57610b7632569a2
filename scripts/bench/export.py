"""Time of one step of each export format beside the eager step, side by side on one thread.

    python scripts/bench/export.py [--models plsr mlp lstm] [--rounds 5] [--no-aoti]

Prints one table: CPU time of a step, its share of the eager step of the model alone, and the first
call in steady steps and in ms. All formats check their inputs besides, which the model alone does
not. C is timed in a C loop, TorchScript in Python and in C++ (with the executor settings that stand
in its card). All formats take turns, and the quickest of the rounds counts, so that other programs
on the machine disturb the ratios little.
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
SIZES = {"mlp": {"hidden": (64, 64)}, "lstm": {"hidden_size": 64}}


def timed(step: Callable[[], Any], count: int = 200) -> tuple[float, float]:
    """First call and median step in us of CPU time."""
    taken = []
    for _ in range(count):
        begun = time.thread_time()
        step()
        taken.append(1e6 * (time.thread_time() - begun))
    return taken[0], statistics.median(taken[count // 4 :])


def printed(command: list[str]) -> tuple[float, float]:
    """First call and step in us, as a program prints them."""
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0]), float(done.stdout.split()[1])


def c_loop(folder: Path) -> Path:
    """The program that steps the C file in a C loop."""
    call = [find_compiler(), "-O3", "-std=c99", "-I.", "boat.c", str(HERE / "export_loop.c")]
    subprocess.run([*call, "-o", "loop", "-lm"], cwd=folder, check=True)
    return folder / "loop"


def cpp_program(folder: Path) -> Path:
    """The C++ program that times TorchScript."""
    from torch.utils.cpp_extension import include_paths, library_paths

    out = folder / "cpp_loop"
    libraries = library_paths()
    call = [
        "g++",
        "-O2",
        "-std=c++20",
        str(HERE / "export_loop.cpp"),
        "-o",
        str(out),
    ]
    call += [f"-I{path}" for path in include_paths()]
    call += [part for path in libraries for part in (f"-L{path}", f"-Wl,-rpath,{path}")]
    call += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"]
    subprocess.run([*call, "-ltorch", "-ltorch_cpu", "-lc10"], check=True)
    return out


Way = Callable[[], tuple[float, float]]
"""Times a format: first call and step in us."""


def ways(variant: str, folder: Path, cpp: Path, aoti: bool) -> dict[str, Way]:
    """Return what times each format, eager first."""
    exported_models.VARIANTS[variant] |= SIZES.get(variant, {})
    spec, model = exported_models.built(variant)
    exported = ExportedVessel(spec, model)
    formats = ["torchscript", "c", "onnx", "casadi", *(["aoti"] if aoti else [])]
    files = {}
    for name in formats:
        kind = get_exporter(name)
        files[name] = folder / f"boat{kind.suffix}"
        print(f"  {variant}: {name}", file=sys.stderr, flush=True)
        kind.export(exported, files[name])
    model = model.float()
    x, w = torch.tensor([[0.0, 0, 0, 1, 0, 0]]), torch.tensor([[9.0, 9, 3, 1]])
    s = model.initial_state(1)
    given = [part[0].numpy() for part in (x, w, s)]
    guarded = GuardedDynamics(model, spec).eval()
    scripted = torch.jit.load(str(files["torchscript"]))
    torch._C._jit_set_profiling_executor(False)
    torch._C._set_graph_executor_optimize(False)
    session = OnnxModel(files["onnx"], exported).session
    feed = {name: part.numpy() for name, part in (("x", x), ("w", w), ("s", s))}
    feed = {i.name: feed[i.name] for i in session.get_inputs()}
    function = CasadiModel(files["casadi"]).function
    doubles = [np.asarray(part, dtype=float) for part in given]
    loop = c_loop(folder)
    program = [str(cpp), str(files["torchscript"]), "4", "400"]
    out: dict[str, Way] = {
        "eager": lambda: timed(lambda: model.step(x, w, s)),
        "eager, checked inputs": lambda: timed(lambda: guarded.flagged_step(x, w, s)),
        "torchscript, Python": lambda: timed(lambda: scripted.step(x, w, s)),
        "onnxruntime": lambda: timed(lambda: session.run(None, feed)),
        "casadi": lambda: timed(lambda: function(*doubles)),
        "c, C loop": lambda: printed([str(loop)]),
        "torchscript, C++": lambda: printed(program),
    }
    if aoti:
        package = AotiModel(files["aoti"]).package
        out["aoti"] = lambda: timed(lambda: package(x, w, s))
    return out


def measured(given: dict[str, Way], rounds: int) -> dict[str, tuple[float, float]]:
    """Return the first call and the quickest step of each format, which take turns."""
    out: dict[str, tuple[float, float]] = {}
    for _ in range(rounds):
        for name, way in given.items():
            first, step = way()
            # only the first call of all is a first call
            known = out.get(name, (first, step))
            out[name] = known[0], min(known[1], step)
    return out


def main() -> None:
    given = bench.options(__doc__, models=["plsr", "mlp", "lstm"], rounds=5, no_aoti=False)
    vessel.PARITY_STEPS = 50
    with tempfile.TemporaryDirectory() as name:
        cpp = cpp_program(Path(name))
        head = f"{'model':8}{'format':24}{'step us':>10}{'of eager':>10}{'first call':>14}"
        print(head + f"{'ms':>8}", flush=True)
        for variant in given.models:
            folder = Path(name) / variant
            folder.mkdir()
            timers = ways(variant, folder, cpp, not given.no_aoti)
            with torch.inference_mode():
                found = measured(timers, given.rounds)
            eager = found["eager"][1]
            for kind, (first, step) in found.items():
                print(
                    f"{variant:8}{kind:24}{step:10.2f}{step / eager:10.4f}"
                    f"{first / step:8.0f} steps{first / 1e3:8.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
