"""What flights say about heading controllers: one definition for all, distributions over random vessels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.steering import Flights, SteeredVessel, fly

QUANTITIES = ("settling", "overshoot", "iae", "travel")
"""Of a row: last entry into the band [s], overshoot [rad], integral of the absolute error [rad s], travel of the rudder command [rad]."""


def measure(flights: Flights, band: float) -> dict[str, Tensor]:
    """Each of `QUANTITIES` by flight, [B]."""
    values = (flights.settled(band), flights.overshoot(), flights.absolute_error(), flights.travel())
    return dict(zip(QUANTITIES, values, strict=True))


def distribution(values: Tensor) -> dict[str, float]:
    """Mean, median, 95th percentile and largest of values [B]."""
    array = values.double().numpy()
    return {"mean": float(array.mean()), "median": float(np.median(array)), "p95": float(np.quantile(array, 0.95)), "max": float(array.max())}


def row(controller: str, kind: str, protocol: str, flights: Flights, band: float) -> dict[str, Any]:
    """A row of metrics.json: the distributions, how many flights had not settled at the end, and how many there were."""
    found = measure(flights, band)
    finite = torch.isfinite(flights.states).all(dim=2).all(dim=1)
    unsettled = (flights.error[:, -1].abs() > band) | ~finite
    out: dict[str, Any] = {"model": controller, "kind": kind, "split": "simulated", "protocol": protocol}
    out |= {name: distribution(values) for name, values in found.items()}
    return out | {"unsettled": int(unsettled.sum()), "n": len(finite), "diverged": int((~finite).sum())}


def random_variations(effect: tuple[float, float], time: tuple[float, float], count: int, seed: int) -> Tensor:
    """Effect and time drawn evenly from their ranges, no bias: [count, 3]."""
    drawn = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = torch.tensor([effect, time], dtype=torch.float64).T
    return torch.cat((low + (high - low) * drawn, torch.zeros(count, 1, dtype=torch.float64)), dim=1)


def step_flights(vessel: SteeredVessel, policy: Policy, variations: Tensor, heading: float, dt: float, duration: float) -> Flights:
    """Steps of the reference, to starboard and to port in turn."""
    side = torch.where(torch.arange(len(variations)) % 2 == 0, 1.0, -1.0)
    return fly(vessel, policy, heading * side, variations, dt=dt, duration=duration)


def table(rows: Sequence[Mapping[str, Any]], floor: str | None) -> str:
    """The comparison as text: settling at the nominal vessel, over the corners and over random vessels."""
    find = {(row["model"], row["protocol"]): row for row in rows}
    names = list(dict.fromkeys(row["model"] for row in rows))
    base = find[(floor, "nominal")]["settling"]["max"] if floor else None
    lines = [
        f"{'controller':14s} {'nominal s':>9s} {'x floor':>8s} {'worst s':>8s} {'random s':>9s} {'p95 s':>7s} {'overshoot deg':>14s} {'bias deg':>9s}"
    ]
    for name in names:
        nominal, corners, random, bias = (find[(name, protocol)] for protocol in ("nominal", "corners", "random", "bias"))
        share = f"{nominal['settling']['max'] / base:8.3f}" if base else f"{'':8s}"
        over = math.degrees(max(corners["overshoot"]["max"], random["overshoot"]["max"]))
        late = "  (not settled in all flights)" if corners["unsettled"] + random["unsettled"] + nominal["unsettled"] else ""
        lines.append(
            f"{name:14s} {nominal['settling']['max']:9.2f} {share} {corners['settling']['max']:8.2f} {random['settling']['mean']:9.2f} "
            f"{random['settling']['p95']:7.2f} {over:14.3f} {math.degrees(bias['error_end']):9.4f}{late}"
        )
    return "\n".join(lines)
