"""Coverage of 95 % intervals of mean residuals on simulated AR(1) residuals: moving blocks, and as
document 000 Listing 9.1 prints them.

python scripts/bench/bootstrap.py [--samples 1000] [--repetitions 500] [--phi 0 0.8 0.95] [--seed 0]

The intervals are of the mean absolute residual and of the mean residual; `block` is the median
length chosen from the data.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from scipy.signal import lfilter

from residnet.judge.goodness import block_interval, independent_interval


def main() -> None:
    """Read the options, print a line for each process and quantity."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--repetitions", type=int, default=500)
    parser.add_argument("--phi", type=float, nargs="+", default=[0.0, 0.8, 0.95])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    print(
        f"{options.repetitions} repetitions of {options.samples} samples, nominal 95 %, standard"
        " error of a coverage about 1 %"
    )
    print(
        f"{'phi':>5s} {'of':>15s} {'blocks':>8s} {'printed':>8s} {'wider by':>9s} {'block':>6s}"
        f" {'ms each':>8s}"
    )
    for phi in options.phi:
        noise = random.normal(size=(options.repetitions, options.samples + 1000))
        series = lfilter([1.0], [1.0, -phi], noise, axis=1)[:, 1000:] * math.sqrt(1 - phi**2)
        line(phi, "mean |residual|", np.abs(series), math.sqrt(2 / math.pi))
        line(phi, "mean residual", series, 0.0)


def line(phi: float, what: str, series: np.ndarray, truth: float) -> None:
    """Coverage of both intervals over the rows of `series`."""
    started = time.perf_counter()
    found = [block_interval([row]) for row in series]
    seconds = time.perf_counter() - started
    printed = [independent_interval(row) for row in series]
    held = np.mean([one.low <= truth <= one.high for one in found])
    naive = np.mean([low <= truth <= high for low, high in printed])
    wider = np.mean([one.high - one.low for one in found]) / np.mean(
        [high - low for low, high in printed]
    )
    block = np.median([one.block for one in found])
    print(
        f"{phi:5.2f} {what:>15s} {100 * held:6.1f} % {100 * naive:6.1f} % {wider:9.2f} {block:6.0f}"
        f" {1000 * seconds / len(series):8.2f}"
    )


if __name__ == "__main__":
    main()
