"""An exported model as the two controllers use it: what both know of the vessel."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import casadi
import numpy as np

NAMES = ("u", "v", "r")


class Identified:
    """A model that `residnet export --format casadi` wrote, with its card.

    Args:
        file: the .casadi file; its card lies beside it.

    Raises:
        ValueError: where the model does not have two inputs, which both controllers need.
    """

    def __init__(self, file: Path) -> None:
        self.step: Any = casadi.Function.load(str(file))
        card = json.loads(file.with_suffix(".card.json").read_text())
        self.dt: float = card["dt"]
        self.memory: int = card["memory"]
        self.inputs = [entry["name"] for entry in card["inputs"]]
        if len(self.inputs) != 2 or any(entry["role"] != "command" for entry in card["inputs"]):
            raise ValueError(
                f"{file}: its inputs are {', '.join(self.inputs)}; this example steers a vessel"
                " with two commands and no other inputs"
            )
        limits = np.array([card["training_range"][name] for name in (*NAMES, *self.inputs)])
        self.low, self.high = limits.T
        self._turns: dict[tuple[float, float], tuple[np.ndarray, np.ndarray]] = {}

    def rate(self, w: np.ndarray, nu: np.ndarray, s: np.ndarray | None = None) -> np.ndarray:
        """Return the mean acceleration [3] over one step from velocities nu under inputs w."""
        memory = np.zeros(self.memory) if s is None else s
        after = np.asarray(self.step(np.r_[0.0, 0.0, 0.0, nu], w, memory)[0]).ravel()
        return np.asarray((after[3:] - nu) / self.dt)

    def steady(self, u: float, r: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocities [3] and inputs [2] of a steady turn, by Newton's method.

        Inputs are held to the training range, where the turn may then be another.
        """
        if (u, r) not in self._turns:
            self._turns[u, r] = self._steady(u, r)
        return self._turns[u, r]

    def _steady(self, u: float, r: float) -> tuple[np.ndarray, np.ndarray]:
        low = self.low[3:]
        high = self.high[3:]
        unknown = np.r_[0.0, 0.5 * (low + high)]
        unknown[1:] += 0.25 * (high - low) * (np.abs(low + high) > 0.1 * (high - low))
        scale = np.r_[0.1, high - low]
        for _ in range(40):

            def missing(given: np.ndarray) -> np.ndarray:
                return self.rate(given[1:], np.array([u, given[0], r]))

            error = missing(unknown)
            slope = np.stack(
                [
                    (missing(unknown + 1e-4 * scale * row) - error) / (1e-4 * scale[k])
                    for k, row in enumerate(np.eye(3))
                ],
                axis=1,
            )
            move = np.linalg.lstsq(slope, -error, rcond=1e-8)[0]
            move *= min(1.0, 0.3 / float(np.abs(move / scale).max() + 1e-12))
            unknown = unknown + move
            unknown[1:] = np.clip(unknown[1:], low, high)
            if np.abs(move / scale).max() < 1e-7:
                break
        return np.array([u, unknown[0], r]), unknown[1:]

    def slopes(self, nu: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the acceleration by velocities [3, 3] and inputs [3, 2]."""
        x = casadi.MX.sym("nu", 3)
        given = casadi.MX.sym("w", 2)
        state = casadi.vertcat(0, 0, 0, x)
        change = (self.step(state, given, np.zeros(self.memory))[0][3:] - x) / self.dt
        both = casadi.Function(
            "slopes", [x, given], [casadi.jacobian(change, x), casadi.jacobian(change, given)]
        )
        first, second = both(nu, w)
        return np.asarray(first), np.asarray(second)
