"""Published equations on the input sets 1 to 3 of document 000, and equations found from each.

    python scripts/bench/input_sets.py

Figures 6.4 to 6.9 show the sets as pictures. The sets of the water jets are those of the author's
public code, which names them after the report; those of the forces are the three of that code
whose pictures fit (the third goes astern, as section 6.3.2 says). 300 s at 10 Hz, from rest, as
there. The first table has the mean square error of the accelerations of the published equations
on each set over the variance of the accelerations; the second what sparse regression finds from
each set alone, without a setting changed, judged on the other sets. The document claims that
(6.34), (6.51), (6.55) fit all sets, that nothing is found from set 2, and nearly all from set 3.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import torch
from made_odin import FORCE_TRUTH, JET_TRUTH, Inputs, force_rate, jet_rate, simulate
from symbolic import FORCE, FORCES, JET, JETS, Log, accelerations, regress, right

from residnet.baselines.given import EquationsConfig
from residnet.core.config import load_mapping
from residnet.core.names import to_si
from residnet.physics.terms import CandidatesConfig, TermLibrary

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "studies" / "halvorsen2019"
SECONDS, STEP = 300.0, 0.1
Signal = Callable[[np.ndarray], np.ndarray]


def square(t: np.ndarray) -> np.ndarray:
    """Return a square wave of period 2 pi that begins with 1."""
    return np.where(np.mod(t, 2 * np.pi) < np.pi, 1.0, -1.0)


def pieces(*parts: tuple[float, Signal | float]) -> Signal:
    """Return a signal of time from pieces, each with the time at which it ends."""

    def signal(t: np.ndarray) -> np.ndarray:
        ends = [end for end, _ in parts]
        which = np.searchsorted(ends, t, side="right").clip(max=len(parts) - 1)
        values = [part(t) if callable(part) else np.full_like(t, part) for _, part in parts]
        return np.choose(which, values)

    return signal


END = np.inf
JET_SETS: list[Inputs] = [
    {
        "rpm": pieces(
            (20, 500.0), (200, lambda t: 1000 + 500 * square(t / 3)), (END, lambda t: 1000 + 2 * t)
        ),
        "nozzle": pieces(
            (50, 0.0),
            (100, lambda t: 0.1 * square(t / 3)),
            (150, lambda t: 0.05 * square(t / 2)),
            (200, lambda t: 0.2 * square(t / 4)),
            (250, lambda t: 0.01 * square(t / 2)),
            (END, 0.0),
        ),
    },
    {
        "rpm": pieces((20, 500.0), (END, lambda t: 1000 + 700 * square(t / 3))),
        "nozzle": pieces(
            *((50, 0.0), (55, 0.05), (65, -0.05), (90, 0.0), (92, 0.05), (95, 0.0)),
            *((105, -0.05), (180, 0.0), (185, 0.1), (190, 0.0), (200, -0.1), (END, 0.0)),
        ),
    },
    {"rpm": lambda t: 800 + 800 * np.sin(t / 3), "nozzle": lambda t: 0.1 * np.sin(t)},
]
SERIES = ((5, 0.0), (20, 4000.0), (100, 0.0), (120, 2000.0), (140, 0.0), (160, 300.0))
SIDE = ((20, 0.0), (40, 1000.0), (80, 0.0), (100, -1000.0))
TURN = ((40, 0.0), (60, 1000.0), (80, -1000.0), (100, 1000.0), (120, 0.0), (140, -200.0))
FORCE_SETS: list[Inputs] = [
    {
        "tau_x": pieces(*SERIES, (270, 0.0), (END, lambda t: 1500 + 1500 * square(t / 3))),
        "tau_y": pieces(*SIDE, (160, 0.0), (250, lambda t: 1500 * square(t / 5)), (END, 0.0)),
        "tau_n": pieces(*TURN, (160, 0.0), (250, lambda t: 700 * square(t / 3)), (END, 0.0)),
    },
    {
        "tau_x": pieces(*SERIES, (END, 0.0)),
        "tau_y": pieces(*SIDE, (END, 0.0)),
        "tau_n": pieces(*TURN, (END, 0.0)),
    },
    {
        "tau_x": pieces((5, 0.0), (55, -2000.0), (155, 0.0), (205, 1000.0), (END, 0.0)),
        "tau_y": pieces((55, 0.0), (105, -500.0), (205, 0.0), (255, 700.0), (END, 0.0)),
        "tau_n": pieces((105, 0.0), (155, -200.0), (255, 0.0), (305, 200.0), (END, 0.0)),
    },
]


def share(error: np.ndarray, log: Log) -> str:
    """Return the mean square error of each acceleration over its variance."""
    left = (error**2).mean(axis=0) / accelerations(log).var(axis=0)
    return " / ".join(f"{value:.0e}" for value in left)


def published(logs: list[Log], config: str, names: dict[str, str], models: list[str]) -> None:
    """Print how well the printed equations fit the accelerations of each set."""
    content = load_mapping(CONFIGS / f"{config}.yaml")["baselines"]
    factors = {"rpm": to_si("rpm")}
    for model in models:
        channels = tuple(names)
        equations = EquationsConfig.model_validate(content[model]).build(channels)
        for number, log in enumerate(logs, start=1):
            columns = [log[own] * factors.get(own, 1.0) for own in names.values()]
            found = equations(torch.from_numpy(np.stack(columns, axis=1))).numpy()
            error = share(found - accelerations(log), log)
            print(f"published   {config}, {model:9s} on set {number}: left of u, v, r {error}")


def found(
    logs: list[Log],
    names: tuple[str, ...],
    space: CandidatesConfig,
    truth: dict[str, dict[str, float]],
) -> None:
    """Print what sparse regression finds from each set alone, and how that fits the others."""
    for number, log in enumerate(logs, start=1):
        equations, _, seconds = regress(log, names, space, accelerations(log))
        good = [right(e, t, 0.01) for e, t in zip(equations, truth.values(), strict=True)]
        others = [other for place, other in enumerate(logs, start=1) if place != number]
        errors = []
        for other in others:
            z = torch.from_numpy(np.stack([other[name] for name in names], axis=1))
            values = [
                TermLibrary(list(e), names)(z).numpy() @ np.array(list(e.values()))
                for e in equations
            ]
            errors.append(share(np.stack(values, axis=1) - accelerations(other), other))
        print(
            f"found       from set {number} of {len(names) - 3} inputs: {sum(good)} of 3 equations"
            f" right in {seconds:.1f} s; left on the other sets {', '.join(errors)}"
        )


def main() -> None:
    """Print both tables for the forces and for the jets."""
    torch.set_num_threads(1)
    states = ("u", "v", "r")
    forces = simulate(force_rate, states, FORCE_SETS, SECONDS, STEP)
    jets = simulate(jet_rate, states, JET_SETS, SECONDS, STEP)
    same = {name: name for name in FORCES}
    published(forces, "force_equations", same, ["input_1", "input_2", "input_3"])
    renamed = dict(zip(("u", "v", "r", "cmd_n", "cmd_nozzle"), JETS, strict=True))
    published(jets, "jet_equations", renamed, ["simulated"])
    found(forces, FORCES, FORCE, FORCE_TRUTH)
    found(jets, JETS, JET, JET_TRUTH)


if __name__ == "__main__":
    main()
