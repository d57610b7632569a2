"""Heading controllers judged under stated conditions: rows of metrics.json, and each flight."""

from __future__ import annotations

from typing import Any

import pandas as pd
import torch

from residnet.control.conditions.config import ConditionsConfig, HeadingChanges
from residnet.control.conditions.flights import ConditionedRun
from residnet.judge.autopilots import distribution

QUIET_FLIGHTS = 100


def drawn(conditions: ConditionsConfig, flights: int, seed: int) -> HeadingChanges:
    """Return flights that no tuning or training has seen, the same for all controllers."""
    random = torch.Generator().manual_seed(seed + 2_000_003)
    return conditions.draw(flights, conditions.dt, random)


def judged(
    controller: str,
    kind: str,
    protocol: str,
    run: ConditionedRun,
    conditions: ConditionsConfig,
    changes: HeadingChanges,
) -> tuple[dict[str, Any], pd.DataFrame]:
    """Return a row of metrics.json, and a table with a line for each flight, in SI units.

    A flight whose heading is no number counts as diverged, and with a heading error of 180 deg all
    the time in the means.
    """
    flown = run.fly(changes)
    finite = torch.isfinite(flown.psi).all(1) & torch.isfinite(flown.command).all(1)
    worst = conditions.duration + 0.5 * 180.0
    found = {
        name: torch.where(finite, values, worst if name == "cost" else torch.nan)
        for name, values in flown.measured(conditions).items()
    }
    row = {"model": controller, "kind": kind, "split": "simulated", "protocol": protocol}
    kept = {name: values if name == "cost" else values[finite] for name, values in found.items()}
    figures = {name: distribution(values) for name, values in kept.items() if len(values)}
    table = pd.DataFrame(
        {
            "controller": controller,
            "protocol": protocol,
            "flight": range(len(finite)),
            **{name: values.numpy() for name, values in found.items()},
        }
    )
    return {**row, **figures, "n": len(finite), "diverged": int((~finite).sum())}, table


def swinging(
    controller: str, kind: str, run: ConditionedRun, changes: HeadingChanges, after: float
) -> dict[str, Any]:
    """Return the row of metrics.json of flights without noise: what still swings at their end.

    `after` is the time in s from the change on from which they are looked at.
    """
    flown = run.fly(changes)
    heading, rudder = flown.swing(after)
    return {
        "model": controller,
        "kind": kind,
        "split": "simulated",
        "protocol": "quiet",
        "heading_swing": distribution(heading),
        "rudder_swing": distribution(rudder),
        "n": len(heading),
    }
