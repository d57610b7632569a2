"""Measures of heading controllers: one definition for all, with spreads over random vessels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.steering import Flights, SteeredPlant, SteeredVessel, fly
from residnet.data.simulated.environment import Disturbance
from residnet.physics.environment.waves import WavesConfig
from residnet.physics.plant import Plant

QUANTITIES = {
    "settling": "s",
    "overshoot": "rad",
    "iae": "rad s",
    "travel": "rad",
    "energy": "rad^2 s",
}
"""Of a row, with units: last entry into the band, overshoot, integral of the absolute error, travel
of the rudder command, integral of its square.
"""


def measure(flights: Flights, band: float) -> dict[str, Tensor]:
    """Return each of `QUANTITIES` by flight, [B]."""
    values = (
        flights.settled(band),
        flights.overshoot(),
        flights.absolute_error(),
        flights.travel(),
        flights.effort(),
    )
    return dict(zip(QUANTITIES, values, strict=True))


def distribution(values: Tensor) -> dict[str, float]:
    """Return mean, median, 95th percentile and largest of values [B]."""
    array = values.double().numpy()
    return {
        "mean": float(array.mean()),
        "median": float(np.median(array)),
        "p95": float(np.quantile(array, 0.95)),
        "max": float(array.max()),
    }


def row(controller: str, kind: str, protocol: str, flights: Flights, band: float) -> dict[str, Any]:
    """Return a row of metrics.json: distributions, flights not settled at the end, flights."""
    found = measure(flights, band)
    finite = torch.isfinite(flights.states).all(dim=2).all(dim=1)
    unsettled = (flights.error[:, -1].abs() > band) | ~finite
    out: dict[str, Any] = {
        "model": controller,
        "kind": kind,
        "split": "simulated",
        "protocol": protocol,
    }
    out |= {name: distribution(values) for name, values in found.items()}
    return out | {
        "unsettled": int(unsettled.sum()),
        "n": len(finite),
        "diverged": int((~finite).sum()),
    }


def random_variations(
    effect: tuple[float, float], time: tuple[float, float], count: int, seed: int
) -> Tensor:
    """Return effect and time drawn evenly from their ranges, no bias: [count, 3]."""
    drawn = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = torch.tensor([effect, time], dtype=torch.float64).T
    return torch.cat(
        (low + (high - low) * drawn, torch.zeros(count, 1, dtype=torch.float64)), dim=1
    )


def step_flights(
    vessel: SteeredVessel,
    policy: Policy,
    variations: Tensor,
    heading: float,
    dt: float,
    duration: float,
    speed: Tensor | None = None,
) -> Flights:
    """Run steps of the reference, to starboard and to port in turn.

    `speed` holds multiples [B] of the service speed.
    """
    side = torch.where(torch.arange(len(variations)) % 2 == 0, 1.0, -1.0)
    return fly(vessel, policy, heading * side, variations, dt=dt, duration=duration, speed=speed)


def wind_flights(
    vessel: SteeredVessel, policy: Policy, speed: float, heading: float, dt: float, duration: float
) -> Flights:
    """Run steps of the reference with the nominal vessel in wind from eight directions."""
    direction = torch.arange(8) * (torch.pi / 4.0)
    weather: dict[str, float | Tensor] = {"wind_speed": speed, "wind_dir": direction}
    return fly(
        vessel,
        policy,
        torch.full((8,), heading),
        _nominal(8),
        dt=dt,
        duration=duration,
        weather=weather,
    )


def sea_flights(
    plant: Plant,
    policy: Policy,
    waves: WavesConfig,
    heading: float,
    dt: float,
    duration: float,
    seed: int,
    rows: int = 8,
) -> Flights:
    """Run steps of the reference with the nominal vessel in several seaways."""
    disturbance = Disturbance(waves=waves)
    return fly(
        SteeredPlant(plant, calm=False),
        policy,
        torch.full((rows,), heading),
        _nominal(rows),
        dt=dt,
        duration=duration,
        surround=lambda source: disturbance.surround(source, plant, rows, dt, seed),
    )


def sea_row(controller: str, kind: str, flights: Flights, start: float) -> dict[str, Any]:
    """Return a row of metrics.json: roots of mean squares from a time [s] on.

    They are of heading error, rudder and, where the vessel rolls, heel.
    """
    settled = flights.error[:, round(start / flights.dt) :]
    found = {
        "heading_rms": settled.square().mean(1).sqrt(),
        "rudder_rms": flights.rudder_rms(start),
    }
    if "phi" in flights.names:
        found["heel_rms"] = flights.rms("phi", start)
    out: dict[str, Any] = {
        "model": controller,
        "kind": kind,
        "split": "simulated",
        "protocol": "sea",
    }
    return (
        out | {name: distribution(values) for name, values in found.items()} | {"n": len(settled)}
    )


def _nominal(rows: int) -> Tensor:
    return torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(rows, -1)


def table(rows: Sequence[Mapping[str, Any]], floor: str | None) -> str:
    """Return the comparison as text.

    Settling at the nominal vessel, over the corners and over random vessels, overshoot, steady
    errors.
    """
    find = {(row["model"], row["protocol"]): row for row in rows}
    names = list(dict.fromkeys(row["model"] for row in rows))
    base = find[(floor, "nominal")]["settling"]["max"] if floor else None
    windy = any(row["protocol"] == "wind" for row in rows)
    lines = [
        f"{'controller':14s} {'nominal s':>9s} {'x floor':>8s} {'worst s':>8s} {'random s':>9s}"
        f" {'p95 s':>7s} {'overshoot deg':>14s} {'bias deg':>9s}"
        + (f" {'wind deg':>9s}" if windy else "")
    ]
    for name in names:
        nominal, corners, random, bias = (
            find[(name, protocol)] for protocol in ("nominal", "corners", "random", "bias")
        )
        share = f"{nominal['settling']['max'] / base:8.3f}" if base else f"{'':8s}"
        over = math.degrees(max(corners["overshoot"]["max"], random["overshoot"]["max"]))
        late = (
            "  (not settled in all flights)"
            if corners["unsettled"] + random["unsettled"] + nominal["unsettled"]
            else ""
        )
        wind = f" {math.degrees(find[(name, 'wind')]['error_end']):9.4f}" if windy else ""
        lines.append(
            f"{name:14s} {nominal['settling']['max']:9.2f} {share}"
            f" {corners['settling']['max']:8.2f} {random['settling']['mean']:9.2f}"
            f" {random['settling']['p95']:7.2f} {over:14.3f}"
            f" {math.degrees(bias['error_end']):9.4f}{wind}{late}"
        )
    return "\n".join(lines)


def effort_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return means over random vessels of what a change and what the course costs, as text."""
    find = {(row["model"], row["protocol"]): row for row in rows}
    names = list(dict.fromkeys(row["model"] for row in rows))
    degree = 180.0 / math.pi
    sea = {name: find[(name, "sea")] for name in names if (name, "sea") in find}
    rolls = any("heel_rms" in row for row in sea.values())
    head = (
        f"{'controller':14s} {'IAE deg s':>10s} {'p95':>8s} {'travel deg':>11s} {'p95':>8s}"
        f" {'energy deg2 s':>14s} {'p95':>8s}"
    )
    head += f" {'sea: heading deg':>17s} {'rudder deg':>11s}" if sea else ""
    lines = [head + (f" {'heel deg':>9s}" if rolls else "")]
    for name in names:
        random = find[(name, "random")]
        parts = [
            (random["iae"], degree, 10),
            (random["travel"], degree, 11),
            (random["energy"], degree**2, 14),
        ]
        line = f"{name:14s} " + " ".join(
            f"{scale * own['mean']:{width}.2f} {scale * own['p95']:8.2f}"
            for own, scale, width in parts
        )
        if sea:
            line += (
                f" {degree * sea[name]['heading_rms']['mean']:17.3f}"
                f" {degree * sea[name]['rudder_rms']['mean']:11.3f}"
            )
        lines.append(line + (f" {degree * sea[name]['heel_rms']['mean']:9.3f}" if rolls else ""))
    return "\n".join(lines)
