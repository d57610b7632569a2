"""Weights of a mean, judged on what its members missed (`scripts/bench/recipe.py --keep`).

    python scripts/bench/weights.py FILE...

Equal weights of each set of members stand beside weights that follow from the errors on validation
logs: the inverse of squared errors, which is best where errors are independent, and least squares
that are not negative, which know how errors go together. `validation` is of a fit that had not seen
these logs. Errors are means over the draws, ratios geometric ones to the mean of all members.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

MEMBERS = ("hull", "hull_network", "network")
Part = dict[str, np.ndarray]


def parts_of(file: Path) -> dict[str, Part]:
    """Return what each member missed [N, n], by the part of the draw."""
    out: dict[str, Part] = {}
    with np.load(file) as kept:
        for key in kept.files:
            part, name = key.split(".", 1)
            out.setdefault(part, {})[name] = kept[key]
    return out


def error(part: Part, weights: np.ndarray) -> float:
    """Return the mean NRMSE over windows and axes of a mean with weights [K]."""
    missed = sum(w * part[name].astype(float) for w, name in zip(weights, MEMBERS, strict=True))
    begins = np.flatnonzero(np.diff(part["window"], prepend=-1))
    known = np.isfinite(missed)
    squares = np.add.reduceat(np.where(known, missed, 0.0) ** 2, begins)
    return float(np.sqrt(squares / np.add.reduceat(known.astype(float), begins)).mean())


def inverse(part: Part) -> np.ndarray:
    """Return weights [K] by the inverse of squared errors."""
    weights = np.array([np.nanmean(part[name].astype(float) ** 2) for name in MEMBERS]) ** -1.0
    return np.asarray(weights / weights.sum())


def least_squares(part: Part) -> np.ndarray:
    """Return the weights [K], none negative, that leave the least squares."""
    every = np.stack([part[name].astype(float).ravel() for name in MEMBERS], axis=1)
    every = every[np.isfinite(every).all(axis=1)]
    # that they add up to one weighs more than all errors
    sure = 1e3 * np.linalg.norm(every)
    weights = nnls(np.vstack((every, np.full(3, sure))), np.append(np.zeros(len(every)), sure))[0]
    return np.asarray(weights / weights.sum())


LEARNED: dict[str, Callable[[Part], np.ndarray]] = {
    "inverse squares": inverse,
    "least squares": least_squares,
}


def judged(file: Path) -> dict[str, float]:
    """Return the test error of each kind of weights for one draw."""
    parts, out = parts_of(file), {}
    for count in range(1, len(MEMBERS) + 1):
        for names in combinations(MEMBERS, count):
            weights = np.array([(name in names) / count for name in MEMBERS])
            out[" + ".join(names)] = error(parts["test"], weights)
    for name, learn in LEARNED.items():
        for part in ("validation", "seen"):
            if part in parts:
                out[f"{name}, {part}"] = error(parts["test"], learn(parts[part]))
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("files", type=Path, nargs="+")
    draws = [judged(file) for file in parser.parse_args().files]
    for name in dict.fromkeys(name for draw in draws for name in draw):
        own = [draw for draw in draws if name in draw]
        ratio = np.log([draw[name] / draw[" + ".join(MEMBERS)] for draw in own])
        spread = ratio.std() / np.sqrt(len(own))
        print(
            f"{name:32} {len(own)} draws: {np.mean([draw[name] for draw in own]):.3f},"
            f" {np.exp(ratio.mean()):.3f} +- {spread:.3f}, at most {np.exp(ratio.max()):.2f}"
        )


if __name__ == "__main__":
    main()
