"""How lively a predicted run is: what is known at run time of how far it may be off.

A free run that holds a course drifts slowly; one that reverses its rudder turns every error of
timing into an error of velocity. Both are seen in the prediction itself, without a measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.layout import VELOCITIES

MEASURES = ("u", "v", "r", "u_dot", "v_dot", "r_dot")
"""Predicted velocities and accelerations whose root mean square so far tells how lively it is."""
_FLOOR = 0.02
"""Share of the usual mean square below which a measure says nothing more."""
_FURTHEST = 2.5
"""Standard deviations beyond which a measure counts no further."""


def mean_squares(states: np.ndarray, step: float) -> np.ndarray:
    """Return the mean squares so far of predicted velocities and accelerations, [L, 6].

    Args:
        states: predicted [L + 1, 6], from the initial state on.
        step: in s.
    """
    nu = states[:, VELOCITIES]
    seen = np.concatenate((nu[1:], np.diff(nu, axis=0) / step), axis=1)
    return np.asarray(np.cumsum(seen**2, axis=0) / np.arange(1, len(seen) + 1)[:, None])


@dataclass(frozen=True)
class Activity:
    """Standardised logarithms of the mean squares of a predicted run.

    Attributes:
        floor: added to each mean square [6], squares of SI units.
        centre: mean of the logarithms over the runs that calibrated [6].
        spread: their standard deviation [6].
    """

    floor: np.ndarray
    centre: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, squares: Sequence[np.ndarray], weight: np.ndarray) -> Activity:
        """Return what standardises the runs of a calibration.

        Args:
            squares: `mean_squares` of each of W runs, [L, 6].
            weight: of each run [W].
        """
        share = np.concatenate(
            [np.full(len(own), w) for own, w in zip(squares, weight, strict=True)]
        )
        joined = np.concatenate(squares)
        floor = _FLOOR**2 * np.average(joined, axis=0, weights=share) + 1e-12
        logs = np.log(joined + floor)
        centre = np.average(logs, axis=0, weights=share)
        spread = np.sqrt(np.average((logs - centre) ** 2, axis=0, weights=share))
        return cls(floor, centre, np.maximum(spread, 1e-6))

    def of_run(self, states: np.ndarray, step: float) -> np.ndarray:
        """Return the measures [L, 6] of a run with predicted states [L + 1, 6]."""
        return self.standard(mean_squares(states, step))

    def standard(self, squares: np.ndarray) -> np.ndarray:
        """Return mean squares [..., 6] standardised."""
        z = (np.log(squares + self.floor) - self.centre) / self.spread
        return np.asarray(np.clip(z, -_FURTHEST, _FURTHEST))
