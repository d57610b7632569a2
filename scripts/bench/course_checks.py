"""What `courses.py` judges plans with: a check of its own and a search by sampling.

Neither uses any function of the planner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
POINTS = 40
"""Samples of a path between two buoys."""


@dataclass(frozen=True)
class Drawn:
    """A drawn course: start [2], buoys [N, 2], radii [N] in m, sides [N] (+1 to starboard)."""

    start: Array
    buoys: Array
    radii: Array
    sides: Array


def draw(
    rng: np.random.Generator,
    count: tuple[int, int],
    spacing: tuple[float, float],
    area: float | None,
    clearance: float,
) -> Drawn:
    """Draw a course; the next buoy lies in any direction, within the area where one is given."""
    number = int(rng.integers(count[0], count[1] + 1))
    at, places = np.zeros(2), []
    while len(places) < number:
        towards = rng.uniform(-math.pi, math.pi)
        after = at + rng.uniform(*spacing) * np.array([math.cos(towards), math.sin(towards)])
        if area is None or np.abs(after).max() <= 0.5 * area:
            places.append(after)
            at = after
    return Drawn(
        np.zeros(2), np.array(places), np.full(number, clearance), rng.choice([-1.0, 1.0], number)
    )


def passes(track: Array, buoys: Array) -> list[int]:
    """Return the sample at which each buoy is passed: nearest in sum, and in their order."""
    distance = np.hypot(*np.moveaxis(track[:, None] - buoys, -1, 0))
    least, chosen = distance[:, 0], []
    for i in range(1, len(buoys)):
        best = np.minimum.accumulate(least)
        first = np.maximum.accumulate(np.where(least <= best, np.arange(len(least)), 0))
        chosen.append(first)
        least = distance[:, i] + best
    at = [int(least.argmin())]
    for first in reversed(chosen):
        at.append(int(first[at[-1]]))
    return at[::-1]


def faults(track: Array, course: Drawn, protocol: str, slack: float = 0.0) -> list[str]:
    """Return what is wrong with a track [N, 2]: order, side of closest approach, clearance.

    The closest approach on the whole track counts, and the one in the buoy's turn. A circle in
    which the track begins counts from where the track, outside of it, comes nearer again. `slack`
    in m is allowed.
    """
    found = []
    turn = passes(track, course.buoys)
    for i, (place, radius, side) in enumerate(
        zip(course.buoys, course.radii, course.sides, strict=True)
    ):
        distance = np.hypot(*(track - place).T)
        if protocol == "enter":
            if distance[turn[i]] > radius + slack:
                found.append(f"buoy {i + 1} missed by {distance[turn[i]] - radius:.3g} m")
            continue
        left = 0
        if distance[0] < radius:
            away = np.flatnonzero(distance >= radius)
            left = int(away[0]) if len(away) else len(track) - 1
            while left < len(track) - 1 and distance[left + 1] >= distance[left]:
                left += 1
        if distance[left:].min() < radius - slack:
            found.append(f"buoy {i + 1} cleared by {distance[left:].min() - radius:.3g} m")
        whole = left + int(distance[left:].argmin())
        for name, near in (("in its turn", turn[i]), ("on the whole course", whole)):
            step = track[min(near + 1, len(track) - 1)] - track[max(near - 1, 0)]
            away = place - track[near]
            if (step[0] * away[1] - step[1] * away[0]) * side <= 0:
                found.append(f"buoy {i + 1} on the wrong side {name}")
    return found


def _words(start: Array, end: Array) -> tuple[Array, Array, Array]:
    """Return lengths [B, 6, 3] and turns [6, 3] of Dubins words between poses [B, 3], and totals.

    Lengths are in turning radii; a total is infinite where there is no such path.
    """
    turns = np.array(
        [(1, 0, 1), (-1, 0, -1), (1, 0, -1), (-1, 0, 1), (1, -1, 1), (-1, 1, -1)], dtype=float
    )
    lengths = np.zeros((len(start), 6, 3))
    possible = np.ones((len(start), 6), dtype=bool)
    for k, (first, middle, last) in enumerate(turns):
        c0 = start[:, :2] + first * np.stack((-np.sin(start[:, 2]), np.cos(start[:, 2])), -1)
        c1 = end[:, :2] + last * np.stack((-np.sin(end[:, 2]), np.cos(end[:, 2])), -1)
        line = c1 - c0
        far, bearing = np.hypot(*line.T), np.arctan2(line[:, 1], line[:, 0])
        if middle == 0 and first == last:
            heading = (bearing, bearing)
            lengths[:, k, 1] = far
        elif middle == 0:
            possible[:, k] = far >= 2.0
            straight = np.sqrt(np.maximum(far**2 - 4.0, 0.0))
            lengths[:, k, 1] = straight
            along = bearing + first * np.arctan2(2.0, straight)
            heading = (along, along)
        else:
            possible[:, k] = far <= 4.0
            lean = np.arccos(np.clip(far / 4.0, 0.0, 1.0))
            out, back = bearing + first * lean, bearing + math.pi - first * lean
            heading = (out + first * math.pi / 2, back + first * math.pi / 2)
            lengths[:, k, 1] = (middle * (heading[1] - heading[0])) % (2 * math.pi)
        lengths[:, k, 0] = (first * (heading[0] - start[:, 2])) % (2 * math.pi)
        lengths[:, k, 2] = (last * (end[:, 2] - heading[1])) % (2 * math.pi)
    return lengths, turns, np.where(possible, lengths.sum(-1), np.inf)


def _path(start: Array, lengths: Array, turns: Array) -> Array:
    """Return the points [n, 2] of a word from a pose, in turning radii."""
    pose, points = start.copy(), []
    for length, turn in zip(lengths, turns, strict=True):
        s = np.linspace(0.0, length, max(int(length / 0.05), 3))
        if turn == 0:
            part = pose[:2] + s[:, None] * np.array([math.cos(pose[2]), math.sin(pose[2])])
        else:
            h = pose[2] + turn * s
            part = pose[:2] + turn * np.stack(
                (np.sin(h) - math.sin(pose[2]), math.cos(pose[2]) - np.cos(h)), -1
            )
            pose = np.array([*pose[:2], h[-1]])
        pose = np.array([*part[-1], pose[2]])
        points.append(part)
    return np.concatenate(points)


def sampled(
    rng: np.random.Generator, course: Drawn, protocol: str, radius: float, paths: int
) -> float:
    """Return the length in m of the shortest sampled path without fault; infinite where none is.

    Each path goes through one random pose at each buoy: on its circle, along it, or anywhere in
    the circle that is to be entered. Vessels are taken to turn at once.
    """
    number = len(course.buoys)
    first = rng.uniform(-math.pi, math.pi, paths)
    pose = np.concatenate((np.zeros((paths, 2)) + course.start / radius, first[:, None]), 1)
    begin, total, words, chosen = pose, np.zeros(paths), [], []
    for i in range(number):
        angle = rng.uniform(-math.pi, math.pi, paths)
        spot = np.stack((np.cos(angle), np.sin(angle)), -1)
        if protocol == "enter":
            reach = np.sqrt(rng.uniform(0, 1, paths)) * course.radii[i] / radius
            heading = rng.uniform(-math.pi, math.pi, paths)
        else:
            # half of the paths keep farther off at random
            reach = course.radii[i] / radius * (1.0 + np.maximum(rng.uniform(-1, 1, paths), 1e-3))
            heading = angle + course.sides[i] * math.pi / 2
        after = np.concatenate(
            (course.buoys[i] / radius + reach[:, None] * spot, heading[:, None]), 1
        )
        lengths, turns, totals = _words(pose, after)
        best = totals.argmin(1)
        words.append(lengths[np.arange(paths), best])
        chosen.append(best)
        total += totals[np.arange(paths), best]
        pose = after
    for row in np.argsort(total):
        at, track = begin[row], []
        for lengths, best in zip(words, chosen, strict=True):
            part = _path(at, lengths[row], turns[best[row]])
            step = lengths[row] * turns[best[row]]
            at = np.array([*part[-1], at[2] + step.sum()])
            track.append(part)
        if not faults(radius * np.concatenate(track), course, protocol, 2e-3 * radius):
            return radius * float(total[row])
    return math.inf
