"""Time of one step of each export format beside the eager step, side by side on one thread.

    python scripts/bench/export.py [--models plsr mlp lstm] [--rounds 5] [--no-aoti] [--no-cpp]

Prints one table: CPU time of a step, its share of the eager step of the model alone, and the first
call in steady steps and in ms. All formats check their inputs besides, which the model alone does
not. C is timed in a C loop, TorchScript in Python and in C++ (with the executor settings that stand
in its card). All formats take turns, and the quickest of the rounds counts, so that other programs
on the machine disturb the ratios little.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))
import exported_models  # noqa: E402

from residnet.dynamics.c_code import compiler  # noqa: E402
from residnet.export import exporter, vessel  # noqa: E402
from residnet.export.c import CasadiModel  # noqa: E402
from residnet.export.guard import GuardedDynamics  # noqa: E402
from residnet.export.onnx_file import OnnxModel  # noqa: E402
from residnet.export.torchscript import AotiModel  # noqa: E402
from residnet.export.vessel import ExportedVessel  # noqa: E402

SIZES = {"mlp": {"hidden": (64, 64)}, "lstm": {"hidden_size": 64}}
C_LOOP = """#include "boat.h"
#include <stdio.h>
#include <time.h>
static double now(void) { return 1e6 * (double)clock() / CLOCKS_PER_SEC; }
int main(void) {
    mine_real x[6] = {0, 0, 0, 1, 0, 0}, w[4] = {9, 9, 3, 1}, s[MINE_MEMORY + 1], y[6];
    double begun = now(), first; int k;
    mine_initial_state(s);
    mine_step(x, w, s, y, s);
    first = now() - begun;
    begun = now();
    for (k = 0; k < 200000; k++) { mine_step(x, w, s, y, s); x[3] = y[3] > 1 ? 1 : y[3]; }
    printf("%.3f %.6f\\n", first, (now() - begun) / 200000);
    return 0;
}
"""


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
    first, step = (float(part) for part in done.stdout.split())
    return first, step


def c_loop(folder: Path) -> Path:
    """The program that steps the C file in a C loop."""
    (folder / "main.c").write_text(C_LOOP)
    call = [compiler(), "-O3", "-std=c99", "boat.c", "main.c", "-o", "loop", "-lm"]
    subprocess.run(call, cwd=folder, check=True)
    return folder / "loop"


def cpp_program(folder: Path) -> Path:
    """The C++ program that times TorchScript."""
    from torch.utils.cpp_extension import include_paths, library_paths

    out = folder / "cpp_loop"
    libraries = library_paths()
    call = ["g++", "-O2", "-std=c++20", str(ROOT / "scripts/bench/export_loop.cpp"), "-o", str(out)]
    call += [f"-I{path}" for path in include_paths()]
    call += [part for path in libraries for part in (f"-L{path}", f"-Wl,-rpath,{path}")]
    call += [f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"]
    subprocess.run([*call, "-ltorch", "-ltorch_cpu", "-lc10"], check=True)
    return out


Way = Callable[[], tuple[float, float]]
"""Times a format: first call and step in us."""


def ways(variant: str, folder: Path, cpp: Path | None, aoti: bool) -> dict[str, Way]:
    """Return what times each format, eager first."""
    exported_models.VARIANTS[variant] |= SIZES.get(variant, {})
    spec, model = exported_models.built(variant)
    exported = ExportedVessel(spec, model)
    formats = ["torchscript", "c", "onnx", "casadi", *(["aoti"] if aoti else [])]
    files = {}
    for name in formats:
        kind = exporter(name)
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
    out: dict[str, Way] = {
        "eager": lambda: timed(lambda: model.step(x, w, s)),
        "eager, checked inputs": lambda: timed(lambda: guarded.flagged_step(x, w, s)),
        "torchscript, Python": lambda: timed(lambda: scripted.step(x, w, s)),
        "onnxruntime": lambda: timed(lambda: session.run(None, feed)),
        "casadi": lambda: timed(lambda: function(*doubles)),
        "c, C loop": lambda: printed([str(loop)]),
    }
    if cpp is not None:
        program = [str(cpp), str(files["torchscript"]), "4", "400"]
        out["torchscript, C++"] = lambda: printed(program)
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", nargs="+", default=["plsr", "mlp", "lstm"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-aoti", action="store_true")
    parser.add_argument("--no-cpp", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    vessel.PARITY_STEPS = 50
    with tempfile.TemporaryDirectory() as name:
        cpp = None if given.no_cpp else cpp_program(Path(name))
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
