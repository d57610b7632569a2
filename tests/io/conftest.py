"""Logs of a ship that several files of tests write down in their own ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from made_once import made_once

import residnet
from residnet.core.log import Log


@pytest.fixture(scope="session")
def ship_logs(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    """Zigzags and a turn of a ship with rudder and propeller."""
    trials: list[dict[str, Any]] = [
        {"kind": "zigzag", "drive": 0.8, "steer": 0.5, "heading": "20 deg", "start": 3},
        {"kind": "turning_circle", "drive": 0.9, "steer": 0.4, "start": 3},
        {"kind": "zigzag", "drive": 0.6, "steer": -0.4, "heading": "10 deg", "start": 3},
    ]
    noise = {"u": 0.02, "v": 0.02, "r": 0.002}

    def make(folder: Path) -> None:
        flown = residnet.simulate(
            "example_rudder_boat", trials, duration=90.0, step=0.1, noise=noise, seed=4
        )
        for number, log in enumerate(flown.logs):
            log.save(folder / f"{number}.parquet")

    folder = made_once(tmp_path_factory, "ship_logs", make)
    return [Log.load(path) for path in sorted(folder.glob("*.parquet"))]
