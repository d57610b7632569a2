"""Plays the recorded commands of a manoeuvre back through every export format of a model.

    python scripts/bench/playback.py RUN[:MODEL] ... [--seconds 60] [--log NAME] [--no-aoti]
    python scripts/bench/playback.py --fits

A run is the folder of a finished fit; MODEL is one of its models, else the selected one. The inputs
are those of a recorded zigzag of its free runs, or of the longest log where there is none. `--fits`
makes short fits first: a learned WAM-V (PLSR, LSTM and their mean), its equation model, and where
RESIDNET_DATA has the logs KVLCC2 (mmg) and a tanker's LSTM with wind.

Prints, for each format, the largest difference of any state from the model itself as a share of
that state's range: formats in single precision against the model in float32, C in double precision,
CasADi and both kinds of FMU against the model in float64. The exit code is 1 where a difference is
larger than 1e-5 (single) or 1e-12 (double; ONNX 1e-7). A file in double precision alone is played
in double.
"""

from __future__ import annotations

import argparse
import copy
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from residnet.core.errors import ExportError, ResidnetError
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, chosen_model, load_model
from residnet.export import ExportedVessel, exporter, vessel
from residnet.export.aoti import AotiModel
from residnet.export.base import DOUBLE, SINGLE, Loaded
from residnet.export.c import CompiledModel
from residnet.export.c_code import compile_shared, identifier
from residnet.export.casadi_function import CasadiModel
from residnet.export.guard import GuardedDynamics
from residnet.export.onnx_file import OnnxModel
from residnet.export.torchscript import ScriptedModel

ZIGZAG = ("zigzag", "zz", "_z_")
"""Parts of the names of logs that are zigzags."""
DOUBLE_ALONE = "in double precision alone"
"""Said of single precision where the C file has only double."""


@dataclass(frozen=True)
class Recording:
    """What is played back: the state that a log starts from, and its inputs.

    Attributes:
        name: of the log.
        x0: state [6].
        w: inputs [T, m].
        past: measured states [K, 6] that warm the memory up; K may be 0.
        past_w: their inputs [K, m].
    """

    name: str
    x0: np.ndarray
    w: np.ndarray
    past: np.ndarray
    past_w: np.ndarray

    def without_past(self) -> Recording:
        """Return the same with an empty memory, for what cannot be warmed up."""
        return replace(self, past=self.past[:0], past_w=self.past_w[:0])


def recording(run: Path, spec: ModelSpec, seconds: float, log: str) -> Recording:
    """Return the recorded commands of a log of a run's free runs.

    Raises:
        ValueError: where the run's free runs hold no such log, or no inputs.
    """
    files = sorted(run.glob("rollouts/*/*.parquet"))
    named = [file for file in files if file.stem == log] if log else files
    zigzags = [f for f in named if any(word in f.stem.lower() for word in ZIGZAG)]
    if not named:
        raise ValueError(f"{run}: its free runs hold no log '{log}'")
    best: Recording | None = None
    columns = [f"input_{name}" for name in spec.signals.columns]
    for file in zigzags or named:
        table = pd.read_parquet(file)
        missing = [name for name in columns if name not in table]
        if missing:
            raise ValueError(f"{file}: holds no {missing[0]}; run the fit again")
        # windows follow each other; each sample of the log counts once
        once = table.drop_duplicates("t").sort_values("t")
        once = once[np.isfinite(once[[*STATE, *columns]]).all(axis=1)]
        once = once[once["t"] <= once["t"].iloc[0] + seconds]
        if best is None or len(once) > len(best.w) + 1:
            x0 = once[list(STATE)].iloc[0].to_numpy(float)
            inputs = once[columns].to_numpy(float)
            best = Recording(
                file.stem, np.r_[0.0, 0.0, x0[2:]], inputs, np.zeros((0, 6)), inputs[:0]
            )
    assert best is not None
    return best


def eager(
    spec: ModelSpec, model: HybridDynamics, given: Recording, dtype: torch.dtype
) -> np.ndarray:
    """Return the states [T + 1, 6] of the model itself, behind the guard that files have too."""
    guarded = GuardedDynamics(copy.deepcopy(model).to(dtype), spec).to(dtype).eval()
    x, w, past, past_w = (
        torch.tensor(part, dtype=dtype).unsqueeze(0)
        for part in (given.x0, given.w, given.past, given.past_w)
    )
    path = [x]
    with torch.no_grad():
        s = guarded.warmup(past, past_w).to(dtype)
        for k in range(w.shape[1]):
            x, s, _ = guarded.flagged_step(x, w[:, k], s)
            path.append(x)
    return np.asarray(torch.cat(path).numpy())


def played(loaded: Loaded, exported: ExportedVessel, given: Recording, kind: Any) -> np.ndarray:
    """Return the states [T + 1, 6] of a file that has steps."""
    past = given.past.astype(kind), given.past_w.astype(kind)
    x, s = given.x0.astype(kind), exported.memory(loaded, *past, "the file")
    path = [x]
    for w in given.w.astype(kind):
        x, s, _ = loaded.step(x, w, s)
        path.append(x)
    return np.stack(path)


def unit_played(file: Path, spec: ModelSpec, given: Recording) -> np.ndarray:
    """Return the states [T + 1, 6] of a co-simulation unit, stepped by FMPy."""
    import fmpy

    names = spec.signals.columns
    t = spec.dt * np.arange(len(given.w) + 1)
    signal = np.zeros(len(t), dtype=[("time", float), *((name, float) for name in names)])
    signal["time"] = t
    for column, name in enumerate(names):
        signal[name] = np.r_[given.w[:, column], given.w[-1, column]]
    start = {f"{name}_start": float(v) for name, v in zip(STATE, given.x0, strict=True)}
    table = fmpy.simulate_fmu(
        str(file), stop_time=float(t[-1]), step_size=spec.dt, output_interval=spec.dt,
        start_values=start, input=signal, output=list(STATE),
    )  # fmt: skip
    return np.stack([table[name] for name in STATE], axis=1)


def scripted(file: Path) -> ScriptedModel:
    return ScriptedModel(torch.jit.load(str(file)), torch.float32)


def compiled(file: Path, folder: Path, exported: ExportedVessel, double: bool) -> CompiledModel:
    flags = [f"-D{identifier(exported.name).upper()}_DOUBLE"] if double else []
    library = compile_shared([file], folder / f"{double}.so", flags)
    return CompiledModel(library, exported, torch.float64 if double else torch.float32)


@dataclass(frozen=True)
class Found:
    """How a format did: its worst share of a state's range, or why it refuses.

    Attributes:
        way: format and precision.
        refused: the one line that says why, or empty.
        share: largest difference, as a share of the state's range.
        state: that has it.
        allowed: largest share.
    """

    way: str
    refused: str = ""
    share: float = 0.0
    state: str = ""
    allowed: float = 0.0

    @property
    def bad(self) -> bool:
        """Whether the difference is too large."""
        return not self.refused and not self.share <= self.allowed


def shares(
    spec: ModelSpec, model: HybridDynamics, given: Recording, aoti: bool, folder: Path
) -> Iterator[Found]:
    """Yield how each format does; `folder` is left with the files of formats that do not refuse."""
    wanted: dict[tuple[str, bool], np.ndarray] = {}
    cards: dict[str, Any] = {}
    exported = ExportedVessel(spec, model)

    def written(kind: str) -> Path:
        found = exporter(kind)
        file = folder / kind / f"boat{found.suffix}"
        if kind not in cards:
            file.parent.mkdir(exist_ok=True)
            cards[kind] = found.export(exported, file)
        return file

    def precision(kind: str) -> Any:
        return np.float64 if cards[kind]["dtype"] == "float64" else np.float32

    def in_c(double: bool) -> np.ndarray:
        file = written("c")
        if not double and precision("c") is np.float64:
            raise ExportError(DOUBLE_ALONE)
        stepped = compiled(file, folder, exported, double)
        return played(stepped, exported, given, np.float64 if double else np.float32)

    def in_aoti() -> np.ndarray:
        file, kind = written("aoti"), precision("aoti")
        dtype = torch.float64 if kind is np.float64 else torch.float32
        return played(AotiModel(file, dtype), exported, given, kind)

    # a unit begins without a past
    ways: dict[str, tuple[bool, Callable[[], np.ndarray]]] = {
        "torchscript": (
            True, lambda: played(scripted(written("torchscript")), exported, given, np.float32),
        ),
        "onnx": (
            True,
            lambda: played(
                OnnxModel(written("onnx"), exported), exported, given, precision("onnx")
            ),
        ),
        "c, single": (True, lambda: in_c(False)),
        "c, double": (True, lambda: in_c(True)),
        "casadi": (
            True, lambda: played(CasadiModel(written("casadi")), exported, given, np.float64),
        ),
        "fmu": (False, lambda: unit_played(written("fmu"), spec, given)),
        "fmu2": (False, lambda: unit_played(written("fmu2"), spec, given)),
    }  # fmt: skip
    if aoti:
        ways["aoti"] = (True, in_aoti)
    for way, (warm, play) in ways.items():
        try:
            states = play()
        except ResidnetError as error:
            yield Found(way, str(error))
            continue
        single = states.dtype == np.float32
        key = states.dtype.name, warm
        if key not in wanted:
            log = given if warm else given.without_past()
            wanted[key] = eager(spec, model, log, torch.float32 if single else torch.float64)
        apart = np.abs(states - wanted[key]).max(axis=0)
        apart /= np.maximum(np.ptp(wanted[key], axis=0), 1e-6)
        worst = int(apart.argmax())
        allowed = SINGLE if single else 1e-7 if way == "onnx" else DOUBLE
        yield Found(way, "", float(apart[worst]), STATE[worst], allowed)


def fits(folder: Path) -> list[str]:
    """Make short fits of the five models; returns what is played back of them."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "ci"))
    import short_configs
    from short_configs import Short

    mean = ("heads={plsr: {kind: plsr}, lstm: {kind: lstm, hidden_size: 8}}", "~training.mlp")
    short_configs.LIMIT = 1800
    short_configs.SHORT["quickstart"] = Short(
        (*short_configs.SHORT["quickstart"].overrides[:3], *short_configs._trained("lstm"), *mean,
         "ensembles={mean: [plsr, lstm]}")
    )  # fmt: skip
    wanted = {
        "quickstart": ("plsr", "lstm", "mean"),
        "wam_v_equations": ("residual",),
        "kvlcc2": ("mmg",),
        "esso_osaka": ("lstm",),
    }
    runs = []
    for name, models in wanted.items():
        result = short_configs.carry_out(name, folder)
        print(result.line(), file=sys.stderr, flush=True)
        if result.state == "ok":
            runs += [f"{folder / name}:{model}" for model in models]
    return runs


def main(arguments: Sequence[str]) -> int:
    """Print the table; return 1 where a format differs by more than it may."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("runs", nargs="*", metavar="RUN[:MODEL]")
    parser.add_argument("--fits", action="store_true", help="make short fits first")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--log", default="", help="name of the log; a zigzag where not given")
    parser.add_argument("--no-aoti", action="store_true")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    # the playback is the longer check
    vessel.PARITY_STEPS = 50
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        runs = [*given.runs, *(fits(Path(name)) if given.fits else [])]
        print(f"{'run: model':44}{'log':38} {'format':13}{'share of range':>15}  state")
        for entry in runs:
            place, _, model_name = entry.partition(":")
            run = Path(place)
            spec, model = load_model(run / "models" / chosen_model(run, model_name or "selected"))
            log = recording(run, spec, given.seconds, given.log)
            head = f"{run.name + ': ' + spec.name:44}{log.name:38} "
            with tempfile.TemporaryDirectory() as written:
                for found in shares(spec, model, log, not given.no_aoti, Path(written)):
                    wrong += found.bad
                    much = "  TOO MUCH" if found.bad else ""
                    said = f"{found.share:15.2e}  {found.state}{much}"
                    said = f" refused: {found.refused}" if found.refused else said
                    print(f"{head}{found.way:13}{said}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except (ResidnetError, ValueError) as error:
        sys.exit(f"playback.py: {error}")
