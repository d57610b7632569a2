"""Equations recovered from simulated logs: how often, how exactly, and how fast, on one thread.

    python scripts/bench/symbolic.py [--parts ships ratios cubic bred] [--designs 10] [--seed 0]

    exact       all six equations of Odin (document 000, (6.6)-(6.8), (6.21)-(6.23)) from random
                multi-sine designs with accelerations given; a coefficient counts within 1 %
    random      six random equations for each design, with products, magnitudes and ratios, and 0.1
                standard deviations of noise: how often the structure is exactly the true one
    late        the same with inputs that act 0.3 s late
    ships       random ships with propeller and rudder, no settings at all, without and with noise
    ratios      the same of ships that divide by their revolutions, which stay away from zero
    cubic       equations with cubic terms, no settings at all, 10 % noise: six kinds, four draws
    bred        the noisy ships by genetic programming, no settings at all (extra gp)
    delay       a delay of 0.5 s, 10 % noise on all channels: the errors of the true terms at every
                shift
    sets        the input sets 1 to 3 of document 000, 300 s at 10 Hz from rest: the mean square
                error of the accelerations of the published equations on each over their variance,
                and what sparse regression finds from each alone, judged on the others

Figures 6.4 to 6.9 show the sets as pictures. Those of the water jets are from the author's public
code, which names them after the report; those of the forces are the three of that code whose
pictures fit (the third goes astern, as section 6.3.2 says). The document claims that (6.34),
(6.51), (6.55) fit all sets, that nothing is found from set 2, and nearly all from set 3.

Truth and designs stand in tests/support/made_odin.py and made_equations.py. Times are of the wall,
of the terms' values, factorisation and search together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import bench
import numpy as np
import torch
from made_equations import CHANNELS, CUBIC_SHIPS, SPACE, Drawn, draw, draw_ship
from made_odin import (
    FORCE_TRUTH,
    JET_TRUTH,
    Inputs,
    force_logs,
    force_rate,
    jet_logs,
    jet_rate,
    msd_log,
    simulate,
)  # fmt: skip

from residnet.baselines.given_config import EquationsConfig
from residnet.core.config import load_mapping
from residnet.core.errors import ConfigError
from residnet.core.names import ACCELERATION_NAMES, to_si
from residnet.heads.genetic_config import GeneticConfig
from residnet.heads.symbolic import SegmentedSamples, find_best_delay
from residnet.heads.symbolic_config import SymbolicConfig
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import CandidatesConfig, parse_term
from residnet.regression.sparse import find_equation, reduce_problem
from residnet.regression.sparse_config import SparseSearchConfig

Log = dict[str, np.ndarray]
Signal = Callable[[np.ndarray], np.ndarray]
Truth = Mapping[str, Mapping[str, float]]
FORCES = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
JETS = ("u", "v", "r", "rpm", "nozzle")
SPRING = ("x", "w", "tau")
FORCE = CandidatesConfig(input_degree=2, coupling=("u", "v", "r"))
JET = CandidatesConfig(
    inputs=("rpm",), input_degree=2, coupling=("u",), coupling_degree=2, angles=("nozzle",)
)


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


def regress(
    log: Log, names: tuple[str, ...], space: CandidatesConfig, targets: np.ndarray
) -> tuple[list[dict[str, float]], float]:
    """Return the coefficients of each target, and the seconds that it took."""
    started = time.perf_counter()
    candidates = space.generate_candidates(names)
    z = torch.from_numpy(np.stack([log[name] for name in names], axis=1))
    values = TermLibrary([c.term for c in candidates], names)(z).numpy()
    reduced = reduce_problem(
        values,
        targets,
        [c.term for c in candidates],
        [c.degree for c in candidates],
        complexity=[c.complexity for c in candidates],
    )
    equations = [
        find_equation(reduced, k, SparseSearchConfig())[0] for k in range(targets.shape[1])
    ]
    seconds = time.perf_counter() - started
    return [dict(zip(e.terms, map(float, e.values), strict=True)) for e in equations], seconds


def accelerations(log: Log) -> np.ndarray:
    return np.stack([log[name] for name in ACCELERATION_NAMES], axis=1)


def right(found: Mapping[str, float], truth: Mapping[str, float], within: float = np.inf) -> bool:
    return set(found) == set(truth) and all(
        abs(found[term] / value - 1) <= within for term, value in truth.items()
    )


def exact(count: int, _: int) -> None:
    """Print in how many designs all six equations are found, and how long that takes."""
    times = []
    good = 0
    for force, jet in zip(force_logs(count), jet_logs(count), strict=True):
        a, seconds_a = regress(force, FORCES, FORCE, accelerations(force))
        b, seconds_b = regress(jet, JETS, JET, accelerations(jet))
        truths = [*FORCE_TRUTH.values(), *JET_TRUTH.values()]
        good += all(right(found, truth, 0.01) for found, truth in zip(a + b, truths, strict=True))
        times.append(seconds_a + seconds_b)
    print(
        f"exact       all six equations right in {good} of {count} designs; all six together"
        f" {np.median(times):.2f} s (median), {max(times):.2f} s (slowest)"
    )


def delay(_: int, __: int) -> None:
    """Print in how many noisy records the delay is found."""
    log = msd_log(delay=0.5)
    hits = 0
    times = []
    zeros = np.zeros(len(log["t"]))
    names = ("u", "v", "tau")
    for seed in range(20):
        random = np.random.default_rng(seed)
        z = {
            name: log[name] + 0.1 * np.ptp(log[name]) * random.uniform(-1, 1, len(zeros))
            for name in (*SPRING, "w_dot")
        }
        started = time.perf_counter()
        chosen = np.stack([z[name] for name in SPRING], axis=1)
        past = SegmentedSamples(chosen, z["w_dot"][:, None], zeros, 0.1)
        found, _ = find_best_delay(past, [("u", "v", "tau")], names, np.array([2]), 20)
        times.append(time.perf_counter() - started)
        hits += found == 5
    print(f"delay       0.5 s found in {hits} of 20, each in {1e3 * np.median(times):.2f} ms")


def share(found: np.ndarray, log: Log) -> str:
    """Return the mean square error of each acceleration [T, 3] over its variance."""
    left = ((found - accelerations(log)) ** 2).mean(axis=0) / accelerations(log).var(axis=0)
    return " / ".join(f"{value:.0e}" for value in left)


def published(logs: list[Log], config: str, names: dict[str, str], models: list[str]) -> None:
    """Print how well the printed equations fit the accelerations of each set."""
    content = load_mapping(bench.CONFIGS / "studies/halvorsen2019" / f"{config}.yaml")["baselines"]
    factors = {"rpm": to_si("rpm")}
    for model in models:
        given = EquationsConfig.model_validate(content[model]).build(tuple(names))
        for number, log in enumerate(logs, start=1):
            columns = [log[own] * factors.get(own, 1.0) for own in names.values()]
            left = share(given(torch.from_numpy(np.stack(columns, axis=1))).numpy(), log)
            print(f"published   {config}, {model:9s} on set {number}: left of u, v, r {left}")


def from_each(
    logs: list[Log], names: tuple[str, ...], space: CandidatesConfig, truth: Truth
) -> None:
    """Print what sparse regression finds from each set alone, and how that fits the others."""
    for number, log in enumerate(logs, start=1):
        told, seconds = regress(log, names, space, accelerations(log))
        good = sum(right(e, t, 0.01) for e, t in zip(told, truth.values(), strict=True))
        errors = []
        for other in (other for other in logs if other is not log):
            z = torch.from_numpy(np.stack([other[name] for name in names], axis=1))
            values = [TermLibrary(list(e), names)(z).numpy() @ list(e.values()) for e in told]
            errors.append(share(np.stack(values, axis=1), other))
        print(
            f"found       from set {number} of {len(names) - 3} inputs: {good} of 3 equations"
            f" right in {seconds:.1f} s; left on the other sets {', '.join(errors)}"
        )


def input_sets(_: int, __: int) -> None:
    """Print both tables for the forces and for the jets."""
    states = ("u", "v", "r")
    forces = simulate(force_rate, states, FORCE_SETS, 300.0, 0.1)
    jets = simulate(jet_rate, states, JET_SETS, 300.0, 0.1)
    same = {name: name for name in FORCES}
    published(forces, "force_equations", same, ["input_1", "input_2", "input_3"])
    renamed = dict(zip((*states, "cmd_n", "cmd_nozzle"), JETS, strict=True))
    published(jets, "jet_equations", renamed, ["simulated"])
    from_each(forces, FORCES, FORCE, FORCE_TRUTH)
    from_each(jets, JETS, JET, JET_TRUTH)


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
    good = 0
    late = 0
    count = 0
    times = []
    for design in designs:
        head = kind.model_validate(config).build(CHANNELS)
        head.calibrate(design.samples)
        started = time.perf_counter()
        notes = head.fit_preferred(design.samples)
        times.append(time.perf_counter() - started)
        late += int(notes.get("delay", {"steps": 0})["steps"] == delay)
        for axis, truth in zip(ACCELERATION_NAMES, design.truth, strict=True):
            found = {c["term"]: c["value"] for c in notes["coefficients"] if c["axis"] == axis}
            good = good + int(alike(found) == alike(truth))
            count = count + 1
    print(
        f"{label:11s} structure right in {good} of {count}, delay in {late} of {len(designs)};"
        f" {np.median(times):.2f} s for three equations (median), {max(times):.2f} s (slowest)"
    )


def ships(label: str, count: int, first: int, levels: Iterable[float], **given: Any) -> None:
    """Print the same of drawn ships, for several levels of noise and no settings at all."""
    for noise in levels:
        designs = [draw_ship(first + k, noise=noise, **given) for k in range(count)]
        kind = GeneticConfig if label == "bred" else SymbolicConfig
        drawn(f"{label} {noise:g}", designs, {}, kind=kind)


def cubic(count: int, first: int) -> None:
    """Print how often equations with cubic terms are recovered, for two kinds of each axis."""
    designs = [
        draw_ship(first + k, noise=0.1, terms=terms)
        for terms in CUBIC_SHIPS
        for k in range(max(1, 2 * count // 5))
    ]
    drawn("cubic 0.1", designs, {})


def equations(label: str, count: int, first: int, delay: int) -> None:
    """Print the same of random equations whose inputs act so many samples late."""
    config: dict[str, Any] = {"candidates": SPACE.model_dump()}
    if delay:
        config["delay"] = {"channels": ["n", "delta"], "longest": 10}
    designs = [draw(first + k, delay=delay) for k in range(count)]
    drawn(label, designs, config, delay)


PARTS: dict[str, Callable[[int, int], None]] = {
    "exact": exact,
    "random": lambda count, first: equations("random", 2 * count, first, 0),
    "late": lambda count, first: equations("late", 2 * count, first, 3),
    "ships": lambda count, first: ships("ships", 2 * count, first, (0.0, 0.1)),
    "ratios": lambda count, first: ships("ratios", count, first, (0.0, 0.1), ratios=True),
    "cubic": cubic,
    "bred": lambda count, first: ships("bred", count, first, (0.1,)),
    "delay": delay,
    "sets": input_sets,
}


def main() -> None:
    """Print each part as it is done."""
    given = bench.options(__doc__, parts=PARTS, designs=10, seed=0)
    for part in given.parts:
        PARTS[part](given.designs, given.seed)


if __name__ == "__main__":
    main()
