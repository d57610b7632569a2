"""The contract of vessel files."""

from __future__ import annotations

import torch

from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.vessel import load_vessel
from residnet.testing.require import require, require_equal, require_finite


def check_vessel(name: str, step: float = 0.1) -> None:
    """Check that a vessel can be built and stepped.

    Its description is one line, its length positive, its motion under half drive finite, and equal
    for a vessel alone and one of several.

    Args:
        name: of the vessel, or path of its file.
        step: of the simulation in s.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"vessel {name}"
    vessel = load_vessel(name)
    require("\n" not in vessel.description.strip(), f"{who}: its description is not one line")
    require(vessel.length.value > 0, f"{who}: its length is not positive")
    plant = vessel.build()
    require(plant.commands > 0, f"{who}: has no commands")
    dynamics = PlantDynamics(plant, step)
    x = plant.approach(3)
    w = torch.zeros(3, len(plant.inputs), dtype=torch.float64)
    half = torch.full((3,), 0.5, dtype=torch.float64)
    w[:, : plant.commands] = plant.demand(half, 0.2 * half)
    start, memory = x.clone(), dynamics.initial_state(3).to(x.dtype)
    with torch.no_grad():
        for _ in range(100):
            x, memory = dynamics.step(x, w, memory)
        require_finite(x, f"{who}: its motion is not finite")
        first, _ = dynamics.step(start, w, dynamics.initial_state(3).to(x.dtype))
        alone, _ = dynamics.step(start[:1], w[:1], dynamics.initial_state(1).to(x.dtype))
    require_equal(alone, first[:1], 1e-12, f"{who}: moves otherwise beside other vessels")
