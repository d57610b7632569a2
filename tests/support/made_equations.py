"""Random equations with products, magnitudes and ratios, and random records to find them in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from residnet.core.samples import Samples
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import CandidatesConfig

CHANNELS = ("u", "v", "r", "n", "delta")
RATIOS = ("u n^-1", "v n^-1", "r n^-1", "delta n^-1", "u^2 n^-1", "u v n^-1", "u r n^-2")
"""Ratios of the library: the revolutions stay away from zero in the records."""
SPACE = CandidatesConfig(
    inputs=("n", "delta"), input_degree=2, coupling=("u",), coupling_degree=2, extra=RATIOS
)
EVIDENCE = 40.0
"""Least rise of the error, in variances of the noise, when another candidate takes the place of a
true term: with less no method could tell the two apart.
"""
TRIES = 200
"""Most equations that are drawn for one that the record can tell."""


class Drawn(NamedTuple):
    """A record with three random equations: names of the candidates, samples, terms by axis."""

    terms: tuple[str, ...]
    samples: Samples
    truth: tuple[dict[str, float], ...]


def draw(
    seed: int,
    *,
    count: int = 3000,
    step: float = 0.1,
    noise: float = 0.1,
    delay: int = 0,
    space: CandidatesConfig = SPACE,
) -> Drawn:
    """Return three random equations of three to five terms, and a record of them.

    Each term makes up between 0.3 and 1 standard deviation of its target; one at least has a
    product, one a magnitude and one a ratio. Noise is in standard deviations of the target; inputs
    act `delay` samples late.
    """
    random = np.random.default_rng(seed)
    terms = tuple(candidate.term for candidate in space.generate_candidates(CHANNELS))
    z = record(random, count + delay, step)
    late = z[delay:].copy()
    late[:, 3:] = z[: len(z) - delay, 3:]
    values = TermLibrary(terms, CHANNELS)(torch.from_numpy(late)).numpy()
    targets = []
    truth = []
    for kind in ("product", "magnitude", "ratio"):
        chosen, y = _equation(random, terms, values, kind, noise)
        weight = np.linalg.lstsq(values[:, chosen], y, rcond=None)[0]
        truth.append({terms[j]: float(w) for j, w in zip(chosen, weight, strict=True)})
        targets.append(y + noise * y.std() * random.normal(size=len(y)))
    target = np.stack(targets, axis=1)
    if delay:
        # the rows before the inputs arrive have no target that the equation explains
        target = np.concatenate((np.repeat(target[:1], delay, axis=0), target))
    return Drawn(terms, _samples(z, target, step), tuple(truth))


def _samples(z: np.ndarray, target: np.ndarray, step: float) -> Samples:
    return Samples(
        torch.from_numpy(z),
        torch.from_numpy(target),
        torch.zeros(len(z), dtype=torch.long),
        torch.arange(len(z), dtype=torch.float64) * step,
        ("made",),
        CHANNELS,
    )


SHIP: tuple[tuple[tuple[str, ...], ...], ...] = (
    (
        ("n |n|", "n^2"),
        ("u |u|", "u", "u^2"),
        ("v r",),
        ("u n", "u |n|", "|u| n"),
        ("u^2 delta^2", "u |delta|", "|u| delta^2"),
    ),
    (
        ("u^2 delta", "u |u| delta", "|u| delta", "n |n| delta", "u n delta"),
        ("u v", "v |u|", "v"),
        ("u r",),
        ("v |v|", "v |r|"),
    ),
    (
        ("u^2 delta", "u |u| delta", "|u| delta", "n |n| delta", "u n delta"),
        ("u r", "r |u|", "r"),
        ("u v", "v |u|"),
        ("r |r|", "r |v|", "v |v|"),
    ),
)
"""Terms of ships' equations by axis: one of each group."""
CUBIC_SHIPS: tuple[tuple[tuple[tuple[str, ...], ...], ...], ...] = (
    (
        (("n |n|", "n^2"), ("u^3",), ("v r",), ("n^2 delta^2",)),
        (("v^3",), ("u r",), ("u^2 delta", "n |n| delta")),
        (("r^3",), ("u v", "v |u|"), ("u^2 delta", "n |n| delta")),
    ),
    (
        (("u",), ("u^3",), ("v^2", "r^2"), ("n", "u n"), ("u^2 delta^2",)),
        (("v",), ("v^2 r", "v r^2"), ("u r",), ("u delta", "delta^3")),
        (("r",), ("v^2 r", "v r^2", "v^3"), ("u v",), ("n^2 delta",)),
    ),
)
"""Terms of equations with cubic terms by kind and axis: one of each group.

The first kind has the cubic damping of document 002 and the rudder drag in the slipstream of
document 001; the second has terms of the third-order expansion of Abkowitz (1964).
"""
OVER = (
    ("u inv(n)", "u^2 inv(n)", "inv(n)"),
    ("v inv(n)", "u v inv(n)", "delta inv(n)"),
    ("r inv(n)", "u r inv(n)", "delta inv(n)"),
)
"""Terms of a ship that divides by its revolutions, which stay away from zero."""


def draw_ship(
    seed: int,
    *,
    count: int = 3000,
    step: float = 0.1,
    noise: float = 0.0,
    ratios: bool = False,
    terms: tuple[tuple[tuple[str, ...], ...], ...] = SHIP,
) -> Drawn:
    """Return the equations of a random ship with propeller and rudder, and a record of it.

    Each term makes up between 0.3 and 1 standard deviation of its target. With `ratios` each
    equation has one of `OVER`, and revolutions stay ahead: terms with |n| are then those with n.
    `terms` has the groups of terms of each axis, of which an equation has one each.
    """
    random = np.random.default_rng(seed)
    z = record(random, count, step, astern=True)
    z[:, 3] += 7.0 * ratios
    targets = []
    truth = []
    for groups, over in zip(terms, OVER, strict=True):
        if ratios:
            told = [tuple(term for term in group if "|n|" not in term) for group in groups]
            groups = (*told, over)
        chosen = [str(random.choice(group)) for group in groups]
        columns = TermLibrary(chosen, CHANNELS)(torch.from_numpy(z)).numpy()
        share = random.uniform(0.3, 1.0, len(chosen)) * random.choice([-1.0, 1.0], len(chosen))
        weight = share / columns.std(axis=0)
        truth.append({term: float(w) for term, w in zip(chosen, weight, strict=True)})
        y = columns @ weight
        targets.append(y + noise * y.std() * random.normal(size=count))
    return Drawn((), _samples(z, np.stack(targets, axis=1), step), tuple(truth))


def record(
    random: np.random.Generator, count: int, step: float, *, astern: bool = False
) -> np.ndarray:
    """Return channels [count, 5]: a vessel's speeds, revolutions and rudder, smooth or in steps.

    Revolutions stay above zero unless the vessel also goes astern.
    """
    ahead = random.choice([0.5, 1.0, 2.0])
    spread = {
        # both directions, rarely astern, or ahead alone
        "u": (0.5 if astern else ahead, 0.6),
        "v": (0.0, 0.3),
        "r": (0.0, 0.15),
        "n": (5.0 if astern else 12.0, 4.0),
        "delta": (0.0, 0.3),
    }
    kind = random.choice(["sines", "steps", "noise"])
    out = []
    for name, (mean, sd) in spread.items():
        smooth = kind != "noise" and (kind == "sines" or name in ("u", "v", "r"))
        held = 1 if kind == "noise" else round(5.0 / step)
        wave = _sines(random, count, step) if smooth else _levels(random, count, held)
        # divisors stay away from zero
        out.append(mean + sd * (np.clip(wave, -2.0, 2.0) if mean else wave))
    return np.stack(out, axis=1)


def _sines(random: np.random.Generator, count: int, step: float) -> np.ndarray:
    t = np.arange(count) * step
    period = np.exp(random.uniform(np.log(3.0), np.log(60.0), 6))
    phase = random.uniform(0, 2 * np.pi, 6)
    share = random.uniform(0.3, 1.0, 6)
    wave = np.asarray((share * np.sin(2 * np.pi * t[:, None] / period + phase)).sum(axis=1))
    return wave / wave.std()


def _levels(random: np.random.Generator, count: int, held: int) -> np.ndarray:
    levels = random.uniform(-1.7, 1.7, -(-count // held))
    return np.repeat(levels, held)[:count]


def _equation(
    random: np.random.Generator, terms: Sequence[str], values: np.ndarray, kind: str, noise: float
) -> tuple[list[int], np.ndarray]:
    """Return the columns of an equation, one of them of a kind, and its target without noise."""
    pool = _apart(values)
    of_kind = {
        "product": [j for j in pool if " " in terms[j] and "|" not in terms[j]],
        "magnitude": [j for j in pool if "|" in terms[j]],
        "ratio": [j for j in pool if "^-" in terms[j]],
    }[kind]
    for _ in range(TRIES):
        size = int(random.integers(2, 5))
        first = int(random.choice(of_kind))
        others = [j for j in pool if j not in (0, first)]
        chosen = [first, *random.choice(others, size, replace=False).tolist()]
        share = random.uniform(0.3, 1.0, len(chosen)) * random.choice([-1.0, 1.0], len(chosen))
        y = values[:, chosen] @ (share / values[:, chosen].std(axis=0))
        if _evidence(values[:, pool], [pool.index(j) for j in chosen], y) > EVIDENCE * (
            (noise * y.std()) ** 2
        ):
            return chosen, y
    raise ValueError("the record tells no equation of the library")


def _apart(values: np.ndarray) -> list[int]:
    """Return the columns that simpler ones do not make up."""
    kept: list[int] = []
    basis = np.zeros((len(values), 0))
    for j, column in enumerate(values.T):
        left = column - basis @ (basis.T @ column)
        left = left - basis @ (basis.T @ left)
        if np.linalg.norm(left) > 1e-9 * np.linalg.norm(column):
            kept.append(j)
            basis = np.concatenate((basis, left[:, None] / np.linalg.norm(left)), axis=1)
    return kept


def _evidence(values: np.ndarray, chosen: list[int], y: np.ndarray) -> float:
    """Return the least rise of the error when one candidate takes the place of a true term."""
    least = np.inf
    for gone in chosen:
        q = np.linalg.qr(values[:, [j for j in chosen if j != gone]])[0]
        columns = values - q @ (q.T @ values)
        target = y - q @ (q.T @ y)
        square = np.square(columns).sum(axis=0)
        usable = (square > 1e-18 * np.square(values).sum(axis=0)) & (np.arange(len(square)) != gone)
        gain = np.square(target @ columns[:, usable]) / square[usable]
        least = min(least, float(target @ target - gain.max()))
    return least
