"""Genetic programming beside sparse regression on the same data: how often the equation is right,
and processor seconds, on one thread.

    python scripts/bench/genetic.py [--parts spring,forces,jets] [--population 1000]

    spring   the mass-spring-damper (5.13), settings of Table 5.1 with a population of 500, ten
    seeds for each row of Table 5.2's last column forces   (6.6)-(6.8) with the settings of Table
    6.1: three input sets, each with another one to validate, as in section 6.3.2 jets
    (6.21)-(6.23) with the settings of Table 6.2, 30 generations: one multi-sine design with another
    one to validate; here genetic
             programming is known to fail (section 6.4.2)

An equation is right when it has the true terms and no others; `fits` counts those whose mean square
error is below the document's threshold (5e-6 for the spring, 1e-8 for the vessel) on training and
validation data, whatever their terms. Sparse regression sees the training data only. Truth and
designs stand in tests/heads/made_odin.py. Needs the extra gp.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))

import numpy as np
import torch
from made_odin import FORCE_TRUTH, JET_TRUTH, MSD_TRUTH, force_logs, jet_logs, msd_log
from symbolic import FORCE, FORCES, JET, JETS, MSD, SPRING, regress, right

from residnet.heads.genetic import GeneticConfig
from residnet.physics.candidates import CandidatesConfig
from residnet.regression.expressions import Algebra
from residnet.regression.genetic import Bred, breed, limits_of
from residnet.regression.writing import term

Log = dict[str, np.ndarray]
Answer = tuple[dict[str, float], Bred, float]
Setup = tuple[tuple[str, ...], CandidatesConfig, Mapping[str, Mapping[str, float]]]
TABLE_51 = {
    "operators": ["+", "-", "*", "abs"],
    "tournament": 3,
    "depth": 7,
    "split": "sum",
    "goal": 1e-10,
}
TABLE_61 = {
    "operators": ["+", "*", "abs"],
    "tournament": 5,
    "depth": 10,
    "generations": 30,
    "patience": 30,
    "goal": 1e-12,
}
TABLE_62 = TABLE_61 | {"operators": ["+", "*", "abs", "sin", "cos"]}


def search(
    logs: tuple[Log, Log],
    names: tuple[str, ...],
    axis: str,
    evolution: Mapping[str, object],
    seed: int,
) -> tuple[dict[str, float], Bred, float]:
    """Coefficients by term, what was bred on the first log and validated on the second, and
    processor seconds.
    """
    config = GeneticConfig.model_validate({"evolution": evolution})
    data = {name: np.concatenate([log[name] for log in logs]) for name in names}
    train = np.arange(len(logs[0]["t"]) + len(logs[1]["t"])) < len(logs[0]["t"])
    started = time.process_time()
    algebra = Algebra(names, limits_of(config.evolution))
    bred = breed(algebra, data, np.concatenate([log[axis] for log in logs]), train, config, seed)
    return (
        {term(algebra, p): v for p, v in zip(bred.products, bred.values, strict=True)},
        bred,
        time.process_time() - started,
    )


def fits(bred: Bred, target: np.ndarray, threshold: float) -> bool:
    return (
        max(bred.found.train, bred.found.validation) * float(np.square(target).mean()) < threshold
    )


def spring(_: int) -> None:
    log = msd_log()
    first, last = (
        {name: values[part] for name, values in log.items()}
        for part in (slice(None, 350), slice(350, None))
    )
    started = time.process_time()
    ten = [regress(first, SPRING, MSD, first["w_dot"][:, None])[0][0] for _ in range(10)]
    sparse = (time.process_time() - started) / 10
    for generations in (2, 5, 10, 20, 50, 100, 200):
        runs = [
            search(
                (first, last),
                SPRING,
                "w_dot",
                TABLE_51 | {"population": 500, "generations": generations},
                seed,
            )
            for seed in range(10)
        ]
        good = sum(right(found, MSD_TRUTH, 0.01) for found, *_ in runs)
        close = sum(fits(bred, log["w_dot"], 5e-6) for _, bred, _ in runs)
        seconds = float(np.median([s for *_, s in runs]))
        print(
            f"spring  at most {generations:3d} generations: right {good} of 10, fits {close} of 10,"
            f" {1e3 * seconds:.1f} ms (median)",
            end="; ",
        )
        print(
            f"sparse regression right {sum(right(f, MSD_TRUTH, 0.01) for f in ten)} of 10,"
            f" {1e3 * sparse:.1f} ms: ratio {seconds / sparse:.0f}"
        )


def vessel(label: str, designs: list[Log], setup: Setup, evolution: Mapping[str, object]) -> None:
    names, space, truths = setup
    for number in range(len(designs) - 1):
        log, other = designs[number], designs[number + 1]
        started = time.process_time()
        rival, *_ = regress(log, names, space, np.stack([log[axis] for axis in truths], axis=1))
        sparse = time.process_time() - started
        cells, total = [], 0.0
        for axis, truth in truths.items():
            found, bred, seconds = search((log, other), names, axis, evolution, number)
            verdict = (
                "right"
                if right(found, truth, 0.01)
                else "fits"
                if fits(bred, log[axis], 1e-8)
                else "WRONG"
            )
            cells.append(
                f"{axis} {verdict} (generation {bred.found.generation}, {bred.found.fitted} fits,"
                f" {seconds:.2f} s)"
            )
            total += seconds
        hits = sum(right(f, truth, 0.01) for f, truth in zip(rival, truths.values(), strict=True))
        print(f"{label} set {number + 1}: {', '.join(cells)}: {total:.1f} s;")
        print(
            f"        sparse regression: {hits} of {len(truths)} right in {sparse:.2f} s: ratio"
            f" {total / sparse:.0f}"
        )


def forces(population: int) -> None:
    vessel(
        "forces ",
        force_logs(4),
        (FORCES, FORCE, FORCE_TRUTH),
        TABLE_61 | {"population": population},
    )


def jets(population: int) -> None:
    vessel("jets   ", jet_logs(2), (JETS, JET, JET_TRUTH), TABLE_62 | {"population": population})


PARTS: dict[str, Callable[[int], None]] = {"spring": spring, "forces": forces, "jets": jets}


def main() -> None:
    """Read the options and print each part as it is done."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default=",".join(PARTS), help="which parts, separated by commas")
    parser.add_argument(
        "--population",
        type=int,
        default=1000,
        help="of the parts `forces` and `jets`; the document's tables say 5000",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    for part in options.parts.split(","):
        if part not in PARTS:
            parser.error(f"no part '{part}'; valid: {', '.join(PARTS)}")
        PARTS[part](options.population)


if __name__ == "__main__":
    main()
