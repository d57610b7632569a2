"""Findings about wind channels that contain the vessel's own motion."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, Level


def relative_wind_findings(log: Log, inputs: Sequence[str]) -> Iterator[Finding]:
    """Return the wind directions that turn against the heading: relative wind, not true wind."""
    if "psi" not in log.channels:
        return
    directions = [name for name in log.channels if "wind" in name and log.units[name] == "rad"]
    for name in directions:
        slope, error = _slope_against_heading(log, name)
        partner = next(
            (other for other in directions if other != name and _same_direction(log, name, other)),
            None,
        )
        turns = error > 0.0 and slope < -5.0 * error and abs(slope + 1.0) < max(3.0 * error, 0.2)
        if not (turns or partner or "relative" in name or name.startswith("rel_")):
            continue
        text = f"{name} turns by {slope:+.2f} +- {2.0 * error:.2f} of every change of heading" + (
            f", and plus psi it is {partner}" if partner else ""
        )
        action = (
            "a free run must not be given it: use the true wind"
            if name in inputs
            else "do not make it an input: use the true wind"
        )
        level: Level = "will mislead" if name in inputs else "note"
        yield Finding(
            level,
            "relative_wind",
            f"{text}: a relative wind contains psi, u and v",
            {"slope": slope, "error": error},
            action,
        )


def _same_direction(log: Log, relative: str, true: str) -> bool:
    """Return whether one direction plus the heading is the other, where the heading tells."""
    with_heading, without_heading = (
        np.exp(1j * (log[relative] + turn - log[true])) for turn in (log["psi"], 0.0)
    )
    return bool(
        abs(np.nanmean(with_heading)) > 0.9
        and abs(np.nanmean(without_heading)) < abs(np.nanmean(with_heading)) - 0.02
    )


def _slope_against_heading(log: Log, name: str) -> tuple[float, float]:
    """Return the change of a direction over ten seconds per rad of heading, and its error.

    The error is a standard error; both are 0 where nothing can be said.
    """
    hop = max(round(10.0 / float(np.median(np.diff(log.t)))), 1)
    if len(log) < 5 * hop:
        return 0.0, 0.0
    change = np.angle(np.exp(1j * (log[name][hop:] - log[name][:-hop])))
    turn = log["psi"][hop:] - log["psi"][:-hop]
    # beyond half a circle a change of direction is ambiguous
    good = np.isfinite(change) & np.isfinite(turn) & (np.abs(turn) < 1.5)
    if good.sum() < 100 or float(np.std(turn[good])) < math.radians(1.0):
        return 0.0, 0.0
    y, x = change[good] - change[good].mean(), turn[good] - turn[good].mean()
    slope = float(x @ y) / float(x @ x)
    scores = np.array([part.sum() for part in np.array_split(x * (y - slope * x), 20)])
    return slope, float(np.sqrt((scores**2).sum()) / float(x @ x))
