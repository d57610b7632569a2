"""Equations recovered from simulated logs: how often, how exactly, and how fast, on one thread.

    python scripts/bench/symbolic.py [--parts ships,ratios,bred] [--designs N] [--seed S]

    exact       all six equations of Odin (document 000, (6.6)-(6.8), (6.21)-(6.23)) from random
                multi-sine designs with accelerations given; a coefficient counts within 1 %
    random      six random equations for each design, with products, magnitudes and ratios, and 0.1
                standard deviations of noise: how often the structure is exactly the true one
    late        the same with inputs that act 0.3 s late
    ships       random ships with propeller and rudder, no settings at all, without and with noise
    ratios      the same of ships that divide by their revolutions, which stay away from zero
    bred        the noisy ships by genetic programming, no settings at all (extra gp)
    delay       a delay of 0.5 s, 10 % noise on all channels: the errors of the true terms at every
                shift, and a search for every shift as the document does

Truth and designs stand in tests/support/made_odin.py and made_equations.py. Times are of the wall,
of the terms' values, factorisation and search together.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))

import numpy as np
import torch
from made_equations import CHANNELS, SPACE, Drawn, draw, draw_ship
from made_odin import FORCE_TRUTH, JET_TRUTH, force_logs, jet_logs, msd_log

from residnet.core.errors import ConfigError
from residnet.core.names import ACCELERATION
from residnet.heads.genetic import GeneticConfig
from residnet.heads.symbolic import Past, SymbolicConfig, best_delay
from residnet.physics.terms import CandidatesConfig, TermLibrary, parse_term
from residnet.regression.sparse import SearchConfig, find, reduce

Log = dict[str, np.ndarray]
Truth = Mapping[str, Mapping[str, float]]
FORCES, JETS, SPRING = (
    ("u", "v", "r", "tau_x", "tau_y", "tau_n"),
    ("u", "v", "r", "rpm", "nozzle"),
    ("x", "w", "tau"),
)
FORCE = CandidatesConfig(input_degree=2, coupling=("u", "v", "r"))
JET = CandidatesConfig(
    inputs=("rpm",), input_degree=2, coupling=("u",), coupling_degree=2, angles=("nozzle",)
)
MSD = CandidatesConfig(motions=("x", "w"), input_degree=2, coupling=("x", "w"))


def regress(
    log: Log, names: tuple[str, ...], space: CandidatesConfig, targets: np.ndarray
) -> tuple[list[dict[str, float]], list[Any], float]:
    """Coefficients of each target, the equations, and the seconds that it took."""
    started = time.perf_counter()
    candidates = space.candidates(names)
    z = torch.from_numpy(np.stack([log[name] for name in names], axis=1))
    values = TermLibrary([c.term for c in candidates], names)(z).numpy()
    reduced = reduce(
        values,
        targets,
        [c.term for c in candidates],
        [c.degree for c in candidates],
        effort=[c.effort for c in candidates],
    )
    equations = [find(reduced, k, SearchConfig())[0] for k in range(targets.shape[1])]
    seconds = time.perf_counter() - started
    return (
        [dict(zip(e.terms, map(float, e.values), strict=True)) for e in equations],
        equations,
        seconds,
    )


def accelerations(log: Log) -> np.ndarray:
    return np.stack([log[name] for name in ACCELERATION], axis=1)


def right(found: Mapping[str, float], truth: Mapping[str, float], within: float = np.inf) -> bool:
    return set(found) == set(truth) and all(
        abs(found[term] / value - 1) <= within for term, value in truth.items()
    )


def exact(count: int, _: int) -> None:
    times, good, worst = [], 0, 0.0
    for force, jet in zip(force_logs(count), jet_logs(count), strict=True):
        a, _, seconds_a = regress(force, FORCES, FORCE, accelerations(force))
        b, _, seconds_b = regress(jet, JETS, JET, accelerations(jet))
        pairs = list(zip(a + b, [*FORCE_TRUTH.values(), *JET_TRUTH.values()], strict=True))
        good += all(right(found, truth, 0.01) for found, truth in pairs)
        worst = max(
            [
                worst,
                *(
                    abs(found.get(t, 0.0) / v - 1)
                    for found, truth in pairs
                    for t, v in truth.items()
                ),
            ]
        )
        times.append(seconds_a + seconds_b)
    print(
        f"exact       all six equations right in {good} of {count} designs; largest coefficient"
        f" error {100 * worst:.1e} %;"
    )
    print(
        f"            all six together {np.median(times):.2f} s (median), {max(times):.2f} s"
        " (slowest)"
    )


def delay(_: int, __: int) -> None:
    log, longest = msd_log(delay=0.5), 20
    hits, times = 0, []
    zeros, names = np.zeros(len(log["t"])), ("u", "v", "tau")
    for seed in range(20):
        random = np.random.default_rng(seed)
        z = {
            name: log[name] + 0.1 * np.ptp(log[name]) * random.uniform(-1, 1, len(zeros))
            for name in (*SPRING, "w_dot")
        }
        started = time.perf_counter()
        chosen = np.stack([z[name] for name in SPRING], axis=1)
        past = Past(chosen, z["w_dot"][:, None], zeros, 0.1)
        found, _ = best_delay(past, [("u", "v", "tau")], names, np.array([2]), longest)
        times.append(time.perf_counter() - started)
        hits += found == 5
    print(f"delay       0.5 s found in {hits} of 20, each in {1e3 * np.median(times):.2f} ms")
    started = time.perf_counter()
    for shift in range(longest + 1):
        now = {
            "x": z["x"][longest:],
            "w": z["w"][longest:],
            "tau": z["tau"][longest - shift : len(zeros) - shift],
        }
        regress(now, SPRING, MSD, z["w_dot"][longest:, None])
    print(
        "            the document's way, the whole search anew for each shift:"
        f" {1e3 * (time.perf_counter() - started):.0f} ms"
    )


def alike(terms: Iterable[str]) -> set[tuple[Any, ...]]:
    """Return terms by their factors, however they are written; sums in brackets as they are."""
    out: set[tuple[Any, ...]] = set()
    for term in terms:
        try:
            out.add(tuple(sorted(parse_term(term, CHANNELS))))
        except ConfigError:
            out.add((term,))
    return out


def drawn(
    label: str,
    designs: list[Drawn],
    config: dict[str, Any],
    delay: int = 0,
    kind: type[SymbolicConfig | GeneticConfig] = SymbolicConfig,
) -> None:
    """Print how often the structure of each drawn equation is found, and the delay."""
    good, late, count, times = 0, 0, 0, []
    for design in designs:
        head = kind.model_validate(config).build(CHANNELS)
        head.calibrate(design.samples)
        started = time.perf_counter()
        notes = head.solve(design.samples)
        times.append(time.perf_counter() - started)
        late += int(notes.get("delay", {"steps": 0})["steps"] == delay)
        for axis, truth in zip(ACCELERATION, design.truth, strict=True):
            found = {c["term"]: c["value"] for c in notes["coefficients"] if c["axis"] == axis}
            good, count = good + int(alike(found) == alike(truth)), count + 1
    print(
        f"{label:11s} structure right in {good} of {count}, delay in {late} of {len(designs)};"
        f" {np.median(times):.2f} s for three equations (median), {max(times):.2f} s (slowest)"
    )


def random_equations(count: int, first: int) -> None:
    designs = [draw(seed) for seed in range(first, first + 2 * count)]
    drawn("random", designs, {"candidates": SPACE.model_dump()})


def late(count: int, first: int) -> None:
    """Inputs that act three samples late."""
    designs = [draw(seed, delay=3) for seed in range(first, first + 2 * count)]
    config = {
        "candidates": SPACE.model_dump(),
        "delay": {"channels": ["n", "delta"], "longest": 10},
    }
    drawn("late", designs, config, 3)


def ships(count: int, first: int) -> None:
    for noise_level in (0.0, 0.1):
        designs = [draw_ship(seed, noise=noise_level) for seed in range(first, first + 2 * count)]
        drawn(f"ships {noise_level:g}", designs, {})


def ratios(count: int, first: int) -> None:
    for noise_level in (0.0, 0.1):
        designs = [draw_ship(first + k, noise=noise_level, ratios=True) for k in range(count)]
        drawn(f"ratios {noise_level:g}", designs, {})


def bred(count: int, first: int) -> None:
    """Breed the equations of noisy ships, with the defaults of genetic programming."""
    designs = [draw_ship(seed, noise=0.1) for seed in range(first, first + count)]
    drawn("bred 0.1", designs, {}, kind=GeneticConfig)


PARTS: dict[str, Callable[[int, int], None]] = {
    "exact": exact,
    "random": random_equations,
    "late": late,
    "ships": ships,
    "ratios": ratios,
    "bred": bred,
    "delay": delay,
}


def main() -> None:
    """Read the options and print each part as it is done."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default=",".join(PARTS), help="which parts, separated by commas")
    parser.add_argument(
        "--designs", type=int, default=10, help="designs of the parts that draw them"
    )
    parser.add_argument("--seed", type=int, default=0, help="first seed of what is drawn")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for part in options.parts.split(","):
        if part not in PARTS:
            parser.error(f"no part '{part}'; valid: {', '.join(PARTS)}")
        PARTS[part](options.designs, options.seed)


if __name__ == "__main__":
    main()
