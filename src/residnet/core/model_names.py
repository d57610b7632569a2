"""Names of the reference models of a fit, which are also kinds of rows in metrics.json."""

from __future__ import annotations

from typing import Final

CONSTANT_VELOCITY: Final = "constant_velocity"
"""The model that holds the initial velocities of a free run."""
BASELINE: Final = "baseline"
"""The first known part of a fit."""
ENSEMBLE: Final = "ensemble"
"""The ensemble of the standard recipe: the mean of the trajectories of unlike models."""
PLANT: Final = "plant"
"""The simulator that made the logs."""

FORMER_NAMES = {"zero": CONSTANT_VELOCITY, "truth": PLANT}
"""Kinds and names of models in run folders of earlier versions, and their names today."""
