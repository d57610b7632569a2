"""Examples of every kind of manoeuvre, found from the unions themselves, and a way to fly them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.log import Log
from residnet.core.registry import kinds
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import RecordedPlantDynamics
from residnet.manoeuvres import FamilyConfig, ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.open_loop import Replay
from residnet.physics.plant import Plant

FAMILIES, MANOEUVRES = kinds(FamilyConfig), kinds(ManoeuvreConfig)
# what a family cannot do without; a new family whose fields have defaults beyond these needs no
# line here
NEEDS: dict[str, Any] = {
    "count": 5,
    "heading": (0.2, 0.4),
    "depth": (1.0, 2.0),
    "drive": (0.3, 0.8),
    "steer": (-0.5, 0.4),
}
# of kinds that nothing draws at random
EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "spiral": [
        {"drive": 0.5, "start": 2, "steady": {"window": 1.5, "tolerance": 0.05}},
        {"drive": 0.6, "steers": [0.4, -0.4], "start": 1},
    ],
    "stopping": [{"drive": 0.6, "start": 8}, {"drive": 0.9, "astern": -0.5, "start": 11}],
    "waypoints": [
        {"drive": 0.7, "points": [[8, 0], [8, 10]], "acceptance": 2, "lookahead": 4},
        {"drive": 0.5, "points": [[10, -5]], "acceptance": 2, "lookahead": 4},
    ],
}
DURATION, DT = 15.0, 0.1


def family(kind: str) -> Any:
    required = {
        name: NEEDS[name]
        for name, info in FAMILIES[kind].model_fields.items()
        if info.is_required()
    }
    return FAMILIES[kind](**required)


def drawn(kind: str, seed: int = 0) -> list[Manoeuvre]:
    if kind == "replay":
        return replays()
    if kind in EXAMPLES:
        return [MANOEUVRES[kind](**example) for example in EXAMPLES[kind]]
    return family(kind).draw(np.random.default_rng(seed), DURATION)


@lru_cache
def replays() -> list[Manoeuvre]:
    """Two recorded logs, flown from where they begin."""
    folder = Path(mkdtemp())
    out: list[Manoeuvre] = []
    for i in range(2):
        t = np.arange(0.0, DURATION, 0.25)
        channels = {
            name: np.full(t.size, 0.1 * (i + j))
            for j, name in enumerate(("x", "y", "psi", "u", "v", "r"))
        }
        channels |= {"cmd_port": 20.0 + 5.0 * np.sin(t + i), "cmd_stbd": 15.0 * np.cos(t)}
        Log(f"log{i}", t, channels).save(folder / f"log{i}.parquet")
        out.append(Replay(log=folder / f"log{i}.parquet"))
    return out


# of a vessel that dives; the contracts fly them
DIVING = ("helix", "vertical_zigzag", "depth_step")
# needs a vessel with all three forces; see test_closed_loop
FLOWN = [kind for kind in MANOEUVRES if kind not in ("four_corner", *DIVING)]


def times(seconds: float = DURATION, dt: float = DT) -> Tensor:
    return torch.arange(round(seconds / dt), dtype=torch.float64) * dt


@lru_cache
def traced(plant: Plant, dt: float = DT) -> RecordedPlantDynamics:
    """The step of a vessel, recorded once."""
    return RecordedPlantDynamics(plant, dt)


def fly(
    plant: Plant,
    manoeuvres: list[Manoeuvre],
    dt: float = DT,
    seconds: float = DURATION,
    psi: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor]:
    """States [B, T+1, 8] and commands [B, T, 2]."""
    t = times(seconds, dt)
    source = type(manoeuvres[0]).source(manoeuvres, Helm.from_plant(plant), t)
    x0 = torch.zeros(len(manoeuvres), 8, dtype=torch.float64)
    x0[:, 2] = psi
    w = torch.zeros(len(manoeuvres), len(t), len(plant.inputs), dtype=torch.float64)
    with torch.no_grad():
        states, inputs, _ = Rollout(traced(plant, dt), source)(x0, w, x0[:, :0])
    return states, inputs[:, :, :2]
