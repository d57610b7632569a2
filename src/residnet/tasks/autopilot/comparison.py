"""Flying all controllers of an autopilot run through the same tests."""

from __future__ import annotations

from typing import Any

import pandas as pd
import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.heading.steering import Flights, SteeredPlant, fly
from residnet.judge.autopilots import (
    measure,
    random_variations,
    row,
    sea_flights,
    sea_row,
    step_flights,
    wind_flights,
)
from residnet.physics.vessel import load_vessel
from residnet.tasks.autopilot.config import AutopilotSettings


def compare(
    controllers: dict[str, tuple[str, Policy]], vessel: SteeredPlant, config: AutopilotSettings
) -> tuple[list[dict[str, Any]], pd.DataFrame, pd.DataFrame]:
    """Return the rows of metrics.json, and two tables: flights of the corners, random vessels.

    Args:
        controllers: kind (policy, classical, floor) and controller by name.
        vessel: in calm water.
        config: of the run.
    """
    corners = config.spread.corners()
    rows: list[dict[str, Any]] = []
    series, plants = [], []
    for name, (kind, policy) in controllers.items():
        test = config.test
        for protocol, variations in (("nominal", corners[:1]), ("corners", corners)):
            flights = step_flights(vessel, policy, variations, test.heading, test.dt, test.duration)
            rows.append(row(name, kind, protocol, flights, test.band))
        series.append(_series(name, flights, corners))
        drawn, speed = _random(config)
        flights = step_flights(vessel, policy, drawn, test.heading, test.dt, test.duration, speed)
        rows.append(row(name, kind, "random", flights, test.band))
        found = {key: values.numpy() for key, values in measure(flights, test.band).items()}
        given = {
            "controller": name,
            "effect": drawn[:, 0].numpy(),
            "time": drawn[:, 1].numpy(),
            "speed": speed.numpy(),
        }
        plants.append(pd.DataFrame({**given, **found}))
        rows += _disturbed(name, kind, policy, vessel, config)
    return rows, pd.concat(series, ignore_index=True), pd.concat(plants, ignore_index=True)


def _random(config: AutopilotSettings) -> tuple[Tensor, Tensor]:
    """Return variations [B, 3] and speeds [B] in m/s, the same for all controllers."""
    low, high = config.spread.speed
    count, seed = config.test.plants, config.seed + 1
    share = torch.rand(
        count, generator=torch.Generator().manual_seed(seed + 1_000_000), dtype=torch.float64
    )
    return (
        random_variations(config.spread.effect, config.spread.time, count, seed),
        low + (high - low) * share,
    )


def _disturbed(
    name: str, kind: str, policy: Policy, vessel: SteeredPlant, config: AutopilotSettings
) -> list[dict[str, Any]]:
    """Return the rows under a constant rudder bias, in wind and in waves."""
    test = config.test
    pushed = torch.tensor(
        [[1.0, 1.0, side * test.bias] for side in (1.0, -1.0)], dtype=torch.float64
    )
    flown = {
        "bias": fly(
            vessel,
            policy,
            torch.full((2,), test.heading),
            pushed,
            dt=test.dt,
            duration=test.bias_time,
        )
    }
    if test.wind is not None:
        abroad = SteeredPlant(load_vessel(config.vessel).build(), calm=False)
        flown["wind"] = wind_flights(
            abroad, policy, test.wind, test.heading, test.dt, test.bias_time
        )
    rows = [
        row(name, kind, key, flights, test.band)
        | {"error_end": float(flights.error[:, -1].abs().max())}
        for key, flights in flown.items()
    ]
    if test.sea is not None:
        plant = load_vessel(config.vessel).build()
        kept = sea_flights(
            plant,
            policy,
            test.sea,
            test.heading,
            test.dt,
            test.duration + test.sea_time,
            config.seed + 2,
        )
        rows.append(sea_row(name, kind, kept, test.duration))
    return rows


def _series(name: str, flights: Flights, corners: Tensor) -> pd.DataFrame:
    """Return heading, yaw rate and rudder every 0.05 s, all turned to starboard."""
    every = max(round(0.05 / flights.dt), 1)
    parts = []
    for i, variation in enumerate(corners):
        side = 1.0 if i % 2 == 0 else -1.0
        parts.append(
            pd.DataFrame(
                {
                    "controller": name,
                    "effect": float(variation[0]),
                    "time": float(variation[1]),
                    "t": torch.arange(0, flights.inputs.shape[1], every).numpy() * flights.dt,
                    "psi": side * flights.state("psi")[i, :-1:every].numpy(),
                    "r": side * flights.state("r")[i, :-1:every].numpy(),
                    "rudder": side * flights.inputs[i, ::every, 0].numpy(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)
