"""Measures of heading controllers: one definition for all, with spreads over random vessels."""

from __future__ import annotations

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
