"""What the scripts of this folder share: options, one thread, times, simulated trials and vessels.

It is imported before anything that counts the cores.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
sys.path.insert(0, str(ROOT / "tests" / "support"))

SIGNALS: dict[str, dict[str, Any]] = {
    "wam_v_cal": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "wam_v_vrx": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_vrx"},
    "example_rudder_boat": {"inputs": ["n", "delta"]},
    "milliampere": {"inputs": ["tau_x", "tau_n"]},
}
"""What models of some shipped vessels are told."""


def options(about: str | None, **defaults: Any) -> argparse.Namespace:
    """Return the options of a script's command line, and keep torch to one thread.

    Args:
        about: its docstring.
        defaults: by name. False is a flag, a tuple words that need no name, a list several values;
            a dictionary several of its keys, all where none is named, and None a text.
    """
    import torch

    torch.set_num_threads(1)
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=about, formatter_class=form)
    for name, default in defaults.items():
        flag = f"--{name.replace('_', '-')}" if len(name) > 1 else f"-{name}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, tuple):
            parser.add_argument(name, nargs="*", default=list(default))
        elif isinstance(default, dict):
            parser.add_argument(flag, nargs="+", choices=list(default), default=list(default))
        elif isinstance(default, list):
            kind = type(default[0]) if default else str
            parser.add_argument(flag, nargs="+", action="extend", type=kind)
        else:
            parser.add_argument(
                flag, default=default, type=str if default is None else type(default)
            )
    given = parser.parse_args()
    for name, default in defaults.items():
        if isinstance(default, list) and getattr(given, name) is None:
            setattr(given, name, default)
    return given


def read_records(files: Sequence[str]) -> list[dict[str, Any]]:
    """Return the records of earlier runs, one JSON object per line; empty names are skipped."""
    return [
        json.loads(line) for file in files if file for line in Path(file).read_text().splitlines()
    ]


def report_record(record: Mapping[str, Any], file: str | None) -> None:
    """Print a record as one line of JSON, and append it to a file unless that is None."""
    line = json.dumps(record)
    print(line, flush=True)
    if file:
        with Path(file).open("a") as stream:
            stream.write(f"{line}\n")


def summarize_log_ratios(log_ratios: np.ndarray) -> tuple[float, float]:
    """Return the geometric mean of paired ratios, and the standard error of its logarithm."""
    n = len(log_ratios)
    error = float(log_ratios.std(ddof=1)) / n**0.5 if n > 1 else 0.0
    return float(np.exp(log_ratios.mean())), error


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


def scattered(vessel: str, random: np.random.Generator, folder: Path) -> str:
    """Write a shipped vessel with masses and damping scattered by a fifth; return its file."""
    content = yaml.safe_load((CONFIGS / "vessels" / f"{vessel}.yaml").read_text(encoding="utf-8"))

    def moved(part: Any) -> Any:
        if isinstance(part, dict):
            words = ("unit", "source")
            return {key: value if key in words else moved(value) for key, value in part.items()}
        return float(part * np.exp(0.2 * random.standard_normal()))

    # vessels with a mass matrix do not list their added masses
    for section in ("added_mass" if "added_mass" in content else "mass", "damping"):
        content[section] = moved(content[section])
    file = folder / "scattered.yaml"
    file.write_text(yaml.safe_dump({**content, "name": "scattered"}, sort_keys=False))
    return str(file)


def programme(vessel: str, seed: int, trials: list[dict[str, Any]], **keys: Any) -> Any:
    """Return `SimulatedTrials` of a minute at 10 Hz in noise; `keys` are further ones."""
    from residnet.core.config import validate_config
    from residnet.manoeuvres.trials_config import SimulatedTrials

    content: dict[str, Any] = {
        "vessel": vessel,
        "seed": seed,
        "trials": trials,
        "duration": 60.0,
        "step": 0.1,
        "substeps": 2,
        "noise": {"u": 0.02, "v": 0.02, "r": 0.003},
        "identification": {},
        "validation": {},
        **keys,
    }
    return validate_config(content, SimulatedTrials, "bench")


def settings(vessel: str, **parts: Any) -> Any:
    """Return the `FitSettings` of a fit to such trials; `parts` are its baseline and others."""
    from residnet.core.config import validate_config
    from residnet.identification.settings import FitSettings

    content: dict[str, Any] = {
        "prepare": {
            "grid": {"step": 0.1},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
            "hold": "mean",
        },
        "signals": SIGNALS[vessel],
        "evaluation": {
            "protocols": {"T20": {"kind": "windows", "length": 20.0}},
            "selection": "T20",
            "scales": {"u": 0.3, "v": 0.1, "r": 0.1},
        },
        **parts,
    }
    return validate_config(content, FitSettings, "bench")
